"""How many trials samplers need to the first crash: problems, peers and the table.

Every sampler is given the same arguments with the same bounds, the same seeds, and the same lag (``--lag``): before
trial n it receives the results up to n - 4, as in a hunt with two workers. A hunt without a crash ends after three
times the trials that random draws need on average. The problems without a simulator have crash regions of known size.
On real ones, every crash runs again. The cost is the steps of all trials, of their setup (such as a warm-up) and of
these second runs. A trial that two hunts have in common runs once, and counts in both.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections import deque
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from development_problems import DEVELOPMENT, development_problem
from peers import PEERS, SLOW, missing_packages
from problems import PROBLEMS, REAL
from search_faults import FAULTS, faults_table, write_faults
from search_kinds import kinds_table, write_kinds
from search_plot import GIVE_UP, delay_table, pairs_table, table, write_plot
from search_pool import trials_on
from search_wall import wall_table
from stored_hunts import write_hunts
from unseen_problems import UNSEEN, unseen_problem

from crashhunt.hunts import GREATEST_LAG, growing_lag, spec_of
from crashhunt.plans import AgentSettings, ArgumentSpec, HuntSettings, Request, plan, sampler_of
from crashhunt.samplers import _cross_entropy, _guided, _model, _mutation
from crashhunt.trial import Outcome, TrialResult

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence
    from types import ModuleType

    from problems import Problem, Real
    from search_pool import Trials

    from crashhunt.trial import TrialSpec

Hunt = tuple[str, str, int]
"""Problem, sampler and seed."""
LAG = "4"
GROWING = "growing"
"""The lag of a hunt with ``--deterministic``."""
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
        steps: of all its trials, with their warm-ups, and of running its crash again; without a simulator, trials.
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

    def confirmed(self, crash: TrialResult) -> bool:
        """Whether it comes again."""

    def submit(self, spec: TrialSpec) -> None:
        """Begin one."""

    def ended(self) -> list[TrialResult]:
        """Wait for some."""


@dataclass(slots=True)
class FastStepper:
    """Trials of a problem without a simulator."""

    problem: Problem
    done: deque[TrialResult] = field(default_factory=deque)

    def confirmed(self, crash: TrialResult) -> bool:
        """Yes: it is a function of its arguments and its seed."""
        return True

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
    """Trials on a simulator, of which none runs twice, unless it is to be confirmed.

    Args:
        trials: where they run.
        known: what has run in other hunts.
    """

    trials: Trials
    known: dict[str, TrialResult] = field(default_factory=dict)
    waiting: deque[TrialResult] = field(default_factory=deque)

    def submit(self, spec: TrialSpec) -> None:
        """Hand it over, or look it up."""
        known = self.known.get(_what(spec))
        if known is None:
            self.trials.submit(spec)
        else:
            self.waiting.append(replace(known, spec=spec))

    def ended(self) -> list[TrialResult]:
        """Wait for one or more.

        Raises:
            RuntimeError: one is invalid, which says nothing about a sampler.
        """
        found = [*self.waiting]
        self.waiting.clear()
        while not found:
            found = [result for result, _ in self.trials.completed()]
            self.known |= {_what(result.spec): result for result in found}
        for result in found:
            if result.outcome is Outcome.INVALID:
                raise RuntimeError(f"{result.failure}")
        return found

    def confirmed(self, crash: TrialResult) -> bool:
        """Run it again, and say whether it came out the same to the bit."""
        self.trials.submit(crash.spec)
        while not (found := list(self.trials.completed())):
            pass
        return found[0][0].digest == crash.digest


def _what(spec: TrialSpec) -> str:
    """Return all that a trial follows from."""
    return json.dumps([spec.seed, spec.arguments, spec.scenario_arguments, spec.max_steps], sort_keys=True)


def a_lag(word: str) -> str:
    """Return a lag as it is given, for argparse."""
    if word != GROWING and not (word.isdecimal() and int(word) > 0):
        raise argparse.ArgumentTypeError(f"{word!r} is no lag; give trials above 0, or {GROWING!r}")
    return word


def a_constant(word: str) -> tuple[ModuleType, str, float]:
    """Return the module, the name and the value of a constant of the samplers, for argparse."""
    path, _, value = word.partition("=")
    place, _, name = path.rpartition(".")
    known = {module.__name__.rpartition(".")[2]: module for module in (_cross_entropy, _guided, _model, _mutation)}
    if place not in known or not isinstance(getattr(known[place], name, None), int | float):
        raise argparse.ArgumentTypeError(f"{path!r} is no constant of {', '.join(known)}; give MODULE.NAME=VALUE")
    return known[place], name, type(getattr(known[place], name))(value)


def lag_of(number: int, lag: str) -> int:
    """Return by how many trials results are delayed before a trial."""
    return growing_lag(number, GREATEST_LAG) if lag == GROWING else int(lag)


def hunted(settings: HuntSettings, place: Place, most: int, name: str, *, lag: str = LAG) -> Run:
    """Ask and tell as a deterministic hunt does, up to the first crash."""
    sampler = sampler_of(settings)
    results: dict[int, TrialResult] = {}
    spent, steps, first = 0.0, 0, most
    asked = told = 0
    while asked < min(first, most) or len(results) < asked:
        if asked < min(first, most) and told >= asked - lag_of(asked, lag) + 1:
            began = time.process_time()
            spec = spec_of(asked, settings, sampler)
            spent += time.process_time() - began
            place.submit(spec)
            asked += 1
            continue
        for result in place.ended():
            results[result.spec.number] = result
            steps += result.steps + (result.setup_steps or 0) + (result.stress.steps if result.stress else 0)
            if result.outcome in settings.crash_on:
                first = min(first, result.spec.number)
        began = time.process_time()
        while told in results and told <= asked - lag_of(asked, lag):
            if sampler.learns:
                sampler.tell(_with_margin(results[told]))
            told += 1
        spent += time.process_time() - began
    found = first < most
    if found:
        steps += results[first].steps + (results[first].setup_steps or 0)
        if not place.confirmed(results[first]):
            print(f"{name}, {settings.sampler}, {settings.seed}: trial {first} does not come again", file=sys.stderr)
    return Run(
        problem=name,
        sampler=settings.sampler,
        seed=settings.seed,
        trials=min(first + 1, most),
        found=found,
        steps=steps,
        cpu_s=spent,
    )


def _with_margin(result: TrialResult) -> TrialResult:
    """Return the result with 1 - robustness margin as its danger, if the trial had probes."""
    return result if result.stress is None else replace(result, danger=1.0 - result.stress.least)


def synthetic_run(name: str, sampler: str, seed: int, lag: str = LAG, limit: float = math.inf) -> Run:
    """One hunt on a problem without a simulator, of at most a number of trials."""
    if name in DEVELOPMENT:
        problem = development_problem(name, seed)
    else:
        problem = unseen_problem(name, seed) if name in UNSEEN else PROBLEMS[name]
    settings = HuntSettings(
        scenario=name, scenario_digest="", trials=0, max_steps=1, seed=seed, sampler=PEERS.get(sampler, sampler),
        agents={"ego": AgentSettings(agent="keep-lane", arguments={
            argument: ArgumentSpec(spec=spec, kind=kind) for argument, (spec, kind) in problem.arguments.items()
        })},
    )  # fmt: skip
    most = math.ceil(min(GIVE_UP / problem.rate, limit))
    found = hunted(settings, FastStepper(problem), most, name, lag=lag)
    return Run(
        problem=name,
        sampler=sampler,
        seed=seed,
        trials=found.trials,
        found=found.found,
        steps=found.steps,
        cpu_s=found.cpu_s,
    )


def real_runs(
    name: str,
    samplers: Sequence[str],
    seeds: Sequence[int],
    parallel: int,
    known: Collection[Hunt],
    lag: str = LAG,
    probe_s: float = 0.0,
) -> Iterator[Run]:
    """All hunts on a problem with a simulator that are not known, on the same warm workers."""
    problem: Real = REAL[name]
    if all((name, sampler, seed) in known for sampler in samplers for seed in seeds):
        return
    most = math.ceil(GIVE_UP / problem.rate)
    with trials_on(problem, parallel, probe_s) as trials:
        place = Workers(trials)
        for seed in seeds:
            for sampler in samplers:
                if (name, sampler, seed) in known:
                    continue
                asked = Request(trials=1, seed=seed, sampler=PEERS.get(sampler, sampler), **problem.request)
                yield replace(hunted(plan(asked)[1], place, most, name, lag=lag), sampler=sampler)


def all_runs(
    samplers: Sequence[str],
    seeds: Sequence[int],
    names: Sequence[str],
    workers: int,
    known: Collection[Hunt] = (),
    lag: str = LAG,
    limit: float = math.inf,
) -> Iterator[Run]:
    """Every sampler on every problem without a simulator, but for what is known."""
    with ProcessPoolExecutor(workers) as pool:
        jobs = [
            pool.submit(synthetic_run, name, sampler, seed, lag, limit)
            for name in names for sampler in samplers for seed in seeds if (name, sampler, seed) not in known
        ]  # fmt: skip
        for job in jobs:
            yield job.result()


def store(path: Path, runs: Sequence[Run]) -> None:
    """Write hunts: problem to sampler to seed to trials, below 0 where it was given up, and steps where they count."""
    found: dict[str, dict[str, dict[str, int | list[int]]]] = {}
    for run in sorted(runs, key=lambda run: (run.problem, run.sampler, run.seed)):
        row = found.setdefault(run.problem, {}).setdefault(run.sampler, {})
        trials = run.trials if run.found else -run.trials
        row[str(run.seed)] = [trials, run.steps] if run.problem in REAL else trials
    write_hunts(path, found)


def stored(path: Path) -> dict[Hunt, Run]:
    """Read what `store` wrote."""
    found: dict[str, dict[str, dict[str, int | list[int]]]] = json.loads(path.read_text(encoding="utf-8"))
    runs = {}
    for name, row in found.items():
        for sampler, of in row.items():
            for seed, what in of.items():
                trials, steps = what if isinstance(what, list) else (what, abs(what))
                runs[name, sampler, int(seed)] = Run(
                    problem=name, sampler=sampler, seed=int(seed), trials=abs(trials), found=trials > 0, steps=steps
                )
    return runs


def _installed(samplers: Sequence[str]) -> list[str]:
    """Return the samplers whose packages are installed, and print the others in one line."""
    missing = {sampler: packages for sampler in samplers if (packages := missing_packages(sampler))}
    if missing:
        needs = ", ".join(f"{sampler} (pip install {' '.join(packages)})" for sampler, packages in missing.items())
        print(f"skipped, because a package is not installed: {needs}", file=sys.stderr)
    return [sampler for sampler in samplers if sampler not in missing]


def main(words: Sequence[str] | None = None) -> int:
    """Run and print."""
    parser = argparse.ArgumentParser("scripts/studies/run search", description=__doc__)
    parser.add_argument(
        "--samplers",
        default=",".join((*OURS, *(peer for peer in PEERS if peer not in SLOW))),
        help=f"also {', '.join(SLOW)}; samplers whose package is not installed are skipped",
    )
    parser.add_argument(
        "--problems",
        default=",".join(PROBLEMS),
        help="some of these, and of " + ", ".join((*REAL, *DEVELOPMENT, *UNSEEN)),
    )
    parser.add_argument("--repetitions", type=int, default=30)
    parser.add_argument(
        "--limit", type=int, metavar="TRIALS", default=math.inf,
        help="of a hunt on a problem without a simulator, for slow samplers; compare only hunts with the same limit",
    )  # fmt: skip
    parser.add_argument("--parallel", type=int, default=2)
    parser.add_argument("--quick", action="store_true", help="a few hunts, in seconds: shows only that nothing broke")
    parser.add_argument("--plot", type=Path, help="an SVG to write, of all hunts")
    parser.add_argument("--store", type=Path, help="a file of JSON to which hunts are added; the table is of all in it")
    parser.add_argument("--kinds", type=int, help="instead, hunts of so many trials that go on, for kinds of crashes")
    parser.add_argument("--faults", type=int, help="instead, so many hunts for planted faults; needs --store")
    parser.add_argument("--wall", action="store_true", help="instead, hunts of the product, for time by the clock")
    parser.add_argument("--again", action="store_true", help="hunts that are stored already, too")
    parser.add_argument("--lag", default=LAG, type=a_lag, help=f"of results, in trials, or {GROWING!r}")
    parser.add_argument(
        "--probe", type=float, default=0.0, metavar="SECONDS",
        help="robustness probes in trials on a simulator; samplers receive 1 - margin as the danger",
    )  # fmt: skip
    parser.add_argument("--pairs", metavar="A,B", help="in addition, the cost of B as a share of that of A, same seeds")
    parser.add_argument(
        "--delay", type=Path, metavar="FILE",
        help=f"in addition, the cost as a share of that of stored hunts with lag {LAG}, and that of the delay alone",
    )  # fmt: skip
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument(
        "--set", action="append", default=[], type=a_constant, metavar="MODULE.NAME=VALUE",
        help="a constant of a sampler, such as _guided._FORGET=0.9, for this run",
    )  # fmt: skip
    options = parser.parse_args(words)
    if options.quick:
        options.samplers, options.problems, options.repetitions = "random,halton,guided", "easy,blind,motorway", 2
    for module, name, value in options.set:
        setattr(module, name, value)
    seeds = range(options.first_seed, options.first_seed + options.repetitions)
    samplers, names = _installed(options.samplers.split(",")), options.problems.split(",")
    unknown = [name for name in names if name not in (*PROBLEMS, *REAL, *DEVELOPMENT, *UNSEEN)]
    if unknown:
        parser.error(f"--problems: {', '.join(unknown)} is no problem; see --help")
    if options.faults:
        if options.store is None:
            parser.error("--faults needs --store FILE")
        faults = range(options.first_seed, options.first_seed + options.faults)
        write_faults(options.store, [*FAULTS], faults, options.parallel)
        print(faults_table(options.store))
        return 0
    if options.kinds:
        write_kinds(options.store, names, samplers, seeds, options.kinds, options.parallel)
        print(kinds_table(options.store))
        return 0
    if options.wall:
        print(wall_table(names, samplers, seeds, options.parallel))
        return 0
    runs = stored(options.store) if options.store is not None and options.store.exists() else {}
    known = () if options.again else (*runs,)
    ran: list[Run] = []
    for found in (
        all_runs(
            samplers,
            seeds,
            [name for name in names if name not in REAL],
            options.parallel,
            known,
            options.lag,
            options.limit,
        ),
        *(
            real_runs(name, samplers, seeds, options.parallel, known, options.lag, options.probe)
            for name in names
            if name in REAL
        ),
    ):
        for run in found:
            runs[run.problem, run.sampler, run.seed] = run
            ran.append(run)
            if options.store is not None:
                store(options.store, [*runs.values()])
    print(table([*runs.values()]))
    if options.pairs is not None:
        base, _, other = options.pairs.partition(",")
        print(f"\n{pairs_table([*runs.values()], base, other)}")
    if options.delay is not None:
        if options.lag == GROWING:
            parser.error("--delay needs a fixed --lag")
        for sampler in samplers:
            early, late = (
                [run for run in found if run.sampler == sampler]
                for found in (stored(options.delay).values(), runs.values())
            )
            print(f"\n{sampler}:\n{delay_table(early, late, int(options.lag) - int(LAG))}")
    for sampler in dict.fromkeys(run.sampler for run in ran):
        of = [run for run in ran if run.sampler == sampler]
        spent, trials = sum(run.cpu_s for run in of), sum(run.trials for run in of)
        print(f"CPU time of {sampler}: {spent:.1f} s for {trials} trials, {1000 * spent / trials:.2f} ms each")
    if options.plot is not None:
        write_plot([*runs.values()], options.plot)
    return 0


if __name__ == "__main__":
    sys.exit(main())
