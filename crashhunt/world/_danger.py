"""Criticality of steps and trials, from 0 (nothing near) to 1 (contact), measured along real paths.

The criticality of a step is the greater of two measures:

- Post-encroachment time (PET; Allen, Shin and Cooper, Analysis of traffic conflicts and collisions, 1978): the time
  between the agent's and another actor's presence at the same place. PET is measured along the path that the agent
  really drove, so oncoming traffic in a bend does not count. For the vehicle ahead in a queue, this is the time gap.
  For a PET of t s, the criticality is exp(-t / 1.2 s): 0.92 for 0.1 s, 0.43 for 1 s, 0.19 for 2 s.
- Deceleration rate to avoid a crash (DRAC; Cooper and Ferguson, Traffic studies at T-junctions, 1976). DRAC is the
  least constant deceleration with which the agent, on the path that it drove, touches no actor within 4 s. Actors move
  along their real paths, not at constant velocities. The criticality is the ratio of this deceleration to 12 m/s²,
  which exceeds the braking of any vehicle. The agent is assumed to respond late, as in responsibility-sensitive safety
  (RSS; Shalev-Shwartz, Shammah and Shashua, On a formal model of safe and scalable self-driving cars, 2017).

The criticality of a trial is integral / (integral + 10 s), and 1 after a touch. The integral is the time integral of
the criticality over the steps, in s. It resembles the time integrated time to collision (TIT; Minderhoud and Bovy,
Extended time-to-collision measures for road traffic safety assessment, 2001). If there are several agents, the maximum
over the agents counts.

Reason for the integral: it ranks trials better than the maximum over steps, as measured by
`scripts/studies/run criticality`. Reason for real paths: with constant velocities, every oncoming vehicle in a bend
would be on a collision course.

Invariant: actors that approach from behind on the same path do not count. The criticality of such actors is the rear
criticality, a separate number (`followers_danger`).

Cost: only actors within reach of the path are tested, at positions 1 m to 4 m apart (0.8 of the agent's length). Each
first touch is refined by bisection. Long episodes are summed in windows of 4096 scenes, so memory stays bounded.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from crashhunt.world._geometry import LEVEL_M
from crashhunt.world._tracks import Others, Reach, Track, spacing_s, ways

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from crashhunt.world._scene import Frame

    Array = NDArray[np.float64]


_HALF_S = 10.0  # integral at which a trial has criticality 0.5
_DECAY_S = 1.2  # time gap at which the criticality falls to 1/e
_MAX_BRAKING_MPS2 = 12.0  # m/s²: more than any vehicle can brake
_BLIND_S = 4.0  # time for which the agent is assumed to keep its speed
AHEAD_M, _BEHIND_M = 100.0, 30.0  # along the way: actors beyond that add almost nothing and cost time
_MOVES_M = 0.01  # from sample to sample: less counts as standing
_UNKNOWN_M = 10.0  # beyond the end of the way: continuing straight on is a guess
_SAME_DIRECTION_COSINE = np.cos(np.pi / 6)  # directions that differ by less than 30° are the same
_PLACES_PER_CALL = 3  # places that are tested in one call
_NO_INDEX = 1 << 30  # index beyond all samples
_BISECTIONS = 5  # bisections of the stretch of a first touch: 4 m become 13 cm
_MAX_DANGER_WITHOUT_CONTACT = 0.999  # upper bound without a touch
_WINDOW, _TAIL = 4096, 128  # scenes: long episodes are summed per window; the tail waits for the ways that follow


class DangerousMoment(NamedTuple):
    """The most critical moment of an episode."""

    danger: float  # criticality, from 0 to 1
    step: int  # number of the step
    agent: str  # identifier of the controlled vehicle
    other: str  # identifier of the other actor; empty if no actor was near


class DangerMeter:
    """Measures the criticality of an episode after it has been recorded, many scenes at a time."""

    def __init__(self, agents: Sequence[str], step_length_s: float) -> None:
        self._dt = step_length_s
        self._frames: list[Frame] = []
        self._count = 0  # of scenes in memory
        self._done = 0  # of these, the scenes that are in the sums already
        self._sums: dict[str, float | None] = dict.fromkeys(agents)

    def add(self, frames: Sequence[Frame]) -> None:
        """Add scenes, and compute the criticality of each window of scenes that they complete."""
        self._frames += frames
        self._count += sum(len(frame.columns) for frame in frames)
        if self._count >= _WINDOW:
            until = self._count - _TAIL
            self._sums, self._done = self._summed(until), until
            while self._frames and self._done - len(self._frames[0].columns) >= _TAIL:
                gone = len(self._frames.pop(0).columns)
                self._count, self._done = self._count - gone, self._done - gone

    @property
    def danger(self) -> float | None:
        """Return the criticality of all added scenes; None if no scene contains an agent."""
        found = [total for total in self._summed(self._count).values() if total is not None]
        return summed_danger(max(found)) if found else None

    def _summed(self, until: int) -> dict[str, float | None]:
        sums = dict(self._sums)
        for agent, before in self._sums.items():
            if not any(agent in frame.roster.index for frame in self._frames):
                continue
            # Actors that the agent does not touch add nothing to the sum.
            measured = _measured(self._frames, agent, self._dt, Reach(AHEAD_M, _BEHIND_M, _UNKNOWN_M))
            if measured is not None:
                times, found, *_ = measured
                fresh = (times >= (self._done - 0.5) * self._dt) & (times < (until - 0.5) * self._dt)
                sums[agent] = (before or 0.0) + float(found[fresh].sum()) * spacing_s(self._dt)
        return sums


def dangers(frames: Sequence[Frame], agents: Sequence[str], step_length_s: float) -> tuple[Array, DangerousMoment]:
    """Return the criticality of each scene, shape (scenes,), and the most critical moment.

    The frames are those of the whole episode, because later scenes determine the criticality of earlier ones.
    """
    count = sum(len(frame.columns) for frame in frames)
    whole: Array
    whole, most = np.zeros(count), DangerousMoment(danger=0.0, step=0, agent=agents[0] if agents else "", other="")
    for agent in agents:
        measured = _measured(frames, agent, step_length_s)
        if measured is None or not len(measured[0]):
            continue
        times, found, who, names = measured
        at = int(found.argmax())
        if found[at] > most.danger:
            step = int(_steps_of(times, count, step_length_s)[at])
            most = DangerousMoment(danger=float(found[at]), step=step, agent=agent, other=names[who[at]])
        whole = np.maximum(whole, by_step(times, found, count, step_length_s))
    return whole, most


def by_step(times: Array, found: Array, count: int, step_length_s: float) -> Array:
    """Return the criticality of each scene: of the latest sample before it, or the greatest sample in its step."""
    steps = _steps_of(times, count, step_length_s)
    held = np.zeros(count)
    np.maximum.at(held, steps, found)
    known = np.zeros(count, bool)
    known[steps] = True
    last = np.maximum.accumulate(np.where(known, np.arange(count), -1))
    present = (last >= 0) & (np.arange(count) <= steps[-1])
    whole: Array = np.where(present, held[last], 0.0)
    return whole


def _steps_of(times: Array, count: int, step_length_s: float) -> NDArray[np.int_]:
    """Return the number of the step in which each sample lies."""
    steps: NDArray[np.int_] = np.clip(np.ceil(times / step_length_s - 1e-6).astype(int), 0, max(0, count - 1))
    return steps


def summed_danger(integral_s: float) -> float:
    """Return the criticality of a trial from the time integral over its steps, in s."""
    return integral_s / (integral_s + _HALF_S)


def _measured(
    frames: Sequence[Frame], agent: str, step_length_s: float, reach: Reach | None = None
) -> tuple[Array, Array, NDArray[np.intp], list[str]] | None:
    """Return times, criticalities and other actor (-1 for none) of each sample, and the names of the actors."""
    seen = ways(frames, agent, AHEAD_M, step_length_s, reach)
    if seen is not None and reach is not None and _forwards(seen[0]) < 0:
        seen = ways(frames, agent, AHEAD_M, step_length_s)  # the core skips actors that are off the way
    if seen is None:
        return None
    track, others, names = seen
    found, who = measured_along(track, others)
    return track.time, found, who, names


def measured_along(track: Track, others: Others, *, same_way: bool = False) -> tuple[Array, NDArray[np.intp]]:
    """Return the criticality of each sample of a path, and the number of the other actor (-1 for none).

    With ``same_way``, only those actors count that the agent would hit from behind, driving in the same direction.
    """
    gaps, brakes, who = np.full(len(track.time), np.inf), np.zeros(len(track.time)), np.full(len(track.time), -1)
    if len(others.sample):
        way = _Way(track, flat=not (track.z.any() or others.z.any()))
        ahead, behind = way.reaches_from_behind(others) if same_way else way.first_contacts(others)
        late = way.reached(way.along[others.sample] + ahead) - track.time[others.sample]
        early = track.time[others.sample] - way.reached(way.along[others.sample] - behind)
        apart = np.minimum(np.where(np.isfinite(ahead), late, np.inf), np.where(np.isfinite(behind), early, np.inf))
        order = np.lexsort((ahead, apart))[::-1]  # the last assignment per sample wins, and it is the nearest
        gaps[others.sample[order]], who[others.sample[order]] = apart[order], others.who[order]
        brakes, blockers = _needed_braking(way, track, others, ahead)
        harder = brakes / _MAX_BRAKING_MPS2 > np.exp(-gaps / _DECAY_S)
        who = np.where(harder & (blockers >= 0), blockers, who)
    found: Array = np.minimum(
        np.maximum(np.exp(-gaps / _DECAY_S), brakes / _MAX_BRAKING_MPS2), _MAX_DANGER_WITHOUT_CONTACT
    )
    return found, who


class _Way:
    """The path that an agent drove, as a function of the distance along it, continued in a straight line."""

    def __init__(self, track: Track, *, flat: bool) -> None:
        self._track = track
        moved = np.hypot(np.diff(track.x), np.diff(track.y))
        self.along = np.concatenate(([0.0], np.cumsum(moved))) + 1e-9 * np.arange(len(track.x))  # strictly increasing
        seconds = np.diff(track.time)
        self.speed = np.append(moved[:1] / seconds[:1], moved / seconds) if len(moved) else np.zeros(1)
        on, way = _UNKNOWN_M, _UNKNOWN_M * _forwards(track)
        self._at = np.append(self.along, self.along[-1] + on)
        self._x = np.append(track.x, track.x[-1] + way * np.cos(track.heading[-1]))
        self._y = np.append(track.y, track.y[-1] + way * np.sin(track.heading[-1]))
        self._flat = flat
        self._heading, self._z = np.append(track.heading, track.heading[-1]), np.append(track.z, track.z[-1])
        self._time = np.append(track.time, track.time[-1] + on / max(float(self.speed[-1]), 0.1))

    def reached(self, along: Array) -> Array:
        """Return the time at which the agent reaches a distance along its path, in s."""
        found: Array = np.interp(along, self._at, self._time)
        return found

    def first_contacts(self, others: Others) -> tuple[Array, Array]:
        """Return the distances ahead and behind at which the agent's outline first touches each actor, or infinity.

        Behind the agent, only actors that drive in another direction count.
        """
        spacing = float(np.clip(1.6 * self._track.half_length.min(), 1.0, 4.0))
        ahead, behind = self._first(others, spacing)
        there = np.isfinite(behind)
        heading = np.interp(self.along[others.sample[there]] + behind[there], self._at, self._heading)
        behind[there] = np.where(
            np.cos(others.heading[there] - heading) < _SAME_DIRECTION_COSINE, -behind[there], np.inf
        )
        behind[~there] = np.inf
        return ahead, behind

    def reaches_from_behind(self, others: Others) -> tuple[Array, Array]:
        """Return the distances ahead as in `first_contacts`, only for actors that drive in the same direction."""
        ahead, _ = self.first_contacts(others)
        there = np.isfinite(ahead)
        heading = np.interp(self.along[others.sample[there]] + ahead[there], self._at, self._heading)
        ahead[there] = np.where(np.cos(others.heading[there] - heading) >= _SAME_DIRECTION_COSINE, ahead[there], np.inf)
        return ahead, np.full(len(ahead), np.inf)

    def _first(self, others: Others, spacing: float) -> tuple[Array, Array]:
        """Return the first positions of contact with each actor ahead and behind, found at fixed distances and refined.

        One search for both sides costs less, because half of its time is the overhead of calls.
        """
        count, base = len(others.sample), self.along[others.sample]
        found = np.full(2 * count, np.inf)  # all positions ahead, then all behind
        reach = (
            np.hypot(others.half_length, others.half_width)
            + np.hypot(self._track.half_length, self._track.half_width)[others.sample]
        )
        # Test several places at a time; all actors of one instant share the places of the agent.
        stretch = _PLACES_PER_CALL * spacing
        ahead, behind = (
            stretch * (np.arange(int(far / stretch) + 1) + 0.5) - spacing / 2 for far in (AHEAD_M, _BEHIND_M)
        )
        far = np.repeat((AHEAD_M, _BEHIND_M), (len(ahead), len(behind)))
        samples, of = np.unique(others.sample, return_inverse=True)
        at = self.along[samples, None] + np.append(ahead, -behind)
        at[(at < self._at[0] - far) | (at > self._at[-1] + far)] = np.nan
        x, y = np.interp(at, self._at, self._x)[of], np.interp(at, self._at, self._y)[of]
        x -= others.x[:, None]
        y -= others.y[:, None]
        around = reach + stretch / 2
        pair, place = np.nonzero(x * x + y * y < (around * around)[:, None])
        side = place >= len(ahead)
        number = ((place - len(ahead) * side)[:, None] * _PLACES_PER_CALL + np.arange(_PLACES_PER_CALL)).ravel()
        pair, side = np.repeat(pair, _PLACES_PER_CALL), np.repeat(side, _PLACES_PER_CALL)
        known = (along := base[pair] + np.where(side, -spacing, spacing) * number) <= self._at[-1]
        known &= along >= self._at[0]
        pair, side, number, along = pair[known], side[known], number[known], along[known]
        hit = self._apart(others, pair, along, reach[pair]) < 0
        first = np.full(len(found), _NO_INDEX)
        np.minimum.at(first, (pair + count * side)[hit], number[hit])
        row = np.flatnonzero(first < _NO_INDEX)
        pair, way = row % max(count, 1), np.where(row < count, spacing, -spacing)
        inside = way * first[row]
        outside = way * np.maximum(first[row] - 1, 0)
        for _ in range(_BISECTIONS):
            middle = (inside + outside) / 2
            touches = self._apart(others, pair, base[pair] + middle) < 0
            inside, outside = np.where(touches, middle, inside), np.where(touches, outside, middle)
        found[row] = inside
        return found[:count], found[count:]

    def _apart(self, others: Others, pair: NDArray[np.intp], along: Array, reach: Array | None = None) -> Array:
        """Return the distance between the agent at positions on its path and other actors; negative if they overlap.

        If `reach` is given, larger distances are returned as infinite.
        """
        x, y = np.interp(along, self._at, self._x), np.interp(along, self._at, self._y)
        dx, dy = others.x[pair] - x, others.y[pair] - y
        if reach is not None:
            near = np.flatnonzero(dx * dx + dy * dy < reach * reach)
            far = np.full(len(pair), np.inf)
            far[near] = self._apart(others, pair[near], along[near])
            return far
        track, sample = self._track, others.sample[pair]
        heading = np.interp(along, self._at, self._heading)
        turn = others.heading[pair] - heading
        c, s = np.cos(heading), np.sin(heading)
        along_turn, across_turn = np.cos(turn), np.sin(turn)
        long, wide = np.abs(along_turn), np.abs(across_turn)
        own_l, own_w, its_l, its_w = (
            half[rows]
            for half, rows in (
                (track.half_length, sample),
                (track.half_width, sample),
                (others.half_length, pair),
                (others.half_width, pair),
            )
        )
        x, y = dx * c + dy * s, dy * c - dx * s
        # Separating axis, as in `rectangle_gap`.
        found: Array = np.abs(x) - own_l - its_l * long - its_w * wide
        np.maximum(found, np.abs(y) - own_w - its_l * wide - its_w * long, out=found)
        np.maximum(found, np.abs(x * along_turn + y * across_turn) - its_l - own_l * long - own_w * wide, out=found)
        np.maximum(found, np.abs(y * along_turn - x * across_turn) - its_w - own_l * wide - own_w * long, out=found)
        if self._flat:
            return found
        above = others.z[pair] - np.interp(along, self._at, self._z)
        lower = np.where(above > 0, track.height[sample], others.height[pair])
        return np.where(np.abs(above) < np.maximum(LEVEL_M, lower), found, np.inf)


def _forwards(track: Track) -> float:
    """Return for each sample 1, or -1 if the agent last moved backwards; lane changes do not count as movements."""
    moved = np.hypot(np.diff(track.x), np.diff(track.y))
    if not len(last := np.flatnonzero(moved > _MOVES_M)[-1:]):
        return 1.0
    (at,) = last
    x, y, heading = track.x[at + 1] - track.x[at], track.y[at + 1] - track.y[at], track.heading[at]
    return -1.0 if x * np.cos(heading) + y * np.sin(heading) < -moved[at] / 2 else 1.0


def _needed_braking(way: _Way, track: Track, others: Others, ahead: Array) -> tuple[Array, NDArray[np.intp]]:
    """Return the least constant deceleration (m/s²) that avoids all touches, and the actor that requires it."""
    count = len(track.time)
    block, depth, who = np.full(count, np.inf), np.zeros(count), np.full(count, -1)
    order = np.argsort(-ahead, kind="stable")  # the last assignment per sample wins, and it is the nearest
    order = order[np.isfinite(ahead[order])]
    if not len(order):
        return depth, who
    turn = np.abs(np.cos(others.heading - track.heading[others.sample]))
    deep = 2 * (track.half_length[others.sample] + others.half_length * turn + others.half_width * np.sqrt(1 - turn**2))
    at = others.sample[order]
    block[at], depth[at], who[at] = (way.along[others.sample] + ahead)[order], deep[order], others.who[order]
    spacing = float(np.diff(track.time).min()) if count > 1 else _BLIND_S
    later = np.arange(1, min(count, int(_BLIND_S / spacing) + 1))[:, None]
    if not len(later):
        return np.zeros(count), np.full(count, -1)
    # Rows are the later samples, columns the samples from which the agent would have to brake.
    there = np.arange(count) + later
    known = there < count
    np.minimum(there, count - 1, out=there)
    seconds = np.where(known, track.time[there] - track.time, 1.0)
    gone, room = way.speed * seconds, block[there] - way.along
    met = np.logical_or.accumulate(known & (gone >= room) & (gone <= room + depth[there]), axis=0)
    safe = np.maximum(room, 1e-3)
    brake = 2 * (gone - safe) / seconds**2
    # An actor that stands before then must stop within the room.
    brake = np.where(brake * seconds > way.speed, way.speed**2 / (2 * safe), brake)
    short = known & met & (gone > room) & np.isfinite(room) & (brake > 0.0)
    brake = np.where(short, np.minimum(brake, _MAX_BRAKING_MPS2), 0.0)
    needed: Array = brake.max(axis=0)
    return needed, np.where(needed > 0.0, who[there[brake.argmax(axis=0), np.arange(count)]], -1)


# Rear criticality: how critical actors were that closed in on an agent from behind, which the agent cannot prevent.
#
# The two measures of the head of this module are computed for every other actor with regard to the agent alone. They
# count only where the actor's way leads into the back of the agent, both in the same direction. Crossing and oncoming
# actors belong to the agent's own criticality.

_MIN_SAMPLES = 2  # samples: a single one has no speed
_SIDEWAYS_M = 10.0  # from the line through the agent: an actor never within it is not behind the agent


def followers_danger(frames: Sequence[Frame], agent: str, step_length_s: float) -> tuple[Array, DangerousMoment, float]:
    """Return the rear criticality of an agent, caused by actors that approach the agent from behind.

    The rear criticality is computed from a recording. For articulated vehicles, only the first part counts. The frames
    are those of the whole episode, in order.

    Returns:
        The rear criticality of each scene, shape (scenes,); the most critical moment; and the value of the trial,
        from 0 to below 1. The ``other`` of the most critical moment is the actor that approaches from behind.
    """
    count = sum(len(frame.columns) for frame in frames)
    nothing = DangerousMoment(danger=0.0, step=0, agent=agent, other="")
    seen = ways(frames, agent, AHEAD_M, step_length_s)
    if seen is None or not len(seen[0].time):
        return np.zeros(count), nothing, 0.0
    track, others, names = seen
    found, who = np.zeros(len(track.time)), np.full(len(track.time), -1)
    for number in _behind(track, others):
        for samples, theirs, own in _pieces(track, others, number):
            danger, _ = measured_along(theirs, own, same_way=True)
            more = danger > found[samples]
            found[samples[more]], who[samples[more]] = danger[more], number
    whole = by_step(track.time, found, count, step_length_s)
    total = summed_danger(float(found.sum()) * spacing_s(step_length_s))
    at = int(found.argmax())
    if who[at] < 0:
        return whole, nothing, total
    step = int(_steps_of(track.time, count, step_length_s)[at])
    return whole, DangerousMoment(danger=float(found[at]), step=step, agent=agent, other=names[who[at]]), total


def _behind(track: Track, others: Others) -> list[int]:
    """Return the numbers of actors that were behind the agent at any time, near its path and in its direction."""
    at = others.sample
    c, s = np.cos(track.heading[at]), np.sin(track.heading[at])
    x, y = others.x - track.x[at], others.y - track.y[at]
    ahead, aside = x * c + y * s, np.abs(y * c - x * s)
    # In a bend, an actor behind is to the side as well.
    near = (ahead < 0) & (aside < _SIDEWAYS_M - ahead) & (np.cos(others.heading - track.heading[at]) > 0)
    return [int(number) for number in np.unique(others.who[near])]


def _pieces(track: Track, others: Others, number: int) -> Iterator[tuple[NDArray[np.intp], Track, Others]]:
    """Yield the paths of an actor while it was near, with the samples of the agent as the only other actor."""
    rows = np.flatnonzero(others.who == number)
    samples, first = np.unique(others.sample[rows], return_index=True)
    rows = rows[first]
    for part in np.split(np.arange(len(samples)), np.flatnonzero(np.diff(samples) > 1) + 1):
        if len(part) < _MIN_SAMPLES:
            continue
        here, these = samples[part], rows[part]
        theirs = Track(
            time=track.time[here],
            x=others.x[these],
            y=others.y[these],
            heading=np.unwrap(others.heading[these]),
            z=others.z[these],
            half_length=others.half_length[these],
            half_width=others.half_width[these],
            height=others.height[these],
        )
        own = Others(np.arange(len(here)), np.zeros(len(here), np.intp), *(column[here] for column in track[1:]))
        yield here, theirs, own
