"""What is read from SUMO, with its answers given: actors in sight, bends, recorded starts, insertion, surveys."""

from __future__ import annotations

import math
from itertools import pairwise
from types import SimpleNamespace

import libsumo
import pytest
from fake_sumo import FakeSumo, gone

from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.scenario import AgentSetup
from crashhunt.sumo import _bent_vehicles, _insertion, _reported_collisions, _scene_reader, _scripted, _traffic_survey
from crashhunt.sumo._bent_vehicles import Bends
from crashhunt.sumo._scene_reader import Sight
from crashhunt.trial import ALL_AGENTS
from crashhunt.world import Actor

MODULES = (_bent_vehicles, _insertion, _scene_reader, _reported_collisions, _scripted, _traffic_survey)


@pytest.fixture
def sumo(monkeypatch):
    made = FakeSumo()
    for module in MODULES:
        monkeypatch.setattr(module, "sumo", made)
    return made


# Actors in sight.

ENDS = ("Starting", "Ending")


@pytest.fixture
def world(sumo):
    """Vehicles and persons by name: x, y, SUMO's angle and speed."""
    sumo.vehicles = {"ego": (0.0, 0.0, 90.0, 10.0), "near": (149.0, 0.0, 0.0, 5.0), "far": (151.0, 0.0, 180.0, 6.0)}
    sumo.persons = {}
    kinds = ("Departed", "Arrived", "StartingTeleport", "EndingTeleport", *(f"Parking{when}Vehicles" for when in ENDS))
    sumo.numbers = dict.fromkeys(kinds, 0)
    sumo.answers |= {
        "vehicle_getIDList": lambda: tuple(sumo.vehicles), "person_getIDList": lambda: tuple(sumo.persons),
        "person_getIDCount": lambda: len(sumo.persons), "simulation_getOption": "striping", "simulation_getTime": 1.5,
        "simulation_getCollisions": (), "person_getVehicle": "", "person_getLaneID": lambda name: f"{name}_walk",
        "vehicle_getLaneID": lambda name: f"{name}_0", "lane_getIDList": (), "vehicle_getStopState": 0,
        **{f"simulation_get{name}Number": lambda name=name: sumo.numbers[name] for name in sumo.numbers},
    }  # fmt: skip
    for kind, there, high in (("vehicle", sumo.vehicles, 7.0), ("person", sumo.persons, 6.0)):
        sumo.answers |= {
            f"{kind}_getPosition": lambda name, there=there: there[name][:2],
            f"{kind}_getAngle": lambda name, there=there: there[name][2],
            f"{kind}_getSpeed": lambda name, there=there: there[name][3],
            f"{kind}_getVehicleClass": "passenger" if kind == "vehicle" else "pedestrian",
            f"{kind}_getLength": 5.0 if kind == "vehicle" else 0.25, f"{kind}_getWidth": 1.8, f"{kind}_getHeight": 1.5,
            f"{kind}_getPosition3D": lambda name, there=there, high=high: (*there[name][:2], high),
            f"{kind}_getSlope": 45.0 if kind == "vehicle" else 0.0,
        }  # fmt: skip
    return sumo


def sight(*controlled, dt=0.1, speeds=None):
    return Sight(controlled or ("ego",), dt, lateral=False, speeds=speeds if speeds is not None else {})


def names(scene):
    return [actor.id for actor in scene.roster.actors]


def test_scene_has_the_actors_within_150_m_at_the_last_look_around(world):
    made = sight()
    scene = made.look(0, ())
    assert names(scene) == ["ego", "near"]
    assert (scene.points, [round(h, 9) for h in scene.headings], scene.speeds) == (
        [(0.0, 0.0), (149.0, 0.0)], [0.0, round(math.pi / 2, 9)], [10.0, 5.0]
    )  # fmt: skip
    assert (scene.time_s, scene.lanes, scene.heights) == (1.5, ("ego_0", "near_0"), [])
    world.vehicles["near"] = (200.0, 0.0, 0.0, 5.0)
    assert (names(made.look(9, ())), made.look(9, ()).lanes) == (["ego", "near"], ())
    assert names(made.look(10, ())) == ["ego"]
    world.vehicles["near"] = (150.0, 0.0, 0.0, 5.0)
    assert names(made.look(20, ())) == ["ego"]
    world.vehicles["near"] = (90.0, -119.9, 0.0, 5.0)
    assert names(made.look(30, ())) == ["ego", "near"]
    assert names(sight("ego", "far").look(0, ())) == ["ego", "near", "far"]
    assert names(sight("absent").look(0, ())) == []


@pytest.mark.parametrize("number", ["Departed", "Arrived", "StartingTeleport", "EndingTeleport"])
def test_look_around_follows_when_a_vehicle_enters_or_leaves(world, number):
    made = sight()
    made.look(0, ())
    world.vehicles["far"] = (100.0, 0.0, 0.0, 5.0)
    assert "far" not in names(made.look(1, ()))
    world.numbers[number] = 1
    assert "far" in names(made.look(2, ()))


def test_scene_of_a_teleport_is_not_swept(world):
    """A vehicle whose teleport ends in the same step stays in sight, and has driven no path."""
    made = sight()
    assert made.look(0, ()).swept
    world.numbers["StartingTeleport"] = 1
    assert not made.look(1, ()).swept


def test_vehicle_is_parked_until_the_step_after_sumo_puts_it_back(world):
    """SUMO moves the vehicle from the parking space to its lane only in that step."""
    made, state, lists = sight(), {"near": 0}, {}
    world.answers["vehicle_getStopState"] = lambda name: state.get(name, 0)
    world.answers |= {f"simulation_getParking{when}VehiclesIDList": lambda when=when: lists[when] for when in ENDS}

    def look(step, starting=(), ending=(), stops=0):
        state["near"] = stops
        for when, names_ in zip(ENDS, (starting, ending), strict=True):
            lists[when], world.numbers[f"Parking{when}Vehicles"] = names_, len(names_)
        return [actor.id for actor in made.look(step, ()).roster.actors if actor.parked]

    assert look(0) == []
    assert look(1, starting=("near", "far")) == []  # stopped on its lane, as some parking areas have it
    assert look(2, starting=("near",), stops=131) == ["near"]
    assert look(3, stops=131) == ["near"]
    assert made.plain is None or made.core is None
    assert look(4, ending=("near",), stops=131) == ["near"]
    assert look(5) == []
    state["near"] = 131
    assert [actor.parked for actor in sight().look(0, ()).roster.actors] == [False, True]  # seen when it is parked


@pytest.mark.parametrize(("dt", "every"), [(0.1, 10), (0.05, 10), (0.5, 2), (1.0, 1), (3.0, 1), (0.3, 3)])
def test_look_around_is_every_second_or_every_ten_steps(world, dt, every):
    made = sight(dt=dt)
    made.look(0, ())
    world.vehicles["far"] = (100.0, 0.0, 0.0, 5.0)
    found = [("far" in names(made.look(step, ()))) for step in range(1, every + 1)]
    assert found == [False] * (every - 1) + [True]


def test_lanes_are_read_in_each_tenth_scene_and_when_something_happens(world):
    made = sight()
    assert [bool(made.look(step, ()).lanes) for step in (0, 1, 9, 10, 11)] == [True, False, False, True, False]
    scene = made.look(12, ("ego",))
    assert (scene.lanes, scene.off_road) == (("ego_0", "near_0"), ("ego",))
    world.answers["simulation_getCollisions"] = [collision("a", "b")]
    assert made.look(13, ()).lanes
    assert made.look(14, ()).lanes == ()  # the same collision


def collision(collider, victim, kind="collision"):
    return SimpleNamespace(collider=collider, victim=victim, type=kind, lane="e_0", colliderSpeed=3.0, victimSpeed=2.0)


def test_contact_is_the_first_step_of_a_collision(world):
    made = sight()
    world.answers["simulation_getCollisions"] = [
        collision("a", "b"),
        collision("a", "p", "crossing"),
        collision("b", "a"),
    ]
    (first, person, back) = made.look(0, ()).contacts
    assert (first.collider, first.victim, first.kind, first.lane) == ("a", "b", "collision", "e_0")
    assert (first.collider_speed, first.victim_speed) == (3.0, 2.0)
    assert (person.victim, back.collider) == ("person p", "b")
    assert made.look(1, ()).contacts == ()
    made.reset()
    assert len(made.look(0, ()).contacts) == 3
    world.answers["simulation_getOption"] = "nonInteracting"
    assert len(sight().look(0, ()).contacts) == 2
    for kind in ("sharedLane", "junctionPedestrian", "walkingarea"):
        world.answers |= {"simulation_getCollisions": [collision("a", "p", kind)], "simulation_getOption": "striping"}
        assert sight().look(0, ()).contacts[0].victim == "person p"


def test_persons_are_actors_while_they_are_outside(world):
    speeds = {"q": 0.75}
    made = sight(speeds=speeds)
    world.persons |= {"p": (10.0, 5.0, 0.0, 1.0), "q": (20.0, 5.0, 270.0, 0.0), "away": (0.0, 500.0, 0.0, 1.0)}
    made.leaving.add("gone")
    world.persons["gone"] = (1.0, 1.0, 0.0, 0.0)
    speeds["q"] = 0.75
    scene = made.look(0, ())
    speeds["q"] = 0.75  # of a person that is moved
    scene = made.look(1, ())
    assert names(scene) == ["ego", "near", "person p", "person q"]
    assert (scene.points[2], scene.speeds[2:], [round(h, 9) for h in scene.headings[2:]]) == (
        (10.0, 5.0), [1.0, 0.75], [round(math.pi / 2, 9), round(-math.pi, 9)]
    )  # fmt: skip
    assert scene.roster.actors[2] == Actor("person p", "pedestrian", 0.25, 1.8, 0.0)
    assert made.look(10, ()).lanes == ("ego_0", "near_0", "p_walk", "q_walk")
    world.answers["person_getVehicle"] = lambda name: "bus" if name == "p" else ""
    assert names(made.look(11, ())) == ["ego", "near", "person q"]
    del world.persons["q"]
    assert names(made.look(12, ())) == ["ego", "near"]
    world.persons.clear()
    assert names(made.look(13, ())) == ["ego", "near"]
    world.persons["p"] = (10.0, 5.0, 0.0, 1.0)
    world.answers["person_getVehicle"] = ""
    assert "person p" in names(made.look(14, ()))
    world.answers["simulation_getOption"] = "nonInteracting"
    assert names(sight().look(0, ())) == ["ego", "near"]


def test_vehicle_that_is_taken_off_is_hidden_at_once(world):
    made = sight()
    made.look(0, ())
    made.lose("near")
    assert names(made.look(1, ())) == ["ego"]
    roster = made.roster
    made.lose("nobody")
    assert made.roster is roster
    made._see(("near",), ())
    assert [actor.id for actor in made.roster.actors] == ["near"]
    assert made.plain is None  # without the core
    assert made.reads_right()


@pytest.mark.parametrize(
    ("heights", "high"), [((0.0, 0.4), False), ((0.0, 0.6), True), ((0.0, -0.6), True), ((9.0, 9.0), False)]
)
def test_heights_are_read_where_the_network_has_them(world, heights, high):
    asked = []

    def convert(edge, place, index, geo):
        asked.append((edge, place, index, geo))
        return 0.0, 0.0, heights[place > 30.0]

    world.answers |= {"lane_getIDList": ("e_0", ":j_0_1"), "lane_getLength": 50.0, "simulation_convert3D": convert}
    world.persons["p"] = (10.0, 5.0, 0.0, 1.0)
    scene = sight().look(0, ())
    assert scene.heights == ([7.0, 7.0, 6.0] if high else [])
    assert [round(grade, 9) for grade in scene.grades] == ([1.0, 1.0, 0.0] if high else [])
    assert [place for edge, place, *_ in asked if edge == "e"] == pytest.approx([0.0, 50 / 3, 100 / 3, 50.0], abs=1e-5)
    assert {(edge, index, geo) for edge, _, index, geo in asked} == {("e", 0, False), (":j_0", 1, False)}
    assert [actor.height for actor in scene.roster.actors] == [1.5 if high else 0.0] * 3


def test_vehicles_of_another_episode_are_read_again(world):
    made = sight()
    made.look(0, ())
    world.answers["vehicle_getLength"] = 9.0
    made.look(10, ())
    assert made.roster.actors[0].length == 5.0
    made.reset()
    made.look(0, ())
    assert made.roster.actors[0].length == 9.0


def test_long_vehicles_have_spines(world):
    asked = []
    world.answers["vehicle_getLength"] = lambda name: 20.0 if name == "near" else 5.0
    made = sight()
    made._bends = SimpleNamespace(
        spine=lambda *given, high: asked.append((*given, high)) or "spine", reset=lambda: None
    )
    scene = made.look(0, ())
    assert scene.spines == {1: "spine"}
    ((vehicle, length, front, heading, high),) = asked
    assert (vehicle, length, front, round(heading, 9), high) == (
        "near",
        20.0,
        (149.0, 0.0),
        round(math.pi / 2, 9),
        False,
    )
    made._bends.spine = lambda *given, high: None
    assert made.look(1, ()).spines == {}


# Bends.


@pytest.mark.parametrize(
    ("kind", "length", "jointed"),
    [("passenger", 15.0, False), ("passenger", 15.1, True), ("rail", 6.0, False), ("tram", 6.1, True),
     ("trailer", 6.1, True), ("trailer", 6.0, False), ("bus", 14.0, False)],
)  # fmt: skip
def test_long_vehicles_have_joints(kind, length, jointed):
    assert _bent_vehicles.is_articulated(kind, length) is jointed


@pytest.fixture
def corner(sumo):
    """A road to the east, a junction, and a road to the north; a vehicle 10 m behind the corner."""
    shapes = {"e_0": [(0.0, 0.0), (100.0, 0.0)], ":j_0": [(100.0, 0.0), (110.0, 10.0)],
              "n_0": [(110.0, 10.0), (110.0, 100.0)], "e_1": [(0.0, 4.0), (100.0, 4.0)]}  # fmt: skip
    links = {"e_0": [("n_0", 1, 1, 1, ":j_0", "M")], ":j_0": [("n_0", 1, 1, 1, "", "M")]}
    sumo.shapes, sumo.links = shapes, links
    sumo.answers |= {
        "vehicle_getLaneID": "n_0", "lane_getEdgeID": lambda lane: lane.rpartition("_")[0],
        "vehicle_getLanePosition": 10.0, "vehicle_getRoute": ("e", "n"), "vehicle_getRouteIndex": 1,
        "lane_getShape": shapes.__getitem__, "lane_getIDList": lambda: tuple(shapes),
        "lane_getLinks": lambda lane: links.get(lane, ()), "vehicle_getLateralLanePosition": 1.0,
        "lane_getLength": lambda lane: sum(math.dist(a, b) for a, b in pairwise(shapes[lane])),
        "simulation_convert3D": lambda edge, place, index, geo: (0.0, 0.0, place),
    }  # fmt: skip
    return sumo


def spine(lateral=False, length=30.0, front=(110.0, 20.0), heading=math.pi / 2, high=False):
    return Bends(lateral=lateral).spine("v", length, front, heading, high=high)


def test_spine_follows_the_lanes_backwards(corner):
    found = spine()
    diagonal = math.sqrt(200.0)
    assert len(found) == 7
    assert found[0] == pytest.approx((110.0, 20.0, 0.0))
    assert found[2] == pytest.approx((110.0, 10.0, 0.0))
    share = 5.0 / diagonal
    assert found[3] == pytest.approx((110.0 - 10.0 * share, 10.0 - 10.0 * share, 0.0))
    assert found[6] == pytest.approx((100.0 - (20.0 - diagonal), 0.0, 0.0))
    lengths = [math.dist(a, b) for a, b in pairwise(found)]
    assert max(lengths) <= 5.0 + 1e-9


def test_spine_is_moved_to_the_side_where_vehicles_may_leave_the_centre(corner):
    found = spine(lateral=True, front=(109.0, 20.0))
    assert found[0] == pytest.approx((109.0, 20.0, 0.0))  # left of the lane to the north
    assert found[-1][1] == pytest.approx(1.0)  # left of the lane to the east
    mirrored = spine(lateral=True, front=(111.0, 20.0))  # as SUMO reports it in left-hand traffic
    assert mirrored[0] == pytest.approx((111.0, 20.0, 0.0))
    assert mirrored[-1][1] == pytest.approx(-1.0)
    assert spine(lateral=True, front=(112.5, 20.0)) is None  # on neither side


def test_straight_and_misplaced_vehicles_have_no_spine(corner):
    assert spine(length=9.0) is None
    assert spine(front=(111.2, 20.0)) is None
    assert spine(front=(110.9, 20.0)) is not None
    corner.answers["vehicle_getLaneID"] = ""
    assert spine() is None
    corner.answers |= {"vehicle_getLaneID": "e_0", "vehicle_getRouteIndex": 0, "vehicle_getLanePosition": 90.0}
    assert spine(front=(90.0, 0.0), heading=0.0) is None
    assert spine(front=(90.0, 0.0), heading=0.01) is not None  # its rectangle points elsewhere
    assert spine(front=(90.0, 0.0), heading=0.001) is None


def test_vehicle_behind_the_beginning_of_its_route_is_straight(corner):
    corner.answers |= {"vehicle_getRoute": ("n",), "vehicle_getRouteIndex": 0}
    assert spine() is None  # straight on, without the corner
    corner.answers |= {"vehicle_getRoute": ("x", "n"), "vehicle_getRouteIndex": 1}
    assert spine() is None  # of an edge that does not lead here, no lane is known


def test_heights_of_a_spine_are_those_of_its_lanes(corner):
    heights = {"n": 3.0, ":j": 2.0, "e": 1.0}
    corner.answers["simulation_convert3D"] = lambda edge, place, index, geo: (0.0, 0.0, heights[edge])
    assert [z for *_, z in spine(high=True)][::3] == [3.0, 2.0, 1.0]
    assert {z for *_, z in spine()} == {0.0}


def test_spine_keeps_to_the_lane_that_the_vehicle_has_used(corner):
    corner.shapes |= {":j_1": [(100.0, 4.0), (110.0, 10.0)]}
    corner.links |= {"e_1": [("n_0", 1, 1, 1, ":j_1", "M")], ":j_1": [("n_0", 1, 1, 1, "", "M")]}
    for used, y in (("e_0", 0.0), ("e_1", 4.0)):
        made = Bends(lateral=False)
        corner.answers |= {"vehicle_getLaneID": used, "vehicle_getLanePosition": 50.0, "vehicle_getRouteIndex": 0}
        made.spine("v", 30.0, (50.0, y), 0.0, high=False)
        corner.answers |= {"vehicle_getLaneID": "n_0", "vehicle_getLanePosition": 10.0, "vehicle_getRouteIndex": 1}
        found = made.spine("v", 40.0, (110.0, 20.0), math.pi / 2, high=False)
        assert found[-1][1] == pytest.approx(y)
        made.reset()
        again = made.spine("v", 40.0, (110.0, 20.0), math.pi / 2, high=False)
        assert again[-1][1] == pytest.approx(0.0)  # the first one, where nothing is known


@pytest.mark.parametrize(
    ("position", "asked"), [(-1.0, 0.0), (0.0, 0.0), (50.0, 50.0), (100.0, 100.0 - 1e-6), (101.0, 100.0 - 1e-6)]
)
def test_height_is_asked_within_the_lane(corner, position, asked):
    assert _bent_vehicles.height_at("e_0", position) == pytest.approx(asked, abs=1e-9)
    corner.answers["simulation_convert3D"] = (1.0, 2.0)
    assert _bent_vehicles.height_at("e_0", position) == 0.0


# Recorded paths.


@pytest.mark.parametrize(
    ("point", "along"),
    [((3.0, 4.0), 3.0), ((-5.0, 1.0), 0.0), ((12.0, 7.0), 17.0), ((10.0, 40.0), 30.0), ((9.0, 1.0), 9.0)],
)
def test_position_along_a_lane_is_that_of_the_nearest_point(sumo, point, along):
    sumo.answers |= {"lane_getShape": ((0.0, 0.0), (10.0, 0.0), (10.0, 0.0), (10.0, 20.0)), "lane_getLength": 30.0}
    assert _scripted._along("e_0", point) == pytest.approx(along)
    sumo.answers["lane_getLength"] = 60.0  # SUMO's length may be another than that of the shape
    assert _scripted._along("e_0", point) == pytest.approx(2.0 * along)
    sumo.answers |= {"lane_getShape": ((1.0, 1.0), (1.0, 1.0))}
    assert _scripted._along("e_0", point) == 0.0


# Insertion.


@pytest.fixture
def insertion(sumo, monkeypatch):
    """A simulation in which vehicles depart at given times."""
    made = SimpleNamespace(time=0.0, departs={}, gone=set(), calls=[], removed=[], dt=1.0)

    def present():
        return tuple(name for name, at in made.departs.items() if at <= made.time and name not in made.gone)

    def step(until=None):
        made.calls.append(("step", until))
        before, made.time = made.time, until if until is not None else made.time + made.dt
        made.departed = [name for name, at in made.departs.items() if before < at <= made.time]

    simulation = SimpleNamespace(
        getTime=lambda: made.time, getDepartedIDList=lambda: made.departed,
        getDepartedPersonIDList=lambda: made.persons,
        findRoute=lambda start, end, kind: SimpleNamespace(edges=made.route(start, end, kind)),
    )  # fmt: skip

    def add(name, *given, **named):
        """Let a vehicle depart at once, or in the next step where steps are simulated."""
        made.calls.append(("add", name, *given, named))
        made.departs[name] = made.time + (0.5 if ("step", None) in made.calls else 0.0)

    made.departed, made.persons, made.route = [], [], lambda *given: ("a", "b", "c")
    names = {"getTypeID": "car", "getLaneIndex": 2, "getLanePosition": 7.25, "getSpeed": 9.5, "getRouteIndex": 1,
             "getRoute": ("a", "b", "c")}  # fmt: skip
    vehicle = SimpleNamespace(
        **{name: lambda vehicle, value=value: value for name, value in names.items()},
        add=add,
        remove=lambda name: made.calls.append(("remove", name)),
    )  # fmt: skip
    library = SimpleNamespace(
        simulation=simulation, simulationStep=step, vehicle=vehicle, TraCIException=libsumo.TraCIException,
        FatalTraCIError=libsumo.FatalTraCIError,
        route=SimpleNamespace(add=lambda *given: made.calls.append(("route", *given))),
        person=SimpleNamespace(removeStages=lambda name: made.calls.append(("removeStages", name))),
    )  # fmt: skip
    monkeypatch.setattr(_insertion, "libsumo", library)
    sumo.answers["vehicle_getIDList"] = present
    made.sumo = sumo
    return made


def scenario(**given):
    return SimpleNamespace(**{"warmup_s": 0.0, "insertion_timeout_s": 5.0, **given})


EXISTING = AgentSetup(existing=True)


def test_new_vehicle_is_added_with_its_setup(insertion):
    setup = AgentSetup(route="r", type="car", depart_lane="1", depart_pos="20", depart_speed="8", speed_mode=5)
    _insertion.enter(scenario(), {"ego": setup}, {}, None)
    given = {"departLane": "1", "departPos": "20", "departSpeed": "8", "depart": "now"}
    assert insertion.calls == [("add", "ego", "r", "car", given)]  # it is there at once
    assert insertion.sumo.calls == [("setSpeedMode", "ego", 5), ("setLaneChangeMode", "ego", 0)]


@pytest.mark.parametrize(
    ("edges", "found", "asked"),
    [(("a", "c"), ["a", "b", "c"], [("a", "c", "car")]), (("a", "b", "c"), ["a", "b", "c"], []), (("a",), ["a"], [])],
)
def test_route_between_two_edges_is_searched(insertion, edges, found, asked):
    searched = []
    insertion.route = lambda *given: searched.append(given) or ("a", "b", "c")
    _insertion.enter(scenario(), {"ego": AgentSetup(edges=edges, type="car")}, {}, None)
    assert insertion.calls[0] == ("route", "crashhunt.ego", found)
    assert insertion.calls[1][:3] == ("add", "ego", "crashhunt.ego")
    assert searched == asked
    if asked:
        insertion.route = lambda *given: ()
        with pytest.raises(InvalidEpisodeError, match="there is no route from 'a' to 'c'"):
            _insertion._add("ego", AgentSetup(edges=edges, type="car"))


@pytest.mark.parametrize(("depart_s", "now", "depart"), [(7.0, 3.0, "7.0"), (7.0, 9.0, "9.0"), (None, 9.0, "now")])
def test_vehicle_departs_at_its_time_and_not_before_now(insertion, depart_s, now, depart):
    insertion.time = now
    _insertion._add("ego", AgentSetup(route="r", depart_s=depart_s))
    assert insertion.calls[0][-1]["depart"] == depart


@pytest.mark.parametrize(("warmup_s", "begin", "steps"), [(0.0, 0.0, []), (4.0, 3.0, [("step", 7.0)])])
def test_traffic_is_warmed_up_for_its_time(insertion, warmup_s, begin, steps):
    insertion.time, insertion.departs = begin, {"ego": -1.0}
    _insertion.enter(scenario(warmup_s=warmup_s), {"ego": EXISTING}, {}, None)
    assert insertion.calls == steps
    warmed = []
    taking_part = SimpleNamespace(warm_up=warmed.append, remove=lambda: warmed.append("remove"))
    insertion.time, insertion.calls = begin, []
    _insertion.enter(scenario(warmup_s=warmup_s), {"ego": EXISTING}, {}, taking_part)
    assert (warmed, insertion.calls) == ([begin + warmup_s] if warmup_s else [], [])


def test_agents_are_waited_for_until_their_time_is_over(insertion):
    insertion.departs = {"ego": 5.0, "two": 2.0}
    removed = []
    taking_part = SimpleNamespace(remove=lambda: removed.append(insertion.time))
    _insertion.enter(scenario(), {"ego": EXISTING, "two": EXISTING}, {}, taking_part)
    assert insertion.time == 5.0
    assert removed == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert [call[1] for call in insertion.sumo.calls] == ["ego", "ego", "two", "two"]
    insertion.time, insertion.departs = 0.0, {"ego": 5.5}
    with pytest.raises(
        InvalidEpisodeError, match="the vehicle 'ego' was not on the road 5 s after it should have entered"
    ):
        _insertion.enter(scenario(), {"ego": EXISTING}, {}, None)
    assert insertion.time == 5.0
    insertion.time, insertion.departs = 0.0, {"ego": 9.5}
    _insertion.enter(scenario(), {"ego": AgentSetup(existing=True, depart_s=5.0)}, {}, None)  # 5 s after that
    insertion.time, insertion.departs = 20.0, {"ego": 24.5}
    _insertion.enter(scenario(), {"ego": AgentSetup(existing=True, depart_s=5.0)}, {}, None)
    insertion.time, insertion.departs, insertion.gone = 0.0, {"ego": 1.0, "two": 3.0}, {"ego"}
    with pytest.raises(InvalidEpisodeError, match="the vehicle 'ego' had left again before all"):
        _insertion.enter(scenario(), {"ego": EXISTING, "two": EXISTING}, {}, None)


def test_vehicle_of_the_traffic_is_replaced_where_it_departs(insertion):
    insertion.departs = {"v": 2.0, "x": 1.0}
    setups = {"ego": AgentSetup(replaces="vehicle")}
    _insertion.enter(scenario(), setups, {"v": "ego"}, None)
    given = {"departLane": "2", "departPos": "7.25", "departSpeed": "9.5", "depart": "now"}
    assert [call for call in insertion.calls if call[0] != "step"] == [
        ("route", "crashhunt.ego", ("b", "c")), ("remove", "v"), ("add", "ego", "crashhunt.ego", "car", given)
    ]  # fmt: skip
    insertion.time, insertion.departs, insertion.calls = 0.0, {"v": 99.0}, []
    with pytest.raises(InvalidEpisodeError, match="the vehicle 'v' was not on the road"):
        _insertion.enter(scenario(), setups, {"v": "ego"}, None)
    insertion.time, insertion.departs = 0.0, {"v": 3.0}
    with pytest.raises(
        InvalidEpisodeError, match="the vehicle 'v' had departed in the warm-up already; lower warmup_s"
    ):
        _insertion.enter(scenario(warmup_s=4.0), setups, {"v": "ego"}, None)
    insertion.time, insertion.departs = 0.0, {"v": 5.0}
    _insertion.enter(scenario(warmup_s=4.0), setups, {"v": "ego"}, None)


def test_agents_replace_different_vehicles():
    setups = {"a": AgentSetup(replaces="x"), "b": AgentSetup(replaces="y"), "c": AgentSetup(route="r")}
    assert _insertion.replaced_by(setups, {"x": "v1", "y": 7}) == {"v1": "a", "7": "b"}
    with pytest.raises(InvalidEpisodeError, match="a and b both replace the vehicle 'v1'"):
        _insertion.replaced_by(setups, {"x": "v1", "y": "v1"})


def test_steps_of_the_set_up_are_counted_also_after_an_error(insertion):
    def fails():
        with _insertion.steps_counted(simulator, 0.5):
            insertion.time = 7.2
            raise KeyError

    simulator = SimpleNamespace(setup_steps=0)
    insertion.time = 3.0
    with pytest.raises(KeyError):
        fails()
    assert simulator.setup_steps == 8
    simulator.setup_steps = 0
    with _insertion.steps_counted(simulator, 0.5):
        _insertion.libsumo.simulation.getTime = gone
    assert simulator.setup_steps == 0


@pytest.mark.parametrize(
    ("stay", "left"),
    [((), ["a", "b", "p"]), (("a",), ["b", "p"]), (("a", "person p"), ["b"]), (("a", "p"), ["b", "p"]),
     ((ALL_AGENTS,), [])],
)  # fmt: skip
def test_excluded_actors_are_removed_when_they_enter(insertion, stay, left):
    leaving = set()
    made = _insertion.VehicleFilter(stay, leaving)
    insertion.departs, insertion.persons = {"a": 1.0, "b": 1.0}, ["p"]
    made.warm_up(2.0)
    assert [call for call in insertion.calls if call[0] != "step"][: len(left)] == [
        ("removeStages" if name == "p" else "remove", name) for name in left
    ]
    assert insertion.calls.count(("step", None)) == 2
    assert leaving == ({"p"} if "p" in left else set())
    assert made.entered[:3] == ["a", "b", "person p"]


# The survey of a scenario's traffic.


@pytest.fixture
def survey(sumo, monkeypatch):
    """Traffic that a function of the time gives: the present vehicles, each with class, speed and stop state."""
    made = SimpleNamespace(time=10.0, dt=1.0, traffic=lambda time: {}, seen=set(), expected=1, calls=[], clock=0.0,
                           parked=(), classes={})  # fmt: skip

    def step():
        made.time += made.dt
        new = [name for name in made.traffic(made.time) if name not in made.seen]
        made.seen |= {*new}
        made.departed = [*new, *made.passing]

    made.departed, made.passing = [], []
    simulation = SimpleNamespace(
        getTime=lambda: made.time, getDeltaT=lambda: made.dt, getDepartedIDList=lambda: made.departed,
        getMinExpectedNumber=lambda: made.expected,
    )  # fmt: skip
    library = SimpleNamespace(
        simulation=simulation, simulationStep=step, isLoaded=lambda: bool(made.calls),
        load=lambda command: made.calls.append(("load", command)),
        start=lambda command: made.calls.append(("start", command)),
        vehicle=SimpleNamespace(isStoppedParking=lambda name: name in made.parked),
    )  # fmt: skip
    monkeypatch.setattr(_traffic_survey, "libsumo", library)
    monkeypatch.setattr(_traffic_survey, "time", SimpleNamespace(process_time=lambda: made.clock))
    sumo.answers |= {
        "vehicle_getIDList": lambda: tuple(made.traffic(made.time)),
        "vehicle_getVehicleClass": lambda name: made.classes.get(name, "passenger"),
        "vehicle_getSpeed": lambda name: made.traffic(made.time)[name][0],
        "vehicle_getStopState": lambda name: made.traffic(made.time)[name][1],
    }  # fmt: skip
    files = SimpleNamespace(arguments=lambda seed, values: [seed, values])
    made.run = lambda: _traffic_survey._run(files, 7, {"scale": 1.0}, 99.0)
    return made


def test_survey_ends_600_s_after_the_first_road_vehicle(survey):
    survey.traffic = lambda time: {"v": (9.0, 0)} if time >= 13.0 else {}
    found = survey.run()
    assert found["entries"] == [("v", 13.0, "passenger", False)]
    assert (found["begin_s"], found["end_s"], found["steps"]) == (10.0, 615.0, 605)
    assert (found["gridlock"], found["cut_short"], found["out_of_time"]) == (None, False, False)
    survey.expected = 0
    survey.run()
    assert survey.calls == [("start", ["sumo", 7, {"scale": 1.0}]), ("load", [7, {"scale": 1.0}])]


@pytest.mark.parametrize(("parked", "kind"), [(("v",), "passenger"), ((), "rail"), ((), "ship")])
def test_survey_waits_an_hour_for_a_vehicle_on_the_road(survey, parked, kind):
    survey.traffic, survey.parked, survey.classes = (lambda time: {"v": (9.0, 0)}), parked, {"v": kind}
    found = survey.run()
    assert found["entries"] == [("v", 11.0, kind, bool(parked))]
    assert found["end_s"] == 3615.0  # looked at every 5 s, from 10 s on


def test_survey_omits_vehicles_that_have_left_in_the_same_step_and_ends_with_the_traffic(survey):
    survey.passing, survey.expected = ["gone"], 0
    found = survey.run()
    assert (found["entries"], found["end_s"], found["cut_short"]) == ([], 15.0, False)


def test_survey_without_traffic_is_cut_short(survey, monkeypatch):
    monkeypatch.setattr(_traffic_survey, "MAX_STEPS_BEFORE_FIRST_ENTRY", 20)
    found = survey.run()
    assert (found["steps"], found["cut_short"]) == (20, True)
    monkeypatch.setattr(_traffic_survey, "MAX_VEHICLE_STEPS", 30)
    survey.traffic = lambda time: {"a": (9.0, 0), "b": (9.0, 0)}
    found = survey.run()
    assert (found["steps"], found["cut_short"], found["out_of_time"]) == (20, True, False)  # 10 vehicle steps a look
    survey.clock = 99.0
    found = survey.run()
    assert (found["steps"], found["cut_short"], found["out_of_time"]) == (5, True, True)
    survey.dt = 10.0
    assert survey.run()["steps"] == 1


@pytest.mark.parametrize(
    ("standing", "moving", "stopped", "jam"),
    [(5, 0, 0, True), (4, 0, 0, False), (19, 1, 0, True), (18, 1, 0, False), (5, 0, 3, True), (4, 0, 3, False)],
)
def test_gridlock_is_a_standstill_of_nearly_all_for_two_minutes(survey, standing, moving, stopped, jam):
    traffic = {f"s{n}": (0.09, 2) for n in range(standing)} | {f"m{n}": (0.1, 0) for n in range(moving)}
    traffic |= {f"p{n}": (0.0, 1) for n in range(stopped)}
    survey.traffic = lambda time: traffic if time > 15 else dict.fromkeys(traffic, (9.0, 0))
    found = survey.run()
    if jam:
        assert found["gridlock"] == {"since_s": 20.0, "standing": standing, "vehicles": standing + moving}
        assert found["end_s"] == 20.0 + 115.0
    else:
        assert found["gridlock"] is None
