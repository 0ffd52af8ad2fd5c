"""The exported part of a crash: the paths of all actors, and the lanes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from crashhunt.base import layout
from crashhunt.base.errors import BundleError
from crashhunt.recording import read_lanes
from crashhunt.world import paths_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from crashhunt.crashes import Bundle
    from crashhunt.world import Path

_SAME_PLACE_M = 1e-3  # a lane continues where another begins: maps give such points to the centimetre, or better
_SAME_WAY_RAD = math.pi / 3  # and in about its direction; a lane that only crosses there is another's


class Pose(NamedTuple):
    """The position of the centre of an actor after a step."""

    step: int  # number of the step; 0 is before the first step
    x: float  # x of the centre, in m
    y: float  # y of the centre, in m
    z: float  # z of the centre, in m; 0 if the map is flat
    heading: float  # heading in rad, from -pi to pi, counter-clockwise from the x axis
    speed: float  # speed in m/s


@dataclass(frozen=True, slots=True)
class RecordedPath:
    """The path of an actor while it was in sight. An actor that came back into sight has several paths."""

    path: Path  # the path as it was recorded
    name: str  # name of the path, unique in the file, of letters, digits, points, dashes and underscores

    @property
    def poses(self) -> list[Pose]:
        """The position of the actor's centre after each step; the recording contains the centre of its front bumper."""
        half = self.path.actor.length / 2
        return [
            Pose(
                step=step,
                x=state.x - half * math.cos(state.heading),
                y=state.y - half * math.sin(state.heading),
                z=state.z - half * state.grade,
                heading=math.remainder(state.heading, math.tau) if abs(state.heading) > math.pi else state.heading,
                speed=state.speed,
            )
            for step, state in enumerate(self.path.states, self.path.first)
        ]


@dataclass(frozen=True, slots=True)
class Road:
    """A lane, with the lanes before and after it."""

    right: NDArray[np.float64]  # right border of the lane, shape (n, 2), in m
    left: NDArray[np.float64]  # left border of the lane, with as many points
    # numbers of the lanes that begin where this lane ends, derived from shapes, because recordings lack them
    after: tuple[int, ...]
    before: tuple[int, ...]  # numbers of the lanes that end where this lane begins

    @property
    def centre(self) -> NDArray[np.float64]:
        """The centre line of the lane, shape (n, 2), in m."""
        return (self.right + self.left) / 2

    @property
    def width(self) -> float:
        """The width of the lane at its beginning, in m."""
        return float(np.hypot(*(self.left[0] - self.right[0])))


@dataclass(frozen=True, slots=True)
class RecordedCrash:
    """The recorded parts of a crash that are exported."""

    title: str  # description of the crash, in one line
    number: int  # number of the crash's trial
    step_length_s: float
    steps: int  # number of recorded steps
    agents: tuple[RecordedPath, ...]  # paths of the controlled vehicles
    others: tuple[RecordedPath, ...]  # the paths of all other actors
    roads: tuple[Road, ...]  # the lanes that an agent came near


def recorded_of(bundle: Bundle) -> RecordedCrash:
    """Return the parts of a crash that can be exported.

    Raises:
        BundleError: the crash has no scenes with its agent, no map was recorded, or its log is damaged.
    """
    recording = bundle.recording()
    paths = paths_of(recording.scenes(), recording.agents)
    lanes = read_lanes(bundle.path / layout.LOG)
    if not paths.agents:
        raise BundleError(
            f"{bundle.id} has no scene with its agent, because a Gymnasium environment records no vehicles",
            fix="export the crash without --as",
        )
    if not lanes:
        raise BundleError(
            f"{bundle.id} has no map of lanes, so there is no road to export",
            fix="export it without --as, or hunt with a simulator that has lanes",
        )
    for path in (*paths.agents, *paths.others):
        for step, state in enumerate(path.states, path.first):
            if not all(map(math.isfinite, state)):
                raise BundleError(
                    f"{bundle.id}: {path.actor.id!r} has no position after step {step}: {tuple(state)}",
                    fix="export it without --as, because no other format can represent that",
                )
    names = _names([*paths.agents, *paths.others])
    ways = [RecordedPath(path, name) for path, name in zip((*paths.agents, *paths.others), names, strict=True)]
    spec, count = bundle.result.spec, len(paths.agents)
    return RecordedCrash(
        title=f"{bundle.id}, trial {spec.number} with seed {spec.seed}: {bundle.result.outcome}",
        number=spec.number,
        step_length_s=recording.prologue.step_length_s,
        steps=paths.steps,
        agents=tuple(ways[:count]),
        others=tuple(ways[count:]),
        roads=_roads(lanes),
    )


def _names(paths: Sequence[Path]) -> list[str]:
    """Return a name for each path that every format accepts, because ``$`` and spaces have a meaning in some."""
    names: dict[str, None] = {}
    for path in paths:
        name = plain = "".join(c if c.isascii() and (c.isalnum() or c in ".-_") else "_" for c in path.actor.id) or "_"
        again = 1
        while name in names:
            again += 1
            name = f"{plain}__{again}"
        names[name] = None
    return list(names)


def _roads(lanes: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]]) -> tuple[Road, ...]:
    borders = [pair for pair in map(_without_duplicates, lanes) if len(pair[0]) > 1]
    lines = [(right + left) / 2 for right, left in borders]
    starts = np.array([line[0] for line in lines]).reshape(-1, 2)
    into = [_direction(line[0], line[1]) for line in lines]
    after: list[tuple[int, ...]] = []
    for line in lines:
        near = np.flatnonzero(np.hypot(*(starts - line[-1]).T) <= _SAME_PLACE_M)
        out_of = _direction(line[-2], line[-1])
        straight = (abs(math.remainder(into[other] - out_of, math.tau)) <= _SAME_WAY_RAD for other in near)
        after.append(tuple(int(other) for other, is_straight in zip(near, straight, strict=True) if is_straight))
    before = [tuple(one for one, found in enumerate(after) if number in found) for number in range(len(lines))]
    return tuple(Road(*pair, *ends) for pair, *ends in zip(borders, after, before, strict=True))


def _without_duplicates(
    lane: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the borders of a lane without points that equal the point before, because these have no direction."""
    right, left = lane
    centre = (right + left) / 2
    kept = np.append(True, np.hypot(*np.diff(centre, axis=0).T) > _SAME_PLACE_M)
    return right[kept], left[kept]


def _direction(begin: NDArray[np.float64], end: NDArray[np.float64]) -> float:
    return math.atan2(end[1] - begin[1], end[0] - begin[0])
