"""Two actors of a recording: their relative motion, and the time until which the crash could have been avoided."""

from __future__ import annotations

import math
from array import array
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from crashhunt.world import (
    DangerMeter,
    DangerousMoment,
    Roster,
    Scene,
    approaches,
    dangers,
    followers_danger,
    join_frames,
    lane_jump,
    on_one_level,
    outline_gap,
    outlines,
    outlines_overlap,
    rectangle_gap,
    time_to_contact,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Reversible, Sequence

    from numpy.typing import NDArray

    from crashhunt.recording import Recording
    from crashhunt.world import Frame


_LOOKS_BACK_S = 30.0  # before the end; what was longer ago has not led to it
_PART_M, _MOST_PARTS = 0.5, 100  # within a step, outlines are compared each time both together have moved so far

Manner = Literal["ahead", "behind", "oncoming", "crossing from the left", "crossing from the right", "left", "right"]


@dataclass(frozen=True, slots=True)
class Moment:
    """The position and speed of the other actor relative to the agent after one step."""

    step: int  # number of the step in the episode
    time_s: float  # simulation time after the step, in s
    speed: float  # speed of the agent, in m/s
    other_speed: float  # speed of the other actor, in m/s
    gap_m: float  # gap between the outlines of the two actors, in m
    # speed at which the centres of the actors approach each other, in m/s; negative if they move apart
    closing_speed: float
    # time to collision at constant velocities, in s; infinite if the actors would miss each other
    time_to_collision_s: float
    # deceleration that the agent would need to avoid a collision, v / (2 TTC) with v the relative speed, in m/s²
    required_deceleration: float


@dataclass(frozen=True, slots=True)
class Position:
    """The position of the other actor relative to the agent."""

    place: Literal["ahead", "behind", "left", "right"]  # side of the agent on which the other actor is
    turn: float  # heading of the other actor minus the heading of the agent, in rad, from -pi to pi

    @property
    def faces(self) -> Literal["same", "other", "left", "right"]:
        """The direction of the other actor relative to the agent: same, opposite, or towards its left or right."""
        if abs(self.turn) > math.radians(135):
            return "other"
        if abs(self.turn) > math.radians(45):
            return "left" if self.turn > 0 else "right"
        return "same"


class Encounter:
    """The steps of a recording in which both of two actors were present."""

    def __init__(self, recording: Recording, agent: str, other: str) -> None:
        self.agent = agent
        self.other = other
        self._recording = recording
        self.moments = self._measure()

    def position(self, step: int) -> Position | None:
        """Return the position of the other actor relative to the agent after a step; None if one of them was absent."""
        scenes = self._recording.scenes()
        found = next(_pairs(scenes[step : step + 1], self.agent, self.other), None) if step >= 0 else None
        if found is None:
            return None
        _, scene, (own, other) = found
        offset = scene.centers[other] - scene.centers[own]
        c, s = math.cos(scene.headings[own]), math.sin(scene.headings[own])
        ahead, left = float(offset[0] * c + offset[1] * s), float(offset[1] * c - offset[0] * s)
        turn = math.remainder(scene.headings[other] - scene.headings[own], math.tau)
        one, two = scene.roster.actors[own], scene.roster.actors[other]
        along, across = abs(math.cos(turn)), abs(math.sin(turn))
        # Side by side: the lengths overlap, as seen from the agent, by more than touching ends.
        is_alongside = (
            abs(ahead) < (one.length + two.length * along + two.width * across) / 2
            and abs(left) > (one.width + two.width * along + two.length * across) / 3
        )
        if is_alongside or abs(left) > abs(ahead):
            return Position("left" if left > 0 else "right", turn)
        return Position("ahead" if ahead > 0 else "behind", turn)

    def manner(self, step: int) -> Manner | None:
        """Return the type of encounter at a step; None if one of the actors was absent."""
        found = self.position(step)
        if found is None:
            return None
        if found.faces == "other":
            return "oncoming"
        if found.faces == "same":
            return found.place
        return "crossing from the right" if found.faces == "left" else "crossing from the left"

    def _measure(self) -> list[Moment]:
        steps: list[int] = []
        times: list[float] = []
        measured = array("d")
        bent: dict[int, tuple[Scene, tuple[int, int]]] = {}
        for step, scene, (own, other) in _pairs(self._recording.scenes(), self.agent, self.other):
            if own in scene.spines or other in scene.spines:
                bent[len(steps)] = scene, (own, other)
            steps.append(step)
            times.append(scene.time_s)
            centers, half = scene.centers, scene.roster.half_sizes
            measured.extend(
                (*centers[own], *centers[other], scene.headings[own], scene.headings[other],
                 scene.speeds[own], scene.speeds[other], *half[own], *half[other])
            )  # fmt: skip
        if not steps:
            return []
        states = np.array(measured).reshape(len(steps), -1)
        states, half_own, half_other = states[:, :8], states[:, 8:10], states[:, 10:]
        heading, other_heading, speed, other_speed = states[:, 4:].T
        offset = states[:, 2:4] - states[:, 0:2]
        own_velocity = speed[:, None] * np.stack((np.cos(heading), np.sin(heading)), axis=1)
        velocity = (
            other_speed[:, None] * np.stack((np.cos(other_heading), np.sin(other_heading)), axis=1) - own_velocity
        )
        distance = np.maximum(np.hypot(*offset.T), 1e-9)
        closing = -np.einsum("ij,ij->i", offset, velocity) / distance
        turn = other_heading - heading
        gap = rectangle_gap(_turned(offset, heading), turn, half_own, half_other)
        contact = time_to_contact(_turned(offset, heading), _turned(velocity, heading), turn, half_own, half_other)
        for place, (scene, rows) in bent.items():
            contact[place], gap[place] = self._bent(scene, rows, gap[place])
        needed = np.where(contact > 0, np.hypot(*velocity.T) / (2 * np.maximum(contact, 1e-9)), 0.0)
        return [
            Moment(step, time_s, *map(float, values))
            for step, time_s, *values in zip(
                steps, times, speed, other_speed, gap, closing, contact, needed, strict=True
            )
        ]

    def _bent(self, scene: Scene, rows: tuple[int, int], straight_m: float) -> tuple[float, float]:
        """Return time to collision and gap of an articulated and another vehicle; if distant, it counts as straight."""
        pair = Scene(
            scene.time_s,
            Roster(tuple(scene.roster.actors[row] for row in rows)),
            [scene.points[row] for row in rows],
            [scene.headings[row] for row in rows],
            [scene.speeds[row] for row in rows],
            spines={place: scene.spines[row] for place, row in enumerate(rows) if row in scene.spines},
        )
        times, gaps, _ = approaches([pair.frame], self.agent)
        return float(times[0]), float(gaps[0]) if math.isfinite(gaps[0]) else straight_m


def _pairs(scenes: Iterable[Scene], agent: str, other: str) -> Iterator[tuple[int, Scene, tuple[int, int]]]:
    """Yield place, scene and the rows of two actors for each scene that contains both."""
    for place, scene in enumerate(scenes):
        index = scene.roster.index
        if agent in index and other in index:
            yield place, scene, (index[agent], index[other])


def last_escape(recording: Recording, agent: str, other: str, *, braking: float) -> int | None:
    """Return the last step after which full braking would have avoided the crash, according to a calculation.

    The agent follows its recorded path and brakes from that step on. The collision partner repeats its recorded motion,
    and keeps its last velocity after the end of the recording. In reality other actors react, so the result is only an
    estimate. `find_escape` determines the step by runs. ``braking`` is the deceleration, in m/s².

    Returns:
        None if there is no such step, or if no collision is calculated even without braking.
    """
    model = _Model(recording, agent, other)
    if not model.collides_without_braking():
        return None
    last = len(model.steps) - 1
    first = max(0, last - math.ceil(_LOOKS_BACK_S / recording.prologue.step_length_s))
    return next((model.steps[start] for start in range(last - 1, first - 1, -1) if model.avoids(start, braking)), None)


class _Model:
    """A model of a crash: the other actor moves as recorded, and the agent follows its path at another speed."""

    def __init__(self, recording: Recording, agent: str, other: str) -> None:
        self._dt = recording.prologue.step_length_s
        self.steps: list[int] = []
        self._speeds: list[float] = []
        self._beyond = 0.0
        self._sizes: list[tuple[float, float]] = []
        poses: tuple[list[tuple[float, float, float]], ...] = [], []
        for step, scene, rows in _pairs(recording.scenes(), agent, other):
            self.steps.append(step)
            self._speeds.append(scene.speeds[rows[0]])
            self._beyond = scene.speeds[rows[1]]
            self._sizes = [(actor.length, actor.width) for actor in (scene.roster.actors[row] for row in rows)]
            for path, row in zip(poses, rows, strict=True):
                path.append((*scene.points[row], scene.headings[row]))
        self._path, self._others = map(_Path, poses)

    def collides_without_braking(self) -> bool:
        """Return whether the recorded actors touch up to the last step, or would touch within the next step."""
        last = len(self.steps) - 1
        if last < 1:
            return False
        before, end = self._path.distances[last - 1 :]
        beyond = end + max(0.0, self._speeds[last]) * self._dt
        return self._touch_on_the_way(last - 1, before, end) or self._touch_on_the_way(last, end, beyond)

    def avoids(self, start: int, braking: float) -> bool:
        """Return whether braking from the given scene on avoids every contact until the agent stands still."""
        speed, driven, index = max(0.0, self._speeds[start]), self._path.distances[start], start
        if self._touch(driven, float(index)):
            return False
        while speed > 0:
            slower = max(0.0, speed - braking * self._dt)
            after = driven + (speed + slower) / 2 * self._dt
            if self._touch_on_the_way(index, driven, after):
                return False
            speed, driven, index = slower, after, index + 1
        # The partner may still drive into the standing agent, which the agent's brakes cannot avoid.
        return True

    def _touch_on_the_way(self, index: int, driven: float, after: float) -> bool:
        """Return whether the two actors touch within a step, after the beginning of the step."""
        (x, y, _), (x_after, y_after, _) = self._other(float(index)), self._other(float(index + 1))
        way = after - driven + math.hypot(x_after - x, y_after - y)
        parts = min(_MOST_PARTS, max(1, math.ceil(way / _PART_M)))
        return any(
            self._touch(driven + (after - driven) * part / parts, index + part / parts) for part in range(1, parts + 1)
        )

    def _touch(self, driven: float, index: float) -> bool:
        return outlines_overlap((*self._path.at(driven), *self._sizes[0]), (*self._other(index), *self._sizes[1]))

    def _other(self, index: float) -> tuple[float, float, float]:
        distances, whole = self._others.distances, int(index)
        if whole >= len(distances) - 1:
            return self._others.at(distances[-1] + (index - len(distances) + 1) * self._dt * self._beyond)
        return self._others.between(whole, index - whole)


class _Path:
    """The driven path of an actor, continued in a straight line."""

    def __init__(self, poses: list[tuple[float, float, float]]) -> None:
        self._poses = np.array(poses).reshape(-1, 3)
        lengths = np.hypot(*np.diff(self._poses[:, :2], axis=0).T)
        self.distances = [0.0, *np.cumsum(lengths).tolist()]

    def at(self, distance: float) -> tuple[float, float, float]:
        index = int(np.searchsorted(self.distances, distance))
        if index >= len(self.distances):
            x, y, heading = self._poses[-1]
            beyond = distance - self.distances[-1]
            return float(x + beyond * math.cos(heading)), float(y + beyond * math.sin(heading)), float(heading)
        if index == 0:
            x, y, heading = self._poses[0]
            return float(x), float(y), float(heading)
        length = self.distances[index] - self.distances[index - 1]
        return self.between(index - 1, (distance - self.distances[index - 1]) / max(length, 1e-9))

    def between(self, index: int, share: float) -> tuple[float, float, float]:
        """Return the pose at a fraction of the way from one recorded pose to the next."""
        before, after = self._poses[index], self._poses[index + 1]
        x, y = before[:2] + share * (after[:2] - before[:2])
        heading = before[2] + share * math.remainder(after[2] - before[2], math.tau)
        return float(x), float(y), float(heading)


def _turned(vectors: NDArray[np.float64], heading: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return vectors of the map in coordinate frames with the given headings."""
    c, s = np.cos(heading), np.sin(heading)
    return np.stack((vectors[:, 0] * c + vectors[:, 1] * s, vectors[:, 1] * c - vectors[:, 0] * s), axis=1)


# How dangerous a recorded trial was from step to step: for the agent, and by those behind it.

_DECAY_S, _MOST = 1.2, 0.999  # as in `crashhunt.world._danger`
_MAX_LANE_TURN_RAD = math.radians(30)
_CHANGE_S = 3.0  # a gradual lane change takes no longer
_MIN_BEND_RAD = math.radians(5)
_SIDEWAYS_M = 0.8  # more than the other actor: less is drift within a lane
_EQUAL_TOLERANCE = 1e-6  # s or m: the same pair, measured by another function
_UNKNOWN_S = 4.0  # before the end, a criticality of 0 is unknown: later actors are not in the recording


@dataclass(frozen=True, slots=True)
class DangerCourse:
    """The criticality of a recorded trial over time, computed after the trial.

    The criticality is NaN in steps without the agent. Instead of 0, the criticality is also NaN within the last 4 s,
    because later steps that are not recorded could raise it.
    """

    agent: str  # identifier of the agent
    steps: range  # numbers of the steps that have a scene
    # the agent's criticality in each of these steps, towards actors ahead of it or crossing its path
    own: NDArray[np.float64]
    # the rear criticality in each of these steps, caused by actors that approach the agent from behind
    behind: NDArray[np.float64]
    greatest: DangerousMoment  # the moment of the agent's greatest own criticality
    # the moment of the greatest criticality caused by an actor behind the agent; ``other`` is this actor
    greatest_behind: DangerousMoment
    # integral of the agent's own criticality over the trial, from 0 to below 1. Trials without a crash and with one
    # agent are ranked by this number.
    own_total: float
    behind_total: float  # integral of the rear criticality over the trial, from 0 to below 1
    # identifier of the actor that came nearest to the agent, the gap in m, and the step; None if no actor came within
    # 50 m
    nearest: tuple[str, float, int] | None = None

    def of_step(self, step: int) -> tuple[float, float] | None:
        """Return the agent's own criticality and its rear criticality after a step; None if the step has no scene."""
        if step not in self.steps:
            return None
        place = self.steps.index(step)
        return float(self.own[place]), float(self.behind[place])


def danger_course(recording: Recording, agent: str) -> DangerCourse | None:
    """Return the criticality of an agent in each step of a trial; None if no scene contains the agent."""
    lane_changes = _LaneChanges(agent)
    frames = list(join_frames(lane_changes.watch(recording.scenes())))
    if not any(agent in frame.roster.index for frame in frames):
        return None
    dt = recording.prologue.step_length_s
    own, greatest = lane_changes.added_to(*dangers(frames, [agent], dt))
    meter = DangerMeter([agent], dt)
    meter.add(frames)
    behind, greatest_behind, behind_total = followers_danger(frames, agent, dt)
    known = np.concatenate([np.full(len(frame.columns), agent in frame.roster.index) for frame in frames])
    steps = range(len(known))
    unsure = np.arange(len(known)) > np.flatnonzero(known)[-1] - _UNKNOWN_S / dt
    return DangerCourse(
        agent=agent,
        steps=steps,
        own=np.where(known & ((own > 0) | ~unsure), own, np.nan),
        behind=np.where(known & ((behind > 0) | ~unsure), behind, np.nan),
        greatest=greatest,
        greatest_behind=greatest_behind,
        own_total=meter.danger or 0.0,
        behind_total=behind_total,
        nearest=_nearest(recording.scenes(), frames, agent),
    )


class _LaneChanges:
    """Lane changes of an agent in front of vehicles that approach in the target lane, found while scenes pass by.

    After a lane change, the agent's path does not lead through the vehicles behind it, so `dangers` does not count
    them. In this case, the post-encroachment time is the time from the lane change until the vehicle behind reaches the
    agent's position.
    """

    def __init__(self, agent: str) -> None:
        self._agent = agent
        self._found: list[DangerousMoment] = []
        self._recent: deque[Scene] = deque()  # as long as a lane change takes

    def watch(self, scenes: Iterable[Scene]) -> Iterator[Scene]:
        """Yield the given scenes, and remember the lane changes in them."""
        before: Scene | None = None
        for number, scene in enumerate(scenes):
            self._recent.append(scene)
            while self._recent[0].time_s < scene.time_s - _CHANGE_S - 1e-6:
                self._recent.popleft()
            if before is not None and self._agent in before.roster.index and self._agent in scene.roster.index:
                self._compare(number, before, scene)
            before = scene
            yield scene

    def added_to(
        self, own: NDArray[np.float64], greatest: DangerousMoment
    ) -> tuple[NDArray[np.float64], DangerousMoment]:
        """Return the criticality of each scene and the most critical moment, including the lane changes."""
        own = own.copy()
        for found in self._found:
            own[found.step] = max(own[found.step], found.danger)
            greatest = found if found.danger > greatest.danger else greatest
        return own, greatest

    def _compare(self, number: int, before: Scene, after: Scene) -> None:
        row = after.roster.index[self._agent]
        entered = _behind_in_its_way(after, row)
        if entered and not lane_jump(before, after, self._agent):
            own = before.roster.index[self._agent]
            followed = {before.roster.actors[one].id for one in _behind_in_its_way(before, own)}
            fresh = [other for other in entered if after.roster.actors[other].id not in followed]
            entered = [other for other in fresh if _moved_into_its_way(self._recent, self._agent, after, other)]
        for other in entered:
            gap_m = max(0.0, -_ahead_m(after, row, other) - after.roster.half_sizes[row][0])
            gap_m = max(0.0, gap_m - after.roster.half_sizes[other][0])
            danger = min(math.exp(-gap_m / max(after.speeds[other], 1e-3) / _DECAY_S), _MOST)
            self._found.append(DangerousMoment(danger, number, self._agent, after.roster.actors[other].id))


def _ahead_m(scene: Scene, row: int, other: int) -> float:
    """Return how far the centre of the other actor is ahead of an actor's centre, along that actor's heading, in m."""
    dx, dy = scene.centers[other] - scene.centers[row]
    return float(dx * math.cos(scene.headings[row]) + dy * math.sin(scene.headings[row]))


def _behind_in_its_way(scene: Scene, row: int) -> list[int]:
    """Return the actors that are behind an actor, drive in its direction, and have a path over its position."""
    half = np.array(scene.roster.half_sizes)
    c, s = math.cos(scene.headings[row]), math.sin(scene.headings[row])
    dx, dy = (scene.centers - scene.centers[row]).T
    same_way = np.cos(np.array(scene.headings) - scene.headings[row]) >= math.cos(_MAX_LANE_TURN_RAD)
    over = (dx * c + dy * s <= 0) & (np.abs(dy * c - dx * s) <= half[:, 1] + half[row, 1]) & same_way
    return [int(other) for other in np.flatnonzero(over) if other != row and on_one_level(scene, row, int(other))]


def _moved_into_its_way(scenes: Reversible[Scene], agent: str, after: Scene, other: int) -> bool:
    """Return whether an agent moved sideways into the path of another actor on a straight road.

    In a bend, the paths of two lanes do not show which of the two vehicles changed lanes.
    """
    name, heading = after.roster.actors[other].id, after.headings[other]
    earliest = None
    for scene in reversed(scenes):
        index = scene.roster.index
        if agent not in index or name not in index or scene.time_s < after.time_s - _CHANGE_S - 1e-6:
            break
        if abs(math.remainder(scene.headings[index[name]] - heading, math.tau)) > _MIN_BEND_RAD:
            return False
        earliest = scene
    if earliest is None:
        return False
    own, its = (
        after.centers[after.roster.index[one]] - earliest.centers[earliest.roster.index[one]] for one in (agent, name)
    )
    across = np.array([-math.sin(heading), math.cos(heading)])
    return bool(abs(own @ across) > abs(its @ across) + _SIDEWAYS_M)


def _nearest(scenes: Sequence[Scene], frames: Sequence[Frame], agent: str) -> tuple[str, float, int] | None:
    """Return the actor that came nearest to an agent, the gap in m, and the step."""
    _, gaps, _ = approaches(frames, agent)
    if not len(gaps) or not math.isfinite(gaps.min()):
        return None
    number = int(gaps.argmin())
    scene = scenes[number]
    row = scene.roster.index[agent]
    found = []
    for _, other in scene.neighbors(row):
        pairs = [(one, two) for one in outlines(scene, row) for two in outlines(scene, other)]
        if on_one_level(scene, row, other):
            found.append((min(outline_gap(one, two) for one, two in pairs), scene.roster.actors[other].id))
    return (min(found)[1], float(gaps[number]), number) if found else None


def closest_actors(recording: Recording, agent: str) -> list[tuple[str, str]]:
    """Return for each scene the actor with the least time to collision and the actor with the least gap to an agent.

    Returns:
        Two identifiers for each scene. An identifier is empty if `approaches` finds no such actor, or if several are
        equally close.
    """
    scenes = recording.scenes()
    times, gaps, _ = approaches([*join_frames(scenes)], agent)
    found = []
    for scene, time_s, gap_m in zip(scenes, times, gaps, strict=True):
        if agent not in scene.roster.index or not (math.isfinite(time_s) or math.isfinite(gap_m)):
            found.append(("", ""))
            continue
        row = scene.roster.index[agent]
        own_times, own_gaps = _to_all(scene, row)
        found.append((_only(scene, own_times, time_s), _only(scene, own_gaps, gap_m)))
    return found


def _to_all(scene: Scene, row: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return time to collision (s) and gap (m) from one actor to each actor of a scene; NaN for the actor itself."""
    headings, speeds, half = np.array(scene.headings), np.array(scene.speeds), np.array(scene.roster.half_sizes)
    velocities = speeds[:, None] * np.stack((np.cos(headings), np.sin(headings)), axis=1)
    own = np.full(len(headings), headings[row])
    offset, relative = _turned(scene.centers - scene.centers[row], own), _turned(velocities - velocities[row], own)
    sizes = np.broadcast_to(half[row], half.shape), half
    times = time_to_contact(offset, relative, headings - headings[row], *sizes)
    gaps = rectangle_gap(offset, headings - headings[row], *sizes)
    times[row] = gaps[row] = math.nan
    return times, gaps


def _only(scene: Scene, measured: NDArray[np.float64], least: float) -> str:
    """Return the only actor with the least measured value; empty if several actors or no actor has it."""
    if not math.isfinite(least):
        return ""
    rows = np.flatnonzero(np.abs(measured - least) <= _EQUAL_TOLERANCE)
    return scene.roster.actors[rows[0]].id if len(rows) == 1 else ""


def most_dangerous(recording: Recording) -> DangerousMoment | None:
    """Return the moment of the greatest criticality of any controlled vehicle; None if the criticality was always 0."""
    frames = [*join_frames(recording.scenes())]
    if not frames:
        return None
    _, most = dangers(frames, recording.agents, recording.prologue.step_length_s)
    return most if most.danger > 0 else None
