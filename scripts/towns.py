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

__all__ = ["AGENT", "TOWNS", "make_town"]

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
AGENT = """\
from crashhunt.agents import CarFollowing


class Erring(CarFollowing):
    def __init__(self, defect: str = "none", observation_space=None, action_space=None, step_length_s: float = 0.1):
        super().__init__(
            desired_speed=12.0, observation_space=observation_space, action_space=action_space,
            step_length_s=step_length_s,
        )
        self.defect = defect

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
    edges = [edge.get("id", "") for edge in ET.parse(network).getroot().findall("edge") if not edge.get("function")]
    rng = random.Random(name)
    trips = ET.Element("routes")
    for number in range(round(_SECONDS / _PERIOD_S)):
        start, end = rng.sample(edges, 2)
        depart = f"{number * _PERIOD_S:g}"
        trip = {"id": f"v{number}", "depart": depart, "from": start, "to": end}
        ET.SubElement(trips, "trip", {**trip, "departLane": "best", "departSpeed": "max"})
    ET.ElementTree(trips).write(folder / "town.rou.xml")
    config = ET.Element("configuration")
    files = ET.SubElement(config, "input")
    ET.SubElement(files, "net-file", value="town.net.xml")
    ET.SubElement(files, "route-files", value="town.rou.xml")
    ET.SubElement(ET.SubElement(config, "time"), "step-length", value="0.1")
    ET.SubElement(ET.SubElement(config, "processing"), "ignore-route-errors", value="true")
    ET.ElementTree(config).write(folder / "town.sumocfg")
    (folder / "erring.py").write_text(AGENT, encoding="utf-8")
    return folder / "town.sumocfg"
