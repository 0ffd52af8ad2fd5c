"""How near to a crash an episode came: time to collision, gap, required deceleration."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from crashhunt.world._closest import ClosestApproach
from crashhunt.world._geometry import rectangle_gap, time_to_contact
from crashhunt.world._outlines import LEVEL_M, levels, outlines
from crashhunt.world._scene import core_of, part_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from crashhunt.world._scene import Frame, Scene

__all__ = ["ApproachMeter", "approaches", "closest_approach"]

_CHUNK = 256  # scenes at a time, which costs a tenth of one at a time
_GAP_M = 50.0  # what is further away is not near
_HORIZON_S = 10.0  # a collision course further ahead than this says nothing
_NOTHING = ClosestApproach()


class ApproachMeter:
    """Measures the closest approach over the scenes of an episode, many scenes at a time.

    Time to collision: J. C. Hayward, Near-miss determination through use of a scale of danger (1972), here of
    outlines at constant velocity. Required deceleration (DRAC): D. F. Cooper and N. Ferguson, Traffic studies at
    T-junctions (1976): v² / (2 gap) = v / (2 TTC), v being the closing speed.

    Args:
        agents: the controlled vehicles.
    """

    def __init__(self, agents: Sequence[str]) -> None:
        self._agents = tuple(agents)
        self.closest = ClosestApproach()

    def measure(self, frames: Sequence[Frame]) -> None:
        """Take scenes in."""
        for agent in self._agents:
            so_far = self.closest
            times, gaps, brakes = approaches(frames, agent, so_far, only_best=True)
            self.closest = ClosestApproach(
                min(so_far.time_to_collision_s, float(times.min(initial=math.inf))),
                min(so_far.gap_m, float(gaps.min(initial=math.inf))),
                max(so_far.required_deceleration, float(brakes.max(initial=0.0))),
            )


def closest_approach(scenes: Sequence[Scene], agents: Sequence[str]) -> ClosestApproach:
    """Return the closest approach over some scenes."""
    meter = ApproachMeter(agents)
    for first in range(0, len(scenes), _CHUNK):
        meter.measure([scene.frame for scene in scenes[first : first + _CHUNK]])
    return meter.closest


def approaches(
    frames: Sequence[Frame], agent: str, so_far: ClosestApproach = _NOTHING, *, only_best: bool = False
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return, for each scene, how near the agent is to the nearest danger.

    Args:
        frames: in order.
        agent: the controlled vehicle; scenes without it are as safe as can be.
        so_far: what does not come nearer than this in any way may be left out.
        only_best: what does not come nearer than another scene does, too.

    Returns:
        Time to collision (s), gap (m), required deceleration (m/s²), each of shape (scenes,). Gaps of more than 50 m
        and times of more than 10 s do not count.
    """
    count = sum(len(frame.columns) for frame in frames)
    times, gaps, brakes = np.full(count, np.inf), np.full(count, np.inf), np.zeros(count)
    whole = _near_block(frames, agent, so_far, only_best) or _whole_block(frames, agent, so_far)
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
        """Offsets, velocities and turns in the agent's frame, and both half sizes."""
        c, s = forward[own[rows], 0], forward[own[rows], 1]
        turned = [np.stack((v[rows, 0] * c + v[rows, 1] * s, v[rows, 1] * c - v[rows, 0] * s), axis=1)
                  for v in (offset, relative)]  # fmt: skip
        return turned[0], turned[1], heading[rows] - heading[own[rows]], half[own[rows]], half[rows]

    near = np.flatnonzero(others & (distance - reach < _GAP_M))
    if len(near):
        # The circles around both outlines bound the gap from below, those within from above (a person is wider than
        # long); only who could be the nearest is measured.
        bound, within = distance[near] - reach[near], half.min(axis=1)
        best = np.full(count, np.inf)
        np.minimum.at(best, number[near], distance[near] - within[near] - within[own[near]])
        near = near[bound <= best[number[near]]]
        place, _, turn, one, two = pairs(near)
        np.minimum.at(gaps, number[near], rectangle_gap(place, turn, one, two))
    # The circles also bound who can ever touch: closing, and passing nearer than both radii. Where they overlap by now,
    # outlines may meet although the centres part, such as those of a lorry and a car that pulls in beside its cab.
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
    """Rectangles of scenes in which an agent is: of each its front, how it moves, and against whom it is measured."""

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
        """The same, counted on from a step and a rectangle."""
        return self._replace(step=self.step + step, own=self.own + first)


def _whole_block(frames: Sequence[Frame], agent: str, so_far: ClosestApproach) -> _Block | None:
    blocks = []
    step = first = 0
    for frame in frames:
        row = frame.roster.index.get(agent)
        if row is not None:
            near = _near_block([frame], agent, so_far)
            for block in [near] if near is not None else _blocks(frame, row):
                blocks.append(block.moved(step, first))
                first += len(block.x)
        step += len(frame.columns)
    return _Block(*(np.concatenate(columns) for columns in zip(*blocks, strict=True))) if blocks else None


def _near_block(frames: Sequence[Frame], agent: str, so_far: ClosestApproach, only_best: bool = False) -> _Block | None:
    """Those only who may be near, as the core finds them; None where it does not."""
    core = core_of(frames)
    if core is None:
        return None
    parts = [part_of(frame, agent, frame.roster.rows) for frame in frames]
    least = so_far.gap_m, so_far.time_to_collision_s, so_far.required_deceleration
    found = core.may_be_near(parts, _GAP_M, _HORIZON_S, *least, only_best)
    if found is None:
        return None
    x, y, heading, speed, *half = np.frombuffer(found[0]).reshape(6, -1)
    step, own = np.frombuffer(found[1], np.int64).reshape(2, -1)
    flat = np.zeros(len(x))
    return _Block(x, y, heading, speed, np.stack(half, axis=1), step, own, flat, flat, flat)


def _blocks(frame: Frame, row: int) -> list[_Block]:
    return [_block(frame, row)] if frame.spines is None else _bent_blocks(frame, row)


def _block(frame: Frame, row: int) -> _Block:
    roster, columns = frame.roster, frame.columns
    scenes, actors = len(columns), len(roster)
    heights = frame.heights if frame.heights is not None else np.zeros((scenes, 2 * actors))
    return _Block(
        columns[:, 0 : 2 * actors : 2].ravel(),
        columns[:, 1 : 2 * actors : 2].ravel(),
        columns[:, 2 * actors : 3 * actors].ravel(),
        columns[:, 3 * actors :].ravel(),
        np.tile(roster.half_sizes, (scenes, 1)),
        np.repeat(np.arange(scenes), actors),
        np.repeat(np.arange(row, scenes * actors, actors), actors),
        heights[:, :actors].ravel(),
        heights[:, actors:].ravel(),
        np.tile([actor.height for actor in roster.actors], scenes),
    )


def _bent_blocks(frame: Frame, row: int) -> list[_Block]:
    """One for each scene and each part of the agent, which is measured against all parts of the others."""
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
            blocks.append(_Block(x, y, heading, speed, half, here, own, z, grade, tall))
    return blocks


def _on_one_level(whole: _Block, forward: NDArray[np.float64]) -> NDArray[np.bool_]:
    """As `same_level` says of two."""
    own = whole.own
    dx, dy = whole.x - whole.x[own], whole.y - whole.y[own]
    ahead = whole.grade[own] * (dx * forward[own, 0] + dy * forward[own, 1])
    behind = whole.grade * (dx * forward[:, 0] + dy * forward[:, 1])
    above = whole.z - whole.z[own]
    lower = np.where(above > 0, whole.tall[own], whole.tall)
    level: NDArray[np.bool_] = np.abs(above - (ahead + behind) / 2) < np.maximum(LEVEL_M, lower)
    return level
