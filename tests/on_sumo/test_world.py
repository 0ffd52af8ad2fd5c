"""The world as SUMO has it: bridges, trains in bends, persons, long steps. Networks and their sources are in nets/."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.reader import make_reader

from crashhunt.crashes import Encounter
from crashhunt.oracles import OffRoad, Overlap, ReportedCollision
from crashhunt.recording import first_divergence, read_log, write_log
from crashhunt.render import SceneView
from crashhunt.scenario import AgentSetup, ObservationSetup
from crashhunt.sumo._bent_vehicles import height_at
from crashhunt.trial import Outcome, TrialSpec
from crashhunt.world import approaches, outlines, outlines_overlap

NETS = Path(__file__).parent / "nets"


@dataclass
class Constant:
    """Drives at one speed."""

    speed: float
    seen: Any = None

    def reset(self, seed):
        pass

    def act(self, observation):
        self.seen = observation
        return self.speed, 0


@pytest.fixture
def drive(sumo_runs):
    """Runs one episode in this process; returns the result."""

    def run(net, routes, *, speed=15.0, steps=300, step_s=0.1, options=None, observation=None):
        simulator = sumo_runs.written(
            NETS / f"{net}.net.xml", f"<routes>{routes}</routes>", table={"options": options or {}},
            step_length_s=step_s, warmup_s=0.0, agents={"ego": AgentSetup(existing=True)}, observation=observation,
        )  # fmt: skip
        agent = Constant(speed)
        oracles = (ReportedCollision(), Overlap(), OffRoad())
        result, recording = sumo_runs.record(simulator, TrialSpec(0, 1, {}, {}, steps), agent, oracles=oracles)
        assert result.outcome is not Outcome.INVALID, result.failure
        return result, recording, agent

    return run


def vehicle(name, edges, *, kind="", **attributes):
    values = "".join(f' {key}="{value}"' for key, value in {**({"type": kind} if kind else {}), **attributes}.items())
    return f'<vehicle id="{name}" depart="0"{values}><route edges="{edges}"/></vehicle>'


def same_after_the_log(recording, folder):
    write_log(folder / "log.mcap", recording)
    again = read_log(folder / "log.mcap")
    assert again.digest == recording.digest
    assert first_divergence(recording, again) is None
    return again


# Height.

STANDS_ON_THE_BRIDGE = (
    '<vehicle id="above" depart="0" departPos="60" departSpeed="0"><route edges="bridge down"/>'
    '<stop lane="bridge_0" endPos="60" duration="999"/></vehicle>'
)


def test_who_drives_below_a_bridge_touches_no_one_on_it(drive, tmp_path):
    low = vehicle("ego", "low", departPos="200", departSpeed="15", departLane="0")
    result, recording, agent = drive("bridge", STANDS_ON_THE_BRIDGE + low, steps=100)
    assert result.outcome is Outcome.SURVIVED
    assert result.closest.gap_m == math.inf
    assert result.closest.time_to_collision_s == math.inf
    covered = 0
    for scene in recording.scenes():
        above, ego = scene.roster.index["above"], scene.roster.index["ego"]
        assert (scene.heights[above], scene.heights[ego]) == pytest.approx((8, 0))
        covered += outlines_overlap(*(outlines(scene, row)[0] for row in (above, ego)))
    assert covered  # seen from above
    assert not agent.seen[1:].any()  # it is shown nobody
    same_after_the_log(recording, tmp_path)


def test_who_is_ahead_on_a_slope_is_on_the_same_level(drive):
    ahead = (
        '<vehicle id="ahead" depart="0" departPos="175" departSpeed="0"><route edges="up bridge"/>'
        '<stop lane="up_0" endPos="175" duration="999"/></vehicle>'
    )
    result, recording, _ = drive("bridge", ahead + vehicle("ego", "up bridge", departPos="50", departSpeed="15"))
    first = recording.scene(0)
    rise = first.heights[first.roster.index["ahead"]] - first.heights[first.roster.index["ego"]]
    assert rise > 4  # higher than a bridge, but on one road
    times, _, _ = approaches([first.frame], "ego")
    assert times[0] == pytest.approx((175 - 50 - 5) / 15, abs=0.3)
    assert (result.outcome, result.collision.role) == (Outcome.COLLISION, "collider")


# Long vehicles.

TRAIN = '<vType id="train" vClass="rail" length="200"/><vType id="bus" vClass="bus" length="18"/>'


def dense(recording, scene, actor, track):
    """Where a vehicle is, by its distance along the polyline of its track: independent of lanes and routes."""
    row = scene.roster.index[actor]
    front = np.array(scene.points[row])
    fine = np.concatenate(
        [np.linspace(a, b, 1 + int(10 * math.dist(a, b)), endpoint=False) for a, b in pairwise(track)]
    )
    places = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(fine, axis=0).T))])
    here = places[np.argmin(np.hypot(*(fine - front).T))]
    return fine[(places <= here) & (places > here - scene.roster.actors[row].length)]


def track(edges):
    from xml.etree import ElementTree

    lanes = {lane.get("id"): lane.get("shape") for lane in ElementTree.parse(NETS / "rail.net.xml").iter("lane")}
    return np.array([tuple(map(float, point.split(","))) for edge in edges for point in lanes[f"{edge}_0"].split()])


@pytest.mark.parametrize("step_s", [pytest.param(0.1, marks=pytest.mark.nightly), 1.0])
def test_trains_on_parallel_tracks_pass_each_other_in_a_bend(drive, tmp_path, step_s):
    traffic = (
        TRAIN
        + vehicle("ego", "outa outb outc", kind="train", departPos="base", departSpeed="max")
        + vehicle("other", "ina inb inc", kind="train", departPos="base", departSpeed="max")
    )
    result, recording, _ = drive("rail", traffic, steps=round(28 / step_s), step_s=step_s)
    assert result.outcome is Outcome.SURVIVED
    width = recording.actors[0].width
    assert result.closest.gap_m == pytest.approx(6 - width, abs=0.2)
    bent = [scene for scene in recording.scenes() if scene.spines]
    assert len(bent) > 10
    assert min(moment.gap_m for moment in Encounter(recording, "ego", "other").moments) == result.closest.gap_m
    middle = bent[len(bent) // 2]
    for actor, edges in (("ego", ("outa", "outb", "outc")), ("other", ("ina", "inb", "inc"))):
        row = middle.roster.index[actor]
        spine = np.array(middle.spines[row])[:, :2]
        cloud = dense(recording, middle, actor, track(edges))
        distance = np.hypot(*(cloud[:, None] - spine[None]).transpose(2, 0, 1))
        assert distance.min(axis=0).max() < 0.2  # on the track, and
        assert distance.min(axis=1).max() < 2.6  # all along it
    if step_s == 0.1:
        again = same_after_the_log(recording, tmp_path)
        assert again.scenes()[-1].spines == recording.scenes()[-1].spines
        # Without their bends they would have collided.
        hits = 0
        for scene in read_log(tmp_path / "log.mcap").scenes():
            scene.spines = {}
            hits += bool(Overlap().check(scene, ["ego"]))
        assert hits > 20


def test_an_articulated_bus_clips_who_stands_in_its_bend_and_no_one_next_to_it(drive):
    # 18 m on a radius of 106 m: the chord is half a metre off the track. A car stands on the inner track.
    bus = TRAIN + vehicle("ego", "outa outb outc", kind="bus", departPos="230", departSpeed="max")
    beside = (
        '<vType id="wide" width="6.5"/>'
        '<vehicle id="car" type="wide" depart="0" departPos="base" departSpeed="max"><route edges="inb inc"/>'
        '<stop lane="inb_0" endPos="80" duration="999"/></vehicle>'
    )
    result, recording, _ = drive("rail", bus + beside, steps=250)
    assert any(scene.spines for scene in recording.scenes())
    assert result.outcome is Outcome.FINISHED or result.outcome is Outcome.SURVIVED
    wider = beside.replace("6.5", "9.9")
    result, recording, _ = drive("rail", bus + wider, steps=250)
    assert (result.outcome, result.collision.role, result.collision.victim) == (Outcome.COLLISION, "collider", "car")


# Persons.

WALKERS = (
    '<vType id="wide" width="2.8"/><vType id="ghost" vClass="pedestrian" maxSpeed="0.01"/>'
    '<vType id="cyclist" vClass="bicycle"/>'
)


def test_a_person_in_the_lane_is_seen_and_hit(drive, tmp_path):
    traffic = (
        WALKERS
        + vehicle("ego", "wc ce", kind="wide", departPos="10", departSpeed="10")
        + '<person id="ego" type="ghost" depart="0" departPos="80"><walk edges="wc" arrivalPos="20"/></person>'
        + '<person id="9" type="cyclist" depart="0" departPos="90"><walk edges="wc ce"/></person>'
        + '<person id="rider" depart="0"><ride from="wc" to="ce" lines="ego"/></person>'
    )
    observation = ObservationSetup(features=("presence", "x", "y", "kind"))
    result, recording, agent = drive("street", traffic, speed=10.0, observation=observation)
    hit = result.collision
    assert (result.outcome, hit.role, hit.collider, hit.victim) == (
        Outcome.COLLISION, "collider", "ego", "person ego",
    )  # fmt: skip
    assert hit.collider_speed == pytest.approx(10)
    assert hit.victim_speed < 0.1
    kinds = {actor.id: actor.kind for actor in recording.actors}
    assert kinds["person ego"] == "pedestrian"
    assert kinds["person 9"] == "bicycle"
    assert agent.seen[0, 3] == 1
    assert set(agent.seen[1:, 3]) >= {3.0, 2.0}
    assert (agent.seen[1:, 0] == 1).sum() == len(recording.scenes()[-1].roster) - 1
    same_after_the_log(recording, tmp_path)


def test_an_overlap_with_a_person_that_sumo_misses_is_seen(drive):
    # SUMO takes its persons' stripes as they are, and reports nothing for one who stands a little in the way.
    traffic = (
        '<vType id="wide" width="2.2"/><vType id="stout" vClass="pedestrian" maxSpeed="0.01" width="0.8"/>'
        + vehicle("ego", "wc ce", kind="wide", departPos="10", departSpeed="10")
        + '<person id="0" type="stout" depart="0" departPos="80"><walk edges="wc" arrivalPos="20"/></person>'
    )
    result, _, _ = drive("street", traffic, speed=10.0)
    assert (result.outcome, result.collision.victim) == (Outcome.COLLISION, "person 0")
    assert "overlap" in result.collision.seen_by
    assert result.closest.gap_m == 0


def test_persons_inside_of_vehicles_and_ghosts_are_no_actors(drive):
    traffic = (
        vehicle("ego", "wc ce", departPos="10", departSpeed="5")
        + '<vehicle id="taxi" depart="triggered" departPos="60"><route edges="wc ce"/></vehicle>'
        + '<person id="rider" depart="0" departPos="60"><ride from="wc" to="ce" lines="taxi"/></person>'
        + '<person id="walker" depart="0" departPos="60"><walk edges="wc ce"/></person>'
    )
    _, recording, _ = drive("street", traffic, speed=5.0, steps=60)
    assert {"ego", "taxi", "person walker"} <= set(recording.scene(60).roster.index)
    assert "person rider" not in recording.scene(60).roster.index
    # In this model they walk through vehicles, in the middle of the lane.
    _, recording, _ = drive("street", traffic, steps=60, options={"pedestrian.model": "nonInteracting"})
    assert sorted(actor.id for actor in recording.actors) == ["ego", "taxi"]


# Long steps.


def test_no_one_drives_through_another_between_two_steps(drive):
    # The one ahead is slow; with steps of a second the ego is behind it, and then ahead of it.
    between = 0
    for place in (100, 104, 108, 112):
        traffic = vehicle("ego", "wc ce", departPos="10", departSpeed="14") + (
            '<vType id="slow" maxSpeed="1" length="2"/>' + vehicle("slow", "wc ce", kind="slow", departPos=place)
        )
        result, recording, _ = drive("street", traffic, speed=14.0, step_s=1.0, steps=12)
        hit, scene = result.collision, recording.scene(recording.steps)
        assert (result.outcome, hit.role, hit.collider, hit.victim) == (Outcome.COLLISION, "collider", "ego", "slow")
        assert scene.previous.time_s < hit.time_s <= scene.time_s
        assert (hit.collider_speed, hit.victim_speed) == pytest.approx((14, 1), abs=0.5)
        assert result.closest.gap_m == 0
        between += not outlines_overlap(*(outlines(scene, row)[0] for row in range(2)))
    assert between


def test_film_page_and_views_show_trains_and_persons(drive, tmp_path):
    traffic = TRAIN + vehicle("ego", "outa outb outc", kind="train", departPos="base", departSpeed="max")
    _, recording, _ = drive("rail", traffic, steps=150)
    step = next(number for number, scene in enumerate(recording.scenes()) if scene.spines) + 40
    scene = recording.scene(step)
    picture = SceneView(recording, [], agent="ego", scale=1.5).draw(step)
    orange = (np.abs(picture.astype(int) - (255, 179, 26)) < 40).all(axis=2)
    assert orange.sum() == pytest.approx(200 * 2.84 * 1.5**2, rel=0.25)
    spine = np.array(scene.spines[0])[:, :2]
    place = (spine - scene.centers[0]) * (1.5, -1.5) + (480, 270)
    shown = [orange[int(y), int(x)] for x, y in place[3:-3] if 0 <= y < 540]
    assert np.mean(shown) > 0.9
    write_log(tmp_path / "log.mcap", recording)
    with (tmp_path / "log.mcap").open("rb") as file:
        updates = [m for *_, m in make_reader(file).iter_messages(["/scene/actors"])]
    cubes = SceneUpdate.FromString(updates[step].data).entities[0].cubes
    assert len(cubes) == 40
    assert cubes[39].pose.position.y == pytest.approx((scene.spines[0][39][1] + scene.spines[0][40][1]) / 2)
    assert len(SceneUpdate.FromString(updates[0].data).entities[0].cubes) == 1

    traffic = WALKERS + vehicle("ego", "wc ce", departPos="10", departSpeed="10")
    traffic += '<person id="0" type="ghost" depart="0" departPos="30"><walk edges="wc ce"/></person>'
    _, recording, _ = drive("street", traffic, steps=2)
    picture = SceneView(recording, [], agent="ego", other="person 0").draw(1)
    assert (np.abs(picture.astype(int) - (143, 15, 63)) < 40).all(axis=2).sum() > 40


def test_lanes_of_any_length_have_a_height(drive):
    # 240.13 m in pieces of 20 m is a rounding error more than that: SUMO refuses it.
    _, recording, _ = drive("bridge", vehicle("ego", "down", departPos="100"), steps=1)
    for lane, length in (("down_0", 240.13), ("up_0", 240.13), (":b1_0_0", 0.1)):
        for piece in range(14):
            assert math.isfinite(height_at(lane, length * piece / 13 + 1e-9))
    assert recording.scene(0).heights
