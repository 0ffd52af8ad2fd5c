"""The files that a process opens, loads or starts, and the files to which its output goes.

An audit hook of Python (PEP 578) reports what Python code opens, loads with ctypes, and starts. The kernel reports what
is mapped and still open, which includes what compiled code has opened. A file that compiled code has opened and closed
again is not found. A hook costs 0.1 us for each event, cannot be removed, and is inherited by forks. Therefore it is
used only in a process that runs a single trial, or that only imports modules.
"""

from __future__ import annotations

import fcntl
import os
import shlex
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any


class OpenedFiles:
    """Collects the absolute paths of files from now on, also of files that do not exist."""

    def __init__(self) -> None:
        self._found: dict[str, None] = {}
        self._since = time.time()
        self._inherited = frozenset(_open_now())  # such as a file from which standard input is redirected
        sys.addaudithook(self._hook)

    def inputs(self) -> list[str]:
        """Return those of `paths` that were there before this object, so that nothing of this process wrote them."""
        return [path for path in self.paths() if (found := _changed_at(path)) is not None and found < self._since]

    def paths(self) -> list[str]:
        """Return what was opened for reading, loaded or started, and what is mapped or open now."""
        return list(dict.fromkeys([*list(self._found), *_mapped(), *sorted({*_open_now()} - self._inherited)]))

    def _hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event not in _EVENTS:
            return
        with suppress(Exception):  # an exception would make the call of the user's code fail
            if event == "open":
                path, _, flags = arguments
                if (flags or 0) & os.O_ACCMODE == os.O_RDONLY:
                    self._add(path)
            elif event == "ctypes.dlopen":
                self._add(arguments[0], only_paths=True)
            elif event == "os.system":
                self._add_command([arguments[0]])
            else:
                program, words, *rest = arguments
                folder = rest[0] if event == "subprocess.Popen" else None
                self._add_command([program, *words], folder)

    def _add(self, path: Any, folder: Any = None, *, only_paths: bool = False) -> None:
        if isinstance(path, int) or path is None:
            return
        name = os.fsdecode(path)
        if not only_paths or "/" in name:  # the loader looks for a plain name in its own folders
            self._found[os.path.join(os.getcwd(), os.fsdecode(folder or ""), name)] = None  # noqa: PTH109, PTH118

    def _add_command(self, words: Any, folder: Any = None) -> None:
        """Add the program, and what words of the command name, such as a script."""
        for word in words:
            text = os.fsdecode(word)
            for part in {text, *(shlex.split(text) if " " in text else ())}:
                if os.path.isfile(os.path.join(os.fsdecode(folder or ""), part)) or part.startswith("/"):  # noqa: PTH113, PTH118
                    self._add(part, folder)


def output_files() -> set[str]:
    """Return the absolute paths of the files to which the output of this command goes: they grow, and are no code.

    The shell may have redirected this command, or a command that started it, such as a suite or a script. A program
    such as ``tee`` may read the output through a pipe; then its files count.
    """
    found: set[str] = set()
    waiting = [target for pid in _ancestors() for stream in (1, 2) if (target := _target(pid, stream))]
    readers: dict[str, list[str]] | None = None
    while waiting:
        target = waiting.pop()
        if target in found:
            continue
        found.add(target)
        if target.startswith("pipe:"):
            readers = _readers_of_pipes() if readers is None else readers
            waiting += [file for pid in readers.get(target, ()) for file in _written_by(pid)]
    return {target for target in found if target.startswith("/")}


def _ancestors() -> list[str]:
    found, pid = [], str(os.getpid())
    while pid not in ("0", "1"):
        found.append(pid)
        try:
            pid = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()[1]
        except OSError:
            break
    return found


def _target(pid: str, stream: int | str) -> str:
    """Return what a file descriptor of a process refers to; empty if the process has ended or is another user's."""
    try:
        return os.readlink(f"/proc/{pid}/fd/{stream}")  # noqa: PTH115
    except OSError:
        return ""


def _readers_of_pipes() -> dict[str, list[str]]:
    """Return for each pipe the processes whose standard input it is."""
    found: dict[str, list[str]] = {}
    for pid in filter(str.isdigit, os.listdir("/proc")):  # noqa: PTH208
        if (target := _target(pid, 0)).startswith("pipe:"):
            found.setdefault(target, []).append(pid)
    return found


def _written_by(pid: str) -> list[str]:
    """Return the files and pipes that a process only writes."""
    found = []
    with suppress(OSError):
        for stream in os.listdir(f"/proc/{pid}/fd"):  # noqa: PTH208
            with suppress(OSError, ValueError, IndexError):
                text = Path(f"/proc/{pid}/fdinfo/{stream}").read_text(encoding="ascii")
                flags = int(text.partition("flags:")[2].split()[0], 8)
                if flags & os.O_ACCMODE == os.O_WRONLY:
                    found.append(_target(pid, stream))
    return found


_EVENTS = frozenset({"open", "ctypes.dlopen", "subprocess.Popen", "os.exec", "os.posix_spawn", "os.system"})


def _changed_at(path: str) -> float | None:
    try:
        return os.stat(path).st_ctime  # noqa: PTH116 - of hundreds of files
    except (OSError, ValueError):
        return None


def _mapped() -> list[str]:
    with open("/proc/self/maps", "rb") as file:
        lines = file.read().splitlines()
    names = {line.split(maxsplit=5)[5] for line in lines if line.count(b" ") > 5 and b"/" in line}
    return [os.fsdecode(name) for name in sorted(names)]


def _open_now() -> list[str]:
    found = []
    for name in os.listdir("/proc/self/fd"):  # noqa: PTH208
        with suppress(OSError):
            if fcntl.fcntl(int(name), fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
                found.append(os.readlink(f"/proc/self/fd/{name}"))  # noqa: PTH115
    return found
