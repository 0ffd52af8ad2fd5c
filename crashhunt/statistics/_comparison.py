"""Comparison of hunts: which hunt crashes more often, and whether the difference may be chance, at any time.

Hunts with the same seed and traffic are compared pair by pair (`crashhunt.statistics.PairSequence`). The answer is
valid at any time, even while the hunts run, after they were killed, or after they stopped at their first crash. Hunts
without common traffic are compared by their certain intervals, each with half of the error probability.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from contextlib import closing
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.base import layout
from crashhunt.base.calls import clear_calls
from crashhunt.base.errors import HuntDirectoryError, UsageError
from crashhunt.base.text import count_of, one_of
from crashhunt.ledger import Ledger
from crashhunt.results import HuntResults
from crashhunt.statistics._anytime_interval import Interval
from crashhunt.statistics._comparison_report import ALPHA, CONFIDENCE, Answer, Comparison, HuntFigures, Pair
from crashhunt.statistics._counted_pairs import Pair as TrialPair, PairSequence
from crashhunt.statistics._counted_trials import PERS, CountingRule, Per, TrialFacts, facts_of_plain
from crashhunt.statistics._hunt_rate import measure_rates
from crashhunt.statistics._paired_rates import difference_of_rates
from crashhunt.statistics._paired_test import PairTest
from crashhunt.statistics._rate_of_running_hunt import counting_rule
from crashhunt.training import HeldOutTraffics, held_out_traffics
from crashhunt.trial import Constant, Outcome

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from crashhunt.plans import HuntSettings
    from crashhunt.statistics._rate_report import CrashRate
    from crashhunt.training import TrainedOn


@clear_calls()
def compare(*directories: Path | str, per: Per = "trial") -> Comparison:
    """Compare the crash rates of hunts; for trials with equal seeds, report whether one hunt crashes less.

    Args:
        directories: directories of at least two hunts.
        per: the unit of the rates and of their difference: ``trial``, ``hour`` or ``1000km``.

    Raises:
        UsageError: fewer than two directories are given, or the unit does not exist.
        HuntDirectoryError: a directory contains no hunt, or its ledger is damaged.
    """
    if len(directories) < 2:
        raise UsageError("a single hunt cannot be compared", fix="give the directories of at least two hunts")
    if per not in PERS:
        raise UsageError(f"per is {per!r}", fix=one_of(str(per), PERS))
    hunts = [HuntResults(directory) for directory in directories]
    for hunt in hunts:
        if hunt.state.damaged:
            raise HuntDirectoryError(hunt.state.detail)
    held_out = held_out_by_seed(hunts)
    sides = [_Side(hunt, held_out[hunt.settings.seed], per) for hunt in hunts]
    figures = [_figures(side) for side in sides]
    pairs = tuple(
        _pair(sides[0], figures[0], side, figure) for side, figure in zip(sides[1:], figures[1:], strict=True)
    )
    return Comparison(tuple(figures), pairs)


def held_out_by_seed(compared: Sequence[HuntResults]) -> dict[int, HeldOutTraffics]:
    """Return for each hunt seed the rule that selects the trials of a comparison; it reads each snapshot once.

    Raises:
        HuntDirectoryError: a training record is damaged.
        BundleError: a snapshot is damaged.
    """
    alike: dict[int, list[HuntResults]] = {}
    for hunt in compared:
        alike.setdefault(hunt.settings.seed, []).append(hunt)
    return {
        seed: held_out_traffics(hunts[0].settings, [hunt.directory for hunt in hunts]) for seed, hunts in alike.items()
    }


class _Side:
    """A hunt in a comparison, whose trials are read once for each confidence."""

    def __init__(self, hunt: HuntResults, held_out: HeldOutTraffics, per: Per) -> None:
        self.hunt, self.held_out, self.per = hunt, held_out, per
        self._rates: dict[float, CrashRate] = {}

    def rate(self, confidence: float = 100 * CONFIDENCE) -> CrashRate:
        """Return the crash rate."""
        if confidence not in self._rates:
            rates = measure_rates(self.hunt.directory, per=self.per, confidence=confidence, held_out=self.held_out)
            self._rates[confidence] = rates[0]
        return self._rates[confidence]

    @property
    def rule(self) -> CountingRule:
        """The rule by which the trials of the hunt count, without its training records."""
        return counting_rule(self.hunt.settings, self.hunt.facts)

    @cached_property
    def own_records(self) -> tuple[TrainedOn, ...]:
        """The training records of the hunt's own agents."""
        return held_out_traffics(self.hunt.settings, [self.hunt.directory]).records


# One hunt in numbers.

_WITH_A_REASON = {"trained_on", "after_unfinished"}  # why no trial counts although there are some, as the rate says


def _figures(side: _Side) -> HuntFigures:
    hunt, rate = side.hunt, side.rate()
    table, outcomes = _table(side), hunt.state.outcomes
    if hunt.code_versions.are_several:
        with closing(Ledger(hunt.directory / layout.LEDGER)) as ledger:
            used = ledger.snapshots()
        outcomes = dict(sum((Counter(used.get(digest)) for digest in hunt.code_versions.newest), Counter()))
    valid = table[table["valid"]]
    crashed, fine = valid[valid["crash"]], valid[~valid["crash"]]
    return HuntFigures(
        dir=str(hunt.directory),
        state=hunt.state.state,
        agents={agent: chosen.agent for agent, chosen in hunt.settings.agents.items()},
        trials=rate.trials,
        crashes=rate.crashes,
        crash_rate=_share(hunt, rate),
        interval=None if rate.certain is None else (rate.certain.low, rate.certain.high),
        why_not=rate.why_not if rate.trials or _WITH_A_REASON & rate.excluded.keys() else "there is no valid trial",
        median_steps_to_crash=float(np.median(crashed["steps"])) if len(crashed) else float("nan"),
        median_time_to_collision_s=float(np.median(fine["ttc"])) if len(fine) else float("nan"),
        outcomes=outcomes,
        counted=hunt.plain_origin,
        disturbed=_disturbed(hunt, set(crashed["number"].tolist())) if hunt.settings.disturb else None,
        excluded=rate.excluded.get("after_unfinished", 0),
        exclusions=rate.excluded,
        per=side.per,
    )


def _share(hunt: HuntResults, rate: CrashRate) -> float:
    """Return the share of trials that crashed; NaN if the share would be biased.

    The number of trials may depend on the crashes. In rare mode, one of five trials runs without disturbances.
    """
    if rate.estimate is not None:
        return rate.estimate
    run = hunt.settings.run
    is_whole = hunt.state.state in ("finished", "crashed") and run.keep_going and not run.distinct
    is_whole = is_whole and not hunt.facts.get("replanned")
    # A grid has a share as well, but no interval.
    if rate.certain is None and is_whole and not hunt.settings.rare and rate.trials and rate.per == "trial":
        return rate.crashes / rate.trials
    return math.nan


def _table(side: _Side) -> NDArray[np.void]:
    """Return number, steps, least time to collision, whether it counts and whether it crashed, for each trial in order.

    If the search guided the hunt, only unguided trials are returned. Trials with training traffic and trials with
    earlier code are excluded.
    """
    hunt, held_out, first = side.hunt, side.held_out, side.hunt.code_versions.first
    crash_on = hunt.settings.crash_on
    fields = [("number", "i8"), ("steps", "i8"), ("ttc", "f8"), ("valid", "?"), ("crash", "?")]
    with closing(Ledger(hunt.directory / layout.LEDGER)) as ledger:
        rows = (
            (number, steps, np.inf if ttc is None else ttc, name != Outcome.INVALID, name in crash_on)
            for number, seed, name, steps, ttc in ledger.table()
            if held_out.has(seed) and number >= first
        )
        table = np.fromiter(rows, fields)
    if hunt.plain_origin:
        plain = [row.number for row in hunt.trial_rows() if row.data["spec"].get("origin") == hunt.plain_origin]
        table = table[np.isin(table["number"], plain)]
    return np.sort(table, order="number")


def _disturbed(hunt: HuntResults, crashed: set[int]) -> int:
    found = hunt.results(outcomes=tuple(map(str, hunt.settings.crash_on)))
    return sum(result.disturbed for result in found if result.spec.number in crashed)


# Two hunts.


def _pair(one: _Side, figures: HuntFigures, two: _Side, other: HuntFigures) -> Pair:
    first, second = one.hunt, two.hunt
    counts = (figures.crashes, figures.trials, other.crashes, other.trials)
    why_not = why_unpaired(first.settings, second.settings)
    if not why_not:
        sequence, test, trained_on, pairs = _paired(one, two)
        if test.pairs and not sequence.why_not:
            found = _by_pairs(one, two, sequence, test, counts, pairs)
            return replace(
                found,
                caution="; ".join(
                    filter(
                        None, (found.caution, _only_held_out(trained_on, test.trials), _overlap(found, figures, other))
                    )
                ),
                excluded=found.excluded + 2 * trained_on,
            )
        if trained_on and not test.pairs:
            raise UsageError(
                f"an agent was trained on all {trained_on} traffics that {first.directory} and {second.directory} have "
                "in common",
                fix="run both with another --seed, or train with a test share",
            )
        if sequence.why_not:
            why_not = f"they have too few valid trials in common: {sequence.why_not}"
        elif sequence.not_same:
            settings = first.settings.seed, second.settings.seed
            why_not = (
                "they have other values of the scenario's arguments with the same seeds"
                if settings[0] == settings[1]
                else "they have no seed in common: run both with the same --seed"
            )
        else:
            why_not = "they have no pair of trials yet"
    return _by_intervals(one, two, why_not, counts)


def _by_pairs(
    one: _Side,
    two: _Side,
    sequence: PairSequence,
    test: PairTest,
    counts: tuple[int, int, int, int],
    pairs: Sequence[TrialPair],
) -> Pair:
    first, second = one.hunt, two.hunt
    evidence: float | None = math.exp(min(test.log_evidence, 700.0))  # a float ends soon after
    difference, why_none = test.difference(ALPHA), ""
    if one.per != "trial":
        evidence, in_unit = None, difference_of_rates(pairs, (one.rule, two.rule), one.per, ALPHA)
        difference, why_none = (None, in_unit) if isinstance(in_unit, str) else (in_unit, "")
    p_value = None
    if _is_fixed_ahead(one) and _is_fixed_ahead(two):
        from scipy.stats import binomtest

        discordant = test.only_first + test.only_second
        p_value = float(binomtest(test.only_first, discordant).pvalue) if discordant else 1.0
    return Pair(
        first=str(first.directory),
        second=str(second.directory),
        trials=test.trials,
        only_first=test.only_first,
        only_second=test.only_second,
        both=test.both,
        p_value=p_value,
        caution="; ".join(filter(None, (why_none, _caution(first, second), _invalid_pairs(one, two, test)))),
        counts=counts,
        evidence=evidence,
        difference=difference,
        units=test.pairs,
        excluded=sequence.excluded + 2 * sequence.invalid,
        answer=_answer_of(difference),
        per=one.per,
        not_started=(test.side(0).not_started, test.side(1).not_started),
        without_result=test.unknown,
    )


def _answer_of(difference: Interval | None) -> Answer:
    """Return which hunt crashes less, from the interval of the difference; the only place that decides."""
    if difference is None:
        return ""
    return "first" if difference.low > 0 else "second" if difference.high < 0 else "undecided"


def _invalid_pairs(one: _Side, two: _Side, test: PairTest) -> str:
    """Return what the trials that are invalid in one hunt only mean for the answer; empty if there are none."""
    found = []
    for number, side in enumerate((one, two)):
        counts, name = test.side(number), side.hunt.directory
        if counts.not_started:
            found.append(f"{name} does not start in {counts.not_started} of the pairs, which count as crashes "
                         f"({counts.example})")  # fmt: skip
        if counts.lost:
            found.append(f"{count_of(counts.lost, 'more pair')} without a result: {name} was killed from outside or "
                         "could not be set up; the answer is valid for any result")  # fmt: skip
    return "; ".join(found)


def _overlap(found: Pair, one: HuntFigures, two: HuntFigures) -> str:
    """Return why the hunts differ although their intervals overlap; empty if there is nothing to explain."""
    if found.answer not in ("first", "second") or not one.interval or not two.interval:
        return ""
    if one.interval[1] < two.interval[0] or two.interval[1] < one.interval[0]:
        return ""
    return "the intervals of the two hunts overlap: the difference of trials in the same traffic decides"


def _only_held_out(trained_on: int, counted: int) -> str:
    if not trained_on:
        return ""
    return f"only {counted} held-out pairs count: an agent was trained on traffics of the other {trained_on}"


def _by_intervals(one: _Side, two: _Side, why_not: str, counts: tuple[int, int, int, int]) -> Pair:
    """Compare hunts without common traffic; each interval has half of the error probability."""
    first, second = one.hunt, two.hunt
    rates = [side.rate(100 * (1 - ALPHA / 2)) for side in (one, two)]
    for rate in rates:
        if rate.certain is None and rate.excluded.get("trained_on"):
            why_not += f"; {rate.dir} has no rate: {rate.why_not}"
    a, b = (rate.certain for rate in rates)
    p_value, difference = None, None
    if a is not None and b is not None:
        difference = Interval(b.low - a.high, b.high - a.low)
        if _is_fixed_ahead(one) and _is_fixed_ahead(two):
            from scipy.stats import fisher_exact

            crashes, trials, other, other_trials = counts
            p_value = float(fisher_exact([[crashes, trials - crashes], [other, other_trials - other]]).pvalue)
    return Pair(
        first=str(first.directory),
        second=str(second.directory),
        trials=0,
        only_first=0,
        only_second=0,
        both=0,
        p_value=p_value,
        caution=_caution(first, second),
        test="intervals" if difference is not None else "",
        why_unpaired=why_not,
        counts=counts,
        difference=difference,
        answer=_answer_of(difference),
        per=one.per,
    )


def _is_fixed_ahead(side: _Side) -> bool:
    """Return whether the number of trials did not depend on crashes, so that a single test at the end is valid."""
    settings = side.hunt.settings
    return not (settings.seeds or settings.run.until_rate) and side.rate().estimate is not None


def _paired(one: _Side, two: _Side) -> tuple[PairSequence, PairTest, int, list[TrialPair]]:
    """Return the pairs, their evidence, how many trials training traffic excludes, and the pairs that count."""
    hunts = one.hunt, two.hunt
    records = dict.fromkeys((*one.own_records, *two.own_records))
    held_out = HeldOutTraffics(one.hunt.settings.seed, tuple(records))
    trained_on = 0
    with_arguments = not _same_draws(*hunts)
    sequence = PairSequence((one.rule, two.rule), lambda first, second: first.tags == second.tags)
    test, pairs = PairTest(sequence.rounds), []
    for side in (0, 1):
        for trial in _trials(hunts[side], with_arguments=with_arguments):
            for pair in sequence.add(side, trial):
                if all(held_out.has(int(first.tags[0])) for first, _ in pair):
                    test.add(pair)
                    pairs += [pair] if pair else []
                else:
                    trained_on += len(pair)
    return sequence, test, trained_on, pairs


def _trials(hunt: HuntResults, *, with_arguments: bool) -> Iterator[TrialFacts]:
    """Yield the trials of a hunt, tagged with the properties that the trials of a pair have in common."""
    crash_on = hunt.settings.crash_on
    with closing(Ledger(hunt.directory / layout.LEDGER)) as ledger:
        for data in ledger.plain_results():
            spec = data["spec"]
            tags: tuple[str, ...] = (str(spec["seed"]),)
            if with_arguments:
                tags += (_text_of(spec["scenario_arguments"]),)
            yield facts_of_plain(data, crash_on, tags)


def _text_of(arguments: dict[str, object]) -> str:
    """Return arguments as text that is equal for equal values; 20 equals 20.0."""
    is_whole = {name: isinstance(value, int) and not isinstance(value, bool) for name, value in arguments.items()}
    plain = {name: float(str(value)) if is_whole[name] else value for name, value in arguments.items()}
    return json.dumps(plain, sort_keys=True)


def why_unpaired(one: HuntSettings, other: HuntSettings) -> str:
    """Return as a clause why trials of two hunts with the same number are not pairs; empty if they are pairs."""
    if one.rare and other.rare:
        return "they are in rare mode, in which one of five trials is undisturbed; each hunt itself reports its rate"
    if one.rare != other.rare:
        return "one is in rare mode, in which one of five trials is undisturbed: the same seed is another traffic"
    if one.seeds != other.seeds:
        counts = " and ".join(f"{hunt.seeds} traffics" if hunt.seeds else "one per trial" for hunt in (one, other))
        return f"they have {counts} (--seeds), so that the same number is another traffic"
    if one.seeds and min(one.trials, other.trials) < one.seeds:
        return f"they have fewer trials than the {one.seeds} traffics of --seeds"
    if one.scenario_digest != other.scenario_digest:
        return "they are of two scenarios, in which the same seed is another traffic"
    differing = [
        name
        for name in sorted(one.scenario_arguments.keys() | other.scenario_arguments.keys())
        if one.scenario_arguments.get(name) != other.scenario_arguments.get(name)
    ]
    if one.disturb != other.disturb:
        return f"they have {_disturbances(one)} and {_disturbances(other)}, so that the same seed is another traffic"
    if differing:
        return f"they do not try the same values of {', '.join(differing)}, so that the same seed is another traffic"
    return ""


def _disturbances(settings: HuntSettings) -> str:
    return f"the disturbances {', '.join(settings.disturb)}" if settings.disturb else "no disturbances"


def _same_draws(first: HuntResults, second: HuntResults) -> bool:
    """Return whether trials with the same number and seed certainly have the same scenario arguments."""
    if all(isinstance(spec.distribution, Constant) for spec in first.settings.scenario_arguments.values()):
        return True
    # Independent samplers draw them before any agent's.
    return first.settings.sampler == second.settings.sampler and first.independent and second.independent


def _caution(first: HuntResults, second: HuntResults) -> str:
    one, other = first.settings, second.settings
    if one.max_steps != other.max_steps:
        return f"trials of the one have {one.max_steps} steps to crash in, those of the other {other.max_steps}"
    if one.crash_on != other.crash_on:
        return "they do not count the same outcomes as crashes"
    if one.disturb != other.disturb:
        return f"the one has {_disturbances(one)}, the other {_disturbances(other)}"
    return ""
