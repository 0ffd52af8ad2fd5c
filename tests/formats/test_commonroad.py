"""What is read back of a CommonRoad scenario is what was recorded."""

from __future__ import annotations

import dataclasses
import errno
import math
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from episodes import Episode, write
from handing import AGENTS, LANES, crash, middles, read_back, readers, recorded_paths

from crashhunt.base import layout
from crashhunt.errors import BundleError, HuntDirectoryError
from crashhunt.formats import write_commonroad
from crashhunt.recording import Recording, read_black_box, write_log


def states_of(element):
    """Step to (x, y, orientation, speed), of every state inside."""
    found = {}
    for state in (*element.findall("initialState"), *element.findall("trajectory/state")):
        x, y = (float(state.findtext(f"position/point/{axis}")) for axis in "xy")
        orientation, speed = (float(state.findtext(f"{tag}/exact")) for tag in ("orientation", "velocity"))
        found[int(state.findtext("time/exact"))] = (x, y, orientation, speed)
    return found


@pytest.mark.parametrize("seed", [1, 3])
def test_every_state_is_there_at_its_time(tmp_path, seed):
    bundle = crash(tmp_path, seed=seed)
    numbers = write_commonroad(bundle, tmp_path / "one.xml", with_agents=True)
    root = ET.parse(tmp_path / "one.xml").getroot()
    paths = recorded_paths(bundle)
    obstacles = {obstacle.get("id"): obstacle for obstacle in root.findall("dynamicObstacle")}
    left = {actor: iter(found) for actor, found in numbers.items()}
    assert len(obstacles) == len(paths.agents) + len(paths.others)
    for path in (*paths.agents, *paths.others):
        obstacle = obstacles[str(next(left[path.actor.id]))]
        states = states_of(obstacle)
        assert list(states) == list(range(path.first, path.last + 1))
        assert [(x, y) for x, y, *_ in states.values()] == list(middles(path).values())
        for (_, _, orientation, speed), state in zip(states.values(), path.states, strict=True):
            assert speed == state.speed
            assert math.remainder(orientation - state.heading, math.tau) == pytest.approx(0, abs=1e-12)
            assert -math.pi <= orientation <= math.pi
        assert obstacle.findtext("shape/rectangle/length") == "4.5"
    assert float(root.get("timeStepSize")) == 0.1
    assert any(path.first for path in paths.others)


def test_each_agent_is_a_planning_problem(tmp_path):
    bundle = crash(tmp_path)
    numbers = write_commonroad(bundle, tmp_path / "one.xml")
    root = ET.parse(tmp_path / "one.xml").getroot()
    paths = recorded_paths(bundle)
    problems = {problem.get("id"): problem for problem in root.findall("planningProblem")}
    assert root.get("benchmarkID") == "C-ZAM_Crashhunt-1_8_T-1"
    assert len(root.findall("dynamicObstacle")) == len(paths.others)
    assert [numbers[agent] for agent in AGENTS] == [[int(number)] for number in problems]
    for path, problem in zip(paths.agents, problems.values(), strict=True):
        first, second = path.states[:2]
        assert states_of(problem)[0][:2] == middles(path)[0]
        turned = math.remainder(second.heading - first.heading, math.tau)
        assert float(problem.findtext("initialState/yawRate/exact")) == pytest.approx(turned / 0.1)
        assert problem.findtext("goalState/time/intervalEnd") == "16"


def test_lanes_follow_on_where_they_begin_and_point_the_same_way(tmp_path):
    write_commonroad(crash(tmp_path), tmp_path / "one.xml")
    lanelets = ET.parse(tmp_path / "one.xml").getroot().findall("lanelet")
    follows = {
        int(lanelet.get("id")): {tag: [int(end.get("ref")) for end in lanelet.findall(tag)] for tag in ENDS}
        for lanelet in lanelets
    }
    assert follows == {
        1: {"predecessor": [], "successor": [2, 3]},
        2: {"predecessor": [1], "successor": []},
        3: {"predecessor": [1], "successor": []},
        4: {"predecessor": [], "successor": []},
    }
    left, right = (
        np.array([(float(p.findtext("x")), float(p.findtext("y"))) for p in lanelets[1].findall(f"{side}/point")])
        for side in ("leftBound", "rightBound")
    )
    assert (left + right) / 2 == pytest.approx(np.array(LANES[1].shape), abs=1e-9)
    assert np.hypot(*(left - right).T) == pytest.approx(3.5)
    assert left[0, 1] > right[0, 1]


ENDS = ("predecessor", "successor")


def test_without_roads_or_vehicles_it_is_refused_in_one_line(tmp_path):
    no_roads, nobody = crash(tmp_path / "a", lanes=()), crash(tmp_path / "b", steps=0, agents=["ego"])
    write(Episode(["ego"], 0, 1), tmp_path / "box")
    prologue = list(read_black_box(tmp_path / "box"))[:1]
    write_log(nobody.path / layout.LOG, Recording(prologue))
    result = dataclasses.replace(nobody.result, digest=Recording(prologue).digest)
    nobody = dataclasses.replace(nobody, files={}, result=result)
    for bundle, said in ((no_roads, "no map of lanes"), (nobody, "no scene with its agent")):
        with pytest.raises(BundleError, match=said) as refused:
            write_commonroad(bundle, tmp_path / "one.xml")
        assert len(str(refused.value).splitlines()) == 1
        assert not (tmp_path / "one.xml").exists()


def test_the_command_states_who_is_which_number(shell):
    crash(shell.folder, agents=["ego"])
    done = shell.crashhunt("export", "crashes/000007-collision", "one.xml", "--as", "commonroad", "--json").json
    numbers = {
        int(found.get("id"))
        for found in ET.parse(shell.folder / "one.xml").getroot()
        if found.tag != "lanelet" and found.get("id")
    }
    assert {number for found in done["actors"].values() for number in found} == numbers
    assert done["bytes"] == (shell.folder / "one.xml").stat().st_size
    for words, said in (
        (("two.zip", "--as", "commonroad"), "two.xml"),
        (("two.zip", "--recorded-agent"), "--as"),
        (("two.xml", "--as", "nothing"), "commonroad"),
        (("two.xml", "--as", "openscenario"), "two.xosc"),
        (("no/two.xml", "--as", "commonroad"), "no/two.xml"),
    ):
        refused = shell.crashhunt("export", "crashes/000007-collision", *words, expect=2)
        assert said in refused.err
        assert len(refused.err.strip().splitlines()) == 1
    assert [path.name for path in shell.folder.rglob("*two*")] == []


def test_a_full_disk_leaves_the_file_that_was_there(tmp_path, monkeypatch):
    def full(_, path, **_more):
        path.write_text("<commonRoad")
        raise OSError(errno.ENOSPC, "No space left on device")

    bundle = crash(tmp_path / "hunt")
    (tmp_path / "one.xml").write_text("before")
    monkeypatch.setattr(ET.ElementTree, "write", full)
    with pytest.raises(HuntDirectoryError, match="No space left"):
        write_commonroad(bundle, tmp_path / "one.xml")
    assert (tmp_path / "one.xml").read_text() == "before"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hunt", "one.xml"]


@readers
def test_commonroad_io_reads_what_was_recorded(tmp_path):
    bundle = crash(tmp_path)
    numbers = write_commonroad(bundle, tmp_path / "one.xml", with_agents=True)
    found = read_back("commonroad", tmp_path / "one.xml")
    paths = recorded_paths(bundle)
    left = {actor: iter(numbers) for actor, numbers in numbers.items()}
    for path in (*paths.agents, *paths.others):
        states = found["obstacles"][str(next(left[path.actor.id]))]
        assert [int(step) for step in states] == list(range(path.first, path.last + 1))
        for (x, y, orientation, speed), state, middle in zip(
            states.values(), path.states, middles(path).values(), strict=True
        ):
            assert (x, y) == pytest.approx(middle, abs=1e-3)
            assert math.remainder(orientation - state.heading, math.tau) == pytest.approx(0, abs=1e-9)
            assert speed == state.speed
    assert found["dt"] == 0.1
    assert found["problems"] == [numbers[agent][-1] for agent in AGENTS]
    assert found["successors"] == {"1": [2, 3], "2": [], "3": [], "4": []}
    # The schema has everybody there from the start, the library has not.
    assert found["against"]
    assert all("allowed ('0')" in message for message in found["against"])
    assert not read_against(tmp_path / "all", steps=6)


def read_against(folder, **made):
    """What the schema says of a crash in which nobody comes later."""
    write_commonroad(crash(folder, **made), folder / "one.xml")
    return read_back("commonroad", folder / "one.xml")["against"]
