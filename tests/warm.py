"""What a command starts, in processes that are there already: what is installed is imported, and what is as it is here.

A hunt starts a template for its workers, and a process for every confirmation; so does a replay. They are forks of a
process that has imported NumPy, and where a simulator is needed that one. The agents each of them imports as ever, and
crashhunt, whichever the snapshot has; only that a file of it which is the same here need not be compiled, and where
all files are that such a process begins with, what they define is there, as if it had been imported from the snapshot.
Keepers, lifelines, signals and exit codes are real; what this does not show is how Python starts, which every command
that a test starts by `Shell.process` or `Shell.start` does.
"""

from __future__ import annotations

import _imp
import atexit
import ctypes
import dataclasses
import fcntl
import functools
import gc
import hashlib
import importlib
import importlib.util
import json
import marshal
import os
import re
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import types
from contextlib import suppress
from importlib import metadata
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterator, Mapping, Sequence

# What Python and its libraries look at when they start.
_AT_START = ("PYTHON", "LC_", "LANG", "LD_", "COVERAGE", "OMP_", "OPENBLAS_")
_SET_LATER = ("PYTHONPATH", "PYTHONDONTWRITEBYTECODE", "PYTHONPYCACHEPREFIX")
_OF_SIMULATORS = {"gym": "gymnasium", "highway": "crashhunt.highway._fast_import", "sumo": "libsumo"}
_MESSAGE = 1 << 20
_START_S = 300.0  # a server imports for two seconds; on a loaded machine for longer
_FREE = 500  # where a process has no files of its own
_HUGE_PAGE_BYTES = 2 << 20
_MADV_COLLAPSE = 25  # since Linux 6.1; an older kernel refuses it, and nothing is lost
# What interrupts a session, such as `timeout`, sends these to its whole group. A hunt that a test runs takes that as
# a request to stop, and the test goes on: what serves it must not have ended by then.
OF_THE_GROUP = (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT, signal.SIGTERM)


# What Python makes of the files of crashhunt, by the digests of these; as bytes, because each fork copies the tables of
# all pages that code objects would take.
_compiled: dict[bytes, bytes] = {}
_run: dict[str, types.CodeType] = {}  # what dataclasses compile
_read: dict[tuple[str, str], str | None] = {}  # what a file says of something that is installed
_made: dict[str, tuple[types.CodeType, bytes]] = {}  # what a module of crashhunt is made from
# What is there when one of these has been imported: modules, their code, and what their files say.
_imported: dict[str, dict[str, tuple[types.ModuleType, types.CodeType, dict[str, bytes]]]] = {}
# What crashhunt records of each module before a trial, by the address of the module's dictionary.
_contents: dict[int, _Contents] = {}
_BEGIN_WITH = ("crashhunt.executors._fork_server",)
_ALSO_BEGIN_WITH = {"sumo": ("crashhunt.sumo._traffic_survey",)}
# What these import as soon as they have read what is to be done.
_ALL = ("crashhunt.scenario._load", "crashhunt.crashes._last_avoidable_step", "crashhunt.recording._foxglove")
_GO_ON_WITH = {
    "": (*_ALL, "crashhunt.simulators._toy_descriptor", "crashhunt.simulators.toy"),
    "gym": _ALL,
    "highway": _ALL,  # whose accelerator knows the folder that it was imported from
    "sumo": (*_ALL, "crashhunt.sumo._descriptor", "crashhunt.sumo._simulator"),
}


def at_start(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the variables that tell how a process of Python begins."""
    found = {name: value for name, value in environment.items() if name.startswith(_AT_START)}
    return {name: value for name, value in found.items() if name not in _SET_LATER}


def path_of(environment: Mapping[str, str]) -> list[str]:
    """Return the folders of PYTHONPATH."""
    return [place for place in environment.get("PYTHONPATH", "").split(os.pathsep) if place]


def leave_after(call: Callable[[], object]) -> NoReturn:
    """Call something, and end as a process of Python ends."""
    code = 1
    try:
        try:
            call()
            code = 0
        except SystemExit as leaving:
            code = leaving.code if isinstance(leaving.code, int) else 1 if leaving.code else 0
        except BaseException:
            traceback.print_exc()
        threading._shutdown()  # type: ignore[attr-defined]
        atexit._run_exitfuncs()
        for stream in (sys.stdout, sys.stderr):
            with suppress(ValueError):
                stream.flush()
    finally:
        os._exit(code)


def use_huge_pages() -> None:
    """Move the memory of this process into huge pages, before it is forked.

    The kernel copies the tables of all pages in each fork, which was a sixth of its time in hunts of tests. Of a huge
    page it copies one entry; a fork that writes to it still copies 4 KB.
    """
    madvise = ctypes.CDLL(None).madvise
    for mapping in re.split(r"\n(?=[0-9a-f]+-)", Path("/proc/self/smaps").read_text(encoding="utf-8")):
        first, *rest = mapping.splitlines()
        place, rights, _, _, _, *name = first.split()
        size, resident = (int(line.split()[1]) for line in rest if line.startswith(("Size:", "Rss:")))
        if rights == "rw-p" and name in ([], ["[heap]"]) and resident > size // 2:
            begin, end = (int(address, 16) for address in place.split("-"))
            begin += -begin % _HUGE_PAGE_BYTES
            madvise(ctypes.c_void_p(begin), ctypes.c_size_t(max(0, end - begin)), _MADV_COLLAPSE)


class Clients:
    """The sockets that a server is asked by: that of the process that started it, and those that connect to its name.

    Args:
        first: the socket of the process that started it.
        name: of the server, as `connect` finds it; empty if no other process connects.
    """

    def __init__(self, first: socket.socket, name: str = "") -> None:
        self._listening: socket.socket | None = None
        self._controls = [first]
        if name:
            self._listening = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            self._listening.bind(f"\0{name}")
            self._listening.listen()

    @property
    def has_any(self) -> bool:
        """Whether any process can still ask."""
        return bool(self._controls)

    @property
    def sockets(self) -> list[socket.socket]:
        """What to wait for."""
        return [*self._controls, *([self._listening] if self._listening else [])]

    def receive(self, ready: Container[object]) -> Iterator[tuple[bytes, list[int]]]:
        """Yield the requests that have come with their descriptors, and admit and dismiss clients."""
        for control in [*self._controls]:
            if control in ready:
                data, descriptors, _, _ = socket.recv_fds(control, _MESSAGE, 16)
                if data:
                    yield data, descriptors
                else:
                    self._controls.remove(control)
                    control.close()
        if self._listening in ready:
            assert self._listening is not None
            control, _ = self._listening.accept()
            with suppress(OSError):  # the process that connected has ended
                control.send(json.dumps(at_start(os.environ)).encode())
            self._controls.append(control)

    def close(self) -> None:
        """Close all, as a fork must do."""
        for opened in self.sockets:
            opened.close()


def connect(name: str, environment: Mapping[str, str]) -> socket.socket | None:
    """Return a socket to the server of a name, or None if there is none that started with these variables."""
    control = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    control.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _MESSAGE)
    deadline = time.monotonic() + _START_S
    while True:
        try:
            control.connect(f"\0{name}")
            if json.loads(control.recv(_MESSAGE) or b"{}") == at_start(environment):
                return control
        except ConnectionRefusedError:  # it is still importing
            if time.monotonic() < deadline:
                time.sleep(0.05)
                continue
        except OSError:  # it has ended
            pass
        control.close()
        return None


def pid_of(control: socket.socket) -> int:
    """Return the process that listens at the other end."""
    pid: int = struct.unpack("3i", control.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))[0]
    return pid


class Warm:
    """The process of which keepers are forks, and whoever asks for one.

    Args:
        control: a socket to it.
        environment: in which it was started.
    """

    def __init__(self, control: socket.socket, environment: Mapping[str, str]) -> None:
        self.control = control
        self._at_start = at_start(environment)

    @classmethod
    def start(cls, environment: Mapping[str, str], name: str = "") -> tuple[Warm, subprocess.Popen[bytes]]:
        """Start it, for other processes to connect to where it has a name.

        It ends when no process has a socket to it any more.
        """
        control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        control.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _MESSAGE)
        with theirs:
            process = subprocess.Popen(
                [sys.executable, "-P", __file__, str(theirs.fileno()), name], pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, env=environment,
            )  # fmt: skip
        return cls(control, environment), process

    @property
    def subprocess(self) -> types.SimpleNamespace:
        """What `crashhunt.base.processes` uses of the module."""
        return types.SimpleNamespace(Popen=self.popen, TimeoutExpired=subprocess.TimeoutExpired)

    def popen(self, words: Sequence[str], **options: Any) -> Forked | subprocess.Popen[bytes]:
        """Start a keeper as `subprocess.Popen` does, in a fork where that comes to the same."""
        environment, folders = options["env"], path_of(options["env"])
        there = {path.name.partition(".")[0] for folder in folders for path in Path(folder).glob("*")}
        if at_start(environment) != self._at_start or not there.isdisjoint(
            {"sitecustomize", "usercustomize", "numpy", *sys.stdlib_module_names}
        ):
            return subprocess.Popen(words, **options)
        return Forked(self.control, words, **options)


_GONE = "the process that the tests fork has ended"


def ask(control: socket.socket, request: Mapping[str, Any], descriptors: Sequence[int], reply: socket.socket) -> None:
    """Ask for a fork."""
    try:
        socket.send_fds(control, [json.dumps(request).encode()], descriptors)
    except ConnectionError as error:  # which must not look as if crashhunt had lost a process of its own
        reply.close()
        raise RuntimeError(_GONE) from error


class Process:
    """A fork of a process that is there already, as far as somebody uses a `subprocess.Popen`.

    Args:
        words: what it was started with.
        reply: from where its number comes, and then how it has ended.
    """

    def __init__(self, words: Sequence[str], reply: socket.socket) -> None:
        self.returncode: int | None = None
        self._words, self._reply = words, reply
        pid = reply.recv(_MESSAGE)
        if not pid:
            reply.close()
            raise RuntimeError(_GONE)
        self.pid = int(pid)

    def poll(self) -> int | None:
        """Return how it has ended, if it has."""
        with suppress(subprocess.TimeoutExpired):
            self.wait(0)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end, and return its exit code, or minus its signal."""
        if self.returncode is None:
            if not select.select([self._reply], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired([*self._words], timeout or 0)
            self.returncode = int(self._reply.recv(_MESSAGE) or -signal.SIGKILL)
            self._reply.close()
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Tell it something, if it is there."""
        if self.poll() is None:
            with suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def kill(self) -> None:
        """Kill it, if it is there."""
        self.send_signal(signal.SIGKILL)

    def terminate(self) -> None:
        """Ask it to end, if it is there."""
        self.send_signal(signal.SIGTERM)


class Forked(Process):
    """A process that crashhunt starts."""

    def __init__(
        self, control: socket.socket, words: Sequence[str], *, env: Mapping[str, str], pass_fds: Sequence[int],
        start_new_session: bool, **streams: Any,
    ) -> None:  # fmt: skip
        reply, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        numbers = [0, 1, 2, *pass_fds]
        with theirs, open(os.devnull, "r+b") as nothing:
            given = [
                number if (stream := streams[name]) is None
                else nothing.fileno() if stream == subprocess.DEVNULL
                else stream if isinstance(stream, int) else stream.fileno()
                for number, name in enumerate(("stdin", "stdout", "stderr"))
            ]  # fmt: skip
            request = {
                "words": words[2:], "environment": dict(env), "folder": str(Path.cwd()), "numbers": numbers,
                "simulator": _simulator_of(words[-1]), "apart": start_new_session,
            }  # fmt: skip
            ask(control, request, [theirs.fileno(), *given, *pass_fds], reply)
        super().__init__(words, reply)


def _simulator_of(job: str) -> str:
    try:
        said = json.loads(Path(job).read_text(encoding="utf-8"))
        scenario = said.get("settings", said)["scenario"]  # a survey of the traffic has no other settings
        simulator = scenario.get("simulator", "sumo")  # what is as it is without being said is not written
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return ""
    return simulator if simulator in _OF_SIMULATORS else ""


class _Known(SourceFileLoader):
    """Takes what has been compiled of the same text."""

    def get_code(self, fullname: str) -> types.CodeType | None:
        text = self.get_data(self.path)
        compiled = _compiled.get(_digest_of(text))
        if compiled is None:
            return super().get_code(fullname)
        known: types.CodeType = marshal.loads(compiled)
        _imp._fix_co_filename(known, self.path)  # type: ignore[attr-defined] - as importlib does it, in C
        _made[fullname] = known, text
        return known

    @classmethod
    def find_spec(cls, name: str, path: Sequence[str] | None, target: object = None) -> ModuleSpec | None:
        if not _is_ours(name):
            return None
        spec = PathFinder.find_spec(name, path)
        if spec is not None and type(spec.loader) is SourceFileLoader:
            spec.loader = cls(name, spec.loader.path)
        return spec


def _digest_of(text: bytes) -> bytes:
    return hashlib.blake2b(text, digest_size=16).digest()


def _compile() -> None:
    import crashhunt

    for folder in crashhunt.__path__:
        for file in Path(folder).rglob("*.py"):
            code = SourceFileLoader("", str(file)).get_code("")
            if code is not None:
                _compiled[_digest_of(file.read_bytes())] = marshal.dumps(code)


def _import_ours(simulator: str = "") -> None:
    """Import what processes of crashhunt begin with, and put it aside; the second needs all that the first does."""
    for name in filter(_is_ours, [*sys.modules]):
        del sys.modules[name]
    sys.meta_path.insert(0, _Known)
    found: dict[str, tuple[types.ModuleType, types.CodeType, dict[str, bytes]]] = {}
    for begins_with in (*_BEGIN_WITH, *_ALSO_BEGIN_WITH.get(simulator, ())):
        for name in (begins_with, *_GO_ON_WITH[simulator]):
            importlib.import_module(name)
        prepare_ours()
        if begins_with == "crashhunt.executors._fork_server":
            _rehearse()
        for name in filter(_is_ours, [*sys.modules]):
            code, text = _made[name]
            is_package = hasattr(sys.modules[name], "__path__")
            found[name] = sys.modules[name], code, {"/__init__.py" if is_package else ".py": text}
        _imported[begins_with] = {**found}
        del _imported[begins_with][begins_with]  # which knows its process, as no other does
    for name in found:
        del sys.modules[name]
    sys.meta_path.remove(_Known)
    gc.collect()
    gc.freeze()


def prepare_ours() -> None:
    """Have crashhunt find out once what is the same in every process: converters, and what is installed."""
    prepare = importlib.import_module("crashhunt.base.codec").prepare
    prepare(importlib.import_module("crashhunt.trial").TrialResult)
    prepare(importlib.import_module("crashhunt.episode").WorkerSettings)
    importlib.import_module("crashhunt.base.plugins").registered("agents")


def _rehearse() -> None:
    """Rehearse trials once, which fills the caches of all forks: another rehearsal in each of them costs 36 ms."""
    rehearsal = importlib.import_module("crashhunt.executors._preparation")
    with tempfile.TemporaryDirectory() as folder:
        rehearsal.rehearse_trial(Path(folder), lambda _: None)
    rehearsal._rehearse = lambda _: None  # where the code of a snapshot is the same, see `_put_back`


class _Contents:
    """What `crashhunt.episode` has recorded of a module, for forks in which the module is still the same.

    A fork that looks at every function of every module writes to the counter of references of each, and the kernel
    copies thousands of pages: a tenth of what a replay costs.

    Args:
        module: the module.
        found: what crashhunt recorded.
    """

    def __init__(self, module: types.ModuleType, found: tuple[dict[str, object], dict[type, object]]) -> None:
        self.found = found
        self.own = id(vars(module))
        addresses = [self.own, *(id(gc.get_referents(vars(kind))[0]) for kind in found[1])]
        self.versions = {address: _version_of(address) for address in addresses}

    @property
    def is_same(self) -> bool:
        """Whether neither the module nor one of its classes has got another attribute since."""
        return all(_version_of(address) == version for address, version in self.versions.items())


def _version_of(address: int) -> int:
    """The version of a dictionary, which Python changes with every change of what it has."""
    return ctypes.c_uint64.from_address(address + 24).value


def _has_versions() -> bool:
    example = {"a": 1}
    found = [_version_of(id(example))]
    for change in (lambda: example.get("a"), lambda: example.update(a=2), lambda: example.pop("a")):
        change()
        found.append(_version_of(id(example)))
    return found[0] == found[1] and len(set(found)) == 3 and example == {}


def _remember_contents() -> None:
    """Have crashhunt record what is the same in every fork once."""
    if sys.implementation.name != "cpython" or not _has_versions():
        return
    _contents.clear()
    for kept in _imported.values():
        failures, *_ = kept["crashhunt.episode._failures"]
        record = failures._contents_of
        ours = {name: module for name, (module, *_) in kept.items()}
        for name, module in {**sys.modules, **ours}.items():
            if type(module) is types.ModuleType:
                _contents[id(vars(module))] = _Contents(module, record(name, module))
        failures._contents_of = functools.partial(_contents_of, record)
    gc.collect()
    gc.freeze()


def _contents_of(record: Callable[..., Any], name: str, module: types.ModuleType) -> Any:
    known = _contents.get(id(vars(module)))
    return known.found if known is not None and known.is_same else record(name, module)


def _is_ours(name: str) -> bool:
    return name.partition(".")[0] == "crashhunt"


def _serve(clients: Clients, simulator: str = "") -> None:
    """Fork for whoever asks, and tell how the forks end; one for each simulator does the same, with that imported."""
    use_huge_pages()
    running: dict[int, tuple[int, socket.socket]] = {}  # what the kernel tells the end of a process by
    others: dict[str, socket.socket] = {}
    while clients.has_any:
        ready, _, _ = select.select([*clients.sockets, *running], [], [])
        for ended in running.keys() & set(ready):
            pid, reply = running.pop(ended)
            _, status = os.waitpid(pid, 0)
            os.close(ended)
            with reply, suppress(OSError):
                reply.send(str(os.waitstatus_to_exitcode(status)).encode())
        for data, descriptors in clients.receive(ready):
            request = json.loads(data)
            if request["simulator"] != simulator:
                if request["simulator"] not in others:
                    others[request["simulator"]] = _with_simulator(request["simulator"])
                socket.send_fds(others[request["simulator"]], [data], descriptors)
            else:
                pid = os.fork()
                if pid == 0:
                    _be_keeper(request, descriptors[1:])
                reply = socket.socket(fileno=os.dup(descriptors[0]))
                with suppress(OSError):  # the process that asked was killed meanwhile; the keeper sees it too
                    reply.send(str(pid).encode())
                running[os.pidfd_open(pid)] = pid, reply
            for descriptor in descriptors:
                os.close(descriptor)


def _with_simulator(simulator: str) -> socket.socket:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _MESSAGE)
    with theirs:
        if os.fork() == 0:
            os.closerange(3, theirs.fileno())
            os.closerange(theirs.fileno() + 1, _FREE)
            leave_after(
                lambda: (
                    _import(_OF_SIMULATORS[simulator]),
                    _import_ours(simulator),
                    _remember_contents(),
                    _serve(Clients(theirs), simulator),
                )
            )
    return ours


def _import(*names: str) -> None:
    for name in names:
        importlib.import_module(name)
    if "crashhunt.base.plugins" in sys.modules:
        sys.modules["crashhunt.base.plugins"].registered("agents")
    for name in filter(_is_ours, [*sys.modules]):
        del sys.modules[name]
    gc.collect()
    gc.freeze()


def _remember() -> None:
    """Have done once what is the same in every fork: what dataclasses compile, what is read of what is installed."""
    read = metadata.PathDistribution.read_text

    def read_once(self: metadata.PathDistribution, filename: str) -> str | None:
        key = str(self._path), filename  # type: ignore[attr-defined]
        if key not in _read:
            _read[key] = read(self, filename)
        return _read[key]

    def run(text: str, *namespaces: dict[str, object]) -> None:
        if text not in _run:
            _run[text] = compile(text, "<string>", "exec")
        exec(_run[text], *namespaces)

    metadata.PathDistribution.read_text = read_once  # type: ignore[method-assign]
    vars(dataclasses)["exec"] = run


def _be_keeper(request: dict[str, Any], descriptors: Sequence[int]) -> NoReturn:
    """Begin as Python does with ``-P`` and a script."""
    kept = [fcntl.fcntl(descriptor, fcntl.F_DUPFD_CLOEXEC, _FREE) for descriptor in descriptors]
    os.closerange(3, _FREE)
    for descriptor, number in zip(kept, request["numbers"], strict=True):
        os.dup2(descriptor, number)
        os.close(descriptor)
    if request["apart"]:
        os.setsid()
    os.environ.clear()
    os.environ.update(request["environment"])
    os.chdir(request["folder"])
    sys.dont_write_bytecode = bool(os.environ.get("PYTHONDONTWRITEBYTECODE"))
    sys.pycache_prefix = os.environ.get("PYTHONPYCACHEPREFIX") or None
    sys.path[:0] = map(os.path.abspath, path_of(os.environ))
    script, *_ = sys.argv = request["words"]
    if "numpy" in sys.modules:
        sys.modules["numpy"].random.seed()
    sys.meta_path.insert(0, _Known)
    if len(request["words"]) > 2:
        _put_back(request["words"][2])
    spec = importlib.util.spec_from_file_location("__main__", script)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules["__main__"] = importlib.util.module_from_spec(spec)
    loader = spec.loader
    leave_after(lambda: loader.exec_module(module))


def _put_back(begins_with: str) -> None:
    """Have what a module imports, if what there is to import is the same, as if it had been imported from there."""
    spec = PathFinder.find_spec("crashhunt")
    if spec is None or spec.origin is None:
        return
    found = _imported.get(begins_with, {})
    folder = Path(spec.origin).parent.parent
    stems = {name: f"{folder}/{name.replace('.', '/')}" for name in found}
    try:
        for name, (_, _, files) in found.items():
            for end, text in files.items():
                with open(stems[name] + end, "rb", buffering=0) as file:
                    if file.read() != text:
                        return
    except OSError:
        return
    for name, (module, code, files) in found.items():
        file, *_ = (stems[name] + end for end in files)
        _imp._fix_co_filename(code, file)  # type: ignore[attr-defined]
        contents = _contents.get(id(vars(module)))
        is_same = contents is not None and contents.is_same
        module.__loader__ = loader = _Known(name, file)
        module.__spec__ = spec = importlib.util.spec_from_file_location(name, file, loader=loader)
        module.__file__ = file
        if hasattr(module, "__path__"):
            module.__path__ = spec.submodule_search_locations
        if contents is not None and is_same:  # none of these is a function
            contents.versions[contents.own] = _version_of(contents.own)
        sys.modules[name] = module


if __name__ == "__main__":
    # A keeper begins with these blocked, here as elsewhere, and admits them itself.
    signal.pthread_sigmask(signal.SIG_SETMASK, OF_THE_GROUP)
    _remember()
    _compile()
    _import_ours()
    _import(
        "crashhunt.executors._fork_server",
        "crashhunt.simulators.toy",
        "crashhunt.recording._log",
        "gymnasium",
        "numpy.ma",
        "tomli_w",
        "tomllib",
        "xml.etree.ElementTree",
        "xml.sax",
    )
    _remember_contents()
    _serve(Clients(socket.socket(fileno=int(sys.argv[1])), sys.argv[2]))
