"""Independent draws."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from crashhunt.samplers._protocol import Key, Space
    from crashhunt.trial import TrialResult, Value

__all__ = ["RandomSampler"]


class RandomSampler:
    """Draws every argument independently in every trial.

    Args:
        space: what to draw from.
        points: not used.
    """

    learns = False
    only_asked = False

    def __init__(self, space: Space, *, points: int = 10) -> None:
        self._space = sorted(space.items())

    def ask(self, number: int, rng: np.random.Generator) -> dict[Key, Value]:
        """Return a draw."""
        return {key: distribution.sample(rng) for key, distribution in self._space}

    def tell(self, result: TrialResult) -> None:
        """Nothing to learn."""
