"""The crash rate of a hunt's agents, from the files in the hunt's directory.

The module reads the trials of a hunt in the order of their numbers, counts them, and divides the rate into parts. Each
part of a rate has its own interval. All parts together have the requested confidence (Bonferroni, 1936): with 5 parts
at 95 %, each interval has 99 % confidence.

Cost: a ledger is read once for all measures, at about 30,000 trials per second.
"""

from __future__ import annotations

import math
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from crashhunt.base import layout
from crashhunt.base.calls import clear_calls
from crashhunt.base.errors import BundleError, HuntDirectoryError, UsageError
from crashhunt.base.text import one_of
from crashhunt.crashes import fault_of, signature_of
from crashhunt.ledger import Ledger
from crashhunt.results import HuntResults
from crashhunt.statistics._counted_trials import PERS, RateCounter, UnitSequence, facts_of_plain
from crashhunt.statistics._rate_of_running_hunt import WHY_NOT_UNTIL_RATE, counting_rule, why_no_interval
from crashhunt.statistics._rate_report import RatePart, check_confidence, make_rate
from crashhunt.training import held_out_traffics
from crashhunt.trial import Choice, Range

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from crashhunt.base.codec import JsonObject
    from crashhunt.ledger import Facts
    from crashhunt.plans import HuntSettings
    from crashhunt.statistics._anytime_interval import Interval
    from crashhunt.statistics._counted_trials import CountingRule, Per, TrialFacts, Unit
    from crashhunt.statistics._rate_report import CrashRate
    from crashhunt.training import HeldOutTraffics
    from crashhunt.trial import Distribution, Value

_DEFAULT_BINS = 4
_MAX_BINS = 50
_LABEL_DIGITS, _MAX_DIGITS = 4, 17  # of the ends of a bin: as few as tell all bins apart
_CRASH_PROPERTIES = ("kind", "fault", "disturbance")
_UNDISTURBED, _DISTURBED, _UNKNOWN = "undisturbed", "disturbed", "not known"


@clear_calls()
def measure_rates(
    directory: Path | str,
    *,
    per: Per | None = None,
    confidence: float = 95.0,
    by: str = "",
    bar: float | None = None,
    held_out: HeldOutTraffics | None = None,
) -> tuple[CrashRate, ...]:
    """Return the crash rate of a hunt's agents: per trial, per hour and per 1,000 km.

    Args:
        directory: directory of the hunt.
        per: the only rate to return: ``trial``, ``hour`` or ``1000km``.
        confidence: confidence, in percent, of the certain intervals, which are valid after any number of trials.
        by: the property that divides the rate into parts: ``kind``, ``fault``, ``disturbance`` or an argument,
            optionally with a number of bins as in ``speed:5``.
        bar: threshold with which the rate is compared; needs `per`.
        held_out: rule for the traffic that counts, if the hunt is compared with others; None for all traffic on which
            the hunt's own agents were not trained.

    Raises:
        UsageError: a value is not allowed.
        HuntDirectoryError: the directory contains no hunt, or its ledger or a training record is damaged.
        BundleError: a snapshot is damaged.
    """
    check_confidence(confidence)
    hunt = HuntResults(directory)
    if hunt.state.damaged:
        raise HuntDirectoryError(hunt.state.detail)
    settings = hunt.settings
    held_out = held_out_traffics(settings, [hunt.directory]) if held_out is None else held_out
    with closing(Ledger(hunt.directory / layout.LEDGER)) as ledger:
        facts = ledger.facts()
        rule = counting_rule(settings, facts, held_out)
        divide = _division(by, hunt, settings, facts)
        sequence = UnitSequence(rule)
        units: list[Unit] = []
        for data in _until_decision(ledger.plain_results(), facts):
            units += sequence.add(facts_of_plain(data, settings.crash_on, (divide.tag(data),)))
    against = why_no_interval(settings, facts)
    open_end = _why_no_estimate(settings, facts, sequence)
    found = []
    for each in PERS if per is None else (per,):
        counter = RateCounter(rule, each)
        for unit in units:
            counter.add(unit)
        parts = () if against else _parts(units, rule, each, divide, confidence, estimate=not open_end)
        rate = make_rate(
            str(hunt.directory), each, counter, sequence, confidence=confidence, why_no_interval=against,
            why_no_estimate=open_end, parts=parts, bar=bar,
        )  # fmt: skip
        found.append(rate)
    return tuple(found)


def counts_suffice(settings: HuntSettings, facts: Facts, held_out: HeldOutTraffics) -> bool:
    """Return whether the rate per trial follows from the counts of the first trials, without reading each trial."""
    rule = counting_rule(settings, facts, held_out)
    is_each = not rule.traffics and not rule.plain_origin and rule.is_held_out is None and not rule.first
    return is_each and not facts.get("until_rate")


def rate_of_counts(
    directory: Path | str,
    settings: HuntSettings,
    facts: Facts,
    *,
    valid: int,
    invalid: int,
    crashes: int,
    steps: int,
    excluded: int,
    confidence: float = 95.0,
) -> CrashRate:
    """Return the same rate per trial as `measure_rates`, from counts; only allowed if `counts_suffice`.

    ``excluded`` is the number of trials that ended after the first unfinished trial. All other counts are of trials
    before it; crashes and steps are of the valid trials.
    """
    rule = counting_rule(settings, facts)
    sequence, counter = UnitSequence(rule), RateCounter(rule, "trial")
    sequence.add_counted(valid=valid, invalid=invalid)
    if valid:
        counter.add_counted(trials=valid, crashes=crashes, steps=steps)
    found = make_rate(
        str(directory), "trial", counter, sequence, confidence=confidence,
        why_no_interval=why_no_interval(settings, facts), why_no_estimate=_why_no_estimate(settings, facts, sequence),
    )  # fmt: skip
    return replace(found, excluded=found.excluded | ({"after_unfinished": excluded} if excluded else {}))


def rate_of_trials(
    directory: Path | str,
    settings: HuntSettings,
    facts: Facts,
    trials: Iterable[JsonObject],
    held_out: HeldOutTraffics,
) -> CrashRate:
    """Return the same rate per trial as `measure_rates`, without parts, from trials that the caller reads.

    The trials are in the order of their numbers.
    """
    rule = counting_rule(settings, facts, held_out)
    sequence, counter = UnitSequence(rule), RateCounter(rule, "trial")
    for data in _until_decision(trials, facts):
        for unit in sequence.add(facts_of_plain(data, settings.crash_on)):
            counter.add(unit)
    return make_rate(
        str(directory), "trial", counter, sequence,
        why_no_interval=why_no_interval(settings, facts), why_no_estimate=_why_no_estimate(settings, facts, sequence),
    )  # fmt: skip


def _until_decision(trials: Iterable[JsonObject], facts: Facts) -> Iterator[JsonObject]:
    """Return the trials up to the one that decided about the threshold of the hunt; all if none has decided."""
    bar = facts.get("until_rate")
    decided = bar["decided_at"] if bar else None
    return (data for data in trials if decided is None or data["spec"]["number"] <= decided)


def _why_no_estimate(settings: HuntSettings, facts: Facts, sequence: UnitSequence) -> str:
    """Return why crashes divided by exposure would be biased; empty if the number of units is independent of them."""
    run = settings.run
    if run.until_rate:
        return WHY_NOT_UNTIL_RATE
    if not run.keep_going:
        return "the hunt stops at its first crash, so crashes by trials would be too high; run with --keep-going"
    if run.distinct:
        return f"the hunt stops at {run.distinct} crash types, so crashes by trials would be too high"
    if not settings.trials:
        return "the number of trials was not fixed ahead"
    if facts.get("replanned"):
        return (
            "TRIALS was changed after results were known, so crashes by trials may be too high or too low; run a new "
            "hunt and keep its TRIALS"
        )
    units = settings.seeds or settings.trials
    if sequence.position < units:
        what = "traffics" if settings.seeds else "trials"
        return f"{sequence.position} of {units} {what} have ended"
    return ""


# What divides a rate into parts.


@dataclass(frozen=True, slots=True)
class _Division:
    """A division of a rate into parts."""

    by: str  # the dividing property, as text
    # function that returns the name of the part to which a trial or its crash belongs, from the ledger's JSON data
    tag: Callable[[JsonObject], str]
    of_crashes: bool  # whether crashes are divided instead of trials
    names: tuple[str, ...] = ()  # names of the parts; empty if the crashes determine the parts


def _division(by: str, hunt: HuntResults, settings: HuntSettings, facts: Facts) -> _Division:
    if not by:
        if not settings.disturb:
            return _Division("", lambda _: "", of_crashes=True)
        names = (_UNDISTURBED, _DISTURBED)
        return _Division(
            "disturbance", lambda data: names[bool(data.get("disturbances"))], of_crashes=True, names=names
        )
    if by == "disturbance":
        return _Division(by, _first_disturbance, of_crashes=True)
    if by in ("kind", "fault"):
        known = _of_bundles(hunt, facts, by)
        return _Division(by, lambda data: known.get(data["spec"]["number"], _UNKNOWN), of_crashes=True)
    return _by_argument(by, settings)


def _first_disturbance(data: JsonObject) -> str:
    found = data.get("disturbances") or ()
    return str(found[0]["what"]) if found else _UNDISTURBED


def crash_types(directory: Path) -> dict[int, str]:
    """Return the type of each crash of a hunt, by the number of the trial."""
    with closing(Ledger(directory / layout.LEDGER)) as ledger:
        return _of_bundles(HuntResults(directory), ledger.facts(), "kind")


def _of_bundles(hunt: HuntResults, facts: Facts, by: str) -> dict[int, str]:
    """Return the type or the fault of each crash, by the number of the trial."""
    found: dict[int, str] = {}
    for words, numbers in (facts.get("dropped") or {}).items() if by == "kind" else ():
        found |= dict.fromkeys(numbers, words)
    for bundle in hunt.crashes:
        try:
            recording = bundle.recording() if bundle.result.collision is not None else None
            name = str(signature_of(bundle, recording)) if by == "kind" else fault_of(bundle, recording).verdict
        except BundleError:
            continue
        found[bundle.result.spec.number] = name
    return found


def _by_argument(by: str, settings: HuntSettings) -> _Division:
    """Return the division by bins of an argument; the argument's distribution fixes the bins in advance.

    Raises:
        UsageError: the argument does not exist, or the number of bins is not allowed.
    """
    space = settings.space
    names = {f"{agent or 'scenario'}.{name}": (agent, name) for agent, name in space}
    short = {name: key for key, (_, name) in names.items() if sum(name == other for _, other in space) == 1}
    word, colon, count = by.partition(":")
    if word in _CRASH_PROPERTIES:
        raise UsageError(f"--by {by}: {word} cannot be divided into bins", fix=f"give --by {word}")
    key = word if word in names else short.get(word, "")
    if not key:
        raise UsageError(f"--by: there is no argument {word!r}", fix=one_of(word, [*_CRASH_PROPERTIES, *short, *names]))
    if colon and not (count.isdecimal() and 1 <= int(count) <= _MAX_BINS):
        raise UsageError(
            f"--by {by}: {count!r} is not a number of bins",
            fix=f"give 1 to {_MAX_BINS} bins, such as {word}:{_DEFAULT_BINS}",
        )
    agent, name = names[key]
    distribution = space[agent, name]
    labels, place = _bins(distribution, int(count) if colon else _DEFAULT_BINS)

    def tag(data: JsonObject) -> str:
        spec = data["spec"]
        given: Mapping[str, object] = spec.get("arguments", {}).get(agent, {}) if agent else spec["scenario_arguments"]
        return labels[place(given.get(name))]

    return _Division(name, tag, of_crashes=False, names=labels)


def _bins(distribution: Distribution, count: int) -> tuple[tuple[str, ...], Callable[[object], int]]:
    """Return the labels of bins of equal probability, and a function that finds the bin of a value."""
    if not isinstance(distribution, Range) or _few_values(distribution, count) or distribution.low == distribution.high:
        options = distribution.options if isinstance(distribution, Choice) else distribution.grid(count)
        labels = tuple(str(option) for option in options)
        return labels, lambda value: options.index(value)

    def place(value: Any) -> int:
        return min(int(distribution.share_of(value) * count), count - 1)

    if _is_stepped(distribution):
        return _labels(_ends_of_steps(distribution, count, place)), place
    edges = [distribution.quantile(part / count) for part in range(count + 1)]
    return _labels([*pairwise(edges)]), place


def _ends_of_steps(distribution: Range, count: int, place: Callable[[Value], int]) -> list[tuple[Value, Value]]:
    """Return the first and the last value of each bin of a distribution with separate values."""

    def value_at(index: int) -> Value:
        return distribution.quantile((index + 0.5) / distribution.steps)

    firsts = [0]
    for part in range(1, count):
        first = math.ceil(part * distribution.steps / count - 0.5)
        firsts.append(first if place(value_at(first)) == part else first + 1)  # a share at an edge may be rounded down
    return [(value_at(first), value_at(after - 1)) for first, after in pairwise([*firsts, distribution.steps])]


def _labels(ends: Sequence[tuple[Value, Value]]) -> tuple[str, ...]:
    """Return a different text for each bin, given the ends of the bins."""
    labels: list[str] = []
    for digits in range(_LABEL_DIGITS, _MAX_DIGITS + 1):
        texts = [[str(end) if isinstance(end, int) else f"{end:.{digits}g}" for end in both] for both in ends]
        labels = [low if low == high else f"{low} to {high}" for low, high in texts]
        is_exact = all((low == high) == (first == last) for (low, high), (first, last) in zip(texts, ends, strict=True))
        if is_exact and len(set(labels)) == len(labels):
            break
    return tuple(labels)


def _few_values(distribution: Range, count: int) -> bool:
    return _is_stepped(distribution) and distribution.steps <= count


def _is_stepped(distribution: Range) -> bool:
    return distribution.step is not None or (distribution.integer and not distribution.log)


def _parts(
    units: Sequence[Unit], rule: CountingRule, per: Per, divide: _Division, confidence: float, *, estimate: bool
) -> tuple[RatePart, ...]:
    names = divide.names or tuple(
        sorted({trial.tags[0] for unit in units for trial in unit if trial.crashed and trial.tags[0]})
    )
    if not divide.by or not names:
        return ()
    alpha = (1 - confidence / 100) / len(names)
    found = []
    for name in names:
        counter = RateCounter(rule, per, **{"matches" if divide.of_crashes else "within": _belongs_to(name)})
        for unit in units:
            counter.add(unit)
        certain: Interval | None = counter.interval(alpha)
        observed = counter.observed if estimate else None
        found.append(
            RatePart(
                by=divide.by, name=name, trials=counter.trials, crashes=counter.crashes, estimate=observed,
                certain=certain,
            )
        )  # fmt: skip
    if divide.of_crashes:
        found.sort(key=lambda part: -part.crashes)
    return tuple(found)


def _belongs_to(name: str) -> Callable[[TrialFacts], bool]:
    return lambda trial: trial.tags[0] == name
