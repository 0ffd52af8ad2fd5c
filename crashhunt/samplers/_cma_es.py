"""The sampler `cma-es`: learns the directions in which criticality rises."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

import numpy as np

from crashhunt.base.errors import UsageError
from crashhunt.base.extras import install_command
from crashhunt.samplers._learning import Draft, Elites, Learning, ScoredTrial, Strategy

if TYPE_CHECKING:
    from crashhunt.samplers._protocol import Space
    from crashhunt.samplers._space_filling import Cube

_FIRST = 10  # trials before a run begins, at the most critical of them
_SIGMA = 0.2  # initial standard deviation, in widths of the cube: a fifth covers most of it


class CmaEs:
    """CMA-ES (Hansen 2001), of the package ``cmaes``: learns the directions in which criticality rises.

    Successive runs start from the most critical of the last ten trials before each run. The first run starts after ten
    trials; the ten trials before a later run may include proposals of the previous run.

    Raises:
        UsageError: the package is not installed.
    """

    def __init__(self, cube: Cube) -> None:
        try:
            self._cmaes: Any = importlib.import_module("cmaes")
        except ImportError:
            raise UsageError("the sampler 'cma-es' needs the package cmaes", fix=install_command("search")) from None
        self._dimensions = cube.dimensions
        self._elites = Elites(_FIRST)
        self._run: Any = None
        self._generation: list[tuple[Any, float]] = []

    def tell(self, trial: ScoredTrial) -> None:
        """Add a result to the generation; a complete generation moves the distribution."""
        self._elites.add(trial)
        if self._dimensions < 2:
            return
        if self._run is None:
            if len(self._elites) >= _FIRST:
                self._begin(self._elites[0].point)
            return
        if trial.origin != "cma-es":
            return
        self._generation.append((trial.point, -trial.score))
        if len(self._generation) == self._run.population_size:
            self._run.tell(self._generation)
            self._generation = []
            if self._run.should_stop():
                self._run = None
                self._elites = Elites(_FIRST)

    def propose(self, place: int, rng: np.random.Generator) -> Draft | None:
        """Return a draw from the current distribution."""
        if self._run is None:
            return None
        self._run.reseed_rng(int(rng.integers(2**31)))
        return Draft(np.clip(self._run.ask(), 0.0, 1.0))

    def _begin(self, point: Any) -> None:
        bounds = np.tile([0.0, 1.0], (self._dimensions, 1))
        self._run = self._cmaes.CMA(mean=np.clip(point, 0.01, 0.99), sigma=_SIGMA, bounds=bounds, seed=0)
        self._generation = []


class CmaEsSampler(Learning):
    """Follows rising criticality by CMA-ES, which needs two arguments or more that vary (`CmaEs`)."""

    origin = "cma-es"

    def _make(self, space: Space) -> Strategy:
        return CmaEs(self._cube)
