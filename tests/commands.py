"""Commands in processes that are there already: what `crashhunt` imports is imported once, and every command is a fork.

A command is a process of its own as before: with its own directory, variables, output and exit code, and nothing that
it changes reaches the next. What it does not show is how Python starts; `Shell.process` does.
"""

from __future__ import annotations

import faulthandler
import gc
import importlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
import types
from contextlib import suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NoReturn

from warm import (
    OF_THE_GROUP,
    Clients,
    Process,
    Warm,
    ask,
    at_start,
    connect,
    leave_after,
    path_of,
    pid_of,
    prepare_ours,
    use_huge_pages,
)

if TYPE_CHECKING:
    from collections.abc import Container, Mapping, Sequence

CRASHHUNT = Path(sys.executable).parent / "crashhunt"
# What `run` and `replay` import; the rest of a command's modules is imported by its fork.
IMPORTED = ("cli", "api", "crashes", "executors", "hunts", "plans", "recording", "replays", "report", "snapshots")
# What these import while they run, and whoever writes, reads and packs hunts; and what one command does that is rare.
_WHILE_RUNNING = (
    "crashhunt.agents._protocol", "crashhunt.analysis._minimization_runs", "crashhunt.analysis._whatif_runs",
    "crashhunt.corpus._cases", "crashhunt.corpus._case_runs", "crashhunt.dashboard._server",
    "crashhunt.gym._descriptor", "crashhunt.highway._descriptor", "crashhunt.results._log_reader",
    "crashhunt.samplers._learning", "crashhunt.samplers._space_filling", "crashhunt.simulators._toy_descriptor",
    "crashhunt.suites._gate_runs", "crashhunt.suites._suite_file", "crashhunt.sumo._descriptor",
    "crashhunt.sumo._files", "crashhunt.sumo._scenario_check", "encodings.ascii", "encodings.cp437", "gzip",
    "importlib.readers", "numpy.ma", "numpy.random", "pydantic.dataclasses", "rich._emoji_codes", "rich.progress",
    "rich.status", "tomli_w", "urllib.request",
    "xml.etree.ElementTree", "xml.sax",
)  # fmt: skip
_FOR_COMMAND = {"compare": ("crashhunt.statistics", "scipy.stats")}  # the latter takes 0.8 s
_MESSAGE = 1 << 20
_DUMP_S = 20.0  # for a process to dump its threads and end; it takes milliseconds
_REPOSITORY = Path(__file__).parents[1]


class Commands:
    """The process that all commands of a test session are forked from.

    Args:
        environment: in which it starts.
        name: for other processes to connect to, where there are any.
    """

    def __init__(self, environment: Mapping[str, str], name: str = "") -> None:
        self._at_start = at_start(environment)
        started = self._environment_of_keepers(environment)
        self.warm, kept = Warm.start(started, name and _name_of_keepers(name))
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._control.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _MESSAGE)
        descriptors = [theirs.fileno(), self.warm.control.fileno()]
        with theirs:
            process = subprocess.Popen(
                [sys.executable, __file__, *map(str, descriptors), json.dumps(at_start(started)), name],
                pass_fds=descriptors,
                stdin=subprocess.DEVNULL,
                env=environment,
            )
        self._started = process, kept
        self.pids = process.pid, kept.pid

    @classmethod
    def connect(cls, name: str, environment: Mapping[str, str]) -> Commands | None:
        """Return the commands that another process has started, if they begin as those of this environment do."""
        started = cls._environment_of_keepers(environment)
        control, keepers = connect(name, environment), connect(_name_of_keepers(name), started)
        if control is None or keepers is None:
            for opened in (control, keepers):
                if opened is not None:
                    opened.close()
            return None
        self = cls.__new__(cls)
        self._at_start, self._control, self.warm = at_start(environment), control, Warm(keepers, started)
        self._started, self.pids = (), (pid_of(control), pid_of(keepers))
        return self

    @staticmethod
    def _environment_of_keepers(environment: Mapping[str, str]) -> dict[str, str]:
        from crashhunt.executors import worker_environment

        return {**environment, **worker_environment()}

    def fits(self, environment: Mapping[str, str]) -> bool:
        """Whether a process that is started with these variables begins as the forks do."""
        return at_start(environment) == self._at_start and not any(
            Path(place, f"{name}.py").exists() or Path(place, name).exists()
            for place in path_of(environment)
            if Path(place) != _REPOSITORY  # as scripts/mutate has it; the forks have its crashhunt too
            for name in ("sitecustomize", "usercustomize", "crashhunt")
        )

    def begin(
        self, words: Sequence[str], folder: Path, environment: Mapping[str, str], *, terminal: int | None = None,
        streams: Container[int] = (2,), start_new_session: bool = False, typed: str = "",
    ) -> Begun:  # fmt: skip
        """Begin a command; these of its streams are the terminal, where one is given, and then not returned."""
        request = {
            "words": words, "folder": str(folder), "environment": dict(environment), "apart": start_new_session,
        }  # fmt: skip
        return Begun(self._control, request, terminal, typed, streams)

    def run(
        self,
        words: Sequence[str],
        folder: Path,
        environment: Mapping[str, str],
        timeout_s: float,
        *,
        terminal: int | None = None,
        streams: Container[int] = (2,),
    ) -> tuple[int, str, str]:
        """Run a command to its end; return its exit code, or minus its signal, and what it has printed.

        Raises:
            subprocess.TimeoutExpired: it took too long, and was killed.
        """
        begun = self.begin(words, folder, environment, terminal=terminal, streams=streams)
        try:
            return begun.wait(timeout_s), *begun.communicate()
        except BaseException as error:
            begun.abandon(error)
            raise

    def close(self) -> None:
        """End it, where this process has started it; else it goes on for the others."""
        self._control.close()
        self.warm.control.close()
        for process in self._started:
            try:
                process.wait(60)
            except subprocess.TimeoutExpired:  # a hunt that a test has left has a socket to it
                process.kill()
                process.wait()


def _name_of_keepers(name: str) -> str:
    return f"{name}-keepers"


class Begun(Process):
    """A command that has begun."""

    def __init__(
        self,
        control: socket.socket,
        request: Mapping[str, Any],
        terminal: int | None = None,
        typed: str = "",
        streams: Container[int] = (2,),
    ) -> None:
        self._files = tempfile.TemporaryFile(), tempfile.TemporaryFile()  # noqa: SIM115 - closed when they are read
        self._printed: tuple[str, str] | None = None
        reply, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        out, err = (file.fileno() for file in self._files)
        with theirs, tempfile.TemporaryFile() as file:
            file.write(typed.encode())
            file.seek(0)
            usual = enumerate((file.fileno(), out, err))
            files = [terminal if terminal and number in streams else one for number, one in usual]
            ask(control, request, [theirs.fileno(), *files], reply)
        super().__init__(["crashhunt", *request["words"]], reply)

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        """Wait for its end, and return what it has printed."""
        self.wait(timeout)
        if self._printed is None:
            out, err = map(_text_of, self._files)
            self._printed = out, err
        return self._printed

    def abandon(self, error: BaseException) -> None:
        """Kill it, and add to an error what it has printed, where its threads were, and its state."""
        state = f"state: {state_of(self.pid)}"  # a stopped process does not dump its threads
        self.send_signal(signal.SIGUSR1)  # of which faulthandler dumps the threads, and then it ends
        with suppress(subprocess.TimeoutExpired):
            self.wait(_DUMP_S)
        self.kill()
        error.add_note("\n".join([*self.communicate(), state]))


def state_of(pid: int) -> str:
    """Return the letter for the state of a process, as in `ps`; empty if it is gone."""
    with suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    return ""


def _text_of(file: IO[bytes]) -> str:
    """As `subprocess` has it where it is asked for text."""
    with file:
        file.seek(0)
        return file.read().decode().replace("\r\n", "\n").replace("\r", "\n")


def _serve(clients: Clients) -> None:
    """Fork for whoever asks, and tell how the forks end."""
    global AT_FIRST
    running: dict[int, tuple[int, socket.socket]] = {}  # what the kernel tells the end of a process by
    while clients.has_any:
        ready, _, _ = select.select([*clients.sockets, *running], [], [])
        for ended in running.keys() & set(ready):
            pid, reply = running.pop(ended)
            _, status = os.waitpid(pid, 0)
            os.close(ended)
            with reply, suppress(OSError):  # the process that asked has ended
                reply.send(str(os.waitstatus_to_exitcode(status)).encode())
        for data, (asker, *streams) in clients.receive(ready):
            request = json.loads(data)
            for name in _FOR_COMMAND.get(next(iter(request["words"]), ""), ()):
                importlib.import_module(name)
                AT_FIRST |= sys.modules.keys()
            pid = os.fork()
            if pid == 0:
                clients.close()
                os.close(asker)
                for descriptor, (_, other) in running.items():
                    os.close(descriptor)
                    other.close()
                _be_command(request, *streams)
            for descriptor in streams:
                os.close(descriptor)
            reply = socket.socket(fileno=asker)
            with suppress(OSError):  # the process that asked has ended
                reply.send(str(pid).encode())
            running[os.pidfd_open(pid)] = pid, reply


def _be_command(request: dict, typed: int, out: int, err: int) -> NoReturn:
    """Do what the script `crashhunt` does, and end as a process of Python ends."""
    for descriptor, copy in ((typed, 0), (out, 1), (err, 2)):
        os.dup2(descriptor, copy)
        os.close(descriptor)
    # The streams of this process know whether the file that they had before could seek; a terminal cannot.
    sys.stdout = open(1, "w", buffering=1, encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stderr = open(2, "w", buffering=1, encoding="utf-8", errors="backslashreplace", closefd=False)  # noqa: SIM115
    faulthandler.register(signal.SIGUSR1, 2, chain=True)  # and end, see `abandon`
    if request["apart"]:
        os.setsid()
    os.environ.clear()
    os.environ.update(request["environment"])
    os.chdir(request["folder"])
    sys.path[1:1] = [place for place in map(os.path.abspath, path_of(os.environ)) if place not in sys.path]
    sys.argv = [str(CRASHHUNT), *request["words"]]
    from crashhunt.cli import main

    leave_after(lambda: (signal.pthread_sigmask(signal.SIG_UNBLOCK, OF_THE_GROUP), main()))


class Hunt:
    """The process of a hunt of a suite: a fork of the command, as far as `run_all` uses a `subprocess.Popen`."""

    def __init__(
        self, words: Sequence[str], *, cwd: str | None, stdout: IO[bytes], env: Mapping[str, str] | None, **_: object
    ) -> None:
        sys.stdout.flush()
        sys.stderr.flush()
        self.pid = os.fork()
        self.returncode: int | None = None
        if self.pid == 0:
            os.setsid()
            for number in (signal.SIGTERM, signal.SIGHUP):
                signal.signal(number, signal.SIG_DFL)
            signal.signal(signal.SIGINT, signal.default_int_handler)
            for name in sys.modules.keys() - AT_FIRST:
                if not name.startswith("crashhunt."):
                    del sys.modules[name]  # what the command itself has imported for its user
            if env is not None:
                os.environ.clear()
                os.environ.update(env)
            sys.path[:] = [place for place in map(os.path.abspath, path_of(os.environ)) if place not in PATH] + PATH
            os.chdir(cwd or ".")
            for descriptor in (1, 2):
                os.dup2(stdout.fileno(), descriptor)
            script, folder, run, parent = words[3:]
            sys.argv = [script, folder, run, parent]
            main = importlib.import_module(script)._main
            leave_after(lambda: main(Path(folder), json.loads(run), int(parent)))

    def poll(self) -> int | None:
        """Return how it has ended, if it has."""
        return self._ended(os.WNOHANG)

    def wait(self) -> int | None:
        """Wait for its end."""
        return self._ended(0)

    def send_signal(self, number: int) -> None:
        """Tell it something, if it is there."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        """Kill it, if it is there."""
        self.send_signal(signal.SIGKILL)

    def _ended(self, options: int) -> int | None:
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, options)
            self.returncode = os.waitstatus_to_exitcode(status) if pid else None
        return self.returncode


if __name__ == "__main__":
    signal.pthread_sigmask(signal.SIG_SETMASK, OF_THE_GROUP)  # until a fork is a command
    sys.path[0] = str(CRASHHUNT.parent)  # where the script lies, and not these tests
    import crashhunt.base.processes
    import crashhunt.suites._processes

    for package in IMPORTED:
        module = importlib.import_module(f"crashhunt.{package}")
        for name in getattr(module, "__all__", ()):
            getattr(module, name)  # which imports what it lies in
    for name in _WHILE_RUNNING:
        importlib.import_module(name)
    del sys.modules["warm"]  # else a snapshot would have it, as whatever has been imported and is not installed
    crashhunt.base.reaper.subprocess = Warm(socket.socket(fileno=int(sys.argv[2])), json.loads(sys.argv[3])).subprocess
    crashhunt.suites._processes.subprocess = types.SimpleNamespace(Popen=Hunt, DEVNULL=subprocess.DEVNULL)
    PARSER = crashhunt.cli.make_parser()
    crashhunt.cli.make_parser = lambda: PARSER  # which every command would make again, and is the same in all of them
    AT_FIRST, PATH = frozenset(sys.modules), sys.path[1:]
    crashhunt.snapshots.environment()  # which looks through all that is installed
    prepare_ours()
    gc.collect()
    gc.freeze()
    use_huge_pages()
    _serve(Clients(socket.socket(fileno=int(sys.argv[1])), sys.argv[4]))
