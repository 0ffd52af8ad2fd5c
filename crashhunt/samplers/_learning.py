"""What all samplers that learn share: each has one strategy, and every fifth trial is drawn at random.

A strategy sees a trial as a point in the unit cube with a score from 0 to 1, the criticality, or 1 for a crash. All
use ranks of scores, because criticality is not linear in the distance to a crash; CMA-ES alone also ends a run where
scores are nearly equal. All depend only on the reported results and the random generator.
"""

from __future__ import annotations

import math
import re
from bisect import insort
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, NamedTuple, Protocol

import numpy as np
from threadpoolctl import ThreadpoolController

from crashhunt.samplers._protocol import HuntFacts, Proposal, Space
from crashhunt.samplers._space_filling import Cube, RandomSampler

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from crashhunt.trial import TrialResult

_PLAIN, _START = "random", "start"


# The protocol of strategies, which propose points near critical trials; a sampler uses one or several of them.


@dataclass(frozen=True, slots=True, eq=False)
class Draft:
    """A proposed point."""

    point: NDArray[np.float64]  # point in the unit cube
    seed: int | None = None  # seed of the trial; None for the seed that follows from the trial's number
    parent: int | None = None  # the number of the trial that it is derived from; None if there is none
    origin: str = ""  # the strategy that proposes the point, if there are several strategies


class Strategy(Protocol):
    """Learns from reported results, and derives proposals only from these; earlier proposals have no influence."""

    def propose(self, place: int, rng: np.random.Generator) -> Draft | None:
        """Return the draft at an index of the sequence of drafts; None while there are too few results."""

    def tell(self, trial: ScoredTrial) -> None:
        """Learn from the result of a trial of any origin."""


def reflected(point: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a point inside the cube: a point outside of the cube is mirrored at the border."""
    inside: NDArray[np.float64] = np.abs(np.mod(point + 1.0, 2.0) - 1.0)
    return inside


# Results as a sampler that learns sees them: a point, and a score that says how near it came to a crash.

CRASHED = 1.0
PLAIN_EVERY = 5
"""Of the trials of a hunt that learns, one of so many is plain random, for an unbiased crash rate."""
NEAREST = math.nextafter(CRASHED, 0.0)
"""Upper bound of the score of a trial without a crash."""
_NUMBER_AT_END = re.compile(r"[\W_]*\d+\W*$")  # of a lane id: the lane's index on its road


class Conjunct(NamedTuple):
    """A conjunct of a requirement in a trial."""

    requirement: str  # name of the requirement
    parts: tuple[float, ...]  # robustness of its disjuncts; the conjunct is violated if all of them are negative
    slack_s: float = 0.0  # the time by which it holds, in s


@dataclass(frozen=True, slots=True, eq=False)
class ScoredTrial:
    """A finished trial, as samplers learn from it."""

    number: int  # number of the trial
    point: NDArray[np.float64]  # point of the trial in the unit cube
    seed: int  # seed of the trial
    score: float  # criticality from 0 to 1; `CRASHED` for a crash
    origin: str = ""  # the strategy that proposed the trial
    parent: int | None = None  # number of the trial from which it was derived; None if there is none
    kind: str = ""  # type of the crash, as far as the result shows it; empty if it does not
    conjuncts: tuple[Conjunct, ...] = ()  # the conjuncts of the requirements of the hunt
    violated: str = ""  # name of the requirement that the trial violates; empty if there is none

    @property
    def crashed(self) -> bool:
        """Whether the trial crashed in a way that the hunt searches for."""
        return self.score == CRASHED


def scored_trial(result: TrialResult, cube: Cube, hunt: HuntFacts) -> ScoredTrial | None:
    """Convert a result to the form from which samplers learn; None if it has no information."""
    if result.outcome in hunt.crash_on:
        score = CRASHED
    elif result.danger is None or result.outcome.category != "no crash":
        return None  # a crash that is not hunted says nothing about the crashes that are
    else:
        score = min(max(result.danger, 0.0), NEAREST)
    spec = result.spec
    kind = _kind(result) if score == CRASHED else ""
    return ScoredTrial(
        number=spec.number,
        point=cube.point(spec),
        seed=spec.seed,
        score=score,
        origin=spec.origin,
        parent=spec.parent,
        kind=kind,
        conjuncts=tuple(_conjuncts(result)),
        violated=result.event.name if kind and result.event is not None else "",
    )


def _conjuncts(result: TrialResult) -> Iterator[Conjunct]:
    for requirement, rows in (result.conjuncts or {}).items():
        slack_s = (result.slack_s or {}).get(requirement) or (0.0,) * len(rows)
        for parts, its_slack_s in zip(rows, slack_s, strict=True):
            yield Conjunct(requirement, parts, its_slack_s)


def _kind(result: TrialResult) -> str:
    """Return the crash type as far as it is known without a recording: outcome, role and place, or the exception."""
    hit, failed, event = result.collision, result.failure, result.event
    words = [str(result.outcome)]
    if hit is not None:
        words += [hit.role, hit.kind, _NUMBER_AT_END.sub("", hit.lane), hit.cell]
    elif failed is not None:
        words += [failed.kind, failed.agent]
    elif event is not None:
        words += [event.label, _NUMBER_AT_END.sub("", event.lane)]
    else:
        return ""
    return " ".join(words).rstrip()


# The best trials so far, in order and limited in number.


class Elites:
    """The trials with the greatest scores; of trials with equal scores, those that were reported first."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._kept: list[tuple[float, int, ScoredTrial]] = []
        self._count = 0

    def __len__(self) -> int:
        return len(self._kept)

    def __iter__(self) -> Iterator[ScoredTrial]:
        return (trial for _, _, trial in self._kept)

    def __getitem__(self, place: int) -> ScoredTrial:
        return self._kept[place][2]

    def add(self, trial: ScoredTrial) -> ScoredTrial | None:
        """Add a trial; return the trial that is dropped for it, which is the new trial if its score is too low."""
        self._count += 1
        insort(self._kept, (-trial.score, self._count, trial))
        return self._kept.pop()[2] if len(self._kept) > self._most else None

    def best(self, many: int) -> list[ScoredTrial]:
        """Return the best trials, at most the given number."""
        return [trial for _, _, trial in self._kept[:many]]


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
