"""Hunts for violations of requirements of ARCH-COMP: chasing cars, and automatic transmission; prints a table.

Instance 1 of the competition: throttle and brake are linear between points every 5 s. Instance 2: they are constant for
5 s each. Each hunt stops at the first violation. The mean and the median are over the hunts that found a violation. A
trial is one call of the simulation, whose trace is that of the environment, without the overhead of an episode. Inputs
of the cars are confirmed by a simulation with finer steps. ``--json FILE`` adds the number of trials of each hunt.

Packages of peers and Numba, which makes the simulations 100 times as fast, are no dependencies of crashhunt.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import chasing_cars
import numpy as np
import transmission

from crashhunt.hunts import spec_of
from crashhunt.oracles import REQUIREMENT, RequirementOracle
from crashhunt.plans import Request, plan, sampler_of
from crashhunt.requirements import parse
from crashhunt.trial import InputSignal, Outcome, TrialResult, TrialSpec, fold_signals
from crashhunt.world import Event

sys.path.append(str(Path(__file__).resolve().parents[1] / "search"))
from peers import PEERS, missing_packages

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from crashhunt.requirements import Requirement

SCENARIO = """schema = 1
simulator = "gym"
step_length_s = {step_s}
[gym]
id = "{environment}"
[agents.car]
agent = "chasing_cars:SignalDriver"
"""
CARS = ("chasing_cars:ChasingCars", chasing_cars)
TRANSMISSION = ("transmission:Transmission", transmission)
BENCHMARKS = {name: benchmark for benchmark in (CARS, TRANSMISSION) for name in benchmark[1].REQUIREMENTS}
PIECE_S = 5.0
_FINER_S = 0.001
_VIOLATED = Outcome.own(REQUIREMENT, RequirementOracle.outcomes[REQUIREMENT])


def inputs_of(spec: TrialSpec, step_s: float, duration_s: float) -> list[NDArray[np.float64]]:
    """Return throttle and brake in each step, as `SignalDriver` reads them."""
    inputs = fold_signals(spec.arguments["car"])
    shares = np.arange(round(duration_s / step_s)) * step_s / duration_s
    found = []
    for name in ("throttle", "brake"):
        signal = inputs[name]
        assert isinstance(signal, InputSignal)
        points, count = np.array(signal.points), len(signal.points)
        if signal.kind == "constant":
            found.append(points[np.minimum(count - 1, (shares * count + 1e-9).astype(int))])
        else:
            found.append(np.interp(shares * (count - 1), np.arange(count), points))
    return found


class Trials:
    """Runs the trials of hunts in this process; the sampler learns from each before it proposes the next.

    Args:
        folder: folder for the scenario.
        trials: greatest number of trials of a hunt.
        instance: instance of the competition.
    """

    def __init__(self, folder: Path, trials: int, instance: int) -> None:
        self._folder, self._trials, self._instance = folder, trials, instance

    def first_violation(self, name: str, sampler: str, repetition: int) -> TrialSpec | None:
        """Return the first trial with a violation; None if there is none within the budget."""
        environment, module = BENCHMARKS[name]
        step_s, duration_s, text = module.STEP_S, module.DURATION_S, module.REQUIREMENTS[name]
        scenario = SCENARIO.format(step_s=step_s, environment=environment)
        (self._folder / "scenario.toml").write_text(scenario, encoding="utf-8")
        pieces = round(duration_s / PIECE_S)
        shape = f"points={pieces + 1}:kind=linear" if self._instance == 1 else f"points={pieces}:kind=constant"
        request = Request(
            scenario=self._folder, requirements=(f"{name}={text}",), sampler=PEERS.get(sampler, sampler),
            seed=repetition, trials=self._trials, max_steps=round(duration_s / step_s),
            arguments=dict.fromkeys(("throttle", "brake"), f"signal:0:1:{shape}"),
        )  # fmt: skip
        _, settings = plan(request)
        chosen, requirement = sampler_of(settings), parse(text)
        for number in range(self._trials):
            spec = spec_of(number, settings, chosen)
            trace = module.simulate(*inputs_of(spec, step_s, duration_s))
            result = result_of(spec, name, requirement, trace, step_s)
            if result.outcome == REQUIREMENT:
                return spec
            chosen.tell(result)
        return None


def result_of(
    spec: TrialSpec, name: str, requirement: Requirement, trace: dict[str, NDArray[np.float64]], step_s: float
) -> TrialResult:
    """Return the result of a trial with the given trace, as far as samplers read it."""
    rows = requirement.parts(trace, step_s)
    least = min(map(max, rows))
    violated = least < 0 or (least == 0 and not requirement.satisfied(trace, step_s))
    return TrialResult(
        spec, _VIOLATED if violated else Outcome.SURVIVED, robustness={name: least}, conjuncts={name: rows},
        slack_s={name: requirement.slack_s(trace, step_s)}, danger=1.0 if least <= 0 else 1 / (1 + least),
        event=Event(REQUIREMENT, "car", name, name=name) if violated else None,
    )  # fmt: skip


def is_confirmed(name: str, spec: TrialSpec) -> bool:
    """Return whether the inputs violate a requirement of the cars in a simulation with finer steps, too."""
    throttle, brake = inputs_of(spec, chasing_cars.STEP_S, chasing_cars.DURATION_S)
    trace = chasing_cars.simulate(throttle, brake, integration_s=_FINER_S)
    return not parse(chasing_cars.REQUIREMENTS[name]).satisfied(trace, chasing_cars.STEP_S)


def measured(found: Callable[[int], TrialSpec | None], name: str, repetitions: range) -> dict[str, object]:
    """Return the numbers of trials of some hunts, and how many violations are confirmed."""
    began = time.process_time()
    violating = [spec for number in repetitions if (spec := found(number)) is not None]
    confirmed = sum(is_confirmed(name, spec) for spec in violating) if name.startswith("CC") else None
    done = [spec.number + 1 for spec in violating]
    return {
        "trials": done,
        "of": len(repetitions),
        "confirmed": confirmed,
        "cpu_s": round(time.process_time() - began, 1),
    }


def main() -> None:
    """Print a row per requirement and sampler."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=1500)
    parser.add_argument("--repetitions", type=int, default=30)
    parser.add_argument("--first", type=int, default=0, help="the first repetition, to add hunts to earlier ones")
    parser.add_argument("--instance", type=int, choices=(1, 2), default=2)
    parser.add_argument("--requirements", default=",".join(BENCHMARKS))
    parser.add_argument("--samplers", default="random,guided,optuna-tpe,optuna-cma-es,verifai-ce")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    print("| requirement | sampler | violated | mean | median | confirmed |\n| --- | --- | --- | --- | --- | --- |")
    chosen = range(given.first, given.first + given.repetitions)
    with tempfile.TemporaryDirectory() as temporary:
        hunts = Trials(Path(temporary), given.trials, given.instance)
        for name in given.requirements.split(","):
            for sampler in given.samplers.split(","):
                if missing := missing_packages(sampler):
                    print(f"{sampler} is skipped: pip install {' '.join(missing)}", file=sys.stderr)
                    continue
                row = measured(partial(hunts.first_violation, name, sampler), name, chosen)
                done = row["trials"]
                assert isinstance(done, list)
                figures = f"{statistics.mean(done):.1f} | {statistics.median(done):g}" if done else " | "
                checked = "" if row["confirmed"] is None else row["confirmed"]
                print(f"| {name} | {sampler} | {len(done)} of {row['of']} | {figures} | {checked} |", flush=True)
                if given.json is not None:
                    row |= {"requirement": name, "sampler": sampler, "instance": given.instance, "most": given.trials}
                    with given.json.open("a", encoding="utf-8") as file:
                        file.write(json.dumps(row) + "\n")


if __name__ == "__main__":
    main()
