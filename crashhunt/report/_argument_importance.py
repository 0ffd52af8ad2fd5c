"""The importance of each argument for the criticality of the trials of a hunt."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypedDict

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from crashhunt.trial import Value


_IMPORTANCE_PARTS = 5  # of a range, with as many trials each
_BOOTSTRAP_RESAMPLES = 200
_INTERVAL_PERCENTILES = (5.0, 95.0)
_LEAST = 40  # trials
MOST_WEIGHED = 4000  # trials


class Importance(TypedDict):
    """The share of the variation of criticality that one argument explains alone, 0 to 1, with a 90 % interval."""

    name: str
    share: float
    low: float
    high: float


def importance_of(trials: Sequence[tuple[Mapping[str, Value], float]]) -> list[Importance]:
    """Return the contribution of each argument to the criticality, the most important argument first.

    The contribution is the correlation ratio of the ranks of criticality over five parts of a range, or over the
    options of a choice. The value expected by chance alone is subtracted (Kelley's epsilon squared, 1935). The result
    is the share of the variance that an argument explains without the other arguments. The interval comes from a
    bootstrap over trials.

    Args:
        trials: arguments and criticality (1 for a crash) of trials that the search did not guide.

    Returns:
        The contributions; an empty list for fewer than 40 trials.
    """
    if len(trials) > MOST_WEIGHED:
        trials = [trials[place * len(trials) // MOST_WEIGHED] for place in range(MOST_WEIGHED)]
    if len(trials) < _LEAST:
        return []
    dangers = np.array([danger for _, danger in trials])
    ranks = np.searchsorted(np.sort(dangers), dangers, "left") + np.searchsorted(np.sort(dangers), dangers, "right")
    names = {name: None for values, _ in trials for name in values}
    rng = np.random.default_rng(0)
    again = rng.integers(len(trials), size=(_BOOTSTRAP_RESAMPLES, len(trials)))
    found = []
    for name in names:
        parts = _range_parts([values.get(name) for values, _ in trials])
        if parts.max() < 1:
            continue
        share = _explained(ranks, parts)
        shares = np.array([_explained(ranks[drawn], parts[drawn]) for drawn in again])
        shares -= shares.mean() - share  # trials that were drawn twice look as if they explained each other
        low, high = (float(end) for end in np.clip(np.percentile(shares, _INTERVAL_PERCENTILES), 0.0, 1.0))
        found.append(Importance(name=name, share=share, low=min(low, share), high=max(high, share)))
    return sorted(found, key=lambda one: -one["share"])


def _range_parts(values: Sequence[Value | None]) -> NDArray[np.intp]:
    """Return for each value the part of the range that contains the value, counted from 0; for text, its index."""
    kinds = list(dict.fromkeys(values))
    if len(kinds) <= _IMPORTANCE_PARTS or not all(isinstance(value, int | float) for value in kinds):
        return np.array([kinds.index(value) for value in values])
    numbers = np.array(values, dtype=float)
    edges = np.unique(np.quantile(numbers, np.arange(1, _IMPORTANCE_PARTS) / _IMPORTANCE_PARTS))
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
