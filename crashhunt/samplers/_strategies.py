"""Three strategies that search for critical trials: CMA-ES, cross-entropy and mutation.

All of them see a trial as a point in the unit cube with a score from 0 to 1, the criticality, or 1 for a crash. Each
section says what its strategy computes and where it comes from. All use ranks of scores, because criticality is not
linear in the distance to a crash; CMA-ES alone also ends a run where scores are nearly equal. All strategies depend
only on the reported results and the random generator.
"""

from __future__ import annotations

import importlib
import math
import re
from bisect import insort
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from crashhunt.base.errors import UsageError
from crashhunt.base.extras import install_command

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from crashhunt.samplers._protocol import HuntFacts
    from crashhunt.samplers._space_filling import Cube
    from crashhunt.trial import TrialResult


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


# Cross-entropy: repeatedly fit a distribution to the most critical trials and draw from it.
#
# Source: Rubinstein (1999), with an adaptive quantile of criticality instead of a fixed level. The distribution is a
# mixture of one normal distribution around all elites and one around each of them. A single normal distribution would
# search between several critical regions, where nothing is critical.

_MIN_ELITES, _MAX_ELITES = 8, 40  # fewer give no spread; more react too slowly
_QUANTILE = 0.1  # share of all trials that are elites, within these bounds
_FLOOR = 0.01  # lower bound of the standard deviation per dimension, so the search never stops
_REDRAWN = 0.1  # probability that a categorical argument is drawn again
_TOGETHER = 0.5  # probability of the distribution around all elites


class CrossEntropy:
    """A mixture of normal distributions around the elites."""

    def __init__(self, cube: Cube) -> None:
        self._categorical = cube.categorical
        self._elites = Elites(_MAX_ELITES)
        self._count = 0
        self._points: np.ndarray[tuple[int, int], np.dtype[np.float64]] | None = None

    def tell(self, trial: ScoredTrial) -> None:
        """Count a trial, and add it to the elites if its score is high enough."""
        self._count += 1
        self._elites.add(trial)
        self._points = None

    def propose(self, place: int, rng: np.random.Generator) -> Draft | None:
        """Return a draw from the mixture."""
        if len(self._elites) < _MIN_ELITES:
            return None
        many = min(max(_MIN_ELITES, math.ceil(_QUANTILE * self._count)), _MAX_ELITES)
        if self._points is None:
            self._points = np.array([elite.point for elite in self._elites.best(many)])
        points = self._points
        mean, spread = points.mean(axis=0), np.maximum(points.std(axis=0), _FLOOR)
        place = int(rng.integers(len(points)))
        chosen = self._elites[place]
        if rng.random() < _TOGETHER:
            center = mean
        else:
            center = chosen.point
            spread = np.maximum(spread * len(points) ** (-1.0 / (len(mean) + 4)), _FLOOR)  # Scott (1992)
        point = reflected(center + spread * rng.standard_normal(len(mean)))
        if self._categorical.any():
            renewed = np.where(rng.random(len(mean)) < _REDRAWN, rng.random(len(mean)), chosen.point)
            point = np.where(self._categorical, renewed, point)
        return Draft(point, parent=chosen.number)


# Mutation: a fuzzer with a corpus of critical trials, which are changed by small or large steps.
#
# The power schedule follows AFL: critical trials are mutated often, and parents with many mutants without progress
# ever less often.

_MIN_CORPUS, _MAX_CORPUS = 4, 64  # trials in the corpus
_KEEP_SEED = 0.5  # probability that a mutant has the traffic of its parent
_SPLICE, _BOUND, _HAVOC = 0.15, 0.05, 0.1  # probability of each operator; otherwise small steps
_LARGEST, _SMALLEST = 0.3, 0.003  # standard deviation of a step, drawn log-uniformly between these
_OTHER_CATEGORY = 0.3  # probability that a selected categorical argument changes


class Mutation:
    """Proposes mutants of the trials in the corpus."""

    def __init__(self, cube: Cube) -> None:
        self._cube = cube
        self._categorical = cube.categorical
        self._corpus = Elites(_MAX_CORPUS)
        self._children: dict[int, int] = {}  # trial number to its number of mutants without progress
        self._scores: dict[int, float] = {}
        self._energy: NDArray[np.float64] | None = None

    def tell(self, trial: ScoredTrial) -> None:
        """Add a trial to the corpus, if it is critical enough."""
        gone = self._corpus.add(trial)
        parent = trial.parent
        if parent is not None and parent in self._children:
            gained = trial.score > self._scores[parent]
            self._children[parent] = 0 if gained else self._children[parent] + 1
            self._energy = None
        if gone is trial:
            return
        self._children[trial.number], self._scores[trial.number] = 0, trial.score
        if gone is not None:
            del self._children[gone.number], self._scores[gone.number]
        self._energy = None

    def propose(self, place: int, rng: np.random.Generator) -> Draft | None:
        """Return a mutant of a trial in the corpus."""
        if len(self._corpus) < _MIN_CORPUS:
            return None
        if self._energy is None:
            # By rank, because criticality may be nearly equal; parents without progress are selected ever less often.
            tired = np.array([self._children[one.number] for one in self._corpus])
            energy = 1.0 / (4.0 + np.arange(len(tired))) / (1.0 + tired / 8.0)
            self._energy = np.cumsum(energy / energy.sum())
        place = min(int(np.searchsorted(self._energy, rng.random())), len(self._corpus) - 1)
        parent = self._corpus[place]
        seed = parent.seed if rng.random() < _KEEP_SEED else None
        point = self._changed(parent.point, rng)
        if seed is not None and self._cube.arguments(point) == self._cube.arguments(parent.point):
            seed = None  # the same arguments and seed would repeat the trial
        return Draft(point, seed=seed, parent=parent.number)

    def _changed(self, point: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        size = len(point)
        how = rng.random()
        if how < _SPLICE:
            other = self._corpus[int(rng.integers(len(self._corpus)))].point
            point = np.where(rng.random(size) < 0.5, other, point)
            how = 1.0
        touched = rng.random(size) < 2.0 ** -rng.integers(0, max(1, int(size).bit_length()))  # from all to about one
        if not touched.any():
            touched[rng.integers(size)] = True
        if how < _SPLICE + _BOUND:
            changed = np.where(rng.random(size) < 0.5, 0.0, 1.0)
        elif how < _SPLICE + _BOUND + _HAVOC:
            changed = rng.random(size)
        else:
            scale = _LARGEST * (_SMALLEST / _LARGEST) ** rng.random()
            changed = reflected(point + scale * rng.standard_normal(size))
            renewed = np.where(rng.random(size) < _OTHER_CATEGORY, rng.random(size), point)
            changed = np.where(self._categorical, renewed, changed)
        return np.where(touched, changed, point)
