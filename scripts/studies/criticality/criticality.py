"""How well measures of a trial that survived predict crashes of similar trials: ``scripts/studies/run criticality``.

Around each of many random trials that survived, others are run with every numeric argument moved by up to 5 % of its
range, half of them with the seed of that trial. What is told is the rank correlation (Spearman) of a measure of the
trial with the share of its neighbours that crash, with an interval of 95 % over the trials (bootstrap). A neighbourhood
has few trials, so that its share is itself uncertain: even the best measure would not reach 1. Where an agent decides
coarsely, a neighbour with the same seed may be the same trial to the bit, and no neighbour: `unmoved` is their share.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from crashhunt.trial import Disturbance

if TYPE_CHECKING:
    from collections.abc import Mapping

    from crashhunt.episode import Episode
    from crashhunt.scenario import Scenario
    from crashhunt.trial import Distribution, TrialResult, Value

SEED = 12345
MOVED = 0.05  # of the range of an argument
PROBLEMS: dict[str, tuple[str, int, dict[str, Any]]] = {
    "loop": ("loop", 250, {}),
    "loop, changing lanes": ("loop", 300, {"agent": "crashhunt.agents:LaneChanger"}),
    "loop, following": ("loop", 250, {"agent": "crashhunt.agents:CarFollowing"}),
    "intersection": ("intersection", 250, {}),
    "merge": ("merge", 300, {}),
    "merge-highway-env": ("merge-highway-env", 60, {}),
    "loop, 1 s steps": ("loop", 40, {"step_length_s": 1.0}),
    "intersection, 1 s steps": ("intersection", 40, {"step_length_s": 1.0}),
    "intersection-highway-env, 1 s steps": ("intersection-highway-env", 13, {"policy_frequency": 1}),
    "roundabout, 1 s steps": ("roundabout", 11, {"policy_frequency": 1}),
}
"""Title to scenario, steps, and what is changed of it."""
VARIED = {
    "crashhunt.agents:LaneChanger": {"blind_spot_m": "0:10", "desired_speed": "12:25", "patience_s": "1:10"},
    "crashhunt.agents:CarFollowing": {"delay_s": "0:1", "headway_s": "0.5:2.5", "max_brake": "3:8"},
}
PROBES = (
    ("brake", "ahead", 2.0, 2.0), ("brake", "ahead", 4.0, 2.0), ("brake", "ahead", 6.0, 2.0),
    ("late_observation", "itself", 1.0, 2.0), ("late_action", "itself", 1.0, 2.0),
)  # fmt: skip
"""What every copy is asked with --probes: kind, who, how strong, and for how many s."""
PROBE_S, FOLLOWED_S = 4.0, 5.0
MEASURES = ("danger", "time_to_collision_s", "gap_m", "required_deceleration")


class Place:
    """Runs trials of one problem in this process.

    Args:
        problem: its title.
        folder: for its files.
    """

    def __init__(self, problem: str, folder: Path) -> None:
        from crashhunt.episode import Parts, WorkerSettings
        from crashhunt.recording import BlackBox
        from crashhunt.trial import CRASHES, parse_spec

        name, self._steps, changes = PROBLEMS[problem]
        scenario = changed(name, changes)
        oracles = ("reported-collision", "overlap", "off-road")
        self._parts = Parts(WorkerSettings(scenario=scenario, oracles=oracles, crash_on=CRASHES, scratch=folder))
        self._parts.load()
        self._simulator = self._parts.simulator()
        self._box = BlackBox(folder / "blackbox.bin")
        self._agents = list(scenario.agents)
        space: dict[tuple[str, str], Distribution | None] = {
            ("", name): argument.distribution for name, argument in scenario.scenario_arguments().items()
        }
        for agent in scenario.agents:
            known = scenario.agent_arguments(agent)
            space |= {(agent, name): argument.distribution for name, argument in known.items()}
            varied = VARIED.get(str(changes.get("agent", "")), {})
            space |= {(agent, name): parse_spec(spec, "float") for name, spec in varied.items()}
        self.space = {key: found for key, found in sorted(space.items()) if found is not None}

    def draw(self, rng: np.random.Generator) -> dict[tuple[str, str], Value]:
        """Draw arguments."""
        return {key: distribution.sample(rng) for key, distribution in self.space.items()}

    def move(self, values: Mapping[tuple[str, str], Value], rng: np.random.Generator) -> dict[tuple[str, str], Value]:
        """Return arguments near some."""
        from crashhunt.trial import Range

        moved = dict(values)
        for key, distribution in self.space.items():
            if isinstance(distribution, Range):
                value, width = values[key], (distribution.high - distribution.low) * MOVED
                assert isinstance(value, int | float)
                near = min(distribution.high, max(distribution.low, value + rng.uniform(-width, width)))
                moved[key] = round(near) if isinstance(value, int) else float(near)
        return moved

    def run(self, values: Mapping[tuple[str, str], Value], seed: int, share: Share | None = None) -> TrialResult:
        """Run a trial, and have copies of it asked."""
        from crashhunt.episode import run_episode
        from crashhunt.trial import TrialSpec

        arguments: dict[str, dict[str, Value]] = {agent: {} for agent in self._agents}
        scenario: dict[str, Value] = {}
        for (agent, name), value in values.items():
            (arguments[agent] if agent else scenario)[name] = value
        self._box.begin(pid=os.getpid(), trial=0, started=time.monotonic())
        return run_episode(
            TrialSpec(number=0, seed=seed, arguments=arguments, scenario_arguments=scenario, max_steps=self._steps),
            simulator=self._simulator,
            make_agent=self._parts.agent,
            box=self._box,
            oracles=self._parts.oracles(),
            asking=[share] if share is not None else [],
        )


class Share:
    """Asks copies of a trial the same every few seconds.

    Attributes:
        asked: how many there were for whom somebody was there.
        crashed: how many of these crashed.
    """

    def __init__(self) -> None:
        self.asked = self.crashed = 0

    def is_due(self, episode: Episode) -> bool:
        """Whether copies are to be asked now."""
        return episode.steps > 0 and episode.steps % round(PROBE_S / episode.simulator.step_length_s) == 0

    def ask(self, episode: Episode) -> None:
        """Ask a copy each."""
        steps = round(FOLLOWED_S / episode.simulator.step_length_s)

        for what, who, strong, long in PROBES:
            one = Disturbance(
                step=episode.steps + 2, who=who, what=what, how_strong=strong, how_long=long, agent=episode.names[0]
            )
            answer = episode.fork(partial(follow, one, steps), observed=False).answer(60.0)
            if answer is None:
                raise RuntimeError("a copy has not answered")
            self.asked += bool(answer["there"])
            self.crashed += bool(answer["crashed"])

    def result(self, result: TrialResult) -> TrialResult:
        """Leave it as it is."""
        return result

    @property
    def share(self) -> float:
        """Of those that were asked, 0 where nobody was."""
        return self.crashed / max(1, self.asked)


def follow(one: Disturbance, steps: int, copy: Episode) -> dict[str, object]:
    """Be a copy: go on with a disturbance."""
    copy.disturb(one)
    there = True
    for _ in range(2 + steps):
        if copy.step() is not None:
            break
        if copy.steps == one.step and not copy.takes_place(one):
            there = False
            break
    return {"there": there, "crashed": copy.result is not None and copy.result.outcome.is_traffic_crash}


def changed(name: str, changes: Mapping[str, Any]) -> Scenario:
    """Return a shipped scenario with another agent, other steps or another frequency of decisions."""
    from crashhunt.scenario import load_scenario

    scenario = load_scenario(name)
    if "step_length_s" in changes:
        return replace(scenario, step_length_s=changes["step_length_s"])
    if "agent" in changes:
        return scenario.with_agents(dict.fromkeys(scenario.agents, str(changes["agent"])))
    if changes:
        (table,) = scenario.tables.values()
        config = {**vars_of(table)["config"], **changes}
        return scenario.with_table(replace(table, config=config))  # type: ignore[type-var]
    return scenario


def vars_of(table: object) -> dict[str, Any]:
    """The fields of a table."""
    from dataclasses import fields

    return {item.name: getattr(table, item.name) for item in fields(table)}  # type: ignore[arg-type]


def measure(problem: str, neighbourhoods: int, neighbours: int, seed: int, *, probes: bool = False) -> dict[str, Any]:
    """Measure one problem in this process."""
    from crashhunt.trial import Outcome

    rng = np.random.default_rng(seed)
    measures = (*MEASURES, "probes") if probes else MEASURES
    found: dict[str, list[float]] = {name: [] for name in (*measures, "rate", "same")}
    ran = crashed = relevant_actors = unmoved = 0
    with tempfile.TemporaryDirectory(prefix="crashhunt-danger-") as folder:
        place = Place(problem, Path(folder))
        while len(found["rate"]) < neighbourhoods:
            values, own = place.draw(rng), int(rng.integers(2**31))
            share = Share() if probes else None
            result = place.run(values, own, share)
            ran += 1
            crashed += result.outcome.is_traffic_crash
            if result.outcome not in (Outcome.SURVIVED, Outcome.FINISHED):
                continue
            hits: list[list[bool]] = [[], []]
            for number in range(neighbours):
                moved = place.move(values, rng)
                near = place.run(moved, own if number % 2 == 0 else int(rng.integers(2**31)))
                relevant_actors += number % 2 == 0
                unmoved += number % 2 == 0 and near.digest == result.digest
                if near.outcome is not Outcome.INVALID:
                    hits[number % 2].append(near.outcome.is_traffic_crash)
            if not hits[0] or not hits[1]:
                continue
            closest = result.closest
            found["danger"].append(result.danger or 0.0)
            found["time_to_collision_s"].append(-min(closest.time_to_collision_s, 1e3))
            found["gap_m"].append(-min(closest.gap_m, 1e3))
            found["required_deceleration"].append(min(closest.required_deceleration, 1e3))
            if share is not None:
                found["probes"].append(share.share)
            found["rate"].append(float(np.mean([*hits[0], *hits[1]])))
            found["same"].append(float(np.mean(hits[0])))
    return {"problem": problem, "neighbourhoods": neighbourhoods, "neighbours": neighbours, "crash_rate": crashed / ran,
            "neighbour_rate": float(np.mean(found["rate"])), "unmoved": unmoved / relevant_actors,
            "cpu_s": round(time.process_time(), 1),
            "correlations": {name: correlation(found[name], found["rate"]) for name in measures},
            "with_the_same_seed": {name: correlation(found[name], found["same"]) for name in measures}}  # fmt: skip


def correlation(measured: list[float], rates: list[float]) -> list[float | None]:
    """The rank correlation, and the ends of its interval; None where one of the two is constant."""
    from scipy.stats import rankdata

    def ranked(one: np.ndarray[Any, Any], two: np.ndarray[Any, Any]) -> float:
        left, right = rankdata(one), rankdata(two)
        spread = left.std() * right.std()
        return float(np.mean((left - left.mean()) * (right - right.mean())) / spread) if spread else math.nan

    one, two, rng = np.array(measured), np.array(rates), np.random.default_rng(0)
    again = [ranked(one[rows], two[rows]) for rows in rng.integers(len(one), size=(400, len(one)))]
    low, high = np.nanpercentile(again, [2.5, 97.5]) if not np.isnan(again).all() else (math.nan, math.nan)
    return [round(value, 2) if math.isfinite(value) else None for value in (ranked(one, two), float(low), float(high))]


def table(rows: list[dict[str, Any]], key: str = "correlations") -> str:
    """Return the results as Markdown."""
    measures = list(rows[0][key]) if rows else MEASURES
    columns = " | ".join(measures)
    lines = [f"| problem | crashes | neighbourhoods | {columns} |", "| --- |" + " --- |" * (2 + len(measures))]
    for row in rows:
        cells = [
            f"{middle:.2f} ({low:.2f} to {high:.2f})" if middle is not None else "-"
            for middle, low, high in (row[key][name] for name in measures)
        ]
        size = f"{row['neighbourhoods']} of {row['neighbours']}"
        lines.append(f"| {row['problem']} | {100 * row['crash_rate']:.0f} % | {size} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Measure what was asked for, each problem in a process of its own: libsumo is one simulation per process."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("problems", nargs="*", choices=[*PROBLEMS, []], metavar="NAME", help="; ".join(PROBLEMS))
    parser.add_argument("--neighbourhoods", type=int, default=120, metavar="N")
    parser.add_argument("--neighbours", type=int, default=12, metavar="N", help="in each neighbourhood")
    parser.add_argument("--seed", type=int, default=SEED, metavar="N")
    parser.add_argument("--quick", action="store_true", help="a few trials of two problems: shows that nothing broke")
    parser.add_argument("--probes", action="store_true", help="ask copies of each trial as well; see PROBES")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    problems = options.problems or (["loop", "merge-highway-env"] if options.quick else list(PROBLEMS))
    size = (4, 2) if options.quick else (options.neighbourhoods, options.neighbours)
    if options.child:
        sys.stdout.write(json.dumps(measure(problems[0], size[0], size[1], options.seed, probes=options.probes)))
        return
    rows = []
    for problem in problems:
        words = ["--child", problem, "--neighbourhoods", str(size[0]), "--neighbours", str(size[1])]
        command = [sys.executable, __file__, *words, "--seed", str(options.seed)]
        command += ["--probes"] if options.probes else []
        alone = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # a process with threads has no copies
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE, env={**os.environ, **alone})
        rows.append(json.loads(done.stdout.splitlines()[-1]))
    print(json.dumps({"results": rows}) if options.json else table(rows))


if __name__ == "__main__":
    main()
