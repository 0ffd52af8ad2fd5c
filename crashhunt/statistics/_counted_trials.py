"""The units of a hunt that count for a rate, their order, and their exposure.

A unit is a trial, or with ``--seeds`` all trials of a traffic seed, because trials in the same traffic are not
independent.

Invariant: units count in the order of their numbers, up to the first trial that has not ended. Trials that crash early
end early, so the finished trials are not a fair sample, but the first k trials are. The interval therefore stays valid
if a hunt stopped at its first crash, was killed, ran out of time, or used many workers.

Invalid trials count neither as crashes nor as exposure. If more than 5 % of the trials are invalid, the rate would
refer to other traffic than described, so no rate is reported. A trial whose process was killed from outside has not
ended, and a resumed hunt runs the trial again.

Cost: constant for each trial. A trial stays in memory only until all trials of lower numbers have ended.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from crashhunt.base.text import format_percent
from crashhunt.plans import RATE_PERS, RatePer
from crashhunt.statistics._anytime_interval import Bets, Interval, RateTest
from crashhunt.trial import KILLED, Failure, Outcome

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

Per: TypeAlias = RatePer
"""What a rate is per."""

PERS: tuple[Per, ...] = RATE_PERS
PER_WORDS: dict[Per, str] = {"trial": "per trial", "hour": "per hour", "1000km": "per 1,000 km"}
MAX_INVALID_SHARE = 0.05  # of the trials that have ended
_SURELY_INVALID_SHARE = 0.04  # against 5 % itself, a share of just 5 % would never be decided
MAX_SPEED_MPS = 100.0  # 360 km/h: no trial's vehicle is faster, so the exposure in km has a bound before it begins
_S_PER_HOUR, _M_PER_1000KM = 3600.0, 1e6
_SPARE_STEPS = 1  # of the bound: exposures are rounded


class TrialFacts(NamedTuple):
    """The facts about a trial that a rate needs."""

    number: int  # number of the trial in the hunt
    # whether the trial has ended; False if its process was killed from outside, so that a resumed hunt runs the trial
    # again
    has_ended: bool
    valid: bool  # whether the trial could be set up
    crashed: bool  # whether the trial ended with an outcome that the hunt counts as a crash
    steps: int = 0  # number of steps of the trial
    driven_s: float | None = None  # time that the agents drove, in s; None if it is unknown
    driven_m: float | None = None  # distance that the agents drove, in m; None if it is unknown
    step_length_s: float | None = None  # step length of the simulator, in s; None if it is unknown
    origin: str = ""  # the strategy that proposed the trial; empty if there was none
    # the groups to which the trial belongs, such as the bin of an argument; used for parts of a rate
    tags: tuple[str, ...] = ()
    seed: int = 0  # seed of the trial's traffic
    # the reason why the trial is invalid, where a ledger was read; None if the trial is valid
    failure: Failure | None = None


Unit: TypeAlias = tuple[TrialFacts, ...]
"""The valid trials of a unit: one, or all of a traffic."""


def facts_of_plain(data: Mapping[str, Any], crash_on: Sequence[str], tags: tuple[str, ...] = ()) -> TrialFacts:
    """Return the facts about a trial that a rate needs, from its data in a ledger."""
    spec, failure, valid = data["spec"], data.get("failure") or {}, data["outcome"] != Outcome.INVALID
    return TrialFacts(
        number=spec["number"],
        has_ended=failure.get("kind") != KILLED,
        valid=valid,
        crashed=data["outcome"] in crash_on,
        steps=data["steps"],
        driven_s=data.get("driven_s"),
        driven_m=data.get("driven_m"),
        step_length_s=data.get("step_length_s"),
        origin=spec.get("origin", ""),
        tags=tags,
        seed=spec["seed"],
        failure=None if valid else Failure.from_json(failure),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class CountingRule:
    """The rule by which trials count, fixed before the first trial."""

    max_steps: int  # maximum number of steps of a trial
    agents: int = 1  # number of controlled vehicles
    # the origin of the trials that were drawn independently; empty if all trials were drawn independently
    plain_origin: str = ""
    traffics: int = 0  # number of traffic seeds of the hunt; 0 if each trial has its own seed
    planned: int = 0  # planned number of trials; 0 for no limit
    # function that returns whether no agent was trained on the traffic of a seed; None if no agent was trained
    is_held_out: Callable[[int], bool] | None = None
    first: int = 0  # number of the first trial that counts; trials of lower numbers may have run with other code

    @property
    def trials_per_unit(self) -> int:
        """The number of trials in a unit: one, or the number of trials of a traffic seed."""
        return self.planned // self.traffics if self.traffics else 1

    def bets(self, per: Per, step_length_s: float | None) -> Bets:
        """Return the bets on units, with the maximum exposure of a unit."""
        most = self.trials_per_unit
        if per == "trial":
            return Bets(most, most)
        seconds = (self.max_steps + _SPARE_STEPS) * self.agents * (step_length_s or 1.0)
        exposure = seconds / _S_PER_HOUR if per == "hour" else seconds * MAX_SPEED_MPS / _M_PER_1000KM
        return Bets(most, most * exposure, fixed_exposure=False)


class UnitSequence:
    """Combines trials that end in any order to units in the order of their numbers."""

    def __init__(self, rule: CountingRule) -> None:
        self._rule = rule
        self._waiting: dict[int, TrialFacts] = {}
        self._traffics: dict[int, list[TrialFacts]] = {}
        self._next = rule.first  # trial, or traffic
        self.valid = self.invalid = self.not_random = self.trained_on = 0  # of the trials in the sequence
        self.other_code = 0  # trials before the sequence
        self.hopeless_at: int | None = None  # the first trial with which too many are invalid, see has_too_many_invalid

    def add(self, trial: TrialFacts) -> Iterator[Unit]:
        """Add a trial, and yield the units that are now complete."""
        if not trial.has_ended:
            return
        if self._rule.traffics:
            yield from self._add_to_traffic(trial)
            return
        if trial.number < self._rule.first:
            self.other_code += 1
            return
        self._waiting[trial.number] = trial
        while (found := self._waiting.pop(self._next, None)) is not None:
            self._next += 1
            if unit := self._counted([found]):
                yield unit

    def add_counted(self, *, valid: int, invalid: int) -> None:
        """Add the first trials of a hunt as counts, if each trial is a unit with its own traffic."""
        self._next += valid + invalid
        self.valid += valid
        self.invalid += invalid

    def _add_to_traffic(self, trial: TrialFacts) -> Iterator[Unit]:
        turns, rounds = self._rule.traffics, self._rule.trials_per_unit
        if trial.number < turns * rounds:  # an incomplete last round would give some traffics more trials than others
            self._traffics.setdefault(trial.number % turns, []).append(trial)
        while len(self._traffics.get(self._next, ())) == rounds > 0:
            unit = self._counted(self._traffics.pop(self._next))
            self._next += 1
            if unit:
                yield unit

    def _counted(self, trials: list[TrialFacts]) -> Unit:
        """Return the trials that count."""
        origin = self._rule.plain_origin
        plain = [trial for trial in trials if not origin or trial.origin == origin]
        self.not_random += len(trials) - len(plain)
        if (is_held_out := self._rule.is_held_out) is not None:
            held_out = [trial for trial in plain if is_held_out(trial.seed)]
            self.trained_on += len(plain) - len(held_out)
            plain = held_out
        counted = tuple(trial for trial in plain if trial.valid)
        self.invalid += len(plain) - len(counted)
        self.valid += len(counted)
        if self.hopeless_at is None and has_too_many_invalid(self.invalid, self.valid):
            self.hopeless_at = trials[-1].number
        return counted

    @property
    def position(self) -> int:
        """The number of trials, or of traffic seeds, that have ended without a gap from number 0 on."""
        return self._next

    @property
    def excluded(self) -> int:
        """The number of trials that have ended although a trial of a lower number has not."""
        return len(self._waiting) + sum(map(len, self._traffics.values()))

    @property
    def why_empty(self) -> str:
        """Return the reason why no trial counts, for a sequence without a valid trial."""
        if self.trained_on and not self.invalid:
            return (
                f"an agent was trained on the traffic of all {self.trained_on} trials; run another --seed, or train "
                "with a test share"
            )
        if self.other_code and not self._waiting and not self.invalid:
            return f"all {self.other_code} trials ran with earlier code, or had begun when the code changed"
        if self._waiting:
            return f"trial {self._next} has not ended, and trials count in the order of their numbers"
        if self._traffics:
            trials = f"all of its {self._rule.trials_per_unit} trials"
            return f"traffic {self._next} has not ended {trials}, and traffics count in the order of their numbers"
        return "no valid trial has finished"

    @property
    def invalid_share(self) -> float:
        """The share of invalid trials among the trials of the sequence."""
        return self.invalid / (self.invalid + self.valid) if self.invalid else 0.0


def why_too_many_invalid(invalid: int, valid: int, are_invalid: str) -> str:
    """Return why units allow no rate or verdict because too many are invalid; empty if few enough are."""
    if not invalid or invalid / (invalid + valid) <= MAX_INVALID_SHARE:
        return ""
    many = f"{invalid} of {invalid + valid} {are_invalid}"
    return f"{many}, more than {format_percent(MAX_INVALID_SHARE)}: the rest is other traffic than described"


def has_too_many_invalid(invalid: int, valid: int) -> bool:
    """Return whether the share of invalid trials exceeds `MAX_INVALID_SHARE`, and more trials will hardly change this.

    If so, the share among all trials is above 4 %, with an error probability of at most 5 %. A hunt with a share of 5 %
    or more therefore ends after some thousand trials.
    """
    if invalid <= MAX_INVALID_SHARE * (invalid + valid):
        return False
    test = RateTest()
    test.add(1, times=invalid)
    test.add(0, times=valid)
    return test.verdict(_SURELY_INVALID_SHARE) == "above"


def exposure_of(trial: TrialFacts, per: Per) -> float | None:
    """Return the exposure of a trial, in trials, hours or 1,000 km; None if it is unknown."""
    if per == "trial":
        return 1.0
    driven = trial.driven_s if per == "hour" else trial.driven_m
    if driven is None:
        return 0.0 if trial.crashed else None  # a crash whose recording is damaged counts with exposure 0
    return driven / (_S_PER_HOUR if per == "hour" else _M_PER_1000KM)


class RateCounter:
    """Counts units for one measure of exposure, either of all trials or of a part of the trials.

    ``within`` returns whether a trial belongs to the part, and ``matches`` whether a crash does; None for all.
    """

    def __init__(
        self,
        rule: CountingRule,
        per: Per,
        *,
        within: Callable[[TrialFacts], bool] | None = None,
        matches: Callable[[TrialFacts], bool] | None = None,
    ) -> None:
        self._rule, self._per = rule, per
        self._within, self._matches = within, matches
        self.test: RateTest | None = None
        self.units = self.trials = self.crashes = self.steps = 0
        self.driven_s = self.driven_m = 0.0
        self.is_measured = per == "trial"  # whether the exposure of any trial is known
        self.why_not = ""

    def add(self, unit: Unit) -> tuple[float, float] | None:
        """Add a unit; return its crashes and its exposure, or None if it does not belong to the part."""
        trials = [trial for trial in unit if self._within(trial)] if self._within is not None else unit
        if not trials:
            return None
        crashed = [trial for trial in trials if trial.crashed and (self._matches is None or self._matches(trial))]
        exposure = math.fsum(map(self._exposure, trials))
        self.units += 1
        self.trials += len(trials)
        self.crashes += len(crashed)
        self.steps += sum(trial.steps for trial in trials)
        self.driven_s += sum(trial.driven_s or 0.0 for trial in trials)
        self.driven_m += sum(trial.driven_m or 0.0 for trial in trials)
        if self.test is None:
            step_length_s = next((trial.step_length_s for trial in trials if trial.step_length_s), None)
            if step_length_s is None and self._per != "trial":
                self.why_not = self.why_not or f"trial {trials[0].number} has no driven distance and time"
            self.test = RateTest(self._rule.bets(self._per, step_length_s))
        try:
            self.test.add(len(crashed), exposure)
        except ValueError as error:
            self.why_not = self.why_not or f"trial {trials[0].number} is beyond the bounds of the hunt: {error}"
        return len(crashed), exposure

    def add_counted(self, *, trials: int, crashes: int, steps: int) -> None:
        """Add the numbers of trials and of crashes, which determine the rate per trial if each trial is a unit."""
        self.units += trials
        self.trials += trials
        self.crashes += crashes
        self.steps += steps
        if self.test is None:
            self.test = RateTest(self._rule.bets("trial", None))
        self.test.add(1, 1.0, crashes)
        self.test.add(0, 1.0, trials - crashes)

    def _exposure(self, trial: TrialFacts) -> float:
        driven = exposure_of(trial, self._per)
        if driven is None:
            self.why_not = self.why_not or f"trial {trial.number} has no driven distance and time"
            return 0.0
        self.is_measured = self.is_measured or trial.driven_s is not None
        return driven

    def interval(self, alpha: float) -> Interval | None:
        """Return the interval that is valid at any time; None if there is no unit, or if an exposure is unknown."""
        return None if self.test is None or self.why_not else self.test.interval(alpha)

    @property
    def observed(self) -> float | None:
        """Crashes divided by exposure; None if the exposure is unknown."""
        return None if self.test is None or self.why_not else self.test.observed
