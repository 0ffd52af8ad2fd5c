"""Finds the causes of a crash: reruns its trial without one candidate cause at a time.

A manoeuvre is suppressed from just before its beginning. Up to that step, every run must be bit-identical to the
recording, or its result does not count. Arguments and seeds affect the whole trial, so other values change the traffic
from the beginning. The runs and their order do not depend on the number of runs at a time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.analysis._delta_debugging import with_argument
from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError, RecorderError
from crashhunt.crashes import INTERRUPTED, Factor, LaneMap, LeftOut, Why, changes_of, partner, signature_of_fault
from crashhunt.plans import read_settings
from crashhunt.recording import has_same_scenes, read_lanes
from crashhunt.trial import Choice, Constant, Disturbance, Outcome, Overruled
from crashhunt.trial_reruns import EndedRun, Reruns, StoppedError
from crashhunt.world import first_contact

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from crashhunt.crashes import Without
    from crashhunt.recording import Recording
    from crashhunt.replays import Rerun
    from crashhunt.trial import Distribution, TrialResult, TrialSpec, Value
    from crashhunt.world import Scene


# What agent and others did before a collision that it may hang on: braking, speeding up, changing lanes.

_BEFORE_S = 10.0  # manoeuvres longer before the collision are not examined
_NEAR_S, _NEAR_M = 5.0, 60.0  # who is further away than that is not asked about
_BRAKES, _SPEEDS_UP = -1.5, 1.0  # m/s²; less is driving along
_ONSET_ACCELERATION_MPS2 = 0.3  # m/s²; from here on, it belongs to what follows
_PAUSE_S = 0.5  # a shorter interruption does not end a manoeuvre
_MIN_SPEED_CHANGE_MPS = 1.0  # m/s in all; less makes no difference


@dataclass(frozen=True, slots=True)
class Manoeuvre:
    """A manoeuvre of an actor."""

    actor: str  # identifier of the actor
    what: str  # either ``braked``, ``sped up`` or ``changed lanes``
    step: int  # the step after which the manoeuvre began
    speed: float  # speed of the actor after this step, in m/s


def relevant_actors(recording: Recording, agent: str, other: str, most: int) -> list[str]:
    """Return the actors to examine for a crash: the collision partner, and the actors that came closest before.

    Without a collision partner, ``other`` is empty.
    """
    scenes = recording.scenes()
    since = scenes[-1].time_s - _NEAR_S if scenes else 0.0
    nearest: dict[str, float] = {}
    for scene in scenes:
        row = scene.roster.index.get(agent)
        if row is None or scene.time_s < since:
            continue
        away = np.hypot(*(scene.centers - scene.centers[row]).T)
        for actor, distance in zip(scene.roster.actors, away.tolist(), strict=True):
            if actor.id != agent and distance < min(_NEAR_M, nearest.get(actor.id, _NEAR_M)):
                nearest[actor.id] = distance
    if other:
        nearest[other] = -1.0
    return sorted((name for name in nearest if name not in recording.agents), key=lambda name: (nearest[name], name))[
        :most
    ]


def manoeuvres_of(recording: Recording, actor: str, lanes: LaneMap, end: int) -> list[Manoeuvre]:
    """Return an actor's manoeuvres in the last seconds before a step: the last manoeuvre of each type.

    The step of the collision is excluded, because a collision changes speeds.
    """
    dt = recording.prologue.step_length_s
    first = max(0, end - round(_BEFORE_S / dt))
    numbered = [
        (number, scene)
        for number, scene in enumerate(recording.scenes()[first:end], first)
        if actor in scene.roster.index
    ]
    if len(numbered) < 2:
        return []
    steps, scenes = [number for number, _ in numbered], [scene for _, scene in numbered]
    speeds = np.array([scene.speeds[scene.roster.index[actor]] for scene in scenes])
    found = []
    for what, limit in (("braked", _BRAKES), ("sped up", _SPEEDS_UP)):
        place = _onset(np.diff(speeds) / dt, limit, max(1, round(_PAUSE_S / dt)), dt)
        if place is not None:
            found.append(Manoeuvre(actor=actor, what=what, step=steps[place], speed=float(speeds[place])))
    place = _change(recording, scenes, actor, lanes)
    if place is not None:
        found.append(Manoeuvre(actor=actor, what="changed lanes", step=steps[place], speed=float(speeds[place])))
    return found


def _onset(changes: NDArray[np.float64], limit: float, pause: int, dt: float) -> int | None:
    """Return the scene after which the actor last began to brake, or to speed up; None if it never did."""
    way = 1.0 if limit > 0 else -1.0
    hard = np.flatnonzero(way * changes >= abs(limit))
    while len(hard):
        breaks = np.flatnonzero(np.diff(hard) > pause)
        begin = int(hard[breaks[-1] + 1]) if len(breaks) else int(hard[0])
        until = int(hard[-1])
        while begin > 0 and way * changes[begin - 1] >= _ONSET_ACCELERATION_MPS2:
            begin -= 1
        if abs(float(changes[begin : until + 1].sum())) * dt >= _MIN_SPEED_CHANGE_MPS:
            return begin
        hard = hard[hard < begin]
    return None


def _change(recording: Recording, scenes: Sequence[Scene], actor: str, lanes: LaneMap) -> int | None:
    if not lanes:
        return None
    if actor in recording.agents:  # with the last scene, in which it may just reach over
        after = recording.scenes()[-1]
        scenes = [*scenes, after] if actor in after.roster.index and after.time_s != scenes[-1].time_s else scenes
    place = lanes.change_began(scenes, actor)
    return None if place is None else min(place, len(scenes) - 2)


_MAX_OTHER_ACTORS = 5  # who is asked about, besides the agent
_DRAWS, _SEEDS = 8, 8
_EARLIER_S = (0.0, 0.5, 1.0)  # a manoeuvre is suppressed from these times before its beginning
_GONE_S = (3.0, 4.0, 5.0)  # an actor is removed at these times before the collision
_LONGER_S = 5.0  # simulation time past the collision, so that one that only comes later is seen
_TRAFFIC_STREAM = 0x776879  # apart from what else is drawn of a trial's seed
INCONCLUSIVE_OUTCOMES = (Outcome.INVALID, Outcome.SIMULATOR_ERROR, Outcome.PROCESS_DIED, Outcome.HANG)
_HOLD_BY_MANOEUVRE = {"braked": "keep_speed", "sped up": "keep_speed", "changed lanes": "keep_lane"}
_FACULTY_BY_MANOEUVRE = {"braked": "speed", "sped up": "speed", "changed lanes": "lane"}


@dataclass(slots=True)
class _Candidate:
    """A candidate cause, and the runs without it."""

    factor: Factor  # description of the candidate
    # the trials without the candidate, each as the changed value and the trial's specification
    runs: Sequence[tuple[Value, TrialSpec]]
    inside: bool = False  # whether the candidate is suppressed within the episode, from the given step on
    held: str = ""  # the actor whose speed is held constant in the runs; empty if there is none
    endings: dict[int, LeftOut] = field(default_factory=dict)

    @property
    def answered(self) -> Factor:
        return replace(self.factor, runs=tuple(self.endings[place] for place in sorted(self.endings)))


def find_why(rerun: Rerun, runs: Reruns, *, most: int, tell: Callable[[], None]) -> Why:
    """Return the causes of a crash.

    At most ``most`` trials run, not counting the unchanged trial. ``tell`` is called after each run.

    Raises:
        CrashhuntError: no trial can be run.
    """
    search = _Search(rerun)
    asked = search.asked()
    turns = [(one, place) for place in range(_DRAWS) for one in asked if place < len(one.runs)]
    chosen, left = turns[:most], len(turns[most:])
    why_not = ""
    try:
        (same,) = runs.run([rerun.spec], recorded=False)
        if same.result.digest != rerun.bundle.result.digest:
            return Why(steps=search.steps, left=len(turns), why_not="the trial was not the same when it was run again")
        # An older crashhunt in the snapshot supports arguments, but no holds within an episode.
        for inside in (False, True):
            batch = [(one, place) for one, place in chosen if one.inside is inside]
            try:
                for ended in runs.run([one.runs[place][1] for one, place in batch], recorded=inside):
                    one, place = batch[ended.place]
                    one.endings[place] = search.ending(one, place, ended)
                    tell()
            except RecorderError:
                raise
            except CrashhuntError as error:
                if not inside:
                    raise
                why_not = error.message
    except StoppedError:
        why_not = INTERRUPTED
    return Why(
        factors=tuple(one.answered for one in asked if one.endings), steps=search.steps, left=left, why_not=why_not
    )


def lanes_around_crash(rerun: Rerun) -> LaneMap:
    """Return the lanes around the place of a crash: of its collision, or else where its agent was last."""
    hit, agent = rerun.bundle.result.collision, rerun.bundle.driver
    place = (0.0, 0.0) if hit is None else (hit.x, hit.y)
    if hit is None:
        last = next((scene for scene in reversed(rerun.recorded.scenes()) if agent in scene.roster.index), None)
        if last is not None:
            x, y = last.points[last.roster.index[agent]]
            place = float(x), float(y)
    return LaneMap(read_lanes(rerun.bundle.path / layout.LOG), place)


class _Search:
    """The candidate causes of one crash, and the runs without each candidate."""

    def __init__(self, rerun: Rerun) -> None:
        result = rerun.bundle.result
        self._rerun, self._result, self._spec = rerun, result, rerun.spec
        self._agent, self._other = rerun.bundle.driver, partner(result)
        self._recording: Recording = rerun.recorded
        self._dt = self._recording.prologue.step_length_s
        self._end = result.steps
        longer = math.ceil(_LONGER_S / self._dt)
        self.steps = max(min(self._spec.max_steps, 2 * self._end + longer), self._end)
        self._inside = replace(self._spec, max_steps=self._end + longer)
        self._settings = read_settings(rerun.bundle.hunt / layout.HUNT)
        self._lanes = lanes_around_crash(rerun)

    def asked(self) -> list[_Candidate]:
        """Return all candidates, the most informative first."""
        found = [*self._disturbances(), *self._agents()]
        names = relevant_actors(self._recording, self._agent, self._other, _MAX_OTHER_ACTORS)
        others = {name: self._others(name) for name in names}
        found += [one for name in names for one in others[name] if one.factor.what != "there"]
        found += [*self._arguments(), *self._seeds()]
        found += [one for name in names for one in others[name] if one.factor.what == "there"]
        return [one for one in found if one.runs]

    def ending(self, asked: _Candidate, place: int, ended: EndedRun) -> LeftOut:
        """Return what happened to the collision in a run."""
        given = asked.runs[place][0]
        result, recording = ended.result, ended.recording
        if result.outcome in INCONCLUSIVE_OUTCOMES and result.outcome is not self._result.outcome:
            return LeftOut(given, "unclear")
        into = ""
        changed: tuple[str, ...] = ()
        if asked.inside:
            step = int(given)
            if recording is None or not has_same_scenes(self._recording, recording, step):
                return LeftOut(given, "unclear")
            if asked.factor.kind == "other":
                held = asked.runs[place][1].disturbances[-1]
                recorded = [(one.step, one.what, one.vehicle) for one in recording.disturbances]
                if (held.step, held.what, held.vehicle) not in recorded:
                    return LeftOut(given, "unclear")  # the simulator could not apply the hold
            into = self._into(recording, asked.held, step) if asked.held else ""
            if asked.factor.what in ("braked", "sped up") and asked.factor.kind == "agent":
                changed = changes_of(self._recording, recording, asked.factor.name, self._lanes, step)
        ending: Without = "none"
        if result.outcome not in (Outcome.SURVIVED, Outcome.FINISHED):
            hit = result.collision
            is_other_agent = hit is not None and not hit.involves(self._agent)  # its crash has ended the run
            ending = "same" if self._is_same(result) else "unclear" if is_other_agent else "other"
        return LeftOut(given=given, ending=ending, into=into, changed=changed)

    def _is_same(self, result: TrialResult) -> bool:
        """Return whether a run ended in the same crash: the same collision partner, or the same failure and place."""
        was, now = self._result.collision, result.collision
        if result.outcome is not self._result.outcome:
            return False
        if was is None or now is None:
            return was is now and signature_of_fault(result) == signature_of_fault(self._result)
        return {was.collider, was.victim} == {now.collider, now.victim}

    def _into(self, recording: Recording, held: str, step: int) -> str:
        """Return the actor that a vehicle with constant speed hit, unless this is the examined collision."""
        for scene in recording.scenes()[step + 1 :]:
            row = scene.roster.index.get(held)
            if row is None:
                return ""
            away = np.hypot(*(scene.centers - scene.centers[row]).T)
            for other in np.flatnonzero(away < scene.roster.touch_distance).tolist():
                name = scene.roster.actors[other].id
                if name != held and name not in recording.agents and first_contact(None, scene, row, other):
                    return str(name)
        return ""

    def _disturbances(self) -> Iterator[_Candidate]:
        """Return the disturbances of the trial as candidate causes."""
        planned = self._spec.disturbances
        targets = {(one.step, one.agent, one.what): one.vehicle for one in self._rerun.bundle.result.disturbances}
        for one in planned:
            if who := targets.get((one.step, one.agent, one.what)):
                spec = replace(self._spec, disturbances=tuple(each for each in planned if each is not one))
                longer = replace(spec, max_steps=self._inside.max_steps)
                yield _Candidate(
                    Factor(kind="disturbance", name=who, what=one.what, step=one.step),
                    [(one.step - 1, longer)],
                    inside=True,
                )

    def _agents(self) -> Iterator[_Candidate]:
        """Return the decisions of the agent as candidate causes; also of the collision partner, if it is an agent."""
        agents = [name for name in (self._agent, self._other) if name in self._recording.agents]
        for doing in (doing for agent in agents for doing in self._manoeuvre_factors(agent)):
            runs = [
                (
                    step,
                    replace(
                        self._inside, overruled=Overruled(doing.actor, step, keeps=_FACULTY_BY_MANOEUVRE[doing.what])
                    ),
                )
                for step in self._earlier(doing.step, _EARLIER_S)
            ]
            yield _Candidate(
                Factor(kind="agent", name=doing.actor, what=doing.what, step=doing.step, was=doing.speed),
                runs,
                inside=True,
            )

    def _others(self, name: str) -> list[_Candidate]:
        """Return another actor's manoeuvres and its presence as candidate causes."""
        found = []
        for doing in self._manoeuvre_factors(name):
            what = _HOLD_BY_MANOEUVRE[doing.what]
            held = name if what == "keep_speed" else ""
            runs = [(step, self._held(name, what, step)) for step in self._earlier(doing.step, _EARLIER_S)]
            found.append(
                _Candidate(
                    factor=Factor(kind="other", name=name, what=doing.what, step=doing.step, was=doing.speed),
                    runs=runs,
                    inside=True,
                    held=held,
                )
            )
        steps = [step for step in self._earlier(self._end, _GONE_S) if name in self._recording.scene(step).roster.index]
        runs = [(step, self._held(name, "gone", step)) for step in steps]
        found.append(_Candidate(Factor(kind="other", name=name, what="there", step=self._end), runs, True))
        return found

    def _manoeuvre_factors(self, actor: str) -> list[Manoeuvre]:
        return manoeuvres_of(self._recording, actor, self._lanes, self._end)

    def _earlier(self, step: int, ago_s: tuple[float, ...]) -> list[int]:
        return list(dict.fromkeys(max(0, step - round(each / self._dt)) for each in ago_s))

    def _held(self, name: str, what: str, step: int) -> TrialSpec:
        """Return the trial with a hold of an actor after a given step."""
        how_long = (self._inside.max_steps - step) * self._dt
        held = Disturbance(
            step=step + 1, who="itself", what=what, how_strong=0.0, how_long=how_long, agent=self._agent, vehicle=name
        )
        return replace(self._inside, disturbances=(*self._inside.disturbances, held))

    def _arguments(self) -> Iterator[_Candidate]:
        """Return each varied argument as a candidate cause, with its default and other values of the hunt."""
        defaults, spec = self._rerun.defaults, replace(self._spec, max_steps=self.steps)
        for (agent, name), distribution in self._settings.space.items():
            known = self._spec.arguments.get(agent, {}) if agent else self._spec.scenario_arguments
            if isinstance(distribution, Constant) or name not in known:
                continue
            was, title, default = known[name], f"{agent}.{name}" if agent else name, defaults.get((agent, name))
            if default is not None and default != was:
                at_default = [(default, with_argument(spec, (agent, name), default))]
                yield _Candidate(Factor("argument", title, "default", was=was), at_default)
            drawn = dict.fromkeys(
                self._drawn_argument(title, distribution)
            )  # the same value again would be the same trial
            values = [value for value in drawn if value not in (was, default)]
            yield _Candidate(
                Factor("argument", title, "drawn", was=was),
                [(value, with_argument(spec, (agent, name), value)) for value in values[:_DRAWS]],
            )

    def _drawn_argument(self, title: str, distribution: Distribution) -> list[Value]:
        sequence = np.random.SeedSequence(self._spec.seed, spawn_key=(_TRAFFIC_STREAM, *title.encode()))
        rng = np.random.default_rng(sequence)
        if isinstance(distribution, Choice):
            return [distribution.options[place] for place in rng.permutation(len(distribution.options))]
        return [distribution.sample(rng) for _ in range(_DRAWS)]

    def _seeds(self) -> Iterator[_Candidate]:
        """Return the seed as a candidate cause; other seeds change the traffic and all other random numbers."""
        sequence = np.random.SeedSequence(self._spec.seed, spawn_key=(_TRAFFIC_STREAM,))
        seeds = [int(each) >> 1 for each in sequence.generate_state(_SEEDS)]
        spec = replace(self._spec, max_steps=self.steps)
        yield _Candidate(
            Factor("seed", "seed", "drawn", was=self._spec.seed), [(seed, replace(spec, seed=seed)) for seed in seeds]
        )
