"""How many trials samplers need to the first crash: problems, peers and the table. ``scripts/bench search`` runs it.

Every sampler is given the same arguments with the same bounds, the same seeds, and the same lag: before trial n it is
told what came of all trials up to n - 4, as in a hunt with two workers. A hunt without a crash is given up after three
times what random draws need on the average. The problems without a simulator have crash regions whose size is known.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
import tempfile
import time
from collections import deque
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from peers import PEERS
from problems import PROBLEMS, REAL

from crashhunt.episode import WorkerSettings
from crashhunt.executors import PoolExecutor
from crashhunt.hunts import spec_of
from crashhunt.plans import AgentSettings, ArgumentSpec, HuntSettings, Request, plan, sampler_of, with_settings
from crashhunt.trial import Outcome, TrialResult

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from problems import Problem, Real

    from crashhunt.trial import TrialSpec

LAG = 4
GIVE_UP = 3.0  # times what random draws need
OURS = ("random", "halton", "sobol", "guided", "cross-entropy", "mutation", "cma-es")
FIRST_SEED = 100


@dataclass(frozen=True, slots=True)
class Run:
    """One hunt.

    Args:
        problem: its name.
        sampler: likewise.
        seed: of the hunt.
        trials: to the first crash, or until it was given up.
        found: whether there was one.
        steps: of all its trials.
        cpu_s: of the sampler alone.
    """

    problem: str
    sampler: str
    seed: int
    trials: int
    found: bool
    steps: int = 0
    cpu_s: float = 0.0


class Place(Protocol):
    """Where trials end."""

    def submit(self, spec: TrialSpec) -> None:
        """Begin one."""

    def ended(self) -> list[TrialResult]:
        """Wait for some."""


@dataclass(slots=True)
class AtOnce:
    """Trials of a problem without a simulator."""

    problem: Problem
    done: deque[TrialResult] = field(default_factory=deque)

    def submit(self, spec: TrialSpec) -> None:
        """Work it out."""
        danger = self.problem.danger(np.array([*spec.arguments["ego"].values()], dtype=object), spec.seed)
        outcome = Outcome.COLLISION if danger >= 1.0 else Outcome.SURVIVED
        self.done.append(TrialResult(spec, outcome, steps=1, danger=danger))

    def ended(self) -> list[TrialResult]:
        """Return all."""
        found = [*self.done]
        self.done.clear()
        return found


@dataclass(slots=True)
class Workers:
    """Trials on a simulator."""

    pool: PoolExecutor

    def submit(self, spec: TrialSpec) -> None:
        """Hand it over."""
        self.pool.submit(spec)

    def ended(self) -> list[TrialResult]:
        """Wait for one or more."""
        while not (found := list(self.pool.completed(1.0))):
            pass
        return found


def hunted(settings: HuntSettings, place: Place, most: int, name: str) -> Run:
    """Ask and tell as a deterministic hunt does, up to the first crash."""
    sampler = sampler_of(settings)
    results: dict[int, TrialResult] = {}
    spent, steps, first = 0.0, 0, most
    asked = told = 0
    while asked < min(first, most) or len(results) < asked:
        if asked < min(first, most) and told >= asked - LAG + 1:
            began = time.process_time()
            spec = spec_of(asked, settings, sampler)
            spent += time.process_time() - began
            place.submit(spec)
            asked += 1
            continue
        for result in place.ended():
            results[result.spec.number] = result
            steps += result.steps
            if result.outcome in settings.crash_on:
                first = min(first, result.spec.number)
        began = time.process_time()
        while told in results and told <= asked - LAG:
            if sampler.learns:
                sampler.tell(results[told])
            told += 1
        spent += time.process_time() - began
    return Run(name, settings.sampler, settings.seed, min(first + 1, most), first < most, steps, spent)


def synthetic_run(name: str, sampler: str, seed: int) -> Run:
    """One hunt on a problem without a simulator."""
    problem = PROBLEMS[name]
    settings = HuntSettings(
        scenario=name, scenario_digest="", trials=0, max_steps=1, seed=seed, sampler=PEERS.get(sampler, sampler),
        agents={"ego": AgentSettings(agent="keep-lane", arguments={
            argument: ArgumentSpec(spec=spec, kind=kind) for argument, (spec, kind) in problem.arguments.items()
        })},
    )  # fmt: skip
    found = hunted(settings, AtOnce(problem), math.ceil(GIVE_UP / problem.rate), name)
    return Run(name, sampler, seed, found.trials, found.found, found.steps, found.cpu_s)


def real_runs(name: str, samplers: Sequence[str], seeds: Sequence[int], parallel: int) -> Iterator[Run]:
    """All hunts on a problem with a simulator, on the same warm workers."""
    problem: Real = REAL[name]
    with tempfile.TemporaryDirectory(prefix="crashhunt-search-") as folder:
        scenario, settings = plan(Request(trials=1, seed=1, **problem.request))
        working = WorkerSettings(
            scenario=with_settings(scenario, settings), oracles=settings.oracles, crash_on=settings.crash_on,
            scratch=Path(folder),
        )  # fmt: skip
        pool = PoolExecutor(working, parallel=parallel)
        try:
            for seed in seeds:
                for sampler in samplers:
                    asked = Request(trials=1, seed=seed, sampler=PEERS.get(sampler, sampler), **problem.request)
                    found = hunted(plan(asked)[1], Workers(pool), math.ceil(GIVE_UP / problem.rate), name)
                    yield Run(name, sampler, seed, found.trials, found.found, found.steps, found.cpu_s)
        finally:
            pool.close()


def cost(runs: Sequence[Run], of_random: Sequence[Run]) -> float:
    """Mean number of trials, given up ones as they are, as a share of what random draws need.

    That is known by calculation where there is no simulator; else it is what those of the same seeds did need.
    """
    problem = PROBLEMS.get(runs[0].problem)
    if problem is not None:
        needed = (1.0 - math.exp(-GIVE_UP)) / problem.rate
    elif of_random:
        needed = statistics.fmean(run.trials for run in of_random)
    else:
        needed = math.nan
    return statistics.fmean(run.trials for run in runs) / needed


def all_runs(samplers: Sequence[str], seeds: Sequence[int], names: Sequence[str], workers: int) -> Iterator[Run]:
    """Every sampler on every problem without a simulator."""
    with ProcessPoolExecutor(workers) as pool:
        jobs = [
            pool.submit(synthetic_run, name, sampler, seed)
            for name in names for sampler in samplers for seed in seeds
        ]  # fmt: skip
        for job in jobs:
            yield job.result()


def summary(runs: Sequence[Run]) -> dict[str, dict[str, float]]:
    """Problem to sampler to cost."""
    found: dict[str, dict[str, float]] = {}
    for name in dict.fromkeys(run.problem for run in runs):
        of = [run for run in runs if run.problem == name]
        of_random = [run for run in of if run.sampler == "random"]
        found[name] = {
            sampler: cost([run for run in of if run.sampler == sampler], of_random)
            for sampler in dict.fromkeys(run.sampler for run in of)
        }
    return found


def table(costs: dict[str, dict[str, float]]) -> str:
    """Return it as Markdown."""
    samplers = list(dict.fromkeys(sampler for row in costs.values() for sampler in row))
    lines = [f"| problem | one in | {' | '.join(samplers)} |", f"| --- | ---: |{' ---: |' * len(samplers)}"]
    for name, row in costs.items():
        rate = (PROBLEMS.get(name) or REAL[name]).rate
        cells = [f"{row[sampler]:.2f}" if sampler in row else "-" for sampler in samplers]
        lines.append(f"| {name} | {1 / rate:.0f} | {' | '.join(cells)} |")
    return "\n".join(lines)


def store(path: Path, runs: Sequence[Run]) -> None:
    """Write hunts: problem to sampler to seed to the number of trials, below 0 where it was given up after so many."""
    found: dict[str, dict[str, dict[str, int]]] = {}
    for run in sorted(runs, key=lambda run: (run.problem, run.sampler, run.seed)):
        row = found.setdefault(run.problem, {}).setdefault(run.sampler, {})
        row[str(run.seed)] = run.trials if run.found else -run.trials
    lines = json.dumps(found, indent=1).replace("\n   ", " ").replace("\n  }", " }")
    path.write_text(lines + "\n", encoding="utf-8")


def stored(path: Path) -> dict[tuple[str, str, int], Run]:
    """Read what `store` wrote."""
    found: dict[str, dict[str, dict[str, int]]] = json.loads(path.read_text(encoding="utf-8"))
    return {
        (name, sampler, int(seed)): Run(name, sampler, int(seed), abs(trials), trials > 0)
        for name, row in found.items() for sampler, of in row.items() for seed, trials in of.items()
    }  # fmt: skip


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser("scripts/search.py", description=__doc__)
    parser.add_argument("--samplers", default=",".join((*OURS, *PEERS)))
    parser.add_argument("--problems", default=",".join(PROBLEMS), help="some of these, and of " + ", ".join(REAL))
    parser.add_argument("--repetitions", type=int, default=30)
    parser.add_argument("--parallel", type=int, default=2)
    parser.add_argument("--store", type=Path, help="a file of JSON to which hunts are added; the table is of all in it")
    options = parser.parse_args()
    seeds = range(FIRST_SEED, FIRST_SEED + options.repetitions)
    samplers, names = options.samplers.split(","), options.problems.split(",")
    runs = stored(options.store) if options.store is not None and options.store.exists() else {}
    for found in (
        all_runs(samplers, seeds, [name for name in names if name in PROBLEMS], options.parallel),
        *(real_runs(name, samplers, seeds, options.parallel) for name in names if name in REAL),
    ):
        for run in found:
            runs[run.problem, run.sampler, run.seed] = run
            if options.store is not None:
                store(options.store, [*runs.values()])
    print(table(summary([*runs.values()])))
    return 0


if __name__ == "__main__":
    sys.exit(main())
