"""Hunt for crashes of planners of others, and print a row for each hunt.

Prints the table of crashhunt/guide/reference/evaluation/planner-evaluation.md. Each planner needs its own package: see
the page. The hunts are kept in the folder ``planners``.
usage: scripts/studies/run planners PLANNER|all SCENARIO [TRIALS]   (40 trials unless given)
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent
SPEEDS, FAST = "desired_speed=10:25", "desired_speed=20:34"
PLANNERS = {
    "fiss_plus": ("fiss_agent:FissPlanner", "trajectory", ["planner=fiss_plus"]),
    "fop_plus": ("fiss_agent:FissPlanner", "trajectory", ["planner=fop_plus"]),
    "mpc": ("mpc_agent:Mpc", "acceleration_steering", ["headway=0.3:1.5"]),
    "frenetix": ("frenetix_agent:Frenetix", "trajectory", []),
    "commonroad": (f"exec:commonroad/bin/python {HERE / 'commonroad_program.py'}", "trajectory", []),
    "sb3": ("sb3_agent:Policy", "acceleration_steering", ["path=policy.zip"]),
    "sumo": ("sumo_agent:SumoDriver", "sumo", []),
}
"""Agent, form of actions and arguments of each planner; ``commonroad`` is a virtual environment."""
WITHOUT_SPEED = ("commonroad", "sb3", "sumo")


def hunt(planner: str, scenario: str, trials: int) -> str:
    """Return a row of the table: planner, scenario, trials, steps per second and outcomes of a hunt."""
    agent, action, arguments = PLANNERS[planner]
    given = [*arguments, *([] if planner in WITHOUT_SPEED else [FAST if scenario == "motorway" else SPEEDS])]
    out = Path("planners") / f"{planner}-{Path(scenario).stem}"
    command = [
        "crashhunt", "run", str(out), "1", str(trials), "300", "--scenario", scenario, "--agent", agent,
        "--action", action, *(word for one in given for word in ("--arg", one)), "--seed", "1", "--keep-going",
        "--timeout", "900", "--json",
    ]  # fmt: skip
    begin = time.monotonic()
    path = os.pathsep.join([str(HERE), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True)
    found = json.loads(done.stdout)
    outcomes = ", ".join(f"{name} {count}" for name, count in found["outcomes"].items() if count)
    return f"| {planner} | {scenario} | {found['trials_run']} | {found['steps_total'] / (time.monotonic() - begin):.0f} | {outcomes} |"


if __name__ == "__main__":
    which, scenario, *rest = sys.argv[1:]
    print("| planner | scenario | trials | steps/s | outcomes |\n| --- | --- | --- | --- | --- |")
    for planner in PLANNERS if which == "all" else [which]:
        print(hunt(planner, scenario, int(rest[0]) if rest else 40), flush=True)
