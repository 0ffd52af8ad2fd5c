"""How dangerous others were to an agent that they closed in on from behind, which is not for the agent to mend.

Of everybody else the same two questions are asked as of an agent (see `crashhunt.world.dangers`), with regard to the
agent alone, and only where its way would have led into the back of the agent, both going the same way. So whoever
crosses or comes towards the agent is not in it: that is the agent's own danger.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from crashhunt.world._danger import AHEAD_M, DangerousMoment, by_step, measured_along, summed_danger
from crashhunt.world._tracks import Others, Track, spacing_s, ways

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from crashhunt.world._scene import Frame

    Array = NDArray[np.float64]

__all__ = ["followers_danger"]

_LEAST = 2  # samples; of one alone nobody knows how fast it was
_SIDEWAYS_M = 10.0  # off the line through the agent, behind it; who never is within it, is not behind it


def followers_danger(frames: Sequence[Frame], agent: str, step_length_s: float) -> tuple[Array, DangerousMoment, float]:
    """Return the danger that those behind an agent were to it.

    It is measured after the fact, from a recording. Of long vehicles that bend, the first part counts.

    Args:
        frames: of the whole episode, in order.
        agent: the controlled vehicle.
        step_length_s: in s.

    Returns:
        That of each scene, shape (scenes,); the most dangerous moment, whose ``other`` is who closed in; and the
        integral over the trial, as the danger of a trial is one: from 0 to below 1.
    """
    count = sum(len(frame.columns) for frame in frames)
    nothing = DangerousMoment(0.0, 0, agent, "")
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
    return whole, DangerousMoment(float(found[at]), round(track.time[at] / step_length_s), agent, names[who[at]]), total


def _behind(track: Track, others: Others) -> list[int]:
    """Who was behind the agent at any time, not far to the side, and not heading against it."""
    at = others.sample
    c, s = np.cos(track.heading[at]), np.sin(track.heading[at])
    x, y = others.x - track.x[at], others.y - track.y[at]
    ahead, aside = x * c + y * s, np.abs(y * c - x * s)
    # In a bend, who is behind is to the side as well.
    near = (ahead < 0) & (aside < _SIDEWAYS_M - ahead) & (np.cos(others.heading - track.heading[at]) > 0)
    return [int(number) for number in np.unique(others.who[near])]


def _pieces(track: Track, others: Others, number: int) -> Iterator[tuple[NDArray[np.intp], Track, Others]]:
    """The ways of another one while it was near, with the samples of the agent, which is who it may reach."""
    rows = np.flatnonzero(others.who == number)
    samples, first = np.unique(others.sample[rows], return_index=True)
    rows = rows[first]
    for part in np.split(np.arange(len(samples)), np.flatnonzero(np.diff(samples) > 1) + 1):
        if len(part) < _LEAST:
            continue
        here, these = samples[part], rows[part]
        theirs = Track(
            track.time[here],
            others.x[these],
            others.y[these],
            np.unwrap(others.heading[these]),
            others.z[these],
            others.half_length[these],
            others.half_width[these],
            others.height[these],
        )
        own = Others(np.arange(len(here)), np.zeros(len(here), np.intp), *(column[here] for column in track[1:]))
        yield here, theirs, own
