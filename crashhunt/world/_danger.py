"""How dangerous steps and trials were: by the ways that were really driven, how little it would have taken.

Two things are asked of every step, and the greater answer is its danger, from 0 (nothing near) to 1 (touched):

- How soon before or after another one was the agent where that one is? This is the post-encroachment time (PET; B. L.
  Allen, B. T. Shin and P. J. Cooper, Analysis of traffic conflicts and collisions, 1978), taken along the way that the
  agent really drove, so that oncoming traffic in a bend is no danger; of the one ahead in a queue it is the time gap.
  For t s the danger is exp(-t / 1.2 s): 0.92 for 0.1 s, 0.43 for 1 s, 0.19 for 2 s.
- Had the agent been blind from here on, and kept its speed along that way, how hard would it have had to brake at
  least, constantly, so as not to touch anybody where they really went? This is the deceleration rate to avoid a crash
  (DRAC; D. F. Cooper and N. Ferguson, Traffic studies at T-junctions, 1976) with real ways in place of constant
  velocities, within 4 s; the danger is its share of 12 m/s², which no brakes exceed. As responsibility-sensitive safety
  (RSS; S. Shalev-Shwartz, S. Shammah and A. Shashua, On a formal model of safe and scalable self-driving cars, 2017)
  it asks what comes of an agent that responds too late.

The danger of a trial grows with the time integral of that of its steps, in s, as the time integrated time to collision
does (TIT; M. M. Minderhoud and P. H. L. Bovy, Extended time-to-collision measures for road traffic safety assessment,
2001): integral / (integral + 10 s), and 1 where somebody was touched. Of several agents it is that of the one in the
greatest danger. The integral ranks trials better than the greatest danger of a step; `scripts/danger` measures that.

Whoever comes from behind on the same way is left out: that is the danger that others are to the agent, and a number of
its own (`followers_danger`), which has no part in the danger of a trial.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from crashhunt.world._outlines import LEVEL_M
from crashhunt.world._tracks import Reach, spacing_s, ways

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from crashhunt.world._scene import Frame
    from crashhunt.world._tracks import Others, Track

    Array = NDArray[np.float64]

__all__ = ["AHEAD_M", "DangerMeter", "DangerousMoment", "by_step", "dangers", "measured_along", "summed_danger"]

_HALF_S = 10.0  # a trial whose dangers add up to this has 0.5
_DECAY_S = 1.2  # in which the danger of a time gap falls to 1/e
_HARDEST = 12.0  # m/s²
_BLIND_S = 4.0  # how long the agent is taken to go on
AHEAD_M, _BEHIND_M = 100.0, 30.0  # along the way; further off is no danger worth the time
_MOVES_M = 0.01  # from sample to sample
_UNKNOWN_M = 10.0  # at the end of the way: straight on is a guess
_SAME_WAY = np.cos(np.pi / 6)  # of directions that differ by less than 30°
_PLACES = 3  # that are looked at together
_NOWHERE = 1 << 30
_HALVINGS = 5  # of the stretch in which two first touch: 4 m become 13 cm
_MOST = 0.999  # without having touched
_WINDOW, _TAIL = 4096, 128  # scenes; of longer episodes a window at a time, and what comes after the tail is seen then


class DangerousMoment(NamedTuple):
    """The most dangerous moment.

    Args:
        danger: from 0 to 1.
        step: when.
        agent: which of the controlled vehicles.
        other: who else; empty where nobody was near.
    """

    danger: float
    step: int
    agent: str
    other: str


class DangerMeter:
    """Measures the danger of an episode, after the fact, many scenes at a time.

    Args:
        agents: the controlled vehicles.
        step_length_s: in s.
    """

    def __init__(self, agents: Sequence[str], step_length_s: float) -> None:
        self._dt = step_length_s
        self._frames: list[Frame] = []
        self._count = 0  # of scenes that are here
        self._done = 0  # of them, those that are summed up already
        self._sums: dict[str, float | None] = dict.fromkeys(agents)

    def add(self, frames: Sequence[Frame]) -> None:
        """Take scenes in."""
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
        """That of all scenes so far; None where no agent was in any of them."""
        found = [total for total in self._summed(self._count).values() if total is not None]
        return summed_danger(max(found)) if found else None

    def _summed(self, until: int) -> dict[str, float | None]:
        sums = dict(self._sums)
        for agent, before in self._sums.items():
            # Whoever is not touched adds nothing to the sum.
            measured = _measured(self._frames, agent, self._dt, Reach(AHEAD_M, _BEHIND_M, _UNKNOWN_M))
            if measured is not None:
                times, found, *_ = measured
                fresh = (times >= (self._done - 0.5) * self._dt) & (times < (until - 0.5) * self._dt)
                sums[agent] = (before or 0.0) + float(found[fresh].sum()) * spacing_s(self._dt)
        return sums


def dangers(frames: Sequence[Frame], agents: Sequence[str], step_length_s: float) -> tuple[Array, DangerousMoment]:
    """Return the danger of each scene, shape (scenes,), and the most dangerous moment.

    Args:
        frames: of the whole episode, in order; what comes after a scene tells how dangerous it was.
        agents: the controlled vehicles.
        step_length_s: in s.
    """
    count = sum(len(frame.columns) for frame in frames)
    whole: Array
    whole, most = np.zeros(count), DangerousMoment(0.0, 0, agents[0] if agents else "", "")
    for agent in agents:
        measured = _measured(frames, agent, step_length_s)
        if measured is None or not len(measured[0]):
            continue
        times, found, who, names = measured
        at = int(found.argmax())
        if found[at] > most.danger:
            most = DangerousMoment(float(found[at]), round(times[at] / step_length_s), agent, names[who[at]])
        whole = np.maximum(whole, by_step(times, found, count, step_length_s))
    return whole, most


def by_step(times: Array, found: Array, count: int, step_length_s: float) -> Array:
    """Return the danger of so many scenes, each: that of the sample before it, or the greatest one within its step."""
    steps = np.clip(np.ceil(times / step_length_s - 1e-6).astype(int), 0, max(0, count - 1))
    held = np.zeros(count)
    np.maximum.at(held, steps, found)
    known = np.zeros(count, bool)
    known[steps] = True
    last = np.maximum.accumulate(np.where(known, np.arange(count), -1))
    present = (last >= 0) & (np.arange(count) <= steps[-1])
    whole: Array = np.where(present, held[last], 0.0)
    return whole


def summed_danger(integral_s: float) -> float:
    """Return the danger of a trial, from the time integral of that of its steps."""
    return integral_s / (integral_s + _HALF_S)


def _measured(
    frames: Sequence[Frame], agent: str, step_length_s: float, reach: Reach | None = None
) -> tuple[Array, Array, NDArray[np.intp], list[str]] | None:
    """Times, dangers and who else, of each sample; and the names of these."""
    seen = ways(frames, agent, AHEAD_M, step_length_s, reach)
    if seen is not None and reach is not None and _forwards(seen[0]) < 0:
        seen = ways(frames, agent, AHEAD_M, step_length_s)  # the core leaves out whom it would not touch straight on
    if seen is None:
        return None
    track, others, names = seen
    found, who = measured_along(track, others)
    return track.time, found, who, names


def measured_along(track: Track, others: Others, *, same_way: bool = False) -> tuple[Array, NDArray[np.intp]]:
    """Return the danger of each sample of a track, and the number of who else; -1 for nobody.

    Args:
        track: of whom the danger is.
        others: who came near it.
        same_way: only those count whom it would reach from behind, going their way.
    """
    gaps, brakes, who = np.full(len(track.time), np.inf), np.zeros(len(track.time)), np.full(len(track.time), -1)
    if len(others.sample):
        way = _Way(track, flat=not (track.z.any() or others.z.any()))
        ahead, behind = way.reaches_from_behind(others) if same_way else way.first_contacts(others)
        late = way.reached(way.along[others.sample] + ahead) - track.time[others.sample]
        early = track.time[others.sample] - way.reached(way.along[others.sample] - behind)
        apart = np.minimum(np.where(np.isfinite(ahead), late, np.inf), np.where(np.isfinite(behind), early, np.inf))
        order = np.lexsort((ahead, apart))[::-1]  # of each sample, the one that is left last is the nearest
        gaps[others.sample[order]], who[others.sample[order]] = apart[order], others.who[order]
        brakes, blockers = _needed_braking(way, track, others, ahead)
        harder = brakes / _HARDEST > np.exp(-gaps / _DECAY_S)
        who = np.where(harder & (blockers >= 0), blockers, who)
    found: Array = np.minimum(np.maximum(np.exp(-gaps / _DECAY_S), brakes / _HARDEST), _MOST)
    return found, who


class _Way:
    """The way that an agent drove, by how far along it is, straight on at its end, or back where it reversed."""

    def __init__(self, track: Track, *, flat: bool) -> None:
        self._track = track
        moved = np.hypot(np.diff(track.x), np.diff(track.y))
        self.along = np.concatenate(([0.0], np.cumsum(moved))) + 1e-9 * np.arange(len(track.x))  # it never stands still
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
        """When it is there, in s."""
        found: Array = np.interp(along, self._at, self._time)
        return found

    def first_contacts(self, others: Others) -> tuple[Array, Array]:
        """How far ahead of it, and behind it, its outline first touches another one; infinite where it does not.

        Behind it, only those count that go another way.
        """
        spacing = float(np.clip(1.6 * self._track.half_length.min(), 1.0, 4.0))
        ahead = self._first(others, spacing, AHEAD_M)
        behind = self._first(others, -spacing, _BEHIND_M)
        there = np.isfinite(behind)
        heading = np.interp(self.along[others.sample[there]] + behind[there], self._at, self._heading)
        behind[there] = np.where(np.cos(others.heading[there] - heading) < _SAME_WAY, -behind[there], np.inf)
        behind[~there] = np.inf
        return ahead, behind

    def reaches_from_behind(self, others: Others) -> tuple[Array, Array]:
        """As `first_contacts`, ahead and with those alone that go the same way there."""
        ahead, _ = self.first_contacts(others)
        there = np.isfinite(ahead)
        heading = np.interp(self.along[others.sample[there]] + ahead[there], self._at, self._heading)
        ahead[there] = np.where(np.cos(others.heading[there] - heading) >= _SAME_WAY, ahead[there], np.inf)
        return ahead, np.full(len(ahead), np.inf)

    def _first(self, others: Others, spacing: float, far: float) -> Array:
        """The first place where it touches each, of places that far apart, and then more closely."""
        found = np.full(len(others.sample), np.inf)
        base = self.along[others.sample]
        reach = (
            np.hypot(others.half_length, others.half_width)
            + np.hypot(self._track.half_length, self._track.half_width)[others.sample]
        )
        # A stretch of several places at a time; those of the agent are the same for all who are near it at one instant.
        stretch = _PLACES * spacing
        middles = stretch * (np.arange(int(far / abs(stretch)) + 1) + 0.5) - spacing / 2
        samples, of = np.unique(others.sample, return_inverse=True)
        at = self.along[samples, None] + middles
        at[(at < self._at[0] - far) | (at > self._at[-1] + far)] = np.nan
        x, y = np.interp(at, self._at, self._x)[of], np.interp(at, self._at, self._y)[of]
        x -= others.x[:, None]
        y -= others.y[:, None]
        around = reach + abs(stretch) / 2
        pair, place = np.nonzero(x * x + y * y < (around * around)[:, None])
        number = (place[:, None] * _PLACES + np.arange(_PLACES)).ravel()
        pair = np.repeat(pair, _PLACES)
        known = (along := base[pair] + spacing * number) <= self._at[-1]
        known &= along >= self._at[0]
        pair, number, along = pair[known], number[known], along[known]
        hit = self._apart(others, pair, along, reach[pair]) < 0
        first = np.full(len(found), _NOWHERE)
        np.minimum.at(first, pair[hit], number[hit])
        pair = np.flatnonzero(first < _NOWHERE)
        inside = spacing * first[pair]
        outside = spacing * np.maximum(first[pair] - 1, 0)
        for _ in range(_HALVINGS):
            middle = (inside + outside) / 2
            touches = self._apart(others, pair, base[pair] + middle) < 0
            inside, outside = np.where(touches, middle, inside), np.where(touches, outside, middle)
        found[pair] = inside
        return found

    def _apart(self, others: Others, pair: NDArray[np.intp], along: Array, reach: Array | None = None) -> Array:
        """How far apart the agent, somewhere on its way, and another one are; negative where they overlap.

        Beyond a reach, where one is given, it is infinite.
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
        # As `rectangle_gap` does it, by the axis on which they are furthest apart.
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
    """Return 1, or -1 where the agent reversed when it last moved; from lane to lane SUMO's vehicles move sideways."""
    moved = np.hypot(np.diff(track.x), np.diff(track.y))
    if not len(last := np.flatnonzero(moved > _MOVES_M)[-1:]):
        return 1.0
    (at,) = last
    x, y, heading = track.x[at + 1] - track.x[at], track.y[at + 1] - track.y[at], track.heading[at]
    return -1.0 if x * np.cos(heading) + y * np.sin(heading) < -moved[at] / 2 else 1.0


def _needed_braking(way: _Way, track: Track, others: Others, ahead: Array) -> tuple[Array, NDArray[np.intp]]:
    """The least constant deceleration (m/s²) with which an agent that kept its speed would touch nobody, and whom."""
    count = len(track.time)
    block, depth, who = np.full(count, np.inf), np.zeros(count), np.full(count, -1)
    order = np.argsort(-ahead, kind="stable")  # of each sample, the one that is left last is the nearest
    order = order[np.isfinite(ahead[order])]
    if not len(order):
        return depth, who
    turn = np.abs(np.cos(others.heading - track.heading[others.sample]))
    deep = 2 * (track.half_length[others.sample] + others.half_length * turn + others.half_width * np.sqrt(1 - turn**2))
    at = others.sample[order]
    block[at], depth[at], who[at] = (way.along[others.sample] + ahead)[order], deep[order], others.who[order]
    needed, blocker, met = np.zeros(count), np.full(count, -1), np.zeros(count, bool)
    spacing = float(np.diff(track.time).min()) if count > 1 else _BLIND_S
    for later in range(1, min(count, int(_BLIND_S / spacing) + 1)):
        here, there = slice(0, count - later), slice(later, count)
        seconds = track.time[there] - track.time[here]
        gone = way.speed[here] * seconds
        room = block[there] - way.along[here]
        met[here] |= (gone >= room) & (gone <= room + depth[there])
        short = met[here] & (gone > room)
        safe = np.maximum(room, 1e-3)
        brake = 2 * (gone - safe) / seconds**2
        # Who stands before that has to stop within the room.
        brake = np.where(brake * seconds > way.speed[here], way.speed[here] ** 2 / (2 * safe), brake)
        brake = np.where(short & np.isfinite(room), np.minimum(brake, _HARDEST), 0.0)
        more = brake > needed[here]
        needed[here], blocker[here] = np.where(more, brake, needed[here]), np.where(more, who[there], blocker[here])
    return needed, blocker
