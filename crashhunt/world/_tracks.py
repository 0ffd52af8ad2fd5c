"""Who was where when, as bare columns: the way of one agent, and everybody who came near it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from crashhunt.world._outlines import levels, outlines
from crashhunt.world._scene import core_of, part_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from crashhunt.world._scene import Frame

    Array = NDArray[np.float64]

__all__ = ["Others", "Reach", "Track", "sampled", "spacing_s", "tracks", "ways"]

_APART_S = 0.3  # of the samples, at least: nobody gets far in it, and every step costs time
_AT_MOST_S = 0.3  # where a step is longer, there are samples between two scenes


def spacing_s(step_length_s: float) -> float:
    """Return how far apart samples are, in s."""
    return _every(step_length_s) * step_length_s / _between_steps(step_length_s)


def _every(step_length_s: float) -> int:
    """Of how many steps one is looked at, where they are short."""
    return max(1, round(_APART_S / step_length_s))


def _between_steps(step_length_s: float) -> int:
    """How many samples a step has, where it is long."""
    return max(1, math.ceil(step_length_s / _AT_MOST_S - 1e-9))


class Track(NamedTuple):
    """The way of an agent, each of shape (samples,).

    Args:
        time: in s since the first scene.
        x: of the centre of its outline, in m.
        y: likewise.
        heading: in rad, without jumps by whole turns.
        z: of its front, in m.
        half_length: in m.
        half_width: in m.
        height: in m.
    """

    time: Array
    x: Array
    y: Array
    heading: Array
    z: Array
    half_length: Array
    half_width: Array
    height: Array


class Others(NamedTuple):
    """Those near an agent, each of shape (pairs,): fields as in `Track`.

    Args:
        sample: of the track.
        who: the number of the actor, as `tracks` names them.
    """

    sample: NDArray[np.intp]
    who: NDArray[np.intp]
    x: Array
    y: Array
    heading: Array
    z: Array
    half_length: Array
    half_width: Array
    height: Array


def sampled(frames: Sequence[Frame], step_length_s: float) -> Iterator[tuple[Frame, Array]]:
    """Yield scenes at regular instants, with the times of their rows, in s since the first.

    Where steps are long, what was between two scenes of the same actors is put in, as if they had gone straight.
    """
    every, between = _every(step_length_s), _between_steps(step_length_s)
    step, last = 0, None
    for frame in frames:
        count = len(frame.columns)
        steps = np.arange(step, step + count)
        step += count
        if between > 1 and frame.spines is None:
            joined = last is not None and last.roster is frame.roster and last.spines is None
            columns, heights = frame.columns, frame.heights
            if joined and last is not None:
                steps = np.append(steps[0] - 1, steps)
                columns = np.vstack((last.columns[-1:], columns))
                if heights is not None and last.heights is not None:
                    heights = np.vstack((last.heights[-1:], heights))
            share = np.arange(int(joined), between * (len(steps) - 1) + 1) / between  # in steps since the first of them
            turning = slice(2 * len(frame.roster), 3 * len(frame.roster))
            unwrapped = columns.copy()
            unwrapped[:, turning] = np.unwrap(columns[:, turning], axis=0)
            last = frame
            filled = None if heights is None or len(heights) != len(steps) else _between(heights, share)
            times: Array = (float(steps[0]) + share) * step_length_s
            yield frame._replace(columns=_between(unwrapped, share), heights=filled), times
            continue
        last = frame
        rows = np.flatnonzero(steps % every == 0)
        if len(rows):
            spines = tuple(frame.spines[row] for row in rows) if frame.spines is not None else None
            heights = frame.heights[rows] if frame.heights is not None else None
            part = frame._replace(columns=frame.columns[rows], heights=heights, spines=spines)
            instants: Array = steps[rows].astype(float) * step_length_s
            yield part, instants


def _between(columns: Array, share: Array) -> Array:
    row = np.minimum(share.astype(int), max(0, len(columns) - 2))
    after = np.minimum(row + 1, len(columns) - 1)
    part = (share - row)[:, None]
    found: Array = columns[row] * (1 - part) + columns[after] * part
    return found


class Reach(NamedTuple):
    """Who is of no interest: whoever does not touch the agent's way.

    Args:
        ahead: how far along it, in m; 0 where everybody is.
        behind: how far back, in m.
        unknown: how far straight on it is taken to go at its end, in m.
    """

    ahead: float = 0.0
    behind: float = 0.0
    unknown: float = 0.0


def ways(
    frames: Sequence[Frame], agent: str, within_m: float, step_length_s: float, reach: Reach | None = None
) -> tuple[Track, Others, list[str]] | None:
    """Return what `tracks` returns of scenes at regular instants, from the core where it can.

    Args:
        frames: of an episode.
        agent: the controlled vehicle.
        within_m: as of `tracks`.
        step_length_s: in s.
        reach: the core may leave out whoever is of no interest, and numbers nobody.
    """
    core = core_of(frames)
    if core is None or _between_steps(step_length_s) > 1:
        return tracks(list(sampled(frames, step_length_s)), agent, within_m)
    numbers: dict[str, int] = {}
    every, step = _every(step_length_s), 0
    parts = []
    for frame in frames:
        whose = frame.roster.rows
        after = step + len(frame.columns)
        # Where it has a sample; who somebody is says nothing where only some are of interest.
        if reach is None and agent in frame.roster.index and -(-step // every) * every < after:
            whose = [numbers.setdefault(actor.id, len(numbers)) for actor in frame.roster.actors]
        parts.append(part_of(frame, agent, whose))
        step = after
    found = core.tracks(parts, every, within_m, *(reach or Reach()))
    if found is None:
        return tracks(list(sampled(frames, step_length_s)), agent, within_m)
    (own, steps), (theirs, pairs) = found
    if not steps:
        return None
    x, y, heading, *half = np.frombuffer(own).reshape(5, -1)
    flat = np.zeros(len(x))
    tall = np.full(len(x), next(one.height for frame in frames for one in frame.roster.actors if one.id == agent))
    time = np.frombuffer(steps, np.int64).astype(float) * step_length_s
    mine = np.array([x, y, heading, flat, *half, tall])
    sample, who = np.frombuffer(pairs, np.int64).reshape(2, -1)
    other_x, other_y, other_heading, *other_half = np.frombuffer(theirs).reshape(5, -1)
    z = np.zeros(len(sample))
    return _track(time, mine), _others([sample, who, other_x, other_y, other_heading, z, *other_half, z]), list(numbers)


def tracks(parts: Sequence[tuple[Frame, Array]], agent: str, within_m: float) -> tuple[Track, Others, list[str]] | None:
    """Return the way of an agent, those who came within a distance of it, and the names of these.

    Args:
        parts: as `sampled` yields them.
        agent: the controlled vehicle.
        within_m: between centres; whoever is a little further away may be among them.

    Returns:
        None where it is in no scene.
    """
    numbers: dict[str, int] = {}
    times: list[Array] = []
    own: list[Array] = []
    theirs: list[tuple[Any, ...]] = []
    first = 0
    for frame, instants in parts:
        row = frame.roster.index.get(agent)
        if row is None:
            continue
        names = np.array([numbers.setdefault(actor.id, len(numbers)) for actor in frame.roster.actors])
        mine, near = (_straight if frame.spines is None else _bent)(frame, row, names, within_m)
        times.append(instants)
        own.append(mine)
        theirs.append((near[0] + first, *near[1:]))
        first += len(instants)
    if not times:
        return None
    track = _track(np.concatenate(times), np.concatenate(own, axis=1))
    return track, _others([np.concatenate(column) for column in zip(*theirs, strict=True)]), list(numbers)


def _track(time: Array, fronts: Array) -> Track:
    x, y, heading, z, *sizes = fronts
    forward = np.cos(heading), np.sin(heading)
    return Track(time, x - sizes[0] * forward[0], y - sizes[0] * forward[1], np.unwrap(heading), z, *sizes)


def _others(fronts: Sequence[NDArray[Any]]) -> Others:
    sample, who, x, y, heading, z, *sizes = fronts
    x, y = x - sizes[0] * np.cos(heading), y - sizes[0] * np.sin(heading)
    return Others(sample.astype(np.intp), who.astype(np.intp), x, y, heading, z, *sizes)


def _straight(frame: Frame, row: int, names: NDArray[np.intp], within_m: float) -> tuple[Array, tuple[Any, ...]]:
    """The agent and those near it, by their fronts."""
    roster, columns, count = frame.roster, frame.columns, len(frame.roster)
    half = roster.half_sizes
    places = columns[:, : 2 * count].reshape(-1, count, 2)
    apart = places - places[:, row : row + 1]
    apart *= apart
    reach = within_m + 2 * half[:, 0] + 2 * half[row, 0]
    near = apart[:, :, 0] + apart[:, :, 1] < reach * reach
    near[:, row] = False
    sample, who = np.nonzero(near)
    rows = len(columns)
    own = np.zeros((7, rows))
    own[0], own[1] = places[:, row, 0], places[:, row, 1]
    own[2] = columns[:, 2 * count + row]
    own[4], own[5] = half[row]
    own[6] = roster.actors[row].height
    z = np.zeros(len(sample))
    tall = z
    if frame.heights is not None:
        own[3], z = frame.heights[:, row], frame.heights[sample, who]
        tall = np.array([actor.height for actor in roster.actors])[who]
    at = places[sample, who]
    size = half[who]
    return own, (sample, names[who], at[:, 0], at[:, 1], columns[sample, 2 * count + who], z, size[:, 0], size[:, 1],
                 tall)  # fmt: skip


def _bent(frame: Frame, row: int, names: NDArray[np.intp], within_m: float) -> tuple[Array, tuple[Any, ...]]:
    """The same where long vehicles are in bends: each of their parts counts as one; of the agent, the first."""
    own: list[tuple[float, ...]] = []
    theirs: list[tuple[float, ...]] = []
    for sample in range(len(frame.columns)):
        scene = frame.scene(sample)
        for who in range(len(frame.roster)):
            tall = frame.roster.actors[who].height
            for (x, y, heading, length, width), (z, _) in zip(outlines(scene, who), levels(scene, who), strict=True):
                found = x, y, heading, z, length / 2, width / 2, tall
                if who != row:
                    theirs.append((sample, names[who], *found))
                elif len(own) == sample:
                    own.append(found)
    mine, rest = np.array(own).T, np.array(theirs).reshape(-1, 9).T
    at = rest[0].astype(int)
    near = np.hypot(rest[2] - mine[0, at], rest[3] - mine[1, at]) < within_m + 2 * rest[6] + 2 * mine[4, at]
    return mine, tuple(rest[:, near])
