"""Splitting: levels suggested by pilot trials, a test of these levels, and the value of a tree of copies.

The first `PILOT_ROOTS` roots have no copies. The greatest measure of each such pilot shows how rarely a level is
reached. The levels are quantiles of these greatest measures. The next `PILOT_ROOTS` roots are trees with these levels.
The hunt ends after these trees unless each level at least doubles the crash probability. Otherwise, copies from a level
give no more information than plain trials. Pilots and test trees do not count for the estimate. The levels are
therefore fixed before the first tree that counts, and the estimate has no bias.

The value of a tree is the weight of its paths that crash, which is at most 1. A tree is therefore a unit of the certain
interval like a plain trial, with a fractional number of crashes.

Source: that of `crashhunt.episode._splitting`. Cost: constant for a path.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING, Final

from crashhunt.episode import COPIES_PER_LEVEL
from crashhunt.statistics._rare import Root
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from crashhunt.trial import Forced, TrialResult

__all__ = ["PILOT_ROOTS", "choose_levels", "crash_shares", "tree_of", "why_unfit"]

PILOT_ROOTS: Final = 64
"""Roots that the levels are chosen from, and trees that test them."""
_MAX_LEVELS: Final = 3  # a further one would be reached by one of 81 pilots, which is too few for a quantile
_MAX_LEVEL_PER_S: Final = 1.0  # with less than 1 s to the collision, no noise decides about it any more
MIN_FACTOR: Final = 2.0
"""From level to level, the crash probability has to grow by this factor at least."""


def choose_levels(peaks: Sequence[float]) -> tuple[float, ...]:
    """Return the levels; each is reached by a third of the pilot trials that reach the level before it.

    Args:
        peaks: the greatest measure of each pilot trial, in 1/s; levels are above 0.
    """
    ordered = sorted((min(peak, _MAX_LEVEL_PER_S) for peak in peaks), reverse=True)
    places = [len(ordered) // COPIES_PER_LEVEL**number for number in range(1, _MAX_LEVELS + 1)]
    return tuple(sorted({ordered[place - 1] for place in places if place and ordered[place - 1] > 0.0}))


def tree_of(result: TrialResult, crash_on: Sequence[Outcome]) -> Root | None:
    """Return the value of a tree of copies; None if the tree has no complete result.

    Args:
        result: result of the tree's root trial.
        crash_on: the outcomes that count as a crash.
    """
    forced = result.forced
    if forced is None or forced.unanswered or result.outcome is Outcome.INVALID:
        return None
    paths = [(forced.survival, result.outcome in crash_on, result.disturbed)]
    paths += [(copy.weight, bool(copy.crash), copy.disturbed) for copy in forced.copies]
    undisturbed = math.fsum(weight for weight, crashed, disturbed in paths if crashed and not disturbed)
    disturbed = math.fsum(weight for weight, crashed, disturbed in paths if crashed and disturbed)
    return Root(
        undisturbed=undisturbed,
        disturbed=disturbed,
        own=min(1.0, undisturbed + disturbed),  # above 1 by rounding only
        steps=result.steps + result.other_steps,
        own_steps=result.steps + (result.setup_steps or 0),
        bound=0.0,
        crashed=result.outcome in crash_on and not result.disturbed,
    )


def crash_shares(trees: Iterable[tuple[Forced, bool]], levels: int) -> list[float]:
    """Return the crash probability of all paths, and of the paths that reach each level; NaN if no path does.

    Args:
        trees: pairs of a tree's result and whether its root trial itself crashed.
        levels: number of levels.
    """
    paths = [
        path
        for tree, crashed in trees
        for path in ((tree.survival, crashed), *((copy.weight, bool(copy.crash)) for copy in tree.copies))
    ]
    found = []
    for number in range(levels + 1):
        # A path that has reached so many levels has at most this share of its tree.
        most = COPIES_PER_LEVEL**-number * 1.001
        beyond = [(weight, crashed) for weight, crashed in paths if weight <= most]
        mass = math.fsum(weight for weight, _ in beyond)
        found.append(math.fsum(weight for weight, crashed in beyond if crashed) / mass if mass else math.nan)
    return found


def why_unfit(shares: Sequence[float]) -> str:
    """Return the reason why levels are of no use, given the result of `crash_shares`; empty if they are of use."""
    if len(shares) < 2:
        return f"in {PILOT_ROOTS} pilot roots, no agent came closer to a vehicle ahead"
    if not shares[0]:
        return f"none of {PILOT_ROOTS} pilot roots and their copies crashed"
    for number, (one, other) in enumerate(pairwise(shares), start=1):
        if math.isnan(other):
            return f"none of {PILOT_ROOTS} pilot roots and their copies reached level {number}"
        if not other >= MIN_FACTOR * one:
            before = f"from level {number - 1}" if number > 1 else "of a trial"
            return (
                f"in {PILOT_ROOTS} pilot roots, P(crash) from level {number} is {other / one:.1f} times that {before} "
                f"(at least {MIN_FACTOR:g} times)"
            )
    return ""
