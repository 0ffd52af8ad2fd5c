"""Measures steps of SMARTS on the network of the scenario ``intersection``, for a comparison with `scripts/bench`.

SMARTS is installed in a folder of its own: ``pip install --target FOLDER "smarts[gymnasium,sumo]==2.0.1"``.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

NETWORK = Path(__file__).resolve().parents[3] / "scenarios" / "intersection" / "intersection.net.xml"
TRAFFIC = """
from smarts.sstudio import gen_scenario
from smarts.sstudio.sstypes import Flow, Mission, Route, Scenario, Traffic, TrafficActor

turns = {"west": "south east north", "east": "north west south", "north": "west south east", "south": "east north west"}
flows = [
    Flow(
        route=Route(begin=(f"from-{source}", 0, 0), end=(f"to-{target}", 0, "max")),
        rate=(500 if source in ("west", "east") else 250) * share, begin=0, end=4000, actors={TrafficActor("car"): 1},
    )
    for source, targets in turns.items()
    for target, share in zip(targets.split(), (0.2, 0.6, 0.2))
]
mission = Mission(Route(begin=("from-west", 0, 5), end=("to-east", 0, "max")), start_time=60.0)
gen_scenario(Scenario(traffic={"all": Traffic(flows=flows)}, ego_missions=[mission]), output_dir=".")
"""


def measure(folder: str, *, sensors: bool) -> tuple[float, float]:
    """Return the CPU time of a step in µs, with that of SUMO's process, and the mean number of vehicles.

    Args:
        folder: folder of the scenario.
        sensors: whether ego has the sensors that correspond to the six parts of `scripts/bench observation`.
    """
    import psutil
    from smarts.core import agent_interface as of
    from smarts.core.controllers import ActionSpaceType
    from smarts.core.scenario import Scenario
    from smarts.core.smarts import SMARTS
    from smarts.core.sumo_traffic_simulation import SumoTrafficSimulation

    chosen = {
        "neighborhood_vehicle_states": of.NeighborhoodVehicles(radius=100),
        "waypoint_paths": of.Waypoints(lookahead=50),
        "road_waypoints": of.RoadWaypoints(horizon=50),
        "signals": of.Signals(lookahead=100.0),
    }
    ego = of.AgentInterface(
        max_episode_steps=500, accelerometer=False, lane_positions=sensors,
        action=ActionSpaceType.LaneWithContinuousSpeed, **chosen if sensors else {},
    )  # fmt: skip
    simulation = SMARTS({"ego": ego}, traffic_sims=[SumoTrafficSimulation(headless=True)])
    simulation.reset(next(Scenario.scenario_variations([folder], ["ego"])))

    def cpu_s() -> float:
        times = [one.cpu_times() for one in (process, *process.children(recursive=True))]
        return float(sum(one.user + one.system for one in times))

    process, steps, vehicles, is_done = psutil.Process(), 0, 0, False
    began = cpu_s()
    while not is_done:
        _, _, done, _ = simulation.step({"ego": (10.0, 0)})
        steps, vehicles, is_done = steps + 1, vehicles + len(simulation.vehicle_index.vehicles), done["ego"]
    found = 1e6 * (cpu_s() - began) / steps, vehicles / steps
    simulation.destroy()
    return found


def main() -> None:
    """Print the CPU time of a step, with and without sensors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder in which SMARTS is installed")
    library = parser.parse_args().folder.resolve()
    sumo = library / "sumo"
    sys.path[:0] = [str(library), str(sumo / "tools")]
    path = {"PATH": f"{sumo / 'bin'}:{os.environ['PATH']}", "PYTHONPATH": ":".join(sys.path[:2])}
    os.environ.update(SUMO_HOME=str(sumo), **path)
    with tempfile.TemporaryDirectory() as folder:
        shutil.copyfile(NETWORK, Path(folder) / "map.net.xml")
        subprocess.run([sys.executable, "-c", TRAFFIC], cwd=folder, check=True, stdout=subprocess.DEVNULL)
        for sensors in (True, False):
            spent, vehicles = measure(folder, sensors=sensors)
            print(f"{'with' if sensors else 'without'} sensors: {spent:,.0f} µs a step, {vehicles:.1f} vehicles")


if __name__ == "__main__":
    main()
