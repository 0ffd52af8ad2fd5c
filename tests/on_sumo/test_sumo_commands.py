"""What disturbances, actions and holds command to SUMO's vehicles, with the answers of SUMO given."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace

import libsumo
import numpy as np
import pytest
from fake_sumo import FakeSumo, gone

from crashhunt.scenario import AgentSetup
from crashhunt.simulators import META_ACTIONS
from crashhunt.sumo import _disturbances, _driving
from crashhunt.sumo._disturbances import JunctionLanes, SteppingOut, SumoDisturbances
from crashhunt.sumo._driving import Driving
from crashhunt.trial import Disturbance
from crashhunt.world import Actor, Roster, Scene

NETS = Path(__file__).with_name("nets")


@pytest.fixture
def sumo(monkeypatch):
    """SUMO's answers on one vehicle, which each test may change."""
    made = FakeSumo(
        vehicle_getSpeed=10.0, vehicle_getAllowedSpeed=13.0, vehicle_getSpeedFactor=1.25, vehicle_getDecel=4.0,
        vehicle_getAccel=2.0, vehicle_getLaneChangeMode=1621, vehicle_getSpeedMode=31, vehicle_getLaneID="e_1",
        vehicle_getRoadID="e", vehicle_getLaneIndex=1, vehicle_getLanePosition=40.0, vehicle_getIDList=("other",),
    )  # fmt: skip
    for module in (_disturbances, _driving):
        monkeypatch.setattr(module, "sumo", made)
    return made


def commanded(sumo, active, *steps):
    """What a disturbance commands at once, in each step with its answers, and at its end."""
    found = [sumo.taken()]
    for answers in steps:
        sumo.answers |= answers
        active.keep()
        found.append(sumo.taken())
    active.end()
    return [*found, sumo.taken()]


def test_vehicle_brakes_to_its_target_and_keeps_it_where_that_is_safe(sumo):
    made = _disturbances._Slows("other", 3.0, 0.5, how_strong=4.0, target=6.0)
    assert made.how_strong == 4.0
    found = commanded(
        sumo, made, {"vehicle_getSpeed": 7.0}, {"vehicle_getSpeed": 6.0}, {"vehicle_getSpeed": 5.0},
        {"vehicle_getSpeed": 5.0, "vehicle_getAllowedSpeed": 5.5},
    )  # fmt: skip
    assert found == [[("setSpeed", "other", speed)] for speed in (8.5, 6.0, 6.0, 6.0, 5.5, -1.0)]
    assert commanded(sumo, _disturbances._Slows("other", 3.0, 0.5, how_strong=3.0), {"vehicle_getSpeed": 1.0})[:2] == [
        [("setSpeed", "other", 3.5)], [("setSpeed", "other", 0.0)]
    ]  # fmt: skip


def test_desired_speed_is_raised_by_a_share_and_put_back(sumo):
    made = _disturbances._Speeds("other", 0.5)
    assert made.how_strong == 0.5
    assert commanded(sumo, made, {"vehicle_getSpeedFactor": 9.0}) == [
        [("setSpeedFactor", "other", 1.875)], [], [("setSpeedFactor", "other", 1.25)]
    ]  # fmt: skip


def test_vehicle_cuts_in_and_brakes_in_the_new_lane_only(sumo):
    made = _disturbances._CutsIn("other", "e_2", 3.0, 0.5, 4.0)
    assert made.how_strong == 3.0
    assert commanded(
        sumo, made, {}, {"vehicle_getLaneID": "e_2"}, {"vehicle_getSpeed": 1.0}, {"vehicle_getLaneID": "e_1"}
    ) == [
        [("setLaneChangeMode", "other", 256), ("changeLane", "other", 2, 4.0)], [], [("setSpeed", "other", 8.5)],
        [("setSpeed", "other", 0.0)], [], [("setLaneChangeMode", "other", 1621), ("setSpeed", "other", -1.0)],
    ]  # fmt: skip
    plain = _disturbances._CutsIn("other", "e_2", 0.0, 0.5, 4.0)
    assert commanded(sumo, plain, {"vehicle_getLaneID": "e_2"})[1:] == [[], [("setLaneChangeMode", "other", 1621)]]


def test_vehicle_merges_when_little_is_left_of_its_lane(sumo):
    made = _disturbances._MergesLate("other", 2, 100.0, 30.0)
    assert made.how_strong == 30.0
    change = [("setLaneChangeMode", "other", 256), ("changeLane", "other", 2, 3600.0)]
    end = [("setLaneChangeMode", "other", 1621), ("changeLane", "other", 1, 0.0)]
    found = commanded(sumo, made, {}, {"vehicle_getLanePosition": 69.9}, {"vehicle_getLanePosition": 70.0}, {})
    assert found == [[("setLaneChangeMode", "other", 0)], [], [], change, [], end]
    sumo.answers["vehicle_getLanePosition"] = 0.0
    left = _disturbances._MergesLate("other", 2, 100.0, 30.0)
    assert commanded(sumo, left, {}, {"vehicle_getRoadID": "f"})[1:] == [[], [("setLaneChangeMode", "other", 256)], end]
    sumo.answers["vehicle_getRoadID"] = "e"
    waits = _disturbances._MergesLate("other", 2, 100.0, 30.0)
    assert commanded(sumo, waits, {})[1:] == [[], [("setLaneChangeMode", "other", 1621)]]


def test_vehicle_that_ignores_priority_is_commanded_a_speed_that_it_can_reach(sumo):
    made = _disturbances._Ignores("other", 0.5)
    assert made.how_strong == 1.0
    found = commanded(
        sumo, made, {"vehicle_getAllowedSpeed": 10.5}, {"vehicle_getAllowedSpeed": 5.0},
        {"vehicle_getSpeed": 1.0, "vehicle_getAllowedSpeed": 0.0}, {"vehicle_getAllowedSpeed": -3.0},
    )  # fmt: skip
    speeds = [found[0][1][2], *(step[0][2] for step in found[1:-1])]
    assert speeds == [11.0, 10.5, 8.0, 0.0, 0.0]
    assert found[0][0] == ("setSpeedMode", "other", 7)
    assert found[-1] == [("setSpeedMode", "other", 31), ("setSpeed", "other", -1.0)]


@pytest.mark.parametrize(
    "make",
    [
        lambda: _disturbances._Slows("other", 3.0, 0.5, how_strong=4.0),
        lambda: _disturbances._Speeds("other", 0.5),
        lambda: _disturbances._CutsIn("other", "e_1", 3.0, 0.5, 4.0),
        lambda: _disturbances._MergesLate("other", 2, 41.0, 30.0),
        lambda: _disturbances._Ignores("other", 0.5),
        lambda: _driving._KeepsSpeed("other"),
        lambda: _driving._KeepsLane("other"),
    ],
)
def test_vehicle_that_has_left_is_let_go_and_other_errors_are_raised(sumo, make):
    made = make()
    before = dict(sumo.answers)
    sumo.answers |= {name: gone for name in before if name != "vehicle_getIDList"}
    sumo.answers |= dict.fromkeys(("vehicle_setSpeed", "vehicle_setSpeedFactor", "vehicle_setLaneChangeMode",
                                   "vehicle_setSpeedMode"), gone)  # fmt: skip
    made.keep()
    made.end()
    sumo.answers |= dict.fromkeys(("vehicle_setSpeed", "vehicle_setSpeedFactor", "vehicle_setLaneChangeMode",
                                   "vehicle_setSpeedMode"), lambda *_: 1 / 0)  # fmt: skip
    with pytest.raises(ZeroDivisionError):
        made.end()


# Which disturbance is which.


@pytest.fixture
def disturbances(sumo, monkeypatch):
    for kind in ("_Slows", "_Speeds", "_Ignores", "SteppingOut"):
        monkeypatch.setattr(_disturbances, kind, lambda *given, kind=kind, **named: (kind, *given, named))
    monkeypatch.setattr(_disturbances, "_cut_in", lambda *given: ("_cut_in", *given))
    monkeypatch.setattr(_disturbances, "_late_merge", lambda *given: ("_late_merge", *given))
    return SumoDisturbances(("ego", "two"), 0.5, SimpleNamespace(left_hand=False))


def planned(what, who="ahead", strong=3.0, long=2.0):
    return Disturbance(1, who, what, strong, long, "ego")


def test_disturbance_is_made_within_what_the_vehicle_can(disturbances, sumo, monkeypatch):
    def made(*given, **named):
        return disturbances.disturb("other", planned(*given, **named))

    assert made("brake") == made("stop") == ("_Slows", "other", 3.0, 0.5, {"how_strong": 3.0, "strengths": []})
    assert made("brake", strong=9.0) == ("_Slows", "other", 4.0, 0.5, {"how_strong": 4.0, "strengths": []})
    assert made("dawdle", strong=0.25) == ("_Slows", "other", 1.5, 0.5, {"how_strong": 0.25, "target": 7.5})
    assert made("dawdle", strong=1.5)[-1] == {"how_strong": 1.5, "target": 0.0}
    assert made("speed", strong=0.25) == ("_Speeds", "other", 0.25, {})
    assert made("late_merge", strong=20.0) == ("_late_merge", "other", 20.0)
    assert made("ignore_priority") == ("_Ignores", "other", 0.5, {})
    sumo.answers["vehicle_getDecel"] = 1.0
    assert made("dawdle", strong=0.25)[2] == 1.0
    assert made("cut_in", who="left") == ("_cut_in", "other", -1, 2.0, 1.0, 0.5)
    for who, left_hand, side in (
        ("left ahead", False, -1),
        ("right", False, 1),
        ("left", True, 1),
        ("right", True, -1),
    ):
        disturbances._driving.left_hand = left_hand
        assert made("cut_in", who=who)[2] == made("cut_in", who=f"{who} ahead")[2] == side
    assert made("cut_in", who="ahead") is made("cut_in", who="behind") is None
    asked = []
    monkeypatch.setattr(_disturbances, "can_step_out", lambda *given: asked.append(given) or len(asked) == 1)
    walks = made("step_out", who="right ahead", strong=1.5, long=3.0)
    assert walks == ("SteppingOut", "other", "ego", [1.5] * 6, 0.5, disturbances.speeds, {})
    assert asked == [("other", "ego", 2.25, disturbances._junctions)]
    assert made("step_out") is None
    sumo.answers["vehicle_getDecel"] = gone
    assert made("brake") is None


def test_target_is_no_agent_and_empty_when_the_agent_has_left(disturbances, monkeypatch):
    asked, scene = [], object()
    monkeypatch.setattr(_disturbances, "roadside", lambda *given: asked.append(given) or "person p")
    monkeypatch.setattr(
        _disturbances, "_at", lambda agent, who, *, left_hand: asked.append((agent, who, left_hand)) or "x"
    )
    monkeypatch.setattr(SumoDisturbances, "_crossing", lambda self, *given: asked.append(given) or "c")
    found = [disturbances.resolve_target(planned(what, "left", 1.5, 3.0), scene) for what in
             ("step_out", "ignore_priority", "brake")]  # fmt: skip
    assert found == ["person p", "c", "x"]
    assert asked == [
        (scene, "ego", "left", 2.25, disturbances._junctions),
        ("ego", "left", scene),
        ("ego", "left", False),
    ]
    monkeypatch.setattr(_disturbances, "_at", lambda *_, **__: "two")
    assert disturbances.resolve_target(planned("brake"), scene) == ""
    monkeypatch.setattr(_disturbances, "_at", gone_named)
    assert disturbances.resolve_target(planned("brake"), scene) == ""


def gone_named(*_, **__):
    raise libsumo.TraCIException("not known")


def scene_of(*places, ego=(0.0, 0.0, 0.0)):
    """A scene with an agent, and others by identifier and place."""
    x, y, heading = ego
    actors = [Actor("ego", "car", 5.0, 2.0, 1.5), *(Actor(name, "car", 5.0, 2.0, 1.5) for name, *_ in places)]
    points = [(x, y), *((px, py) for _, px, py in places)]
    return Scene(0.0, Roster(tuple(actors)), points, [heading] * len(points), [1.0] * len(points))


def test_crossing_vehicle_is_the_nearest_one_on_a_crossing_path(disturbances, sumo):
    sumo.answers |= {
        "lane_getInternalFoes": lambda way: {":j_0_0": (":j_3_0", ":j_4_0")}.get(way, ()),
        "vehicle_getLaneID": lambda name: {"free": "e_0"}.get(name, "e_9"),
        "vehicle_getNextLinks": lambda name: () if name not in ways else (("f", 0, 0, 0, ways[name]),),
        "vehicle_getIDList": ("ego", "two", "far", "near", "apart", "free", "behind"),
    }  # fmt: skip
    ways = {"ego": ":j_0_0", "two": ":j_3_0", "far": ":j_3_0", "near": ":j_4_0", "apart": ":j_5_0", "behind": ":j_3_0",
            "absent": ":j_3_0"}  # fmt: skip
    places = [("two", 10.0, -5.0), ("far", 30.0, -20.0), ("near", 20.0, -20.0), ("apart", 5.0, -5.0),
              ("free", 5.0, -5.0), ("behind", -20.0, -5.0), ("absent", 4.0, -4.0), ("person p", 4.0, -4.0)]  # fmt: skip
    scene = scene_of(*places)
    assert disturbances._crossing("ego", "right ahead", scene) == "near"
    assert disturbances._crossing("ego", "right behind", scene) == "behind"
    assert disturbances._crossing("ego", "left ahead", scene) == ""
    for x, found in ((79.0, "far"), (81.0, "")):
        assert disturbances._crossing("ego", "right ahead", scene_of(("far", x, -2.0))) == found
    assert disturbances._crossing("ego", "right ahead", scene_of(("far", 0.0, -80.0))) == ""
    assert disturbances._crossing("ego", "right", scene_of(("far", 0.0, -80.0))) == "far"
    assert disturbances._crossing("nobody", "right ahead", scene) == ""
    ways["ego"] = ":j_9_0"
    assert disturbances._crossing("ego", "right ahead", scene) == ""


# Persons who step out.


@pytest.fixture
def person(sumo, monkeypatch):
    """A person on the sidewalk y = -6 at x = 30, who walks east; the agent drives east on y = 0."""
    sumo.answers |= {
        "person_getPosition": (30.0, -6.0), "person_getRoadID": "s", "person_getLaneID": "s_0",
        "person_getMaxSpeed": 1.5, "person_getLanePosition": 30.0, "vehicle_getAngle": 90.0,
        "vehicle_getPosition": (0.0, 0.0), "lane_getShape": ((0.0, -6.0), (100.0, -6.0)), "lane_getLength": 100.0,
    }  # fmt: skip
    stage = SimpleNamespace(edges=("r", "s", "t"), arrivalPos=12.0, type=2)
    made = SimpleNamespace(stage=stage, calls=[], stages=2)
    library = SimpleNamespace(
        person=SimpleNamespace(
            getStage=lambda name: stage, getRemainingStages=lambda name: made.stages,
            appendWalkingStage=lambda *given: made.calls.append(("append", *given)),
            removeStage=lambda *given: made.calls.append(("remove", *given)),
        ),
        TraCIException=libsumo.TraCIException,
        lane=SimpleNamespace(getShape=lambda lane: made.lanes[lane], getAllowed=lambda lane: made.allowed[lane],
                             getDisallowed=lambda lane: made.disallowed.get(lane, ())),
    )  # fmt: skip
    made.lanes, made.allowed, made.disallowed = {}, {}, {}
    monkeypatch.setattr(_disturbances, "libsumo", library)
    return made


@pytest.mark.parametrize("turn", [0, 90, 210])
@pytest.mark.parametrize("side", [-1, 1])
def test_person_walks_straight_to_the_agents_axis(person, sumo, turn, side):
    c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    sumo.answers |= {
        "vehicle_getAngle": 90.0 - turn, "vehicle_getPosition": (7.0, 3.0),
        "person_getPosition": (7.0 + 30.0 * c - side * 6.0 * s, 3.0 + 30.0 * s + side * 6.0 * c),
    }  # fmt: skip
    way = _disturbances._Way.of("p", "ego")
    assert way.far_m == pytest.approx(6.0)
    assert way.direction == pytest.approx((side * s, -side * c))
    assert way.at(6.0) == pytest.approx((7.0 + 30.0 * c, 3.0 + 30.0 * s))
    assert way.at(0.0) == way.start
    assert (way.angle - (90.0 - turn + side * 90.0)) % 360.0 == pytest.approx(0.0, abs=1e-9) or (
        way.angle - (90.0 - turn + side * 90.0)
    ) % 360.0 == pytest.approx(360.0)


def test_person_steps_out_stands_and_is_back_in_time(person, sumo):
    speeds = {}
    made = SteppingOut("person p", "ego", [9.0] * 13, 1.0, speeds)
    assert made.how_strong == 1.5  # as fast as it can
    moved, shown = [], [speeds["p"]]
    for _ in range(12):
        moved += sumo.taken()
        made.keep()
        shown.append(speeds["p"])
    moved += sumo.taken()
    assert {call[:3] for call in moved} == {("moveToXY", "p", "")}
    assert [(x, round(y, 9)) for *_, x, y, _, _, _ in moved] == [
        (30.0, y) for y in (-4.5, -3.0, -1.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.5, -3.0, -4.5, -6.0)
    ]
    assert shown == [1.5] * 4 + [0.0] * 5 + [1.5] * 4
    assert [call[5] for call in moved] == pytest.approx([0.0] * 9 + [180.0] * 4)
    assert {call[6:] for call in moved} == {(2, 100.0)}
    made.end()
    assert person.calls == [("append", "p", ("s", "t"), 12.0), ("remove", "p", 0)]
    assert speeds == {}


def test_person_that_has_too_little_time_turns_back_before_the_axis(person, sumo):
    SteppingOut("person p", "ego", [1.0] * 6, 0.5, {})  # one metre a second, three seconds in all
    made = SteppingOut("person p", "ego", [1.0] * 6, 0.5, {})
    sumo.taken()
    for _ in range(5):
        made.keep()
    assert [call[4] for call in sumo.taken()] == [-5.0, -4.5, -5.0, -5.5, -6.0]


def test_person_on_a_junction_or_gone_is_not_moved(person, sumo):
    speeds = {}
    made = SteppingOut("person p", "ego", [1.0] * 6, 0.5, speeds)
    sumo.taken()
    sumo.answers["person_getRoadID"] = ":j_w0"
    made.keep()
    assert (sumo.taken(), speeds) == ([], {})
    speeds["p"] = 1.0
    sumo.answers["person_getRoadID"] = gone
    made.keep()
    assert (sumo.taken(), speeds) == ([], {})
    person.stages = 1
    made.end()
    assert person.calls == [("append", "p", ("s", "t"), 12.0)]  # the walk before was its last one
    person.stage.edges = ("x", "y")
    other = (
        SteppingOut("person p", "ego", [1.0] * 6, 0.5, speeds)
        if not callable(sumo.answers["person_getRoadID"])
        else None
    )
    assert other is None
    sumo.answers["person_getRoadID"] = "s"
    other = SteppingOut("person p", "ego", [1.0] * 6, 0.5, speeds)
    other.end()
    assert person.calls[-1] == ("append", "p", ("x", "y"), 12.0)  # its edge is none of its walk


@pytest.mark.parametrize(
    ("places", "who", "found"),
    [
        ([("person a", 30.0, -6.0)], "right ahead", "person a"),
        ([("person a", 30.0, 6.0)], "left ahead", "person a"),
        ([("person a", 30.0, 6.0)], "right ahead", ""),
        ([("car", 30.0, -6.0)], "right ahead", ""),
        ([("person a", 60.0, -6.0)], "right ahead", "person a"),
        ([("person a", 60.1, -6.0)], "right ahead", ""),
        ([("person a", 0.0, -6.0)], "right ahead", ""),
        ([("person a", -1.0, -6.0)], "right ahead", ""),
        ([("person a", 30.0, -1.6)], "right ahead", ""),
        ([("person a", 30.0, -1.7)], "right ahead", "person a"),
        ([("person a", 30.0, -15.0)], "right ahead", "person a"),
        ([("person a", 30.0, -15.1)], "right ahead", ""),
        ([("person a", 30.0, -6.0), ("person b", 20.0, -9.0)], "right ahead", "person b"),
        ([("person unable", 20.0, -6.0), ("person b", 30.0, -9.0)], "right ahead", "person b"),
        ([("person standing", 20.0, -6.0), ("person b", 30.0, -9.0)], "right ahead", "person b"),
        ([("person a", 30.0, -6.0)], "ahead", ""),
    ],
)
def test_person_at_the_roadside_is_the_nearest_who_walks_and_can_step_out(monkeypatch, places, who, found):
    monkeypatch.setattr(_disturbances, "_walks", lambda actor: actor != "person standing")
    monkeypatch.setattr(_disturbances, "can_step_out", lambda actor, agent, reach, junctions: (
        (agent, reach, junctions) == ("ego", 4.5, "junctions") and actor != "person unable"
    ))  # fmt: skip
    for turn in (0.0, 1.0, -2.5):
        c, s = math.cos(turn), math.sin(turn)
        turned = [(name, 7.0 + x * c - y * s, 3.0 + x * s + y * c) for name, x, y in places]
        if any(abs(y) in (1.6, 15.0) or x in (0.0, 60.0) for _, x, y in places) and turn:
            continue  # at a limit, rounding decides
        scene = scene_of(*turned, ego=(7.0, 3.0, turn))
        assert _disturbances.roadside(scene, "ego", who, 4.5, "junctions") == found
        assert _disturbances.roadside(scene, "nobody", who, 4.5, "junctions") == ""


@pytest.mark.parametrize(("stage", "walks"), [(2, True), (1, False), (3, False)])
def test_person_walks_in_a_walking_stage(person, stage, walks):
    person.stage.type = stage
    assert _disturbances._walks("person p") is walks


class Junctions:
    def __init__(self, *lanes):
        self.lanes, self.asked = lanes, []

    def near(self, point, radius_m):
        self.asked.append((point, radius_m))
        return self.lanes


def lane(*shape, area=False):
    return _disturbances._JunctionLane(shape, walking_area=area)


def test_person_can_step_out_where_its_own_lane_stays_the_best(person, sumo):
    """Scores of the other lanes: by distance in lane widths, and by the angle that the person walks in."""

    def can(*lanes, reach=6.0):
        junctions = Junctions(*lanes)
        found = _disturbances.can_step_out("person p", "ego", reach, junctions)
        assert junctions.asked == [((30.0, -6.0), min(6.0, reach))]
        return found

    assert can()
    across = ((30.0, -3.0), (30.0, 20.0))  # a lane in the way of the person, and along it
    assert not can(lane(*across))
    assert not can(lane((29.0, 0.0), (31.0, 0.0)))  # parallel to its own lane, and nearer at the axis
    assert can(lane((29.0, -9.0), (31.0, -9.0)))  # parallel too, on the other side
    # Nearer by less than the margin, or the angle makes up for it.
    assert can(lane((29.0, 0.0), (31.0, 0.0)), reach=2.0)
    assert not can(lane((29.0, -6.1), (31.0, -6.1)), reach=0.1)  # within the margin of 0.05
    assert can(lane((29.0, -6.5), (31.0, -6.5)), reach=0.1)
    sumo.answers["person_getLanePosition"] = 99.5  # near the end of its lane, the margin is larger
    assert not can(lane((29.0, -6.5), (31.0, -6.5)), reach=0.1)
    assert can(lane((29.0, -8.5), (31.0, -8.5)), reach=0.1)
    sumo.answers["person_getLanePosition"] = 99.0
    assert can(lane((29.0, -6.5), (31.0, -6.5)), reach=0.1)
    sumo.answers["person_getRoadID"] = ":j_c0"
    assert not _disturbances.can_step_out("person p", "ego", 6.0, Junctions())


def test_lanes_beyond_whose_ends_a_person_is_do_not_count(person, sumo):
    reach = 0.1
    beside = ((40.0, -6.1), (60.0, -6.1))  # it begins 10 m ahead of the person
    assert _disturbances.can_step_out("person p", "ego", reach, Junctions(lane(*beside)))
    sumo.answers["lane_getShape"] = ((30.2, -6.0), (100.0, -6.0))  # the person is before the beginning of its own lane
    assert not _disturbances.can_step_out("person p", "ego", reach, Junctions(lane((29.0, -16.0), (31.0, -16.0))))
    assert _disturbances.can_step_out("person p", "ego", reach, Junctions(lane(*beside)))


def test_angle_does_not_count_against_a_walking_area(person, sumo):
    """On a crossing lane of the same distance, the angle decides; a walking area fits every angle."""
    for area, possible in ((False, True), (True, False)):
        other = lane((29.5, -3.4), (30.5, -3.4), area=area)
        assert _disturbances.can_step_out("person p", "ego", 0.6, Junctions(other)) is possible, area


def test_lanes_of_junctions_are_those_for_pedestrians_and_read_once(person, sumo):
    reads = []
    sumo.answers["lane_getIDList"] = lambda: reads.append(1) or (":j_w0_0", ":j_c1_0", ":j_5_0", ":j_6_0", "e_0")
    person.lanes = {":j_w0_0": [(0.0, 0.0), (2.0, 1.0)], ":j_c1_0": [(90.0, 0.0), (95.0, 5.0)], ":j_5_0": [(0.0, 0.0)],
                    ":j_6_0": [(0.0, 0.0), (0.0, 9.0)], "e_0": [(0.0, 0.0)]}  # fmt: skip
    person.allowed = {":j_w0_0": ("pedestrian",), ":j_c1_0": ("bicycle", "pedestrian"), ":j_5_0": ("bus",),
                      ":j_6_0": (), "e_0": ()}  # fmt: skip
    junctions = JunctionLanes()
    near = junctions.near((0.0, 0.0), 1.0)
    assert [(found.shape, found.walking_area) for found in near] == [
        (((0.0, 0.0), (2.0, 1.0)), True), (((0.0, 0.0), (0.0, 9.0)), False)
    ]  # fmt: skip
    assert (near[0].left, near[0].right, near[0].low, near[0].high) == (0.0, 2.0, 0.0, 1.0)
    reach = 15.0 + 3.2
    for x, y, count in ((90.0 - reach - 1.0, 2.0, 1), (95.0 + reach + 1.0, 2.0, 1), (92.0, -reach - 1.0, 1),
                        (92.0, 5.0 + reach + 1.0, 1), (92.0, 5.0 + reach + 1.1, 0)):  # fmt: skip
        assert len(junctions.near((x, y), 1.0)) == count
        assert len(junctions.near((x, y), 0.0)) == 0
    assert reads == [1]
    person.disallowed[":j_6_0"] = ("pedestrian",)
    assert len(JunctionLanes().near((0.0, 0.0), 1.0)) == 1
    assert all(map(_disturbances._WALKING_AREA.search, (":j_w0_0", ":j_w12_3")))
    assert not any(map(_disturbances._WALKING_AREA.search, (":j_c0_0", ":x_w_0", ":j_w0_0x")))


# Actions.


def driving(sumo, **setup):
    made = Driving({"ego": AgentSetup(route="r", **setup)}, 0.5, NETS / "lights.net.xml")
    made.begin(["ego"])
    made.left_hand = False
    sumo.answers |= {"edge_getLaneNumber": 3, "lane_getWidth": 3.0, "lane_getAllowed": (),
                     "vehicle_getVehicleClass": "passenger"}  # fmt: skip
    return made


@pytest.mark.parametrize(
    ("lane", "action", "stays", "commands"),
    [
        (1, (7.5, 0), True, [("setSpeed", "ego", 7.5)]),
        (1, (7.5, 1), True, [("setSpeed", "ego", 7.5), ("changeLane", "ego", 2, 0.5)]),
        (1, (7.5, -1), True, [("setSpeed", "ego", 7.5), ("changeLane", "ego", 0, 0.5)]),
        (2, (7.5, 1), False, [("setSpeed", "ego", 7.5)]),
        (0, (7.5, -1), False, [("setSpeed", "ego", 7.5)]),
    ],
)
def test_action_sets_the_speed_and_the_lane(sumo, lane, action, stays, commands):
    made = driving(sumo)
    sumo.answers["vehicle_getLaneIndex"] = lane
    assert made.apply("ego", np.array(action)) is stays
    assert sumo.taken() == commands
    sumo.answers["vehicle_getRoadID"] = ":j_0"
    assert made.apply("ego", np.array(action)) is True
    assert sumo.taken() == [("setSpeed", "ego", 7.5)]


def test_meta_actions_select_the_next_target_speed_and_lane(sumo):
    made = driving(sumo, action="meta", target_speeds=(5.0, 10.0, 20.0))
    index = {name: np.array([number]) for number, name in enumerate(META_ACTIONS)}
    sumo.answers["vehicle_getSpeed"] = 13.0  # nearest to 10
    speeds = []
    for name in ("IDLE", "FASTER", "FASTER", "SLOWER", "SLOWER", "SLOWER", "IDLE"):
        assert made.apply("ego", index[name]) is True
        ((_, _, speed),) = sumo.taken()
        speeds.append(speed)
    assert speeds == [10.0, 20.0, 20.0, 10.0, 5.0, 5.0, 5.0]
    for name, lane in (("LANE_LEFT", 2), ("LANE_RIGHT", 0)):
        made.apply("ego", index[name])
        assert sumo.taken() == [("setSpeed", "ego", 5.0), ("changeLane", "ego", lane, 0.5)]
    sumo.answers["vehicle_getLaneIndex"] = 2
    assert made.apply("ego", index["LANE_LEFT"]) is True  # ignored
    made.begin(["ego"])
    sumo.taken()
    sumo.answers["vehicle_getSpeed"] = 100.0
    made.apply("ego", index["IDLE"])
    assert sumo.taken() == [("setSpeed", "ego", 20.0)]


@pytest.mark.parametrize(
    ("left_hand", "change", "lane", "closed", "expected"),
    [
        (False, 1, 1, (), (True, 1)), (False, -1, 1, (), (True, -1)), (True, 1, 1, (), (True, -1)),
        (True, -1, 1, (), (True, 1)), (False, 1, 2, (), (False, 1)), (False, -1, 0, (), (False, -1)),
        (True, 1, 0, (), (False, -1)), (False, 1, 1, ("bus",), (False, 1)), (False, 1, 1, ("passenger",), (True, 1)),
    ],
)  # fmt: skip
def test_neighbouring_lane_is_on_the_named_side(sumo, left_hand, change, lane, closed, expected):
    made = driving(sumo)
    made.left_hand = left_hand
    sumo.answers |= {"vehicle_getLaneIndex": lane, "lane_getAllowed": closed}
    assert made.neighboring_lane("ego", change) == expected
    sumo.answers["vehicle_getRoadID"] = ":j_0"
    assert made.neighboring_lane("ego", change) is None


def test_distance_from_the_leftmost_lane_is_between_centre_lines(sumo):
    made = driving(sumo)
    widths = {"e_0": 2.0, "e_1": 3.0, "e_2": 4.0, "f_0": 3.2, "f_1": 3.2, "f_2": 3.2}
    sumo.answers["lane_getWidth"] = lambda lane: widths[lane]
    assert [made.from_left("e", lane) for lane in (2, 1, 0)] == [0.0, 3.5, 6.0]
    assert [made.from_left("f", lane) for lane in (2, 1, 0)] == [0.0, 3.2, 6.4]
    assert (made.lanes("e"), made.lanes("f")) == (3, 3)
    sumo.answers["lane_getWidth"] = 99.0  # each edge is read once
    made.left_hand = True
    assert [made.from_left("e", lane) for lane in (0, 1, 2)] == [0.0, 2.5, 6.0]


@pytest.mark.parametrize(("left_hand", "sign"), [(False, -1.0), (True, 1.0)])
def test_offset_to_the_right_has_the_sign_of_the_traffic(sumo, left_hand, sign):
    made = driving(sumo)
    made.left_hand = left_hand
    sumo.answers |= {"vehicle_getLateralLanePosition": 0.5, "vehicle_getLateralSpeed": 0.25}
    assert made.aside("ego") == (sign * 0.5, sign * 0.25)


@pytest.mark.parametrize(
    ("net", "left_hand"),
    [("left.net.xml", True), ("left-street.net.xml", True), ("left-grid.net.xml.gz", True), ("rand.net.xml.gz", False)],
)
def test_the_side_of_traffic_is_that_of_the_network_file(net, left_hand):
    assert Driving({}, 0.5, NETS / net).left_hand is left_hand


def test_holds_are_commands_that_end(sumo, monkeypatch):
    removed = []
    namespace = SimpleNamespace(vehicle=SimpleNamespace(remove=removed.append), TraCIException=libsumo.TraCIException)
    monkeypatch.setattr(_driving, "libsumo", namespace)
    assert _driving.hold_vehicle("nobody", "keep_lane") is None
    speed, lane = _driving.hold_vehicle("other", "keep_speed"), _driving.hold_vehicle("other", "keep_lane")
    assert (speed.how_strong, lane.how_strong) == (10.0, 1.0)
    assert sumo.taken() == [
        ("setSpeedMode", "other", 0),
        ("setSpeed", "other", 10.0),
        ("setLaneChangeMode", "other", 0),
    ]
    speed.keep(), lane.keep()
    assert sumo.taken() == []
    speed.end(), lane.end()
    assert sumo.taken() == [
        ("setSpeedMode", "other", 31),
        ("setSpeed", "other", -1.0),
        ("setLaneChangeMode", "other", 1621),
    ]
    away = _driving.hold_vehicle("other", "gone")
    assert (removed, away.how_strong) == (["other"], 1.0)
    away.keep(), away.end()
    assert sumo.taken() == []
