"""The closest approach of an episode to a crash: time to collision, gap, required deceleration.

The module computes three measures between a controlled vehicle and every other actor in each scene, and keeps the most
critical values.

Invariant: the result is the same as for all pairs of rectangles. A pair is skipped only if circles around and inside
the outlines prove that it cannot be more critical. Many scenes are computed in one NumPy call, because the overhead of
a call exceeds the arithmetic of one scene tenfold. Sources are cited at `ApproachMeter`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from crashhunt.base.codec import Serializable, null_is
from crashhunt.world._geometry import LEVEL_M, levels, outlines, rectangle_gap, time_to_contact
from crashhunt.world._scene import Frame, Scene, core_of, part_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray


# The closest approach.


@dataclass(frozen=True, slots=True)
class ClosestApproach(Serializable):
    """The closest approach of a trial to a crash: the most critical values over all steps, agents and other actors.

    Args:
        time_to_collision_s: the minimum time to collision at constant velocities, in s; infinite if no paths crossed.
        gap_m: the minimum distance between outlines, in m; 0 if they touch.
        required_deceleration: the maximum deceleration that was needed to avoid a collision, in m/s².
    """

    time_to_collision_s: float = field(default=math.inf, metadata=null_is(math.inf))
    gap_m: float = field(default=math.inf, metadata=null_is(math.inf))
    required_deceleration: float = field(default=0.0, metadata=null_is(math.inf))


_SCENES_PER_CALL = 256  # scenes per call, which costs a tenth of one scene per call
_GAP_M = 50.0  # larger gaps are ignored
_HORIZON_S = 10.0  # later collisions are ignored: velocities change within that time
_NO_APPROACH = ClosestApproach()


class ApproachMeter:
    """Measures the closest approach over the scenes of an episode, many scenes at a time.

    Time to collision: Hayward, Near-miss determination through use of a scale of danger (1972); here for outlines at
    constant velocity. Required deceleration (DRAC): Cooper and Ferguson, Traffic studies at T-junctions (1976): v² / (2
    gap) = v / (2 TTC), v being the closing speed.
    """

    def __init__(self, agents: Sequence[str]) -> None:
        self._agents = tuple(agents)
        self.closest = ClosestApproach()

    def measure(self, frames: Sequence[Frame]) -> None:
        """Measure further scenes, and update the closest approach."""
        for agent in self._agents:
            if not any(agent in frame.roster.index for frame in frames):
                continue  # quickly: an environment whose scenes have no actors may run thousands of short trials
            closest = self.closest
            times, gaps, brakes = approaches(frames, agent, closest, only_best=True)
            self.closest = ClosestApproach(
                min(closest.time_to_collision_s, float(times.min(initial=math.inf))),
                min(closest.gap_m, float(gaps.min(initial=math.inf))),
                max(closest.required_deceleration, float(brakes.max(initial=0.0))),
            )


def closest_approach(scenes: Sequence[Scene], agents: Sequence[str]) -> ClosestApproach:
    """Return the closest approach over the given scenes."""
    meter = ApproachMeter(agents)
    for first in range(0, len(scenes), _SCENES_PER_CALL):
        meter.measure([scene.frame for scene in scenes[first : first + _SCENES_PER_CALL]])
    return meter.closest


def approaches(
    frames: Sequence[Frame], agent: str, closest: ClosestApproach = _NO_APPROACH, *, only_best: bool = False
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the closest approach of an agent in each scene.

    Args:
        frames: frames of the scenes, in order.
        agent: identifier of the controlled vehicle; scenes without it have no approach.
        closest: the closest approach before these scenes; approaches that are not closer in any measure may be skipped.
        only_best: whether an approach may also be skipped if another of the scenes has a closer approach.

    Returns:
        Time to collision (s), gap (m), required deceleration (m/s²), each of shape (scenes,). Gaps of more than 50 m
        and times of more than 10 s are ignored.
    """
    count = sum(len(frame.columns) for frame in frames)
    times, gaps, brakes = np.full(count, np.inf), np.full(count, np.inf), np.zeros(count)
    whole = _near_block(frames, agent, closest, only_best) or _whole_block(frames, agent, closest)
    if whole is None or not len(whole.x):
        return times, gaps, brakes
    heading, speed, half, number, own = whole.heading, whole.speed, whole.half, whole.step, whole.own
    forward = np.stack((np.cos(heading), np.sin(heading)), axis=1)
    center = np.stack((whole.x, whole.y), axis=1) - half[:, :1] * forward
    velocity = speed[:, None] * forward
    offset, relative = center - center[own], velocity - velocity[own]
    reach = np.hypot(half[:, 0], half[:, 1])
    reach = reach + reach[own]
    distance = np.hypot(offset[:, 0], offset[:, 1])
    others = np.arange(len(own)) != own
    if any(frame.heights is not None for frame in frames):
        others &= _on_one_level(whole, forward)

    def pairs(rows: NDArray[np.intp]) -> tuple[NDArray[np.float64], ...]:
        """Return offsets, velocities and turns in the agent's frame, and the half sizes of both rectangles."""
        c, s = forward[own[rows], 0], forward[own[rows], 1]
        turned = [np.stack((v[rows, 0] * c + v[rows, 1] * s, v[rows, 1] * c - v[rows, 0] * s), axis=1)
                  for v in (offset, relative)]  # fmt: skip
        return turned[0], turned[1], heading[rows] - heading[own[rows]], half[own[rows]], half[rows]

    near = np.flatnonzero(others & (distance - reach < _GAP_M))
    if len(near):
        # Circles around both outlines bound the gap from below, circles within from above (a person is wider than
        # long), so only actors that can be the nearest are measured.
        bound, within = distance[near] - reach[near], half.min(axis=1)
        best = np.full(count, np.inf)
        np.minimum.at(best, number[near], distance[near] - within[near] - within[own[near]])
        near = near[bound <= best[number[near]]]
        place, _, turn, one, two = pairs(near)
        np.minimum.at(gaps, number[near], rectangle_gap(place, turn, one, two))
    # Pairs touch only if they close in and their circles meet. Where the circles overlap already, outlines may meet
    # although the centres part, such as those of a lorry and of a car that pulls in next to its cab.
    closing = -np.einsum("ij,ij->i", offset, relative)
    squared = np.einsum("ij,ij->i", relative, relative)
    passing = np.abs(offset[:, 0] * relative[:, 1] - offset[:, 1] * relative[:, 0])
    closing_speed = np.sqrt(squared)
    in_time = distance - reach < _HORIZON_S * closing_speed
    closing_in = (closing > 0) | (distance < reach)
    course = np.flatnonzero(others & closing_in & (passing <= reach * closing_speed) & in_time)
    if len(course):
        place, moving, turn, one, two = pairs(course)
        contact = time_to_contact(place, moving, turn, one, two)
        contact = np.where(contact <= _HORIZON_S, contact, np.inf)
        np.minimum.at(times, number[course], contact)
        needed = np.zeros_like(contact)
        np.divide(closing_speed[course], 2 * contact, out=needed, where=contact > 0)
        np.maximum.at(brakes, number[course], needed)
    return times, gaps, brakes


class _Block(NamedTuple):
    """The rectangles of several scenes with an agent: fronts, motions, and the agent rectangle to compare each with."""

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    heading: NDArray[np.float64]
    speed: NDArray[np.float64]
    half: NDArray[np.float64]
    step: NDArray[np.intp]
    own: NDArray[np.intp]
    z: NDArray[np.float64]
    grade: NDArray[np.float64]
    tall: NDArray[np.float64]

    def moved(self, step: int, first: int) -> _Block:
        """Return the same rectangles, with an offset added to the numbers of scenes and of agent rectangles."""
        return self._replace(step=self.step + step, own=self.own + first)


def _whole_block(frames: Sequence[Frame], agent: str, closest: ClosestApproach) -> _Block | None:
    blocks = []
    step = first = 0
    for frame in frames:
        row = frame.roster.index.get(agent)
        if row is not None:
            near = _near_block([frame], agent, closest)
            if near is None and frame.spines is None:
                near = _block(frame, row)
            for block in _bent_blocks(frame, row) if near is None else [near]:
                blocks.append(block.moved(step, first))
                first += len(block.x)
        step += len(frame.columns)
    return _Block(*(np.concatenate(columns) for columns in zip(*blocks, strict=True))) if blocks else None


def _near_block(
    frames: Sequence[Frame], agent: str, closest: ClosestApproach, only_best: bool = False
) -> _Block | None:
    """Return only the rectangles that may be near, as found by the core; None if the core cannot do this."""
    core = core_of(frames)
    if core is None:
        return None
    parts = [part_of(frame, agent) for frame in frames]
    least = closest.gap_m, closest.time_to_collision_s, closest.required_deceleration
    found = core.may_be_near(parts, _GAP_M, _HORIZON_S, *least, only_best)
    if found is None:
        return None
    x, y, heading, speed, *half = np.frombuffer(found[0]).reshape(6, -1)
    step, own = np.frombuffer(found[1], np.int64).reshape(2, -1)
    flat = np.zeros(len(x))
    return _Block(
        x=x,
        y=y,
        heading=heading,
        speed=speed,
        half=np.stack(half, axis=1),
        step=step,
        own=own,
        z=flat,
        grade=flat,
        tall=flat,
    )


def _block(frame: Frame, row: int) -> _Block:
    roster, columns = frame.roster, frame.columns
    scenes, actors = len(columns), len(roster)
    heights = frame.heights if frame.heights is not None else np.zeros((scenes, 2 * actors))
    return _Block(
        x=columns[:, 0 : 2 * actors : 2].ravel(),
        y=columns[:, 1 : 2 * actors : 2].ravel(),
        heading=columns[:, 2 * actors : 3 * actors].ravel(),
        speed=columns[:, 3 * actors :].ravel(),
        half=np.tile(roster.half_sizes, (scenes, 1)),
        step=np.repeat(np.arange(scenes), actors),
        own=np.repeat(np.arange(row, scenes * actors, actors), actors),
        z=heights[:, :actors].ravel(),
        grade=heights[:, actors:].ravel(),
        tall=np.tile([actor.height for actor in roster.actors], scenes),
    )


def _bent_blocks(frame: Frame, row: int) -> list[_Block]:
    """Return one block for each part of the agent; each part is compared with all parts of the other actors."""
    blocks = []
    for step in range(len(frame.columns)):
        scene = frame.scene(step)
        rows = [number for number in range(len(frame.roster)) if number != row]
        mine = [(row, *part) for part in zip(outlines(scene, row), levels(scene, row), strict=True)]
        theirs = [
            (number, *part)
            for number in rows
            for part in zip(outlines(scene, number), levels(scene, number), strict=True)
        ]
        for part in mine:
            values = np.array(
                [
                    (x, y, h, scene.speeds[who], length / 2, width / 2, *level, frame.roster.actors[who].height)
                    for who, (x, y, h, length, width), level in (part, *theirs)
                ]
            )
            x, y, heading, speed, length, width, z, grade, tall = values.T
            here = np.full(len(values), step)
            own = np.zeros(len(values), np.intp)
            half = np.stack((length, width), axis=1)
            blocks.append(
                _Block(
                    x=x, y=y, heading=heading, speed=speed, half=half, step=here, own=own, z=z, grade=grade, tall=tall
                )
            )
    return blocks


def _on_one_level(whole: _Block, forward: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return for each rectangle whether it is on the same level as the agent, as defined by `same_level`."""
    own = whole.own
    dx, dy = whole.x - whole.x[own], whole.y - whole.y[own]
    ahead = whole.grade[own] * (dx * forward[own, 0] + dy * forward[own, 1])
    behind = whole.grade * (dx * forward[:, 0] + dy * forward[:, 1])
    above = whole.z - whole.z[own]
    lower = np.where(above > 0, whole.tall[own], whole.tall)
    level: NDArray[np.bool_] = np.abs(above - (ahead + behind) / 2) < np.maximum(LEVEL_M, lower)
    return level
