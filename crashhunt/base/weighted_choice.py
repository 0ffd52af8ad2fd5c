"""Random draws with weights."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np

T = TypeVar("T")


def one_of(weights: Mapping[T, float], rng: np.random.Generator) -> T:
    """Return a random value; its probability is proportional to its weight, which must be positive."""
    place = rng.random() * sum(weights.values())
    for value, weight in weights.items():
        place -= weight
        if place < 0:
            return value
    return list(weights)[-1]  # rounding may leave a remainder after the last weight
