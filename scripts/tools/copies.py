"""Copies of the repository in which pytest runs, each in a fork of this process."""

from __future__ import annotations

import ast
import contextlib
import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter, defaultdict
from pathlib import Path
from types import ModuleType
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
# What the parent has imported differently, or must not have imported at all.
OURS = {"crashhunt", "conftest", "py", "xdist", "_hypothesis_pytestplugin", "__main__", "slips", "copies"}
PYTEST = (
    "-q", "-x", "--tb=no", "-p", "no:randomly", "-p", "no:cacheprovider", "--hypothesis-profile=slips",
    "-W", "ignore::pytest.PytestAssertRewriteWarning",
)  # fmt: skip

_STARTS = {"subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn", "socket.sendmsg"}
"""What Python calls it when a process is started (sys.audit); tests have another process fork by a message."""


class Watcher:
    """A pytest plugin that notes which lines of some files each test runs, and how long it takes.

    Args:
        files: the absolute paths of the files.
    """

    def __init__(self, files: list[str]) -> None:
        self.seconds: Counter[str] = Counter()
        self.forked: set[str] = set()  # tests that have started processes, of which no line is seen
        self._files = files
        self._test = ""

    def start(self) -> None:
        """Begin to trace, in C: a trace function in Python makes tests several times slower."""
        import coverage

        self._coverage = coverage.Coverage(data_file=None, config_file=False, include=self._files)
        self._coverage.set_option("run:disable_warnings", ["trace-changed", "no-data-collected"])
        self._coverage.start()
        sys.addaudithook(self._audit)

    def reached(self) -> dict[str, dict[str, list[int]]]:
        """Stop, and return of each file test to the lines that it runs; those that run at import have no test."""
        self._coverage.stop()
        data, reached = self._coverage.get_data(), {}
        for file in self._files:
            inside, lines = lines_in_functions(Path(file).read_text(encoding="utf-8")), defaultdict(set)
            for line, tests in data.contexts_by_lineno(file).items():
                for test in tests if line in inside else ("",):
                    lines[test].add(line)
            reached[file] = {test: sorted(found) for test, found in lines.items()}
        return reached

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """A test begins."""
        self._test = nodeid
        self._coverage.switch_context(nodeid)

    def pytest_runtest_logreport(self, report: Any) -> None:
        """A part of a test is over."""
        self.seconds[report.nodeid] += report.duration

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        """A test is over."""
        self._test = ""
        self._coverage.switch_context("")

    def _audit(self, event: str, _: object) -> None:
        if event in _STARTS and self._test:
            self.forked.add(self._test)


def lines_in_functions(source: str) -> set[int]:
    """Return the lines of the bodies of functions, which do not run at import."""
    inside: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            inside.update(range(node.body[0].lineno, (node.end_lineno or node.lineno) + 1))
    return inside


class NoBrowser:
    """A pytest plugin that leaves out tests in a browser: it needs more memory than a slip may take, and seconds."""

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        """Keep the other tests."""
        items[:] = [item for item in items if "chromium" not in getattr(item, "fixturenames", ())]


class Slot:
    """A copy of the repository, in which one pytest runs at a time.

    Args:
        tree: where the copy is.
    """

    def __init__(self, tree: Path) -> None:
        self.tree = tree
        self._written = 0
        self._pid = 0
        self._deadline = 0.0
        self._temporary = ""
        # Some tests read the workflows of GitHub.
        shutil.copytree(
            ROOT, tree, ignore=lambda _, names: [name for name in names if name[0] == "." and name != ".github"]
        )

    def put(self, file: Path, text: str) -> None:
        """Write a source file into the copy."""
        self._written += 1
        path = self.tree / file
        path.write_text(text, encoding="utf-8")
        # Python knows what it has compiled by size and time of the source, and two slips may have both in common.
        os.utime(path, (self._written, self._written))

    def start(self, arguments: list[str], *, seconds: float, watcher: Watcher | None = None) -> None:
        """Run pytest in a process of its own, for so much time of the processor and at most ten times as long."""
        self._deadline = time.monotonic() + 10 * seconds
        # The child ends without Python's exit functions, so that this process removes its temporary files.
        memory = Path("/dev/shm")
        in_memory = memory.is_dir() and os.access(memory, os.W_OK)
        self._temporary = tempfile.mkdtemp(prefix="crashhunt-mutate-", dir=memory if in_memory else None)
        self._pid = os.fork()
        if self._pid == 0:
            code = 70
            try:
                code = self._child(arguments, seconds, watcher)
            finally:
                os._exit(code)

    def poll(self) -> str | None:
        """Return how pytest has ended, such as ``passed``; None while it runs."""
        if time.monotonic() > self._deadline:
            self.kill()
            return "timeout"
        pid, status = os.waitpid(self._pid, os.WNOHANG)
        if not pid:
            return None
        self._sweep()
        self._pid = 0
        shutil.rmtree(self._temporary, ignore_errors=True)
        if os.WIFSIGNALED(status):
            return "timeout" if os.WTERMSIG(status) == signal.SIGXCPU else "failed"
        return "passed" if os.WEXITSTATUS(status) == 0 else "failed"

    def wait(self) -> str:
        """Wait until pytest has ended."""
        while (ended := self.poll()) is None:
            time.sleep(0.02)
        return ended

    def kill(self) -> None:
        """End pytest and what it has started."""
        if self._pid:
            self._sweep()
            with contextlib.suppress(ChildProcessError):
                os.waitpid(self._pid, 0)
            self._pid = 0
            shutil.rmtree(self._temporary, ignore_errors=True)

    def said(self) -> str:
        """Return what pytest has printed."""
        return (self.tree / ".said").read_text(encoding="utf-8", errors="replace")

    def _sweep(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._pid, signal.SIGKILL)

    def _child(self, arguments: list[str], seconds: float, watcher: Watcher | None) -> int:
        os.setsid()
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        resource.setrlimit(resource.RLIMIT_CPU, (int(seconds) + 1, int(seconds) + 10))
        for what, most in ((resource.RLIMIT_FSIZE, 2 << 30), (resource.RLIMIT_AS, 8 << 30)):
            resource.setrlimit(what, (most, resource.getrlimit(what)[1]))  # a slip may take without an end
        os.chdir(self.tree)
        output = os.open(".said", os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        for number in (1, 2):
            os.dup2(output, number)
        # No test sees this folder and its modules, of which snapshots would copy the code.
        sys.path[:] = [str(self.tree), *(place for place in sys.path if place != str(Path(__file__).parent))]
        for name in ("copies", "slips"):
            sys.modules.pop(name, None)
        sys.modules["__main__"] = ModuleType("__main__")
        os.environ |= {"PYTHONPATH": str(self.tree), "TMPDIR": self._temporary}  # for what the tests start, too
        tempfile.tempdir = None
        import hypothesis
        import pytest

        # An example that fails is enough: it need not be a small one.
        phases = (hypothesis.Phase.explicit, hypothesis.Phase.generate)
        hypothesis.settings.register_profile("slips", phases=phases, deadline=None, derandomize=True, database=None)
        if watcher is not None:
            watcher.start()
        plugins = [NoBrowser(), *([watcher] if watcher is not None else [])]
        code = pytest.main([*PYTEST, f"--basetemp={self.tree}.tmp", *arguments], plugins=plugins)
        if watcher is not None:
            reached = watcher.reached()
            others = [name for name, module in [*sys.modules.items()] if self._is_installed(name, module)]
            facts = {"reached": reached, "seconds": watcher.seconds, "forked": [*watcher.forked], "modules": others}
            Path(".facts").write_text(json.dumps(facts), encoding="utf-8")
        sys.stdout.flush()
        return int(code)

    def _is_installed(self, name: str, module: object) -> bool:
        file = getattr(module, "__file__", None) or ""
        top = name.partition(".")[0]
        return top not in OURS and not top.startswith(("pytest", "_pytest")) and not file.startswith(str(self.tree))
