"""Hunts for violations of requirements of ARCH-COMP: chasing cars, and automatic transmission; prints a table.

Instance 2 of the competition: throttle and brake are constant for 5 s each. Each hunt stops at the first violation.
The mean and the median are over the hunts that found a violation. Inputs of the cars are confirmed by a simulation with
finer steps. ``--json FILE`` also writes the trials of each hunt that found one.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
from pathlib import Path

import chasing_cars
import numpy as np
import transmission

from crashhunt.episode import Episode, Parts, WorkerSettings
from crashhunt.hunts import spec_of
from crashhunt.oracles import REQUIREMENT
from crashhunt.plans import Request, plan, sampler_of
from crashhunt.requirements import parse
from crashhunt.trial import InputSignal, TrialSpec, fold_signals

SCENARIO = """schema = 1
simulator = "gym"
step_length_s = {step_s}
[gym]
id = "{environment}"
[agents.car]
agent = "chasing_cars:SignalDriver"
"""
CARS = ("chasing_cars:ChasingCars", chasing_cars.STEP_S, chasing_cars.DURATION_S, chasing_cars.REQUIREMENTS)
TRANSMISSION = ("transmission:Transmission", transmission.STEP_S, transmission.DURATION_S, transmission.REQUIREMENTS)
BENCHMARKS = {name: benchmark for benchmark in (CARS, TRANSMISSION) for name in benchmark[3]}
PIECE_S = 5.0
_FINE_STEP_S = 0.1


class Trials:
    """Runs the trials of hunts in this process; the sampler learns from each before it proposes the next.

    Args:
        folder: folder for the scenario.
        trials: greatest number of trials of a hunt.
    """

    def __init__(self, folder: Path, trials: int) -> None:
        self._folder, self._trials = folder, trials

    def first_violation(self, name: str, sampler: str, repetition: int) -> TrialSpec | None:
        """Return the first trial with a violation; None if there is none within the budget."""
        environment, step_s, duration_s, requirements = BENCHMARKS[name]
        text = SCENARIO.format(step_s=step_s, environment=environment)
        (self._folder / "scenario.toml").write_text(text, encoding="utf-8")
        signal = f"signal:0:1:points={round(duration_s / PIECE_S)}:kind=constant"
        request = Request(
            scenario=self._folder, requirements=(f"{name}={requirements[name]}",), sampler=sampler, seed=repetition,
            trials=self._trials, max_steps=round(duration_s / step_s), arguments={"throttle": signal, "brake": signal},
        )  # fmt: skip
        scenario, settings = plan(request)
        worker = WorkerSettings(
            scenario=scenario, oracles=settings.oracles, crash_on=settings.crash_on, scratch=self._folder
        )
        parts, chosen = Parts(worker), sampler_of(settings)
        simulator = parts.simulator()
        for number in range(self._trials):
            spec = spec_of(number, settings, chosen)
            with Episode(
                spec, simulator=simulator, make_agent=parts.agent, oracles=parts.oracles(), crash_on=worker.crash_on
            ) as episode:
                result = episode.start()
                while result is None:
                    result = episode.step()
            if result.outcome == REQUIREMENT:
                return spec
            assert result.robustness is not None, result.summary
            chosen.tell(result)
        return None


def is_confirmed(name: str, spec: TrialSpec) -> bool:
    """Return whether the inputs violate a requirement of the cars in a simulation with finer steps, too."""
    _, _, duration_s, requirements = BENCHMARKS[name]
    inputs = fold_signals(spec.arguments["car"])
    signals = [signal for name in ("throttle", "brake") if isinstance(signal := inputs[name], InputSignal)]
    env = chasing_cars.ChasingCars(integration_s=0.0025, step_s=_FINE_STEP_S)
    _, info = env.reset()
    rows = [info]
    for step in range(round(duration_s / _FINE_STEP_S)):
        # The agent of the hunt changes its inputs only at the steps of the environment.
        time_s = step * _FINE_STEP_S // chasing_cars.STEP_S * chasing_cars.STEP_S
        _, _, _, _, info = env.step(np.array([signal(time_s) for signal in signals]))
        rows.append(info)
    trace = {key: np.array([row[key] for row in rows]) for key in info}
    return not parse(requirements[name]).satisfied(trace, _FINE_STEP_S)


def main() -> None:
    """Print a row per requirement and sampler."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=300)
    parser.add_argument("--repetitions", type=int, default=10)
    parser.add_argument("--requirements", default=",".join(BENCHMARKS))
    parser.add_argument("--samplers", default="random,guided")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    print("| requirement | sampler | violated | mean | median | confirmed |\n| --- | --- | --- | --- | --- | --- |")
    rows: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory() as temporary:
        hunts = Trials(Path(temporary), given.trials)
        for name in given.requirements.split(","):
            for sampler in given.samplers.split(","):
                found = [hunts.first_violation(name, sampler, number) for number in range(given.repetitions)]
                violating = [spec for spec in found if spec is not None]
                done = [spec.number + 1 for spec in violating]
                rows.append({"requirement": name, "sampler": sampler, "trials": done, "of": len(found)})
                figures = f"{statistics.mean(done):.1f} | {statistics.median(done):g}" if done else "| "
                confirmed = sum(is_confirmed(name, spec) for spec in violating) if name.startswith("CC") else ""
                print(f"| {name} | {sampler} | {len(done)} of {len(found)} | {figures} | {confirmed} |", flush=True)
                if given.json is not None:
                    given.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
