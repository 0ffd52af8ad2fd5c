"""The probability law of the first disturbance: proposes first disturbances in a running trial, with weights.

A root is a trial in which no disturbance begins after step 1. An onset is the beginning of a disturbance. In each trial
of the hunt, either no onset is effective before the trial ends, or there is a first effective onset, which belongs to a
model and a step. If the probabilities per step are independent, the probability of each case has a closed form. Copies
of the root cover the second case. Each copy begins with one forced onset. All later disturbances are drawn as in any
trial.

Let S be the probability that no onset is effective so far, and c the chance of a model per step. Let a be the
probability that its draw finds a vehicle. The first onset is of this model with probability S * c * a, and then S is
multiplied by 1 - c * a. Draws without a vehicle have no effect, so they neither begin nor end anything. The draws that
find a vehicle are known one step ahead, because the root is undisturbed until then.

The proposal multiplies the probability of each cell (a model with one strength) by a ratio. The proposed probability
accumulates along the root. In each interval of length `Forcing.spacing` of this probability, one onset is placed at a
uniformly drawn point. The weight of an onset is spacing / ratio.

Invariant: let P be the probability, given the root, that the first effective onset of a trial belongs to a set of
onsets. For any set, P is the expected sum of the weights of the proposed onsets in the set. The estimate is the sum of
the weighted crashes of all copies; if the root itself crashes, S at the end of the root is added. The estimate is
therefore unbiased, for all ratios above 0 and for any spacing.

Reason for intervals of fixed length: eight equal parts of each root would need the total probability, which is known
only at the end of the root. A second run of the root would cost its steps again. The spacing is learned, so that a root
has eight copies on average.

Order within a step: disturbances of the agent first, because the agent notices them one step earlier, when the vehicles
around it in the next step are not known. In the step of the onset, models later in this order are drawn as usual.
Models earlier in the order are drawn on the condition that they are not effective.

Second onsets: a copy with its first onset can be treated as a root again. Either the copy has no further effective
onset before its end, or it has a second onset. The same closed form applies to the models after the first onset in the
same step, and to all models from the next step on. A copy may therefore run without later disturbances, and each of its
own copies begins with one forced second onset. The copy itself then counts with the probability of no second onset. The
choice of the copies with a second onset does not depend on their results, so the estimate has no bias. `Forcing`
selects the first onsets that get second onsets. At first, all of them do, because the hunt learns from their results
where second onsets are useful. Later, one copy of each root gets second onsets in addition.

Source: stratified importance sampling (Owen, Monte Carlo theory, methods and examples, 2013, chapters 8 and 9). Cost:
in each step of the root, one check of every place around the agent at which a model may find a vehicle.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from crashhunt.base.foreign_code import supports
from crashhunt.disturbances._protocol import Drawn, Enumerates
from crashhunt.trial import KINDS, SENSOR_KINDS, Disturbance, Forcing, in_turn

if TYPE_CHECKING:
    from crashhunt.disturbances._disturbance_rates import DisturbanceSampler

HasTarget = Callable[[Disturbance], bool]
"""Whether a disturbance that begins in the next step finds a vehicle."""

COPIES_PER_ROOT: Final = 8
"""Mean number of copies: more share one root and are correlated, fewer leave the root's own steps unused."""
FIRST_STEP: Final = 2
"""The first step in which an onset is forced: a fork after step 0 is too late for what an agent sees in step 1."""
SECONDS_PER_COPY: Final = 2
"""Mean number of second onsets that are forced on a copy, where that pays."""
_ONSET_STREAM = 0x6F6E7365  # separates these draws from others with the seed of the trial
_LATER_STREAM = 0x6C617465
_UNLISTED_DRAW = Drawn("", 0.0, 0.0)  # of a model that cannot list what it draws
_KIND_WITH_STRENGTH_TARGETS = (
    "step_out"  # of the kinds of crashhunt the only one whose target depends on more than the place
)


@dataclass(frozen=True, slots=True)
class Onset:
    """The beginning of a first disturbance, which is forced on a copy of the root trial."""

    cell: str  # the model and strength, such as ``brake=4.0``
    weight: float  # probability of all the disturbances that this forced disturbance represents
    step: int  # the step in which the disturbance begins
    planned: tuple[Disturbance, ...]  # the forced disturbance and all later disturbances of the copy, in order
    # only the forced disturbance, for a copy on which second disturbances are forced
    alone: tuple[Disturbance, ...] = ()
    number: int = 0  # number of the forced disturbance in its root trial
    place: int = 0  # position of the model in the order in which models begin disturbances within a step


@dataclass(frozen=True, slots=True)
class _Cell:
    key: str
    drawn: Drawn
    share: float  # of the draws of its model
    ratio: float


@dataclass(frozen=True, slots=True)
class _Place:
    """One model around one agent, with the cell of each of its disturbances."""

    order: int  # within a step
    agent: str
    name: str
    what: str
    chance: float
    cells: Mapping[Drawn, tuple[_Cell, ...]]
    all_cells: tuple[_Cell, ...]


def cell_of(name: str, how_strong: float | None = None) -> str:
    """Return the key of a cell. For a model that cannot list its draws, the key has no strength."""
    return name if how_strong is None else f"{name}={how_strong!r}"


def first_forcing(sampler: DisturbanceSampler, last: int) -> Forcing:
    """Return the forcing of the first roots: natural rates, at most eight copies, second disturbances on all copies.

    If only later roots had second onsets, crashes that need two onsets would have large weights in the first roots, and
    small weights in later roots. An estimate that has missed the large weights would look precise, but would be too
    low.
    """
    draws = len(sampler.agents) * max(0, last - FIRST_STEP + 1)
    log_none = draws * math.fsum(math.log1p(-sampler.chance(name)) for name in sampler.models)
    # 1 - exp() would lose the digits of small chances, and a spacing that is too small makes millions of copies.
    any_onset = max(-math.expm1(log_none), np.finfo(float).tiny * COPIES_PER_ROOT)
    return Forcing(any_onset / COPIES_PER_ROOT, second=_cells_of(sampler), second_spacing=any_onset / SECONDS_PER_COPY)


def _cells_of(sampler: DisturbanceSampler) -> tuple[str, ...]:
    """Return the keys of all cells, sorted."""
    found = set()
    for name, model in sampler.models.items():
        strengths = [drawn.how_strong for drawn, _ in model.possibilities()] if supports(model, Enumerates) else [None]
        found |= {cell_of(name, how_strong) for how_strong in strengths}
    return tuple(sorted(found))


class FirstOnsets:
    """Proposes the first disturbances for the copies of one root trial while the trial runs.

    Args:
        sampler: sampler of the hunt's disturbances, without fixed disturbances.
        forcing: forcing of the root trial.
        seed: seed of the root trial.
        last: number of the last step of the root trial.
        first: the first step in which a disturbance is forced.
        after_place: in the first step, disturbances are forced only at later positions in the order than this position.
        stream: numbers that separate the random numbers of the onsets from other random numbers with the same seed.
        places: places of the sampler with the ratios of the forcing; None to create them.
    """

    def __init__(
        self,
        sampler: DisturbanceSampler,
        forcing: Forcing,
        seed: int,
        last: int,
        *,
        first: int = FIRST_STEP,
        after_place: int = -1,
        stream: tuple[int, ...] = (),
        places: Sequence[_Place] | None = None,
    ) -> None:
        self.survival = 1.0  # probability that no disturbance has been effective until the present step
        # probability, by cell, that the first disturbance belongs to the cell and has begun before the present step
        self.masses: dict[str, float] = {}
        self._sampler, self._forcing, self._seed, self._last = sampler, forcing, seed, last
        self._first, self._after_place, self._stream = first, after_place, stream
        places = _places_of(sampler, forcing.ratios) if places is None else places
        self._places_of_seconds: list[_Place] | None = None  # made once for all copies: each would take as long
        self._of_agent = [place for place in places if place.what in SENSOR_KINDS]
        self._traffic = [place for place in places if place.what not in SENSOR_KINDS]
        self._points = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_ONSET_STREAM, *stream)))
        self._proposed = 0.0
        self._number = 0
        self._point = self._points.random() * forcing.spacing

    def after(self, step: int, has_target: HasTarget) -> list[Onset]:
        """Return the disturbances for copies that are forked after a step; call it after every step, from step 0 on.

        Args:
            step: the completed step.
            has_target: function that returns whether a disturbance that begins in the next step has a target vehicle.
        """
        found: list[Onset] = []
        begins = step + 1
        if self._first <= begins <= self._last:
            skipped: list[tuple[_Place, list[_Cell]]] = []
            for number, place in enumerate(self._traffic):
                if begins == self._first and place.order <= self._after_place:
                    continue
                there = [
                    asked
                    for asked in place.cells
                    if asked is _UNLISTED_DRAW or has_target(_disturbance(place, asked, begins))
                ]
                cells = [cell for asked in there for cell in place.cells[asked]]
                if proposed := self._propose(place, cells):
                    later = [
                        *((one, frozenset(cell.drawn for cell in some)) for one, some in skipped),
                        *((one, None) for one in self._traffic[number + 1 :]),
                    ]
                    found += [self._onset(place, cell, begins, later, n) for cell, n in proposed]
                skipped.append((place, cells))
        begins = step + 2
        if self._first <= begins <= self._last:
            for number, place in enumerate(self._of_agent):
                if begins == self._first and place.order <= self._after_place:
                    continue
                if proposed := self._propose(place, place.all_cells):
                    after = [(one, None) for one in (*self._of_agent[number + 1 :], *self._traffic)]
                    found += [self._onset(place, cell, begins, after, n) for cell, n in proposed]
        return found

    def following(self, onset: Onset) -> FirstOnsets | None:
        """Return an object that proposes second disturbances for a copy; None if the copy gets no second disturbances.

        The method `after` of this object must be called after every step of the copy, from the step on after which the
        copy was forked.
        """
        forcing = self._forcing
        is_pilot = onset.number == self._seed % COPIES_PER_ROOT
        if not forcing.second_spacing or not (is_pilot or onset.cell in forcing.second):
            return None
        if self._places_of_seconds is None:
            self._places_of_seconds = _places_of(self._sampler, {})
        return FirstOnsets(
            self._sampler,
            Forcing(forcing.second_spacing),
            self._seed,
            self._last,
            first=onset.step,
            after_place=onset.place,
            stream=(onset.number,),
            places=self._places_of_seconds,
        )

    def _propose(self, place: _Place, cells: Sequence[_Cell]) -> list[tuple[_Cell, int]]:
        """Return the cells that are drawn for a place in a step, with their numbers, and advance the probability."""
        found = []
        here = self.survival * place.chance
        share = proposed = 0.0
        for cell in cells:
            mass = here * cell.share
            share += cell.share
            self.masses[cell.key] = self.masses.get(cell.key, 0.0) + mass
            proposed += mass * cell.ratio
            # One point lies uniformly in each interval, so the cell under it is drawn by its proposed probability.
            while self._point < self._proposed + proposed:
                found.append((cell, self._number))
                self._number += 1
                self._point = (self._number + self._points.random()) * self._forcing.spacing
        self._proposed += proposed
        self.survival *= 1.0 - place.chance * share
        return found

    def _onset(
        self, place: _Place, cell: _Cell, step: int, in_step: Sequence[tuple[_Place, frozenset[Drawn] | None]],
        number: int,
    ) -> Onset:  # fmt: skip
        """Return a forced disturbance with all later disturbances of the copy.

        Args:
            place: place (model and agent) of the disturbance.
            cell: cell of the disturbance.
            step: the step in which the disturbance begins.
            in_step: the other places from which a disturbance may begin in the same step. Each place has the draws that
                are excluded because they would be effective; None to draw as usual.
            number: number of the disturbance in the root trial.
        """
        rng = np.random.default_rng(
            np.random.SeedSequence(self._seed, spawn_key=(_LATER_STREAM, number, *self._stream))
        )
        sampler, last = self._sampler, self._last
        if cell.drawn is _UNLISTED_DRAW:
            planned = [sampler.draw_one(step, place.name, place.agent, rng)]
        else:
            planned = [_disturbance(place, cell.drawn, step)]
        alone = tuple(planned)
        for other, excluded in in_step:
            begun = sampler.draw_between(step - 1, step, other.name, other.agent, rng)
            while excluded and any(_drawn(one) in excluded for one in begun):
                begun = sampler.draw_between(step - 1, step, other.name, other.agent, rng)
            # A model that cannot list its draws is effective whenever it begins.
            planned += [] if excluded is not None and _UNLISTED_DRAW in excluded else begun
        for other in (*self._of_agent, *self._traffic):
            planned += sampler.draw_between(step, last, other.name, other.agent, rng)
        return Onset(
            cell=cell.key,
            weight=self._forcing.spacing / cell.ratio,
            step=step,
            planned=in_turn(planned),
            alone=alone,
            number=number,
            place=place.order,
        )


def _places_of(sampler: DisturbanceSampler, ratios: Mapping[str, float]) -> list[_Place]:
    """Return the places of all models around all agents; those of the agents' own disturbances come first."""
    names = [(agent, name) for agent in sampler.agents for name in sampler.models]
    names.sort(key=lambda pair: sampler.models[pair[1]].what not in SENSOR_KINDS)
    return [_place_of(sampler, ratios, order, agent, name) for order, (agent, name) in enumerate(names)]


def _place_of(sampler: DisturbanceSampler, ratios: Mapping[str, float], order: int, agent: str, name: str) -> _Place:
    model = sampler.models[name]
    by_place = model.what in KINDS and model.what != _KIND_WITH_STRENGTH_TARGETS
    cells: dict[Drawn, list[_Cell]] = {}
    if supports(model, Enumerates):
        for drawn, share in model.possibilities():
            key = cell_of(name, drawn.how_strong)
            asked = Drawn(drawn.who, 1.0, 1.0) if by_place else drawn
            cells.setdefault(asked, []).append(_Cell(key=key, drawn=drawn, share=share, ratio=ratios.get(key, 1.0)))
    else:  # every draw counts, whether it finds a vehicle or not
        cells[_UNLISTED_DRAW] = [_Cell(key=cell_of(name), drawn=_UNLISTED_DRAW, share=1.0, ratio=ratios.get(name, 1.0))]
    frozen = {asked: tuple(some) for asked, some in cells.items()}
    return _Place(
        order=order,
        agent=agent,
        name=name,
        what=model.what,
        chance=sampler.chance(name),
        cells=frozen,
        all_cells=tuple(cell for some in frozen.values() for cell in some),
    )


def _disturbance(place: _Place, drawn: Drawn, step: int) -> Disturbance:
    return Disturbance(
        step=step,
        who=drawn.who,
        what=place.what,
        how_strong=float(drawn.how_strong),
        how_long=float(drawn.how_long),
        agent=place.agent,
    )


def _drawn(one: Disturbance) -> Drawn:
    return Drawn(one.who, one.how_strong, one.how_long)
