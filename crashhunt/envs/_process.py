"""Runs episodes in a process of their own, because libsumo has one simulation per process."""

from __future__ import annotations

import os
import subprocess
import sys
import weakref
from contextlib import suppress
from multiprocessing.connection import Connection, Pipe
from typing import TYPE_CHECKING, Any, TypeAlias

from crashhunt.base.errors import SimulatorError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    import numpy as np
    from gymnasium import Space
    from numpy.typing import NDArray

    from crashhunt.trial import Value

__all__ = ["RemoteEpisodes"]

Ours: TypeAlias = "Connection[Any, Any]"
"""A pipe between the two processes, which carries the arguments and results of the methods of `Episodes`."""

_LOOK_EVERY_S = 1.0  # time between two checks whether the parent process still exists
_GOOD_BYE_S = 5.0  # time for SUMO to close before the process is killed


class RemoteEpisodes:
    """`Episodes` in a child process, which ends with this object and with this process.

    The arguments are those of `Episodes`. Exceptions of the child process are raised here.
    """

    def __init__(
        self, scenario: str | Path, agent: str, action: str, disturb: Sequence[str] = (), max_steps: int = 0
    ) -> None:
        here, there = Pipe()
        # Use a program of its own, because the daemonic workers of an AsyncVectorEnv may not have children of
        # multiprocessing.
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "crashhunt.envs._process", str(there.fileno()), str(os.getpid())],
            pass_fds=(there.fileno(),),
            stdin=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            start_new_session=True,  # Ctrl-C must reach the parent process only
        )
        there.close()
        self._pipe = here
        self._end = weakref.finalize(self, _end, self._process, here, os.getpid())
        found = self._ask("made", str(scenario), agent, action, tuple(disturb), max_steps)
        self.observation_space: Space[object] = found["observation_space"]
        self.action_space: Space[object] = found["action_space"]
        self.step_length_s: float = found["step_length_s"]
        self.agent: str = found["agent"]

    def reset(self, seed: int, arguments: Mapping[str, Value]) -> tuple[NDArray[np.generic], dict[str, object]]:
        """Begin an episode."""
        found: tuple[NDArray[np.generic], dict[str, object]] = self._ask("reset", seed, dict(arguments))
        return found

    def step(self, action: object) -> tuple[NDArray[np.generic], float, bool, dict[str, object]]:
        """Advance one control step."""
        found: tuple[NDArray[np.generic], float, bool, dict[str, object]] = self._ask("step", action)
        return found

    def picture(self) -> NDArray[np.generic]:
        """Return the scene from above."""
        found: NDArray[np.generic] = self._ask("picture")
        return found

    def close(self) -> None:
        """End the process."""
        self._end()

    def _ask(self, name: str, *words: object) -> Any:
        if self._pipe.closed:
            raise SimulatorError("the environment has been closed", fix="make a new environment")
        try:
            self._pipe.send((name, words))
            fine, answer = self._pipe.recv()
        except (EOFError, ConnectionError) as error:
            self._end()
            code = self._process.returncode
            how = f"by signal {-code}" if code is not None and code < 0 else f"with exit code {code}"
            raise SimulatorError(f"the process of the environment ended {how}", fix="make a new environment") from error
        if not fine:
            raise answer
        return answer


def _end(process: subprocess.Popen[bytes], pipe: Ours, owner: int) -> None:
    """End the child process; in a fork of the owner, only close the pipe."""
    pipe.close()
    if os.getpid() != owner:
        return
    try:
        process.wait(_GOOD_BYE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def main() -> None:
    """Answer requests until the parent process has ended."""
    from crashhunt.envs._episodes import Episodes

    pipe: Ours = Connection(int(sys.argv[1]))
    parent = int(sys.argv[2])
    episodes: Episodes | None = None
    with suppress(EOFError, ConnectionError):
        while True:
            # Forks of the parent hold the pipe open as well, so an open pipe does not prove that the parent exists.
            while not pipe.poll(_LOOK_EVERY_S):
                if os.getppid() != parent:
                    return
            name, words = pipe.recv()
            answer: object
            try:
                if episodes is None:
                    episodes = Episodes(*words)
                    names = ("observation_space", "action_space", "step_length_s", "agent")
                    answer = {name: getattr(episodes, name) for name in names}
                else:
                    answer = getattr(episodes, name)(*words)
            except Exception as error:
                _fail(pipe, error)
            else:
                pipe.send((True, answer))
    if episodes is not None:
        episodes.close()


def _fail(pipe: Ours, error: Exception) -> None:
    try:
        pipe.send((False, error))
    except Exception:  # the error cannot be pickled
        pipe.send((False, SimulatorError(f"{type(error).__name__}: {error}")))


if __name__ == "__main__":
    main()
