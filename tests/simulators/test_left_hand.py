"""Traffic that keeps to the left: SUMO mirrors everything, and left is left all the same."""

from __future__ import annotations

import shutil
from contextlib import closing
from pathlib import Path

import pytest

from crashhunt.scenario import load_scenario
from crashhunt.simulators.sumo import SumoSimulator

NET = Path(__file__).with_name("nets") / "left.net.xml"
SCENARIO = """
schema = 1
simulator = "sumo"
step_length_s = 0.1

[sumo]
net = "left.net.xml"
routes = ["r.rou.xml"]
options = { %s }

[agents.ego]
agent = "keep-lane"
type = "car"
edges = ["st"]
depart_lane = "1"
depart_pos = "50"
depart_speed = "10"
action = "%s"
"""


@pytest.mark.parametrize("action", ["continuous", "meta"])
@pytest.mark.parametrize("options", ["", "lateral-resolution = 0.8"])
def test_a_change_to_the_left_is_one(tmp_path, options, action):
    shutil.copy(NET, tmp_path)
    (tmp_path / "r.rou.xml").write_text('<routes><vType id="car" sigma="0" speedFactor="1"/></routes>')
    (tmp_path / "scenario.toml").write_text(SCENARIO % (options, action))
    stage = tmp_path / "stage"
    stage.mkdir()
    with closing(SumoSimulator(load_scenario(str(tmp_path)), stage)) as simulator:
        for side in (1, -1):
            observations, *_ = simulator.reset(seed=1, options={})
            before = observations["ego"][0]
            y = simulator.scene().points[0][1]
            form, step = simulator.actions["ego"], None
            for number in range(40):
                turn = number == 0
                meant = (10.0, side if turn else 0) if action == "continuous" else (1 - side) if turn else 1
                step = simulator.step({"ego": form.encode(meant)})
            moved = simulator.scene().points[0][1] - y  # it drives towards x
            assert 2.0 < side * moved < 3.3  # on the sublanes, most of it
            shown = step[0]["ego"][0]
            assert before[2] == pytest.approx(3.2)  # right of the leftmost lane, of three
            assert shown[2] - before[2] == pytest.approx(-moved, abs=1e-3)
