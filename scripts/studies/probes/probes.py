"""How many steps it takes to the first crash by disturbance, with probes and branches, and without.

Both ways run the same trials in the same order, with the same random disturbances. Without, the first trial ends it
that crashes with them and not without; with, so does the first copy, once its specification has crashed at the same
step from the start. Steps of copies, and those of trials that are run again to see that, count as those of trials do,
so that how busy a machine is makes no difference. Where nothing has crashed after the most steps, these are taken, so
that a long search counts for less than it would have taken. What is told is the geometric mean of the ratio, over pairs
and over problems.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable

    from crashhunt.episode import Brancher, Episode, Prober
    from crashhunt.trial import Disturbance, Outcome, TrialResult, TrialSpec, Value

RATES = ("brake=0.02", "cut_in=0.01", "late_observation=0.01", "stop=0.01", "unseen=0.01")
FOLLOWING = "crashhunt.agents:CarFollowing"
PROBLEMS: dict[str, tuple[str, str, dict[str, Value], int]] = {
    "merge": ("merge", "", {}, 300),
    "merge, short headway": ("merge", "", {"headway_s": 1.0}, 300),
    "merge, IDM": ("merge", "crashhunt.agents:IntelligentDriver", {}, 300),
    "loop, following": ("loop", FOLLOWING, {}, 300),
    "loop, late": ("loop", FOLLOWING, {"delay_s": 0.8}, 300),
    "intersection": ("intersection", "", {}, 250),
}
"""Title to scenario, agent where it is another, arguments that are not the defaults, and steps of a trial."""
PROBE_S = 4.0
_AGENT_OF_SEED = 0x66697273


class FoundError(Exception):
    """A copy has crashed.

    Args:
        what: it is.
        here: how many steps its trial had taken.
        disturbances: with which the trial crashes from the start as well.
        outcome: of the copy.
        step: at which it ended.
    """

    def __init__(self, what: str, here: int, disturbances: tuple[Disturbance, ...], outcome: str, step: int) -> None:
        super().__init__(what)
        self.what, self.here, self.disturbances, self.outcome, self.step = what, here, disturbances, outcome, step


class Place:
    """Runs trials of one problem in this process.

    Args:
        problem: its title.
        folder: for its files.
    """

    def __init__(self, problem: str, folder: Path) -> None:
        from crashhunt.base.plugins import locate
        from crashhunt.episode import Parts, WorkerSettings
        from crashhunt.oracles import DEFAULT_ORACLES
        from crashhunt.plans import disturber
        from crashhunt.recording import BlackBox
        from crashhunt.scenario import load_scenario
        from crashhunt.trial import CRASHES, signature_of

        name, agent, given, self.steps = PROBLEMS[problem]
        scenario = load_scenario(name)
        (self._ego,) = scenario.agents
        scenario = scenario.with_agents({self._ego: agent}) if agent else scenario
        known = {} if agent else {name: one.default for name, one in scenario.agent_arguments(self._ego).items()}
        declared = signature_of(locate("agents", scenario.agents[self._ego].agent)).arguments
        self._given = {name: value for name, value in known.items() if value is not None and name in declared} | given
        self._varied = {name: one.distribution for name, one in scenario.scenario_arguments().items()}
        settings = WorkerSettings(scenario=scenario, oracles=DEFAULT_ORACLES, crash_on=CRASHES, scratch=folder)
        self._parts = Parts(settings)
        self._parts.load()
        self._simulator = self._parts.simulator()
        self._box = BlackBox(folder / "blackbox.bin")
        found = disturber(scenario, RATES, (self._ego,))
        assert found is not None
        self._disturber = found

    def specification(self, rng: np.random.Generator) -> TrialSpec:
        """Draw a trial: traffic and disturbances; the agent is always the same."""
        from crashhunt.trial import TrialSpec

        seed = int(rng.integers(2**31))
        traffic = {name: one.sample(rng) for name, one in self._varied.items() if one is not None}
        planned = self._disturber.draw(seed, self.steps)
        return TrialSpec(
            number=0,
            seed=seed,
            arguments={self._ego: self._given},
            scenario_arguments=traffic,
            max_steps=self.steps,
            disturbances=planned,
        )

    def run(self, spec: TrialSpec, **asking: Any) -> TrialResult:
        """Run a trial."""
        from crashhunt.episode import run_episode

        self._box.begin(pid=os.getpid(), trial=0, started=time.monotonic())
        return run_episode(
            spec, simulator=self._simulator, make_agent=self._parts.agent, box=self._box,
            oracles=self._parts.oracles(), **asking,
        )  # fmt: skip

    def first_crash(self, repetition: int, most: int, *, copies: bool) -> tuple[int, str, int]:
        """Return after how many steps the first crash by disturbance came, of what, and how many did not confirm."""
        from crashhunt.trial import CRASHES

        rng, total, failed = np.random.default_rng([_AGENT_OF_SEED, repetition]), 0, 0
        while total < most:
            spec = self.specification(rng)
            probes, branches = asking(CRASHES) if copies else (None, None)
            try:
                result = self.run(spec, asking=[one for one in (probes, branches) if one is not None])
            except FoundError as found:
                assert probes is not None
                assert branches is not None
                again = self.run(replace(spec, disturbances=found.disturbances))
                total += found.here + probes._stress.steps + branches._branches.steps + again.steps
                if (str(again.outcome), again.steps) == (found.outcome, found.step):
                    return total, found.what, failed
                failed += 1
                continue
            total += result.steps
            total += result.stress.steps if result.stress is not None else 0
            total += result.branches.steps if result.branches is not None else 0
            for asks in (probes, branches):
                if asks is not None and asks.fork_runner.why_not:
                    raise RuntimeError(asks.fork_runner.why_not)
            if result.outcome.is_traffic_crash and result.disturbed:
                plain = self.run(replace(spec, disturbances=()))
                total += plain.steps
                if not plain.outcome.is_traffic_crash:
                    return total, "a trial", failed
        return most, "", failed


def asking(crashes: tuple[Outcome, ...]) -> tuple[Prober, Brancher]:
    """Return what asks copies of a trial, and raises `FoundError` at the first that crashes by disturbance."""
    from crashhunt.episode import BUDGET_BESIDE, Brancher, Prober
    from crashhunt.trial import in_turn

    class Probes(Prober):
        def _copy(self, episode: Episode, disturbance: Any) -> tuple[str, int]:
            outcome, step = super()._copy(episode, disturbance)
            # Whether it would have crashed anyway is asked afterwards, as ever: then it is the next trial's turn.
            if outcome and disturbance is not None and (self._goes_on or not super()._copy(episode, None)[0]):
                planned = in_turn([*episode.spec.disturbances, disturbance])
                raise FoundError("a probe", episode.steps, planned, outcome, step)
            return outcome, step

    class Branches(Brancher):
        def _record_crash(self, episode: Episode, found: Any) -> None:
            super()._record_crash(episode, found)
            branch = self._branches.crashes[-1]
            raise FoundError("a branch", episode.steps, branch.disturbances, branch.outcome, branch.step)

    return Probes(PROBE_S, crashes, lambda _: None, BUDGET_BESIDE), Branches(RATES, crashes, lambda _: None)


def measure(problem: str, first: int, last: int, most: int) -> None:
    """Measure some repetitions of one problem in this process; print a line of JSON each."""
    with tempfile.TemporaryDirectory(prefix="crashhunt-first-") as folder:
        place = Place(problem, Path(folder))
        for repetition in range(first, last):
            alone, what_alone, _ = place.first_crash(repetition, most, copies=False)
            copies, what_copies, failed = place.first_crash(repetition, most, copies=True)
            found = {"problem": problem, "repetition": repetition, "most": most, "alone": alone, "copies": copies,
                     "by_alone": what_alone, "by_copies": what_copies, "not_confirmed": failed}  # fmt: skip
            print(json.dumps(found), flush=True)


def ratios(rows: list[dict[str, Any]]) -> dict[str, tuple[int, float, float, float]]:
    """Of each problem: pairs, geometric means of both, and of their ratio."""
    found = {}
    for problem in dict.fromkeys(row["problem"] for row in rows):
        mine = [row for row in rows if row["problem"] == problem]
        alone, copies = (np.log([row[way] for row in mine]).mean() for way in ("alone", "copies"))
        found[problem] = len(mine), float(np.exp(alone)), float(np.exp(copies)), float(np.exp(copies - alone))
    return found


def table(rows: list[dict[str, Any]]) -> str:
    """Return the results as Markdown."""
    found = ratios(rows)
    lines = [
        "| problem | pairs | steps without | none found | steps with | none found | ratio |",
        "| --- |" + " --- |" * 6,
    ]
    for problem, (pairs, alone, copies, ratio) in found.items():
        none = [sum(row["problem"] == problem and not row[way] for row in rows) for way in ("by_alone", "by_copies")]
        lines.append(f"| {problem} | {pairs} | {alone:.0f} | {none[0]} | {copies:.0f} | {none[1]} | {ratio:.2f} |")
    whole = np.exp(np.mean([np.log(ratio) for *_, ratio in found.values()]))
    rng, logs = np.random.default_rng(0), dict[str, list[float]]()
    for row in rows:
        logs.setdefault(row["problem"], []).append(float(np.log(row["copies"] / row["alone"])))
    again = [np.mean([rng.choice(one, len(one)).mean() for one in logs.values()]) for _ in range(1000)]
    low, high = np.exp(np.percentile(again, [2.5, 97.5]))
    lines.append(f"\nGeometric mean of the ratio: {whole:.2f} ({low:.2f} to {high:.2f}).")
    return "\n".join(lines)


def measured(problems: Iterable[str], *, repetitions: int, most: int) -> list[dict[str, Any]]:
    """Measure problems, each in a process of its own: libsumo is one simulation per process."""
    rows: list[dict[str, Any]] = []
    for problem in problems:
        done = subprocess.run(
            [sys.executable, __file__, "--child", problem, "0", str(repetitions), str(most)],
            check=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        )  # fmt: skip
        rows += [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    return rows


def main() -> None:
    """Measure what was asked for, or show what has been."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("problems", nargs="*", help=f"some of {', '.join(PROBLEMS)}; all without")
    parser.add_argument("--repetitions", type=int, default=20)
    parser.add_argument("--most", type=int, default=12000, help="steps, after which a search is given up")
    parser.add_argument("--child", nargs=4, help=argparse.SUPPRESS)
    parser.add_argument("--lines", type=Path, help="show results that were kept, lines of JSON")
    parser.add_argument("--json", action="store_true", help="print lines of JSON")
    chosen = parser.parse_args()
    if chosen.child:
        problem, first, last, most = chosen.child
        measure(problem, int(first), int(last), int(most))
        return
    if chosen.lines is not None:
        rows = [json.loads(line) for line in chosen.lines.read_text(encoding="utf-8").splitlines()]
    else:
        rows = measured(chosen.problems or PROBLEMS, repetitions=chosen.repetitions, most=chosen.most)
    print("\n".join(map(json.dumps, rows)) if chosen.json else table(rows))


if __name__ == "__main__":
    main()
