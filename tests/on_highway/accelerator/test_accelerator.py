"""The accelerator of highway-env: every bit the same, and hands off whatever it does not know."""

from __future__ import annotations

import copy
import gc
import os
import subprocess
import sys
import weakref

# First: this imports highway-env without what takes most of that time.
from crashhunt.highway import HighwaySimulator, restore_classes

# isort: split

import gymnasium
import highway_env
import numpy as np
import pytest
from compiled import needs_kernel
from conftest import examples, mostly_nightly
from exact_values import exact
from highway_env.envs.common import observation
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.road.lane import CircularLane, SineLane, StraightLane
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.objects import Landmark
from hypothesis import given, settings, strategies as st
from small_roads import small_road, state

from crashhunt.highway.accelerator import (
    Onlooker,
    _supported,
    _switch as accelerator,
    kind_of,
    reason_against,
    switch_off,
    switch_on,
)
from crashhunt.highway.accelerator._kernel_objects import KernelObjects
from crashhunt.highway.accelerator._lane_network import Network

assert HighwaySimulator
IDS = sorted(name for name, spec in gymnasium.registry.items() if str(spec.entry_point).startswith("highway_env"))
BEHAVIOR = "highway_env.vehicle.behavior"
FEATURES = ["presence", "x", "y", "vx", "vy", "heading", "cos_h", "sin_h"]
CONFIGS = {
    "default": {},
    "linear": {"other_vehicles_type": f"{BEHAVIOR}.AggressiveVehicle", "simulation_frequency": 10},
    "seen": {
        "neighbour_vehicles_connected_lanes": True,
        "action": {"type": "ContinuousAction"},
        "observation": {"type": "Kinematics", "features": FEATURES, "vehicles_count": 9, "see_behind": True,
                        "normalize": False, "order": "shuffled", "absolute": True},
    },
    "grid": {"observation": {"type": "OccupancyGrid", "align_to_vehicle_axes": True}},
}  # fmt: skip
# By day, the environments of our scenarios as they are, the intersection with several agents, and what an agent sees
# with continuous actions on a motorway; test_kernel.py has linear drivers, test_accelerator_usual.py has grids. The
# others, other traffic (seed 1), and longer drives by night.
ALWAYS = [
    (name, "default", 0, 3) for name in ("intersection-multi-agent-v2", "merge-generic-v1", "roundabout-generic-v1")
]
ALWAYS += [("highway-fast-v0", config, 0, 5) for config in ("default", "seen")]  # with a third of the sub-steps
STEPS = {"highway-v0": 4, "lane-keeping-v0": 40}


CASES = [(name, "default", seed, STEPS.get(name, 8)) for name in IDS for seed in (0, 1)]
CASES += [
    (name, config, 0, STEPS.get(name, 8))
    for name in IDS
    for config in ("linear", "seen", "grid")
    if name.endswith("v0")  # later versions only look further for neighbours, which "seen" does as well
    and not (config != "linear" and ("multi" in name or "parking" in name or name == "lane-keeping-v0"))
    and not (config == "grid" and "generic" in name)
]


pytestmark = [pytest.mark.usefixtures("plain_highway_env"), needs_kernel]


def episode(name, config, seed, steps, *, idm):
    """The whole state after every sub-step, and what every step returns."""
    restore_classes()
    env = gymnasium.make(name, disable_env_checker=True).unwrapped
    trace = [exact(env.reset(seed=seed, options={"config": config})[0]), state(env.road)]
    if idm:
        driver = IDMVehicle.create_from(env.vehicle) if isinstance(env.vehicle, ControlledVehicle) else None
        if driver is not None:
            env.road.vehicles[env.road.vehicles.index(env.vehicle)] = driver
            env.controlled_vehicles[0] = driver
            env.action_type.controlled_vehicle = driver
            env.observation_type.observer_vehicle = driver
    onlooker = Onlooker(env.road.step, after=lambda: trace.append(state(env.road)))
    # Where any other function stands in its place, everybody is looked at again in every sub-step.
    env.road.step = onlooker if idm or seed == 0 else lambda dt: onlooker(dt)
    env.action_space.seed(seed)
    try:
        for _ in range(steps):
            shown, reward, terminated, truncated, info = env.step(env.action_space.sample())
            trace.append(exact([shown, reward, terminated, truncated, info]))
            if np.any(terminated):
                break
    except Exception as error:  # some rewards cannot do with some actions; that is to be the same as well
        trace.append(repr(error))
    env.close()
    return trace


def both(*words, **options):
    switch_off()
    slow = episode(*words, **options)
    assert switch_on() == ""
    fast = episode(*words, **options)
    switch_off()
    return slow, fast


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore:.*invalid value:RuntimeWarning")
@pytest.mark.parametrize(("name", "config", "seed", "steps"), mostly_nightly([*ALWAYS, *CASES], ALWAYS))
def test_every_bit_is_the_same_after_every_sub_step(name, config, seed, steps):
    chosen = dict(CONFIGS[config])
    if name.startswith(("merge", "roundabout", "two-way")):
        chosen.pop("action", None)  # their rewards ask for the number of a meta-action
    for idm in (False, True) if "multi" not in name else (False,):
        slow, fast = both(name, chosen, seed, steps, idm=idm)
        assert len(slow) == len(fast) > 4
        for number, (one, two) in enumerate(zip(slow, fast, strict=True)):
            assert one == two, f"{name} {config} seed {seed}: entry {number}"


@settings(max_examples=examples(60))
@given(data=st.data())
def test_neighbours_and_lanes_are_those_of_highway_env_wherever_vehicles_are(data):
    """Straight, slanted, bent and winding lanes; ties, crowds, and vehicles far from every lane."""
    network = RoadNetwork()
    network.add_lane("a", "b", StraightLane([0, 0], [60, 0]))
    network.add_lane("a", "b", StraightLane([0, 4], [60, 4]))
    network.add_lane("b", "c", StraightLane([60, 0], [100, 30]))
    network.add_lane("b", "d", SineLane([60, 4], [120, 4], 3.0, 0.1, 0.5))
    network.add_lane("d", "a", CircularLane([60, 40], 36.0, np.deg2rad(-90), np.deg2rad(120)))
    road = Road(network, neighbour_vehicles_connected_lanes=data.draw(st.booleans()))
    near = st.sampled_from([0.0, 4.0, 2.0, 60.0, 30.0])
    place = st.tuples(near | st.floats(-50, 200), near | st.floats(-50, 120))
    poses = data.draw(st.lists(st.tuples(place, st.floats(-4, 4), st.floats(-5, 40)), min_size=2, max_size=9))
    for position, heading, speed in poses:
        road.vehicles.append(IDMVehicle(road, position, heading, speed))
    keys = [None, *network.lanes_dict()]
    asked = [(vehicle, key) for vehicle in road.vehicles for key in keys]
    close = [(vehicle, count, data.draw(st.booleans())) for vehicle in road.vehicles for count in (None, 3)]

    def answers():
        found = [road.neighbour_vehicles(vehicle, key) for vehicle, key in asked]
        found += [road.close_objects_to(vehicle, 60, count, behind) for vehicle, count, behind in close]
        return [[id(thing) for thing in things] for things in found]

    def played():
        trace = []
        before = [(v.position.copy(), v.heading, v.speed, dict(vars(v))) for v in road.vehicles]
        for _ in range(3):
            road.act()
            road.step(0.2)
            trace.append(
                exact([[v.position, v.heading, v.speed, v.lane_index, v.action, v.impact] for v in road.vehicles])
            )
        for vehicle, (position, _, _, attributes) in zip(road.vehicles, before, strict=True):
            vars(vehicle).clear()
            vars(vehicle).update(attributes, position=position, action={"steering": 0, "acceleration": 0})
        return trace

    switch_off()
    expected, run = answers(), played()
    assert switch_on() == ""
    assert answers() == expected
    assert played() == run
    switch_off()


class Hurried(IDMVehicle):
    TIME_WANTED = 0.5


class Timid(IDMVehicle):
    asked = 0

    def acceleration(self, ego_vehicle, front_vehicle=None, rear_vehicle=None):
        type(self).asked += 1
        return super().acceleration(ego_vehicle, front_vehicle, rear_vehicle) - 1.0


class Ghost(IDMVehicle):
    def handle_collisions(self, other, dt=0):
        self.met = [*getattr(self, "met", []), other]


class Slippery(IDMVehicle):
    def step(self, dt):
        super().step(dt)
        self.position[1] += 0.01


@pytest.mark.parametrize("kind", [Hurried, Timid, Ghost, Slippery])
def test_a_subclass_is_as_its_author_wrote_it(kind):
    """Other numbers are heeded, and other methods called."""

    def played():
        road = small_road(IDMVehicle, kind, IDMVehicle)
        for _ in range(20):
            road.act()
            road.step(0.1)
        return exact([[v.position, v.heading, v.speed, v.action, len(getattr(v, "met", []))] for v in road.vehicles])

    slow = played()
    assert switch_on() == ""
    Timid.asked = 0
    assert played() == slow
    assert (Timid.asked > 0) == (kind is Timid)
    assert (kind_of(kind).drives == "idm") == (kind in (Hurried, Slippery))
    assert kind_of(kind).moves == (kind in (Hurried, Timid))


@pytest.mark.parametrize(("speeds", "known"), [([8, 16, 24], True), ([0, 2**60], False)])
def test_whole_speeds_out_of_a_list_are_known(speeds, known, monkeypatch):
    """NumPy's whole numbers, which floats hold: the target speeds of u-turns, roundabouts and exits."""

    def played():
        road = small_road(IDMVehicle, ControlledVehicle, IDMVehicle)
        road.vehicles[1] = MDPVehicle(road, [20.0, 4.0], 0.0, 17.5, target_speeds=speeds)
        road.vehicles[0].POLITENESS = 0.5
        road.vehicles[2].target_speed = np.int64(24)
        for number in range(20):
            road.vehicles[1].act(["FASTER", "LANE_LEFT", None][number % 3])
            road.act()
            road.step(0.1)
        return exact([[v.position, v.heading, v.speed, v.action, v.target_lane_index] for v in road.vehicles])

    slow = played()
    assert switch_on() == ""
    asked, act = [], accelerator.originals["Road.act"]
    with monkeypatch.context() as patched:  # ends before highway-env's methods are restored
        patched.setitem(accelerator.originals, "Road.act", lambda road: asked.append(road) or act(road))
        assert played() == slow
    assert len(asked) == (0 if known else 20)


class Elsewhere(Landmark):
    def to_dict(self, origin_vehicle=None, observe_intentions=True):
        return super().to_dict(origin_vehicle, observe_intentions) | {"x": 1.0}


@pytest.mark.parametrize("change", ["nothing", "whole", "presence", "class", "method", "unknown", "no goal"])
def test_a_goal_is_shown_without_data_frames_where_it_is_known(change, monkeypatch):
    env = gymnasium.make("parking-v0", disable_env_checker=True).unwrapped
    env.reset(seed=3)
    seen = env.observation_type
    if change == "whole":
        env.vehicle.heading = 2
    elif change == "presence":
        seen.features, seen.scales = ["presence", "y", "y"], np.array([2, 3, 4])
    elif change == "class":
        env.vehicle.goal.__class__ = Elsewhere
    elif change == "method":
        env.vehicle.to_dict = lambda *given: dict.fromkeys(seen.features, 7.0)
    elif change == "unknown":
        seen.features = [*seen.features[:-1], "long_off"]
    elif change == "no goal":
        del env.vehicle.goal

    def shown():
        try:
            found = seen.observe()
        except Exception as error:
            return repr(error)
        assert found["observation"] is not found["achieved_goal"]
        return type(found), exact(found), [array.dtype for array in found.values()]

    slow = shown()
    assert switch_on() == ""
    frames = []
    build = observation.pd.DataFrame.from_records
    monkeypatch.setattr(observation.pd.DataFrame, "from_records", lambda rows: frames.append(1) or build(rows))
    assert shown() == slow
    assert bool(frames) == (change in ("class", "method", "unknown", "no goal"))


def test_a_method_of_one_vehicle_is_called():
    assert switch_on() == ""
    road = small_road(IDMVehicle, IDMVehicle)
    called = []
    road.vehicles[1].act = lambda: called.append("act")
    road.act()
    road.step(0.1)
    assert called == ["act"]


def test_it_steps_aside_for_another_version(monkeypatch):
    monkeypatch.setattr(highway_env, "__version__", "9.9")
    assert "highway-env 9.9 is not supported" in switch_on()
    assert Road.act.__module__ == "highway_env.road.road"


def test_it_steps_aside_for_a_changed_installation(monkeypatch):
    monkeypatch.setattr(_supported, "ACCELERATED", {highway_env.__version__: "0123"})
    assert "not the published one" in reason_against()


# Each in a process of its own that has imported highway-env, which takes a second, but nothing of ours: in forks.
PATCHED = """
import os, sys
import highway_env, highway_env.envs.common.observation as kinds
from highway_env.road.lane import AbstractLane
from highway_env.vehicle.kinematics import Vehicle
def mine(self, *words): ...
def replace(name):
    exec(f"{name} = mine", globals())
    from crashhunt.highway.accelerator import switch_on
    print(name, switch_on(), flush=True)
def remove():
    del kinds.ExitObservation
    highway_env.__version__ = '1.10.1'  # a checkout, next to the published one
    import crashhunt
    with crashhunt.accelerate() as faster:
        print(faster, bool(faster), faster.left_alone, flush=True)
for name in sys.argv[1:]:
    if os.fork() == 0:
        replace(name) if name else remove()
        os._exit(0)
    os.wait()
"""


def test_in_the_users_process_it_steps_aside_for_another_version_and_where_another_has_replaced_a_method(tmp_path):
    names = ["Vehicle.clip_actions", "AbstractLane.on_lane", "highway_env.utils.not_zero"]
    (tmp_path / "patched.py").write_text(PATCHED)
    command = [sys.executable, "patched.py", *names, ""]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    *replaced, removed = done.stdout.splitlines()
    for name, line in zip(names, replaced, strict=True):
        assert line.startswith(name)
        assert f" {name.removeprefix('highway_env.utils.')} has been replaced by" in line
    # That version has not even the names which the accelerator imports.
    assert removed.startswith("<highway-env is not accelerated: highway-env 1.10.1 is not supported (supported: ")
    assert removed.endswith(")> False {}")


@pytest.mark.parametrize(("owner", "name"), [(Road, "act"), (AbstractEnv, "_simulate")])
def test_method_that_a_module_puts_back_too_late_is_not_taken_for_an_original(monkeypatch, owner, name):
    assert not switch_on()
    with monkeypatch.context() as patched:
        patched.setattr(owner, name, lambda *_: None)
        switch_off()  # leaves the module's own method where it is
    assert not switch_on()
    try:
        env = gymnasium.make("highway-v0").unwrapped
        env.reset(seed=1)
        env.step(1)  # which called itself without end
    finally:
        switch_off()


PLUGIN = """
from crashhunt.highway.accelerator import switch_on


def pytest_configure(config):
    reason = switch_on()
    assert not reason, reason
"""


def test_highway_envs_own_tests_pass_with_it(tmp_path):
    """Its published archives do not have them: give a checkout of its repository."""
    source = os.environ.get("CRASHHUNT_HIGHWAY_ENV_SOURCE")
    if not source:
        pytest.skip("set CRASHHUNT_HIGHWAY_ENV_SOURCE to a checkout of highway-env")
    (tmp_path / "accelerated.py").write_text(PLUGIN)
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    command = [sys.executable, "-m", "pytest", "-q", "-c", "pytest.ini", "--rootdir", source, "-p", "accelerated",
               "-p", "no:randomly", "-p", "no:xdist", "-p", "no:cacheprovider", f"{source}/tests"]  # fmt: skip
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{source}", "SDL_VIDEODRIVER": "dummy"}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:]
    assert "165 passed" in done.stdout


def test_roads_of_earlier_episodes_are_forgotten():
    assert switch_on() == ""
    gone = []
    for seed in range(20):
        env = gymnasium.make("highway-fast-v0", disable_env_checker=True).unwrapped
        env.reset(seed=seed)
        env.step(1)
        gone.append(weakref.ref(env.road))
        env.close()
        del env
    gc.collect()
    assert sum(road() is not None for road in gone) <= 16
    switch_off()
    gc.collect()
    assert not any(road() is not None for road in gone)


def test_a_vehicle_that_calls_itself_equal_to_another_is_not_taken_for_it():
    env = gymnasium.make("highway-fast-v0", disable_env_checker=True).unwrapped
    env.reset(seed=0)
    objects = KernelObjects(env.road, Network(env.road.network))
    assert objects.is_of(env.road)
    other = copy.copy(env.road.vehicles[-1])
    other.__class__ = type("Equal", (type(other),), {"__eq__": lambda *_: True, "__hash__": object.__hash__})
    env.road.vehicles[-1] = other
    assert not objects.is_of(env.road)
