"""The compiled core where the world is not only cars on a plane: persons, bridges, buses in a bend, long steps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from crashhunt.agents import KeepLaneWithSpeed
from crashhunt.oracles import OffRoad, Overlap, ReportedCollision
from crashhunt.scenario import AgentSetup
from crashhunt.trial import TrialSpec

core = pytest.importorskip("_crashhunt_core", reason="the compiled core is not built")

NETS = Path(__file__).parents[1] / "on_sumo" / "nets"
WALKERS = (
    '<vType id="wide" width="2.8"/><vType id="ghost" vClass="pedestrian" maxSpeed="0.01"/>'
    '<vehicle id="ego" type="wide" depart="0" departPos="10" departSpeed="10"><route edges="wc ce"/></vehicle>'
    '<person id="ego" type="ghost" depart="0" departPos="80"><walk edges="wc" arrivalPos="20"/></person>'
    '<person id="rider" depart="0"><ride from="wc" to="ce" lines="ego"/></person>'
    '<vehicle id="one" depart="1"><route edges="wc ce"/></vehicle>'
    '<vehicle id="ü" depart="4"><route edges="wc"/></vehicle>'
)
BRIDGE = (
    '<vehicle id="above" depart="0" departPos="60" departSpeed="0"><route edges="bridge down"/>'
    '<stop lane="bridge_0" endPos="60" duration="999"/></vehicle>'
    '<vehicle id="ego" depart="0" departPos="50" departSpeed="15"><route edges="up bridge"/></vehicle>'
)
BEND = (
    '<vType id="bus" vClass="bus" length="18"/>'
    '<vehicle id="ego" type="bus" depart="0" departPos="230" departSpeed="max">'
    '<route edges="outa outb outc"/></vehicle>'
    '<vehicle id="car" depart="0" departSpeed="max"><route edges="inb inc"/></vehicle>'
)
EGO = '<vehicle id="ego" depart="0" departPos="10" departSpeed="10"><route edges="wc ce"/></vehicle>'
CRASH = EGO + (
    '<vehicle id="ahead" depart="0" departPos="60" departSpeed="0"><route edges="wc"/>'
    '<stop lane="wc_0" endPos="60" duration="999"/></vehicle>'
)
COME_AND_GO = EGO + (
    '<vehicle id="short" depart="0" departPos="-13" departSpeed="10"><route edges="wc"/></vehicle>'
    '<vehicle id="shorter" depart="2.5" departPos="-12" departSpeed="7"><route edges="wc"/></vehicle>'
    '<person id="late" depart="3.3" departPos="70"><walk edges="wc" arrivalPos="20"/></person>'
)
STAND = (
    '<vehicle id="{0}" type="{5}" depart="0" departPos="{1}" departSpeed="0"><route edges="{2}"/>'
    '<stop lane="{3}" endPos="{1}" duration="{4}"/></vehicle>'
)
# SUMO takes one out of the jam, who finds no room on the next edge until those who stand there drive off.
JAM = EGO.replace("10", "80", 1) + (
    '<vType id="tram" length="42"/>'
    + STAND.format("stopped", 190, "wc ce", "wc_0", 999, "DEFAULT_VEHTYPE")
    + '<vehicle id="jammed" depart="0" departPos="180" departSpeed="0"><route edges="wc ce"/></vehicle>'
    + "".join(STAND.format(f"full{row}", 43 + 48 * row, "ce", "ce_0", 6, "tram") for row in range(4))
)
# The same with lorries, of whom the first drives into a lay-by and the others stay: whom SUMO has taken out comes back
# in a step in which nobody else comes or goes.
LAY_BY = '<stop lane="ce_0" endPos="11.5" duration="6"/><stop lane="ce_0" endPos="13" duration="999" parking="true"/>'
BACK = EGO.replace("10", "80", 1) + (
    '<vType id="lorry" length="11"/>'
    + STAND.format("stopped", 190, "wc ce", "wc_0", 999, "DEFAULT_VEHTYPE")
    + '<vehicle id="jammed" depart="0" departPos="180" departSpeed="0"><route edges="wc ce"/></vehicle>'
    + '<vehicle id="full" type="lorry" depart="0" departPos="11.5" departSpeed="0"><route edges="ce"/>'
    + f"{LAY_BY}</vehicle>"
    + "".join(STAND.format(f"full{row}", 27 + 14.9 * row, "ce", "ce_0", 999, "lorry") for row in range(12))
)
# The trams of before, which the core leaves to Python, and one lay-by for them.
BACK_TO_TRAMS = JAM.replace('duration="6"', 'duration="999"').replace(
    '<stop lane="ce_0" endPos="43" duration="999"/>',
    '<stop lane="ce_0" endPos="43" duration="6"/><stop lane="ce_0" endPos="45" duration="999" parking="true"/>',
)
# Whoever is parked is on no lane, and names are in order: nobody's lane is told first.
PARKED = EGO + STAND.format("beside", 60, "wc", "wc_0", 999, "DEFAULT_VEHTYPE").replace(
    "/></veh", ' parking="true"/></veh'
)
WORLDS = {
    "crash": ("street", CRASH, 0.1, 80),
    "come and go": ("street", COME_AND_GO, 0.1, 75),
    "walkers": ("street", WALKERS, 0.1, 80),
    "long steps": ("street", WALKERS, 1.0, 30),
    "parked": ("street", PARKED, 0.1, 30),
    "bridge": ("bridge", BRIDGE, 0.1, 60),
    "bend": ("rail", BEND, 0.1, 120),
    "jam": ("street", JAM, 0.1, 110),
    "back": ("street", BACK, 0.1, 110),
    "back to trams": ("street", BACK_TO_TRAMS, 0.1, 110),
}


@pytest.mark.parametrize("world", WORLDS)
def test_a_trial_in_another_world_is_the_same_bit_by_bit(sumo_runs, world):
    net, traffic, step_s, steps = WORLDS[world]
    found, used = [], []
    for native in (None, False):
        table = {"options": {"time-to-teleport": 2}, "native": native}
        simulator = sumo_runs.written(
            NETS / f"{net}.net.xml", f"<routes>{traffic}</routes>", table=table, step_length_s=step_s, warmup_s=0.0,
            agents={"ego": AgentSetup(existing=True)},
        )  # fmt: skip
        spec, oracles = TrialSpec(0, 1, {}, {}, steps), (ReportedCollision(), Overlap(), OffRoad())
        result, recording = sumo_runs.record(simulator, spec, KeepLaneWithSpeed(12.0), oracles=oracles)
        used.append(simulator._sight.core is core)
        found.append(
            (
                repr(replace(result, setup_s=0.0, wall_s=0.0)),
                [(one.tag, bytes(one.payload)) for one in recording.records],
            )
        )
        assert result.steps > 5, result.failure
        assert not simulator.notices
    assert used == [True, False]
    assert found[0] == found[1]
