"""What the page tells of a search: which arguments danger follows, and which trials a crash was made from."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypedDict

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from crashhunt.hunts import TrialRow
    from crashhunt.trial import TrialResult, Value

__all__ = ["UNCHOSEN", "Importance", "importance_of", "lineage_of", "values_of"]

UNCHOSEN = ("", "random", "start", "halton")
"""Origins of trials that nobody chose by what was learned, so that they are everywhere."""

_LEAST, _MOST = 40, 4000  # trials
_PARTS = 5  # of a range, with as many trials each
_RESAMPLED = 200
_INTERVAL = (5.0, 95.0)
_GENERATIONS = 50  # of a lineage; nobody reads more


class Importance(TypedDict):
    """How much of the differences in danger one argument explains alone, from 0 to 1, with an interval of 90 %."""

    name: str
    share: float
    low: float
    high: float


def values_of(row: TrialRow) -> dict[str, Value]:
    """Return all arguments of a trial by the names that the page has for them."""
    values = {
        f"{agent}.{name}" if len(row.arguments) > 1 else name: value
        for agent, given in row.arguments.items()
        for name, value in given.items()
    }
    return {**values, **row.scenario_arguments}


def importance_of(trials: Sequence[tuple[Mapping[str, Value], float]]) -> list[Importance]:
    """Return what each argument contributes to danger, the most important first.

    It is the correlation ratio of the ranks of danger over five parts of a range, or the words of a choice, without
    what chance alone would give (Kelley's epsilon squared, 1935): the share of the variance that an argument explains
    without any other. The interval is of a bootstrap over trials.

    Args:
        trials: arguments and danger, 1 for a crash, of trials that nobody chose by what was learned.

    Returns:
        Nothing where there are fewer than 40.
    """
    trials = trials[:: max(1, -(-len(trials) // _MOST))]
    if len(trials) < _LEAST:
        return []
    dangers = np.array([danger for _, danger in trials])
    ranks = np.searchsorted(np.sort(dangers), dangers, "left") + np.searchsorted(np.sort(dangers), dangers, "right")
    names = {name: None for values, _ in trials for name in values}
    rng = np.random.default_rng(0)
    again = rng.integers(len(trials), size=(_RESAMPLED, len(trials)))
    found = []
    for name in names:
        parts = _parts([values.get(name) for values, _ in trials])
        if parts.max() < 1:
            continue
        share = _explained(ranks, parts)
        shares = np.array([_explained(ranks[drawn], parts[drawn]) for drawn in again])
        shares -= shares.mean() - share  # trials that were drawn twice look as if they explained each other
        low, high = (float(end) for end in np.clip(np.percentile(shares, _INTERVAL), 0.0, 1.0))
        found.append(Importance(name=name, share=share, low=min(low, share), high=max(high, share)))
    return sorted(found, key=lambda one: -one["share"])


def _parts(values: Sequence[Value | None]) -> NDArray[np.intp]:
    """Return in which part of its range each value is, from 0; of words, which one it is."""
    kinds = list(dict.fromkeys(values))
    if len(kinds) <= _PARTS or not all(isinstance(value, int | float) for value in kinds):
        return np.array([kinds.index(value) for value in values])
    numbers = np.array(values, dtype=float)
    edges = np.unique(np.quantile(numbers, np.arange(1, _PARTS) / _PARTS))
    return np.searchsorted(edges, numbers, "right")


def _explained(ranks: NDArray[np.intp], parts: NDArray[np.intp]) -> float:
    counts = np.bincount(parts)
    sums = np.bincount(parts, ranks)
    there, total = counts > 0, len(ranks)
    whole = float(((ranks - ranks.mean()) ** 2).sum())
    between = float((sums[there] ** 2 / counts[there]).sum() - total * ranks.mean() ** 2)
    groups = int(there.sum())
    if whole <= 0.0 or total <= groups:
        return 0.0
    return max(0.0, 1.0 - (whole - between) / (total - groups) * (total - 1) / whole)


def lineage_of(number: int, trial: Callable[[int], TrialResult | None]) -> list[TrialResult]:
    """Return the trials that a trial was made from: its parent, that one's parent, and so on.

    Args:
        number: of the trial.
        trial: returns one by its number, None where it is missing.
    """
    found: list[TrialResult] = []
    result = trial(number)
    while result is not None and result.spec.parent is not None and len(found) < _GENERATIONS:
        if result.spec.parent >= result.spec.number:
            break
        result = trial(result.spec.parent)
        if result is not None:
            found.append(result)
    return found
