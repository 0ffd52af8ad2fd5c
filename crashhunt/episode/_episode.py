"""One episode: the only place where agent, simulator, oracle and recorder meet."""

from __future__ import annotations

import itertools
import random
import sys
import time
import traceback
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from crashhunt.base.errors import ActionError, EpisodeError, InvalidEpisodeError, RecorderError, SimulatorError
from crashhunt.oracles import Finding, Oracle, TrafficEvents, merge_findings
from crashhunt.recording import (
    AgentChannel,
    BlackBox,
    Phase,
    Prologue,
    Tag,
    digest_of,
    encode_actors,
    encode_events,
    encode_heights,
    encode_notes,
    encode_spines,
)
from crashhunt.trial import CRASHES, Failure, Outcome, TrialResult, TrialSpec
from crashhunt.world import ApproachMeter

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from crashhunt.agents import Agent
    from crashhunt.simulators import Simulator
    from crashhunt.world import Actor, Roster, Scene

__all__ = ["run_episode", "seed_everything", "words_of"]


_MEASURE_EVERY = 256
"""Steps; how near to a crash it was is measured over many at a time, which costs a tenth of one at a time."""


@dataclass(slots=True)
class _Scribe:
    """Turns what happens into records."""

    box: BlackBox
    numbers: dict[Actor, int] = field(default_factory=dict)
    roster: Roster | None = None
    events: Counter[str] = field(default_factory=Counter)

    def begin(self, simulator: Simulator) -> tuple[str, ...]:
        """Record who takes part; return the agents in the order of their numbers."""
        agents = tuple(simulator.agents)
        channels = []
        for agent in agents:
            space, form = simulator.observation_spaces[agent], simulator.actions[agent]
            sample = form.encode(_any_action(form.space))
            channels.append(
                AgentChannel(
                    agent,
                    np.dtype(space.dtype).str,
                    tuple(space.shape or ()),
                    sample.dtype.str,
                    sample.shape,
                    tuple(form.names),
                    tuple(getattr(simulator, "observation_names", ())),
                )
            )
        self.box.prologue(Prologue(tuple(channels), simulator.step_length_s).encode(), len(agents))
        return agents

    def scene(self, step: int, scene: Scene, rewards: tuple[float, ...]) -> None:
        """Record a scene, and before it whatever is new about it."""
        if scene.roster is not self.roster:
            fresh = [actor for actor in scene.roster.actors if actor not in self.numbers]
            if fresh:
                self.numbers.update(zip(fresh, itertools.count(len(self.numbers)), strict=False))
                self.box.append(Tag.ACTORS, 0, encode_actors(fresh))
            numbers = np.array([self.numbers[actor] for actor in scene.roster.actors], "<u4")
            self.box.append(Tag.ROSTER, 0, numbers.tobytes())
            self.roster = scene.roster
        if scene.lanes:
            self.box.append(Tag.LANES, 0, "\n".join(scene.lanes).encode())
        if scene.contacts or scene.off_road:
            self.box.append(Tag.EVENTS, 0, encode_events(scene))
        if scene.heights:
            self.box.append(Tag.HEIGHTS, 0, encode_heights(scene))
        if scene.spines:
            self.box.append(Tag.SPINES, 0, encode_spines(scene))
        if scene.events:
            self.box.note(encode_notes(scene.events))
            self.events.update([event.kind for event in scene.events])
        self.box.step(step, scene, rewards)


def run_episode(
    spec: TrialSpec,
    *,
    simulator: Simulator,
    make_agent: Callable[[str, Simulator, Mapping[str, Any]], Agent],
    box: BlackBox,
    oracles: Sequence[Oracle],
    crash_on: Sequence[Outcome] = CRASHES,
) -> TrialResult:
    """Run one trial from its specification.

    Args:
        spec: which trial.
        simulator: where.
        make_agent: called with agent id, simulator and arguments; returns the agent at the wheel.
        box: what records it; `BlackBox.begin` has been called.
        oracles: what decides whether a step is a crash.
        crash_on: what ends the episode; a traffic crash or event of another kind is recorded, and the episode goes on.

    Returns:
        The result. Whatever agent or simulator raise is in it.

    Raises:
        RecorderError: the disk is full.
    """
    began = time.monotonic()
    setup_s = 0.0
    seed_everything(spec.seed)
    agents: dict[str, Agent] = {}
    if any(outcome.is_traffic_event for outcome in crash_on):
        oracles = [*oracles, TrafficEvents()]
    run = _Run(spec, simulator, box, tuple(oracles), frozenset(crash_on))
    try:
        result = run.set_up(make_agent, agents)
        setup_s = time.monotonic() - began
        if result is None:
            result = run.drive(agents)
        result = run.finish(result)
    except RecorderError:
        raise
    except BaseException as error:  # of an oracle, or of what the agent has damaged, such as our own files
        result = run.failed(error)
    finally:
        for agent in agents.values():
            _quietly(agent)
    return replace(result, setup_s=setup_s, wall_s=time.monotonic() - began)


def seed_everything(seed: int) -> None:
    """Seed the generators of the process: `random`, `numpy.random`, and torch where it has been imported."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - agents may use the global generator
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.manual_seed(seed)


class _Run:
    def __init__(
        self,
        spec: TrialSpec,
        simulator: Simulator,
        box: BlackBox,
        oracles: tuple[Oracle, ...],
        crash_on: frozenset[Outcome],
    ) -> None:
        self.spec = spec
        self.simulator = simulator
        self.box = box
        self.oracles = oracles
        self.crash_on = crash_on
        self.scribe = _Scribe(box)
        self.meter = ApproachMeter(())
        self.names: tuple[str, ...] = ()
        self.observations: dict[str, Any] = {}
        self.step = 0

    def set_up(
        self, make_agent: Callable[[str, Simulator, Mapping[str, Any]], Agent], agents: dict[str, Agent]
    ) -> TrialResult | None:
        """Begin the episode; return a result where that fails."""
        agent = ""
        try:
            options = {"arguments": self.spec.scenario_arguments}
            self.observations, _ = self.simulator.reset(seed=self.spec.seed, options=options)
            self.names = self.scribe.begin(self.simulator)
            self.meter = ApproachMeter(self.names)
            for number, agent in enumerate(self.names):
                agents[agent] = make_agent(agent, self.simulator, self.spec.arguments.get(agent, {}))
                agents[agent].reset(_agent_seed(self.spec.seed, number))
            agent = ""
            scene = self.simulator.scene()
            self.scribe.scene(0, scene, (0.0,) * len(self.names))
        except RecorderError:
            raise
        except BaseException as error:
            return self._result(Outcome.INVALID, failure=_failure(error, agent))
        finding = self._check(scene)
        if finding is not None:
            hit = finding.collision
            what = f"{hit.collider} and {hit.victim} overlap" if hit else finding.event.what if finding.event else ""
            failure = Failure("invalid", f"{what} before the first step")
            return self._result(Outcome.INVALID, collision=hit, failure=failure)
        return None

    def drive(self, agents: dict[str, Agent]) -> TrialResult:
        """Step until something ends the episode."""
        simulator, box, scribe, names = self.simulator, self.box, self.scribe, self.names
        forms = [simulator.actions[name].encode for name in names]
        restored = {name: _restorer(space) for name, space in getattr(simulator, "shown_spaces", {}).items()}
        observations = self.observations
        everybody = tuple(range(len(names)))
        active = everybody
        before = simulator.scene()
        for step in range(1, self.spec.max_steps + 1):
            actions: dict[str, Any] = {}
            for number in active:
                name = names[number]
                observation = observations[name]
                box.observation(number, observation)
                try:
                    if name in restored:
                        observation = restored[name](observation)
                    action = forms[number](agents[name].act(observation))
                except BaseException as error:
                    return self._result(Outcome.AGENT_ERROR, failure=_failure(error, name))
                box.action(number, action)
                actions[name] = action
            try:
                observations, rewards, terminations, truncations, _ = simulator.step(actions)
                scene = simulator.scene()
                scene.follow(before)
                before = scene
            except RecorderError:
                raise
            except BaseException as error:  # an environment of a user's may exit as well as an agent
                return self._result(Outcome.SIMULATOR_ERROR, failure=_failure(error, ""))
            scribe.scene(step, scene, tuple([rewards.get(name, 0.0) for name in names]))
            self.step = step
            if step % _MEASURE_EVERY == 0:
                self.meter.measure(box.take_frames())
            finding = self._check(scene)
            if finding is not None:
                return self._result(finding.outcome, collision=finding.collision, event=finding.event)
            if len(simulator.agents) != len(active) or True in truncations.values():
                present = set(simulator.agents)
                active = tuple(number for number in everybody if names[number] in present)
                if not active or all(terminations.get(name) or truncations.get(name) for name in actions):
                    return self._result(Outcome.FINISHED)
        return self._result(Outcome.SURVIVED)

    def finish(self, result: TrialResult) -> TrialResult:
        """Add what is measured over the whole recording."""
        self.meter.measure(self.box.take_frames())
        self.box.mark(Phase.DONE)
        digest = digest_of(*self.box.evidence()) if result.outcome is not Outcome.INVALID else ""
        closest = self.meter.closest
        if result.collision is not None and "overlap" in result.collision.seen_by:
            closest = replace(closest, gap_m=0.0, time_to_collision_s=0.0)  # perhaps between two scenes
        events = dict(self.scribe.events) if hasattr(self.simulator, "told_events") else None
        return replace(result, digest=digest, closest=closest, events=events)

    def failed(self, error: BaseException) -> TrialResult:
        """What comes of an episode that could not go on, and neither agent nor simulator said why."""
        outcome = Outcome.AGENT_ERROR if isinstance(error, OSError | MemoryError) else Outcome.SIMULATOR_ERROR
        result = TrialResult(self.spec, outcome, steps=self.step, failure=_failure(error, ""))
        try:
            return self.finish(result)
        except BaseException:
            return result

    def _check(self, scene: Scene) -> Finding | None:
        findings: list[Finding] = []
        for oracle in self.oracles:
            findings += oracle.check(scene, self.names)
        if not findings:
            return None
        return merge_findings([finding for finding in findings if finding.outcome in self.crash_on])

    def _result(self, outcome: Outcome, **evidence: Any) -> TrialResult:
        scene_time = 0.0
        if self.scribe.roster is not None:
            scene_time = self.simulator.scene().time_s
        return TrialResult(self.spec, outcome, steps=self.step, sim_time_s=scene_time, **evidence)


def _agent_seed(seed: int, number: int) -> int:
    """A seed of each agent's own, which differs from the simulator's."""
    return int(np.random.SeedSequence(seed, spawn_key=(number,)).generate_state(1)[0]) >> 1


def _restorer(space: Any) -> Callable[[Any], Any]:
    """What makes a Dict or Tuple observation again of the flattened array, which is recorded."""
    from gymnasium.spaces import unflatten

    return partial(unflatten, space)


def _any_action(space: Any) -> Any:
    # Only the shape and type of the encoded action matter.
    space.seed(0)
    return space.sample()


def _failure(error: BaseException, agent: str) -> Failure:
    # A message of our own says everything; where in our code it was raised is nobody's business.
    text = "" if isinstance(error, InvalidEpisodeError) else "".join(traceback.format_exception(error))
    message = words_of(error) if isinstance(error, EpisodeError) else " ".join(words_of(error).split())
    kinds: dict[type[BaseException], str] = {
        ActionError: "bad action",
        InvalidEpisodeError: "invalid",
        SimulatorError: "simulator error",
    }
    return Failure(kinds.get(type(error), type(error).__name__), message, text, agent)


def words_of(error: BaseException) -> str:
    """Return the message of an exception, which may be of a class that cannot even say it."""
    try:
        return str(error)
    except BaseException as other:  # in a ``__str__`` of somebody else's
        return f"(its message cannot be had: {type(other).__name__})"


def _quietly(agent: Agent) -> None:
    """Close an agent; whatever comes of that, the episode is over."""
    try:
        close = getattr(agent, "close", None)
        if close is not None:
            close()
    except BaseException:
        with suppress(BaseException):
            traceback.print_exc()
