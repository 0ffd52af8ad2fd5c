"""Routes, arguments and texts of a made scenario, from the files that SUMO's programs would write."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest

from crashhunt.base.errors import ScenarioError
from crashhunt.sumo.maps import MapSource, _make
from crashhunt.sumo.maps._folder import arguments_of
from crashhunt.sumo.maps._make import MadeScenario, PlainTrial, _busiest, _thin_traffic
from crashhunt.sumo.maps._road_network import Edge, NetworkLane, RoadNetwork
from crashhunt.sumo.maps._traffic import (
    RUN_S,
    Demand,
    PlainRun,
    Route,
    _counted,
    _entry_capacity,
    find_demand,
    route_file,
)


def edge(name, length_m=100.0, speed_mps=10.0, *, lanes=1, disallowed=()):
    lane = NetworkLane(length_m=length_m, speed_mps=speed_mps, allowed=None, disallowed=frozenset(disallowed), shape=())
    return Edge(name, "", (lane,) * lanes)


def network(*edges):
    return RoadNetwork(edges={one.id: one for one in edges})


TOWN = network(
    edge("a", 400.0), edge("b", 600.0, 20.0, lanes=2), edge("c", 200.0), edge("way", 30.0, disallowed=("passenger",))
)


class Tools:
    """In place of SUMO's programs: each call writes the next of `files`; `words` are the options of each call."""

    def __init__(self, *files):
        self.files, self.words = list(files), []

    def run(self, program, words, folder):
        assert program == "randomTrips.py"
        assert not (folder / "routes.xml").exists() or "walks.xml" in words
        found = dict(pairwise(words))
        self.words.append(found)
        content = self.files.pop(0)
        if content is not None:
            (folder / found["--route-file"]).write_text(content)


def routes(*ways, tag="route"):
    return "<routes>" + "".join(f'<vehicle><{tag} edges="{way}"/></vehicle>' for way in ways) + "</routes>"


def test_demand_has_each_drivable_route_with_its_weight(tmp_path):
    tools = Tools(routes("a b", "a b", "b c", "a way", "a gone"), routes("a c", "c", "c a", tag="walk"))
    found = find_demand(TOWN, tools, tmp_path, net="n.xml", people=True)
    assert found.routes == (
        Route(id="r0", edges=("a", "b"), weight=2, length_m=1000.0, free_s=70.0),
        Route(id="r1", edges=("b", "c"), weight=1, length_m=800.0, free_s=50.0),
    )
    assert found.walks == (("a", "c"), ("c", "a"))
    assert found.ego_routes == ("r0", "r1")
    # 6 vehicles on each of 1.8 km of lane; a trip takes 1.6 times as long as on free roads.
    trip_s = 1.6 * (2 * 70 + 50) / 3
    assert found.vehicles_per_hour == pytest.approx(6 * 1.8 / trip_s * 3600)
    first, walks = tools.words
    common = {"--net-file": "n.xml", "--period": "1", "--seed": "42", "--threads": "1"}
    own = {"--end": "300", "--vehicle-class": "passenger", "--fringe-factor": "10", "--min-distance": "300"}
    assert (common | own).items() <= first.items()
    assert (common | {"--end": "96", "--max-distance": "600"}).items() <= walks.items()
    assert {"--persons", "--validate"} <= walks.keys()
    assert {"--lanes", "--length", "--remove-loops", "--validate"} <= first.keys()
    assert [rate for _, rate in found.rates()] == pytest.approx(
        [found.vehicles_per_hour * 2 / 3, found.vehicles_per_hour / 3]
    )


def test_small_map_has_shorter_routes_or_single_roads(tmp_path):
    tools = Tools(routes("a b"), routes("a b", "c"))
    found = find_demand(TOWN, tools, tmp_path, net="n.xml", people=False)
    assert [route.edges for route in found.routes] == [("a", "b"), ("c",)]
    assert [words["--min-distance"] for words in tools.words] == ["300", "0"]
    assert found.walks == ()
    (tmp_path / "routes.xml").unlink()
    tools = Tools(None, None)
    found = find_demand(TOWN, tools, tmp_path, net="n.xml", people=False)
    assert [route.edges for route in found.routes] == [("a",), ("b",), ("c",)]
    assert [route.weight for route in found.routes] == [1, 1, 1]
    short = network(edge("a", 49.0), edge("b", 50.0))
    assert [route.edges for route in find_demand(short, Tools(None, None), tmp_path, net="n", people=False).routes] == [
        ("b",)
    ]
    with pytest.raises(ScenarioError, match="the map has no route that a car can drive; choose a larger part"):
        find_demand(network(edge("a", 9.0)), Tools(None, None), tmp_path, net="n", people=False)


def test_traffic_of_a_map_is_neither_tiny_nor_huge_nor_more_than_its_entries_take(tmp_path):
    def per_hour(*edges):
        return find_demand(network(*edges), Tools(None, None), tmp_path, net="n", people=False).vehicles_per_hour

    assert per_hour(edge("a", 100.0)) == pytest.approx(min(4 / 16.0 * 3600, 800.0))  # at least 4 on the road
    assert per_hour(edge("a", 100000.0, lanes=2)) == pytest.approx(100 / 16000.0 * 3600)  # at most 100
    assert per_hour(edge("a", 5.0 + 45.0, 100.0)) == 800.0  # of a lane
    ways = [Route(id=name, edges=edges, weight=weight, length_m=1.0, free_s=1.0) for name, edges, weight in
            (("r0", ("a", "b"), 3), ("r1", ("b",), 1), ("r2", ("a",), 2))]  # fmt: skip
    assert _entry_capacity(TOWN, ways, 6) == pytest.approx(800 * 6 / 5)
    assert _entry_capacity(TOWN, ways[1:2], 1) == 1600.0


def test_routes_in_a_file_are_counted_in_its_order(tmp_path):
    file = tmp_path / "x.xml"
    assert _counted(file, "route") == {}
    file.write_text(
        '<r><route edges="b a"/><route edges="a"/><route edges="b a"/><route edges=""/><walk edges="c"/></r>'
    )
    assert list(_counted(file, "route").items()) == [(("b", "a"), 2), (("a",), 1)]
    assert _counted(file, "walk") == {("c",): 1}


DEMAND = Demand(
    routes=(Route(id="r0", edges=("a", "b"), weight=1, length_m=1000.0, free_s=70.0),), vehicles_per_hour=720.0,
    walks=(("a", "c"), ("c", "a")), ego_routes=("r0", "r1"),
)  # fmt: skip


def test_arguments_of_a_made_scenario_have_usual_defaults_and_ranges():
    found = [(one.name, one.default, one.range, one.unit, one.option) for one in
             arguments_of(DEMAND, (0.5, 2.0), bicycles=True)]  # fmt: skip
    assert found == [
        ("demand", 1.0, "0.5:2", "", "scale"), ("imperfection", 0.5, "0:1", "", ""),
        ("speed_spread", 0.1, "0:0.2", "", ""), ("trucks_per_100_cars", 10, "0:30", "trucks", ""),
        ("cyclists_per_100_cars", 15, "0:50", "cyclists", ""), ("persons_per_path", 30, "10:120", "persons/h", ""),
        ("ego_route", "r0", "r0|r1", "", ""),
    ]  # fmt: skip
    plain = replace(DEMAND, walks=(), ego_routes=("r1",))
    few = arguments_of(plain, (1.5, 2.0), bicycles=False)
    assert [one.name for one in few] == ["demand", "imperfection", "speed_spread", "trucks_per_100_cars", "ego_route"]
    assert (few[0].default, few[-1].default, few[-1].range) == (1.5, "r1", "")
    assert arguments_of(plain, (0.1, 0.5), bicycles=False)[0].default == 0.5
    assert "720 vehicles/h" in few[0].help


def test_route_file_has_flows_of_vehicles_and_persons():
    text = route_file(DEMAND, TOWN, bicycles=True)
    for line in (
        '<vType id="car" sigma="${imperfection}" speedFactor="normc(1,${speed_spread},0.5,1.5)"/>',
        '<vType id="truck" vClass="truck" sigma="${imperfection}" speedFactor="normc(0.85,${speed_spread},0.5,1.1)"/>',
        '<vType id="ego" color="yellow" accel="3" decel="8" emergencyDecel="9"/>',
        '<vTypeDistribution id="cars" vTypes="car" probabilities="100"/>',
        '<vTypeDistribution id="cars-trucks" vTypes="car truck" probabilities="100 ${trucks_per_100_cars}"/>',
        '<route id="r0" edges="a b"/>',
        '<routeDistribution id="ego-route" routes="${ego_route}"/>',
        '<flow id="r0" type="cars-trucks-cyclists" route="r0" begin="0" end="86400" period="exp(0.2)"',
        ' departLane="best" departSpeed="max" departPos="base"/>',
        '<personFlow id="w0" begin="0.0" end="86400" perHour="${persons_per_path}">',
        '<personFlow id="w1" begin="60.0" end="86400" perHour="${persons_per_path}">',
        '<walk edges="c a"/>',
    ):
        assert line in text
    assert "cyclist" not in route_file(DEMAND, TOWN, bicycles=False)


RUN = PlainRun(
    demand=2.0, wanted=100, entered=99, arrived=80, running=19, halting=2, teleports=0, collisions=0,
    mean_speed_mps=11.5, persons=7, edge_vehicles={"a": 60.0, "b": 90.0, "c": 30.0, "gone": 99.0, "way": 0.0},
    probe_delays_s={"r0": 0.5, "r1": 2.25},
)  # fmt: skip


def made(**more):
    given = {"folder": None, "source": MapSource(kind="grid", shape=(2, 2)), "network": TOWN, "demand": DEMAND,
             "plain": RUN, "busy": RUN, "steps": 100, "notes": (), "agent": "keep-lane"}  # fmt: skip
    return MadeScenario(**given | more)


def test_busiest_roads_are_of_different_streets_by_vehicles_per_hour():
    found = _busiest(made())
    assert found == [(name, count * 3600 / RUN_S) for name, count in (("b", 90.0), ("a", 60.0), ("c", 30.0))]
    same = replace(
        TOWN, edges={**TOWN.edges, "a": replace(TOWN.edges["a"], name="X"), "b": replace(TOWN.edges["b"], name="X")}
    )
    assert [name for name, _ in _busiest(made(network=same))] == ["b", "c"]
    many = network(*(edge(f"e{number}") for number in range(20)))
    busy = replace(RUN, edge_vehicles={f"e{number}": 1.0 + number for number in range(20)})
    assert len(_busiest(made(network=many, busy=busy))) == _make._MAX_LISTED_ROADS


def test_times_of_a_made_scenario_follow_its_routes():
    def with_routes(*free_s, ego=("r0",)):
        ways = tuple(
            Route(id=f"r{number}", edges=("a",), weight=1 + number, length_m=100.0, free_s=one)
            for number, one in enumerate(free_s)
        )
        return replace(DEMAND, routes=ways, ego_routes=ego)

    low, high = _make._WARMUP_S
    assert _make._warmup_s(with_routes(50.0, 80.0)) == round(min(max(1.2 * (50 + 160) / 3, low), high))
    assert (_make._warmup_s(with_routes(0.1)), _make._warmup_s(with_routes(9e9))) == (low, high)
    least, most = _make._STEPS
    assert _make._steps(with_routes(60.0, 9e9)) == min(max(1200, least), most)
    assert (_make._steps(with_routes(0.1)), _make._steps(with_routes(9e9))) == (least, most)
    assert _make._speed_limit_mps(with_routes(10.0, 1.0)) == 10.0
    assert _make._speed_limit_mps(with_routes(10.0, 5.0, ego=("r0", "r1"))) == 13.3
    assert (_make._speed_limit_mps(with_routes(99.0)), _make._speed_limit_mps(with_routes(0.01))) == (5.0, 40.0)
    assert _make._lanes_km(TOWN) == pytest.approx(0.4 + 1.2 + 0.2)


def test_place_is_described_in_words():
    lines = _make.describe_place(made(
        network=replace(TOWN, junctions=_make_counter(traffic_light=3, priority=5, right_before_left=2), crossings=4),
        trial=PlainTrial(outcome="survived", steps=1, wall_s=2.0), notes=("thin",),
        plain=replace(RUN, demand=1.0, teleports=2, collisions=1),
    ))  # fmt: skip
    assert "traffic keeps to the right" in lines[0]
    assert lines[1:4] == [
        "roads: 1.2 km in 3 edges, 1.8 km of lanes",
        "lanes: 1 to 2 per direction; speed limits 36 to 72 km/h",
        "junctions: 10: 3 with traffic lights, 5 priority, 2 right before left; 4 pedestrian crossings",
    ]
    assert lines[4] == "traffic: 1 routes, 720 vehicles/h at demand 1, 2 flows of persons"
    assert "2 stood for 300 s, 1 collision among them" in lines[5]
    assert lines[6].startswith(f"at demand 2: 99 of 100 vehicles entered in {RUN_S} s, 80 arrived at 11.5 m/s")
    assert lines[6].endswith("no jam") or ", no jam" in lines[6]
    per_hour = [f"{name} {count * 3600 / RUN_S:,.0f}/h" for name, count in (("b", 90), ("a", 60), ("c", 30))]
    assert lines[7] == f"busiest: {'; '.join(per_hour)}"
    assert lines[8] == "agent: 2 routes; it enters within 2.2 s at demand 2"
    assert lines[9].startswith("one trial of keep-lane: survived after 1 step (2.0 s, ")
    assert lines[10] == "note: thin"


def _make_counter(**counts):
    return type(TOWN.junctions)(counts)


def test_thin_traffic_is_noted_up_to_a_density():
    least = _make._THIN_PER_KM
    assert _thin_traffic(replace(RUN, running=10), 10 / least, 2.0) == []
    assert _thin_traffic(replace(RUN, running=10), 10.1 / least, 2.0) != []
    (limited,) = _thin_traffic(replace(RUN, demand=0.5, running=10), 15 / least, 0.5)
    assert "because --demand ends at 0.5" in limited
    (other,) = _thin_traffic(replace(RUN, demand=1.0, running=10), 15 / least, 2.0)
    assert "--bbox" in other
