"""Who is meant by a place around a vehicle of SUMO, and who can change lanes there, with the answers of SUMO given."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest

from crashhunt.sumo import _disturbances, _driving
from crashhunt.world import Actor, Roster, Scene


@pytest.fixture
def sumo(monkeypatch):
    """SUMO's answers on a vehicle in the middle of three lanes."""
    answers = {
        "vehicle_getRoadID": "e", "vehicle_getLaneIndex": 1, "edge_getLaneNumber": 3, "lane_getAllowed": (),
        "vehicle_getVehicleClass": "passenger", "vehicle_getLaneID": "e_1", "vehicle_getNextLinks": (),
        "vehicle_getLanePosition": 40.0,
    }  # fmt: skip
    made = SimpleNamespace(answers=answers)
    for name in answers:
        setattr(made, name, lambda *_, name=name: answers[name])
    monkeypatch.setattr(_disturbances, "sumo", made)
    for kind in ("_CutsIn", "_MergesLate"):
        monkeypatch.setattr(_disturbances, kind, lambda *given: given)
    return made


@pytest.mark.parametrize(
    ("side", "answers", "target"),
    [
        (1, {}, "e_2"),
        (-1, {}, "e_0"),
        (1, {"vehicle_getLaneIndex": 2}, None),
        (-1, {"vehicle_getLaneIndex": 0}, None),
        (1, {"vehicle_getRoadID": ":junction_0"}, None),  # lanes inside a junction lead elsewhere
        (1, {"vehicle_getRoadID": "e:"}, "e:_2"),
        (1, {"lane_getAllowed": ("bus", "bicycle")}, None),
        (1, {"lane_getAllowed": ("bus", "passenger")}, "e_2"),
    ],
)
def test_vehicle_cuts_in_only_where_it_may_drive(sumo, side, answers, target):
    sumo.answers |= answers
    found = _disturbances._cut_in("other", side, 3.0, 2.0, 0.1)
    assert found == (None if target is None else ("other", target, 2.0, 0.1, 3.0))


@pytest.mark.parametrize(
    ("lanes", "strong", "found"),
    [
        ([("e_0", 100.0, 0.5, 1, False), ("e_1", 100.0, 0.5, 1, False)], 30.0, (2, 100.0, 30.0)),
        ([("e_1", 100.0, 0.5, -1, False)], 30.0, (0, 100.0, 30.0)),
        ([("e_1", 100.0, 0.5, 1, False)], 90.0, (2, 100.0, 60.0)),  # no more than is left of the lane
        ([("e_1", 100.0, 0.5, 0, False)], 30.0, None),  # its lane continues
        ([("e_0", 100.0, 0.5, 1, False)], 30.0, None),
        ([("e_1", 40.0, 0.5, 1, False)], 30.0, None),
    ],
)
def test_vehicle_merges_late_only_where_its_lane_ends(sumo, monkeypatch, lanes, strong, found):
    vehicle = SimpleNamespace(getBestLanes=lambda name: lanes)
    monkeypatch.setattr(_disturbances, "libsumo", SimpleNamespace(vehicle=vehicle))
    expected = found and ("other", found[0], found[1], found[2])
    assert _disturbances._late_merge("other", strong) == expected


def test_way_of_a_vehicle_is_its_lane_inside_the_junction(sumo):
    assert _disturbances._way("other") == ""
    sumo.answers["vehicle_getNextLinks"] = (("f_0", True, True, False, ":j_3_0"), ("g_0", True, True, False, ":k_0"))
    assert _disturbances._way("other") == ":j_3_0"
    sumo.answers["vehicle_getLaneID"] = ":j_1_0"
    assert _disturbances._way("other") == ":j_1_0"


@pytest.mark.parametrize("heading", [0.0, math.pi / 2, 2.5, -1.0])
@pytest.mark.parametrize(
    ("ahead", "left", "place"),
    [
        (10.0, 0.0, "ahead"), (-10.0, 0.0, "behind"), (10.0, 1.5, "ahead"), (10.0, 1.7, "left ahead"),
        (10.0, -1.7, "right ahead"), (-10.0, 3.0, "left behind"), (-10.0, -3.0, "right behind"), (0.0, 3.0, "left"),
        (2.4, -3.0, "right"), (2.6, -3.0, "right ahead"), (-2.4, 3.0, "left"), (-2.6, 3.0, "left behind"),
    ],
)  # fmt: skip
def test_place_is_seen_from_the_vehicle(heading, ahead, left, place):
    c, s = math.cos(heading), math.sin(heading)
    there = (5.0 + ahead * c - left * s, 7.0 + ahead * s + left * c)
    actors = (Actor("other", "car", 9.0, 2.0, 1.5), Actor("ego", "car", 5.0, 2.0, 1.5))
    scene = Scene(0.0, Roster(actors), [there, (5.0, 7.0)], [0.0, heading], [1.0, 1.0])
    assert _disturbances._place(scene, 1, 0) == place


class Neighbours:
    """SUMO's answers on the vehicles in a lane and in the neighbouring lanes; minimum gaps are subtracted."""

    gaps = {"ego": 2.5, "a": 1.0, "b": 1.0, "c": 1.0, "d": 1.0}  # noqa: RUF012

    def __init__(self, leader=None, follower=None, lists=()):
        self.leader, self.follower, self.lists = leader, follower, dict(lists)
        self.asked = []

    def vehicle_getLeader(self, agent, most):  # noqa: N802
        return self.leader

    def vehicle_getFollower(self, agent, most):  # noqa: N802
        return self.follower

    def vehicle_getMinGap(self, name):  # noqa: N802
        return self.gaps[name]

    def vehicle_getNeighbors(self, agent, mode):  # noqa: N802
        self.asked.append(mode)
        return self.lists.get(mode, ())


@pytest.mark.parametrize(
    ("found", "name"), [(("a", 20.0), "a"), (None, ""), (("", -1.0), ""), (("a", 1e6), ""), (("a", -0.5), "a")]
)
def test_vehicle_in_the_lane_is_the_leader_or_the_follower(monkeypatch, found, name):
    monkeypatch.setattr(_disturbances, "sumo", Neighbours(leader=found))
    assert _disturbances._at("ego", "ahead", left_hand=False) == name
    assert _disturbances._at("ego", "behind", left_hand=False) == ""
    monkeypatch.setattr(_disturbances, "sumo", Neighbours(follower=found))
    assert _disturbances._at("ego", "behind", left_hand=False) == name
    assert _disturbances._at("ego", "ahead", left_hand=False) == ""


@pytest.mark.parametrize("left_hand", [False, True])
def test_vehicle_in_a_neighbouring_lane_is_the_nearest_there(monkeypatch, left_hand):
    left, right, ahead = _disturbances._LEFT, _disturbances._RIGHT, _disturbances._AHEAD
    if left_hand:
        left, right = right, left
    lists = {
        left | ahead: (("a", 20.0), ("b", 10.0)),  # from bumper to bumper, 22.5 and 12.5 m
        left: (("c", 5.0),),
        right: (("d", -3.0),),  # alongside: the gap of 1 m does not make up for it
    }
    for who, name in (
        ("left ahead", "b"), ("left behind", "c"), ("left", ""), ("right ahead", ""), ("right behind", ""),
        ("right", "d"),
    ):  # fmt: skip
        monkeypatch.setattr(_disturbances, "sumo", Neighbours(lists=lists))
        assert _disturbances._at("ego", who, left_hand=left_hand) == name, who
    # The gap of the rear vehicle counts: of the agent for those ahead, of the other vehicle for those behind.
    for lists, who, name in (
        ({left | ahead: (("a", -2.4),)}, "left ahead", "a"), ({left | ahead: (("a", -2.6),)}, "left", "a"),
        ({left: (("a", -0.9),)}, "left behind", "a"), ({left: (("a", -1.1),)}, "left", "a"),
        ({left: (("a", _disturbances._NEIGHBOUR_LANE_M),)}, "left behind", ""),
    ):  # fmt: skip
        monkeypatch.setattr(_disturbances, "sumo", Neighbours(lists=lists))
        assert _disturbances._at("ego", who, left_hand=left_hand) == name, (lists, who)


@pytest.mark.parametrize(
    ("allowed", "vehicle_class", "closed"),
    [
        ((), "truck", False),
        (("bus",), "truck", True),
        (("bus", "truck"), "truck", False),
        (("bus",), "ignoring", False),
    ],
)
def test_lane_is_closed_to_classes_that_it_does_not_name(monkeypatch, allowed, vehicle_class, closed, tmp_path):
    """No lane is closed to the class that ignores permissions."""
    asked = []
    monkeypatch.setattr(_driving.sumo, "lane_getAllowed", lambda lane: asked.append(lane) or allowed)
    driving = _driving.Driving({}, 0.1, tmp_path)
    assert [driving._is_closed("e_0", vehicle_class) for _ in range(2)] == [closed] * 2
    assert asked == ["e_0"]
