"""How many trials ``guided`` needs with half and twice each of its constants: ``scripts/search --sensitivity``.

Only the trials to the first crash count, on the problems without a simulator. Hunts that the file has do not run again.
"""

from __future__ import annotations

import json
import statistics
from concurrent.futures import ProcessPoolExecutor
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.samplers import _guided, _model

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

__all__ = ["CONSTANTS", "METHOD", "sensitivity_table", "write_sensitivity"]

CONSTANTS = ("TRIALS", "_CANDIDATES", "_FAR", "_WORTHWHILE", "_PRIOR", "_NEARER", "_PATIENCE")
"""Constants that were chosen; the eighth is `_REPEATS`, which has no effect before the first crash."""
METHOD = ("_ANYWHERE", "_AROUND", "_NEAR", "_KEEP_SEED", "_AMBITION", "_FIRST_ODDS", "_ODDS_STEP", "_STARTS")
"""Numbers of the method that were not varied when a version was chosen."""
_USUAL = "usual"

CostOf = dict[str, dict[str, dict[str, int]]]
"""Constant and value, to problem, to seed, to the trials of the hunt."""


def _value(name: str) -> float:
    value: float = next(getattr(module, name) for module in (_guided, _model) if hasattr(module, name))
    return value


def _values(name: str) -> tuple[float, float]:
    value = _value(name)
    return (max(1, value // 2) if isinstance(value, int) else value / 2), 2 * value


def _label(name: str, value: float) -> str:
    return f"{name}={value:g}"


def _cost(hunt: Callable[[str, str, int], int], name: str, value: float, problem: str, seed: int) -> int:
    """Return the trials of a hunt with a value of a constant."""
    if name == _USUAL:
        return hunt(problem, "guided", seed)
    usual = _value(name)
    try:
        _set(name, value)
        return hunt(problem, "guided", seed)
    finally:
        _set(name, usual)


def _set(name: str, value: float) -> None:
    for module in (_guided, _model):
        if hasattr(module, name):
            setattr(module, name, value)


def write_sensitivity(
    path: Path,
    hunt: Callable[[str, str, int], int],
    names: Sequence[str],
    problems: Sequence[str],
    seeds: Sequence[int],
    parallel: int,
) -> None:
    """Run hunts that the file does not have, and write it after each value.

    Args:
        path: file of JSON.
        hunt: returns the trials of a hunt for a problem, a sampler and a seed.
        names: constants.
        problems: problems without a simulator.
        seeds: seeds of hunts.
        parallel: number of processes.
    """
    found: CostOf = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    asked = [(_USUAL, 0.0), *((name, value) for name in names for value in _values(name))]
    with ProcessPoolExecutor(parallel) as pool:
        for name, value in asked:
            row = found.setdefault(_USUAL if name == _USUAL else _label(name, value), {})
            jobs = {
                (problem, seed): pool.submit(_cost, hunt, name, value, problem, seed)
                for problem in problems for seed in seeds if str(seed) not in row.get(problem, {})
            }  # fmt: skip
            for (problem, seed), job in jobs.items():
                row.setdefault(problem, {})[str(seed)] = job.result()
            lines = (
                f" {json.dumps(label)}: {{\n"
                + ",\n".join(f"  {json.dumps(problem)}: {json.dumps(of)}" for problem, of in rows.items())
                + "\n }"
                for label, rows in found.items()
            )
            path.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


def sensitivity_table(path: Path) -> str:
    """Return a table as Markdown: the trials with each value, divided by those with the usual value, same seeds.

    The last column has the greatest ratio of a problem, of both values.
    """
    found: CostOf = json.loads(path.read_text(encoding="utf-8"))
    lines = ["| constant | half | twice | worst problem |", "| --- | --- | --- | --- |"]
    for name in (*CONSTANTS, *METHOD):
        labels = [_label(name, value) for value in _values(name)]
        if not all(label in found for label in labels):
            continue
        cells, worst = [], []
        for label, value in zip(labels, _values(name), strict=True):
            words, ratios = _ratios(found[_USUAL], found[label])
            cells.append(f"{value:g}: {words}")
            worst += ratios
        _, problem, words = max(worst)
        lines.append(f"| `{name}` ({_value(name):g}) | {' | '.join(cells)} | {problem} {words} |")
    return "\n".join(lines)


def _ratios(
    usual: dict[str, dict[str, int]], other: dict[str, dict[str, int]]
) -> tuple[str, list[tuple[float, str, str]]]:
    """Return the ratio over all problems in words, and for each problem the ratio, its name and the ratio in words."""
    rng = np.random.default_rng(0)
    ratios, drawn = [], []
    for problem, of in other.items():
        one, two = (np.array([row[seed] for seed in of], dtype=float) for row in (usual[problem], of))
        again = rng.integers(len(one), size=(4000, len(one)))
        draws = two[again].mean(1) / one[again].mean(1)
        drawn.append(draws)
        ratios.append((float(two.mean() / one.mean()), problem, _words(float(two.mean() / one.mean()), draws)))
    whole = np.exp(np.mean(np.log(drawn), axis=0))
    return _words(statistics.geometric_mean(ratio for ratio, _, _ in ratios), whole), ratios


def _words(ratio: float, draws: np.ndarray[tuple[int], np.dtype[np.float64]]) -> str:
    low, high = np.percentile(draws, (2.5, 97.5))
    return f"{ratio:.2f} ({low:.2f}-{high:.2f})"
