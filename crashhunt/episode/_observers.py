"""Observers of an episode: their protocol, their registration, and the two observers of every trial.

The first measures the criticality of the episode, and the second records the episode in the black box.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np

from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.base.foreign_code import supports
from crashhunt.recording import (
    AgentChannel,
    BlackBox,
    ObservedPart,
    Phase,
    Prologue,
    Tag,
    digest_of,
    encode_actors,
    encode_disturbance,
    encode_events,
    encode_heights,
    encode_notes,
    encode_roster,
    encode_spines,
)
from crashhunt.simulators import (
    FlattensObservations,
    KnowsEncodedType,
    NamesMetaActions,
    NamesObservations,
    ObservesParts,
    OfAnyLength,
    ReportsCrashCell,
    ReportsDanger,
    ReportsEvents,
    ReportsLights,
    RestoresObservations,
    SupportsExclusion,
    SupportsScripts,
)
from crashhunt.trial import STRENGTH_MARK, Outcome
from crashhunt.world import ApproachMeter, DangerMeter, DrivenMeter

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from crashhunt.agents import Agent
    from crashhunt.native import UsualSteps
    from crashhunt.simulators import ActionForm, Options, Simulator
    from crashhunt.trial import Disturbance, TrialResult, TrialSpec
    from crashhunt.world import Actor, ClosestApproach, Frame, Roster, Scene


# Observers of a running episode, which never change it.


class ObservedEpisode(Protocol):
    """The part of an `Episode` that its observers may use."""

    spec: TrialSpec
    simulator: Simulator
    names: tuple[str, ...]
    agents: dict[str, Agent]
    steps: int
    setup_steps: int | None


class Observer:
    """Observes an episode; override the hooks that you need. Hooks that are not overridden cost nothing.

    Observers are called in their order, and at the end in reverse order. An exception of an observer ends the episode,
    like every error that is neither the agent's nor the simulator's.
    """

    def begin(self, episode: ObservedEpisode) -> None:
        """Called after the simulator's reset, when `Episode.names` contains all actors and no agent exists yet."""

    def making(self, number: int) -> None:
        """Called before an agent is created and reset.

        Args:
            number: number of the agent in `Episode.names`; -1 after all agents have been created.
        """

    def observation(self, number: int, observation: NDArray[np.generic]) -> None:
        """Called before an agent receives an observation.

        Args:
            number: number of the agent, in `Episode.names`.
            observation: the observation in its recorded form; a structured observation is flattened.
        """

    def action(self, number: int, action: NDArray[np.generic]) -> None:
        """Called after an agent has acted.

        Args:
            number: number of the agent, in `Episode.names`.
            action: the encoded action.
        """

    def disturbance(self, disturbance: Disturbance) -> None:
        """Called for a disturbance that takes place, before the step in which it begins or the step after.

        Args:
            disturbance: the disturbance with its target vehicle; the vehicle is empty if there is no target.
        """

    def scene(self, step: int, scene: Scene, rewards: tuple[float, ...]) -> None:
        """Called when a step is complete.

        Args:
            step: number of the step; 0 for the scene before the first step.
            scene: scene after the step.
            rewards: reward of every agent, in the order of `Episode.names`; 0 if the agent did not act.
        """

    def copied(self) -> None:
        """Called in a fork of the process in which the episode runs. The fork must not affect the original."""

    def end(self, result: TrialResult) -> TrialResult:
        """Called at the end of the episode; returns the result with the data of this observer added.

        If an observer fails at the end, this method is called again with another result.
        """
        return result


# What connects an episode with those who take part, and with those who look on.


def options_of(spec: TrialSpec, simulator: Simulator) -> Options:
    """Return the options for the simulator's reset.

    Raises:
        InvalidEpisodeError: the simulator does not support an option.
    """
    arguments = spec.scenario_arguments
    if any(STRENGTH_MARK in name for name in arguments):  # which concern the injector of disturbances only
        arguments = {name: value for name, value in arguments.items() if STRENGTH_MARK not in name}
    options: Options = {"arguments": arguments}
    if spec.only is not None:
        if not supports(simulator, SupportsExclusion):
            raise InvalidEpisodeError("the simulator cannot remove actors")
        options["only"] = spec.only
    if spec.script is not None:
        if not supports(simulator, SupportsScripts):
            raise InvalidEpisodeError("the simulator cannot move actors along recorded paths")
        options["script"] = spec.script
    return options


def agent_seed(seed: int, number: int) -> int:
    """Return the seed of an agent, which differs from the simulator's seed."""
    return int(np.random.SeedSequence(seed, spawn_key=(number,)).generate_state(1)[0]) >> 1


def observation_restorers(simulator: Simulator) -> dict[str, Callable[[NDArray[np.generic]], object]]:
    """Return for each agent the function that restores a structured observation from its recorded array."""
    if not supports(simulator, FlattensObservations):
        return {}
    if supports(simulator, RestoresObservations):
        return {name: partial(simulator.restore_observation, name) for name in simulator.shown_spaces}
    from gymnasium.spaces import unflatten

    return {name: partial(unflatten, space) for name, space in simulator.shown_spaces.items()}


def callbacks_for(observers: Sequence[Observer], name: str) -> Any:
    """Return the methods with the given name of all observers that override this method."""
    return [getattr(one, name) for one in observers if overrides_hook(one, name)]


def overrides_hook(observer: Observer, name: str) -> bool:
    """Return whether an observer overrides a hook."""
    return getattr(type(observer), name) is not getattr(Observer, name)


# The observer that measures how near to a crash an episode comes.

_SCENES_PER_BATCH = 2048  # scenes


class Nearness(Observer):
    """Observer that measures the closest approach, the criticality and the driven distance of a trial.

    Args:
        take_frames: function that returns the scenes since its last call as columns, such as `BlackBox.take_frames`.
    """

    EVERY: ClassVar = 256
    """Steps; scenes are taken in many at a time, which costs a tenth of one at a time."""

    def __init__(self, take_frames: Callable[[], Sequence[Frame]]) -> None:
        self._take_frames = take_frames
        self._meter = ApproachMeter(())
        self._dangers = DangerMeter((), 1.0)
        self._driven = DrivenMeter((), 1.0)
        self._simulator: object = None
        self._waiting: list[Frame] = []  # for the closest approach, of which so many at a time cost least

    @property
    def closest(self) -> ClosestApproach:
        """The closest approach until the last complete step."""
        self._measure_frames()
        self._measure()
        return self._meter.closest

    def begin(self, episode: ObservedEpisode) -> None:
        """Register the controlled vehicles."""
        self._meter = ApproachMeter(episode.names)
        self._simulator = episode.simulator
        self._dangers = DangerMeter(episode.names, episode.simulator.step_length_s)
        self._driven = DrivenMeter(episode.names, episode.simulator.step_length_s)

    def scene(self, step: int, scene: Scene, rewards: tuple[float, ...]) -> None:
        """Measure the scenes since the last measurement, in one batch after every few steps."""
        if step and step % self.EVERY == 0:
            self._measure_frames()
            if sum(len(frame.columns) for frame in self._waiting) >= _SCENES_PER_BATCH:
                self._measure()

    def end(self, result: TrialResult) -> TrialResult:
        """Add the closest approach, the criticality and the driven distance to the result."""
        closest = self.closest
        if result.collision is not None and "overlap" in result.collision.seen_by:
            closest = replace(closest, gap_m=0.0, time_to_collision_s=0.0)  # perhaps between two scenes
        if result.outcome is Outcome.INVALID:
            return replace(result, closest=closest)
        touched = result.outcome.is_traffic_crash or closest.gap_m <= 0.0
        danger = 1.0 if touched else self._dangers.danger
        # Asked at the end: before the first step it names none, which counts as one that never does.
        if danger is None and supports(self._simulator, ReportsDanger):
            named = self._simulator.named_danger
            danger = None if named is None or math.isnan(named) else min(max(named, 0.0), 1.0)
        collision = result.collision
        if collision is not None and supports(self._simulator, ReportsCrashCell):
            result = replace(result, collision=replace(collision, cell=self._simulator.crash_cell))
        driven = self._driven
        return replace(
            result, closest=closest, danger=danger, driven_m=driven.driven_m, driven_s=driven.driven_s,
            step_length_s=driven.step_length_s,
        )  # fmt: skip

    def _measure_frames(self) -> None:
        frames = self._take_frames()
        self._waiting += frames
        self._dangers.add(frames)
        self._driven.add(frames)

    def _measure(self) -> None:
        waiting, self._waiting = self._waiting, []
        self._meter.measure(waiting)


# The observer that records an episode in the black box.


class Recorder(Observer):
    """Observer that records an episode; it adds the digest and the number of traffic events to the result.

    The recorder is the first observer, because a step is complete only after it is recorded.
    """

    def __init__(self, box: BlackBox, simulator: Simulator) -> None:
        self._box = box
        self.numbers: dict[Actor, int] = {}  # the numbers of the actors that are recorded
        self._same: dict[int, int] = {}
        self._kept: list[Actor] = []
        # Without detection of events, a count of 0 would be misleading.
        self._events: Counter[str] | None = Counter() if supports(simulator, ReportsEvents) else None
        # Called in every step: without a call in between.
        self.observation = box.observation  # type: ignore[assignment, method-assign]
        self.action = box.action  # type: ignore[assignment, method-assign]

    def lend(self, steps: UsualSteps, roster: Roster, records: tuple[bytes, bytes] | None = None) -> None:
        """Let the compiled core write the recording of its steps directly, for the given actors.

        Args:
            steps: steps of the core.
            roster: the actors.
            records: the payloads of the records of actors and roster; None if there are none yet.
        """
        records = records or self._introduce(roster.actors)
        if roster is not self._box.roster:
            self._note_actors(*records)
        self._box.lend(steps, roster, records[1])

    def begin(self, episode: ObservedEpisode) -> None:
        """Record the actors of the episode."""
        simulator = episode.simulator
        columns = tuple(simulator.observation_names) if supports(simulator, NamesObservations) else ()
        layouts = simulator.observation_layouts if supports(simulator, ObservesParts) else {}
        channels = []
        for agent in episode.names:
            space, form = simulator.observation_spaces[agent], simulator.actions[agent]
            shown = np.dtype(space.dtype).str, tuple(space.shape or ())
            parts = tuple(
                ObservedPart(name, layouts[agent].shapes[name], tuple(column.name for column in one.part.columns))
                for name, one in (layouts[agent].parts.items() if agent in layouts else ())
            )
            names = () if parts else columns
            channels.append(AgentChannel(agent, *shown, *_type_of(form), tuple(form.names), names, parts))
        self._box.set_up(episode.setup_steps or 0)
        prologue = Prologue(tuple(channels), simulator.step_length_s, episode.spec.digest_of_changes)
        self._box.prologue(prologue.encode(), len(channels))

    def making(self, number: int) -> None:
        """Record which agent is being created, because its constructor may end the process."""
        self._box.mark(Phase.SETUP if number < 0 else Phase.ACT, max(number, 0))

    def observation(self, number: int, observation: NDArray[np.generic]) -> None:
        """Record the observation that an agent is about to receive."""
        self._box.observation(number, observation)

    def action(self, number: int, action: NDArray[np.generic]) -> None:
        """Record the action of an agent."""
        self._box.action(number, action)

    def disturbance(self, disturbance: Disturbance) -> None:
        """Record a disturbance and its target vehicle."""
        self._box.append(Tag.DISTURBANCE, 0, encode_disturbance(disturbance))

    def scene(self, step: int, scene: Scene, rewards: tuple[float, ...]) -> None:
        """Record a scene, and before it any changes of actors and lanes."""
        if scene.roster is not self._box.roster:
            self._note_actors(*self._introduce(scene.roster.actors))
        if scene.lanes:
            self._box.append(Tag.LANES, 0, "\n".join(scene.lanes).encode())
        if scene.contacts or scene.off_road:
            self._box.append(Tag.EVENTS, 0, encode_events(scene))
        if scene.heights:
            self._box.append(Tag.HEIGHTS, 0, encode_heights(scene))
        if scene.spines:
            self._box.append(Tag.SPINES, 0, encode_spines(scene))
        if scene.events:
            self._box.note(encode_notes(scene.events))
            if self._events is not None:
                self._events.update([event.kind for event in scene.events])
        self._box.step(step, scene, rewards)

    def _introduce(self, actors: Sequence[Actor]) -> tuple[bytes, bytes]:
        """Return the payloads of two records: of those actors that are not recorded yet, and of a roster of all.

        The first must be written next. It is empty if all actors have been recorded.
        """
        # Most are the same objects as before: to look for an equal one takes longer than all else about a roster.
        fresh, known, same = [], self.numbers, self._same
        numbers: list[Any] = [*map(same.get, map(id, actors))]
        for row, actor in enumerate(actors) if None in numbers else ():
            if numbers[row] is None:
                free = len(known)
                numbers[row] = same[id(actor)] = known.setdefault(actor, free)
                self._kept.append(actor)  # so that no other actor gets its id()
                if len(known) > free:
                    fresh.append(actor)
        return encode_actors(fresh) if fresh else b"", encode_roster(numbers)

    def _note_actors(self, introduction: bytes, numbers: bytes) -> None:
        if introduction:
            self._box.append(Tag.ACTORS, 0, introduction)
        self._box.append(Tag.ROSTER, 0, numbers)

    def copied(self) -> None:
        """Continue recording in a private copy."""
        self._box.copy()

    def end(self, result: TrialResult) -> TrialResult:
        """Record the end of the episode, and add the digest of the recording to the result."""
        self._box.mark(Phase.DONE)
        digest = ""
        if result.outcome is not Outcome.INVALID:
            of_changes = result.spec.digest_of_changes
            digest = digest_of(self._box.evidence(), of_changes=of_changes, core=self._box.core)
        return replace(result, digest=digest, events=None if self._events is None else dict(self._events))


# The observer that reads lights and routes, in the replay that confirms a crash.

_MAX_LIGHT_STEPS = 6000  # the last steps, of which lights and routes are kept
_NOT_KEPT = ("present", "goal_x", "goal_y")  # columns that no sentence needs
_ROUTE_EVERY = 5  # steps; a route changes little in between


class LightRecorder(Observer):
    """Observer that keeps what a simulator reports of traffic lights, the lights of vehicles, routes, and actions."""

    def __init__(self) -> None:
        self._simulator: ReportsLights | None = None
        self._actions: dict[str, list[str]] = {}
        self._signals: dict[str, list[tuple[int, str]]] = {}
        self._vehicles: dict[str, list[tuple[int, int, int]]] = {}
        self._parts: dict[str, deque[tuple[int, object]]] = {}
        self._routes: dict[str, deque[tuple[int, list[float]]]] = {}

    def begin(self, episode: ObservedEpisode) -> None:
        """Keep the simulator, and the names of discrete actions, of which the recording has the numbers only."""
        self._simulator = episode.simulator if supports(episode.simulator, ReportsLights) else None
        for agent, form in episode.simulator.actions.items():
            if supports(form.space, NamesMetaActions):
                self._actions[agent] = [str(name) for name in form.space.meanings]

    def scene(self, step: int, scene: Scene, rewards: tuple[float, ...]) -> None:
        """Read the lights and routes of a step."""
        if self._simulator is None:
            return
        try:
            found = self._simulator.lights()
        except Exception:  # a picture with less in it is better than a crash that is not confirmed
            self._simulator = None
            return
        for lane, colours in found.signals.items():
            changes = self._signals.setdefault(lane, [])
            if not changes or changes[-1][1] != colours:
                changes.append((step, colours))
        for vehicle, lit in found.vehicles.items():
            shown = self._vehicles.setdefault(vehicle, [])
            if shown[-1][1:] != lit if shown else any(lit):
                shown.append((step, *lit))
        for agent, parts in found.parts.items():
            rounded = {
                name: [{key: round(value, 1) for key, value in row.items() if key not in _NOT_KEPT} for row in rows[:1]]
                for name, rows in parts.items()
            }
            self._parts.setdefault(agent, deque(maxlen=_MAX_LIGHT_STEPS)).append((step, rounded))
        for agent, points in found.routes.items() if step % _ROUTE_EVERY == 0 else ():
            flat = [round(value, 1) for point in points for value in point]
            self._routes.setdefault(agent, deque(maxlen=_MAX_LIGHT_STEPS // _ROUTE_EVERY)).append((step, flat))

    def data(self) -> dict[str, object] | None:
        """Return everything that was read, as JSON; None if the simulator reports nothing."""
        if self._simulator is None or not (self._signals or self._vehicles or self._parts):
            return {"actions": self._actions} if self._actions else None
        return {
            **({"actions": self._actions} if self._actions else {}),
            "signals": self._signals,
            "vehicles": self._vehicles,
            "parts": {agent: list(steps) for agent, steps in self._parts.items()},
            "routes": {agent: list(steps) for agent, steps in self._routes.items()},
        }


_ready: dict[int, tuple[ActionForm, NDArray[np.generic]]] = {}  # by identity, which holds as long as the form is here


def ready_recorder(simulator: Simulator) -> None:
    """Encode an action of each agent before the first episode, so that its recorder starts faster.

    Seeding a space takes longer than many steps. A fork inherits the random generators of the spaces in their state
    after this call, so an agent that samples from its action space gets the same samples. Call this function only for
    simulators whose `reset` does not use these generators.
    """
    for form in simulator.actions.values():
        if supports(form, OfAnyLength) or supports(form, KnowsEncodedType):
            continue
        _ready[id(form)] = form, _encode_any(form)


def _type_of(form: ActionForm) -> tuple[str, tuple[int, ...]]:
    """Return the type and the shape of encoded actions, as in `AgentChannel`."""
    if supports(form, OfAnyLength):
        return "|u1", tuple(form.encoded_shape)
    if supports(form, KnowsEncodedType):
        return form.encoded_type
    sample = _sample_of(form)
    return sample.dtype.str, sample.shape


def _sample_of(form: ActionForm) -> NDArray[np.generic]:
    ready = _ready.pop(id(form), None)  # for one episode: afterwards an agent may have sampled from the space
    return _encode_any(form) if ready is None else ready[1]


def _encode_any(form: ActionForm) -> NDArray[np.generic]:
    # Only the shape and type of the encoded action matter.
    form.space.seed(0)
    return form.encode(form.space.sample())
