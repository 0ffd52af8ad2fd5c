"""How long hunts take by the clock: ``scripts/studies/run search --wall``."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from problems import REAL
from search_plot import GIVE_UP

import crashhunt

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.hunts import HuntReport


def wall_table(names: Sequence[str], samplers: Sequence[str], seeds: Sequence[int], parallel: int) -> str:
    """Hunt as ``crashhunt run`` does, in turns, and return the mean cost by the clock and in steps as Markdown.

    Scenarios have their own warm-up here, as what is hunted is what ships.
    """
    lines = [
        "| problem | hunts | sampler | trials | seconds | of the first sampler | steps, likewise |",
        "| --- | ---: | --- | ---: | ---: | ---: | ---: |",
    ]
    for name in names:
        paid = np.array([[_paid(_hunted(name, sampler, seed, parallel)) for sampler in samplers] for seed in seeds])
        means = paid.mean(0)
        drawn = paid[np.random.default_rng(0).integers(len(seeds), size=(2000, len(seeds)))].mean(1)
        for place, sampler in enumerate(samplers):
            low, high = np.percentile(drawn[:, place, 1] / drawn[:, 0, 1], (2.5, 97.5))
            _, seconds, steps = means[place] / means[0]
            lines.append(
                f"| {name} | {len(seeds)} | {sampler} | {means[place, 0]:.0f} | {means[place, 1]:.2f} "
                f"| {seconds:.2f} ({low:.2f}-{high:.2f}) | {steps:.2f} |"
            )
    return "\n".join(lines)


def _hunted(name: str, sampler: str, seed: int, parallel: int) -> HuntReport:
    problem = REAL[name]
    with tempfile.TemporaryDirectory(prefix="crashhunt-wall-") as folder:
        return crashhunt.run(
            Path(folder) / "hunt", parallel=parallel, trials=round(GIVE_UP / problem.rate), seed=seed, sampler=sampler,
            **problem.request,
        )  # fmt: skip


def _paid(report: HuntReport) -> tuple[int, float, int]:
    return sum(report.outcomes.values()), report.wall_s, report.steps_total
