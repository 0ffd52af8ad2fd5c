"""Samplers that learn: a strategy each, beside a stream of plain random trials."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from crashhunt.samplers._cma_es import CmaEs
from crashhunt.samplers._cross_entropy import CrossEntropy
from crashhunt.samplers._cube import Cube
from crashhunt.samplers._guided import Portfolio
from crashhunt.samplers._mutation import Mutation
from crashhunt.samplers._protocol import HuntFacts, Proposal
from crashhunt.samplers._random import RandomSampler
from crashhunt.samplers._told import told_of

if TYPE_CHECKING:
    import numpy as np

    from crashhunt.samplers._protocol import Space
    from crashhunt.samplers._strategy import Strategy
    from crashhunt.trial import TrialResult

__all__ = ["CmaEsSampler", "CrossEntropySampler", "GuidedSampler", "Learning", "MutationSampler"]

_PLAIN_EVERY = 5  # trials, of which the first is a plain random one
_PLAIN, _START = "random", "start"


class Learning:
    """What all of them are: every fifth trial is random, the others are a strategy's.

    Args:
        space: what to sample.
        points: not used.
        hunt: what counts as a crash in it, and its seed.
    """

    learns = True
    independent = False
    only_asked = False
    wants_hunt = True
    plain_origin = _PLAIN
    origin: ClassVar[str]

    def __init__(self, space: Space, *, points: int = 10, hunt: HuntFacts = HuntFacts()) -> None:  # noqa: B008
        self._hunt = hunt
        self._random = RandomSampler(space)
        self._cube = Cube(space)
        self._strategy = self._make(space)

    def _make(self, space: Space) -> Strategy:
        raise NotImplementedError

    def ask(self, number: int, rng: np.random.Generator) -> Proposal:
        """Return a plain random trial, or what the strategy makes of what it was told."""
        if number % _PLAIN_EVERY == 0:
            return Proposal(self._random.ask(number, rng).arguments, origin=_PLAIN)
        # Of its own trials alone: Halton's sequence without every fifth point has a hole, where an argument has base 5.
        place = number - number // _PLAIN_EVERY - 1
        draft = self._strategy.propose(place, rng) if self._cube.dimensions else None
        if draft is None:  # there is nothing to go by yet, or nothing to vary
            return Proposal(self._random.ask(number, rng).arguments, origin=_START)
        arguments = self._cube.arguments(draft.point)
        return Proposal(arguments, seed=draft.seed, parent=draft.parent, origin=draft.origin or self.origin)

    def tell(self, result: TrialResult) -> None:
        """Learn how a trial ended."""
        told = told_of(result, self._cube, self._hunt)
        if told is not None and self._cube.dimensions:
            self._strategy.tell(told)


class CrossEntropySampler(Learning):
    """Draws from what is fitted to the most dangerous trials (`CrossEntropy`)."""

    origin = "cross-entropy"

    def _make(self, space: Space) -> Strategy:
        return CrossEntropy(self._cube)


class MutationSampler(Learning):
    """Changes the most dangerous trials, with the same traffic or with other (`Mutation`)."""

    origin = "mutation"

    def _make(self, space: Space) -> Strategy:
        return Mutation(self._cube)


class CmaEsSampler(Learning):
    """Follows danger uphill by CMA-ES, which needs two arguments or more that vary (`CmaEs`)."""

    origin = "cma-es"

    def _make(self, space: Space) -> Strategy:
        return CmaEs(self._cube)


class GuidedSampler(Learning):
    """Gives each strategy what it has earned (`Portfolio`)."""

    origin = "guided"

    def _make(self, space: Space) -> Strategy:
        return Portfolio(self._cube, space, self._hunt)
