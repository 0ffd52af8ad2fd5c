"""What the accelerator checks before it computes anything itself: classes, functions, lanes, numbers and positions."""

from __future__ import annotations

from collections import Counter
from types import SimpleNamespace

# First: this imports highway-env without what takes most of that time.
from crashhunt.highway import HighwaySimulator

# isort: split

import numpy as np
import pytest
from compiled import needs_kernel
from highway_env.road.lane import CircularLane, SineLane, StraightLane
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle, LinearVehicle
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.dynamics import BicycleVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark, Obstacle
from small_roads import small_road

from crashhunt.highway.accelerator import (
    _kernel,
    _kernel_objects,
    _lane_network as _network,
    _roads,
    _supported,
    kind_of,
    switch_on,
)

assert HighwaySimulator
pytestmark = [
    pytest.mark.usefixtures("plain_highway_env"),
    pytest.mark.filterwarnings("ignore:.*out of date:DeprecationWarning"),
    needs_kernel,
]


GROUPS = {
    "collides": "handle_collisions _is_colliding polygon direction velocity lane_distance_to on_road",
    "moves": "step clip_actions on_state_update",
    "drives": "act follow_road steering_control speed_control acceleration desired_gap change_lane_policy mobil "
    "collect_data add_features acceleration_features steering_features",
    "slides": "state derivative_func",
    "predicts": "predict_trajectory_constant_speed",
    "describes": "to_dict destination destination_direction lane_offset",
    "chooses": "index_to_speed",
}
BASES = {
    IDMVehicle: "idm", LinearVehicle: "linear", MDPVehicle: "controlled", ControlledVehicle: "controlled",
    Vehicle: "nothing", BicycleVehicle: "nothing", Obstacle: "", Landmark: "",
}  # fmt: skip


def abilities(kind):
    found = kind_of(kind)
    return {
        name: bool(getattr(found, name)) for name in ("collides", "moves", "drives", "predicts", "describes", "chooses")
    }


@pytest.mark.parametrize("base", BASES)
def test_a_method_of_a_users_class_disables_what_depends_on_it_and_nothing_else(base):
    """Whatever is computed needs the shape of a vehicle; a prediction needs movement and decisions too."""
    plain, moving = abilities(base), issubclass(base, Vehicle)
    assert plain == {"collides": True, "moves": moving, "drives": moving, "predicts": moving, "describes": True,
                     "chooses": base is MDPVehicle}  # fmt: skip
    assert (kind_of(base).base, kind_of(base).slides) == (BASES[base], base is BicycleVehicle)
    assert kind_of(base).times == (base in (IDMVehicle, LinearVehicle))
    for group, names in GROUPS.items():
        for name in names.split()[: None if base is IDMVehicle else 1]:
            found = abilities(type("Own", (base,), {name: lambda self, *given: None}))
            lost = {
                "collides": {*plain},
                "moves": {"moves", "predicts"},
                "drives": {"drives", "predicts"},
                "slides": {"moves", "predicts"} if base is BicycleVehicle else set(),
                "predicts": {"predicts"},
                "describes": {"describes"},
                "chooses": {"chooses"},
            }[group]
            assert found == {ability: plain[ability] and ability not in lost for ability in plain}, name


@pytest.mark.parametrize(
    "own", [{"__eq__": lambda *_: True, "__hash__": lambda _: 1}, {"speed": property(lambda _: 1.0)},
            {"LENGTH": property(lambda _: 9.0)}, {"__getattribute__": lambda *given: object.__getattribute__(*given)}]
)  # fmt: skip
def test_a_users_class_whose_values_run_code_is_not_accelerated(own):
    assert abilities(type("Own", (IDMVehicle,), own)) == dict.fromkeys(abilities(IDMVehicle), False)
    assert not kind_of(type("Own", (IDMVehicle,), own)).plain
    assert kind_of(type("Own", (IDMVehicle,), {"LENGTH": 9.0, "note": "of a user"})).plain


def test_a_class_is_looked_at_again_when_it_or_its_bases_have_changed():
    kind = type("Own", (IDMVehicle,), {})
    first = kind_of(kind)
    assert kind_of(kind) is first
    kind.note = 1  # a new member counts as a change
    second = kind_of(kind)
    assert second is not first
    assert second.drives
    kind.mobil = lambda self, lane: False
    assert not kind_of(kind).drives
    del kind.mobil
    assert kind_of(kind).drives == "idm"
    kind.__bases__ = (MDPVehicle,)
    assert kind_of(kind).drives == "controlled"


def test_left_alone_names_members_of_moving_classes_only(caplog, monkeypatch):
    monkeypatch.setattr(_supported, "left_alone", {})
    moving = type("Walker", (IDMVehicle,), {"mobil": lambda *_: False, "step": lambda *_: None})
    still = type("Post", (Obstacle,), {"polygon": lambda *_: None})
    with caplog.at_level("INFO", "crashhunt"):
        kind_of(moving), kind_of(still)
        moving.note = 1
        kind_of(moving)  # the same again
    names = [name.rpartition(".")[2] for name in _supported.left_alone]
    assert "Walker" in names
    assert "Post" not in names
    assert [record.message.partition(": ")[2].rpartition(".")[2] for record in caplog.records] == [
        "Walker has its own mobil, step"
    ]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda space, kind: None, ""),
        (lambda space, kind: space.update(function=len), "place.function has been replaced"),
        (lambda space, kind: space.pop("function"), "place.function has been replaced"),
        (lambda space, kind: space.update(number=7), ""),
        (lambda space, kind: space.update(later=7), ""),
        (lambda space, kind: space.update(later=print), "place.later has been replaced"),
        (lambda space, kind: space.update(min=7), "place.min has been replaced"),  # hides a built-in function
        (lambda space, kind: space.update(free=len), ""),
        (lambda space, kind: space.update(__doc__=len), ""),
        (lambda space, kind: setattr(kind, "method", len), "Kind.method has been replaced"),
        (lambda space, kind: setattr(kind, "value", 2), ""),
        (lambda space, kind: setattr(kind, "value", len), ""),  # was no function when the watch began
        (lambda space, kind: delattr(kind, "method"), "Kind.method has been replaced"),
    ],
)
def test_watch_reports_replaced_functions_and_no_numbers(change, reason, caplog):
    space = {"function": max, "number": 1, "free": max, "__doc__": "text"}
    kind = type("Kind", (), {"method": lambda self: None, "value": 1})
    watch = _supported.Watch([("place", space), ("Kind", kind)], ["place.free"])
    assert watch.intact
    assert watch.reason == ""
    change(space, kind)
    with caplog.at_level("WARNING", "crashhunt"):
        assert [watch.reason, watch.reason] == [reason, reason]
        assert watch.intact == (not reason)
    expected = [f"the accelerator is disabled: {reason}"] if reason else []
    assert [record.message for record in caplog.records] == expected


def test_watch_is_intact_again_when_a_function_is_put_back_and_reports_the_next_change():
    space = {"one": max, "two": min}
    watch = _supported.Watch([("place", space)])
    for name, original in (("one", max), ("two", min), ("one", max)):
        space[name] = len
        assert watch.reason == f"place.{name} has been replaced"
        space[name] = original
        assert watch.intact


def test_watch_of_roads_reports_functions_of_numpy_and_values_that_hide_methods(monkeypatch):
    watch = _supported.Watch.of_roads(())
    assert watch.intact
    for owner, name, value, said in [
        (np, "cos", np.sin, "numpy.cos"), (np.linalg, "norm", np.sin, "numpy.linalg.norm"),
        (np, "median", np.sin, ""), (IDMVehicle, "speed_control", 1.0, "IDMVehicle.speed_control"),
        (IDMVehicle, "colour", 1.0, ""), (RegulatedRoad, "close_objects_to", 1.0, "RegulatedRoad.close_objects_to"),
        (Obstacle, "mobil", 1.0, ""), (StraightLane, "on_lane", len, "StraightLane.on_lane"),
    ]:  # fmt: skip
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, value, raising=False)
            assert watch.reason == (f"{said} has been replaced" if said else "")
        assert watch.intact


def test_genuine_function_is_one_of_highway_envs_files_under_its_own_name():
    assert _supported.is_genuine("Road.act", Road.act)
    assert not _supported.is_genuine("Road.step", Road.act)
    assert not _supported.is_genuine("wrapped", lambda: None)
    assert not _supported.is_genuine("len", len)
    names = [name for name, _ in _supported._functions()]
    assert {"Road.act", "IDMVehicle.mobil", "Vehicle.velocity", "StraightLane.from_config", "wrap_to_pi"} <= {*names}
    assert not any(name.endswith(".") or "MAX_SPEED" in name for name in names)


# Lanes.


def bent_network():
    network = RoadNetwork()
    network.add_lane("a", "b", StraightLane([0, 0], [60, 0], width=4))
    network.add_lane("a", "b", StraightLane([0, 4], [60, 4], width=4))
    network.add_lane("b", "c", SineLane([60, 0], [100, 0], 2.0, 0.1, 0.5))
    network.add_lane("d", "a", CircularLane([0, 20], 20.0, 0.0, 1.5))
    return network


def test_connected_lanes_are_the_next_and_the_last_ones_with_their_offsets():
    network = bent_network()
    lanes = _network.Network(network)
    assert lanes.keys == [("a", "b", 0), ("a", "b", 1), ("b", "c", 0), ("d", "a", 0)]
    assert lanes.connected_lanes(0) == [(0, 0.0), (2, 60.0), (3, -network.get_lane(("d", "a", 0)).length)]
    assert lanes.connected_lanes(1) == [(1, 0.0), (2, 60.0), (3, -network.get_lane(("d", "a", 0)).length)]
    assert lanes.connected_lanes(2) == [(2, 0.0), (0, -60.0)]
    assert lanes.connected_lanes(3) == [(3, 0.0), (0, network.get_lane(("d", "a", 0)).length)]
    network.graph["b"]["e"] = []  # without lanes
    network.graph["e"] = {"a": []}
    assert lanes.connected_lanes(0) == [(0, 0.0), (2, 60.0), (3, -network.get_lane(("d", "a", 0)).length)]


def test_neighbours_are_found_at_the_ends_and_sides_of_a_lane_as_in_highway_env():
    network = bent_network()
    lane = network.get_lane(("a", "b", 0))

    def found():
        place = Road(network, [IDMVehicle(None, lane.position(s, 0.0), 0.0) for s in (-9.0, 30.0, 80.0)])
        for vehicle in place.vehicles:
            vehicle.road, vehicle.lane_index, vehicle.lane = place, ("a", "b", 0), lane
        observer, other, _ = place.vehicles
        for s in (-5.1, -5.0, 0.0, 64.9, 65.0, 65.1):
            for r in (-3.1, -3.0, 0.0, 3.0, 3.1):
                other.position = lane.position(s, r)
                neighbours = place.neighbour_vehicles(observer)
                yield s, r, *map(place.vehicles.index, filter(None, neighbours))

    slow = [*found()]
    assert {len(one) for one in slow} == {2, 3}
    assert switch_on() == ""
    assert [*found()] == slow


NUMBERS = {
    ("a", "b", 0): "length width heading speed_limit",
    ("b", "c", 0): "length width heading speed_limit amplitude pulsation phase",
    ("d", "a", 0): "length width speed_limit radius start_phase direction",
}


@pytest.mark.parametrize("key", NUMBERS)
def test_lane_is_known_where_all_its_values_are_usual(key):
    def known(name, value):
        network = bent_network()
        setattr(network.get_lane(key), name, value)
        return _network.Network(network).plain

    for name in NUMBERS[key].split():
        assert [known(name, value) for value in (3, -2.5, np.float64(2.5))] == [True] * 3, name
        assert [known(name, value) for value in (np.float32(3), "20", True)] == [False] * 3, name
        assert known(name, None) == (name == "speed_limit")
    for name in ("center",) if key[0] == "d" else ("start", "direction", "direction_lateral"):
        value = getattr(bent_network().get_lane(key), name)
        assert known(name, value + 1), name
        for odd in (value.astype(np.float32), np.append(value, 1.0), value.tolist(), np.append(value, value)[::2]):
            assert not known(name, odd), name
    assert known("note", "of a user")
    assert not any(known(name, len) for name in ("local_coordinates", "after_end"))
    assert not known("VEHICLE_LENGTH", 5)
    network = bent_network()
    del network.get_lane(key).forbidden
    assert not _network.Network(network).plain


def test_network_is_known_where_its_graph_is_of_dictionaries_and_lists():
    def known(change):
        network = bent_network()
        change(network, network.graph)
        return _network.Network(network).plain

    assert known(lambda network, graph: None)
    assert not known(lambda network, graph: graph.clear())
    assert not known(lambda network, graph: graph["a"].update(b=tuple(graph["a"]["b"])))
    assert not known(lambda network, graph: graph.update(a=Counter(graph["a"])))
    assert not known(lambda network, graph: setattr(network, "graph", Counter(graph)))
    assert not known(lambda network, graph: setattr(network, "note", 1))
    own = type("Own", (StraightLane,), {})
    assert not known(lambda network, graph: graph["a"]["b"].append(own([0, 8], [60, 8])))


def test_change_of_a_network_is_noticed():
    changes = [
        lambda network: network.graph["a"]["b"].reverse(),
        lambda network: network.graph["a"]["b"].pop(),
        lambda network: network.graph.update(e={}),
        lambda network: network.graph["b"].update(e=[]),
        lambda network: setattr(network, "note", 1),
    ]
    for key in (("a", "b", 1), ("b", "c", 0), ("d", "a", 0)):
        for name, value in vars(bent_network().get_lane(key)).items():
            if type(value) is np.ndarray:
                changes.append(lambda network, key=key, name=name: vars(network.get_lane(key))[name].__iadd__(1))
            changes.append(lambda network, key=key, name=name: setattr(network.get_lane(key), name, 77.0))
    for change in changes:
        network = bent_network()
        lanes = _network.Network(network)
        assert lanes.is_of(network)
        assert not lanes.is_of(bent_network())
        change(network)
        assert not lanes.is_of(network)


def test_other_reach_beyond_the_end_of_lanes_makes_them_unknown(monkeypatch):
    network = bent_network()
    lanes = _network.Network(network)
    monkeypatch.setattr(CircularLane, "VEHICLE_LENGTH", 6, raising=False)
    assert not lanes.is_of(network)
    assert not _network.Network(network).plain


# What is kept between two looks at a road.


def test_state_of_a_road_is_kept_only_while_no_foreign_code_runs():
    assert switch_on() == ""
    place = small_road(*[IDMVehicle] * 3)
    assert _roads.cached(place) is None
    assert _roads.cached(None) is None
    state = _roads.look(place)
    owner = state.owner
    assert _roads.cached(place) is owner is _roads.prepared(place)
    owner.keep(state)
    assert _roads.take(place) is None  # not alone
    owner.alone = True
    owner.keep(state)
    assert _roads.take(place) is state
    assert _roads.take(place) is None  # it has been taken
    owner.keep(state)
    owner.distrust()
    assert _roads.take(place) is None
    owner.keep(state)
    owner.checked = True
    assert _roads.take_for_observation(place) is state
    assert not owner.checked
    assert _roads.take(place) is None
    assert _roads.take_for_observation(small_road(IDMVehicle)) is None
    _roads._roads[id(place)] = _roads.Prepared(small_road(IDMVehicle))  # a road that has gone had the same id()
    assert _roads.cached(place) is None


def test_vehicles_are_compared_with_the_kernels_once_where_no_foreign_code_runs(monkeypatch):
    assert switch_on() == ""
    place = small_road(*[IDMVehicle] * 3)
    owner = _roads.look(place).owner
    compared = []
    is_of = _kernel_objects.KernelObjects.is_of
    monkeypatch.setattr(
        _kernel_objects.KernelObjects, "is_of", lambda self, road: compared.append(1) or is_of(self, road)
    )
    assert owner.drives_all()
    assert owner.checked
    assert _roads.look(place).owner is owner
    assert compared == [1]
    owner.distrust()
    assert _roads.look(place) is not None
    assert compared == [1, 1]
    place.vehicles[1].__class__ = type("Own", (IDMVehicle,), {"mobil": lambda *_: False})
    assert not owner.drives_all()
    assert not owner.checked


@pytest.mark.parametrize(
    "change",
    [
        lambda place: setattr(place, "vehicles", (*place.vehicles,)),
        lambda place: setattr(place, "objects", (*place.objects,)),
        lambda place: setattr(place, "neighbour_vehicles", place.neighbour_vehicles),
        lambda place: setattr(place, "close_vehicles_to", place.close_vehicles_to),
        lambda place: setattr(place, "__class__", type("Own", (Road,), {"neighbour_vehicles": lambda *_: None})),
        lambda place: setattr(place, "__class__", type("Own", (Road,), {"objects": property(lambda _: [])})),
    ],
)
def test_unusual_road_is_not_searched_by_the_kernel(change):
    assert switch_on() == ""
    place = small_road(*[IDMVehicle] * 3)
    assert _roads.is_known(place)
    change(place)
    assert not _roads.is_known(place)
    assert _roads.look(place) is None


def test_road_with_own_act_or_search_of_close_objects_is_still_known():
    assert switch_on() == ""
    place = small_road(*[IDMVehicle] * 3)
    place.act, place.step = place.act, place.step
    assert _roads.is_known(place)
    place.__class__ = type("Own", (Road,), {"close_objects_to": lambda *_: []})
    assert _roads.is_known(place)
    place.__class__ = type("Own", (Road,), {"neighbour_vehicles": lambda *_: (None, None)})
    assert not _roads.is_known(place)
    assert _roads.network_of(place) is None


# The compiled kernel.


@pytest.mark.parametrize("name", ["sin", "arctan2", "power"])
def test_kernel_is_not_used_with_a_replaced_function_of_numpy(name, monkeypatch):
    monkeypatch.setattr(np, name, lambda *given: given[0])
    assert _kernel._load_kernel.__wrapped__() == (None, "a function of NumPy has been replaced")


def test_kernel_that_cannot_bind_states_its_reason(monkeypatch):
    def bind(*_):
        raise OSError("no inner loop for sine")

    module = SimpleNamespace(INTERFACE=_kernel._INTERFACE, bind=bind)
    monkeypatch.setattr(_kernel.importlib, "import_module", lambda _: module)
    assert _kernel._load_kernel.__wrapped__() == (None, "no inner loop for sine")


def test_kernel_is_bound_with_the_first_rounding_that_is_numpys(monkeypatch):
    """All ways are tried, each once; what has been found stays bound."""
    bound, right = [], _kernel.kernel()

    def compute(name, numbers):
        return right.compute(name, numbers) if bound[-1][-3:] == wanted or name == "turned" else float("nan")

    module = SimpleNamespace(
        INTERFACE=_kernel._INTERFACE, bind=lambda *given: bound.append(given), compute=compute,
        bind_turn=lambda rounds: None,
    )  # fmt: skip
    monkeypatch.setattr(_kernel.importlib, "import_module", lambda _: module)
    ways = [(one, two, step) for one in (True, False) for two in (True, False) for step in (0, 8)]
    for wanted in (ways[0], ways[5], ways[-1]):
        bound.clear()
        assert _kernel._load_kernel.__wrapped__() == (module, "")
        assert [given[-3:] for given in bound] == ways[: ways.index(wanted) + 1]


def test_functions_are_compared_on_many_numbers_of_all_magnitudes():
    asked, right = {}, _kernel.kernel()
    module = SimpleNamespace(
        compute=lambda name, numbers: asked.setdefault(name, []).append(numbers) or right.compute(name, numbers)
    )
    assert _kernel._differs(module) == ""
    counts = {name: len(found) for name, found in asked.items()}
    assert counts == {
        "sin": 600, "cos": 600, "tan": 600, "arctan": 600, "arcsin": 600, "arctan2": 600, "power": 3000, "dot": 600,
        "remainder": 600, "dot3": 600, "product": 1200, "square": 1200,
    }  # fmt: skip
    for name, found in asked.items():
        columns = np.array(found).T
        if name == "power":
            columns, exponents = columns[:1], columns[1]
            assert (exponents.min(), exponents.max()) == (pytest.approx(0.0, abs=0.1), pytest.approx(6.0, abs=0.1))
            assert {0.5, 2.0, 4.0} <= set(exponents.tolist())
        if name == "remainder":
            assert set(columns[1]) == {2 * np.pi}
            columns = columns[:1]
        for column in columns:
            sizes = np.abs(column)
            assert sizes.min() < 1e-8
            assert sizes.max() > 500.0 or name == "arcsin"
            assert 0.4 < np.mean(column > 0) < 0.6 or name == "power"
        for one in range(len(columns)):
            for other in range(one):
                assert abs(np.corrcoef(np.log(np.abs(columns[one])), np.log(np.abs(columns[other])))[0, 1]) < 0.2, name
    assert np.abs(np.array(asked["arcsin"])).max() == 1.0


def test_vehicle_of_the_dynamic_model_moves_without_a_search_for_its_lane():
    place = small_road(BicycleVehicle)
    vehicle = place.vehicles[0]
    vehicle.act({"steering": 0.1, "acceleration": 1.0})
    vehicle.lane_index = ("0", "1", 2)
    at = vehicle.position.copy()
    _kernel._derivatives(vehicle, 0.5)
    assert vehicle.road is place
    assert vehicle.lane_index == ("0", "1", 2)
    assert vehicle.position[0] > at[0] + 5
    vehicle.action = {}
    with pytest.raises(KeyError):
        _kernel._derivatives(vehicle, 0.5)
    assert vehicle.road is place


def parameters(*things):
    return _kernel_objects._read_parameters(list(things), _supported.kinds_of(things))


def test_parameters_of_vehicles_are_refused_where_they_are_not_usual_numbers():
    vehicle, other = small_road(IDMVehicle, IDMVehicle).vehicles
    usual = parameters(vehicle, other)
    rows = np.frombuffer(usual).reshape(2, -1)
    assert rows[0].tolist() == rows[1].tolist()
    names = [*_kernel_objects._PARAMETERS, "DELTA"]
    assert rows[0].tolist() == [getattr(vehicle, name) for name in names]
    for name in names:
        for value in (np.float32(2.5), "2", None, float("nan")):
            setattr(vehicle, name, value)
            assert parameters(vehicle, other) is None, (name, value)
        setattr(vehicle, name, getattr(other, name) * 1.25 or 0.5)
        found = np.frombuffer(parameters(vehicle, other)).reshape(2, -1)
        assert found[1].tolist() == rows[1].tolist()
        assert np.flatnonzero(found[0] != rows[0]).tolist() == [names.index(name)]
        delattr(vehicle, name)
    odd = {"MAX_SPEED": np.float64(30), "MIN_SPEED": np.float64(-9), "COMFORT_ACC_MIN": 3.0, "TIME_WANTED": np.inf}
    for name, value in [*odd.items(), ("COMFORT_ACC_MAX", 0.0), ("DELTA", 20.0), ("DELTA", -20.0)]:
        setattr(vehicle, name, value)
        assert parameters(vehicle, other) is None, (name, value)
        delattr(vehicle, name)
    vehicle.LENGTH, vehicle.DELTA = np.float64(6), 19.0
    assert parameters(vehicle, other) not in (None, usual)
    vehicle.act = vehicle.act
    assert parameters(vehicle, other) is None


def test_objects_need_fewer_parameters_than_vehicles():
    place = small_road(IDMVehicle, Vehicle, ControlledVehicle)
    things = [*place.vehicles, Obstacle(place, [0.0, 0.0]), Landmark(place, [9.0, 0.0])]
    known = [np.isfinite(row).sum() for row in np.frombuffer(parameters(*things)).reshape(5, -1)]
    assert known == [19, 4, 9, 2, 2]
    kinds = _supported.kinds_of(things)
    assert [_kernel_objects._flags_of(*pair) for pair in zip(things, kinds, strict=True)] == [4, 0, 0, 8, 1]
    assert _kernel_objects._flags_of(*((slide := small_road(BicycleVehicle).vehicles[0]), kind_of(type(slide)))) == 2
    assert parameters() == b""


def test_one_example_of_each_class_shows_its_parameters_and_all_that_have_their_own():
    first, second, third, other = small_road(IDMVehicle, IDMVehicle, IDMVehicle, Vehicle).vehicles
    first.LENGTH = third.LENGTH = 9.0
    things = [first, second, third, other]
    found = _kernel_objects._examples(things, _supported.kinds_of(things))
    assert [thing for thing, _ in found] == things
    assert [len(names) for _, names in found] == [18, 18, 18, 4]
    del first.LENGTH, third.LENGTH
    found = _kernel_objects._examples(things, _supported.kinds_of(things))
    assert [thing for thing, _ in found] == [first, other]


# Positions on a road.


@pytest.mark.parametrize(
    "change",
    [
        lambda things: setattr(things[0], "position", things[1].position),
        lambda things: setattr(things[0], "position", things[0].position.astype(np.float32)),
        lambda things: setattr(things[0], "position", np.zeros((1, 2))),
        lambda things: setattr(things[0], "position", [0.0, 1.0]),
        lambda things: things.append(things[0]),
        lambda things: setattr(things[0], "__class__", type("Own", (IDMVehicle,), {"__len__": lambda _: 0})),
    ],
)
def test_things_are_plain_where_each_has_its_own_usual_position(change):

    def are_plain(things):
        return _kernel_objects.are_plain(things, _supported.kinds_of(things))

    things = small_road(*[IDMVehicle] * 3).vehicles
    assert are_plain(things)
    things[2].position = things[2].position.view(np.dtype(np.float64).newbyteorder("="))
    assert are_plain(things)
    change(things)
    assert not are_plain(things)
