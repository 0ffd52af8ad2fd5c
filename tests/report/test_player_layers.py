"""What the player draws besides the actors: what the agent observed and planned, lights, stop lines."""

from __future__ import annotations

import base64
import xml.etree.ElementTree as ET
import zlib
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import add_toy, keeps_going

from crashhunt.crashes import list_bundles
from crashhunt.recording import AgentChannel, ObservedPart
from crashhunt.report import player_data
from crashhunt.report._player_layers import (
    _checked,
    _in_words,
    _pictures,
    _plan,
    _present,
    _rows,
    _seen,
    _way,
    player_layers,
)
from crashhunt.scenario import load_scenario
from crashhunt.simulators import PARTS
from crashhunt.world import Actor, Roster, Scene


def unpacked(layer) -> np.ndarray:
    values = np.frombuffer(zlib.decompress(base64.b64decode(layer["values"])), "<f4")
    return values.reshape(-1, *layer["size"])


def hunted(shell):
    words = "--arg speed=14:20 --seed 1 --keep-going --observe ego,actors,predictions,lidar2d --no-snapshot"
    add_toy(shell).crashhunt("run", "seen", "1", "3", "99", "--scenario", "toy", *words.split())


@pytest.fixture
def hunt(shell, made_once):
    return made_once(hunted, shell)


def test_boxes_of_a_scene_are_where_its_actors_are_and_the_rays_end_at_outlines(hunt):
    bundle = list_bundles(hunt.folder / "seen")[0]
    data = player_data(bundle)
    seen, recording = data["observed"], bundle.recording()
    boxes, rays = unpacked(seen["layers"]["actors"]), unpacked(seen["layers"]["lidar2d"])
    assert seen["first"] == 0
    assert len(boxes) == len(rays) == recording.steps  # the agent observes every scene but the last one
    for step in (0, recording.steps - 1):
        scene = recording.scene(step)
        ego = scene.roster.index["ego"]
        others = [row for row in range(len(scene.roster)) if row != ego]
        found = boxes[step][np.isfinite(boxes[step][:, 0])]
        assert sorted(found[:, 0].tolist()) == pytest.approx(
            sorted((scene.centers[others, 0] - data["origin"][0]).tolist()), abs=0.02
        )
        ahead = min(
            scene.centers[row, 0] - scene.centers[ego, 0] - scene.roster.actors[row].length / 2
            for row in others
            if scene.centers[row, 0] > scene.centers[ego, 0]
        )
        assert rays[step][0] == pytest.approx(ahead, abs=0.02)  # the toy drives along the x axis


def test_outlines_of_obstacles_begin_at_the_origin_as_lanes_do(hunt, monkeypatch):
    bundle = list_bundles(hunt.folder / "seen")[0]
    assert "obstacles" not in player_data(bundle)
    house = np.array([(20.0, 5.0), (24.0, 5.0), (24.0, 9.0), (20.0, 5.0)])
    monkeypatch.setattr("crashhunt.report._page.read_obstacles", lambda _: [house, house[:2]])
    data = player_data(bundle)
    (packed,) = data["obstacles"]
    assert unpacked({"values": packed, "size": [2]}) == pytest.approx(house - data["origin"])


def test_recording_without_observations_shows_none(hunt):
    bundle = list_bundles(hunt.folder / "seen")[0]
    compact = bundle.recording().compacted([], 1000.0, observations=False)
    seen = player_layers(bundle, compact, "ego", None, np.zeros(2))["observed"]
    assert np.isnan(unpacked(seen["layers"]["actors"])).all()
    assert np.isnan(unpacked(seen["layers"]["lidar2d"])).all()
    assert not any(seen["words"])
    assert not any(seen["lights"])


def test_crash_without_observed_parts_has_no_layers_of_them(toy, made_once):
    data = player_data(list_bundles(made_once(keeps_going, toy).folder / "h")[0])
    assert data["stopLines"] == []
    assert not {"observed", "plan", "yields"} & data.keys()


def test_present_values_of_a_history_are_its_last_ones():
    part = ObservedPart("signals", (4, 3, 4), tuple(column.name for column in PARTS["signals"].columns))
    channel = AgentChannel("ego", "<f8", (48,), "<f8", (2,), (), (), (part,))
    assert _present(channel, "signals", np.arange(48.0)).tolist() == np.arange(36.0, 48).reshape(3, 4).tolist()


@pytest.mark.parametrize("frame", ["map", "vehicle", "unknown"])
def test_plan_is_drawn_in_the_frame_that_the_action_has(frame):
    heading, count = 0.5, 64
    channel = AgentChannel("ego", "<f8", (1,), "<f8", (count, 5))
    roster = Roster((Actor("ego", "passenger", 4.0, 2.0),))
    middle = (1.0, 1.0) if frame == "unknown" else (500.0, 300.0)  # near the origin of the map, it may be either
    front = (middle[0] + 2 * np.cos(heading), middle[1] + 2 * np.sin(heading))
    scene = Scene(0.0, roster, [front], [heading], [10.0])
    ahead = np.arange(1, count + 1) * 1.0
    offset = np.stack((ahead * np.cos(heading), ahead * np.sin(heading)), axis=1)
    places = np.stack((ahead, 0 * ahead), axis=1) if frame == "vehicle" else offset + middle
    action = np.column_stack((ahead / 10, places, np.full(count, heading), np.full(count, 10.0)))
    steps = [SimpleNamespace(actions={}), SimpleNamespace(actions={"ego": action})]
    recording = SimpleNamespace(all_steps=steps, steps=1, scene=lambda _: scene)
    found = _plan(recording, channel, np.zeros(2))
    if frame == "unknown":
        assert found == {}
    else:
        assert unpacked(found)[0] == pytest.approx(offset + middle, abs=1e-3)


def row(part: str, **values: float) -> np.ndarray:
    return np.array([values.get(column.name, 0.0) for column in PARTS[part].columns])


def words(**parts: np.ndarray) -> dict[str, str]:
    return dict(
        _in_words({name: _rows(values, [one.name for one in PARTS[name].columns]) for name, values in parts.items()})
    )


def test_signals_priority_and_the_lane_goal_are_said_in_words():
    clear = row("right_of_way")
    assert words(signals=row("signals", present=1, state=2, distance=23.44, time_in_state=3.25)) == {
        "signal": "red for 3.2 s, in 23.4 m"
    }
    assert words(signals=row("signals")) == {}  # no traffic light is ahead
    assert words(right_of_way=clear) == {"priority": "no actor to yield to"}
    first = row("right_of_way", present=1, must_yield=1, other_arrival=1000)
    other = row("right_of_way", present=1, other_arrival=0.5)
    assert words(right_of_way=np.stack([first, other]))["priority"] == "must yield to 1 actor"  # which stands
    route = row("route_state", lane_changes_needed=-2, distance_to_lane_change=80, distance_left=300)
    assert words(route_state=route) == {
        "lane goal": "2 lanes to the right within 80.0 m",
        "goal": "in 300.0 m",
    }
    assert words(stop_line=row("stop_line", present=1, distance=-1, must_yield=1)) == {
        "stop line": "inside the junction, must yield"
    }


def test_distance_beyond_a_kilometre_and_stop_line_without_rule_are_short():
    route = row("route_state", distance_left=100_453.2)
    assert words(route_state=route)["goal"] == "in 100.5 km"
    assert words(stop_line=row("stop_line", present=1, distance=72.6)) == {}


@pytest.mark.parametrize(
    "data", [{}, {"signals": []}, {"signals": {"a": [[1]]}, "vehicles": {}, "parts": {}, "routes": {}}]
)
def test_lights_of_another_form_are_not_shown(data):
    assert _checked(data) == {"signals": {}, "vehicles": {}, "parts": {}, "routes": {}}
    odd = {**_checked({}), "parts": {"ego": [(0, {"signals": [{"state": 9.0}]})]}, "routes": {"ego": [(0, [1.0])]}}
    assert _way(odd, "ego", np.zeros(2)) == {}


@pytest.mark.parametrize("shape", [(4, 20, 30), (20, 30, 3), (20, 30, 1)])
def test_observed_picture_is_the_newest_one_of_its_step(shape):
    channel = AgentChannel("car", "|u1", shape, "<f8", (1,))
    draw = np.random.default_rng(1)
    seen = [draw.integers(0, 256, shape).astype(np.uint8) for _ in range(3)]
    steps = [SimpleNamespace(observations={})] + [SimpleNamespace(observations={"car": one}) for one in seen]
    found = _pictures(SimpleNamespace(all_steps=steps, steps=3), channel)["observation"]
    size = tuple(found["size"])
    assert (found["first"], size) == (0, (20, 30, 1) if shape[0] == 4 else shape)
    shown = np.frombuffer(zlib.decompress(base64.b64decode(found["bytes"])), np.uint8).reshape(-1, *size)
    assert (shown == np.array([one[-1:].transpose(1, 2, 0) if shape[0] == 4 else one for one in seen])).all()
    vector = AgentChannel("car", "<f8", (5,), "<f8", (1,))
    assert _pictures(SimpleNamespace(all_steps=steps, steps=3), vector) == {}


def test_observed_values_are_curves_where_there_is_no_scene():
    channel = AgentChannel("cart", "<f4", (2,), "<i8", (), (), ("angle", "rate"))
    steps = [SimpleNamespace(observations={})] + [SimpleNamespace(observations={"cart": [n, -n]}) for n in range(3)]
    found = _seen(SimpleNamespace(all_steps=steps, steps=2, actors=[]), channel)
    assert found["names"] == ["angle", "rate"]
    values = np.frombuffer(zlib.decompress(base64.b64decode(found["values"])), "<f4").reshape(-1, 2)
    assert values.tolist() == [[0, 0], [1, -1], [2, -2]]
    assert _seen(SimpleNamespace(all_steps=steps, steps=2, actors=["ego"]), channel) == {}


def test_stop_lines_are_at_the_ends_of_the_lanes_that_have_to_yield():
    scenario = load_scenario("intersection")
    root = ET.parse(scenario.folder / "intersection.net.xml").getroot()
    waits = {f"{one.get('from')}_{one.get('fromLane')}" for one in root.iter("connection") if one.get("state") == "m"}
    waits = {lane for lane in waits if not lane.startswith(":")}
    ends = {
        lane.get("id"): [*map(float, lane.get("shape").split()[-1].split(","))]
        for lane in root.iter("lane")
        if lane.get("id") in waits
    }
    found = scenario.backend.stop_lines(scenario)
    assert {line.lane for line in found} == waits
    for line in found:
        assert line.kind == "yield"
        assert line.ends.mean(axis=0).tolist() == pytest.approx(ends[line.lane], abs=0.01)
