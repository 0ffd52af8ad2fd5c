"""Samplers that learn: each has one strategy, and every fifth trial is drawn at random."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from threadpoolctl import ThreadpoolController

from crashhunt.samplers._protocol import HuntFacts, Proposal, Space
from crashhunt.samplers._space_filling import Cube, RandomSampler
from crashhunt.samplers._strategies import PLAIN_EVERY, CmaEs, CrossEntropy, Mutation, Strategy, scored_trial

if TYPE_CHECKING:
    import numpy as np

    from crashhunt.trial import TrialResult

_PLAIN, _START = "random", "start"


class Learning:
    """The base class of all samplers that learn: every fifth trial is random, and a strategy proposes the others.

    Args:
        space: the space of the arguments to sample.
        points: ignored; other samplers need this argument.
        hunt: facts about the hunt: its seed, and what counts as a crash.
    """

    learns = True
    independent = False
    only_asked = False
    wants_hunt = True
    plain_origin = _PLAIN
    origin: ClassVar[str]
    version = 2  # 1 gave equal scores to all trials with a criticality above 0.999

    def __init__(self, space: Space, *, points: int = 10, hunt: HuntFacts = HuntFacts()) -> None:  # noqa: B008
        self._hunt = hunt
        self._random = RandomSampler(space)
        self._cube = Cube(space)
        self._strategy = self._make(space)
        # For matrices of this size, several threads take more CPU time than they save. They may also add numbers in
        # another order, and then a hunt would not resume with the same trials on a machine with more cores.
        self._libraries = ThreadpoolController()

    def _make(self, space: Space) -> Strategy:
        raise NotImplementedError

    def ask(self, number: int, rng: np.random.Generator) -> Proposal:
        """Return a plain random trial, or the proposal of the strategy."""
        if number % PLAIN_EVERY == 0:
            return Proposal(self._random.ask(number, rng).arguments, origin=_PLAIN)
        # Count the strategy's trials alone: without every fifth point, Halton's sequence in base 5 has a hole.
        place = number - number // PLAIN_EVERY - 1
        with self._libraries.limit(limits=1):
            draft = self._strategy.propose(place, rng) if self._cube.dimensions else None
        if draft is None:  # too few results yet, or no argument varies
            return Proposal(self._random.ask(number, rng).arguments, origin=_START)
        arguments = self._cube.arguments(draft.point)
        return Proposal(arguments, seed=draft.seed, parent=draft.parent, origin=draft.origin or self.origin)

    def tell(self, result: TrialResult) -> None:
        """Learn from the result of a trial."""
        trial = scored_trial(result, self._cube, self._hunt)
        if trial is not None and self._cube.dimensions:
            with self._libraries.limit(limits=1):
                self._strategy.tell(trial)


class CrossEntropySampler(Learning):
    """Draws from a distribution that is fitted to the most critical trials (`CrossEntropy`)."""

    origin = "cross-entropy"

    def _make(self, space: Space) -> Strategy:
        return CrossEntropy(self._cube)


class MutationSampler(Learning):
    """Changes the most critical trials, with the same or other traffic (`Mutation`)."""

    origin = "mutation"

    def _make(self, space: Space) -> Strategy:
        return Mutation(self._cube)


class CmaEsSampler(Learning):
    """Follows rising criticality by CMA-ES, which needs two arguments or more that vary (`CmaEs`)."""

    origin = "cma-es"

    def _make(self, space: Space) -> Strategy:
        return CmaEs(self._cube)


class GuidedSampler(Learning):
    """Proposes trials by models of criticality or robustness, whose share of the trials depends on their success."""

    origin = "guided"
    # 2 excluded basins of known crashes, 3 had no mutation, 4 had no niches, 5 had another model, 6 searches each
    # conjunct of a requirement by itself and changes signals by their shape, 7 ranks equal robustness by time
    version = 7

    def _make(self, space: Space) -> Strategy:
        from crashhunt.samplers._guided import Arms  # its linear algebra takes a fifth of a second to import

        return Arms(self._cube, space, self._hunt)
