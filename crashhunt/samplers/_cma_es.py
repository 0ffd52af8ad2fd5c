"""CMA-ES (Hansen 2001), of the package ``cmaes``: learns in which directions of the space danger grows."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

import numpy as np

from crashhunt.base.errors import UsageError
from crashhunt.samplers._elites import Elites
from crashhunt.samplers._strategy import Draft

if TYPE_CHECKING:
    from crashhunt.samplers._cube import Cube
    from crashhunt.samplers._told import Told

__all__ = ["CmaEs"]

_FIRST = 10  # trials before it begins, at the most dangerous of them
_SIGMA = 0.2


class CmaEs:
    """One run after the other, each from the most dangerous of ten trials: of the first, or those after the last run.

    Among these may be what that run itself proposed, where it ended.

    Args:
        cube: of the arguments.

    Raises:
        UsageError: the package is not installed.
    """

    def __init__(self, cube: Cube) -> None:
        try:
            self._cmaes: Any = importlib.import_module("cmaes")
        except ImportError:
            raise UsageError(
                "the sampler 'cma-es' needs the package cmaes", fix="pip install 'crashhunt[search]'"
            ) from None
        self._dimensions = cube.dimensions
        self._elites = Elites(_FIRST)
        self._run: Any = None
        self._generation: list[tuple[Any, float]] = []

    def tell(self, told: Told) -> None:
        """Take it into the generation; a full one moves the distribution."""
        self._elites.add(told)
        if self._dimensions < 2:
            return
        if self._run is None:
            if len(self._elites) >= _FIRST:
                self._begin(self._elites[0].point)
            return
        if told.origin != "cma-es":
            return
        self._generation.append((told.point, -told.score))
        if len(self._generation) == self._run.population_size:
            self._run.tell(self._generation)
            self._generation = []
            if self._run.should_stop():
                self._run = None
                self._elites = Elites(_FIRST)

    def propose(self, place: int, rng: np.random.Generator) -> Draft | None:
        """Return a draw from the distribution as it is now."""
        if self._run is None:
            return None
        self._run.reseed_rng(int(rng.integers(2**31)))
        return Draft(np.clip(self._run.ask(), 0.0, 1.0))

    def _begin(self, point: Any) -> None:
        bounds = np.tile([0.0, 1.0], (self._dimensions, 1))
        self._run = self._cmaes.CMA(mean=np.clip(point, 0.01, 0.99), sigma=_SIGMA, bounds=bounds, seed=0)
        self._generation = []
