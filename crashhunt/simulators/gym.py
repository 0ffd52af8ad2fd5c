"""Any Gymnasium environment as a simulator. Its scenes have no actors: recordings hold observations and actions."""

from __future__ import annotations

import logging
import warnings
from copy import deepcopy
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from crashhunt.base.errors import CrashhuntError, InvalidEpisodeError, ScenarioError
from crashhunt.base.plugins import load_object
from crashhunt.base.text import encodable
from crashhunt.scenario import argument_values
from crashhunt.scenario.backends.gym import GymSetup
from crashhunt.simulators._gymnasium import ObservationForm, action_form, as_tables, merge, native, reseed_in_place
from crashhunt.world import Contact, Roster, Scene

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from crashhunt.scenario import Scenario
    from crashhunt.scenario.backends.gym import CrashRule
    from crashhunt.simulators._protocol import ActionForm, Info, Observations, Options, StepResult
    from crashhunt.trial import Value

__all__ = ["GymSimulator"]

_NOBODY = Roster(())


class GymSimulator:
    """Runs the episodes of a scenario in a Gymnasium environment, each in a new environment.

    Scenario arguments are keyword arguments of the environment. When the crash rule holds, the step has a collision
    without a collision partner. An episode that ends without a crash has finished. The environment's own step limit is
    disabled.

    Args:
        scenario: The scenario to run.
        stage: Not used.

    Raises:
        ScenarioError: The environment or the crash rule does not exist.
    """

    def __init__(self, scenario: Scenario, stage: Path) -> None:
        self._scenario = scenario
        self._setup = scenario.table(GymSetup)
        (self._agent,) = scenario.agents
        self.step_length_s = scenario.step_length_s
        self._factory = self._find()
        self._rule = _Rule(self._setup.crash)
        self._near, _, self._key = self._setup.danger.partition("info.")
        self.named_danger: float | None = None
        self.agents: list[str] = []
        self.notices: dict[str, None] = {}
        try:
            self._adopt(self._make(argument_values(scenario)))  # to read its spaces
        except CrashhuntError:
            raise
        except Exception as error:
            raise self._mistake(f"{type(error).__name__}: {error}") from error

    def reset(self, *, seed: int, options: Options | None = None) -> tuple[Observations, Info]:
        """Make the environment and reset it."""
        self._env.close()
        try:
            self._adopt(self._make((options or {}).get("arguments", {})))
            observation, info = self._env.reset(seed=seed)
        except CrashhuntError:
            raise
        except Exception as error:
            message = f"the environment could not be set up: {type(error).__name__}: {error}"
            raise InvalidEpisodeError(message) from error
        self.agents = [self._agent]
        self._steps = 0
        self._crashed = False
        self.named_danger = None
        self._look("")
        return {self._agent: self._shown(observation)}, {self._agent: info}

    why_no_reseeding = ""

    def reseed(self, seed: int) -> None:
        """Re-seed the environment's Gymnasium generator; other generators that the environment has keep their state."""
        reseed_in_place(self._env.unwrapped.np_random, seed)

    def step(self, actions: Mapping[str, NDArray[np.generic]]) -> StepResult:
        """Step the environment."""
        action = native(self.actions[self._agent], actions[self._agent])
        observation, reward, terminated, truncated, info = self._env.step(action)
        self._steps += 1
        self._look(self._rule(observation, float(reward), bool(terminated), bool(truncated), info))
        if self._key and self._key in info:
            self._record_danger(info[self._key])
        over = bool(terminated or truncated) or self._crashed
        if over:
            self.agents = []
        agent, shown = self._agent, self._shown(observation)
        return {agent: shown}, {agent: float(reward)}, {agent: over}, {agent: False}, {agent: info}

    def scene(self) -> Scene:
        """Return the scene: the time and a crash, without actors."""
        return self._scene

    def close(self) -> None:
        """Close the environment."""
        self._env.close()

    def _shown(self, observation: object) -> NDArray[np.generic]:
        """Return an observation as it is recorded; report an observation outside the space once per hunt.

        The episode continues, because many environments leave their space by a rounding error.
        """
        array = self._form.encode(observation)
        if not self._form.space.contains(array):
            what = "outside its own observation space"
            if array.dtype.kind == "f" and np.isnan(array).any():
                what = "that contains NaN"
            notice = f"the environment {self._setup.id!r} shows its agent an observation {what}"
            if notice not in self.notices:
                self.notices[notice] = None
                logging.getLogger("crashhunt").warning("%s, for the first time at step %d", notice, self._steps)
        return array

    def _find(self) -> Callable[..., object]:
        name = self._setup.id
        if name.partition(":")[2].isidentifier():
            factory: Callable[..., object] = load_object(name)
            return factory
        # The trial limits the number of steps, not the environment.
        return lambda **kwargs: gymnasium.make(name, max_episode_steps=-1, disable_env_checker=True, **kwargs)

    def _make(self, arguments: Mapping[str, Value]) -> gymnasium.Env[Any, Any]:
        kwargs = deepcopy(self._setup.kwargs)
        for table in as_tables(self._scenario, arguments):
            merge(kwargs, table)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # for an outdated version, which the user chose
                made = self._factory(**kwargs)
        except (gymnasium.error.Error, ImportError, TypeError) as error:
            raise self._mistake(str(error)) from None
        if not isinstance(made, gymnasium.Env):
            raise self._mistake(f"this factory returned a {type(made).__name__}; it must return a gymnasium.Env")
        return made

    def _mistake(self, message: str) -> ScenarioError:
        return ScenarioError(f"gym.id = {self._setup.id!r}: {' '.join(message.split())}", where=self._scenario.origin)

    def _adopt(self, env: gymnasium.Env[Any, Any]) -> None:
        self._env = env
        self._form = ObservationForm(env.observation_space)
        self.observation_spaces = {self._agent: self._form.space}
        self.shown_spaces = {self._agent: self._form.original} if self._form.flattened else {}
        self.actions: dict[str, ActionForm] = {self._agent: action_form(env.action_space)}

    def _record_danger(self, reported: Any) -> None:
        try:
            value = float(reported)
        except (TypeError, ValueError):
            message = f"gym.danger = {self._setup.danger!r} is {reported!r:.80}; it must be a number"
            raise self._mistake(message) from None
        if not np.isnan(value):
            found = 1 / (1 + max(0.0, value)) if self._near else min(1.0, max(0.0, value))
            self.named_danger = max(found, self.named_danger or 0.0)

    def _look(self, what: str) -> None:
        contacts: tuple[Contact, ...] = ()
        if what and not self._crashed:
            self._crashed = True
            contacts = (
                Contact(
                    collider=self._agent,
                    victim="",
                    kind=what,
                    lane="",
                    collider_speed=float("nan"),
                    victim_speed=float("nan"),
                ),
            )
        self._scene = Scene(self._steps * self.step_length_s, _NOBODY, [], [], [], contacts)


class _Rule:
    def __init__(self, rule: CrashRule) -> None:
        self._rule = rule
        self._function = load_object(rule.function) if rule.function else None

    def __call__(self, observation: object, reward: float, terminated: bool, truncated: bool, info: Info) -> str:
        """Return a description of the crash; empty if the step has no crash."""
        rule = self._rule
        if rule.info and info.get(rule.info):
            return rule.info
        if rule.reward_below is not None and reward < rule.reward_below:
            return f"reward {reward:g}"
        if self._function is not None:
            found = self._function(observation, reward, terminated, truncated, info)
            if found:
                return encodable(found) if isinstance(found, str) else self._rule.function
        return "terminated" if rule.termination and terminated else ""
