"""Several hunts side by side: a table for the terminal, and an HTML page with plots."""

from __future__ import annotations

import html
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.base.files import output_file
from crashhunt.base.text import aligned, count_of, format_number, in_lines
from crashhunt.report._argument_words import argument_units
from crashhunt.report._rate_text import count_training_trials
from crashhunt.results import FACTS, HuntResults, columns_of
from crashhunt.statistics import PER_WORDS, held_out_by_seed
from crashhunt.trial import Outcome, in_order

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from crashhunt.results import Cell
    from crashhunt.statistics import Comparison, HuntFigures
    from crashhunt.training import HeldOutTraffics

_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#5a5a5a")
_MAX_BINS = 10  # more, and most hunts have too few crashes a bin
_STYLE = """
:root { color-scheme: light dark; --ink: #1b2430; --faint: #5d6b7d; --line: #d9dfe7; --paper: #fff; --back: #f6f7f9; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6ebf2; --faint: #9aa8ba; --line: #38465a; --paper: #1d2632; --back: #131a23; } }
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 68rem; padding: 0 1rem;
  color: var(--ink); background: var(--back); }
table { border-collapse: collapse; width: 100%; background: var(--paper); }
th, td { text-align: left; padding: .4rem .7rem; border: 1px solid var(--line); overflow-wrap: anywhere; }
.wide { overflow-x: auto; }
.rates { display: grid; gap: .9rem; } .rate { position: relative; height: 1.2rem; margin-top: .15rem; }
.rate > * { position: absolute; top: 0; height: 100%; }
.interval { height: 0; top: 50%; border-top: 2px solid var(--ink); }
.interval::before, .interval::after { content: ""; position: absolute; top: -7px; height: 12px; width: 2px;
  background: var(--ink); } .interval::after { right: 0; }
.faint { color: var(--faint); } h1, p, figcaption, .name { overflow-wrap: anywhere; }
svg { display: block; max-width: 100%; height: auto; }
.plots { display: flex; flex-wrap: wrap; gap: 1rem; }
figure { margin: 0; padding: .7rem; background: var(--paper); border: 1px solid var(--line); border-radius: 6px; }
figcaption { font-weight: 600; } svg text { font-size: 11px; fill: var(--faint); }
.key { display: inline-block; width: .8em; height: .8em; border-radius: 2px; margin-right: .4em; }
svg .axis { stroke: var(--line); fill: none; }
"""


def describe_comparison(found: Comparison) -> str:
    """Return a comparison of hunts as text."""
    header = (
        "hunt",
        "trials",
        "crashes",
        f"crash rate {PER_WORDS[found.per]}",
        "95 % interval",
        "median step",
        "median TTC",
    )
    rows = [
        (
            hunt.dir,
            str(hunt.trials),
            f"{hunt.crashes} ({hunt.disturbed} disturbed)" if hunt.disturbed is not None else str(hunt.crashes),
            format_number(hunt.crash_rate) if np.isfinite(hunt.crash_rate) else "-",
            f"{format_number(hunt.interval[0])} to {format_number(hunt.interval[1])}" if hunt.interval else "-",
            f"{hunt.median_steps_to_crash:g}" if np.isfinite(hunt.median_steps_to_crash) else "-",
            f"{hunt.median_time_to_collision_s:.2f} s" if np.isfinite(hunt.median_time_to_collision_s) else "-",
        )
        for hunt in found.hunts
    ]
    lines = aligned([header, *rows], left=range(1))
    lines += [
        f"{hunt.dir}: only trials of origin {hunt.counted} count, because the search guided all others"
        for hunt in found.hunts
        if hunt.counted
    ]
    for hunt in found.hunts:
        if hunt.why_not:
            missing = "no interval" if np.isfinite(hunt.crash_rate) else "no crash rate"
            lines.append(f"{hunt.dir}: {missing}: {hunt.why_not}")
        if trained_on := hunt.exclusions.get("trained_on"):
            lines.append(f"{hunt.dir}: {count_training_trials(trained_on)}")
        if other_code := hunt.exclusions.get("other_code"):
            lines.append(f"{hunt.dir}: only the newest code counts: {other_code} trials of earlier code are excluded")
        if hunt.excluded:
            lines.append(f"{hunt.dir}: not counted: {count_of(hunt.excluded, 'trial')} after one that has not ended")
    for pair in found.pairs:
        lines += ["", pair.verdict]
        if pair.caution:
            lines.append(f"  but {pair.caution}")
    return in_lines(lines)


def comparison_page(found: Comparison, path: Path) -> None:
    """Write an HTML page that works without a network: crash rates with intervals, outcomes, and plots per argument.

    Raises:
        HuntDirectoryError: the page cannot be written.
    """
    colors = {hunt.dir: _COLORS[place % len(_COLORS)] for place, hunt in enumerate(found.hunts)}
    answers = "".join(
        f"<p>{html.escape(pair.verdict)}{f'; but {html.escape(pair.caution)}' if pair.caution else ''}</p>"
        for pair in found.pairs
    )
    keys = "".join(
        f'<span><span class="key" style="background:{color}"></span>{html.escape(name)}&emsp;</span>'
        for name, color in colors.items()
    )
    plots = "".join(_argument_plots(found.hunts, colors))
    page = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1"><title>Comparison</title>'
        f"<style>{_STYLE}</style></head><body><h1>Comparison</h1>{answers}<p>{keys}</p>"
        f'<h2>Crash rate</h2><figure class="rates">{_rates(found.hunts, colors)}</figure>'
        f'<h2>Outcomes</h2><div class="wide">{_outcomes(found.hunts)}</div>'
        f'<h2>Crash rate against each argument</h2><div class="plots">{plots}</div></body></html>\n'
    )
    with output_file(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _rates(hunts: Sequence[HuntFigures], colors: dict[str, str]) -> str:
    """Return a bar with its interval for each hunt as HTML; lengths are in percent of the width of the page."""
    ends = [hunt.interval[1] if hunt.interval else _drawn_rate(hunt) for hunt in hunts]
    most = max([end for end in ends if np.isfinite(end)] or [1.0])
    scale, parts = 100 / max(most, 1e-9), []
    for hunt in hunts:
        rate = _drawn_rate(hunt)
        share = f"{format_number(rate)} {PER_WORDS[hunt.per]} ({hunt.crashes} of {hunt.trials})"
        said = share if np.isfinite(hunt.crash_rate) else f"{hunt.crashes} of {hunt.trials}"
        if hunt.disturbed is not None:
            said += f", {hunt.disturbed} of them disturbed"
        if trained_on := hunt.exclusions.get("trained_on"):
            said += f", {count_training_trials(trained_on)}"
        if other_code := hunt.exclusions.get("other_code"):
            said += f", without {other_code} trials of earlier code"
        bar = f'<span style="left:0;width:{rate * scale:.2f}%;background:{colors[hunt.dir]}"></span>'
        if hunt.counted:
            said += f", only trials of origin {html.escape(hunt.counted)} count, because the search guided all others"
        if hunt.interval:
            low, high = hunt.interval
            said += f", 95 % interval {format_number(low)} to {format_number(high)}"
            high = min(high, most)
            bar += f'<span class="interval" style="left:{low * scale:.2f}%;width:{(high - low) * scale:.2f}%"></span>'
        name = f'<span class="name">{html.escape(hunt.dir)}</span>'
        parts.append(f'<div>{name} <span class="faint">{said}</span><div class="rate">{bar}</div></div>')
    return "".join(parts)


def _drawn_rate(hunt: HuntFigures) -> float:
    """Return the crash rate that a hunt's bar shows; 0 if the hunt has no rate."""
    return hunt.crash_rate if np.isfinite(hunt.crash_rate) else 0.0


def _outcomes(hunts: Sequence[HuntFigures]) -> str:
    kinds = [str(kind) for kind in in_order(kind for hunt in hunts for kind, count in hunt.outcomes.items() if count)]
    head = "".join(f"<th>{kind}</th>" for kind in kinds)
    rows = "".join(
        f"<tr><th>{html.escape(hunt.dir)}</th>{''.join(f'<td>{hunt.outcomes.get(k, 0)}</td>' for k in kinds)}</tr>"
        for hunt in hunts
    )
    return f"<table><tr><th>hunt</th>{head}</tr>{rows}</table>"


def _argument_plots(hunts: Sequence[HuntFigures], colors: dict[str, str]) -> list[str]:
    values: dict[str, dict[str, tuple[NDArray[np.generic], NDArray[np.generic]]]] = {}
    units: dict[str, str] = {}
    compared = [HuntResults(hunt.dir) for hunt in hunts]
    held_out = held_out_by_seed(compared)
    for hunt, results in zip(hunts, compared, strict=True):
        for name, pair in _arguments(results, held_out[results.settings.seed]).items():
            values.setdefault(name, {})[hunt.dir] = pair
        for (agent, name), unit in argument_units(Path(hunt.dir), results.settings).items():
            units[f"{agent or 'scenario'}.{name}"] = unit
    labels = {name: name.partition(".")[2] + (f" ({units[name]})" if name in units else "") for name in values}
    return [_argument_plot(name, labels[name], of, colors) for name, of in values.items()]


def _arguments(
    hunt: HuntResults, held_out: HeldOutTraffics
) -> dict[str, tuple[NDArray[np.generic], NDArray[np.generic]]]:
    """Return the values of every argument that varies, and whether the trial with each value crashed."""
    names = [name for name in columns_of(hunt.settings) if name not in FACTS]
    columns: dict[str, list[Cell]] = {name: [] for name in names}
    crashed: list[bool] = []
    crash_on = hunt.settings.crash_on
    for row in hunt.rows():
        if not held_out.has(int(str(row["seed"]))) or int(str(row["number"])) < hunt.code_versions.first:
            continue
        if row["outcome"] == Outcome.INVALID or (hunt.plain_origin and row["origin"] != hunt.plain_origin):
            continue
        crashed.append(row["outcome"] in crash_on)
        for name in names:
            columns[name].append(row[name])
    hit = np.array(crashed, bool)
    return {name: (np.array(found), hit) for name, found in columns.items() if len({str(v) for v in found}) > 1}


def _argument_plot(
    name: str, label: str, of: dict[str, tuple[NDArray[np.generic], NDArray[np.generic]]], colors: dict[str, str]
) -> str:
    numeric = all(np.issubdtype(values.dtype, np.number) for values, _ in of.values())
    lines: dict[str, list[tuple[float, float, int]]] = {}
    if numeric:
        low = min(float(values.min()) for values, _ in of.values())
        high = max(float(values.max()) for values, _ in of.values())
        edges: NDArray[np.float64] = np.linspace(low, high, _MAX_BINS + 1)
        labels = [format_number(low), format_number(high)]
    else:
        words = sorted({str(value) for values, _ in of.values() for value in values})
        labels = words
        edges = np.arange(len(words) + 1, dtype=float) - 0.5
    for hunt, (values, crashed) in of.items():
        numbers = values.astype(float) if numeric else np.array([labels.index(str(value)) for value in values], float)
        bins = np.clip(np.digitize(numbers, edges) - 1, 0, len(edges) - 2)
        lines[hunt] = []
        for place in range(len(edges) - 1):
            inside = bins == place
            if inside.any():
                middle = (place + 0.5) / (len(edges) - 1)
                lines[hunt].append((middle, float(crashed[inside].mean()), int(inside.sum())))
    most = max((rate for line in lines.values() for _, rate, _ in line), default=0.0) or 1.0  # without crashes
    parts = ['<path class="axis" d="M52 8V148H268"/>',
             f'<text x="160" y="180" text-anchor="middle">{html.escape(label)}</text>',
             '<text transform="translate(11 78) rotate(-90)" text-anchor="middle">crash rate per trial</text>',
             f'<text x="48" y="16" text-anchor="end">{format_number(most)}</text>',
             '<text x="48" y="150" text-anchor="end">0</text>']  # fmt: skip
    for place, end in enumerate(labels):
        x = 52 + 216 * (place / (len(labels) - 1) if numeric else (place + 0.5) / len(labels))
        anchor = ("start" if not place else "end") if numeric else "middle"
        parts.append(f'<text x="{x:.0f}" y="163" text-anchor="{anchor}">{html.escape(end)}</text>')
    for hunt, line in lines.items():
        at = [(52 + 216 * x, 148 - 136 * rate / most, count, rate) for x, rate, count in line]
        path = "L".join(f"{x:.1f} {y:.1f}" for x, y, _, _ in at)
        parts.append(f'<path d="M{path}" fill="none" stroke="{colors[hunt]}" stroke-width="2"/>')
        parts += [
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{colors[hunt]}">'
            f"<title>{format_number(rate)} per trial, {count} trials</title></circle>"
            for x, y, count, rate in at
        ]
    return (
        f'<figure><figcaption>{html.escape(name)}</figcaption><svg viewBox="0 0 280 186" width="280" role="img" '
        f'aria-label="crash rate against {html.escape(name)}">{"".join(parts)}</svg></figure>'
    )
