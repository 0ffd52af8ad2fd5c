"""Sequences that fill a space more evenly than independent draws do.

Where a crash follows from a few arguments, they find it sooner; where it is up to the seed, they are as good as random.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from crashhunt.samplers._cube import Cube
from crashhunt.samplers._protocol import HuntFacts, Proposal

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.samplers._protocol import Space
    from crashhunt.trial import TrialResult

__all__ = ["HaltonSampler", "SobolSampler"]

_LONGEST = 2**30  # points that SciPy's Sobol sequence has; the next one is the first again


class HaltonSampler:
    """The sequence of Halton (1960), scrambled by the hunt's seed as Owen (2017) does.

    Args:
        space: what to fill.
        points: not used.
        hunt: whose seed scrambles it.
    """

    learns = False
    independent = False  # the trials of one hunt depend on each other, so that counts are no binomial draws
    only_asked = False
    wants_hunt = True
    sequence: ClassVar[str] = "Halton"

    def __init__(self, space: Space, *, points: int = 10, hunt: HuntFacts = HuntFacts()) -> None:  # noqa: B008
        self._cube = Cube(space)
        self._seed = hunt.seed
        self._points: Any = None

    def ask(self, number: int, rng: np.random.Generator) -> Proposal:
        """Return the arguments whose turn it is."""
        return Proposal(self._cube.arguments(self.point(number)))

    def tell(self, result: TrialResult) -> None:
        """Nothing to learn."""

    def point(self, number: int) -> NDArray[np.float64]:
        """Return the point whose turn it is, in the cube of the arguments that vary."""
        number %= _LONGEST
        if not self._cube.dimensions:
            return np.empty(0)
        if self._points is None:
            from scipy.stats import qmc  # takes most of a second, so nobody else pays for it

            # Of its own, so that it has nothing to do with the trials' seeds.
            source = np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(0, 0)))
            self._points = getattr(qmc, self.sequence)(self._cube.dimensions, scramble=True, seed=source)
        if number < self._points.num_generated:
            self._points.reset()
        if number > self._points.num_generated:
            self._points.fast_forward(number - self._points.num_generated)
        point: NDArray[np.float64] = self._points.random(1)[0]
        return point


class SobolSampler(HaltonSampler):
    """The sequence of Sobol' (1967), scrambled by the hunt's seed as Matoušek (1998) does.

    The most even after 2, 4, 8 … trials.

    Args:
        space: what to fill; at most 21201 arguments that vary.
        points: not used.
        hunt: whose seed scrambles it.
    """

    sequence = "Sobol"
