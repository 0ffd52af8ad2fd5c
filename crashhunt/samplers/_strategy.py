"""The protocol of strategies, which propose points near critical trials; a sampler uses one or several of them."""

from __future__ import annotations

import math
import re
from bisect import insort
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from crashhunt.samplers._protocol import HuntFacts
    from crashhunt.samplers._space_filling import Cube
    from crashhunt.trial import TrialResult


@dataclass(frozen=True, slots=True, eq=False)
class Draft:
    """A proposed point.

    Args:
        point: point in the unit cube.
        seed: seed of the trial; None for the seed that follows from the trial's number.
        parent: the number of the trial that it is derived from; None if there is none.
        origin: the strategy that proposes the point, if there are several strategies.
    """

    point: NDArray[np.float64]
    seed: int | None = None
    parent: int | None = None
    origin: str = ""


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
    """A conjunct of a requirement in a trial.

    Args:
        requirement: name of the requirement.
        parts: robustness of its disjuncts; the conjunct is violated if all of them are negative.
    """

    requirement: str
    parts: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ScoredTrial:
    """A finished trial, as samplers learn from it.

    Args:
        number: number of the trial.
        point: point of the trial in the unit cube.
        seed: seed of the trial.
        score: criticality from 0 to 1; `CRASHED` for a crash.
        origin: the strategy that proposed the trial.
        parent: number of the trial from which it was derived; None if there is none.
        kind: type of the crash, as far as the result shows it; empty if it does not.
        conjuncts: the conjuncts of the requirements of the hunt.
        violated: name of the requirement that the trial violates; empty if there is none.
    """

    number: int
    point: NDArray[np.float64]
    seed: int
    score: float
    origin: str = ""
    parent: int | None = None
    kind: str = ""
    conjuncts: tuple[Conjunct, ...] = ()
    violated: str = ""

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
        conjuncts=tuple(
            Conjunct(requirement, parts) for requirement, rows in (result.conjuncts or {}).items() for parts in rows
        ),
        violated=result.event.name if kind and result.event is not None else "",
    )


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
    """The trials with the greatest scores; of trials with equal scores, those that were reported first.

    Args:
        most: the maximum number of trials.
    """

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
