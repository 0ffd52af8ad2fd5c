"""What takes place around vehicles of SUMO, with its answers given: traffic events, and what a driver considers."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
from fake_sumo import FakeSumo

from crashhunt.sumo import _surroundings, _traffic_events
from crashhunt.sumo._traffic_events import HardBraking, SumoEvents
from crashhunt.world import Actor, Contact, Roster, Scene

MODULES = (_surroundings, _traffic_events)


@pytest.fixture
def sumo(monkeypatch):
    made = FakeSumo()
    for module in MODULES:
        monkeypatch.setattr(module, "sumo", made)
    return made


ROSTERS = {}


def scene_of(time_s=0.0, lanes=(), contacts=(), **places):
    """A scene with actors by name: x, y, heading and speed."""
    key = tuple(places)
    if key not in ROSTERS:
        ROSTERS[key] = Roster(tuple(Actor(name, "car", 4.0, 2.0, 1.5) for name in places))
    rows = [(*row, *(0.0, 0.0)[len(row) - 2 :]) if len(row) < 4 else row for row in places.values()]
    made = Scene(time_s, ROSTERS[key], [row[:2] for row in rows], [row[2] for row in rows], [row[3] for row in rows])
    made.contacts = contacts
    made.agent_lanes.update(lanes)
    return made


# Hard braking.


@pytest.fixture
def braking(sumo):
    """A vehicle f behind ego; each can brake with 4 m/s²."""
    sumo.answers |= {
        "vehicle_getFollower": lambda agent: ("f", 5.0) if agent == "ego" else ("", -1.0),
        "vehicle_getDecel": 4.0, "vehicle_getLeader": ("ego", 5.0), "vehicle_getLaneID": "e_0",
        "vehicle_getNextLinks": (), "lane_getInternalFoes": (),
    }  # fmt: skip

    def begin(limit=None, agents=("ego",)):
        made = HardBraking(0.5, limit)
        made.begin(agents, dict.fromkeys(agents))
        return made

    return begin


def after(made, was, now, lanes=(), agents=("ego",), name="f", **more):
    last = scene_of(0.0, ego=(20.0, 0.0, 0.0, 10.0), **{name: (0.0, 0.0, 0.0, was)})
    scene = scene_of(0.5, ego=(25.0, 0.0, 0.0, 10.0), **{name: (5.0, 0.0, 0.0, now)}, **more)
    return made.look(last, scene, agents, dict(lanes))


@pytest.mark.parametrize(
    ("limit", "was", "now", "found"),
    [
        (None, 10.0, 7.9, True), (None, 10.0, 8.0, False), (None, 10.0, 7.996, False), (None, 10.0, 7.994, True),
        (3.0, 10.0, 8.4, True), (3.0, 10.0, 8.5, False), (0.5, 10.0, 9.0, True), (0.5, 10.0, 9.1, False),
        (None, 7.9, 10.0, False),
    ],
)  # fmt: skip
def test_braking_is_hard_above_the_limit_of_the_type_or_of_the_scenario(braking, limit, was, now, found):
    """Weaker braking than 2 m/s² is never an event."""
    for more in ({}, {"new": (90.0, 0.0, 0.0, 0.0)}):  # the same actors, or others
        what = after(braking(limit), was, now, **more)
        decelerated = f"f braked at {(was - now) / 0.5:.1f} m/s² with ego ahead of it"
        assert what == ([("ego", "f", decelerated)] if found else [])


@pytest.mark.parametrize("name", ["ego2", "person p"])
def test_braking_of_agents_and_persons_is_no_event(braking, name):
    made = braking(agents=("ego", "ego2"))
    assert after(made, 20.0, 10.0, name=name) == []


@pytest.mark.parametrize(
    ("leader", "lane", "links", "foes", "lanes", "where"),
    [
        (("ego", 5.0), "e_0", (), (), {}, "ahead of it"),
        (("x", 5.0), "e_0", (("g", 0, 0, 0, ":j_1"),), (":j_2",), {"ego": ":j_2"}, ""),
        (None, "e_0", (("g", 0, 0, 0, ":j_1"),), (":j_2",), {"ego": ":j_2"}, "across its way"),
        (("", -1.0), ":j_1", (), (":j_2",), {"ego": ":j_2"}, "across its way"),
        (None, "e_0", (("g", 0, 0, 0, ":j_1"),), (":j_2",), {"ego": ":j_3"}, ""),
        (None, "e_0", (), (":j_2",), {"ego": ":j_2"}, ""),
    ],
)
def test_vehicle_brakes_because_of_what_is_ahead_or_across(braking, sumo, leader, lane, links, foes, lanes, where):
    sumo.answers |= {"vehicle_getLeader": lambda vehicle, most: leader if most == 100.0 else None,
                     "vehicle_getLaneID": lane, "vehicle_getNextLinks": links,
                     "lane_getInternalFoes": lambda way: foes if way == ":j_1" else ()}  # fmt: skip
    found = after(braking(), 20.0, 17.0, lanes)
    assert [what.partition("with ego ")[2] for _, _, what in found] == ([where] if where else [])


def test_agent_that_has_left_has_no_follower(braking):
    made = braking(agents=("ego", "away"))
    after(made, 10.0, 10.0, agents=("ego", "away"))
    assert made.followers == {"ego": "f"}


# Other events.


@pytest.fixture
def events(sumo, braking):
    sumo.answers |= {
        "vehicle_getStopState": 0, "simulation_getEmergencyStoppingVehiclesNumber": 0, "vehicle_getLanePosition": 7.0,
        "simulation_getStartingTeleportNumber": 0, "lane_getAngle": 90.0, "lane_getLinks": (),
        "vehicle_getLeader": None, "vehicle_getFollower": ("", -1.0), "vehicle_getLaneIndex": 0, "vehicle_getStops": (),
        "simulation_getStartingTeleportIDList": (), "simulation_getEndingTeleportIDList": (),
    }  # fmt: skip

    def begin(agents=("ego",), **limits):
        made = SumoEvents(0.5, limits)
        made.begin(scene_of(lanes={"ego": "e_0"}, ego=(0.0, 0.0, 0.0, 10.0)), agents, dict.fromkeys(agents))
        return made

    return begin


def looked(made, *rows, agents=("ego",), **more):
    """The kinds of events after each step; a step is the lane of ego and its row."""
    found = []
    for lane, row in rows:
        scene = scene_of(lanes={"ego": lane} if lane else {}, ego=row, **more)
        found.append([(event.kind, event.what) for event in made.look(scene, agents)])
    return found


def test_standstill_is_an_event_unless_it_is_planned(events, sumo):
    still = ("e_0", (0.0, 0.0, 0.0, 0.05))
    made = events(not_moving=1.5)
    assert [len(step) for step in looked(made, still, still, still, still)] == [0, 0, 1, 0]
    made = events(not_moving=1.5)
    assert [len(step) for step in looked(made, still, still)] == [0, 0]
    sumo.answers["vehicle_getStopState"] = 3
    looked(made, still)
    sumo.answers["vehicle_getStopState"] = 2  # no stop
    ((event,),) = looked(made, still, still, still)[2:]
    assert event == ("not_moving", "ego had stood still for 1.5 s")
    made = events(not_moving=0.5)
    assert looked(made, ("e_0", (0.0, 0.0, 0.0, 0.1))) == [[]]
    assert made.counted == ({}, 0.0, {}, 1)


def test_wrong_way_is_asked_when_the_lane_changes_and_every_tenth_step(events, sumo):
    def driving(x, lane="e_0"):
        return lane, (float(x), 0.0, 0.0, 10.0)

    made = events()
    assert not any(looked(made, *[driving(-5 * step) for step in range(9)]))
    assert made.is_quiet("ego")
    ((event,),) = looked(made, driving(-50))  # the tenth
    assert event == ("wrong_way", "ego drove the wrong way on lane e_0")
    assert not made.is_quiet("ego")
    assert made.is_quiet("two")
    assert not any(looked(made, *[driving(-50 - 5 * step) for step in range(1, 11)]))  # reported once
    looked(made, driving(-90, "e_1"))  # forwards again, on another lane
    assert made.is_quiet("ego")
    ((event,),) = looked(made, driving(-100, "e_0"))
    assert event[0] == "wrong_way"
    assert not any(looked(events(), driving(-5, ":j_0")))  # inside a junction, lanes bend


TURNS = [(0, False), (119, False), (121, True), (180, True), (241, False), (239, True)]


def test_course_against_the_lane_is_the_wrong_way(events, sumo):
    for angle in (0.0, 90.0, 200.0, 333.0):
        sumo.answers["lane_getAngle"] = lambda *where, angle=angle: {("e_1", 7.0): angle}[where]
        for turn, wrong in TURNS:
            course = math.radians(90.0 - angle + turn)
            for driven, counts in ((1.0, wrong), (0.051, wrong), (0.049, False)):
                row = (driven * math.cos(course), driven * math.sin(course), 0.0, 10.0)
                assert bool(looked(events(), ("e_1", row))[0]) == counts, (angle, turn, driven)


def test_red_light_is_run_where_all_shortest_ways_were_red(events, sumo):
    links = {
        "e_0": [("f_0", 1, 1, 1, ":j0_0", "r"), ("g_0", 1, 1, 1, ":j1_0", "G")],
        ":j0_0": [("f_0", 1, 1, 1, "", "M")], ":j1_0": [("g_0", 1, 1, 1, "", "M")],
        "f_0": [("h_0", 1, 1, 1, ":k_0", "g")], ":k_0": [("h_0", 1, 1, 1, "", "m")],
    }  # fmt: skip
    sumo.answers["lane_getLinks"] = lambda lane: links.get(lane, [])

    def entered(lane):
        made = events()
        return [what for kind, what in looked(made, (lane, (5.0, 0.0, 0.0, 10.0)))[0] if kind == "red_light"]

    said = "ego ran a red light at 10.0 m/s, coming from lane e_0"
    assert entered("e_1") == []
    for lane, count in ((":j0_0", 1), ("f_0", 1), ("f_1", 1), ("g_0", 0), (":j1_0", 0), ("h_0", 1), ("x_0", 0)):
        assert entered(lane) == [said] * count, lane
    for state, count in (("u", 1), ("y", 0), ("s", 0), ("G", 0), ("o", 0), ("O", 0)):
        links["e_0"][0] = ("f_0", 1, 1, 1, ":j0_0", state)
        assert entered("f_0") == [said] * count, state
    links["e_0"] = [("f_0", 1, 1, 1, ":j0_0", "r"), ("f_1", 1, 1, 1, ":j3_0", "G")]
    links[":j3_0"] = [("f_1", 1, 1, 1, "", "M")]
    assert entered("f_0") == []  # it may have come by the other way
    assert _traffic_events._ways_between("e_0", "nowhere") == []
    chain = {f"c{n}_0": [(f"c{n + 1}_0", 1, 1, 1, "", f"{n}")] for n in range(9)}
    sumo.answers["lane_getLinks"] = lambda lane: chain.get(lane, [])
    assert _traffic_events._ways_between("c0_0", "c6") == [("0", "1", "2", "3", "4", "5")]
    assert _traffic_events._ways_between("c0_0", "c7") == []


def test_missed_route_is_reported_once_for_a_lane(events, sumo):
    sumo.answers |= {
        "simulation_getEmergencyStoppingVehiclesNumber": 1,
        "simulation_getEmergencyStoppingVehiclesIDList": ("ego", "x"),
        "vehicle_getRoute": ("d", "e", "f"), "vehicle_getRouteIndex": 1, "lane_getLinks": [("g_0", 1, 1, 1, "", "M")],
    }  # fmt: skip
    here = ("e_0", (0.0, 0.0, 0.0, 0.0))
    made = events()
    said = "ego missed its route: it is at the end of lane e_0, which does not lead there"
    assert looked(made, here, here) == [[("off_route", said)], []]
    for answers in ({"vehicle_getRouteIndex": 2}, {"vehicle_getRouteIndex": -1}, {"vehicle_getRoute": ("d", "e", "g")},
                    {"simulation_getEmergencyStoppingVehiclesIDList": ("x",)},
                    {"simulation_getEmergencyStoppingVehiclesNumber": 0}):  # fmt: skip
        before = {name: sumo.answers[name] for name in answers}
        sumo.answers |= answers
        assert looked(events(), here) == [[]], answers
        sumo.answers |= before
    made = events()
    assert looked(made, (":j_0", (0.0, 0.0, 0.0, 0.0))) == [[]]
    assert len(looked(made, ("e_0", (0.0, 0.0, 0.0, 0.0)))[0]) == 1


def hit(collider, victim):
    return Contact(collider=collider, victim=victim, kind="collision", lane="e_0", collider_speed=1.0, victim_speed=1.0)


@pytest.mark.parametrize(
    ("pair", "x", "found"),
    [
        (("a", "b"), 50.0, "a drove into b, 46 m from ego"),
        (("a", "b"), 154.0, "a drove into b, 150 m from ego"),
        (("a", "b"), 154.5, ""),
        (("a", ""), 50.0, ""),
        (("ego", "b"), 50.0, ""),
        (("a", "ego"), 50.0, ""),
        (("a", "away"), 50.0, ""),
    ],
)
def test_collision_of_others_is_reported_near_an_agent(events, pair, x, found):
    made = events()
    made._braking.lately = {"b": ("ego", -5.0), "a": ("ego", -5.1)}
    scene = scene_of(0.0, {"ego": "e_0"}, (hit(*pair),), ego=(0.0, 0.0, 0.0, 10.0), a=(x, 0.0), b=(x + 2.0, 0.0))
    events_found = made.look(scene, ("ego",))
    assert [event.what.partition(";")[0] for event in events_found] == ([found] if found else [])
    if found:
        (event,) = events_found
        assert (event.others, event.agent, event.lane, event.x) == (("a", "b"), "ego", "e_0", 0.0)
        assert event.what.endswith("; b had braked hard 5.0 s before, with ego ahead")
        assert "a had braked" not in event.what


def test_teleports_are_those_of_agents_and_of_vehicles_near_them(events, sumo):
    sumo.answers |= {"simulation_getStartingTeleportNumber": 1,
                     "simulation_getStartingTeleportIDList": ("ego", "near", "far", "new")}  # fmt: skip
    made = events()
    last = scene_of(0.0, {"ego": "e_0"}, ego=(5.0, 6.0, 0.0, 10.0), near=(159.0, 6.0), far=(159.6, 6.0))
    made.resume(last, 4, {"ego": ""})
    found = made.look(scene_of(0.5, new=(5.0, 6.0)), ("ego",))
    assert [(event.agent, event.others, event.what) for event in found] == [
        ("ego", (), "SUMO teleported ego"), ("ego", ("near",), "SUMO teleported near, 150 m from ego")
    ]  # fmt: skip
    assert (found[0].x, found[0].y, found[0].speed, found[0].lane) == (5.0, 6.0, 10.0, "e_0")
    assert (found[1].x, found[1].lane) == (None, "") or found[1].lane == ""


def test_place_of_a_teleport_that_ends_in_its_own_step_is_the_place_before(events, sumo):
    """The lane was that after the teleport, 20 m from the position."""
    sumo.answers |= {"simulation_getStartingTeleportNumber": 1, "simulation_getStartingTeleportIDList": ("ego",)}
    made = events()
    made.resume(scene_of(0.0, {"ego": "e_0"}, ego=(5.0, 6.0, 0.0, 10.0)), 4, {"ego": ""})
    (found,) = made.look(scene_of(0.5, {"ego": "f_0"}, ego=(25.0, 6.0, 0.0, 15.0)), ("ego",))
    assert (found.x, found.speed, found.lane) == (5.0, 10.0, "e_0")


@pytest.mark.parametrize(
    ("one", "two", "gap"),
    [
        ((0.0, 0.0, 0.0), (10.0, 0.0, 0.0), 6.0), ((0.0, 0.0, 0.0), (0.0, 5.0, 0.0), 3.0),
        ((0.0, 0.0, 0.0), (10.0, 0.0, math.pi / 2), 9.0), ((0.0, 0.0, math.pi / 2), (0.0, 10.0, math.pi / 2), 6.0),
        ((0.0, 0.0, math.pi), (10.0, 0.0, 0.0), 2.0), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0),
        ((0.0, 0.0, 0.0), (10.0, 5.0, 0.0), math.hypot(6.0, 3.0)),
    ],
)  # fmt: skip
def test_gap_is_between_the_outlines(one, two, gap):
    """Places are those of the front bumpers; actors are 4 m long and 2 m wide."""
    assert _traffic_events._gap(scene_of(a=(*one, 0.0), b=(*two, 0.0)), "a", "b") == pytest.approx(gap)
    assert _traffic_events._gap(scene_of(a=(*one, 0.0), b=(*two, 0.0)), "b", "a") == pytest.approx(gap)


# Surroundings.


@pytest.fixture
def around(sumo):
    sumo.answers |= {
        "vehicle_getSpeed": lambda name: {"ego": 20.0, "back": -1.0}.get(name, 7.0),
        "vehicle_getDecel": lambda name: {"ego": 4.5, "weak": 0.0}.get(name, 3.0),
        "vehicle_getAccel": lambda name: 2.5 if name == "ego" else 1.5,
        "vehicle_getMinGap": lambda name: 2.5 if name == "ego" else 1.0, "person_getIDList": ("person",),
        "vehicle_getLeader": ("lead", 10.0), "vehicle_getNextTLS": (), "vehicle_getJunctionFoes": (),
        "vehicle_getLength": lambda name: 5.0 if name == "ego" else 4.0,
    }  # fmt: skip
    return sumo


def surrounded(lane=lambda agent, change: None):
    return _surroundings.surroundings_of("ego", lane)


def test_surroundings_have_the_vehicles_own_limits_and_its_leader(around):
    found = surrounded()
    assert (found.speed_mps, found.acceleration_mps2, found.braking_mps2) == (20.0, 2.5, 4.5)
    (lead,) = found.ahead
    assert (lead.actor, lead.gap_m, lead.speed_mps, lead.braking_mps2, lead.acceleration_mps2) == (
        "lead",
        12.5,
        7.0,
        3.0,
        1.5,
    )
    assert found.sides == {}
    for leader in (None, ("", -1.0), ("person", 3.0)):
        around.answers["vehicle_getLeader"] = leader
        assert surrounded().ahead == ()
    around.answers["vehicle_getLeader"] = ("weak", 1.0)
    assert surrounded().ahead[0].braking_mps2 == 0.5
    around.answers["vehicle_getSpeed"] = -3.0
    assert (surrounded().speed_mps, surrounded().ahead[0].speed_mps) == (0.0, 0.0)


@pytest.mark.parametrize(("speed", "look"), [(0.0, 60.0), (10.0, 60.0), (20.0, 120.0)])
def test_surroundings_reach_six_seconds_and_60_m(around, speed, look):
    asked = []
    around.answers |= {
        "vehicle_getSpeed": speed, "vehicle_getLeader": lambda agent, most: asked.append(most),
        "vehicle_getJunctionFoes": lambda agent, most: asked.append(most) or (),
        "vehicle_getNextTLS": [("t", 0, place, "r") for place in (0.0, -0.1, look, look + 0.1)],
    }  # fmt: skip
    assert [light.gap_m for light in surrounded().ahead] == [-1.0, look - 1.0]
    assert asked == [look, look]


def test_red_lights_are_ahead(around):
    around.answers |= {"vehicle_getLeader": None, "vehicle_getNextTLS": [("t", 0, 30.0 + n, state) for n, state in
                                                                        enumerate("ruRyYgGsoO")]}  # fmt: skip
    found = surrounded().ahead
    assert [(light.gap_m, light.actor, light.speed_mps, light.kind) for light in found] == [
        (29.0 + n, "", 0.0, "red light") for n in range(3)
    ]


def test_crossing_vehicles_are_those_of_which_one_has_to_yield(around):
    def foe(name, distance=10.0, exit_m=20.0, yields=True, foe_yields=False):
        return name, distance, 11.0, exit_m, 21.0, "e_0", "f_0", yields, foe_yields

    around.answers["vehicle_getJunctionFoes"] = [
        foe("a"), foe("b", yields=False, foe_yields=True), foe("c", yields=False), foe("d", exit_m=-5.0),
        foe("e", exit_m=-4.9),
    ]  # fmt: skip
    found = surrounded().crossing
    assert [crossing.actor for crossing in found] == ["a", "b", "e"]
    first, second, third = found
    assert (first.distance_m, first.exit_m, first.actor_distance_m, first.actor_exit_m) == (10.0, 25.0, 11.0, 25.0)
    assert (first.speed_mps, first.braking_mps2) == (7.0, 3.0)
    assert [first.has_right_of_way, second.has_right_of_way] == [True, False]
    assert third.exit_m == pytest.approx(0.1)


def test_sides_have_the_nearest_vehicles_of_their_lanes(around, monkeypatch):
    modes = {0: [("x", 9.0), ("y", 4.0)], 1: [], 2: [("z", 5.0), ("w", 3.0)], 3: [("v", 8.0)]}
    vehicle = SimpleNamespace(getNeighbors=lambda agent, mode: modes[mode])
    monkeypatch.setattr(_surroundings, "libsumo", SimpleNamespace(vehicle=vehicle))
    found = surrounded(lambda agent, change: (True, change)).sides
    assert list(found) == [1, -1]
    left, right = found[1], found[-1]
    assert [(one.actor, one.gap_m) for one in (left.ahead, left.behind, right.ahead)] == [
        ("w", 5.5),
        ("y", 5.0),
        ("v", 10.5),
    ]
    assert right.behind is None
    mirrored = surrounded(lambda agent, change: (True, -change)).sides
    assert mirrored[1].ahead.actor == "v"
    only = surrounded(lambda agent, change: (change == 1, change) if change == 1 else (False, change)).sides
    assert (only[1].exists, only[-1].exists, only[-1].ahead) == (True, False, None)
