"""What a careful driver of a SUMO vehicle would consider, against the geometry of the scene."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import pytest

from crashhunt.scenario import argument_values, load_scenario


@pytest.fixture
def merge(sumo_runs):
    return sumo_runs.begin("merge", 3)[0]


def apart(scene, one, other):
    """How far an actor is ahead of another one and to its left, as the latter is headed."""
    (x, y), (to_x, to_y) = (scene.points[scene.roster.index[name]] for name in (one, other))
    heading = scene.headings[scene.roster.index[one]]
    c, s = math.cos(heading), math.sin(heading)
    return (to_x - x) * c + (to_y - y) * s, (to_y - y) * c - (to_x - x) * s


def gap_between(scene, rear, front):
    """The gap on a straight road, from poses and lengths."""
    ahead_m, _ = apart(scene, rear, front)
    return ahead_m - scene.roster.actors[scene.roster.index[front]].length


def test_gaps_sides_and_speeds_are_those_of_the_scene(merge):
    seen = {"ahead": 0, 1: 0, -1: 0}
    for step in range(160):
        merge.step({"ego": merge.actions["ego"].encode((22.0, 1 if step == 60 else 0))})
        if step % 8:
            continue
        around, scene = merge.surroundings("ego"), merge.scene()
        for kind in ("vehicle", "red light"):
            of_kind = [one for one in around.ahead if one.kind == kind]
            assert merge.nearest_ahead("ego", kind) == min(of_kind, key=lambda one: one.gap_m, default=None)
        assert around.speed_mps == pytest.approx(scene.speeds[scene.roster.index["ego"]])
        for one in around.ahead:
            if one.actor in scene.roster.index:
                seen["ahead"] += 1
                assert one.gap_m == pytest.approx(gap_between(scene, "ego", one.actor), abs=0.6)
                assert one.speed_mps == pytest.approx(scene.speeds[scene.roster.index[one.actor]])
        for change, side in around.sides.items():
            for one, rear, front in ((side.ahead, "ego", None), (side.behind, None, "ego")):
                if one is not None and one.actor in scene.roster.index:
                    seen[change] += 1
                    assert apart(scene, "ego", one.actor)[1] * change > 1.0
                    wanted = gap_between(scene, rear or one.actor, front or one.actor)
                    assert one.gap_m == pytest.approx(wanted, abs=0.6)
    assert min(seen.values()) > 5


def test_looking_changes_nothing_in_the_simulation(sumo_runs):
    scenario = load_scenario("merge")
    merge, traces = sumo_runs.open(scenario), []
    for looks in (False, True):
        merge.reset(seed=5, options={"arguments": argument_values(scenario)})
        for _ in range(60):
            merge.step({"ego": merge.actions["ego"].encode((20.0, 0))})
            if looks:
                merge.surroundings("ego")
        scene = merge.scene()
        traces.append((scene.points, scene.speeds, scene.roster.actors))
    assert traces[0] == traces[1]


_UNREGULATED_DRIVE = """
import sys
from pathlib import Path
import libsumo
from crashhunt.sumo._surroundings import surroundings_of, unregulated_junctions

net, routes = sys.argv[1:]
unregulated = unregulated_junctions(Path(net))
libsumo.start(["sumo", "-n", net, "-r", routes, "--no-step-log", "true", "-W"])
foes = inside = 0
for _ in range(60):
    libsumo.simulationStep()
    for vehicle in libsumo.vehicle.getIDList():
        foes += len(surroundings_of(vehicle, lambda *_: None, unregulated).crossing)
        inside += libsumo.vehicle.getLaneID(vehicle).startswith(":A1")
print(sorted(unregulated), foes > 0, inside > 0)
"""


def test_junctions_without_rules_end_no_process(tmp_path):
    # libsumo's getJunctionFoes dies with a segmentation fault at such a junction, so another process calls it.
    (tmp_path / "routes.rou.xml").write_text(
        """<routes><route id="r" edges="C1B1 B1A1 A1B3 B3C3"/><route id="q" edges="C4B4 B4A1 A1B2 B2C2"/>
        <flow id="a" route="r" begin="0" end="60" period="4"/><flow id="b" route="q" begin="0" end="60" period="3"/>
        <flow id="c" begin="0" end="60" period="3"><route edges="B2B1 B1B4"/></flow></routes>"""
    )
    arguments = (Path(__file__).parent / "nets" / "spider.net.xml.gz", tmp_path / "routes.rou.xml")
    done = subprocess.run([sys.executable, "-c", _UNREGULATED_DRIVE, *arguments], capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip()) == (0, "['A1'] True True"), done.stderr
