"""Crash rates as lines for the terminal, as CSV with a line for each rate, and as an HTML page."""

from __future__ import annotations

import csv
import html
import math
from itertools import groupby
from typing import TYPE_CHECKING, TextIO

from crashhunt.base.files import output_file
from crashhunt.base.text import count_of, format_number, in_lines
from crashhunt.statistics import PER_WORDS, Interval

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from crashhunt.ledger import RateBounds, RunningRate
    from crashhunt.statistics import CrashRate, RatePart

_TRAINED_ON = "trained_on"
_MAX_DIGITS = 9  # of a rate next to a bar
_REASONS = {
    "invalid": "invalid",
    "not_random": "not drawn at random",
    "after_unfinished": "after a trial that has not ended",
    "other_code": "of earlier code, or begun when the code changed",
}
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 60rem; padding: 0 1rem; }
table { border-collapse: collapse; width: 100%; }
th, td { text-align: left; padding: .4rem .7rem; border: 1px solid #ccc; }
.wide { overflow-x: auto; } .faint { color: #5d6b7d; }
@media (prefers-color-scheme: dark) { body { color: #e6ebf2; background: #131a23; } th, td { border-color: #38465a; } }
"""


def count_training_trials(count: int) -> str:
    """Return text on the trials that are not counted because an agent was trained on their traffic."""
    return f"{count_of(count, 'trial')} on training traffic {'is' if count == 1 else 'are'} excluded"


def format_interval(interval: Interval) -> str:
    """Return an interval as text, such as ``at least 0.19, at most 0.52``."""
    least = f"at least {format_number(interval.low)}, " if interval.low > 0 else ""
    return f"{least}at most {format_number(interval.high)}"


def describe_running(rate: RunningRate) -> str:
    """Return the rate of a running hunt as one line: the answer, then the evidence."""
    if rate["method"] == "rare":
        return _describe_rare(rate)
    bar = (
        f"; bar {format_number(rate['bar'])} {PER_WORDS[rate['per']]}: {rate['verdict']}"
        if rate["bar"] is not None
        else ""
    )
    if rate["certain"] is None:
        return f"crash rate: not known yet ({rate['why_not']}){bar}"
    kind = "random trial" if rate["origin"] else "trial"
    trials = f"{count_of(rate['crashes'], 'crash')} in {count_of(rate['trials'], kind)}"
    if trained_on := rate.get("trained_on"):
        bar += f"; {count_training_trials(trained_on)}"
    return f"crash rate: {_certain(rate['certain'])} {PER_WORDS[rate['per']]} ({trials}, {rate['confidence']:g} %){bar}"


def _describe_rare(rate: RunningRate) -> str:
    roots = count_of(rate["units"], "root")
    certain = f"; certain: {_certain(rate['certain'])} ({rate['confidence']:g} %)" if rate["certain"] else ""
    if rate["estimate"] is None:
        return f"crash rate: not known yet ({rate['why_not']}){certain}"
    if not rate["estimate"]:
        return f"crash rate: no crash yet in {roots} and their copies{certain}"
    found = f"crash rate: {format_number(rate['estimate'])} per trial"
    if (one := rate["estimated"]) is not None and one["high"] is not None:
        found += f" ({format_number(one['low'])} to {format_number(one['high'])}, estimated from {roots})"
    else:
        found += f" (no interval from {roots} yet)"
    return found + certain


def _certain(bounds: RateBounds) -> str:
    return format_interval(Interval(bounds["low"], math.inf if bounds["high"] is None else bounds["high"]))


def describe_rates(rates: Sequence[CrashRate]) -> str:
    """Return rates as text: the answer first, then the evidence."""
    lines: list[str] = []
    for _, group in groupby(rates, key=lambda rate: rate.dir):
        lines += _of_hunt(list(group))
    return in_lines(lines)


def _of_hunt(rates: list[CrashRate]) -> list[str]:
    first = rates[0]
    head = f"{first.dir}: {count_of(first.crashes, 'crash')} in {count_of(first.trials, 'trial')}"
    if first.units != first.trials:
        head += f" of {count_of(first.units, 'traffic')}"
    confidence = f"({first.confidence:g} %, valid whenever you look)"
    known = [rate for rate in rates if rate.certain is not None]
    lines: list[str]
    if known and not first.crashes:
        highest = [(rate.certain.high, PER_WORDS[rate.per]) for rate in known if rate.certain is not None]
        each = [f"{format_number(high)} {per}" for high, per in highest]
        lines = [f"{head}: at most {', '.join(each)} {confidence}"]
    elif known:
        lines = [f"{head} {confidence}", *(f"  {PER_WORDS[rate.per]}: {_answer(rate)}" for rate in known)]
    else:
        lines = [head]
    for why in dict.fromkeys(rate.why_not for rate in rates if rate.why_not):
        concerned = [rate for rate in rates if rate.why_not == why]
        missing = "no rate" if concerned[0].certain is None else "no estimate"
        which = "" if len(concerned) == len(rates) else f" {' and '.join(PER_WORDS[rate.per] for rate in concerned)}"
        lines.append(f"  {missing}{which}: {why}")
    if trained_on := first.excluded.get(_TRAINED_ON):
        lines.append(f"  {count_training_trials(trained_on)}")
    each = [f"{count} {_REASONS[reason]}" for reason, count in first.excluded.items() if reason != _TRAINED_ON]
    if each:
        lines.append(f"  not counted: {', '.join(each)}")
    lines += [line for rate in rates for line in _part_lines(rate)]
    lines += [f"  {_verdict(rate, rate.bar)}" for rate in rates if rate.bar is not None]
    return lines


def _verdict(rate: CrashRate, bar: float) -> str:
    exact = (format_number(bar, digits) for digits in range(3, _MAX_DIGITS))
    text = next((text for text in exact if float(text.replace(",", "")) == bar), f"{bar:g}")
    shown = f"the bar of {text} {PER_WORDS[rate.per]}"
    if rate.verdict != "undecided":
        if rate.certain is None:
            return f"certainly {rate.verdict} {shown}"
        end, words = (rate.certain.high, "at most") if rate.verdict == "below" else (rate.certain.low, "at least")
        return f"certainly {rate.verdict} {shown}: {words} {_format_distinct(end, bar)}"
    if rate.why_undecided:
        return f"undecided about {shown}: {rate.why_undecided}"
    if rate.certain is None:
        return f"undecided about {shown}: there is no rate"
    low, high = (_format_distinct(end, bar) for end in rate.certain)
    return f"undecided, because the rate may be {low} to {high}: more trials are needed to compare with {shown}"


def _format_distinct(rate: float, bar: float) -> str:
    """Return a rate with enough digits to show on which side of a bar it lies.

    >>> _format_distinct(0.0099996, 0.01)
    '0.0099996'
    >>> _format_distinct(0.012, 0.01)
    '0.012'
    """
    for digits in range(3, _MAX_DIGITS):
        text = format_number(rate, digits)
        if not math.isfinite(rate) or (float(text.replace(",", "")) - bar) * (rate - bar) > 0:
            return text
    return format_number(rate)


def _answer(rate: CrashRate | RatePart) -> str:
    if rate.certain is None:
        return "not known"
    estimate = "" if rate.estimate is None else f"{format_number(rate.estimate)}, "
    return f"{estimate}{format_interval(rate.certain)}"


def _part_lines(rate: CrashRate) -> list[str]:
    if not rate.parts:
        return []
    parts = len(rate.parts)
    together = f"{rate.confidence:g} % for all {parts} intervals together" if parts > 1 else f"{rate.confidence:g} %"
    return [
        f"  {PER_WORDS[rate.per]}, by {rate.parts[0].by} ({together}):",
        *(f"    {part.name}: {part.crashes} of {part.trials:,} trials, {_answer(part)}" for part in rate.parts),
    ]


_COLUMNS = (
    "dir", "per", "by", "part", "units", "trials", "crashes", "hours", "km", "estimate", "low", "high", "confidence",
    "bar", "verdict", "why_not", "trained_on",
)  # fmt: skip


def write_rates_csv(rates: Sequence[CrashRate], out: TextIO) -> None:
    """Write one CSV line for each rate, and one for each part of the trials."""
    writer = csv.DictWriter(out, _COLUMNS, restval="")
    writer.writeheader()
    for rate in rates:
        data = rate.to_json()
        data |= {"hours": data["exposure"]["hours"], "km": data["exposure"]["km"], "trials": rate.trials}
        data[_TRAINED_ON] = rate.excluded.get(_TRAINED_ON)
        writer.writerow(_cells(data, rate.certain))
        for part in rate.parts:
            named = {"dir": rate.dir, "per": rate.per, "part": part.name, "confidence": rate.confidence}
            writer.writerow(_cells({**part.to_json(), **named}, part.certain))


def _cells(data: dict[str, object], certain: Interval | None) -> dict[str, object]:
    low, high = ("", "") if certain is None else certain
    found = {**data, "low": low, "high": high if high != math.inf else ""}
    return {name: "" if found.get(name) is None else found[name] for name in _COLUMNS}


def rates_page(rates: Sequence[CrashRate], path: Path) -> None:
    """Write an HTML page that works without a network: the rates of all hunts in a table.

    Raises:
        HuntDirectoryError: the page cannot be written.
    """
    rows = []
    for rate in rates:
        exposure = f"{rate.trials:,} trials, {rate.driven_s / 3600:,.2f} h, {rate.driven_m / 1000:,.1f} km"
        trained_on = rate.excluded.get(_TRAINED_ON)
        remarks = filter(None, (rate.why_not, count_training_trials(trained_on) if trained_on else ""))
        rows.append((rate.dir, PER_WORDS[rate.per], str(rate.crashes), exposure, *_numbers(rate), "; ".join(remarks)))
        for part in rate.parts:
            name = f"{part.by} {part.name}" if part.by != part.name else part.name
            rows.append((rate.dir, f"{PER_WORDS[rate.per]}, {name}", str(part.crashes), f"{part.trials:,} trials",
                         *_numbers(part), ""))  # fmt: skip
    header = ("hunt", "rate", "crashes", "in", "estimate", "at least", "at most", "remarks")
    head = "".join(f"<th>{name}</th>" for name in header)
    body = "".join(f"<tr>{''.join(f'<td>{html.escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    confidence = f"{rates[0].confidence:g}" if rates else "95"
    page = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1"><title>Crash rates</title>'
        f"<style>{_STYLE}</style></head><body><h1>Crash rates</h1>"
        f'<p class="faint">At least and at most: {confidence} % confidence, valid whenever you look.</p>'
        f'<div class="wide"><table><tr>{head}</tr>{body}</table></div></body></html>\n'
    )
    with output_file(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _numbers(rate: CrashRate | RatePart) -> tuple[str, str, str]:
    estimate = "" if rate.estimate is None else format_number(rate.estimate)
    if rate.certain is None:
        return estimate, "", ""
    return estimate, format_number(rate.certain.low), format_number(rate.certain.high)
