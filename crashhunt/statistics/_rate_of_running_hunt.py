"""The trials that count for the crash rate of a hunt, the rate of a running hunt, and rare mode.

Cost: constant for each trial. A resumed hunt reads the number and the outcome of each earlier trial once.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from crashhunt.base.errors import UsageError
from crashhunt.disturbances import first_forcing
from crashhunt.plans import rate_of, share_of
from crashhunt.results import CodeVersions
from crashhunt.statistics._rare import BLOCK, TRIALS_PER_ROOT, RareCounter, is_root, learn_forcing, root_of, with_plain
from crashhunt.statistics._rate_report import make_rate
from crashhunt.statistics._running import WHY_NOT_UNTIL_RATE, BarWatch, Paced, RateWatch
from crashhunt.statistics._units import CountingRule, TrialFacts
from crashhunt.trial import Forcing, Outcome

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from crashhunt.disturbances import DisturbanceSampler
    from crashhunt.ledger import Facts, Ledger, RunningRate
    from crashhunt.plans import HuntSettings
    from crashhunt.statistics._rare import RareEstimate
    from crashhunt.statistics._rate_report import CrashRate
    from crashhunt.training import HeldOutTraffics
    from crashhunt.trial import Forced, ForcedCopy, TrialResult


def counting_rule(settings: HuntSettings, facts: Facts, held_out: HeldOutTraffics | None = None) -> CountingRule:
    """Return the rule by which the trials of a hunt count.

    Args:
        settings: settings of the hunt.
        facts: facts from the hunt's ledger.
        held_out: rule for the traffic on which agents were trained; None if the caller excludes these trials itself.
    """
    independent = bool(facts.get("independent", settings.sampler == "random"))
    origin = "" if independent or settings.seeds else facts.get("plain_origin") or ""
    return CountingRule(
        max_steps=settings.max_steps,
        agents=max(1, len(settings.agents)),
        plain_origin=origin,
        traffics=settings.seeds,
        planned=settings.trials,
        is_held_out=held_out.has if held_out is not None and held_out.records else None,
        first=CodeVersions.of(facts).first,
    )


def refuse_training_traffic(settings: HuntSettings, held_out: HeldOutTraffics) -> None:
    """Refuse a hunt that ends with a rate, if the training of its agents makes such a rate impossible.

    Raises:
        UsageError: an agent was trained on the traffic of the hunt.
    """
    fix = "give another --seed"
    if settings.rare and any(settings.seed in record.hunt_seeds for record in held_out.records):
        raise UsageError(f"--rare: an agent was trained on traffics of --seed {settings.seed}", fix=fix)
    if settings.run.until_rate and held_out.is_empty:
        raise UsageError(f"--until-rate: an agent was trained on all traffics of --seed {settings.seed}", fix=fix)


def why_no_interval(settings: HuntSettings, facts: Facts) -> str:
    """Return the reason why the trials of a hunt give no rate; empty if they give a rate."""
    if settings.rare:
        return "in rare mode, one of five trials runs without disturbances; crashhunt status reports the rate"
    if settings.seeds:
        if settings.sampler != "random":
            return f"the sampler {settings.sampler} does not draw trials independently"
        if settings.trials < settings.seeds:
            return "no number of trials was fixed ahead for each traffic (--seeds): TRIALS must be at least --seeds"
        if facts.get("replanned"):
            return "TRIALS was changed after results were known, and with --seeds it decides what counts as a unit"
        return ""
    if facts.get("independent", settings.sampler == "random") or facts.get("plain_origin"):
        return ""
    return f"the sampler {settings.sampler} does not draw trials independently"


def bar_watch(settings: HuntSettings, ledger: Ledger, held_out: HeldOutTraffics, first: int = 0) -> BarWatch | None:
    """Return an object that compares the rate with the threshold, with earlier trials added; None without threshold."""
    if not settings.run.until_rate:
        return None
    bar, per = rate_of(settings.run.until_rate)
    rule = replace(counting_rule(settings, {"independent": True}, held_out), first=first)
    watch = BarWatch(rule, bar, per, settings.crash_on)
    for data in ledger.plain_results():
        watch.add(data)
    return watch


def rate_of_bar(directory: Path, watch: BarWatch | None) -> CrashRate | None:
    """Return the final crash rate of a hunt that compares its rate with a threshold; None without a threshold."""
    if watch is None:
        return None
    found = make_rate(
        str(directory), watch.per, watch.counter, watch.sequence, confidence=100 * (1 - watch.alpha),
        why_no_estimate=WHY_NOT_UNTIL_RATE, bar=watch.bar,
    )  # fmt: skip
    excluded = found.excluded
    if watch.decided_at is not None:  # which later trials have ended depends on the workers
        excluded = {reason: count for reason, count in excluded.items() if reason != "after_unfinished"}
    return replace(found, excluded=excluded, verdict=watch.verdict, why_undecided=watch.why_undecided)


def rate_watch(settings: HuntSettings, ledger: Ledger, held_out: HeldOutTraffics) -> RateWatch | None:
    """Return an object that computes the rate per trial, with earlier trials added; None if there is no rate."""
    facts = ledger.facts()
    if why_no_interval(settings, facts):
        return None
    watch = RateWatch(counting_rule(settings, facts, held_out), "trial", settings.crash_on)
    for number, seed, outcome, origin, was_killed in ledger.endings():
        trial = TrialFacts(
            number=number,
            has_ended=not was_killed,
            valid=outcome != Outcome.INVALID,
            crashed=outcome in settings.crash_on,
            origin=origin,
            seed=seed,
        )
        watch.add_facts(trial)
    return watch


# Rare mode of a hunt: every fifth trial is a root, whose copies have forced first onsets; the others are plain trials.
#
# The forcing of a root depends on its number and on the results of earlier blocks alone. So the roots are the same with
# any number of workers, and after the hunt was killed and resumed.
#
# ``--until-error`` ends the hunt at the first full block at which the interval is narrow enough. Roots above that block
# may have ended by then. They do not count, because that they have ended depends on the number of workers.

_MAX_VERIFIED_ROOTS = 5  # roots; a crash of a copy is a crash only where it comes again from the start


class Forcings:
    """Chooses the forcing of each root, from the results of the blocks of roots before the previous block.

    Args:
        settings: settings of the hunt.
        ledger: ledger of the hunt.
        sampler: sampler of the hunt's disturbances.
    """

    def __init__(self, settings: HuntSettings, ledger: Ledger, sampler: DisturbanceSampler) -> None:
        self._ledger = ledger
        self._start = first_forcing(sampler, settings.max_steps)
        self._earlier: list[Forced] = []
        self._known = 0  # trials that the earlier results are of
        self._current = self._start

    @staticmethod
    def needed(number: int) -> int:
        """Return the number of trials, from number 0 on, that must have ended before the given trial begins."""
        if not is_root(number):
            return 0
        return max(0, number // TRIALS_PER_ROOT // BLOCK - 1) * BLOCK * TRIALS_PER_ROOT

    def of(self, number: int) -> Forcing | None:
        """Return the forcing of a root; None for a plain trial. Call this method in the order of trial numbers."""
        if not is_root(number):
            return None
        needed = self.needed(number)
        if self._known < needed:
            for earlier in range(self._known, needed, TRIALS_PER_ROOT):
                result = self._ledger.result(earlier)
                if result is not None and result.forced is not None and not result.forced.unanswered:
                    self._earlier.append(result.forced)
            self._known = needed
            self._current = learn_forcing(self._earlier, self._start)
        return self._current


class RareWatch:
    """Reads trials in the order of their numbers, and finds the block after which the hunt may end.

    A root counts after its plain trials have ended as well.

    Args:
        settings: settings of the hunt.
        ledger: ledger of the hunt.
        sampler: sampler of the hunt's disturbances.

    Attributes:
        weightiest: the greatest weights of roots with a crashed copy, in descending order.
        is_met: whether the interval is narrow enough; no further trial is then read.
        is_replanned: whether TRIALS was changed after results were known.
    """

    def __init__(self, settings: HuntSettings, ledger: Ledger, sampler: DisturbanceSampler) -> None:
        self.weightiest: list[TrialResult] = []
        self.is_met = False
        self.is_replanned = False
        self._settings, self._ledger = settings, ledger
        self._hazard = len(sampler.agents) * math.fsum(sampler.chance(name) for name in sampler.models)
        self._counter = RareCounter(min(1.0, self._hazard * settings.max_steps))
        self._until = share_of(settings.run.until_error) if settings.run.until_error else 0.0
        self._read = 0  # trials
        self._group: list[TrialResult] = []  # the last root that was read, and its plain trials
        self._paced: Paced[RunningRate] = Paced(lambda: self.estimate().running())

    @property
    def roots(self) -> int:
        """The number of roots that were read together with their plain trials."""
        return self._counter.roots + self._counter.excluded

    def read(self, finished: int | None = None) -> None:
        """Read the finished trials, up to the first trial that has not finished.

        Args:
            finished: number of first trials that have finished; None to read it from the ledger.
        """
        while not self.is_met and (finished is None or self._read < finished):
            result = self._ledger.result(self._read)
            if result is None:
                return
            self._read += 1
            self._group.append(result)
            if self._read % TRIALS_PER_ROOT == 0:
                self._count(*self._group)
                self._group.clear()

    def _count(self, first: TrialResult, *plain: TrialResult) -> None:
        root = root_of(first, self._settings.crash_on, self._hazard)
        if root is None:
            valid = [one for one in plain if one.outcome is not Outcome.INVALID]
            crashed = [one.outcome in self._settings.crash_on for one in valid]
            self._counter.add(None, crashed, len(plain) - len(valid))
        else:
            self._counter.add(with_plain(root, plain, self._settings.crash_on))
            if any(crashed_copies(first)):
                self.weightiest.append(first)
                self.weightiest.sort(key=greatest_weight, reverse=True)
                del self.weightiest[_MAX_VERIFIED_ROOTS:]
        if self._until and self.roots % BLOCK == 0:
            self.is_met = self.estimate().relative_error <= self._until

    def estimate(self) -> RareEstimate:
        """Return the estimate from the trials that were read.

        If TRIALS was changed after results were known, it may have been changed because of a crash. An interval needs
        many crashes, so only an estimate with an interval remains.
        """
        found = self._counter.estimate()
        if not found.estimate or found.estimated is not None or not self.is_replanned:
            return found
        return replace(
            found, estimate=None, why_not=f"TRIALS was changed after results were known, and {found.why_not}"
        )

    def running(self, *, now: bool = False) -> RunningRate:
        """Return the current crash rate.

        Args:
            now: whether the rate must be up to date; otherwise it may be some moments old.
        """
        return self._paced(self._read // TRIALS_PER_ROOT, now=now)


def forcings_of(settings: HuntSettings, ledger: Ledger, sampler: DisturbanceSampler | None) -> Forcings | None:
    """Return the object that determines the forcing of roots; None if the hunt is not in rare mode."""
    if not settings.rare:
        return None
    assert sampler is not None
    return Forcings(settings, ledger, sampler)


def rare_watch(settings: HuntSettings, ledger: Ledger, sampler: DisturbanceSampler | None) -> RareWatch | None:
    """Return the object that estimates the crash rate; None if the hunt is not in rare mode."""
    if not settings.rare:
        return None
    assert sampler is not None
    watch = RareWatch(settings, ledger, sampler)
    watch.is_replanned = bool(ledger.facts().get("replanned"))
    return watch


def crashed_copies(result: TrialResult) -> Iterator[ForcedCopy]:
    """Return the copies of a root that crashed."""
    return (copy for copy in result.forced.copies if copy.crash) if result.forced is not None else iter(())


def greatest_weight(result: TrialResult) -> float:
    """Return the greatest weight among the crashed copies of a root with at least one crashed copy."""
    return max(copy.weight for copy in crashed_copies(result))
