"""Independent draws."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.samplers._protocol import Proposal

if TYPE_CHECKING:
    import numpy as np

    from crashhunt.samplers._protocol import Space
    from crashhunt.trial import TrialResult

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

    @property
    def independent(self) -> bool:
        """Whether draws are independent; a class made of this one that draws in another way says so for itself."""
        return type(self).ask is RandomSampler.ask

    def ask(self, number: int, rng: np.random.Generator) -> Proposal:
        """Return a draw."""
        return Proposal({key: distribution.sample(rng) for key, distribution in self._space})

    def tell(self, result: TrialResult) -> None:
        """Nothing to learn."""
