"""What all tests share: the command line, run as a user runs it."""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import functools
import gc
import json
import os
import secrets
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
import warnings
from dataclasses import dataclass
from importlib.machinery import SourceFileLoader
from importlib.metadata import distribution
from itertools import islice
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import TYPE_CHECKING, Any

import as_installed  # noqa: F401 - before anything imports crashhunt

os.environ["HYPOTHESIS_NO_PLUGINS"] = "1"  # one is Trio's, which takes a tenth of a second

# isort: split

import hypothesis
import json_schemas
import pytest
from commands import CRASHHUNT, Begun, Commands
from threadpoolctl import ThreadpoolController

from crashhunt.base import reaper
from crashhunt.native import HOW_TO_REBUILD, _core, outdated_modules
from crashhunt.snapshots import _take
from crashhunt.snapshots._snapshot import write_manifest

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterable, Iterator

pytest_plugins = ["browsers", "made_up_trials"]

# Every worker, and every process that a test starts, would compile the same files again: seconds each. What is imported
# from now on is kept, as it is for users.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# Tests have small matrices, for which threads of linear algebra only wait for each other: on a loaded machine, models
# of samplers took thirty times as long. NumPy is imported already; what is loaded from now on reads the variable.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ThreadpoolController().limit(limits=1, user_api="blas")


def _write_to_memory() -> None:
    """Have the files of tests in memory, where there is room: ledgers, bundles and snapshots are synced to disk."""
    place = "/dev/shm"
    try:
        found = os.statvfs(place)
    except OSError:
        return
    fits = found.f_bavail * found.f_frsize > _ROOM and os.access(place, os.W_OK)
    if "TMPDIR" not in os.environ and fits and not found.f_flag & os.ST_NOEXEC:  # some tests run what they write
        _remove_older(Path(place))
        os.environ["TMPDIR"] = folder = tempfile.mkdtemp(prefix=f"{_SESSION}{os.getpid()}-", dir=place)
        tempfile.tempdir = None
        atexit.register(_tidy, Path(folder), os.getpid())


def _remove_older(place: Path) -> None:
    """Remove what killed and failed sessions have left, but for the three newest, as pytest does with its folders."""
    with contextlib.suppress(OSError):  # another session has removed one meanwhile
        for folder in sorted(place.glob(f"{_SESSION}*"), key=os.path.getmtime)[:-3]:
            if not Path("/proc", folder.name.split("-")[2]).exists():
                shutil.rmtree(folder, ignore_errors=True)


def _tidy(folder: Path, pid: int) -> None:
    """Remove what hunts that were killed have left, and all of it where every test has passed."""
    if os.getpid() != pid:
        return
    kept = [*folder.glob("pytest-of-*/pytest-[0-9]*")]
    for path in folder.iterdir() if kept else [folder]:
        if not path.name.startswith("pytest-of-"):
            shutil.rmtree(path, ignore_errors=True)


_ROOM = 4 << 30  # bytes; a session needs a tenth of it
_SESSION = f"tests-{os.getuid()}-"  # and the process of the session: the beginning of its folder's name
_write_to_memory()

# In the background of a shell, or under nohup, these are ignored, and so they would be by what tests start and stop.
for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, lambda *_: None)):
    if signal.getsignal(number) is signal.SIG_IGN and threading.current_thread() is threading.main_thread():
        signal.signal(number, handler)


# A loaded machine takes longer than Hypothesis' 200 ms now and then, and nothing is wrong.
# The examples are others at every run, so that many runs see what few examples do not; but what CI says of a change is
# about that change, and must not depend on luck.
def examples(count: int) -> int:
    """Return how many examples a property is tried with: so many at night, and two of five of them by day."""
    return count if os.environ.get("CRASHHUNT_TEST_EXAMPLES") == "all" else count * 2 // 5


hypothesis.settings.register_profile(
    "crashhunt",
    max_examples=examples(50),
    deadline=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
    derandomize=bool(os.environ.get("CI")),
)
hypothesis.settings.load_profile("crashhunt")

_TIMEOUT_S = 400.0
_left_to_the_night: list[bool] = []  # whether this session has the usual tests only
_OF_ALL_WORKERS = "CRASHHUNT_TEST_COMMANDS"
_SHARED = os.environ.pop(_OF_ALL_WORKERS, "")  # which commands of tests must not see
collect_ignore = ["e2e/frozen"]  # in which a case of a corpus is a test to whoever has crashhunt's plugin
_REPOSITORY = f"{Path(__file__).parents[1]}{os.sep}"
FAULTY = Path(__file__).parent / "e2e" / "faulty.py"


@dataclass(frozen=True)
class Done:
    """A command that has ended."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> dict[str, Any]:
        """Standard output, which must be exactly one JSON object."""
        found: dict[str, Any] = json.loads(self.out)
        return found


class Shell:
    """A folder to work in, and the commands run there."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.environment = _usual_environment()
        self._begun: list[Begun | subprocess.Popen[str]] = []

    @property
    def unmeasured(self) -> dict[str, str]:
        """The environment without what measures coverage, where that would be in the way of what is tested."""
        return {name: value for name, value in self.environment.items() if not name.startswith("COVERAGE")}

    def crashhunt(
        self, *words: str, expect: int | None = 0, terminal: int | None = None, streams: Container[int] = (2,)
    ) -> Done:
        """Run a command to its end: in a fork of a process that has imported what it needs, where that is the same.

        Standard error goes to the terminal, where one is given by its descriptor; ``streams`` names others instead.
        """
        commands = _commands()
        if not commands.fits(self.environment):
            assert terminal is None, "cannot be a fork"
            return self.process(*words, expect=expect)
        ended = commands.run(words, self.folder, self.environment, _TIMEOUT_S, terminal=terminal, streams=streams)
        done = Done(*ended)
        return _ended(words, done, expect)

    def process(self, *words: str, expect: int | None = 0) -> Done:
        """Run a command to its end as a shell does it, for tests of how it starts and ends."""
        done = subprocess.run(
            [str(CRASHHUNT), *words], cwd=self.folder, env=self.environment, capture_output=True, text=True,
            timeout=_TIMEOUT_S, check=False,
        )  # fmt: skip
        return _ended(words, Done(done.returncode, done.stdout, done.stderr), expect)

    def begin(self, *words: str, start_new_session: bool = False, typed: str = "") -> Begun | subprocess.Popen[str]:
        """Begin a command, in a fork where that is the same; the caller ends it."""
        if not typed and not _commands().fits(self.environment):
            return self.start(*words, start_new_session=start_new_session)
        begun = _commands().begin(
            words, self.folder, self.environment, start_new_session=start_new_session, typed=typed
        )
        self._begun.append(begun)
        return begun

    def start(self, *words: str, **options: Any) -> subprocess.Popen[str]:
        """Start a command as a shell does it, with nobody between it and its keepers; the caller ends it."""
        begun = subprocess.Popen(
            [str(CRASHHUNT), *words],
            cwd=self.folder,
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            **options,
        )
        self._begun.append(begun)
        return begun

    def end(self) -> None:
        """Kill what has begun and not ended: of a test that failed before it did so itself."""
        for begun in self._begun:
            begun.kill()


def _ended(words: tuple[str, ...], done: Done, expect: int | None) -> Done:
    if expect is not None:
        assert done.code == expect, f"{words}: {done.code}\n{done.out}\n{done.err}"
    assert "Traceback" not in done.err, done.err
    json_schemas.check_output(words, done.out)
    return done


def _usual_environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if not name.startswith("PYTEST")}


_starting_commands = threading.Lock()  # two pools of one test may start their first process at the same time


def _commands() -> Commands:
    with _starting_commands:
        return _the_commands()


@functools.cache
def _the_commands() -> Commands:
    environment = _usual_environment()
    return (_SHARED and Commands.connect(_SHARED, environment)) or Commands(environment)


@pytest.hookimpl(trylast=True)
def pytest_configure(config: pytest.Config) -> None:
    """Do once, before several workers of pytest-xdist start, what each of them would do: compile, start servers.

    Compiling the tests of a fresh clone takes 7 s of a processor, most of it for what pytest adds to assertions, the
    constants that Hypothesis reads from crashhunt 2 s, and the servers that commands are forked from 3 s.
    """
    _left_to_the_night.append(config.getoption("markexpr") == "not nightly")
    if "PYTEST_XDIST_WORKER" in os.environ:
        return
    if others := outdated_entry_points(Path(_REPOSITORY, "pyproject.toml")):
        what = f"crashhunt was installed before pyproject.toml changed its entry points: {', '.join(others)}"
        pytest.exit(f"{what}. Fix: scripts/test, or pip install --no-deps --editable .", pytest.ExitCode.USAGE_ERROR)
    if not config.getoption("tx", None):
        return
    if config.args_source is pytest.Config.ArgsSource.TESTPATHS:
        compile_once(config, Path(__file__).parent, max(1, os.cpu_count() or 1))
    name = f"crashhunt-tests-{os.getpid()}-{secrets.token_hex(4)}"
    servers = Commands(_usual_environment(), name)
    os.environ[_OF_ALL_WORKERS] = name
    config.add_cleanup(servers.close)


def outdated_entry_points(pyproject: Path) -> list[str]:
    """Return the names of commands and plugins that were installed otherwise than `pyproject.toml` has them now.

    scripts/test installs again when `pyproject.toml` changes, but ``pytest`` alone does not. Without this check, many
    tests of hunts fail, and none names the reason.
    """
    project = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]
    groups = {"console_scripts": project["scripts"], **project["entry-points"]}
    wanted = {(group, name, value) for group, named in groups.items() for name, value in named.items()}
    installed = {(one.group, one.name, one.value) for one in distribution("crashhunt").entry_points}
    return sorted({name for _, name, _ in wanted ^ installed})


def compile_once(config: pytest.Config, tests: Path, processes: int) -> None:
    """Compile the modules of crashhunt and of a folder of tests that are not compiled yet, in several processes."""
    try:
        from _pytest.assertion.rewrite import PYC_TAIL, _rewrite_test, _write_pyc, assertstate_key, get_cache_dir
    except ImportError:  # of another version of pytest, where each worker compiles for itself
        return

    def compile_test(file: Path) -> None:
        compiled = get_cache_dir(file) / f"{file.stem}{PYC_TAIL}"
        if not compiled.exists():
            compiled.parent.mkdir(parents=True, exist_ok=True)
            source, code = _rewrite_test(file, config)
            _write_pyc(config.stash[assertstate_key], code, source, compiled)

    def compile_module(file: Path) -> None:
        SourceFileLoader("", str(file)).get_code("")  # which keeps it
        keep_constants(file)

    work = [(compile_test, file) for file in sorted(tests.rglob("test_*.py"))]
    work += [(compile_module, file) for file in sorted(Path(_core.__file__).parents[1].rglob("*.py"))]
    started = []
    for number in range(processes):
        pid = os.fork()
        if pid == 0:
            warnings.simplefilter("ignore")  # Hypothesis warns of what takes long before tests are collected
            with contextlib.suppress(Exception):  # the worker that imports the module reports what is wrong with it
                for compile_file, file in work[number::processes]:
                    compile_file(file)
            os._exit(0)
        started.append(pid)
    for pid in started:
        os.waitpid(pid, 0)


def keep_constants(file: Path) -> None:
    """Have Hypothesis write down which constants a module has, for its examples; each worker reads all modules else."""
    try:
        from hypothesis.internal.constants_ast import constants_from_module
    except ImportError:  # of another version, where each worker reads for itself
        return
    module = ModuleType(file.stem)
    module.__file__ = str(file)
    constants_from_module(module)


# Thousands of tests and their modules live to the end: the garbage collector need not walk them each time, neither
# while they are collected, which takes a quarter of that time, nor later.
gc.disable()


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session: pytest.Session) -> None:  # which pytest-xdist's own process has as well
    """From here on, there is garbage."""
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def _commands_end() -> Iterator[None]:
    yield
    if _the_commands.cache_info().currsize:
        _the_commands().close()
        _the_commands.cache_clear()


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with what takes longest, in every worker of pytest-xdist: else one of them is alone with it in the end.

    All tests in a browser go to the first worker, since a browser takes seconds to start.
    """
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    groups: dict[str, list[pytest.Item]] = {"browser": [], "long": [], "": []}
    for item in items:
        groups[_group(item)].append(item)
    browser, long, others = groups.values()
    each = len(items) // workers  # which is how they are handed out at first
    items[:] = browser
    for worker in range(workers):
        items += long[worker::workers]
        rest = each * (worker + 1) - len(items) if worker + 1 < workers else len(others)
        items += others[: max(rest, 0)]
        del others[: max(rest, 0)]


def _group(item: pytest.Item) -> str:
    if "chromium" in getattr(item, "fixturenames", ()):
        return "browser"
    return "long" if item.get_closest_marker("long") else ""


_OUTDATED = functools.cache(outdated_modules)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Compiled modules that were built from other sources than those that are tested are told in one line."""
    if item.path.parent.name in ("native", "simulators") and _OUTDATED():
        what = f"compiled from other sources than those tested: {', '.join(_OUTDATED())}"
        pytest.fail(f"{what}. Fix: {HOW_TO_REBUILD}", pytrace=False)


def wait_for(
    condition: Callable[[], Any],
    *,
    timeout_s: float = 300.0,
    every_s: float = 0.02,
    process: Begun | subprocess.Popen[str] | None = None,
) -> Any:
    """Wait until a condition holds, and return its value. A process that is given must not end before."""
    deadline = time.monotonic() + timeout_s
    while not (found := condition()):
        assert process is None or process.poll() is None, process.communicate()
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(every_s)
    return found


@pytest.fixture
def plain_highway_env() -> Iterator[None]:
    """highway-env without the accelerator and with its own classes, before a test and after it, whatever it does."""
    from crashhunt.highway import restore_classes
    from crashhunt.highway.accelerator import switch_off

    switch_off()
    restore_classes()
    yield
    switch_off()
    restore_classes()


@pytest.fixture(autouse=True)
def _apart(request: pytest.FixtureRequest) -> Iterator[None]:
    """Keep a test apart from the others; one fixture, because thousands of tests have it.

    What a test has imported from its own folder is no other test's, nor found by others. Test modules, and with them
    the whole repository, are not in the snapshots of hunts in this process. What a test itself hunts and replays starts
    as little as what its commands do.
    """
    modules, last, path = len(sys.modules), next(reversed(sys.modules)), [*sys.path]
    not_installed, started = _take._not_installed, reaper.subprocess
    _take._not_installed = _not_installed_nor_ours
    if request.path.parent.name != "base":
        reaper.subprocess = _WARM_SUBPROCESS  # type: ignore[assignment]
    yield
    _take._not_installed, reaper.subprocess = not_installed, started
    sys.path[:] = path
    for name in _imported_since(modules, last):
        if (getattr(sys.modules[name], "__file__", None) or "").startswith(tempfile.gettempdir() + os.sep):
            del sys.modules[name]


def _imported_since(modules: int, last: str) -> list[str]:
    """Return what may have been imported since there were so many modules, of which this was the last.

    There are thousands of modules, and comparing them all would take half of the time of a simple test.
    """
    names, more = reversed(sys.modules), len(sys.modules) - modules
    new = [*islice(names, max(more, 0))]
    return new if more >= 0 and next(names) == last else [*sys.modules]


_not_installed = _take._not_installed
_WARM_SUBPROCESS = SimpleNamespace(
    Popen=lambda *words, **options: _commands().warm.popen(*words, **options),
    TimeoutExpired=subprocess.TimeoutExpired,
)


def _not_installed_nor_ours(places: Any) -> set[str]:
    return {name for name in _not_installed(places) if not _is_ours(name)}


def _is_ours(name: str) -> bool:
    return (getattr(sys.modules.get(name), "__file__", None) or "").startswith(_REPOSITORY)


def mostly_nightly(cases: Iterable[Any], always: Container[Any]) -> list[Any]:
    """Cases of one contract, of which some run always, and the others where `nightly` tests are asked for.

    By day the others are no items at all: each worker would make a thousand of them, and leave them out.
    """
    listed = [*cases]
    daily = [case for case in listed if case in always]
    if daily and any(_left_to_the_night):
        return daily
    return [
        case if case in always
        else pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.nightly)
        for case in listed
    ]  # fmt: skip


def one_in(number: int, cases: Iterable[Any]) -> list[Any]:
    """Cases of one contract, of which one in so many runs always, and the others at night."""
    listed = [*cases]
    return mostly_nightly(listed, listed[::number])


@pytest.fixture
def shell(tmp_path: Path) -> Iterator[Shell]:
    """An empty folder with a module `faulty` of agents that go wrong."""
    shutil.copy(FAULTY, tmp_path / "faulty.py")
    shell = Shell(tmp_path)
    yield shell
    shell.end()


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Callable[[Shell], object], Shell], Shell]:
    """Fills a folder with what a function makes in one; it is called once, everybody gets a copy.

    Once a session, and not once a worker of pytest-xdist: the others wait for the one that has begun.
    """
    base = tmp_path_factory.getbasetemp()
    shared = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "made"
    shared.mkdir(exist_ok=True)

    def fill(make: Callable[[Shell], object], shell: Shell) -> Shell:
        folder = shared / f"{make.__module__}.{make.__qualname__}"
        with folder.with_name(f"{folder.name}.lock").open("a+") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            lock.seek(0)
            if not lock.read():
                shutil.rmtree(folder, ignore_errors=True)  # of somebody who failed
                shutil.copytree(shell.folder, folder)
                make(Shell(folder))
                lock.write("made")
        copy_files(folder, shell.folder)
        return shell

    return fill


def copy_files(folder: Path | str, target: Path | str) -> None:
    """Copy what is in a folder, as `shutil.copytree` does, in a third of its time: a snapshot has hundreds of files."""
    os.makedirs(target, exist_ok=True)  # noqa: PTH103
    with os.scandir(folder) as entries:
        for entry in entries:
            copy = f"{target}/{entry.name}"
            if entry.is_symlink() or not (entry.is_dir() or entry.is_file()):
                shutil.copy2(entry.path, copy, follow_symlinks=False)
            elif entry.is_dir():
                copy_files(entry.path, copy)
            else:
                _copy_file(entry.path, copy)
    shutil.copystat(folder, target)


def _copy_file(path: str, copy: str) -> None:
    source = os.open(path, os.O_RDONLY)
    try:
        status = os.fstat(source)
        target = os.open(copy, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        try:
            sent = 0
            while sent < status.st_size:
                sent += os.sendfile(target, source, sent, status.st_size - sent)
            os.fchmod(target, stat.S_IMODE(status.st_mode))
            os.utime(target, ns=(status.st_atime_ns, status.st_mtime_ns))
        finally:
            os.close(target)
    finally:
        os.close(source)


def rewritten(snapshot: Path, name: str, text: str) -> None:
    """Write a file that describes a snapshot as if it had been written so, digests, proof and all."""
    (snapshot / name).write_text(text)
    manifest = json.loads((snapshot / "manifest.json").read_text())
    (snapshot / "manifest.json").unlink()  # a manifest describes the files beside it
    del manifest["integrity"]
    write_manifest(snapshot, manifest)


TOY = """
title = "A toy"
schema = 1
simulator = "toy"
[arguments.gap_m]
default = 30.0
range = "10:60"
[arguments.step_wall_s]
default = 0.0
[arguments.fail_reset]
default = false
[agents.ego]
agent = "crashhunt.agents:KeepLaneWithSpeed"
[agents.ego.arguments.speed]
default = 8.0
range = "4:14"
"""


def add_toy(shell: Shell) -> Shell:
    """Write the scenario `toy` into a folder; it takes microseconds a step, and above 10 m/s it soon crashes."""
    (shell.folder / "toy").mkdir()
    (shell.folder / "toy" / "scenario.toml").write_text(TOY, encoding="utf-8")
    return shell


@pytest.fixture
def toy(shell: Shell) -> Shell:
    """The same with the scenario `toy`."""
    return add_toy(shell)


def keeps_going(toy: Shell) -> None:
    """Hunt 12 trials of it, of which some crash, in ``h``; for `made_once`."""
    toy.crashhunt("run", "h", "2", "12", "99", "--scenario", "toy", "--seed", "5", "--keep-going", "--no-snapshot")


def crashes_on_loop(shell: Shell) -> None:
    """Hunt 5 trials on the scenario `loop`, too fast, in ``runs/one``: 3 crashes and a near miss; for `made_once`."""
    words = ("--arg", "speed=18:25", "--seed", "1", "--keep-going", "--near-misses", "1", "--no-snapshot")
    (shell.folder / "runs").mkdir()
    shell.crashhunt("run", "runs/one", "2", "5", "300", *words)


@pytest.fixture
def sumo_runs(tmp_path):
    """Writes scenarios of SUMO and runs them; the simulators are closed when the test ends."""
    from sumo_runs import SumoRuns

    with SumoRuns(tmp_path) as made:
        yield made


@pytest.fixture
def agents_may_command_sumo(monkeypatch):
    """Lets agents of a test command SUMO, which brings about in a few steps what rarely happens by itself."""
    from crashhunt.sumo import _agent_calls  # imports libsumo, which other tests do not need

    monkeypatch.setattr(_agent_calls, "_CALLERS_OF_AGENTS", {})
