"""How many planted faults samplers find in environments of Gymnasium: ``scripts/studies/run search --faults HUNTS``.

Each hunt has its own regions: one of the arguments for each fault. They are drawn by the seed of the hunt. The sampler
gets the results that an environment gives: all crashes with one type, with a coarse cell of the last observation, or
with a name.
"""

from __future__ import annotations

import json
import math
import statistics
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from stored_hunts import write_hunts

from crashhunt.hunts import spec_of
from crashhunt.plans import AgentSettings, ArgumentSpec, HuntSettings, sampler_of
from crashhunt.trial import Collision, Outcome, TrialResult

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from crashhunt.trial import TrialSpec

_LAG = 4
_ROOM = 0.1  # distance between two regions, at least
_LEVELS = 3  # of each of four numbers of a state
EVIDENCE = ("type", "cell", "name")
"""What a crash tells the sampler of its fault: nothing, a coarse cell of the state, or its name."""


@dataclass(frozen=True, slots=True)
class FaultProblem:
    """Regions of arguments, of which each has a fault.

    Args:
        about: in words.
        rates: of crashes by each fault, of random draws.
        trials: of a hunt.
        reaches: distance from each region over which criticality falls to 0; 0 for a region without.
        dimensions: how many arguments there are.
        by_seed: whether the seed of a trial, not the region, decides which of four faults shows.
        noise: standard deviation of criticality between seeds.
    """

    about: str
    rates: tuple[float, ...]
    trials: int = 150
    reaches: tuple[float, ...] = ()
    dimensions: int = 3
    by_seed: bool = False
    noise: float = 0.0


FAULTS = {
    "even": FaultProblem("three faults of the same size", (1 / 210,) * 3),
    "uneven": FaultProblem("three faults, one larger", (1 / 50, 1 / 400, 1 / 400)),
    "four": FaultProblem("four faults", (1 / 190,) * 4),
    "rare": FaultProblem("one large and two small faults", (1 / 30, 1 / 730, 1 / 730), trials=200),
    "lure": FaultProblem(
        "criticality leads to one fault only", (1 / 100, 1 / 220, 1 / 220), trials=200, reaches=(0.8, 0.0, 0.0)
    ),
    "mixed": FaultProblem("the seed decides which of four faults shows", (1 / 140,), trials=200, by_seed=True),
    "greedy": FaultProblem(
        "one fault is everywhere, two are rare", (1 / 12, 1 / 700, 1 / 700), trials=200, reaches=(1.5, 0.3, 0.3)
    ),
    "noisy": FaultProblem("three faults, and criticality with noise", (1 / 100, 1 / 300, 1 / 300), noise=0.15),
    "wide": FaultProblem(
        "three faults of four arguments", (1 / 60, 1 / 300, 1 / 300), trials=200, dimensions=4, reaches=(1.0,) * 3
    ),
}
"""The first six are those of the first study; the others were added with the second."""


class _Planted:
    """The regions of one hunt."""

    def __init__(self, problem: FaultProblem, seed: int) -> None:
        self._problem = problem
        rng = np.random.default_rng([7, seed])
        size = problem.dimensions
        unit = math.pi ** (size / 2) / math.gamma(size / 2 + 1)
        self._radii = np.array([(rate / unit) ** (1 / size) for rate in problem.rates])
        self._reaches = np.array(problem.reaches or (0.8,) * len(self._radii))
        while True:
            centers = np.array([rng.uniform(radius, 1 - radius, size) for radius in self._radii])
            apart = [
                float(np.linalg.norm(one - other)) - self._radii[i] - self._radii[j]
                for i, one in enumerate(centers) for j, other in enumerate(centers) if i < j
            ]  # fmt: skip
            if min(apart, default=1.0) > _ROOM:
                break
        self._centers = centers
        self._ends = rng.random((4, 4))  # the mean state after each fault

    def result(self, spec: TrialSpec, evidence: str) -> tuple[TrialResult, str]:
        """Return the result of a trial as a sampler gets it, and the fault; empty without a crash."""
        point = np.array([*spec.arguments["ego"].values()], dtype=float)
        away = np.linalg.norm(self._centers - point, axis=1) - self._radii
        luck = np.random.default_rng([spec.seed, 1])
        if away.min() >= 0.0:
            near = np.where(self._reaches > 0.0, 1.0 - away / np.maximum(self._reaches, 1e-9), 0.0)
            danger = 0.95 * max(0.0, float(near.max())) + self._problem.noise * float(luck.standard_normal())
            return TrialResult(spec, Outcome.SURVIVED, steps=1, danger=min(max(danger, 0.0), 0.99)), ""
        fault = int(luck.integers(4)) if self._problem.by_seed else int(np.argmin(away))
        state = 0.7 * self._ends[fault] + 0.3 * luck.random(4)
        hit = Collision(
            "ego", "collider", "ego", "", kind=f"fault {fault}" if evidence == "name" else "terminated",
            cell="".join(str(int(_LEVELS * share)) for share in state) if evidence == "cell" else "",
        )  # fmt: skip
        return TrialResult(spec, Outcome.COLLISION, steps=1, danger=1.0, collision=hit), f"{fault}"


def faults_found(name: str, sampler: str, evidence: str, seed: int) -> list[str]:
    """Return the fault of each crash of a hunt, in the order of trials."""
    problem = FAULTS[name]
    settings = HuntSettings(
        scenario=name, scenario_digest="", trials=0, max_steps=1, seed=seed, sampler=sampler,
        agents={"ego": AgentSettings(agent="keep-lane", arguments={
            f"x{index}": ArgumentSpec(spec="0.0:1.0", kind="float") for index in range(problem.dimensions)
        })},
    )  # fmt: skip
    planted, asks = _Planted(problem, seed), sampler_of(settings)
    results: list[TrialResult] = []
    faults = []
    for number in range(problem.trials):
        if asks.learns and number >= _LAG:
            asks.tell(results[number - _LAG])
        result, fault = planted.result(spec_of(number, settings, asks), evidence)
        results.append(result)
        if fault:
            faults.append(fault)
    return faults


def write_faults(path: Path, names: Sequence[str], seeds: Sequence[int], parallel: int) -> None:
    """Hunt, and write a file of JSON: problem to sampler and evidence to seed to the faults of crashes, in order."""
    found: dict[str, dict[str, dict[str, str]]] = {}
    with ProcessPoolExecutor(parallel) as pool:
        jobs = {
            (name, sampler, evidence, seed): pool.submit(faults_found, name, sampler, evidence, seed)
            for name in names
            for sampler, evidence in (("random", ""), *(("guided", evidence) for evidence in EVIDENCE))
            for seed in seeds
        }
        for (name, sampler, evidence, seed), job in jobs.items():
            row = found.setdefault(name, {}).setdefault(f"{sampler} {evidence}".strip(), {})
            row[str(seed)] = "".join(job.result())
            if seed == seeds[-1]:
                write_hunts(path, found)


def faults_table(path: Path) -> str:
    """Return it as Markdown: the mean numbers of faults and of crashes in a hunt, and ratios to random draws."""
    stored = json.loads(path.read_text(encoding="utf-8"))
    columns = ["random", *(f"guided {evidence}" for evidence in EVIDENCE)]
    columns = [column for column in columns if all(column in row for row in stored.values())]
    lines = [f"| problem | {' | '.join(columns)} |", f"| --- |{' ---: |' * len(columns)}"]
    means = {
        name: [statistics.fmean(len({*of}) for of in row[column].values()) for column in columns]
        for name, row in stored.items()
    }
    for name, row in means.items():
        crashes = [statistics.fmean(map(len, stored[name][column].values())) for column in columns]
        cells = [f"{mean:.2f} ({many:.0f})" for mean, many in zip(row, crashes, strict=True)]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    for words, of in (("median", statistics.median), ("least", min)):
        ratios = [of(row[place] / row[0] for row in means.values()) for place in range(len(columns))]
        lines.append(f"| *{words}, random = 1* | {' | '.join(f'{ratio:.2f}' for ratio in ratios)} |")
    return "\n".join(lines)
