"""Towns that nobody has tuned anything for: made by SUMO's netgenerate, with traffic at random, and an agent that errs.

Its agent follows whoever is ahead, and heeds neither lights nor priority; from its 30th step on it is asleep in some
trials, and changes lanes without looking in others. The drivers around it err at random.
"""

from __future__ import annotations

import random
import shutil
import subprocess
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

if TYPE_CHECKING:
    from pathlib import Path

TOWNS = {
    "priority": ("--grid", "--grid.number", "4", "--grid.length", "110", "-L", "2", "-j", "priority"),
    "lights": ("--grid", "--grid.number", "4", "--grid.length", "130", "-L", "2", "-j", "traffic_light"),
    "right before left": (
        "--spider", "--spider.arm-number", "6", "--spider.circle-number", "3", "--spider.space-radius", "90",
        "-L", "1", "-j", "right_before_left",
    ),
    "random": ("--rand", "--rand.iterations", "80", "--rand.max-distance", "170", "-L", "2", "--seed", "7"),
}  # fmt: skip
"""Name to the arguments of netgenerate."""
AGENT_HEAD = """\
from crashhunt.agents import CarFollowing


class Erring(CarFollowing):
    def __init__(self, defect: str = "none", observation_space=None, action_space=None, step_length_s: float = 0.1):
        super().__init__(
            desired_speed=12.0, observation_space=observation_space, action_space=action_space,
            step_length_s=step_length_s,
        )
"""
"""The beginning of an agent with a defect, up to the end of the base class's constructor."""
AGENT = f"""\
{AGENT_HEAD}        self.defect = defect

    def reset(self, seed):
        super().reset(seed)
        self.step = 0

    def act(self, observation):
        action = super().act(observation)
        self.step += 1
        if self.step < 30 or self.defect == "none":
            return action
        if self.defect == "asleep":
            return 14.0, 0
        return action[0], 1 if self.step // 20 % 2 else -1
"""
_SECONDS, _PERIOD_S = 80, 0.35


def make_town(name: str, folder: Path) -> Path:
    """Make a town and return its .sumocfg; beside it is ``erring.py``, whose ``Erring`` is the agent.

    Raises:
        FileNotFoundError: netgenerate is missing.
    """
    program = shutil.which("netgenerate")
    if program is None:
        raise FileNotFoundError("netgenerate is missing: pip install 'crashhunt[maps]', and have it on the PATH")
    folder.mkdir(parents=True, exist_ok=True)
    network = folder / "town.net.xml"
    words = [program, *TOWNS[name], "--no-turnarounds", "true", "--output-file", str(network)]
    subprocess.run(words, check=True, capture_output=True)
    write_traffic(network, folder, seed=name, seconds=_SECONDS, step_s=0.1)
    (folder / "erring.py").write_text(AGENT, encoding="utf-8")
    return folder / "town.sumocfg"


def write_traffic(network: Path, folder: Path, *, seed: str, seconds: float, step_s: float) -> None:
    """Write trips at random on a network, and ``town.sumocfg``, which names both.

    Args:
        network: of which the folder has a copy named ``town.net.xml``.
        folder: into which the files are written.
        seed: of the trips.
        seconds: how long vehicles depart, in s.
        step_s: length of a step, in s.
    """
    edges = [
        edge.get("id", "")
        for edge in ET.parse(network).getroot().findall("edge")
        if not edge.get("function") and any(lane.get("allow") != "pedestrian" for lane in edge.findall("lane"))
    ]
    rng = random.Random(seed)
    trips = ET.Element("routes")
    for number in range(round(seconds / _PERIOD_S)):
        start, end = rng.sample(edges, 2)
        trip = {"id": f"v{number}", "depart": f"{number * _PERIOD_S:g}", "from": start, "to": end}
        ET.SubElement(trips, "trip", {**trip, "departLane": "best", "departSpeed": "max"})
    ET.ElementTree(trips).write(folder / "town.rou.xml")
    config = ET.Element("configuration")
    files = ET.SubElement(config, "input")
    ET.SubElement(files, "net-file", value="town.net.xml")
    ET.SubElement(files, "route-files", value="town.rou.xml")
    ET.SubElement(ET.SubElement(config, "time"), "step-length", value=f"{step_s:g}")
    ET.SubElement(ET.SubElement(config, "processing"), "ignore-route-errors", value="true")
    ET.ElementTree(config).write(folder / "town.sumocfg")
