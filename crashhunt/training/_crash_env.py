"""``crashhunt/Crashes-v0``: a Gymnasium environment whose episodes begin shortly before saved crashes."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import gymnasium

from crashhunt.base import layout
from crashhunt.base.errors import SimulatorError, UsageError
from crashhunt.base.text import one_of
from crashhunt.crashes import snapshot_of
from crashhunt.envs import RemoteEpisodes
from crashhunt.plans import read_settings
from crashhunt.training._crash_priorities import CrashReplay
from crashhunt.training._held_out_traffics import TrainedOn, check_test_share, is_test_traffic, split_crashes
from crashhunt.training._training_episodes import CrashEpisodes

_SEED_LIMIT = 2**31
"""Seeds of plain episodes are drawn from 0 to here, as those of trials are."""
_MAX_INVALID = 20
"""Plain episodes in a row that cannot be set up, such as by a vehicle that never enters."""


class CrashEnv(gymnasium.Env[Any, Any]):
    """The environment that ``gymnasium.make("crashhunt:crashhunt/Crashes-v0")`` returns.

    Each reset begins with a saved crash or with a plain episode. A crash episode repeats the recorded actions up to
    ``before_s`` before the crash, then the caller acts. A plain episode has another seed, and arguments from the ranges
    of a hunt. Spaces, rewards and crash rules are those of the scenario. An episode terminates when the vehicle crashes
    or arrives. Crashes that the agent does not yet survive are drawn more often (`CrashReplay`).

    Only traffic seeds of the training part are used; `crashhunt split` shows the parts. `info` contains ``crash`` (name
    of the crash; empty in a plain episode), ``seed``, ``step`` and ``sim_time_s``. In the last step, it also contains
    ``outcome`` and ``has_crashed``.

    ``reset(options={"crash": NAME})`` chooses a crash of `crashes`. An empty name chooses a plain episode.

    Args:
        crashes: Directories of hunts, corpora or crashes of one scenario.
        before_s: Simulation time before the crash at which the caller takes over, in s.
        after_s: Simulation time after the step of the crash at which the episode is truncated, in s.
        share: Probability that a reset begins with a crash, from 0 to 1.
        test: Share of the traffic seeds in the test part, which is never used, from 0 to below 1.
        trained_on: File ``trained_on.json``, or the policy's folder, into which the file is written; empty for no file.
        agent: The controlled vehicle; by default the first agent of the scenario. The other agents drive as in the
            hunt, with the current code.
        max_steps: Maximum number of steps of a plain episode; None for the maximum of the hunt.
        crash_reward: Reward that is added in the step of a crash, such as -10.
        process: Whether the simulation runs in its own process; by default only with SUMO, because a process can have
            only one simulation of SUMO.
        render_mode: Only None is allowed.

    Raises:
        UsageError: An option is out of range, no crash is in the training part, or the crashes' scenarios or spaces
            differ.
        UntrustedError: A crash is neither made here nor trusted.
        CrashhuntError: A crash is damaged, or its scenario cannot be loaded.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 - Gymnasium's base class declares it so

    def __init__(
        self,
        crashes: Sequence[str | Path] | str | Path = (),
        *,
        before_s: float = 5.0,
        after_s: float = 10.0,
        share: float = 0.5,
        test: float = 0.5,
        trained_on: str | Path = "",
        agent: str = "",
        max_steps: int | None = None,
        crash_reward: float = 0.0,
        process: bool | None = None,
        render_mode: str | None = None,
    ) -> None:
        _check_types(before_s=before_s, after_s=after_s, share=share, test=test, crash_reward=crash_reward)
        _check(before_s, after_s, share, max_steps, crash_reward)
        if not isinstance(agent, str):
            raise UsageError(f"agent is {agent!r}", fix="give the name of a controlled vehicle")
        if render_mode is not None:
            raise UsageError(
                f"render_mode is {render_mode!r}", fix="omit render_mode; crashhunt replay --video makes films"
            )
        places = _places(crashes)
        record = _record_file(trained_on)
        split = split_crashes(places, check_test_share(test, "test"))
        if not split.training:
            fix = "hunt for more crashes, or give a lower test share"
            raise UsageError(
                f"none of the {len(split.crashes)} crashes is in the training part (test={test:g})", fix=fix
            )
        self._split, self._training = split, split.training
        self._share, self._crash_reward = share, crash_reward
        paths = tuple(str(crash.bundle.path) for crash in self._training)
        words = (paths, agent, float(before_s), float(after_s), max_steps or 0)
        if process is None:
            snapshot = snapshot_of(self._training[0].bundle)
            snapshot.verify()
            process = snapshot.scenario.backend.one_per_process
        self._episodes: CrashEpisodes | _RemoteCrashEpisodes
        self._episodes = _RemoteCrashEpisodes(*words) if process else CrashEpisodes(*words)
        self.agent = self._episodes.agent
        self.observation_space = self._episodes.observation_space
        self.action_space = self._episodes.action_space
        self.render_mode = None
        self.crashes = tuple(crash.name for crash in self._training)  # names of the crashes of the training part
        self._replay = CrashReplay(len(self._training))
        self._index: int | None = None
        if record is not None:
            self.trained_on.write(record)

    @property
    def trained_on(self) -> TrainedOn:
        """The traffic seeds on which an agent has been trained with this environment."""
        return TrainedOn(
            test=self._split.test,
            seeds=frozenset(crash.seed for crash in self._training),
            hunt_seeds=frozenset(
                read_settings(hunt / layout.HUNT).seed for hunt in {crash.bundle.hunt for crash in self._training}
            ),
        )

    @property
    def scores(self) -> dict[str, float]:
        """How often the latest episodes from each crash crashed, by name: an exponential average that begins at 1."""
        return dict(zip(self.crashes, self._replay.scores.tolist(), strict=True))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: Seed for the draws of this and all further episodes; it also deletes the outcomes of earlier episodes.
            options: the entry ``crash`` is the name of the crash to begin with; an empty name selects a plain episode.

        Raises:
            UsageError: The crash is not in the training part, or an option does not exist.
            SimulatorError: No episode can be set up.
        """
        super().reset(seed=seed)
        if seed is not None:
            self._replay.restart()
        chosen = self._chosen(options or {})
        is_crash = self.np_random.random() < self._share if chosen is None else chosen >= 0
        if not is_crash:
            return self._reset_to_plain()
        while True:
            if self._replay.is_empty:
                raise SimulatorError(
                    "no crash can be repeated up to its last seconds; the reasons are in the warnings",
                    fix="crashhunt replay DIR shows the first difference",
                )
            index = self._replay.draw(self.np_random) if chosen is None else chosen
            observation, info, divergence = self._episodes.reset_to_crash(index)
            if not divergence:
                self._index = index
                crash = self._training[index]
                return observation, {**info, "crash": crash.name, "seed": crash.seed}
            message = f"{self.crashes[index]} is not used: {divergence}"
            if chosen is not None:
                raise SimulatorError(message, fix="crashhunt replay DIR shows the first difference")
            warnings.warn(message, stacklevel=2)
            self._replay.remove(index)

    def _chosen(self, options: dict[str, Any]) -> int | None:
        """Return the index of the crash that the options select: -1 for a plain episode, None for no selection."""
        if not isinstance(options, dict):
            raise UsageError(f"options is {options!r}", fix="give {'crash': NAME}")
        unknown = sorted(options.keys() - {"crash"})
        if unknown:
            raise UsageError(f"options has {unknown[0]!r}", fix="give only 'crash'")
        name = options.get("crash")
        if name is None or name == "":
            return None if name is None else -1
        found = [place for place, known in enumerate(self.crashes) if name in (known, known.rpartition("/")[2])]
        if len(found) == 1:
            return found[0]
        if found:
            fix = "give the whole name DIRECTORY/CRASH; the directories of the hunts need different names"
            raise UsageError(f"{len(found)} crashes are named {name!r}", fix=fix)
        if any(name in (crash.name, crash.bundle.id) for crash in self._split.held_out):
            raise UsageError(f"the crash {name!r} is in the test part", fix="choose one of env.unwrapped.crashes")
        raise UsageError(f"there is no crash {name!r} in the training part", fix=one_of(str(name), self.crashes))

    def _reset_to_plain(self) -> tuple[Any, dict[str, Any]]:
        self._index = None
        for attempt in range(_MAX_INVALID):
            hunt = int(self.np_random.integers(len(self._training)))
            seed = int(self.np_random.integers(_SEED_LIMIT))
            while is_test_traffic(seed, self._split.test):
                seed = int(self.np_random.integers(_SEED_LIMIT))
            try:
                observation, info = self._episodes.reset_to_plain(hunt, seed)
            except SimulatorError:
                if attempt == _MAX_INVALID - 1 or self._episodes.is_closed:
                    raise
                continue
            return observation, {**info, "crash": "", "seed": seed}
        raise AssertionError

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advance the episode by one step.

        Raises:
            ActionError: The action is not in the action space.
            SimulatorError: No episode is running.
        """
        observation, reward, terminated, truncated, info = self._episodes.step(action)
        if "outcome" in info:
            has_crashed = bool(info["has_crashed"])
            reward += self._crash_reward * has_crashed
            if self._index is not None:
                self._replay.record(self._index, has_crashed=has_crashed)
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        """End the simulation and remove its files; a second call does nothing."""
        self._episodes.close()


class _RemoteCrashEpisodes(RemoteEpisodes):
    """Runs `CrashEpisodes` in a child process."""

    served = "crashhunt.training._training_episodes:CrashEpisodes"

    def reset_to_crash(self, index: int) -> tuple[Any, dict[str, Any], str]:
        """Begin an episode shortly before a crash."""
        found: tuple[Any, dict[str, Any], str] = self._ask("reset_to_crash", index)
        return found

    def reset_to_plain(self, hunt: int, seed: int) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in a new traffic of a hunt."""
        found: tuple[Any, dict[str, Any]] = self._ask("reset_to_plain", hunt, seed)
        return found

    def step(self, action: object) -> tuple[Any, float, bool, bool, dict[str, Any]]:  # type: ignore[override]
        """Advance the episode by one step."""
        found: tuple[Any, float, bool, bool, dict[str, Any]] = self._ask("step", action)
        return found


def _check_types(**numbers: object) -> None:
    """Refuse options that are not numbers, such as text from a configuration file."""
    for name, value in numbers.items():
        if not isinstance(value, Real):
            raise UsageError(f"{name} is {value!r}", fix="give a number")


def _places(crashes: object) -> list[str | Path]:
    """Return the directories that contain crashes."""
    fix = "give the directories of hunts or of a corpus"
    if isinstance(crashes, str | Path):
        return [crashes]
    found: list[Any] = [*crashes] if isinstance(crashes, Iterable) else [crashes]
    if not all(isinstance(place, str | Path) for place in found):
        raise UsageError(f"crashes is {crashes!r}", fix=fix)
    if not found:
        raise UsageError("crashes is empty", fix=fix)
    return found


def _record_file(trained_on: object) -> Path | None:
    """Return the path of ``trained_on.json``; None for no file."""
    if not isinstance(trained_on, str | Path) or "\0" in str(trained_on):
        raise UsageError(
            f"trained_on is {trained_on!r}, which is no path", fix="give the folder in which the policy is saved"
        )
    if not str(trained_on):
        return None
    path = Path(trained_on)
    return path if path.suffix == ".json" else path / layout.TRAINED_ON


def _check(before_s: float, after_s: float, share: float, max_steps: int | None, crash_reward: float) -> None:
    for name, value in (("before_s", before_s), ("after_s", after_s)):
        if not 0 < value < math.inf:
            raise UsageError(f"{name} is {value:g}", fix="give a time above 0, in s")
    if not 0 <= share <= 1:
        raise UsageError(f"share is {share:g}", fix="give a probability from 0 to 1")
    if max_steps is not None and (not isinstance(max_steps, Integral) or max_steps < 1):
        raise UsageError(f"max_steps is {max_steps!r}", fix="give at least 1, or None for the maximum of the hunt")
    if not math.isfinite(crash_reward):
        raise UsageError(f"crash_reward is {crash_reward:g}", fix="give a finite number, such as -10")


def make_training_env(crashes: Sequence[str | Path] | str | Path, **options: Any) -> gymnasium.Env[Any, Any]:
    """Return the environment ``crashhunt/Crashes-v0`` with Gymnasium's usual wrappers.

    Args:
        crashes: Directories of hunts, corpora or crashes of one scenario.
        options: Options of `crashhunt.training.CrashEnv`.

    Raises:
        CrashhuntError: As for `crashhunt.training.CrashEnv`.
    """
    return gymnasium.make("crashhunt:crashhunt/Crashes-v0", crashes=crashes, **options)
