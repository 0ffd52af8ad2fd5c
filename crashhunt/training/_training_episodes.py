"""Episodes that begin shortly before a saved crash, or with new traffic of the same hunt.

The recorded actions are repeated up to the step at which the agent takes over. Repeating the actions needs neither the
code of the recorded agent nor its state. Each observation and scene of these steps is compared with the recording bit
for bit, to ensure that the agent faces the situation that led to the crash.
"""

from __future__ import annotations

import hashlib
import random
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.base import layout
from crashhunt.base.errors import SimulatorError, UsageError
from crashhunt.base.foreign_code import supports
from crashhunt.base.plugins import locate
from crashhunt.base.temporary import TemporaryFolder
from crashhunt.base.text import one_of
from crashhunt.crashes import read_bundle
from crashhunt.episode import Episode, Parts, observation_restorers
from crashhunt.plans import disturber, read_settings
from crashhunt.replays import ReplayOptions, prepare
from crashhunt.simulators import FlattensObservations, ReportsTruncation
from crashhunt.trial import Outcome, TrialSpec

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from gymnasium import Space
    from numpy.typing import NDArray

    from crashhunt.agents import Agent
    from crashhunt.crashes import Bundle
    from crashhunt.disturbances import DisturbanceSampler
    from crashhunt.plans import HuntSettings
    from crashhunt.recording import Recording
    from crashhunt.replays import Rerun
    from crashhunt.simulators import Simulator
    from crashhunt.trial import TrialResult, Value
    from crashhunt.world import Scene

_DIGEST_BYTES = 16


class CrashEpisodes:
    """Episodes of one controlled vehicle, from saved crashes of one scenario.

    Args:
        crashes: Paths of the bundles.
        agent: The controlled vehicle that the caller drives; if empty, the first agent of the scenario.
        before_s: Simulation time before the crash at which the caller takes over, in s.
        after_s: Simulation time after the step of the crash at which the episode is truncated, in s.
        max_steps: Maximum number of steps of a plain episode; 0 for the maximum of the hunt.

    Attributes:
        observation_space: The observation space of the vehicle.
        action_space: The action space of the vehicle.
        step_length_s: Simulation time of a step, in s.
        agent: The controlled vehicle.
        is_closed: Whether there can be no further episodes; always false, because no other process is involved.

    Raises:
        CrashhuntError: A crash cannot be run again, or the crashes have different scenarios or spaces.
    """

    is_closed = False

    def __init__(self, crashes: Sequence[str], agent: str, before_s: float, after_s: float, max_steps: int) -> None:
        self._bundles = [read_bundle(Path(path)) for path in crashes]
        self._before_s, self._after_s, self._max_steps = before_s, after_s, max_steps
        self._folder = TemporaryFolder("training")
        self._starts: dict[int, _Start] = {}
        self._stages: dict[Path, _Stage] = {}
        self._running: _Stage | None = None
        self._episode: Episode | None = None
        firsts = {bundle.hunt: bundle for bundle in reversed(self._bundles)}
        for bundle in reversed(firsts.values()):
            self._stages[bundle.hunt] = _Stage(bundle, agent, self._folder.path)
        first, *others = self._stages.values()
        for other in others:
            _require_same(first, other)
        self.agent, self.step_length_s = first.agent, first.simulator.step_length_s
        self.observation_space, self.action_space = first.observation_space, first.action_space

    def reset_to_crash(self, index: int) -> tuple[object, dict[str, object], str]:
        """Begin an episode shortly before a crash.

        Returns:
            The observation, the info, and a description of where the repeated steps differ from the recording. The
            description is empty if the repeated steps are bit-identical; otherwise the episode must not be used.
        """
        bundle = self._bundles[index]
        stage = self._enter(bundle.hunt)
        start = self._starts.get(index)
        if start is None:
            rerun = prepare(bundle, ReplayOptions(code="current"))
            start = self._starts[index] = _Start.of(rerun, stage.agent, self._before_s)
        steps_after = max(1, round(self._after_s / self.step_length_s))
        spec = replace(start.spec, max_steps=min(start.spec.max_steps, start.crash_step + steps_after))
        with _seeded(spec.seed):
            episode = self._begin(stage, spec)
            divergence = start.repeat(episode, stage.agent)
        if divergence:
            return None, {}, divergence
        return *self._observation_and_info(episode), ""

    def reset_to_plain(self, hunt: int, seed: int) -> tuple[object, dict[str, object]]:
        """Begin an episode with new traffic of a hunt.

        The traffic has the settings of the hunt of the crash with the index ``hunt``. The seed is also that of the
        scenario arguments.

        Raises:
            SimulatorError: The episode cannot be set up.
        """
        stage = self._enter(self._bundles[hunt].hunt)
        spec = stage.plain_spec(seed, self._max_steps)
        with _seeded(seed):
            episode = self._begin(stage, spec)
        if episode.result is not None:
            failure = episode.result.failure
            why = failure.message if failure is not None else str(episode.result.outcome)
            raise SimulatorError(
                f"the environment cannot begin an episode with seed {seed}: {why}",
                fix="check the scenario with crashhunt run",
            )
        return self._observation_and_info(episode)

    def step(self, action: object) -> tuple[object, float, bool, bool, dict[str, object]]:
        """Advance one step; return observation, reward, whether the episode terminated or is truncated, and info."""
        episode, stage = self._episode, self._running
        if episode is None or stage is None or episode.result is not None:
            raise SimulatorError("no episode is running", fix="call reset")
        # A wrong action is an error of the caller, so it does not end the episode.
        encoded = stage.simulator.actions[stage.agent].encode(action)
        result = _advance(episode, {stage.agent: encoded})
        if result is not None and result.outcome.is_software_fault:
            raise episode.error or SimulatorError(str(result.outcome))
        observation, info = self._observation_and_info(episode)
        is_over = bool(episode.terminations.get(stage.agent))
        reward = float(episode.rewards.get(stage.agent, 0.0))
        if result is None:
            return observation, reward, is_over, False, info
        info["outcome"] = str(result.outcome)
        has_crashed = info["has_crashed"] = result.outcome in stage.settings.crash_on
        terminated = has_crashed or is_over or result.outcome == Outcome.FINISHED
        if not has_crashed and supports(stage.simulator, ReportsTruncation) and stage.simulator.was_truncated:
            terminated = False  # a learner expects further rewards after a time limit
        return observation, reward, terminated, not terminated, info

    def close(self) -> None:
        """End the simulation and delete its files."""
        self._end_episode()
        for stage in self._stages.values():
            stage.simulator.close()
        self._folder.remove()

    def _enter(self, hunt: Path) -> _Stage:
        """Return the stage of a hunt; first end another hunt's simulation, because a process has only one of SUMO."""
        self._end_episode()
        stage = self._stages[hunt]
        if self._running is not None and self._running is not stage:
            self._running.simulator.close()
        self._running = stage
        return stage

    def _end_episode(self) -> None:
        if self._episode is not None:
            self._episode.close()
            self._episode = None

    def _begin(self, stage: _Stage, spec: TrialSpec) -> Episode:
        episode = self._episode = Episode(
            spec,
            simulator=stage.simulator,
            make_agent=stage.make_agent,
            oracles=stage.parts.oracles(),
            crash_on=stage.settings.crash_on,
        )
        episode.start()
        return episode

    def _observation_and_info(self, episode: Episode) -> tuple[object, dict[str, object]]:
        assert self._running is not None
        agent, scene = self._running.agent, episode.scene
        assert scene is not None
        observation: object = episode.observations[agent]
        restore = observation_restorers(self._running.simulator).get(agent)
        if restore is not None:
            observation = restore(episode.observations[agent])
        return observation, {"sim_time_s": scene.time_s, "step": episode.steps}


class _Stage:
    """A hunt whose traffic can be simulated: its simulator, spaces and settings."""

    def __init__(self, bundle: Bundle, agent: str, folder: Path) -> None:
        rerun = prepare(bundle, ReplayOptions(code="current"))
        worker = rerun.worker
        scenario = worker.scenario
        self.name, self.title = Path(rerun.snapshot.settings.scenario).name, str(bundle.hunt)
        if agent and agent not in scenario.agents:
            raise UsageError(f"there is no controlled vehicle {agent!r}", fix=one_of(agent, scenario.agents))
        self.agent = agent or next(iter(scenario.agents))
        self.settings: HuntSettings = read_settings(bundle.hunt / layout.HUNT)
        self.parts = Parts(worker)
        place = folder / f"{bundle.hunt.name}-{len(list(folder.iterdir()))}"
        place.mkdir()
        self.simulator: Simulator = locate("simulators", scenario.simulator)(scenario, place)
        self._disturber: DisturbanceSampler | None = disturber(
            scenario, self.settings.disturb, tuple(self.settings.agents)
        )
        shown = self.simulator.shown_spaces if supports(self.simulator, FlattensObservations) else {}
        self.observation_space: Space[object] = shown.get(self.agent) or self.simulator.observation_spaces[self.agent]
        self.action_space: Space[object] = self.simulator.actions[self.agent].space

    def make_agent(self, agent: str, simulator: Simulator, arguments: Mapping[str, Value]) -> Agent:
        """Return the agent of a vehicle; for the caller's own vehicle, an agent whose actions are never used."""
        return _Caller() if agent == self.agent else self.parts.agent(agent, simulator, arguments)

    def plain_spec(self, seed: int, max_steps: int) -> TrialSpec:
        """Return a trial of the hunt with another seed; its arguments are drawn independently of other trials."""
        rng = np.random.default_rng(np.random.SeedSequence(seed))
        arguments: dict[str, dict[str, Value]] = {agent: {} for agent in self.settings.agents}
        scenario_arguments: dict[str, Value] = {}
        for (agent, name), distribution in sorted(self.settings.space.items()):
            (arguments[agent] if agent else scenario_arguments)[name] = distribution.sample(rng)
        steps = max_steps or self.settings.max_steps
        return TrialSpec(
            number=0,
            seed=seed,
            arguments=arguments,
            scenario_arguments=scenario_arguments,
            max_steps=steps,
            disturbances=self._disturber.draw(seed, steps) if self._disturber is not None else (),
        )


class _Caller:
    """The place of the caller's agent in an episode. `Episode.step` receives the actions from the caller instead."""

    def reset(self, seed: int) -> None:
        """Do nothing, because this agent has no state."""

    def act(self, observation: object) -> object:
        """Raise an error, because this method is never called."""
        raise AssertionError


def _require_same(first: _Stage, other: _Stage) -> None:
    """Refuse crashes on which one policy cannot be trained together.

    Raises:
        UsageError: The crashes have different scenarios or spaces.
    """
    where = f"{first.title} and {other.title}"
    if first.name != other.name:
        raise UsageError(
            f"the crashes belong to two scenarios: {first.name!r} and {other.name!r} ({where})",
            fix="give crashes of one scenario",
        )
    for what in ("observation_space", "action_space"):
        mine, theirs = getattr(first, what), getattr(other, what)
        if mine != theirs:
            raise UsageError(
                f"the {what.replace('_', ' ')}s differ: {' '.join(str(mine).split())} and "
                f"{' '.join(str(theirs).split())} ({where})",
                fix="give crashes of hunts with the same configuration and --action",
            )


@dataclass(frozen=True, slots=True)
class _Start:
    """The recorded steps up to the step at which the caller takes over."""

    spec: TrialSpec  # the trial of the crash
    crash_step: int  # the number of the step of the crash
    actions: tuple[NDArray[np.generic], ...]  # the encoded actions of the caller's vehicle in the recorded steps
    # the digest of the caller's observation in each step; empty if the recording has no observations
    observations: tuple[bytes, ...]
    # for the start and each step, the recorded actors and the digest of their states
    scenes: tuple[tuple[tuple[str, ...], bytes], ...]
    is_compact: bool  # whether the recording contains only some of the actors

    @classmethod
    def of(cls, rerun: Rerun, agent: str, before_s: float) -> _Start:
        """Read the recorded steps from the recording of a crash."""
        recorded: Recording = rerun.recorded
        last = max(0, recorded.steps - max(1, round(before_s / recorded.prologue.step_length_s)))
        steps = recorded.all_steps[1 : last + 1]
        has_observations = recorded.compact is None or recorded.compact.observations
        return cls(
            spec=rerun.spec,
            crash_step=recorded.steps,
            actions=tuple(step.actions[agent] for step in steps),
            observations=tuple(_digest(step.observations[agent]) for step in steps) if has_observations else (),
            scenes=tuple(_state(recorded.scene(number)) for number in range(last + 1)),
            is_compact=recorded.compact is not None,
        )

    def repeat(self, episode: Episode, agent: str) -> str:
        """Repeat the recorded steps; return a description of where they differ from the recording, or an empty text."""
        if episode.result is not None:
            return f"the episode cannot be set up ({episode.result.outcome})"
        for step, action in enumerate((None, *self.actions)):
            if action is not None:
                if self.observations and _digest(episode.observations[agent]) != self.observations[step - 1]:
                    return f"the observation of step {step} differs from the recording"
                if _advance(episode, {agent: action}) is not None:
                    return f"the episode ends at step {step}, before the recorded crash"
            actors, state = self.scenes[step]
            assert episode.scene is not None
            if _state(episode.scene, actors if self.is_compact else ()) != (actors, state):
                return f"the scene of step {step} differs from the recording"
        return ""


def _state(scene: Scene, actors: Sequence[str] = ()) -> tuple[tuple[str, ...], bytes]:
    """Return actors of a scene and the digest of their positions, headings and speeds; by default, of all actors."""
    rows = scene.roster.index
    present = tuple(actor for actor in actors or rows if actor in rows)
    return present, _digest(scene.data[[rows[actor] for actor in present]])


def _digest(array: NDArray[np.generic]) -> bytes:
    return hashlib.blake2b(np.ascontiguousarray(array).tobytes(), digest_size=_DIGEST_BYTES).digest()


def _advance(episode: Episode, actions: Mapping[str, NDArray[np.generic]]) -> TrialResult | None:
    reseeding = episode.spec.reseeding
    seed = reseeding.seed_after(episode.steps) if reseeding is not None else None
    if seed is not None and episode.reseed(seed) is not None:
        return episode.result
    return episode.step(actions)


@contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """Return a context that seeds the process's random generators as a trial does, and later restores their state.

    A scenario may use the process's random generators. The caller's training uses these generators as well, and must
    not get the same numbers in each episode.
    """
    states = random.getstate(), np.random.get_state()  # noqa: NPY002 - scenarios may use the global generator
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    try:
        yield
    finally:
        random.setstate(states[0])
        np.random.set_state(states[1])  # noqa: NPY002
