"""The table and the plot of what ``scripts/studies/run search`` has measured, of the hunts that it has stored."""

from __future__ import annotations

import math
import statistics
from html import escape
from typing import TYPE_CHECKING

import numpy as np
from development_problems import DEVELOPMENT
from problems import PROBLEMS, REAL
from unseen_problems import UNSEEN

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from search import Run

GIVE_UP = 3.0  # times what random draws need
_LEFT, _WIDTH, _ROW, _TOP = 190, 860, 24, 92
_LEAST, _MOST = 0.02, 5.0
_MARKS = {
    "guided": ("#1f5fbf", "#7db0ff", "disc"),
    "cross-entropy": ("#b06a00", "#ffc247", "square"),
    "cma-es": ("#b06a00", "#ffc247", "cross"),
    "mutation": ("#00866b", "#4fd3b5", "square"),
    "halton": ("#7d8b9c", "#8593a6", "ring"),
    "sobol": ("#7d8b9c", "#8593a6", "cross"),
    "plain-mutation": ("#00866b", "#4fd3b5", "ring"),
    "optuna-tpe": ("#c62828", "#ff6b6b", "ring"),
    "optuna-cma-es": ("#c62828", "#ff6b6b", "cross"),
    "verifai-ce": ("#8e24aa", "#d78bff", "ring"),
    "verifai-mab": ("#8e24aa", "#d78bff", "cross"),
}
"""Sampler to its colour in the light, in the dark, and its form."""
_RATES = {name: problem.rate for name, problem in PROBLEMS.items()} | {
    name: rate for name, (_, rate, _) in {**DEVELOPMENT, **UNSEEN}.items()
}
"""Crashes per random trial of the problems without a simulator."""
_MISLEADING = ("deceptive",)
"""Problems whose criticality says something, but leads to a place without a crash."""


def _paid(problem: str, runs: Sequence[Run]) -> list[int]:
    return [run.steps if problem in REAL else run.trials for run in runs]


def _needed(problem: str, of_random: Sequence[Run]) -> float:
    """What random draws need: by calculation without a simulator, else as measured."""
    if problem in _RATES:
        return (1.0 - math.exp(-GIVE_UP)) / _RATES[problem]
    return statistics.fmean(_paid(problem, of_random)) if of_random else math.nan


def one_in(problem: str, runs: Sequence[Run]) -> float:
    """Return how many random trials there are to a crash: by calculation without a simulator, else as they ended."""
    if problem in _RATES:
        return 1 / _RATES[problem]
    drawn = [run for run in runs if (run.problem, run.sampler) == (problem, "random")]
    crashes = sum(run.found for run in drawn)
    return sum(run.trials for run in drawn) / crashes if crashes else math.nan


def costs(runs: Sequence[Run]) -> dict[str, dict[str, float]]:
    """Return, by problem and sampler, the mean cost as a share of what random draws need; given up hunts as they are.

    The cost is trials without a simulator, where all take as long, and steps of everything with one.
    """
    found: dict[str, dict[str, float]] = {}
    for problem in (*PROBLEMS, *REAL, *DEVELOPMENT, *UNSEEN):
        of = [run for run in runs if run.problem == problem]
        needed = _needed(problem, [run for run in of if run.sampler == "random"])
        for sampler in dict.fromkeys(run.sampler for run in of):
            paid = _paid(problem, [run for run in of if run.sampler == sampler])
            found.setdefault(problem, {})[sampler] = statistics.fmean(paid) / needed
    return found


def interval(runs: Sequence[Run], problem: str, sampler: str) -> tuple[float, float]:
    """Return an interval of 95 % of a cost, by bootstrap over hunts; of the random ones too, if measured."""
    rng = np.random.default_rng(0)

    def means(name: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        paid = np.array(_paid(problem, [run for run in runs if (run.problem, run.sampler) == (problem, name)]))
        drawn: np.ndarray[tuple[int], np.dtype[np.float64]] = paid[
            rng.integers(len(paid), size=(2000, len(paid)))
        ].mean(1)
        return drawn

    needed = means("random") if problem in REAL else np.full(2000, _needed(problem, ()))
    low, high = np.percentile(means(sampler) / needed, (2.5, 97.5))
    return float(low), float(high)


def rare(found: dict[str, dict[str, float]], sampler: str) -> float:
    """Return the geometric mean over the problems of one in 200 and rarer on which danger says something."""
    names = [name for name, problem in PROBLEMS.items() if problem.hint and problem.rate <= 1 / 200]
    values = [found[name][sampler] for name in names if sampler in found.get(name, {})]
    return statistics.geometric_mean(values) if len(values) == len(names) else math.nan


def table(runs: Sequence[Run]) -> str:
    """Return it as Markdown."""
    found = costs(runs)
    known = ("random", "guided-4", *_MARKS, "smac", "turbo")
    samplers = [name for name in known if any(name in row for row in found.values())]
    samplers.sort(key=lambda name: ["random", "guided"].index(name) if name in ("random", "guided") else 2)
    lines = [f"| problem | one in | {' | '.join(samplers)} |", f"| --- | ---: |{' ---: |' * len(samplers)}"]
    for name, row in found.items():
        cells = [_cell(runs, name, sampler, row) for sampler in samplers]
        lines.append(f"| {name} | {one_in(name, runs):.0f} | {' | '.join(cells)} |")
    means = [rare(found, sampler) for sampler in samplers]
    lines.append(f"| *rare, with a hint* | | {' | '.join('-' if math.isnan(one) else f'{one:.2f}' for one in means)} |")
    return "\n".join(lines)


def pairs_table(runs: Sequence[Run], base: str, other: str) -> str:
    """Return the cost of one sampler as a share of that of another in hunts with the same seeds, as Markdown."""
    rng = np.random.default_rng(0)
    lines = [f"| problem | hunts | {base} | {other} | ratio |", "| --- | ---: | ---: | ---: | --- |"]
    ratios, drawn = [], []
    for problem in dict.fromkeys(run.problem for run in runs):
        costs_of = {
            name: {run.seed: _paid(problem, [run])[0] for run in runs if (run.problem, run.sampler) == (problem, name)}
            for name in (base, other)
        }
        seeds = sorted(costs_of[base].keys() & costs_of[other].keys())
        if len(seeds) < 2:
            continue
        one, two = (np.array([costs_of[name][seed] for seed in seeds], dtype=float) for name in (base, other))
        again = rng.integers(len(seeds), size=(4000, len(seeds)))
        ratios.append(float(two.mean() / one.mean()))
        drawn.append(two[again].mean(1) / one[again].mean(1))
        cells = [problem, f"{len(seeds)}", f"{one.mean():.0f}", f"{two.mean():.0f}", _share(ratios[-1], drawn[-1])]
        lines.append(f"| {' | '.join(cells)} |")
    if ratios:
        whole = np.exp(np.mean(np.log(drawn), axis=0))
        lines.append(f"| *all {len(ratios)}* | | | | {_share(statistics.geometric_mean(ratios), whole)} |")
    return "\n".join(lines)


def delay_table(early: Sequence[Run], late: Sequence[Run], more: int) -> str:
    """Return the cost of hunts with a greater lag, and of the delay alone, as shares of the cost with a smaller lag.

    An imaginary sampler makes as many random draws in addition as results arrive later, and needs as many further
    trials as with the smaller lag. One column counts all of these draws, and the other ends a hunt when a draw crashes.

    Args:
        early: hunts of one sampler with the smaller lag.
        late: its hunts with the greater lag; those with the same problem and seed count.
        more: by how many trials the lag is greater.
    """
    rng = np.random.default_rng(0)
    lines = [
        "| problem | hunts | early | late | ratio | delay alone | delay, draws may crash |",
        "| --- | ---: | ---: | ---: | --- | --- | --- |",
    ]
    of_late = {(run.problem, run.seed): run.trials for run in late}
    found, learnable = [], []
    for problem in dict.fromkeys(run.problem for run in early if run.problem in _RATES):
        pairs = [
            (run.trials, of_late[problem, run.seed])
            for run in sorted(early, key=lambda run: run.seed)
            if run.problem == problem and (problem, run.seed) in of_late
        ]
        if len(pairs) < 2:
            continue
        one, two = np.array(pairs, dtype=float).T
        again = rng.integers(len(pairs), size=(4000, len(pairs)))
        # The first of each is the mean of all hunts, the others are of the bootstrap.
        before, after = (np.append(costs.mean(), costs[again].mean(1)) for costs in (one, two))
        rate = _RATES[problem]
        survive = (1.0 - rate) ** more
        delayed = before + more, (1.0 - survive) / rate + survive * before
        found.append([ratio / before for ratio in (after, *delayed)])
        learnable.append(problem in PROBLEMS and PROBLEMS[problem].hint and problem not in _MISLEADING)
        cells = [problem, f"{len(pairs)}", f"{before[0]:.0f}", f"{after[0]:.0f}", *_shares(found[-1])]
        lines.append(f"| {' | '.join(cells)} |")
    for name, chosen in (("all", [True] * len(found)), ("criticality leads to the crash", learnable)):
        if any(chosen):
            logarithms = np.log(np.array(found)[chosen]).mean(axis=0)
            lines.append(f"| *{name}: {sum(chosen)}* | | | | {' | '.join(_shares(np.exp(logarithms)))} |")
    return "\n".join(lines)


def _shares(ratios: Sequence[np.ndarray[tuple[int], np.dtype[np.float64]]]) -> list[str]:
    return [_share(float(ratio[0]), ratio[1:]) for ratio in ratios]


def _share(ratio: float, drawn: np.ndarray[tuple[int], np.dtype[np.float64]]) -> str:
    low, high = np.percentile(drawn, (2.5, 97.5))
    return f"{ratio:.2f} ({low:.2f}-{high:.2f})"


def _cell(runs: Sequence[Run], problem: str, sampler: str, row: dict[str, float]) -> str:
    if sampler not in row:
        return "-"
    if not sampler.startswith("guided") or (problem in REAL and "random" not in row):
        return f"{row[sampler]:.2f}"
    low, high = interval(runs, problem, sampler)
    return f"{row[sampler]:.2f} ({low:.2f}-{high:.2f})"


def write_plot(runs: Sequence[Run], target: Path) -> None:
    """Write it as SVG: a row a problem, a mark a sampler, and the interval of guided."""
    found = costs(runs)
    height = _TOP + _ROW * len(found) + 46
    rules = [f".s{place} {{ --c: {light}; }}" for place, (light, _, _) in enumerate(_MARKS.values())]
    dark = [f".s{place} {{ --c: {shade}; }}" for place, (_, shade, _) in enumerate(_MARKS.values())]
    parts = [
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" '
            'font-family="system-ui, sans-serif" font-size="12">'
        ),
        "<title>Cost to the first crash, as a share of what random draws need</title>",
        "<style>:root { --page: #ffffff; --text: #1b2430; --faint: #5d6b7d; --line: #d9dfe7; }",
        *rules,
        "@media (prefers-color-scheme: dark) {",
        ":root { --page: #12171e; --text: #e6ebf2; --faint: #9aa8ba; --line: #313b48; }",
        *dark,
        "}",
        (
            "text { fill: var(--text); } .faint { fill: var(--faint); } .line { stroke: var(--line); } "
            ".one { stroke: var(--faint); stroke-dasharray: 4 3; }"
        ),
        (
            ".disc, .square { fill: var(--c); } .ring, .cross { fill: none; stroke: var(--c); stroke-width: 1.8; } "
            ".bar { stroke: var(--c); stroke-width: 2.5; }</style>"
        ),
        f'<rect width="{_WIDTH}" height="{height}" fill="var(--page)"/>',
        (
            '<text x="12" y="20" font-weight="600">Cost to the first crash, as a share of what random draws need '
            "(left is better)</text>"
        ),
        *_legend(),
    ]
    bottom = _TOP + _ROW * len(found)
    for share in (0.05, 0.1, 0.2, 0.5, 1.0, 2.0):
        x = _x(share)
        parts.append(f'<line class="{"one" if share == 1 else "line"}" x1="{x}" x2="{x}" y1="{_TOP}" y2="{bottom}"/>')
        parts.append(f'<text class="faint" x="{x}" y="{bottom + 16}" text-anchor="middle">{share:g}</text>')
    parts.append(f'<text class="faint" x="{_x(1)}" y="{bottom + 32}" text-anchor="middle">random draws</text>')
    for place, (name, row) in enumerate(found.items()):
        y = _TOP + _ROW * place + _ROW / 2
        rate = f"1 in {one_in(name, runs):.0f}"
        parts.append(f'<text x="12" y="{y + 4}">{escape(name)} <tspan class="faint">{rate}</tspan></text>')
        if name in REAL and place and list(found)[place - 1] in PROBLEMS:
            parts.append(f'<line class="line" x1="12" x2="{_WIDTH - 12}" y1="{y - _ROW / 2}" y2="{y - _ROW / 2}"/>')
        if "guided" in row:
            low, high = interval(runs, name, "guided")
            parts.append(f'<line class="bar s0" x1="{_x(low)}" x2="{_x(high)}" y1="{y}" y2="{y}"/>')
        parts += [_mark(sampler, _x(row[sampler]), y) for sampler in reversed(_MARKS) if sampler in row]
    target.write_text("\n".join([*parts, "</svg>"]) + "\n", encoding="utf-8")


def _x(share: float) -> float:
    within = math.log(min(max(share, _LEAST), _MOST) / _LEAST) / math.log(_MOST / _LEAST)
    return round(_LEFT + (_WIDTH - 24 - _LEFT) * within, 1)


def _legend() -> list[str]:
    parts = []
    for place, name in enumerate(_MARKS):
        x, y = 18 + 168 * (place % 5), 40 + 18 * (place // 5)
        parts += [_mark(name, x, y), f'<text x="{x + 10}" y="{y + 4}">{name}</text>']
    return parts


def _mark(sampler: str, x: float, y: float) -> str:
    place, (_, _, form) = list(_MARKS).index(sampler), _MARKS[sampler]
    told = f'class="{form} s{place}"'
    match form:
        case "disc" | "ring":
            return f'<circle {told} cx="{x}" cy="{y}" r="{6 if form == "disc" else 4}"/>'
        case "square":
            return f'<rect {told} x="{x - 4}" y="{y - 4}" width="8" height="8"/>'
        case _:
            return f'<path {told} d="M{x - 4} {y - 4}l8 8m0-8l-8 8"/>'
