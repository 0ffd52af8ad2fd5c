"""The portfolio behind the sampler `guided`: distributes trials between a model and an even search.

A trial that is more critical than a share of 1 - q of the unguided trials has payoff -log q. For trials that know
nothing, payoffs are exponentially distributed with mean 1. The mean payoff of the model's trials therefore has an
inverse gamma posterior. Before each proposal, a mean is drawn from it (Thompson 1933), and the model proposes if the
mean is high enough. Only ranks matter for payoffs. One threshold reads the scale of criticality: the progress towards a
crash.

Rising criticality does not imply a crash, and before the first crash this is unknown. The share of the highest peak of
criticality therefore falls exponentially with the number of the model's trials there since the last progress. A
misleading peak then costs only a number of trials that grows with the logarithm of the length of the hunt. The best
strategies for bandits have the same growth (Lai and Robbins 1985). Other peaks and the even search share what the
highest peak does not get. The weight of each other peak falls in the same way. The even search has the weight of a peak
that was not searched yet.

After the first crash, new crash types count. Before each proposal, the rate of new types that the model finds is drawn
from its posterior, and so is that of unguided trials. The model does not search in basins of crashes that yield known
types only.

Sources: nearest-better clustering (Preuss 2010), Thompson sampling (1933), Halton's sequence (1960); payoffs and shares
are our own, measured with `scripts/studies/run search`. Cost: about a millisecond per trial, the model included.
"""

from __future__ import annotations

import math
import sys
from bisect import bisect_left, bisect_right, insort
from collections import deque
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.samplers._learning import CRASHED, NEAREST, Conjunct, Draft, Elites, Learning, ScoredTrial, Strategy
from crashhunt.samplers._model import TRIALS, Model
from crashhunt.samplers._signal_shapes import SignalShapes
from crashhunt.samplers._space_filling import Cube, HaltonSampler
from crashhunt.trial import MAX_ROBUSTNESS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from crashhunt.samplers._protocol import HuntFacts, Space

    Floats = NDArray[np.float64]
    Seeds = NDArray[np.int64]


_EVEN, _MODEL, _OTHER = "halton", "model", "other model"


# Basins: a trial belongs to the basin of the nearest more critical trial, unless that is far away (nearest-better
# clustering; Preuss 2010). The most critical trial of a basin is its peak.

_FAR = 2.0  # times the mean distance to the nearest more critical trial: beyond that, a trial has a basin of its own


def make_basins(points: Floats, scores: Floats, usual: NDArray[np.bool_] | None = None) -> NDArray[np.intp]:
    """Return the basin of each trial, as the index of its peak.

    Of two trials with equal scores, the first is the more critical one, so that a plateau is one basin. The points are
    trials x arguments, in the unit cube. The trials of ``usual`` determine what is far away; None for all.
    """
    order = np.argsort(-scores, kind="stable")
    ranked = points[order]
    away = (ranked**2).sum(axis=1)[:, None] + (ranked**2).sum(axis=1) - 2.0 * ranked @ ranked.T
    away = np.where(np.tri(len(ranked), k=-1, dtype=bool), np.sqrt(np.maximum(away, 0.0)), np.inf)
    nearest, better = away.min(axis=1), order[away.argmin(axis=1)]
    measured = np.isfinite(nearest) if usual is None else np.isfinite(nearest) & usual[order]
    far = _FAR * float(nearest[measured].mean()) if measured.any() else 0.0
    basins = np.arange(len(points))
    for place, its_nearest, its_better in zip(order.tolist(), nearest.tolist(), better.tolist(), strict=True):
        if its_nearest <= far:
            basins[place] = basins[its_better]
    return basins


def nearest_of(points: Floats, ground: Floats) -> NDArray[np.intp]:
    """Return the index of the nearest point of the ground for each point."""
    nearest: NDArray[np.intp] = np.argmin((ground**2).sum(axis=1) - 2.0 * points @ ground.T, axis=1)
    return nearest


# Known crashes: search for other crashes, not for these again.
#
# Criticality leads to a known crash from all of its basin, so its neighbourhood alone is not enough: just outside of it
# are the most critical trials of all. A crash belongs to the basin of the nearest earlier one if that is not far away.

_REPEATS = 3  # consecutive crashes of known types in a basin: the next is new in at most one of five cases


class KnownCrashes:
    """The places in the space of arguments that are not worth another trial.

    A basin is excluded when its last crashes are of known types. The same arguments may lead to other types, so one
    crash is not enough. A crash whose result has no type excludes its basin at once.

    The same traffic leads to the same crash even with other arguments, so the seed of a crash is excluded, too.
    """

    def __init__(self) -> None:
        self._crashes: deque[tuple[ScoredTrial, bool]] = deque(maxlen=TRIALS)  # each with whether it was new
        self._types: set[str] = set()
        self._seeds = np.empty(0, dtype=np.int64)
        self._ground = np.empty((0, 0))  # points of crashes and trials
        self._is_excluded = np.empty(0, dtype=bool)  # of these, which are in an excluded basin

    def __bool__(self) -> bool:
        return bool(self._crashes)

    def cover(self, points: Floats, seeds: Seeds) -> NDArray[np.bool_]:
        """Return which points are in an excluded basin or have the seed of a crash."""
        covered: NDArray[np.bool_] = np.isin(seeds, self._seeds)
        if self._is_excluded.any():
            covered |= self._is_excluded[nearest_of(points, self._ground)]
        return covered

    def outside(self, trials: Sequence[ScoredTrial]) -> list[ScoredTrial]:
        """Return the trials that are not covered."""
        if not self._crashes or not trials:
            return [*trials]
        covered = self.cover(np.array([one.point for one in trials]), np.array([one.seed for one in trials])).tolist()
        return [trial for trial, is_covered in zip(trials, covered, strict=True) if not is_covered]

    def is_new(self, crash: ScoredTrial) -> bool:
        """Return whether the type of a crash is unknown; for a crash without a type, whether it is not covered."""
        return crash.kind not in self._types if crash.kind else bool(self.outside([crash]))

    def add(self, crash: ScoredTrial, trials: Sequence[ScoredTrial]) -> None:
        """Add a crash, and compute the basins among trials without a crash."""
        self._crashes.append((crash, self.is_new(crash)))
        self._types.add(crash.kind)
        self._seeds = np.array([one.seed for one, _ in self._crashes])
        self._compute(trials)

    def update(self, trials: Sequence[ScoredTrial]) -> None:
        """Compute the basins among trials without a crash again, if one is excluded."""
        if self._is_excluded.any():
            self._compute(trials)

    def _compute(self, trials: Sequence[ScoredTrial]) -> None:
        many = len(self._crashes)
        points = np.array([one.point for one in (*(crash for crash, _ in self._crashes), *trials)])
        basins = make_basins(points, np.append(CRASHED + np.arange(many, 0, -1), [trial.score for trial in trials]))
        repeats: dict[int, int] = {}
        for basin, (crash, is_new) in zip(basins[:many].tolist(), self._crashes, strict=True):
            repeats[basin] = _REPEATS if not crash.kind else 0 if is_new else repeats.get(basin, 0) + 1
        self._ground = points
        self._is_excluded = np.isin(basins, [basin for basin, known in repeats.items() if known >= _REPEATS])


# Peaks: the model searches at the highest one, and at others the more, the longer it makes no progress there.

_NEARER = 0.5  # progress: the distance of the greatest score of a basin from 1 shrinks to this share or less
_PATIENCE = 14  # trials of the model without progress, for each argument, in which the share of a peak falls to 1 / e


class Peaks:
    """The peaks of criticality among trials without a crash."""

    def __init__(self, trials: Sequence[ScoredTrial], dimensions: int) -> None:
        self._trials = trials
        self._points = np.array([trial.point for trial in trials]).reshape(-1, dimensions)
        scores = np.array([trial.score for trial in trials])
        # The model's trials are close together, so that only the others show how far apart trials usually are.
        unguided = np.array([trial.origin != _MODEL for trial in trials], dtype=bool)
        self._basins = make_basins(self._points, scores, unguided) if trials else np.empty(0, dtype=np.intp)
        record, without = dict.fromkeys(self._basins.tolist(), -1.0), dict.fromkeys(self._basins.tolist(), 0)
        for trial, basin in zip(trials, self._basins.tolist(), strict=True):
            if 1.0 - trial.score < _NEARER * (1.0 - record[basin]):
                record[basin], without[basin] = trial.score, 0
            elif trial.origin == _MODEL:
                without[basin] += 1
        by_score = np.argsort(-scores, kind="stable").tolist()
        patience = _PATIENCE * dimensions
        self.weights = {
            place: math.exp(-without[place] / patience) for place in by_score if self._basins[place] == place
        }
        """Index of the peak to its weight, from the highest to the lowest peak."""

    def score(self, peak: int) -> float:
        """Return the score of a peak."""
        return self._trials[peak].score

    def is_outside(self, points: Floats, peak: int) -> NDArray[np.bool_]:
        """Return which points are not in the basin of a peak."""
        outside: NDArray[np.bool_] = self._basins[nearest_of(points, self._points)] != peak
        return outside

    def members(self, peak: int) -> set[int]:
        """Return the numbers of the trials in the basin of a peak."""
        return {trial.number for trial, basin in zip(self._trials, self._basins.tolist(), strict=True) if basin == peak}


_WORTHWHILE = 1.5  # mean payoff: below that, the even search proposes, because criticality cannot mislead it
_FEW = 5  # trials that may have equal scores by chance
_CORNER_EVERY = 4  # where robustness ranks no trials, one proposal of so many is a corner
_PRIOR = 2.0  # payoff of one imagined trial of the model, so that it is tried


class Portfolio:
    """Divides the trials between a model of criticality and Halton's sequence."""

    def __init__(self, cube: Cube, space: Space, hunt: HuntFacts) -> None:
        self._dimensions = cube.dimensions
        self._even = HaltonSampler(space, hunt=hunt)
        self._shapes = SignalShapes(cube.signals) if cube.signals else None
        self._model = Model(cube)
        self._unguided: list[float] = []  # scores, in order
        self._best = Elites(TRIALS)  # most critical trials without a crash
        self._last: deque[ScoredTrial] = deque(maxlen=TRIALS)  # latest trials without a crash
        self._known = KnownCrashes()
        self._found = {True: (0.5, 1.0), False: (0.5, 1.0)}  # new types, as Jeffreys (1946), and trials: guided, not
        self._earned, self._counted = _PRIOR, 1.0  # sum and number of the model's payoffs
        self._peaks: Peaks | None = None

    def tell(self, trial: ScoredTrial) -> None:
        """Update payoffs and the model with a trial."""
        self._peaks = None
        is_guided = trial.origin == _MODEL
        if is_guided:
            self._earned += self._own_payoff(trial)
            self._counted += 1.0
        elif trial.origin != _OTHER:
            insort(self._unguided, trial.score)
        types, trials = self._found[is_guided]
        self._found[is_guided] = (types + (trial.crashed and self._known.is_new(trial)), trials + 1.0)
        if trial.crashed:
            self._known.add(trial, self._remembered())
            self._model.remember(self._worth_learning())
            return
        self._best.add(trial)
        self._last.append(trial)
        self._known.update(self._remembered())
        self._model.learn(self._worth_learning())

    def propose(self, place: int, rng: np.random.Generator) -> Draft:
        """Return a proposal of the model, or the next point of the even search."""
        if self._shapes is not None and (corner := self._corner(place)) < len(self._shapes.corners):
            return Draft(self._shapes.with_corner(self._even.point(place), corner), origin=_EVEN)
        draft = self._guided(rng) if self._is_worthwhile(rng) else None
        if draft is not None:
            return replace(draft, origin=_MODEL)
        point = self._even.point(place)
        if self._shapes is not None and self._ranks:
            point = self._shapes.with_shapes(point, rng)
        return Draft(point, origin=_EVEN)

    def _corner(self, place: int) -> int:
        """Return the number of the corner of signals to propose: it may be above all numbers."""
        if self._ranks:
            return place
        turn, rest = divmod(place, _CORNER_EVERY)
        return turn + 1 if rest == _CORNER_EVERY - 1 else sys.maxsize

    @property
    def _ranks(self) -> bool:
        """Whether robustness differs in the better half of the unguided trials, of the first few in the best two.

        Where it does not, such as for gears, corners and shapes of signals have no advantage over even points.
        """
        scores = self._unguided
        worse = len(scores) // 2 if len(scores) >= _FEW else len(scores) - 2
        return len(scores) < 2 or scores[-1] - scores[worse] > _TIME

    def _is_worthwhile(self, rng: np.random.Generator) -> bool:
        """Draw whether the model finds more than the even search."""
        if self._known:
            guided, unguided = (rng.standard_gamma(types) / trials for types, trials in self._found.values())
            if guided < unguided:
                return False
        return bool(self._earned / rng.standard_gamma(self._counted) > _WORTHWHILE)

    def _guided(self, rng: np.random.Generator) -> Draft | None:
        """Return a proposal of the model at the highest or another peak; None if the even search is drawn."""
        if self._peaks is None:
            self._peaks = Peaks(self._known.outside(self._remembered()), self._dimensions)
        peaks = self._peaks
        weights = {peak: of for peak, of in peaks.weights.items() if self._payoff(peaks.score(peak)) >= _WORTHWHILE}
        if not weights:
            return None
        highest, *others = weights
        if rng.random() < weights[highest]:
            return self._model.propose(rng, self._known.cover if self._known else None)
        shares = np.cumsum([1.0, *(weights[peak] for peak in others)])  # the first is that of the even search
        drawn = int(np.searchsorted(shares / shares[-1], rng.random()))
        return self._at(others[drawn - 1], peaks, rng) if drawn else None

    def _at(self, peak: int, peaks: Peaks, rng: np.random.Generator) -> Draft | None:
        """Return a proposal of the model in the basin of a peak."""

        def excluded(points: Floats, seeds: Seeds) -> NDArray[np.bool_]:
            outside = peaks.is_outside(points, peak)
            return outside | self._known.cover(points, seeds) if self._known else outside

        members = peaks.members(peak)
        among = np.array([trial.number in members for trial in self._model.trials], dtype=bool)
        return self._model.propose(rng, excluded, among)

    def _remembered(self) -> list[ScoredTrial]:
        """Return the most critical and the latest trials without a crash, in order."""
        return _in_order([*self._last, *self._best])

    def _worth_learning(self) -> list[ScoredTrial]:
        """Return the trials from which the model learns: the most critical and the latest that are not covered."""
        half = TRIALS // 2
        best, last = self._known.outside([*self._best]), self._known.outside([*self._last])
        return _in_order([*last[-half:], *best[:half]])

    def _own_payoff(self, trial: ScoredTrial) -> float:
        """Return the payoff of a trial of the model, without what the traffic of its parent explains of it."""
        payoff = self._payoff(trial.score)
        parent = next((one for one in self._best if one.number == trial.parent), None)
        if parent is None or parent.seed != trial.seed or trial.score > parent.score:
            return payoff
        _, traffic = self._model.parameters.shares
        return (1.0 - traffic) * payoff + traffic * min(payoff, 1.0)

    def _payoff(self, score: float) -> float:
        below, at_most = bisect_left(self._unguided, score), bisect_right(self._unguided, score)
        above = len(self._unguided) - at_most + 0.5 * (at_most - below)
        return math.log((len(self._unguided) + 1.0) / (above + 0.5))


# Requirements: each conjunct of each requirement has a portfolio of its own, and a bandit chooses the next one.
#
# Robustness has the unit of its signals, so a minimum over conjuncts searches for the violation of one of them only
# (the scale problem). Zhang, Hasuo and Arcaini, "Multi-armed bandits for Boolean connectives in hybrid system
# falsification", CAV 2019, choose between the conjuncts by their progress. In a disjunction all parts must be violated,
# so its parts are divided by the range that was seen of each, and the greatest counts.
#
# The robustness of flags and whole numbers is often equal in all trials. Between equal robustness, the time by which a
# conjunct holds decides, as in the time robustness of Donzé and Maler (FORMATS 2010).

_SCALED_AFTER = 20  # trials from which the ranges are computed
_MOST_ARMS = 16
_TIME = 1e-6  # share of time in the distance to a violation: it decides only between equal robustness
_FORGET = 0.95  # factor of earlier rewards of a conjunct at each of its proposals


class _Arm:
    """The search for the violation of one conjunct."""

    def __init__(self, make: Callable[[], Portfolio]) -> None:
        self._make = make
        self._portfolio = make()
        self._early: list[tuple[ScoredTrial, Conjunct]] = []
        self._scales: NDArray[np.float64] | None = None
        self._best = -1.0
        self._gained, self._lost = 1.0, 1.0  # as in a uniform prior of the probability of progress

    def tell(self, trial: ScoredTrial, conjunct: Conjunct, *, is_own: bool) -> None:
        """Learn from a trial in which the conjunct has the given robustness."""
        if is_own:
            self._gained, self._lost = _FORGET * self._gained, _FORGET * self._lost
        if self._scales is None:
            self._early.append((trial, conjunct))
            if len(self._early) < _SCALED_AFTER:
                self._portfolio.tell(self._scored(trial, conjunct))
                return
            self._scales = _scales([one.parts for _, one in self._early])
            self._portfolio, self._best = self._make(), -1.0
            for earlier, as_it_was in self._early:
                scored = self._scored(earlier, as_it_was)
                self._portfolio.tell(scored)
                self._best = max(self._best, scored.score)
            return
        scored = self._scored(trial, conjunct)
        if is_own:
            self._gained += scored.score > self._best
            self._lost += scored.score <= self._best
        self._best = max(self._best, scored.score)
        self._portfolio.tell(scored)

    def propose(self, place: int, rng: np.random.Generator) -> Draft:
        """Return a proposal of the conjunct's portfolio."""
        return self._portfolio.propose(place, rng)

    def draw(self, rng: np.random.Generator) -> float:
        """Draw the probability of progress of the next proposal (Thompson 1933)."""
        return float(rng.beta(self._gained + 1.0, self._lost + 1.0))

    def _scored(self, trial: ScoredTrial, conjunct: Conjunct) -> ScoredTrial:
        if trial.crashed:
            return trial
        scales = self._scales if self._scales is not None else np.ones(len(conjunct.parts))
        distance = max(0.0, float(np.max(np.array(conjunct.parts) / scales)))
        distance += _TIME * (1.0 - 1.0 / (1.0 + max(0.0, conjunct.slack_s)))
        return replace(trial, score=min(1.0 / (1.0 + distance), NEAREST))


def _scales(rows: Sequence[tuple[float, ...]]) -> NDArray[np.float64]:
    """Return the median of the positive finite values of each column; 1 without any."""
    columns = np.array(rows).T
    medians = [np.median(kept) if len(kept := of[(of > 0) & (of < MAX_ROBUSTNESS)]) else 1.0 for of in columns]
    return np.array(medians)


class Arms:
    """Divides the trials between the conjuncts of requirements; without requirements, one portfolio proposes all."""

    def __init__(self, cube: Cube, space: Space, hunt: HuntFacts) -> None:
        self._make: Callable[[], Portfolio] = partial(Portfolio, cube, space, hunt)
        self._whole = self._make()
        self._arms: dict[str, _Arm] = {}
        self._violated: set[str] = set()

    def tell(self, trial: ScoredTrial) -> None:
        """Learn from a trial."""
        if not trial.conjuncts and not self._arms:
            self._whole.tell(trial)
            return
        if trial.violated:
            self._violated.add(trial.violated)
        for number, conjunct in enumerate(trial.conjuncts):
            name = f"{conjunct.requirement}#{number}"
            if name not in self._arms:
                if len(self._arms) >= _MOST_ARMS:
                    continue
                self._arms[name] = _Arm(self._make)
            if (
                trial.crashed
                and trial.violated
                and not (trial.violated == conjunct.requirement and max(conjunct.parts) <= 0)
            ):
                continue  # the trial ended at the violation of something else, so the values are not those of its end
            is_own = len(trial.conjuncts) == 1 or trial.origin == f"{_MODEL} {name}"
            origin = trial.origin
            if origin.startswith(_MODEL):
                origin = _MODEL if is_own else _OTHER
            self._arms[name].tell(replace(trial, origin=origin), conjunct, is_own=is_own and origin == _MODEL)

    def propose(self, place: int, rng: np.random.Generator) -> Draft:
        """Return a proposal of the portfolio whose conjunct is most likely to make progress."""
        if not self._arms:
            return self._whole.propose(place, rng)
        names = [name for name in self._arms if name.rpartition("#")[0] not in self._violated] or [*self._arms]
        if len(names) == 1:
            name = names[0]
        else:
            chances = [self._arms[name].draw(rng) for name in names]
            name = names[int(np.argmax(chances))]
        draft = self._arms[name].propose(place, rng)
        return replace(draft, origin=f"{_MODEL} {name}") if draft.origin == _MODEL and len(self._arms) > 1 else draft


def _in_order(trials: Sequence[ScoredTrial]) -> list[ScoredTrial]:
    """Return trials by their number, each once."""
    known = {trial.number: trial for trial in trials}
    return [known[number] for number in sorted(known)]


class GuidedSampler(Learning):
    """Proposes trials by models of criticality or robustness, whose share of the trials depends on their success."""

    origin = "guided"
    # 2 excluded basins of known crashes, 3 had no mutation, 4 had no niches, 5 had another model, 6 searches each
    # conjunct of a requirement by itself and changes signals by their shape, 7 ranks equal robustness by time
    version = 7

    def _make(self, space: Space) -> Strategy:
        return Arms(self._cube, space, self._hunt)
