"""The accelerator and users: whatever they override, replace or change, and whenever, every bit stays the same.

A case is drawn from a number. It takes something of highway-env's, such as a method, a property, a function of a module
or a value, and changes it on a class, on a subclass or on one object, before the episode, after its reset or in the
middle of a step. What replaces a function calls it and alters what it returns by the number of its calls: a call that
is left out, or is too much, changes every bit after it.
"""

from __future__ import annotations

import inspect
import math
import random
from functools import wraps

import gymnasium
import highway_env
import numpy as np
import pytest
from compiled import needs_kernel
from conftest import mostly_nightly
from exact_values import exact
from highway_env import utils
from highway_env.envs.common import observation
from highway_env.road import lane, regulation, road
from highway_env.vehicle import behavior, controller, kinematics, objects
from small_roads import same_either_way, state

import crashhunt
from crashhunt.highway import restore_classes
from crashhunt.highway.accelerator import Onlooker, switch_off, switch_on, why_not

assert highway_env
MODULES = (utils, lane, regulation, road, behavior, controller, kinematics, objects, observation)
ENVIRONMENTS = {
    "highway-fast-v0": {"vehicles_count": 9, "vehicles_density": 1.6},
    "intersection-v0": {"initial_vehicle_count": 6},
    "roundabout-v0": {},
    "merge-v0": {},
}
NEVER = ("__", "_abc", "create_", "make_", "from_config", "to_config", "straight_road", "random", "plot", "render")
SPECIAL = {
    "__bool__": lambda self: False,
    "__len__": lambda self: 0,
    "__eq__": lambda self, other: True,
    "__hash__": lambda self: 7,
    "__getattribute__": lambda self, name: _slower(name, object.__getattribute__(self, name)),
    "__setattr__": lambda self, name, value: object.__setattr__(self, name, _slower(name, value)),
    "__deepcopy__": lambda self, memo: self,
}


def _slower(name, value):
    return value * 0.999 if name == "speed" else value


pytestmark = [pytest.mark.usefixtures("plain_highway_env"), needs_kernel]


def altered(function, calls):
    """The same function, but for a little that grows with its calls."""

    @wraps(function)
    def wrapper(*words, **options):
        calls.append(None)
        return _altered(function(*words, **options), words[0] if words else None, len(calls))

    return wrapper


def _altered(found, first, number):
    if isinstance(found, bool | np.bool_):
        return bool(found) ^ (number % 7 == 0)
    if isinstance(found, float | np.floating):
        return found + 1e-3 * math.sin(number)
    if isinstance(found, np.ndarray) and found.dtype.kind == "f":
        return found + 1e-3 * math.sin(number)
    if isinstance(found, tuple) and found and all(isinstance(part, float) for part in found):
        return tuple(part + 1e-3 * math.sin(number) for part in found)
    if found is None and isinstance(first, kinematics.Vehicle):
        first.__dict__["speed"] = first.__dict__.get("speed", 0.0) + 1e-4 * math.sin(number)
    return found


def member(value, calls):
    if isinstance(value, property):
        return property(altered(value.fget, calls), value.fset)
    if isinstance(value, staticmethod | classmethod):
        return type(value)(altered(value.__func__, calls))
    return altered(value, calls)


class Changes:
    """What has been changed, to be undone."""

    def __init__(self):
        self.undo = []
        self.calls = []
        self.said = ""

    def set(self, owner, name, value):
        space = vars(owner)
        had, before = name in space, space.get(name)
        if had:
            self.undo.append(lambda: setattr(owner, name, before))
        else:
            self.undo.append(lambda: name in vars(owner) and delattr(owner, name))
        setattr(owner, name, value)

    def revert(self):
        while self.undo:
            self.undo.pop()()


def _methods(kind):
    return sorted(
        name
        for name in dir(kind)
        if not name.startswith(NEVER)
        and (callable(found := inspect.getattr_static(kind, name)) or hasattr(type(found), "__get__"))
        and not isinstance(found, type)
    )


def _numbers(thing):
    return sorted(
        name
        for name, value in vars(thing).items()
        if type(value) in (int, float, np.float64) and name not in ("speed_index", "direction")
    )


def change_class(rng, env, changes):
    kinds = [kind for module in MODULES for kind in vars(module).values()
             if isinstance(kind, type) and kind.__module__ == module.__name__
             and (module is not observation or kind is observation.KinematicObservation)]  # fmt: skip
    kind = rng.choice(sorted(kinds, key=lambda kind: kind.__name__))
    names = [name for name in _methods(kind) if rng.random() < 0.3 or name in vars(kind)]
    if names:
        name = rng.choice(names)
        changes.said = f"{kind.__name__}.{name}"
        changes.set(kind, name, member(inspect.getattr_static(kind, name), changes.calls))


def change_module(rng, env, changes):
    module = rng.choice(MODULES)
    names = sorted(name for name, value in vars(module).items()
                   if inspect.isfunction(value) and not name.startswith(NEVER))  # fmt: skip
    if names:
        name = rng.choice(names)
        changes.said = f"{module.__name__}.{name}"
        changes.set(module, name, altered(vars(module)[name], changes.calls))


def _thing(rng, env):
    place = env.road
    lanes = [found for ends in place.network.graph.values() for row in ends.values() for found in row]
    every = place.vehicles + place.objects
    return rng.choice([rng.choice(every), rng.choice(every), rng.choice(lanes), place.network, place,
                       env.observation_type])  # fmt: skip


def change_object(rng, env, changes):
    thing = _thing(rng, env)
    names = [name for name in _methods(type(thing)) if not isinstance(inspect.getattr_static(thing, name), property)]
    name = rng.choice(names)
    changes.said = f"a {type(thing).__name__}'s {name}"
    changes.set(thing, name, altered(getattr(thing, name), changes.calls))


def change_subclass(rng, env, changes):
    """An object becomes one of a subclass with a member of its own."""
    thing = _thing(rng, env)
    kind, odd = type(thing), rng.random()
    if odd < 0.25:
        name = rng.choice(sorted(SPECIAL))
        own = {name: SPECIAL[name]}
        if name == "__eq__":
            own["__hash__"] = kind.__hash__
    elif odd < 0.5 and (names := [*_numbers(thing), *(("speed", "heading") if "speed" in vars(thing) else ())]):
        name = rng.choice(names)

        def get(self):
            changes.calls.append(None)
            return self.__dict__[name] + 1e-4 * math.sin(len(changes.calls))

        own = {name: property(get, lambda self, value: self.__dict__.update({name: value}))}
    else:
        name = rng.choice(_methods(kind))
        own = {name: member(inspect.getattr_static(kind, name), changes.calls)}
    mine = type(f"My{kind.__name__}", (kind,), own)
    changes.said = f"{mine.__name__}.{name}"
    if isinstance(thing, objects.RoadObject) and rng.random() < 0.5:
        for other in env.road.vehicles:
            if type(other) is kind:
                other.__class__ = mine
    thing.__class__ = mine
    if rng.random() < 0.3:  # and changes once more, when it has been seen
        again = rng.choice(_methods(kind))
        changes.set(mine, again, member(inspect.getattr_static(kind, again), changes.calls))
        changes.said += f" and {again}"


def change_value(rng, env, changes):
    thing = _thing(rng, env)
    odd = rng.random()
    arrays = sorted(name for name, value in vars(thing).items() if isinstance(value, np.ndarray))
    if odd < 0.2 and isinstance(thing, objects.RoadObject):
        kind = rng.choice([base for base in type(thing).__mro__ if vars(base).keys() & set(_numbers(base))] or [object])
        if kind is not object:
            name = rng.choice(_numbers(kind))
            changes.said = f"{kind.__name__}.{name} * 0.9"
            changes.set(kind, name, vars(kind)[name] * 0.9)
    elif odd < 0.5 and arrays:
        name = rng.choice(arrays)
        changes.said = f"a {type(thing).__name__}'s {name} in place"
        if vars(thing)[name].dtype.kind == "f":
            vars(thing)[name][0] += 0.5
    elif odd < 0.6 and thing is env.road:
        changes.said = "the road's vehicles"
        how = rng.choice(["pop", "reverse", "twice", "tuple"])
        if how == "tuple":
            thing.vehicles = tuple(thing.vehicles)
        else:
            {"pop": lambda: thing.vehicles.pop(), "reverse": lambda: thing.vehicles.reverse(),
             "twice": lambda: thing.vehicles.append(thing.vehicles[-1])}[how]()  # fmt: skip
    elif names := _numbers(thing):
        name, how = rng.choice(names), rng.choice([float, np.float32, np.float64, int])
        changes.said = f"a {type(thing).__name__}'s {name} as {how.__name__}"
        setattr(thing, name, how(vars(thing)[name] * rng.choice([1.0, 0.9])))
    elif thing is env.road.network:
        changes.said = "the network's lanes"
        ends = rng.choice(list(thing.graph.values()))
        rng.choice(list(ends.values())).reverse()


CHANGES = [change_class, change_class, change_module, change_object, change_object, change_subclass, change_subclass,
           change_value, change_value]  # fmt: skip


def played(number, *, fast, alone=False):
    """Everything that happens in a case, and what it is; by itself, or with somebody who says when he interferes."""
    rng = random.Random(number)
    name = rng.choice(sorted(ENVIRONMENTS))
    change = rng.choice(CHANGES)
    when = rng.choice(["first", "reset", "middle"] if change in (change_class, change_module) else ["reset", "middle"])
    switch_off()
    restore_classes()
    changes = Changes()
    if fast:
        assert switch_on() == ""
    trace = []
    try:
        if when == "first":
            change(rng, None, changes)
        env = gymnasium.make(name, disable_env_checker=True).unwrapped
        changes.calls.clear()  # making one plays an episode of no seed
        config = {**ENVIRONMENTS[name], "simulation_frequency": 5}
        trace.append(exact(env.reset(seed=number, options={"config": config})[0]))
        if when == "reset":
            change(rng, env, changes)
        count = 0

        def before(dt):
            nonlocal count
            count += 1
            if count == 4 and when == "middle":
                change(rng, env, changes)

        onlooker = Onlooker(
            env.road.step,
            before=before,
            after=lambda: trace.append(state(env.road)),
            interferes=lambda: count in (3, 4) and when == "middle",  # as it is asked before and after
        )
        # Any other function in its place might do anything.
        env.road.step = onlooker if alone else lambda dt: onlooker(dt)
        env.action_space.seed(number)
        for _ in range(3):
            found = env.step(env.action_space.sample())
            trace.append(exact(list(found)))
    except Exception as error:  # what somebody's change breaks is to break in the same way
        trace.append(f"{type(error).__name__}: {error}"[:60])
    finally:
        changes.revert()
    trace.append(len(changes.calls))
    return trace, f"{name}, {when}: {changes.said}"


def first_difference(number, *, alone=False):
    slow, what = played(number, fast=False, alone=alone)
    fast, again = played(number, fast=True, alone=alone)
    assert what == again
    if slow == fast:
        return ""
    place = next((n for n, (a, b) in enumerate(zip(slow, fast, strict=False)) if a != b), min(len(slow), len(fast)))
    return f"{number}: {what}: entry {place} of {len(slow)}, {len(fast)}: {slow[-2:]!s:.150} / {fast[-2:]!s:.150}"


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("number", mostly_nightly([*range(20), 267, 373, 402], [0, 10, 267, 373, 402]))
def test_every_bit_is_the_same_whatever_a_user_changes(number):
    assert first_difference(number) == ""


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("number", mostly_nightly(range(20, 60), range(20, 60, 20)))
def test_every_bit_is_the_same_where_a_user_states_when_something_changes(number):
    assert first_difference(number, alone=True) == ""


def small_road(network=None, kind=behavior.IDMVehicle):
    place = road.Road(network or road.RoadNetwork.straight_road_network(2), np_random=np.random.default_rng(1))
    place.vehicles += [kind(place, [18.0 * n, 4.0 * (n % 2)], 0.02, 20.0 + n) for n in range(4)]
    return place


def driven(make, change=lambda place: None, steps=12):
    """The state after each step, the same without and with the accelerator; the change is made after the third."""

    def drive():
        with pytest.MonkeyPatch.context() as patch:
            place, trace = make(), []
            for number in range(steps):
                if number == 3:
                    change(place) if not hasattr(change, "patches") else change(place, patch)
                place.act()
                place.step(0.2)
                trace.append(state(place))
            return trace

    return same_either_way(drive)


class Reversed(road.RoadNetwork):
    """Counts every vehicle to the first lane."""

    def get_closest_lane_index(self, position, heading=None):
        return ("0", "1", 0)


class Empty(behavior.IDMVehicle):
    """Is false wherever highway-env asks whether a vehicle is ahead."""

    def __len__(self):
        return 0


class FalseVehicle(behavior.IDMVehicle):
    def __bool__(self):
        return False


def reversed_network():
    network = Reversed()
    network.graph = road.RoadNetwork.straight_road_network(2).graph
    return network


@pytest.mark.parametrize(
    "given",
    [{"network": reversed_network()}, {"kind": Empty}, {"kind": FalseVehicle}],
    ids=["network", "empty", "false"],
)
def test_road_of_a_users_own_is_driven_as_by_highway_env(given):
    driven(lambda: small_road(**given))


def second_lane(place):
    return place.network.get_lane(("0", "1", 1))


@pytest.mark.parametrize(
    "change",
    [
        lambda place: setattr(place.network, "get_closest_lane_index", lambda position, heading=None: ("0", "1", 0)),
        lambda place: setattr(place, "neighbour_vehicles", lambda vehicle, lane_index=None: (None, None)),
        lambda place: setattr(second_lane(place), "width", 0.5),
        lambda place: setattr(second_lane(place), "length", 30.0),
        lambda place: setattr(second_lane(place), "start", np.array([9.0, 1.0])),
        lambda place: second_lane(place).start.__iadd__([0.0, 0.7]),  # in place
    ],
    ids=["closest lane", "neighbours", "width", "length", "start", "start in place"],
)
def test_road_that_changes_while_driving_is_heeded(change):
    driven(small_road, change)


@pytest.mark.parametrize(
    ("owner", "name"),
    [(lane.StraightLane, "on_lane"), (lane.AbstractLane, "on_lane"), (utils, "not_zero"),
     (behavior.IDMVehicle, "mobil"), (road.Road, "neighbour_vehicles"),
     (controller.ControlledVehicle, "follow_road"), (lane, "wrap_to_pi")],
)  # fmt: skip
def test_a_function_that_is_replaced_after_it_was_sped_up_is_called(owner, name):
    """And is forgotten when its author puts it back."""
    calls = []

    def change(place, patch):
        calls.clear()
        patch.setattr(owner, name, altered(getattr(owner, name), calls))

    change.patches = True
    driven(small_road, change)
    assert len(calls) > 0
    assert why_not() == ""


def test_a_number_that_is_changed_is_heeded_and_does_not_slow_it_down(monkeypatch):
    def change(place, patch):
        patch.setattr(behavior.IDMVehicle, "TIME_WANTED", 0.3)
        patch.setattr(kinematics.Vehicle, "MAX_SPEED", 22.0)

    change.patches = True
    assert driven(small_road, change) != driven(small_road)
    assert why_not() == ""


def test_in_public_it_states_what_it_does_and_is_undone():
    with crashhunt.accelerate() as faster:
        assert faster
        assert repr(faster) == "<highway-env is accelerated>" or "has its own" in repr(faster)
        with crashhunt.accelerate() as again:
            assert again
        assert faster  # the inner one was not the first
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(lane.StraightLane, "on_lane", lambda self, *words, **options: True, raising=False)
            assert not faster
            assert faster.reason == "StraightLane.on_lane has been replaced"
        assert faster

        class Stubborn(behavior.IDMVehicle):
            def mobil(self, lane_index):
                return False

        small_road(kind=Stubborn).act()
        (own,) = [own for name, own in faster.left_alone.items() if name.endswith("Stubborn")]
        assert own == ("mobil",)
    assert not faster
    assert faster.reason == "it has been undone"
    assert road.Road.act.__module__ == "highway_env.road.road"


def test_what_an_actor_has_wrapped_meanwhile_stays_and_does_without_it():
    assert switch_on() == ""
    with pytest.MonkeyPatch.context() as patch:
        calls = []
        patch.setattr(road.Road, "neighbour_vehicles", altered(road.Road.neighbour_vehicles, calls))
        switch_off()
        place = small_road()
        assert place.neighbour_vehicles(place.vehicles[0])[0] is place.vehicles[2]
        assert calls
