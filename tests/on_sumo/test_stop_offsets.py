"""Stop lines before the end of their lane, as SUMO's element ``stopOffset`` sets them: SUMO's driver stops there."""

from __future__ import annotations

from pathlib import Path

import libsumo
import numpy as np
import pytest

from crashhunt.scenario import load_scenario
from crashhunt.sumo._lane_graph import lane_graph

OFFSET_M = 6.0
NET = (Path(__file__).parent / "nets" / "lights.net.xml").read_text()
ROUTES = """<routes><vType id="car" sigma="0"/>
<flow id="west" type="car" begin="0" end="60" period="1"><route edges="west middle east"/></flow></routes>"""
SCENARIO = """
schema = 1
simulator = "sumo"
step_length_s = 0.1
warmup_s = 38.0
sumo = { net = "n.net.xml", routes = ["r.rou.xml"] }
[agents.ego]
agent = "keep-lane"
type = "car"
edges = %s
action = "sumo"
observation = ["signals", "stop_line", "right_of_way"]
"""


@pytest.fixture
def scenario_of(sumo_runs, tmp_path):
    def make(edges, lane, attributes):
        tag = f'<lane id="{lane}" '
        before, after = NET.split(tag)
        own, rest = after.split("/>", 1)
        (tmp_path / "n.net.xml").write_text(
            f'{before}{tag}{own}><stopOffset value="{OFFSET_M}" {attributes}/></lane>{rest}'
        )
        return load_scenario(sumo_runs.write(tmp_path / "n.net.xml", ROUTES, {"scenario.toml": SCENARIO % edges}))

    return make


@pytest.mark.parametrize("edges", [["south", "east"], ["north", "middle", "east"]])
@pytest.mark.parametrize("attributes", ['vClasses="all"', 'exceptions="bicycle bus"'])
def test_distances_are_those_to_the_stop_line_where_sumos_driver_waits_at_a_light(
    edges, attributes, scenario_of, sumo_runs
):
    lane = f"{edges[0]}_0"
    simulator = sumo_runs.open(scenario_of(edges, lane, attributes))
    simulator.reset(seed=1)
    for _ in range(180):
        observations, *_ = simulator.step({"ego": np.array((-1.0, 0.0))})
    shown = simulator.restore_observation("ego", observations["ego"])
    assert libsumo.vehicle.getSpeed("ego") == 0.0
    to_end = libsumo.lane.getLength(lane) - libsumo.vehicle.getLanePosition("ego")
    assert shown["stop_line"][1] == pytest.approx(to_end - OFFSET_M)
    if edges[0] == "south":  # before a road with priority, SUMO's driver creeps over the line
        assert OFFSET_M <= to_end < OFFSET_M + 1.2
        assert shown["signals"][0, :3].tolist() == pytest.approx([1.0, 2.0, to_end - OFFSET_M])
    else:
        assert shown["right_of_way"][:, 0].sum() >= 1
        assert shown["right_of_way"][0, 2] == pytest.approx(to_end - OFFSET_M)
        assert shown["right_of_way"][0, 3] > to_end, "the conflict is in the junction"


def test_stop_line_on_the_map_is_that_of_the_class_of_the_vehicle(scenario_of):
    graph = lane_graph(scenario_of(["south", "east"], "south_0", 'exceptions="bicycle"'))
    (car,), (bicycle,) = (
        [one.ends for one in graph.stop_lines_for(kind) if one.lane == "south_0"] for kind in ("passenger", "bicycle")
    )
    np.testing.assert_allclose(bicycle - car, [[0.0, OFFSET_M], [0.0, OFFSET_M]])
