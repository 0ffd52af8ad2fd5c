"""What the views of a log show: where, how high, in which colour, and what is left out."""

from __future__ import annotations

import math

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.reader import make_reader

from crashhunt.base.errors import BundleError
from crashhunt.recording import (
    AgentChannel,
    Prologue,
    Recording,
    Tag,
    encode_actors,
    encode_heights,
    encode_notes,
    encode_spines,
    foxglove_layout,
    lane_borders,
    read_lanes,
    read_obstacles,
    write_log,
)
from crashhunt.recording._blackbox_file import Record
from crashhunt.recording._foxglove import MESSAGES
from crashhunt.trial import Collision, Outcome, TrialResult, TrialSpec
from crashhunt.world import Actor, Event, Lane, Roster, Scene

KINDS = {
    "/map": SceneUpdate, "/scene/actors": SceneUpdate, "/scene/crash": SceneUpdate, "/tf": FrameTransforms,
    "/ego/pose": PoseInFrame, "/log": Log, "/metrics": MESSAGES["Metrics"],
}  # fmt: skip
ACTORS = (
    Actor("ego", "passenger", 5.0, 2.0),
    Actor("second", "passenger", 5.0, 2.0),
    Actor("tram", "tram", 16.0, 2.5, 3.5),
    Actor("person 1", "pedestrian", 0.3, 0.5),
    Actor("van", "delivery", 6.0, 2.2),
)
POINTS = [(10.0, 20.0), (60.0, 20.0), (30.0, 4.0), (0.0, 0.0), (-40.0, 3.0)]
HEADINGS, SPEEDS = [0.5, 0.0, math.pi / 2, 0.0, 3.0], [12.0, 7.0, 3.0, 1.0, 0.0]
SPINE = ((30.0, 4.0, 2.0), (30.0, -4.0, 2.0), (22.0, -4.0, 1.0))
AGENTS = tuple(AgentChannel(name, "<f4", (1,), "<f4", (1,)) for name in ("ego", "second"))


def record(*steps, agents=AGENTS, step_s=0.1):
    """Each step is what is special about its scene."""
    records = [Record(Tag.PROLOGUE, 0, Prologue(agents, step_s).encode()), Record(Tag.ACTORS, 0, encode_actors(ACTORS))]
    rows = None
    for number, more in enumerate(steps):
        present = more.get("rows", range(len(ACTORS)))
        if present != rows:
            records.append(Record(Tag.ROSTER, 0, np.array(list(present), "<u4").tobytes()))
            rows = present
        actors = tuple(ACTORS[row] for row in present)
        scene = Scene(
            number * step_s + 100, Roster(actors), [], [], [], heights=more.get("heights", ()),
            grades=(0.0,) * len(more.get("heights", ())), spines=more.get("spines", {}),
        )  # fmt: skip
        if scene.heights:
            records.append(Record(Tag.HEIGHTS, 0, encode_heights(scene)))
        if scene.spines:
            records.append(Record(Tag.SPINES, 0, encode_spines(scene)))
        if "events" in more:
            records.append(Record(Tag.NOTES, 0, encode_notes(more["events"])))
        points = [value for row in present for value in POINTS[row]]
        values = [
            *([0.0] * len(agents)),
            *points,
            *(HEADINGS[row] for row in present),
            *(SPEEDS[row] for row in present),
        ]
        head = np.array([number], "<i8").tobytes() + np.array([scene.time_s], "<f8").tobytes()
        records.append(Record(Tag.STEP, 0, head + np.array(values, "<f8").tobytes()))
    return Recording(records)


@pytest.fixture
def shown(tmp_path):
    def show(recording, **options):
        write_log(tmp_path / "log.mcap", recording, **options)
        messages = {}
        with (tmp_path / "log.mcap").open("rb") as file:
            for _, channel, message in make_reader(file).iter_messages():
                assert message.log_time == message.publish_time
                if channel.topic in KINDS:
                    found = KINDS[channel.topic].FromString(message.data)
                    messages.setdefault(channel.topic, []).append((message.log_time, found))
        return messages

    return show


CRASH = TrialResult(
    TrialSpec(0, 0, {}, {}, max_steps=9), Outcome.COLLISION, steps=1,
    collision=Collision("second", "victim", "van", "second", ("overlap",)),
)  # fmt: skip


def colour(color):
    return color.r, color.g, color.b, color.a


def test_every_actor_is_a_box_in_the_colour_of_its_part(shown):
    messages = shown(record({}, {}), crash=CRASH)
    (time_ns, update), (later_ns, _) = messages["/scene/actors"]
    assert (time_ns, later_ns) == (100_000_000_000, 100_100_000_000)
    boxes = {entity.id: entity for entity in update.entities}
    assert list(boxes) == [actor.id for actor in ACTORS]
    colours = {name: colour(box.cubes[0].color) for name, box in boxes.items()}
    assert colours["ego"] == (1.0, 0.8, 0.1, 1.0)
    assert colours["second"] == (0.2, 0.8, 0.4, 1.0)
    assert colours["van"] == (0.95, 0.2, 0.2, 1.0)
    assert colours["tram"] == colours["person 1"] == (0.55, 0.6, 0.68, 1.0)
    heights = [box.cubes[0].size.z for box in boxes.values()]
    assert heights == [1.5, 1.5, 3.5, 1.7, 1.5]
    assert [box.cubes[0].pose.position.z for box in boxes.values()] == [height / 2 for height in heights]
    ego = boxes["ego"]
    assert (ego.frame_id, ego.metadata[0].key, ego.metadata[0].value) == ("map", "kind", "passenger")
    assert ego.lifetime.ToNanoseconds() == 110_000_000
    assert ego.timestamp.ToNanoseconds() == time_ns
    cube = ego.cubes[0]
    assert (cube.size.x, cube.size.y) == (5, 2)
    assert (cube.pose.position.x, cube.pose.position.y) == pytest.approx(
        (10 - 2.5 * math.cos(0.5), 20 - 2.5 * math.sin(0.5))
    )
    assert (cube.pose.orientation.z, cube.pose.orientation.w) == pytest.approx((math.sin(0.25), math.cos(0.25)))


def test_the_controlled_vehicles_have_frames(shown):
    messages = shown(record({"heights": (3.0, 0.0, 0.0, 0.0, 0.0)}, step_s=1.5))
    ((time_ns, frames),) = messages["/tf"]
    ((_, pose),) = messages["/ego/pose"]
    ego, second = frames.transforms
    assert [(each.parent_frame_id, each.child_frame_id) for each in (ego, second)] == [
        ("map", "ego"),
        ("map", "second"),
    ]
    centre = 10 - 2.5 * math.cos(0.5), 20 - 2.5 * math.sin(0.5), 3.0
    assert (ego.translation.x, ego.translation.y, ego.translation.z) == pytest.approx(centre)
    assert (second.translation.x, second.translation.y) == (57.5, 20)
    assert (ego.rotation.z, ego.rotation.w) == pytest.approx((math.sin(0.25), math.cos(0.25)))
    assert pose.frame_id == "map"
    place = pose.pose.position
    assert (place.x, place.y, place.z) == pytest.approx(centre)
    assert (pose.pose.orientation.z, pose.pose.orientation.w) == pytest.approx((math.sin(0.25), math.cos(0.25)))
    assert ego.timestamp.ToNanoseconds() == pose.timestamp.ToNanoseconds() == time_ns
    boxes = messages["/scene/actors"][0][1].entities
    assert boxes[0].cubes[0].pose.position.z == 3.75
    assert boxes[0].lifetime.ToNanoseconds() == 1_650_000_000


def test_a_bent_vehicle_is_as_many_boxes_as_it_has_parts(shown):
    level = (0.0, 0.0, 2.0, 0.0, 0.0)
    messages = shown(record({}, {"spines": {2: SPINE}, "heights": level}, {"heights": level}, {}))
    trams = [update.entities[2] for _, update in messages["/scene/actors"]]
    assert [len(tram.cubes) for tram in trams] == [1, 2, 1, 1]
    front, back = trams[1].cubes
    assert (front.size.x, front.size.y, front.size.z) == (8, 2.5, 3.5)
    place = front.pose.position
    assert (place.x, place.y, place.z) == pytest.approx((30, 0, 3.75))
    place = back.pose.position
    assert (place.x, place.y, place.z) == pytest.approx((26, -4, 3.75))
    assert (back.pose.orientation.z, back.pose.orientation.w) == pytest.approx((0, 1))
    assert (front.pose.orientation.z, front.pose.orientation.w) == pytest.approx([math.sin(math.pi / 4)] * 2)
    assert colour(back.color) == colour(front.color)
    assert trams[2].cubes[0].size.x == 16
    assert (trams[2].cubes[0].pose.position.y, trams[2].cubes[0].pose.position.z) == pytest.approx((-4, 3.75))
    assert trams[3].cubes[0].pose.position.z == 1.75


def test_metrics_are_of_the_first_agent_and_say_when_it_is_gone(shown):
    messages = shown(record({"rows": (0, 1)}, {"rows": (1, 4)}))
    (_, first), (_, gone) = messages["/metrics"]
    assert first.speed == 12
    assert first.gap_m == pytest.approx(45 - math.sin(0.5))
    assert first.time_to_collision_s == math.inf
    assert first.required_deceleration == 0
    assert math.isnan(gone.speed)
    assert gone.gap_m == math.inf
    assert [entity.id for entity in messages["/scene/actors"][1][1].entities] == ["second", "van"]


def test_events_and_the_crash_are_lines_of_the_log(shown):
    event = Event("red_light", "ego", "ego ran the red light 'c'")
    messages = shown(record({}, {"events": [event]}, {"heights": (0.0, 5.0, 0.0, 0.0, 0.0)}), crash=CRASH)
    (event_ns, warning), (crash_ns, error) = messages["/log"]
    assert (warning.level, warning.message, warning.name) == (
        Log.WARNING,
        "red_light: ego ran the red light 'c'",
        "crashhunt",
    )
    assert warning.timestamp.ToNanoseconds() == event_ns == 100_100_000_000
    assert (error.level, error.message) == (Log.ERROR, "collision: second was hit by van at step 1")
    assert error.timestamp.ToNanoseconds() == crash_ns == 100_200_000_000
    ((marked_ns, update),) = messages["/scene/crash"]
    (mark,) = update.entities
    assert marked_ns == mark.timestamp.ToNanoseconds() == crash_ns
    text, ring = mark.texts[0], mark.lines[0]
    assert text.text == "collision"
    assert (text.pose.position.x, text.pose.position.y, text.pose.position.z) == (60, 20, 9)
    assert len(ring.points) == 32
    assert {round(math.hypot(point.x - 60, point.y - 20), 6) for point in ring.points} == {5}
    assert {round(point.z, 6) for point in ring.points} == {5.1}
    assert len({(round(point.x, 3), round(point.y, 3)) for point in ring.points}) == 32
    # Where the vehicle has left, there is a line and no mark; where nobody collided, the mark is at the first agent.
    gone = shown(record({"rows": (0, 2)}), crash=CRASH)
    assert "/scene/crash" not in gone
    assert len(gone["/log"]) == 1
    failed = shown(record({}), crash=TrialResult(CRASH.spec, Outcome.AGENT_ERROR, steps=1))
    assert failed["/scene/crash"][0][1].entities[0].texts[0].pose.position.x == 10
    assert "/log" not in shown(record({}))


def test_the_map_is_what_an_agent_came_near(shown, tmp_path):
    def lane(name, *shape, width=4.0):
        return Lane(name, width, shape)

    lanes = [
        lane("east", (0.0, 0.0), (100.0, 0.0)),
        lane("corner", (0.0, 0.0), (10.0, 0.0), (10.0, 10.0), width=2.0),
        lane("point", (5.0, 5.0)),
        lane("just", (360.0, 0.0), (365.0, 0.0)),
        lane("beyond", (360.1, 0.0), (365.0, 0.0)),
        lane("below", (0.0, -281.0), (5.0, -281.0)),
        lane("reaching", (0.0, -900.0), (0.0, -280.0)),
        lane("left", (-291.0, 0.0), (-300.0, 0.0)),
        lane("above", (0.0, 321.0), (5.0, 330.0)),
        lane("twice", (0.0, 0.0), (0.0, 0.0)),
    ]
    messages = shown(record({}, {}), lanes=lanes)
    ((time_ns, update),) = messages["/map"]
    (entity,) = update.entities
    assert (entity.id, entity.frame_id, time_ns) == ("lanes", "map", 100_000_000_000)
    assert entity.timestamp.ToNanoseconds() == time_ns
    borders = [[(round(p.x, 6), round(p.y, 6)) for p in line.points] for line in entity.lines]
    assert borders[:4] == [
        [(0, -2), (100, -2)], [(0, 2), (100, 2)],
        [(0, -1), (10.707107, -0.707107), (11, 10)], [(0, 1), (9.292893, 0.707107), (9, 10)],
    ]  # fmt: skip
    assert [line[0] for line in borders[4:]] == [(360, -2), (360, 2), (2, -900), (-2, -900), (0, 0), (0, 0)]
    assert colour(entity.lines[0].color) == (0.45, 0.45, 0.5, 1.0)
    found = read_lanes(tmp_path / "log.mcap")
    assert len(found) == 5
    assert found[1][0].tolist() == pytest.approx(np.array([(0, -1), (10.707107, -0.707107), (11, 10)]), abs=1e-5)
    assert found[1][1].tolist() == pytest.approx(np.array([(0, 1), (9.292893, 0.707107), (9, 10)]), abs=1e-5)
    direct = lane_borders(lanes)
    assert len(direct) == len(lanes) - 1
    assert np.array_equal(direct[0], [[[0, -2], [100, -2]], [[0, 2], [100, 2]]])
    assert np.allclose(direct[1][1], found[1][1])


def test_obstacles_are_apart_from_the_lanes_of_the_map(shown, tmp_path):
    outline = ((20.0, 5.0), (24.0, 5.0), (24.0, 9.0), (20.0, 5.0))
    lanes = [Lane("house", 0.0, outline), Lane("east", 4.0, ((0.0, 0.0), (100.0, 0.0)))]
    ((_, update),) = shown(record({}, {}), lanes=lanes)["/map"]
    assert [(entity.id, len(entity.lines)) for entity in update.entities] == [("lanes", 2), ("obstacles", 1)]
    assert [found.tolist() for found in read_obstacles(tmp_path / "log.mcap")] == [[list(one) for one in outline]]
    ((right, left),) = read_lanes(tmp_path / "log.mcap")
    assert (right.tolist(), left.tolist()) == ([[0, -2], [100, -2]], [[0, 2], [100, 2]])


def test_without_scenes_or_agents_there_is_nothing_to_see(shown, tmp_path):
    lanes = [Lane("a", 3.0, ((0.0, 0.0), (9.0, 0.0)))]
    assert shown(record(), lanes=lanes, crash=CRASH) == {}
    assert read_lanes(tmp_path / "log.mcap") == []
    assert shown(record({}, agents=()), lanes=lanes, crash=CRASH) == {}
    assert set(shown(record({"rows": (2, 3)}), lanes=lanes)) == {"/scene/actors", "/tf", "/ego/pose", "/metrics"}
    assert foxglove_layout(record(agents=()))["configById"]["3D!scene"]["followTf"] == "map"
    with pytest.raises(BundleError, match="cannot be read"):
        read_lanes(tmp_path / "gone.mcap")
    whole = (tmp_path / "log.mcap").read_bytes()
    (tmp_path / "log.mcap").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(BundleError, match="damaged"):
        read_lanes(tmp_path / "log.mcap")


def test_the_layout_shows_what_there_is():
    layout = foxglove_layout(record({}))
    scene = layout["configById"]["3D!scene"]
    assert scene["followTf"] == "ego"
    assert scene["cameraState"]["perspective"] is False
    assert list(scene["topics"]) == ["/map", "/scene/actors", "/scene/crash"]
    assert all(topic["visible"] for topic in scene["topics"].values())
    paths = layout["configById"]["Plot!metrics"]["paths"]
    assert [path["value"] for path in paths] == ["/metrics.speed", "/metrics.time_to_collision_s", "/metrics.gap_m"]
    assert {layout["layout"]["first"], *list(layout["layout"]["second"].values())[:2]} == set(layout["configById"])


def test_a_long_actor_is_a_long_message(shown, monkeypatch):
    """The parts of an update are put together by hand, with lengths of one byte and of two."""
    monkeypatch.setitem(globals(), "ACTORS", (Actor("ego", "k" * 300, 5.0, 2.0), *ACTORS[1:]))
    boxes = shown(record({}))["/scene/actors"][0][1].entities
    assert boxes[0].metadata[0].value == "k" * 300
    assert len(boxes) == 5
