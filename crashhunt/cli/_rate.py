"""``crashhunt rate``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.errors import UsageError
from crashhunt.base.text import command_line
from crashhunt.cli._common import (
    DONE,
    NO_ANSWER,
    THE_ANSWER_IS_NO,
    CommandOptions,
    Commands,
    GivenOnce,
    add_json,
    number,
)
from crashhunt.plans import RATE_PERS

if TYPE_CHECKING:
    from collections.abc import Iterable

    from crashhunt.statistics import Per


def add_rate(commands: Commands) -> None:
    """Add the command ``rate`` to the parser."""
    rate = commands.add_parser(
        "rate",
        help="report how often an agent crashes, with a guarantee",
        description="Report how often an agent crashes in the traffic of a hunt: per trial, per hour and per 1,000 km. "
        "Each rate has an interval that is valid whenever you look, also for a hunt that is running, was killed, or "
        "stopped at its first crash.",
    )
    rate.add_argument("directories", metavar="DIR", type=Path, nargs="+", help="directories of hunts or suites")
    rate.add_argument(
        "--per",
        metavar="UNIT",
        choices=RATE_PERS,
        help="the unit of the rate: trial, hour or 1000km; default: all three units, or the unit of --bar",
    )
    rate.add_argument(
        "--confidence",
        metavar="PERCENT",
        type=number,
        default=95.0,
        help="confidence of the intervals, in percent; default: 95",
    )
    rate.add_argument(
        "--by", metavar="PART", action=GivenOnce, default="",
        help="report a rate for each group. The words kind, fault and disturbance group the crashes; ARG or ARG:BINS "
        "groups the trials by the value of the argument ARG, in BINS bins (default: 4)",
    )  # fmt: skip
    rate.add_argument(
        "--bar", metavar="RATE", default="",
        help="compare the crash rate with this rate, such as 1e-3/trial, 2/hour or 5/1000km: exit with 0 if the crash "
        "rate is certainly below, 1 if it is certainly above, 3 if undecided",
    )  # fmt: skip
    rate.add_argument("--csv", action="store_true", help="print the table as CSV, with a line for each rate")
    rate.add_argument("--html", metavar="FILE", type=Path, help="write an HTML page with the rates")
    add_json(rate)
    rate.set_defaults(command=_rate)


def _rate(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.plans import check_rate, rate_of
    from crashhunt.report import describe_rates, rates_page, write_rates_csv
    from crashhunt.results import find_searches
    from crashhunt.statistics import measure_rates

    per: Per | None = options.per
    bar = None
    if options.bar:
        if fix := check_rate(options.bar):
            raise UsageError(f"--bar is {options.bar}", fix=fix)
        bar, unit = rate_of(options.bar)
        if per not in (None, unit):
            raise UsageError(f"--per {per} contradicts --bar {options.bar}", fix=f"give --per {unit}, or no --per")
        per = unit
    per = per or ("trial" if options.by else None)
    hunts = dict.fromkeys(hunt for directory in options.directories for hunt in find_searches(directory))
    rates = [
        rate
        for hunt in hunts
        for rate in measure_rates(hunt, per=per, confidence=options.confidence, by=options.by, bar=bar)
    ]
    if options.csv:
        write_rates_csv(rates, sys.stdout)
    else:
        options.say(describe_rates(rates))
    if options.html is not None:
        rates_page(rates, options.html)
        options.say(f"{command_line(options.html)} has the page", to_stderr=options.csv)
    options.print_json({"rates": [rate.to_json() for rate in rates]})
    return DONE if bar is None else exit_code_of(rate.verdict for rate in rates)


def exit_code_of(verdicts: Iterable[str]) -> int:
    """Return 1 if a rate is above its threshold, else 3 if a rate is undecided, else 0."""
    found = set(verdicts)
    if "above" in found:
        return THE_ANSWER_IS_NO
    return NO_ANSWER if found != {"below"} else DONE
