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
    """Yield the scenes that are looked at, not all where steps are short, and the times of their rows, in s."""
    every, step = _every(step_length_s), 0
    for frame in frames:
        steps = np.arange(step, step + len(frame.columns))
        step += len(steps)
        rows = np.flatnonzero(steps % every == 0)
        if len(rows):
            spines = tuple(frame.spines[row] for row in rows) if frame.spines is not None else None
            heights = frame.heights[rows] if frame.heights is not None else None
            part = frame._replace(columns=frame.columns[rows], heights=heights, spines=spines)
            instants: Array = steps[rows].astype(float) * step_length_s
            yield part, instants


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
    """Return what `tracks` returns of instants that are `spacing_s` apart, from the core where it can.

    Where steps are long, what was between two scenes is put in, as if everybody who is in both had gone straight.

    Args:
        frames: of an episode.
        agent: the controlled vehicle.
        within_m: as of `tracks`.
        step_length_s: in s.
        reach: the core may leave out whoever is of no interest, and numbers nobody.
    """
    between = _between_steps(step_length_s)
    if between > 1:
        reach = None  # whoever is not on the agent's way in two scenes may be on it between them
    seen = _fronts_from_core(frames, agent, within_m, step_length_s, reach)
    seen = seen or _fronts(list(sampled(frames, step_length_s)), agent, within_m)
    if not len(seen.time):
        return None
    if between > 1:
        seen = _filled(seen, between, step_length_s)
    return _track(seen.time, seen.own), _others(seen.theirs), seen.names


def tracks(parts: Sequence[tuple[Frame, Array]], agent: str, within_m: float) -> tuple[Track, Others, list[str]] | None:
    """Return the way of an agent, those who came within a distance of it, and the names of these.

    Args:
        parts: as `sampled` yields them.
        agent: the controlled vehicle.
        within_m: between centres; whoever is a little further away may be among them.

    Returns:
        None where it is in no scene.
    """
    seen = _fronts(parts, agent, within_m)
    return (_track(seen.time, seen.own), _others(seen.theirs), seen.names) if len(seen.time) else None


class _Fronts(NamedTuple):
    """What a track is made of, with fronts in place of centres.

    Args:
        time: in s, shape (samples,).
        own: shape (7, samples): x, y, heading, z, half the length and the width, and height of the agent.
        theirs: sample and who, and the same seven of each who is near, each of shape (pairs,).
        names: of whom they number.
    """

    time: Array
    own: Array
    theirs: Sequence[NDArray[Any]]
    names: list[str]


def _fronts_from_core(
    frames: Sequence[Frame], agent: str, within_m: float, step_length_s: float, reach: Reach | None
) -> _Fronts | None:
    core = core_of(frames)
    if core is None:
        return None
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
        return None
    (own, steps), (theirs, pairs) = found
    if not steps:
        return _NOWHERE
    x, y, heading, *half = np.frombuffer(own).reshape(5, -1)
    flat = np.zeros(len(x))
    tall = np.full(len(x), next(one.height for frame in frames for one in frame.roster.actors if one.id == agent))
    time = np.frombuffer(steps, np.int64).astype(float) * step_length_s
    mine = np.array([x, y, heading, flat, *half, tall])
    sample, who = np.frombuffer(pairs, np.int64).reshape(2, -1)
    other_x, other_y, other_heading, *other_half = np.frombuffer(theirs).reshape(5, -1)
    z = np.zeros(len(sample))
    return _Fronts(time, mine, [sample, who, other_x, other_y, other_heading, z, *other_half, z], list(numbers))


def _fronts(parts: Sequence[tuple[Frame, Array]], agent: str, within_m: float) -> _Fronts:
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
        return _NOWHERE
    columns = [np.concatenate(column) for column in zip(*theirs, strict=True)]
    return _Fronts(np.concatenate(times), np.concatenate(own, axis=1), columns, list(numbers))


_NOWHERE = _Fronts(np.zeros(0), np.zeros((7, 0)), [np.zeros(0)] * 9, [])


def _filled(seen: _Fronts, between: int, step_length_s: float) -> _Fronts:
    """Put in what was between two scenes: of everybody who is in both, as if they had gone straight."""
    time, own, theirs, names = seen
    joined = np.diff(time) < 1.5 * step_length_s  # the agent may have been away for some steps
    size = np.append(np.where(joined, between, 1), 1)
    first = np.cumsum(size) - size
    share = np.arange(1, between) / between
    whole = np.empty((len(own) + 1, int(size.sum())))
    whole[:, first] = np.vstack((time, own))
    start = np.flatnonzero(joined)
    whole[:, (first[start, None] + np.arange(1, between)).ravel()] = _between(
        whole[:, first], start, start + 1, share, 3
    )
    # Of long vehicles in bends each part counts, from front to back: the last one stands for those that it has not.
    sample, who, *_ = theirs
    order = np.lexsort((sample, who))
    pairs = np.array([np.asarray(column, float)[order] for column in theirs])
    begins = np.flatnonzero(np.append(True, (np.diff(pairs[0]) != 0) | (np.diff(pairs[1]) != 0))[: len(order)])
    parts = np.diff(np.append(begins, len(order)))
    here = np.flatnonzero((np.diff(pairs[1, begins]) == 0) & (np.diff(pairs[0, begins]) == 1))
    here = here[joined[pairs[0, begins[here]].astype(int)]]
    most = np.maximum(parts[here], parts[here + 1])
    part = np.arange(most.sum()) - np.repeat(np.cumsum(most) - most, most)
    here = np.repeat(here, most)
    old, new = (begins[at] + np.minimum(part, parts[at] - 1) for at in (here, here + 1))
    put_in = _between(pairs, old, new, share, 4)
    put_in[0] = (first[pairs[0, old].astype(int), None] + np.arange(1, between)).ravel()
    pairs[0] = first[pairs[0].astype(int)]
    return _Fronts(whole[0], whole[1:], list(np.hstack((pairs, put_in))), names)


def _between(columns: Array, old: NDArray[np.intp], new: NDArray[np.intp], share: Array, heading: int) -> Array:
    """Return what is so far from old columns to new ones, each as often as there are shares; a row has headings."""
    before, after = columns[:, old, None], columns[:, new, None].copy()
    turned = after[heading] - before[heading]
    after[heading] -= math.tau * np.round(turned / math.tau)  # the short way round
    found: Array = (before * (1 - share) + after * share).reshape(len(columns), -1)
    return found


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
