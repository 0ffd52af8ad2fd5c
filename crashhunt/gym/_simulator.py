"""Any Gymnasium environment as a simulator.

Scenes of such environments have no actors: recordings contain observations and actions.
"""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from crashhunt.base.errors import InvalidEpisodeError, PluginError, ScenarioError
from crashhunt.base.exceptions import in_words, place_of
from crashhunt.base.foreign_code import Boundary, ForeignError, Party, number_of, truth_of
from crashhunt.base.plugins import load_object
from crashhunt.base.signals import InterruptedCodeError, interrupted_after
from crashhunt.base.text import (
    ABSENT_WORDS,
    NOTICE_TOPIC,
    PRESENT_WORDS,
    count_of,
    did_you_mean,
    encodable,
    listed,
    one_of,
)
from crashhunt.gym._descriptor import CrashRule, GymSetup
from crashhunt.gym._pettingzoo import OneLearner, generates_agents, is_parallel, takes_turns
from crashhunt.scenario import argument_values
from crashhunt.simulators import (
    ObservationForm,
    action_form,
    action_mask_of,
    as_tables,
    has_action_masks,
    has_nan,
    merge,
    native,
    reseed_in_place,
    time_limit_of,
)
from crashhunt.trial import fold_signals
from crashhunt.world import Contact, Roster, Scene

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from crashhunt.scenario import Scenario
    from crashhunt.simulators import ActionForm, Info, Observations, Options, StepResult
    from crashhunt.trial import Value


# Descriptions of the state after a crash, for environments that do not report the types of their crashes.
#
# A cell is the set of true flags and short texts of the last ``info``. Unlike the cells of Go-Explore (Ecoffet and
# others, 2021), a cell does not contain the last observation. With coarse levels of the observation, guided hunts found
# fewer planted faults on seven of nine problems, because one fault ended in several cells
# (`scripts/studies/run search --faults`).


_MAX_TEXT_CHARACTERS, _MAX_WORDS = 20, 8  # of the info


def crash_cell(info: Mapping[str, object]) -> str:
    """Return a description of the last step, equal for similar steps.

    Args:
        info: the dictionary ``info`` of the last step. True flags and short texts are used; numbers are not.
    """
    words = []
    for key, value in info.items():
        if isinstance(value, bool | np.bool_) and value:
            words.append(str(key))
        elif isinstance(value, str) and 0 < len(value) <= _MAX_TEXT_CHARACTERS:
            words.append(f"{key}={value}")
    return encodable(" ".join(sorted(words)[:_MAX_WORDS]))


_RESET_OPTIONS = "reset_options"  # the key of the table [gym], and the first part of an argument's option
_NO_ACTORS = Roster(())
_RESET_PARTS = ("observation", "info")
_STEP_PARTS = ("observation", "reward", "terminated", "truncated", "info")
_LIMIT = "max_episode_steps"
_LIMIT_FIX = 'give 1 or more steps, or set gym.time_limit = "none" to lift the limit'
_CRASH_KIND_KEY = "crash_kind"
_MAX_KIND_CHARACTERS = 80
_MAX_LISTED_KEYS = 12
_MAX_CLOSE_S = 5.0
"""Wall time that an environment may need to close; Unity and CARLA need some seconds."""
_OR_WRAP = "or name a function in gym.id that wraps the environment"
_REWARD_FIX, _FLAG_FIX = f"return a number from step(), {_OR_WRAP}", f"return a bool from step(), {_OR_WRAP}"
_CHECKER = "gymnasium.utils.passive_env_checker"
_INFO_FIX = "set gym.crash.function to a function that returns a bool, instead of gym.crash.info"
_FUNCTION_FIX = "return True or False from gym.crash.function, or a text that describes the crash"
_DANGER_FIX = "name a key of info in gym.danger whose value is a number"
_CONSTRUCTOR, _RESET, _STEP, _REWARD, _INFO, _CLOSE, _MASK = (
    Boundary(Party.ENVIRONMENT, place)
    for place in ("constructor", "reset", "step", "reward", "info", "close", "action mask")
)


class GymSimulator:
    """Runs the episodes of a scenario in a Gymnasium environment, each in a new environment.

    Scenario arguments are keyword arguments of the environment, or entries of the options of its reset. When the
    crash rule holds, the step has a collision without a collision partner. An episode that ends without a crash has
    finished, also by the environment's own time limit. The environment has the wrappers with which it is registered.

    Raises:
        ScenarioError: The environment or the crash rule does not exist.
    """

    def __init__(self, scenario: Scenario, stage: Path) -> None:
        self._scenario = scenario
        self._setup = scenario.table(GymSetup)
        (self._agent,) = scenario.agents
        self.step_length_s = scenario.step_length_s
        self._factory = self._find()
        self._others = load_object(self._setup.others) if self._setup.others else None
        self._rule = _Rule(self._setup.crash, self._number)
        self._near, _, self._key = self._setup.danger.partition("info.")
        self.named_danger: float | None = None
        self.crash_cell = ""
        self.agents: list[str] = []
        self._notices: dict[str, None] = {}
        self._named = _named_keys(self._setup)
        self._missing = set(self._named)
        self._keys: dict[str, None] = {}
        self._steps = 0
        self._is_open = False
        try:
            self._adopt(self._make(self._configured(argument_values(scenario))[0]))  # to read its spaces
            self._close()  # here, because the time of a trial does not include it
        except ForeignError as error:
            place = place_of(error.error)
            what = f"its {error.place} fails{f' at {place}' if place else ''}: {in_words(error.error)}"
            fix = self._checker_fix() if _is_of_checker(error.error) else ""
            raise self._mistake(what, fix=fix) from error.error

    @property
    def notices(self) -> list[str]:
        """Notices about the environment, and for each key of ``info`` that the scenario names, whether it occurred."""
        found = list(self._notices)
        for condition, key in self._named.items() if self._steps else ():
            if condition not in self._missing:
                found.append(f"{condition}{PRESENT_WORDS}")
                continue
            what = f"info had only the keys {listed(self._keys)}" if self._keys else "info was empty"
            fix = did_you_mean(key, self._keys) or "name one of its keys."
            if key == self._setup.crash.info:
                fix += " Keep it if info has this key only in the step of a crash"
            found.append(f"{condition}{ABSENT_WORDS}{what}{NOTICE_TOPIC}{condition}{ABSENT_WORDS}{what}. Fix: {fix}")
        return found

    party = Party.ENVIRONMENT
    foreign_packages = ()  # boundaries are around all calls

    def reset(self, *, seed: int, options: Options | None = None) -> tuple[Observations, Info]:
        """Make the environment and reset it."""
        self._close()
        keywords, reset_options = self._configured((options or {}).get("arguments", {}))
        try:
            self._adopt(self._make(keywords))
            with _RESET:
                # An environment without ``reset_options`` may have a method without the parameter ``options``.
                given = {} if reset_options is None else {"options": reset_options}
                observation, info = _parts("reset", self._env.reset(seed=seed, **given), _RESET_PARTS)
        except ForeignError as error:
            fix = self._checker_fix() if _is_of_checker(error.error) else ""
            what = f"the environment could not be set up: {in_words(error.error)}"
            raise InvalidEpisodeError(what, fix=fix) from error.error
        self.agents = [self._agent]
        self._steps = 0
        self._info: Info = info if isinstance(info, Mapping) else {}
        self._masks_are_used = False
        self._crashed = False
        self.was_truncated = False
        self.crash_cell = ""
        self.named_danger = None
        self._look("")
        return {self._agent: self._recorded_observation(observation)}, {self._agent: info}

    why_no_reseeding = ""

    def reseed(self, seed: int) -> None:
        """Re-seed the environment's Gymnasium generator; other generators that the environment has keep their state."""
        reseed_in_place(self._env.unwrapped.np_random, seed)

    def step(self, actions: Mapping[str, NDArray[np.generic]]) -> StepResult:
        """Run one step of the environment."""
        if not self._steps and not self._masks_are_used:
            with _MASK:
                has_masks = has_action_masks(self._env, self._info)
            if has_masks:
                self._notice(f"the environment {self._setup.id!r} gives action masks, which its agent does not use")
        action = native(self.actions[self._agent], actions[self._agent])
        with _STEP:
            try:
                returned = self._env.step(action)
            except ValueError as error:
                raise _as_raised_without_wrappers(error) from error
            except AssertionError as error:
                if not _is_of_checker(error):
                    raise
                raise AssertionError(f"{error}; {self._checker_fix()}") from error
            observation, reward, ended, cut, info = _parts("step", returned, _STEP_PARTS)
        self._steps += 1
        self._info = info
        with _REWARD:  # these may be objects of any class
            reward = self._number(reward, "the reward", _REWARD_FIX)
            terminated = truth_of(ended, "terminated", _FLAG_FIX)
            truncated = truth_of(cut, "truncated", _FLAG_FIX)
        with _INFO:  # the crash rule may be a function of the user's
            self._note_keys(info)
            what = self._rule(observation, reward, terminated, truncated, info)
            if what and not self._crashed:
                self.crash_cell = "" if self._rule.has_named else crash_cell(info)
            danger = math.nan
            if self._key and self._key in info:
                danger = self._number(info[self._key], f"gym.danger = {self._setup.danger!r}", _DANGER_FIX)
        self._look(what)
        self._record_danger(danger)
        self.was_truncated = truncated and not terminated and not self._crashed
        if truncated and not terminated:
            self._report_truncation()
        elif self._steps == self._limit_of_other_id[0] + 1:
            limit, other = self._limit_of_other_id
            what = f"is registered as {other!r} with a time limit of {count_of(limit, 'step')}"
            self._notice(f"the environment {self._setup.id!r} {what}, which only that id has")
        over = terminated or truncated or self._crashed
        if over:
            self.agents = []
        agent, shown = self._agent, self._recorded_observation(observation)
        return {agent: shown}, {agent: reward}, {agent: over}, {agent: False}, {agent: info}

    def action_mask(self, _: str) -> NDArray[np.bool_] | None:
        """Return which actions the environment allows in the next step; None if it gives no masks."""
        self._masks_are_used = True
        with _MASK:
            return action_mask_of(self._env, self._info, self.actions[self._agent].space)

    def restore_observation(self, agent: str, array: NDArray[np.generic]) -> object:
        """Return the observation that the agent receives for a recorded observation."""
        return self._form.restore(array)

    def scene(self) -> Scene:
        """Return the scene: the time and a possible crash, without actors."""
        return self._scene

    def close(self) -> None:
        """Close the environment."""
        self._close()

    def _close(self) -> None:
        """Close the environment; report a failure once per hunt, because it cannot affect the episode."""
        if not self._is_open:
            return
        self._is_open = False
        try:
            with _CLOSE, interrupted_after(_MAX_CLOSE_S):
                self._env.close()
        except ForeignError as error:
            what = f"cannot be closed: {in_words(error.error)}"
            if isinstance(error.error, InterruptedCodeError):
                what = f"cannot be closed: its close() was stopped after {_MAX_CLOSE_S:g} s"
            self._notice(f"the environment {self._setup.id!r} {what}")

    def _recorded_observation(self, observation: object) -> NDArray[np.generic]:
        """Return an observation in its recorded form; report an observation outside of the space once per hunt.

        The episode continues, because many environments leave their space by a rounding error.
        """
        array = self._form.encode(observation)
        if not self._form.contains(observation, array):
            place = self._form.misfit(observation)
            what = f"outside its own observation space{f', by its part {place}' if place else ''}"
            if has_nan(observation):
                what = "that contains NaN"
            self._notice(f"the environment {self._setup.id!r} shows its agent an observation {what}")
        return array

    def _notice(self, notice: str) -> None:
        if notice not in self._notices:
            self._notices[notice] = None
            logging.getLogger("crashhunt").warning("%s, for the first time at step %d", notice, self._steps)

    def _note_keys(self, info: Info) -> None:
        """Note the keys of a step's info, and which of the keys that the scenario names occurred.

        Many environments add a key only in the step of a crash, so one trial without the key is no mistake.
        """
        if self._missing:
            self._missing = {condition for condition in self._missing if self._named[condition] not in info}
            if len(self._keys) < _MAX_LISTED_KEYS:
                self._keys |= dict.fromkeys(map(str, info))

    def _checker_fix(self) -> str:
        """Return the fix if the checker of `gymnasium.make` refuses an environment that works without it."""
        without = "set kwargs.disable_env_checker = true in the table [gym]"
        if not self._is_registered:
            without = "give gymnasium.make disable_env_checker=True"
        return f"correct the environment, or {without}"

    def _report_truncation(self) -> None:
        if self._steps != time_limit_of(self._env):
            what = f"the environment {self._setup.id!r} truncates an episode itself or by a wrapper"
            self._notice(f"{what}, so the trial ends as finished before MAX_STEPS")
            return
        is_default = self._is_registered and self._setup.time_limit == "registered"
        fix = '; set gym.time_limit = "none" to lift it' if is_default and _LIMIT not in self._setup.kwargs else ""
        what = f"ends an episode after {count_of(self._steps, 'step')}, which is its own time limit"
        self._notice(f"the environment {self._setup.id!r} {what}{fix}")

    def _find(self) -> Callable[..., object]:
        """Return the function that makes the environment."""
        name = self._setup.id
        attribute = name.partition(":")[2]
        self._is_registered, self._limit_of_other_id = True, (-1, "")
        if attribute.isidentifier():
            try:
                factory: Callable[..., object] = load_object(name)
            except PluginError:
                if attribute not in gymnasium.registry:  # by the module: not all ids have a version
                    raise
            else:
                self._is_registered = False
                for other, spec in gymnasium.registry.items():
                    if spec.entry_point in (name, factory) and spec.max_episode_steps:
                        self._limit_of_other_id = spec.max_episode_steps, other
                return factory
        lifted = {_LIMIT: -1} if self._setup.time_limit == "none" else {}
        return lambda **kwargs: gymnasium.make(name, **{**lifted, **kwargs})

    def _configured(self, arguments: Mapping[str, Value]) -> tuple[dict[str, object], dict[str, object] | None]:
        """Return the keyword arguments of the environment, and the options of its reset."""
        keywords, options = deepcopy((self._setup.kwargs, self._setup.reset_options))
        for table in as_tables(self._scenario, fold_signals(arguments)):
            entries = table.get(_RESET_OPTIONS)
            if options is not None and isinstance(entries, dict):
                merge(options, entries)
            else:
                merge(keywords, table)
        return keywords, options

    def _make(self, keywords: dict[str, object]) -> gymnasium.Env[Any, Any]:
        try:
            with _CONSTRUCTOR, warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # for an outdated version, which the user chose
                made = self._factory(**keywords)
        except ForeignError as error:
            if isinstance(error.error, gymnasium.error.Error | ImportError | TypeError):
                is_of_reset = _RESET_OPTIONS in keywords and self._setup.reset_options is None
                fix = "add reset_options = {} to the table [gym]" if is_of_reset else ""
                if _LIMIT in keywords and self._is_registered:
                    fix = _LIMIT_FIX * (_LIMIT in str(error.error))
                elif _LIMIT in keywords:
                    fix = f"remove {_LIMIT}, or name the id with which the environment is registered"
                raise self._mistake(str(error.error), fix=fix) from None
            if isinstance(error.error, ValueError) and _LIMIT in keywords and _LIMIT in str(error.error):
                raise self._mistake(str(error.error), fix=_LIMIT_FIX * self._is_registered) from None
            raise
        if is_parallel(made):
            learner, names = self._setup.learner, list(map(str, made.possible_agents))
            if learner and learner not in names:
                raise ScenarioError(
                    f"gym.learner = {learner!r} is not an agent",
                    fix=one_of(learner, names),
                    where=self._scenario.origin,
                )
            with _CONSTRUCTOR:
                made = OneLearner(made, self._setup.learner, self._others, self._setup.others)
        elif self._setup.learner or self._setup.others:
            fix = "remove gym.learner and gym.others"
            raise self._mistake(
                "this environment has one agent and is not a parallel environment of PettingZoo", fix=fix
            )
        if not isinstance(made, gymnasium.Env):
            fix, what = (
                "return a gymnasium.Env, or a parallel environment of PettingZoo",
                "which is not a gymnasium.Env",
            )
            if takes_turns(made):
                fix, what = "name the function parallel_env of the environment", "whose agents act in turns"
            elif generates_agents(made):
                fix = "set it to the list of the agents that may take part, at least the one that gym.learner names"
                what = "a parallel environment without possible_agents"
            raise self._mistake(f"this factory returned a {type(made).__name__}, {what}", fix=fix)
        return made

    def _mistake(self, message: str, *, fix: str = "") -> ScenarioError:
        text = f"gym.id = {self._setup.id!r}: {' '.join(message.split())}"
        return ScenarioError(text, fix=fix, where=self._scenario.origin)

    def _adopt(self, env: gymnasium.Env[Any, Any]) -> None:
        self._env, self._is_open = env, True
        with _CONSTRUCTOR:
            spaces = env.observation_space, env.action_space
        for name, space in zip(("observation_space", "action_space"), spaces, strict=True):
            if not isinstance(space, gymnasium.Space):
                fix = "set it in the environment's constructor"
                raise self._mistake(f"the environment's {name} is {space!r:.80}, not a gymnasium.Space", fix=fix)
        self._form = ObservationForm(spaces[0])
        self.observation_spaces = {self._agent: self._form.space}
        self.shown_spaces = {self._agent: self._form.original} if self._form.structured else {}
        self.actions: dict[str, ActionForm] = {self._agent: action_form(spaces[1])}

    def _number(self, value: object, what: str, fix: str) -> float:
        """Return a number of the environment; report NaN once per hunt, because no comparison with it holds.

        Raises:
            UnusableValueError: the value is neither a bool nor a number.
        """
        number = number_of(value, what, fix)
        if math.isnan(number):
            words = "NaN is not compared, so such a step is no crash by this value"
            self._notice(f"{what} is NaN in the environment {self._setup.id!r}: {words}")
        return number

    def _record_danger(self, value: float) -> None:
        if not math.isnan(value):
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
        self._scene = Scene(self._steps * self.step_length_s, _NO_ACTORS, [], [], [], contacts)


def _named_keys(setup: GymSetup) -> dict[str, str]:
    """Return the keys of ``info`` that a scenario names, by the condition as the user wrote it."""
    named = {f"gym.crash.info = {setup.crash.info!r}": setup.crash.info}
    named[f"gym.danger = {setup.danger!r}"] = setup.danger.partition("info.")[2]
    return {condition: key for condition, key in named.items() if key}


def _parts(method: str, returned: Any, wanted: tuple[str, ...]) -> Sequence[Any]:
    """Return what a method of an environment has returned, after a check that it is what Gymnasium defines.

    Raises:
        TypeError: the environment has the interface of the old gym, or its info is not a dictionary.
    """
    if not isinstance(returned, tuple | list) or len(returned) != len(wanted):
        what = f"{len(returned)} values" if isinstance(returned, tuple | list) else f"one {type(returned).__name__}"
        raise TypeError(f"{method}() returned {what}, but {method}() of Gymnasium returns {', '.join(wanted)}")
    if method == "step" and not isinstance(returned[-1], Mapping):
        raise TypeError(f"step() returned info = {returned[-1]!r:.80}, which is not a dictionary")
    return returned


def _as_raised_without_wrappers(error: ValueError) -> Exception:
    """Return the error that names the environment if a wrapper of Gymnasium cannot unpack what it has returned."""
    if not _module_of(error).startswith("gymnasium.") or "to unpack" not in str(error):
        return error
    return TypeError(f"step() of Gymnasium returns {', '.join(_STEP_PARTS)}, but step() of the environment: {error}")


def _is_of_checker(error: BaseException) -> bool:
    """Return whether an error was raised by the checker that `gymnasium.make` wraps around an environment."""
    return _module_of(error) == _CHECKER


def _module_of(error: BaseException) -> str:
    """Return the name of the module that has raised an error; empty if it is unknown."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return "" if trace is None else str(trace.tb_frame.f_globals.get("__name__"))


class _Rule:
    def __init__(self, rule: CrashRule, number: Callable[[object, str, str], float]) -> None:
        self._rule = rule
        self._number = number
        self._function = load_object(rule.function) if rule.function else None
        self._kind = load_object(rule.kind) if rule.kind else None
        self.has_named = False
        """Whether the environment or the function has named the type of the last crash."""

    def __call__(self, observation: object, reward: float, terminated: bool, truncated: bool, info: Info) -> str:
        """Return a description of the crash, by default its type; empty if the step has no crash."""
        found = self._find(observation, reward, terminated, truncated, info)
        if not found:
            return ""
        given = observation, reward, terminated, truncated, info
        kind = info.get(_CRASH_KIND_KEY) if self._kind is None else self._kind(*given)
        text = " ".join(encodable(kind).split()) if isinstance(kind, str) else ""
        self.has_named = bool(text)
        return text[:_MAX_KIND_CHARACTERS] or found

    def _find(self, observation: object, reward: float, terminated: bool, truncated: bool, info: Info) -> str:
        rule = self._rule
        if rule.info and rule.info in info and self._is_true(info[rule.info], f"info[{rule.info!r}]", _INFO_FIX):
            return rule.info
        if rule.reward_below is not None and reward < rule.reward_below:
            return f"reward {reward:g}"
        if self._function is not None:
            found = self._function(observation, reward, terminated, truncated, info)
            if isinstance(found, str):
                if found:
                    return encodable(found)
            elif found is not None and self._is_true(found, f"the result of {rule.function}", _FUNCTION_FIX):
                return rule.function
        return "terminated" if rule.termination and terminated else ""

    def _is_true(self, value: object, what: str, fix: str) -> bool:
        """Return whether a value means a crash; NaN is neither true nor false, and is reported."""
        number = self._number(value, what, fix)
        return number != 0 and not math.isnan(number)
