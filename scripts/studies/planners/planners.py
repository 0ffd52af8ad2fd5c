"""Hunt for crashes of planners of others, and print a row for each hunt.

Prints the table of crashhunt/guide/reference/evaluation/planner-evaluation.md. Each planner needs its own package: see
the page. The hunts are kept in the folder ``planners``, and each takes at most TIME, such as 60s. More options go to
``crashhunt run``, such as ``--disturb brake=0.02``. ``traffic`` instead of a planner counts the collisions of SUMO's own
cars in as many episodes.
usage: scripts/studies/run planners PLANNER SCENARIO TRIALS [TIME [OPTION...]]
"""

from __future__ import annotations

import json
import os
import re
import resource
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

HERE = Path(__file__).parent
PROGRAM = HERE.parents[2] / "crashhunt" / "agents" / "planners" / "commonroad_program.py"
STEPS = 300
PLANNERS = {
    "fiss_plus": ("crashhunt.agents.planners.fiss_agent:FissPlanner", "trajectory", ["desired_speed=10:25"]),
    "fop_plus": ("crashhunt.agents.planners.fiss_agent:FopPlanner", "trajectory", ["desired_speed=10:25"]),
    "mpc": (
        "crashhunt.agents.planners.mpc_agent:Mpc",
        "acceleration_steering",
        ["desired_speed=10:25", "headway=0.3:1.5"],
    ),
    "frenetix": ("crashhunt.agents.planners.frenetix_agent:Frenetix", "trajectory", ["desired_speed=10:25"]),
    "commonroad": (f"exec:commonroad/bin/python {PROGRAM}", "trajectory", []),
    "sb3": ("sb3_agent:Policy", "acceleration_steering", ["path=policy.zip"]),
    "sumo": ("sumo_agent:SumoDriver", "sumo", []),
}
"""Agent, form of actions and arguments of each planner; ``commonroad`` is a virtual environment."""


def hunt(planner: str, scenario: str, trials: int, time: str = "", *options: str) -> str:
    """Return a row of the table: planner, scenario, trials, steps per second of CPU, outcomes and first crash."""
    agent, action, arguments = PLANNERS[planner]
    if Path(scenario).stem.startswith("motorway"):
        arguments = [one.replace("=10:25", "=20:34") for one in arguments]
    name = re.sub(r"[^\w=.]+", "-", " ".join([planner, Path(scenario).stem, *options]))
    out = Path("planners") / name
    out.parent.mkdir(exist_ok=True)
    command = [
        "crashhunt", "run", str(out), "1", str(trials), str(STEPS), "--scenario", scenario, "--agent", agent,
        "--action", action, *(word for one in arguments for word in ("--arg", one)), "--seed", "1", "--keep-going",
        "--timeout", "900", *(("--for", time) if time else ()), *options, "--json",
    ]  # fmt: skip
    if planner == "commonroad":
        command.append("--reuse")  # it imports for seconds
    path = os.pathsep.join([str(HERE), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True)
    if done.returncode == 2:
        raise SystemExit(done.stderr)
    found, used = json.loads(done.stdout), resource.getrusage(resource.RUSAGE_CHILDREN)
    outcomes = ", ".join(f"{name} {count}" for name, count in found["outcomes"].items() if count)
    rate = found["steps_total"] / (used.ru_utime + used.ru_stime)
    first = min((one.name for one in (out / "crashes").glob("*")), default="-")
    return f"| {name} | {found['trials_run']} | {rate:.0f} | {outcomes} | {first} |"


def traffic(scenario: str, episodes: int) -> str:
    """Return a row of the table: collisions of SUMO's cars in sight with each other, and the hours that they drove."""
    from crashhunt.scenario import argument_values, load_scenario
    from crashhunt.sumo import SumoSimulator

    loaded, pairs, hours = load_scenario(scenario), 0, 0.0
    loaded = replace(loaded, agents={"ego": replace(loaded.agents["ego"], action="sumo")})
    with tempfile.TemporaryDirectory() as folder:
        simulator = SumoSimulator(loaded, Path(folder))
        for seed in range(episodes):
            simulator.reset(seed=seed, options={"arguments": argument_values(loaded)})
            for _ in range(STEPS):
                if not simulator.agents:
                    break
                simulator.step({"ego": simulator.actions["ego"].encode(None)})
                scene = simulator.scene()
                hours += (len(scene.roster.index) - 1) * loaded.step_length_s / 3600
                pairs += sum("ego" not in (one.collider, one.victim) for one in scene.contacts)
        simulator.close()
    return f"| traffic | {scenario} | {episodes} | {pairs} collisions in {hours:.1f} h |"


if __name__ == "__main__":
    which, place, count, *rest = sys.argv[1:]
    row = traffic(place, int(count)) if which == "traffic" else hunt(which, place, int(count), *rest)
    print(row, flush=True)
