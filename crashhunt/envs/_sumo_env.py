"""SUMO as a Gymnasium environment with one controlled vehicle, for training and testing an agent."""

from __future__ import annotations

import importlib.util
import os
import weakref
from collections.abc import Iterable
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from crashhunt.base.errors import UsageError
from crashhunt.base.extras import install_command
from crashhunt.base.text import one_of
from crashhunt.envs._env_episodes import Episodes
from crashhunt.envs._process import RemoteEpisodes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

# The environment that owns this process's simulation, and the id of this process: a fork owns no simulation. The
# reference is weak, so that an environment without `close` is still collected.
_here: weakref.WeakSet[Episodes] = weakref.WeakSet()
_process: list[int] = []


class SumoEnv(gymnasium.Env[Any, Any]):
    """The environment that ``gymnasium.make("crashhunt:crashhunt/SUMO-v0")`` returns.

    The observation has the layout of highway-env's Kinematics: float32, shape (vehicles, features). If ``observation``
    names parts, the observation is a dictionary of arrays, one per part, and ``info["actors"]`` contains the
    identifiers of the actors in the rows of the part ``actors``. The reward is the
    distance driven in a step, in m. An episode terminates when the vehicle arrives or crashes, and ``info["outcome"]``
    is how it ended. An episode is truncated after ``max_steps``.

    Args:
        scenario: Name of a shipped scenario, or a path.
        agent: The controlled vehicle; by default the first agent of the scenario. The other agents keep their lane.
        action: The form of the actions, as ``crashhunt list actions`` names it. The default is the scenario's own
            choice, or else ``speed_and_lane``: (target speed in m/s, lane change).
        observation: The parts that the vehicle observes, separated by commas or as a sequence, such as
            ``"ego,actors:rows=8"``; ``crashhunt list observations`` shows all parts. The default is the scenario's own
            choice.
        max_steps: Maximum number of steps of an episode; None for no limit.
        render_mode: None, or ``rgb_array``: `render` returns the scene from above, uint8, shape (540, 960, 3).
        process: Whether the environment runs in its own process, which costs up to a millisecond per step. libsumo has
            one simulation per process. Therefore, by default, the first environment runs in the caller's process, and
            each further environment in its own process.
        disturb: Rates of disturbances per second, as in ``--disturb``: ``brake=0.02,cut_in=0.01``. Disturbances need
            ``max_steps``, and the seed of the episode determines them. ``info["disturbances"]`` describes the
            disturbances that began in the step, and those that begin with the returned observation.

    Raises:
        CrashhuntError: The scenario, the agent or a disturbance does not exist, or SUMO does not support it.
        UsageError: An option has the wrong type, or is out of range.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 - Gymnasium's base class declares it so

    def __init__(
        self,
        scenario: str | Path = "loop",
        *,
        agent: str = "",
        action: str = "",
        observation: str | Sequence[str] = "",
        max_steps: int | None = None,
        render_mode: str | None = None,
        process: bool | None = None,
        disturb: str = "",
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise UsageError(f"render_mode is {render_mode!r}", fix=one_of(str(render_mode), ("rgb_array",)))
        if render_mode is not None and importlib.util.find_spec("PIL") is None:
            raise UsageError("render_mode needs Pillow", fix=install_command("video"))
        if not isinstance(scenario, str | Path) or not str(scenario):
            raise UsageError(f"scenario is {scenario!r}", fix="give the name of a shipped scenario, or a path")
        for name, text in (("agent", agent), ("action", action), ("disturb", disturb)):
            if not isinstance(text, str):
                raise UsageError(f"{name} is {text!r}", fix=f"give {name} as text, or omit it")
        if max_steps is not None and (not isinstance(max_steps, Integral) or max_steps < 1):
            raise UsageError(f"max_steps is {max_steps!r}", fix="give at least 1, or None for no limit")
        words = _words_in(disturb)
        given: object = _words_in(observation) if isinstance(observation, str) else observation
        parts = tuple(given) if isinstance(given, Iterable) else (given,)
        if not all(isinstance(part, str) for part in parts):
            raise UsageError(f"observation is {observation!r}", fix="give the names of parts as text, or omit it")
        self._max_steps = max_steps
        self._episodes: Episodes | RemoteEpisodes
        if process is None:
            process = _process == [os.getpid()] and len(_here) > 0
        if process:
            self._episodes = RemoteEpisodes(str(scenario), agent, action, words, max_steps or 0, parts)
        else:
            self._episodes = Episodes(scenario, agent, action, words, max_steps or 0, parts)
            if _process != [os.getpid()]:
                _here.clear()
                _process[:] = [os.getpid()]
            _here.add(self._episodes)
        self.agent = self._episodes.agent
        self.observation_space = self._episodes.observation_space
        self.action_space = self._episodes.action_space
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": max(1, round(1.0 / self._episodes.step_length_s))}
        self._steps, self._is_copy = -1, False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, object]]:
        """Begin an episode.

        Args:
            seed: Seed of the environment's random generator, which draws the seeds of this and of all later episodes.
            options: Scenario arguments that differ from their defaults, as ``{"arguments": {name: value}}``.

        Raises:
            ArgumentError: The scenario has no argument of that name, or the argument cannot have that value.
            UsageError: The options contain something else.
            SimulatorError: The environment has been closed, or SUMO could not set up the episode.
        """
        if self._is_copy:
            raise UsageError(
                "a copy of an episode cannot be reset", fix="reset the original, or make a new environment"
            )
        arguments = _arguments_in(options)
        super().reset(seed=seed)
        drawn = int(self.np_random.integers(2**31))
        self._steps = 0
        return self._episodes.reset(drawn, arguments)

    def step(self, action: object) -> tuple[Any, float, bool, bool, dict[str, object]]:
        """Advance one control step.

        Raises:
            ActionError: The action is not in the space.
            SimulatorError: SUMO failed, its process ended, or another simulation has begun in this process.
        """
        observation, reward, terminated, info = self._episodes.step(action)
        self._steps += 1
        truncated = not terminated and self._max_steps is not None and self._steps >= self._max_steps
        return observation, reward, terminated, truncated, info

    def branch(self, n: int, *, seed: int | None = None) -> list[SumoEnv]:
        """Return independent copies of the running episode, each in a fork of the process of this environment.

        Each copy continues from the present state of this environment. With the same actions, copies without a ``seed``
        return bit-identical observations. Copies may be branched again, and continue to exist after this environment is
        closed. Close each copy.

        Args:
            n: number of copies, at least 1.
            seed: seed from which each copy gets another seed for SUMO's random generators, so that drivers behave
                differently. The departure times of vehicles stay as planned. If the seed is None, the generators keep
                their state.

        Raises:
            UsageError: this environment runs in the user's process, or SUMO's generators cannot be re-seeded.
            SimulatorError: no episode is running, or its process cannot be forked.
        """
        if not isinstance(n, Integral) or n < 1:
            raise UsageError(f"n is {n!r}", fix="give the number of copies, at least 1")
        if seed is not None and (not isinstance(seed, Integral) or seed < 0):
            raise UsageError(f"seed is {seed!r}", fix="give 0 or more")
        if not isinstance(self._episodes, RemoteEpisodes):
            message = "only an environment with a process of its own can be branched"
            raise UsageError(message, fix="make it with process=True")
        seeds: list[int | None] = [None] * n
        if seed is not None:
            seeds = [int(one) >> 1 for one in np.random.SeedSequence(seed).generate_state(n)]
        found = []
        for episodes in self._episodes.branch(seeds):
            env = object.__new__(type(self))
            env.__dict__.update(self.__dict__)
            env._episodes, env._is_copy = episodes, True
            found.append(env)
        return found

    def __reduce__(self) -> tuple[object, ...]:
        """Refuse to be copied or pickled, because a simulation of SUMO is bound to its process."""
        raise UsageError(
            "an environment on SUMO cannot be copied or pickled",
            fix="make another one; branch copies a running episode",
        )

    def render(self) -> NDArray[np.generic] | None:
        """Return the scene from above if ``render_mode`` is ``rgb_array``; otherwise None.

        Raises:
            UsageError: No episode has begun.
        """
        if self.render_mode is None:
            return None
        if self._steps < 0:
            raise UsageError("there is nothing to render yet", fix="call reset first")
        return self._episodes.picture()

    def close(self) -> None:
        """End the simulation and remove its files; a second call does nothing."""
        self._episodes.close()
        if isinstance(self._episodes, Episodes):
            _here.discard(self._episodes)


def _words_in(text: str) -> tuple[str, ...]:
    """Return the words of a text that are separated by commas."""
    return tuple(filter(None, (word.strip() for word in text.split(","))))


def _arguments_in(options: object) -> dict[str, Any]:
    """Return the scenario arguments in the options of a reset; a misspelt entry would otherwise have no effect."""
    given = {} if options is None else options
    if not isinstance(given, dict):
        raise UsageError(f"options is {options!r}", fix="give {'arguments': {NAME: VALUE}}")
    if unknown := [key for key in given if key != "arguments"]:
        raise UsageError(f"options has {unknown[0]!r}", fix="give only 'arguments'")
    arguments = given.get("arguments", {})
    if not isinstance(arguments, dict):
        raise UsageError(f"options: arguments is {arguments!r}", fix="give {NAME: VALUE}")
    return arguments
