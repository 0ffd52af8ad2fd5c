"""Demand that SUMO omits: reported once, and as the reason of trials whose vehicle never enters."""

from __future__ import annotations

import os
import re
from pathlib import Path

import libsumo
import numpy as np
import pytest

from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.base.text import NOTICE_TOPIC
from crashhunt.executors._protocol import Notes
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.sumo import BACKEND as SUMO, SumoSetup, _omitted_demand

NET = Path(__file__).with_name("signal.net.xml")
EGO = '<vehicle id="ego" route="across" depart="3"/>'
UNSORTED = f"""<routes><route id="across" edges="west east"/>
{EGO}
<flow id="late" route="across" begin="1" end="90" period="5"/><person id="p" depart="2"><walk edges="west"/></person>
</routes>"""


@pytest.fixture
def simulate(sumo_runs):
    """Simulates some steps while standard error is a file, as in a trial; returns the simulator."""

    def run(routes, agent="ego", steps=5, options=None, files=None):
        folder = sumo_runs.write(NET, routes, files)
        sumo = SumoSetup(net=NET.name, routes=("r.rou.xml",), options=options or {})
        agents = {agent: AgentSetup(existing=True)}
        simulator = sumo_runs.open(
            Scenario(step_length_s=0.5, insertion_timeout_s=5.0, agents=agents, tables={"sumo": sumo}, folder=folder)
        )
        kept, output = os.dup(2), os.open(folder / "run.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(output, 2)
        os.write(2, b"Warning: Route file should be sorted by departure time, ignoring 'that of before'!\n")
        try:
            simulator.reset(seed=1)
            for _ in range(steps):
                libsumo.simulationStep()
            simulator.reported = list(simulator.notices)
        finally:
            os.dup2(kept, 2)
            os.close(output)
            os.close(kept)
        return simulator

    return run


def test_omitted_demand_is_reported_with_reason_and_place(simulate, monkeypatch):
    assert simulate(UNSORTED).reported == []  # the note of the scenario says so already
    monkeypatch.setattr(_omitted_demand, "_MAX_SORTED_BYTES", 10)
    (notice,) = simulate(UNSORTED).reported
    topic, _, text = notice.partition(NOTICE_TOPIC)
    assert topic == "its route file is not sorted by departure time"
    assert text.startswith(
        "SUMO omits 'late' and 1 more of the demand, because its route file is not sorted by departure time "
        "(r.rou.xml, line 3). Fix: sort the file"
    )
    assert simulate(UNSORTED.replace("<flow", "<!--").replace("</person>", "</person>-->")).reported == []


@pytest.mark.parametrize("seed", range(6))
def test_note_names_what_sumo_leaves_out(simulate, seed):
    """In files of any order, with times in each notation; with includes, which SUMO reads in their place."""
    rng = np.random.default_rng(seed)
    walk = '<walk edges="west"/>'

    def element(number):
        time = int(rng.integers(0, 40))
        depart = (f"{time}", f"0:00:{time}", f"{time}.5", "triggered" if number % 5 == 4 else f"{time}")[number % 4]
        flow = f'begin="{time}" end="90" number="2"' if time else 'end="90" number="2"'
        kinds = (f'<vehicle id="{number}" route="across" depart="{depart}"/>',
                 f'<flow id="{number}" route="across" {flow}/>',
                 f'<person id="{number}" depart="{time}">{walk}</person>',
                 f'<personFlow id="{number}" {flow}>{walk}</personFlow>',
                 f'<trip id="{number}" from="west" to="east" depart="{depart}"/>')  # fmt: skip
        return kinds[int(rng.integers(0, len(kinds)))].replace('"triggered"', f'"{time}"')

    demand = [element(number) for number in range(12)]
    files = {"more.rou.xml": f"<routes>{''.join(demand[4:8])}</routes>"}
    demand[4:8] = ['<include href="more.rou.xml"/>']
    head = '<routes><route id="across" edges="west east"/><vehicle id="ego" route="across" depart="0"/>'
    simulator = simulate(f"{head}{''.join(demand)}</routes>", steps=100, files=files)
    folder = simulator._scenario.folder
    said = re.findall(r"ignoring '(\d+)'!", (folder / "run.log").read_text())
    late = []
    _omitted_demand._search(folder / "r.rou.xml", 0.0, [0.0], late)
    assert [name.split("'")[1] for name, _ in late] == said
    assert said
    (note,) = [note for note in SUMO.notes(simulator._scenario) if "sorted" in note]
    assert f"omits {len(said)} element{'s' * (len(said) > 1)} of the demand, such as {late[0][0]} in " in note


def test_vehicles_that_wait_too_long_are_counted(simulate):
    crowd = '<flow id="crowd" route="across" begin="0" end="2" number="90" departLane="0"/>'
    ego = EGO.replace("<vehicle", '<vehicle departLane="1"')
    routes = f'<routes><route id="across" edges="west east"/>{crowd}{ego}</routes>'
    (notice,) = simulate(routes, options={"max-depart-delay": 1}).reported
    assert "max-depart-delay was over before there was room for them" in notice
    assert simulate(routes).reported == []


@pytest.mark.parametrize(
    ("routes", "agent", "says"),
    [
        (
            UNSORTED,
            "late.2",
            "the vehicle 'late.2' never enters: SUMO omits 'late', because its route file is not",
        ),
        (
            UNSORTED.replace('end="90" period="5"', 'end="9" number="0"').replace('depart="3"', 'depart="0"'),
            "late.0",
            "the flow has no vehicles",
        ),
    ],
)
def test_invalid_trial_names_why_its_vehicle_is_omitted(simulate, routes, agent, says):
    with pytest.raises(InvalidEpisodeError) as caught:
        simulate(routes, agent)
    assert says in caught.value.message
    assert caught.value.fix


def test_one_notice_of_each_topic_is_reported(tmp_path):
    notes = Notes(tmp_path)
    for note in (f"a{NOTICE_TOPIC}three are omitted", "plain", f"a{NOTICE_TOPIC}four are omitted", "plain", "other"):
        notes.add(note)
    assert (notes.fresh(), notes.fresh()) == (["three are omitted", "plain", "other"], [])
