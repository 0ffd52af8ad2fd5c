"""Episodes in their own process: libsumo has one simulation per process.

The process of an environment can be forked between two steps (`RemoteEpisodes.branch`). After SUMO's `loadState`, a run
differs from the original run. A fork continues exactly, because it has all of SUMO's memory. The fork has its own
connection, so that the user's program can step it like the original. The user's program itself is never forked, because
it may have threads, which a fork does not have.

Invariant: a process ends when its connection is closed, and when the user's program ends.
"""

from __future__ import annotations

import os
import pickle
import select
import signal
import subprocess
import sys
import threading
import weakref
from contextlib import suppress
from multiprocessing.connection import Connection, Pipe
from multiprocessing.reduction import recv_handle, send_handle
from typing import TYPE_CHECKING, Any, TypeAlias

from crashhunt.base.errors import SimulatorError
from crashhunt.base.forks import CannotForkError, fork, held
from crashhunt.base.plugins import load_object
from crashhunt.base.processes import outlive_parent
from crashhunt.executors import worker_environment

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import numpy as np
    from gymnasium import Space
    from numpy.typing import NDArray

    from crashhunt.envs._env_episodes import Episodes
    from crashhunt.trial import Value

Ours: TypeAlias = "Connection[Any, Any]"
"""A pipe between the two processes, which carries the arguments and results of the methods of `Episodes`."""

_LOOK_EVERY_S = 1.0  # time between two checks whether the parent process still exists
_GOOD_BYE_S = 5.0  # time for SUMO to close before the process is killed


class RemoteEpisodes:
    """`Episodes` in a child process, which ends with this object and with this process.

    Exceptions of the child process are raised here.

    Args:
        words: The arguments of `Episodes`, or of the class that a subclass uses; they can be pickled.
    """

    served = "crashhunt.envs._env_episodes:Episodes"
    """The class whose methods the child process calls."""

    def __init__(self, *words: object) -> None:
        here, there = Pipe()
        # Not a child of multiprocessing: the daemonic workers of an AsyncVectorEnv may not have one.
        self._process: subprocess.Popen[bytes] | _Fork = subprocess.Popen(
            [sys.executable, "-P", "-m", "crashhunt.envs._process", str(there.fileno()), str(os.getpid())],
            pass_fds=(there.fileno(),),
            stdin=subprocess.DEVNULL,
            env={**os.environ, **worker_environment(), "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            start_new_session=True,  # Ctrl-C must reach the user's program only
        )
        there.close()
        self._connect(here)
        self._name, self.pid = "the environment", self._process.pid
        self._end = weakref.finalize(self, _end, self._process, here, os.getpid())
        found = self._ask("made", self.served, *words)
        self.observation_space: Space[object] = found["observation_space"]
        self.action_space: Space[object] = found["action_space"]
        self.step_length_s: float = found["step_length_s"]
        self.agent: str = found["agent"]

    def reset(self, seed: int, arguments: Mapping[str, Value]) -> tuple[NDArray[np.generic], dict[str, object]]:
        """Begin an episode."""
        found: tuple[NDArray[np.generic], dict[str, object]] = self._ask("reset", seed, dict(arguments))
        return found

    def step(self, action: object) -> tuple[NDArray[np.generic], float, bool, dict[str, object]]:
        """Advance the episode by one control step."""
        found: tuple[NDArray[np.generic], float, bool, dict[str, object]] = self._ask("step", action)
        return found

    def branch(self, seeds: Sequence[int | None]) -> list[RemoteEpisodes]:
        """Return copies of the running episode, each in a fork of its process.

        Args:
            seeds: seed for SUMO's random generators in each copy, with effect from the next step on; None to keep their
                state.

        Raises:
            SimulatorError: no episode is running, or the process cannot be forked.
            UsageError: the random generators cannot be re-seeded.
        """
        copies: list[RemoteEpisodes] = []
        try:
            for number, seed in enumerate(seeds, 1):
                copies.append(self._branch(f"copy {number} of {len(seeds)} of {self._name}", seed))
        except BaseException:
            for copy in copies:
                copy.close()
            raise
        return copies

    def _branch(self, name: str, seed: int | None) -> RemoteEpisodes:
        here, there = Pipe()
        with there:
            try:
                pid, problem = self._ask("branch", seed, os.getpid(), passes=there.fileno())
                if problem:
                    raise SimulatorError(f"{self._name} cannot be copied: {problem}", fix="make a new environment")
            except BaseException:
                here.close()
                raise
        copy: RemoteEpisodes = object.__new__(RemoteEpisodes)
        copy.__dict__.update(self.__dict__)
        copy._process = _Fork(pid)
        copy._connect(here)
        copy._name, copy.pid = f"{name} (process {pid})", pid
        copy._end = weakref.finalize(copy, _end, copy._process, here, os.getpid())
        copy._ask("agent_name")  # it has begun to serve
        return copy

    def picture(self) -> NDArray[np.generic]:
        """Return the scene from above."""
        found: NDArray[np.generic] = self._ask("picture")
        return found

    @property
    def is_closed(self) -> bool:
        """Whether the process has ended, so that no further episodes are possible."""
        return self._pipe.closed

    def close(self) -> None:
        """End the process."""
        self._end()

    def _connect(self, pipe: Ours) -> None:
        self._pipe = pipe
        self._why_closed = "the environment has been closed"
        self._lock = threading.Lock()  # messages of two threads must not mix
        self._asked = 0
        self._answers = select.poll()
        self._answers.register(pipe.fileno(), select.POLLIN)

    def _ask(self, name: str, *words: object, passes: int = -1) -> Any:
        with self._lock:
            if self._pipe.closed:
                raise SimulatorError(self._why_closed, fix="make a new environment")
            fine, answer = self._exchange(name, words, passes)
        if not fine:
            raise answer
        return answer

    def _exchange(self, name: str, words: tuple[object, ...], passes: int) -> tuple[bool, Any]:
        """Send a request to the process, and return its answer.

        Ctrl-C nearly always arrives during the wait. If a request was interrupted, its answer arrives later and is
        skipped, so that the next request does not receive it. A Ctrl-C in the middle of a message ends the process,
        because the rest of the stream cannot be read.
        """
        is_in_message = False
        try:
            self._asked += 1
            self._pipe.send((self._asked, name, words))
            if passes >= 0:
                is_in_message = True
                send_handle(self._pipe, passes, None)
                is_in_message = False
            while True:
                self._answers.poll()
                is_in_message = True
                answer = self._pipe.recv_bytes()
                is_in_message = False
                number, fine, found = pickle.loads(answer)  # from our own process
                if number == self._asked:
                    return fine, found
        except (EOFError, ConnectionError) as error:
            self._end()
            code = self._process.returncode
            how = "" if code is None else f" by signal {-code}" if code < 0 else f" with exit code {code}"
            what = f"the process of {self._name}" if isinstance(self._process, subprocess.Popen) else self._name
            self._why_closed = f"{what} ended{how}"
            raise SimulatorError(self._why_closed, fix="make a new environment") from error
        except BaseException:
            if is_in_message:
                self._why_closed = f"{self._name} was interrupted in the middle of a message"
                self._end()
            raise


class _Fork:
    """A fork that another process has made, with the methods of `subprocess.Popen` that are used here."""

    returncode: int | None = None  # only its parent learns that

    def __init__(self, pid: int) -> None:
        self._ends = os.pidfd_open(pid)

    def wait(self, timeout: float | None = None) -> None:
        """Wait for the end of the process, and return its exit code.

        Raises:
            subprocess.TimeoutExpired: the process is still running.
        """
        if self._ends < 0:
            return
        if not select.select([self._ends], [], [], timeout)[0]:
            raise subprocess.TimeoutExpired("fork", timeout or 0.0)
        os.close(self._ends)
        self._ends = -1

    def kill(self) -> None:
        """Kill the process."""
        if self._ends >= 0:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._ends, signal.SIGKILL)


def _end(process: subprocess.Popen[bytes] | _Fork, pipe: Ours, owner: int) -> None:
    """End a process; in a fork of the owner, only close the pipe."""
    pipe.close()
    if os.getpid() != owner:
        return
    try:
        process.wait(_GOOD_BYE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def main() -> None:
    """Answer requests until the user's program has ended."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the kernel reaps copies that end
    parent = int(sys.argv[2])
    episodes = _serve(Connection(int(sys.argv[1])), lambda: os.getppid() != parent, None)
    if episodes is not None:
        episodes.close()


def _serve(pipe: Ours, is_orphan: Callable[[], bool], episodes: Episodes | None) -> Episodes | None:
    """Answer requests until the connection is closed, or the user's program has ended."""
    with suppress(EOFError, ConnectionError):
        while True:
            # Forks of the user's program hold the other end open as well, so its end does not close the connection.
            while not pipe.poll(_LOOK_EVERY_S):
                if is_orphan():
                    return episodes
            number, name, words = pipe.recv()
            answer: object
            try:
                if episodes is None:
                    episodes = load_object(words[0])(*words[1:])
                    names = ("observation_space", "action_space", "step_length_s", "agent")
                    answer = {name: getattr(episodes, name) for name in names}
                elif name == "branch":
                    answer = _fork(pipe, episodes, *words)
                elif name == "agent_name":
                    answer = episodes.agent
                else:
                    answer = getattr(episodes, name)(*words)
            except Exception as error:
                _fail(pipe, number, error)
            else:
                pipe.send((number, True, answer))
    return episodes


def _fork(pipe: Ours, episodes: Episodes, seed: int | None, owner: int) -> tuple[int, str]:
    """Fork this process; return the id of the fork, and the reason if there is none.

    Without a seed, the random generators keep their state. ``owner`` is the process id of the user's program.
    """
    end = recv_handle(pipe)

    def serve() -> None:
        outlive_parent()  # the user may close the original first
        alive = os.pidfd_open(owner)
        if seed is not None:
            episodes.reseed(seed)
        _serve(Connection(end), lambda: bool(select.select([alive], [], [], 0.0)[0]), episodes)

    try:
        episodes.require_branch(reseeded=seed is not None)
        return fork(serve, held(), keeps=(end,)), ""
    except CannotForkError as error:
        return 0, error.message
    finally:
        os.close(end)


def _fail(pipe: Ours, number: int, error: Exception) -> None:
    try:
        pipe.send((number, False, error))
    except Exception:  # the error cannot be pickled
        pipe.send((number, False, SimulatorError(f"{type(error).__name__}: {error}")))


if __name__ == "__main__":
    main()
