"""Random configurations of all environments that highway-env registers: with the accelerator, every bit is the same.

``CRASHHUNT_CONFIGURATIONS`` sets the number of configurations per environment at night; the default gives 2,000 in all.
"""

from __future__ import annotations

import os
import warnings

# First: this imports highway-env without what takes most of that time.
from crashhunt.highway import HighwaySimulator

# isort: split

import gymnasium
import numpy as np
import pytest
from compiled import needs_kernel
from exact_values import exact
from highway_env.vehicle.behavior import IDMVehicle

from crashhunt.highway.accelerator import switch_off, switch_on

assert HighwaySimulator
pytestmark = [pytest.mark.usefixtures("plain_highway_env"), needs_kernel]
IDS = sorted(name for name, spec in gymnasium.registry.items() if str(spec.entry_point).startswith("highway_env"))
PER_ENVIRONMENT = int(os.environ.get("CRASHHUNT_CONFIGURATIONS", -(-2000 // len(IDS))))
STEPS = 60
FEATURES = ["presence", "x", "y", "vx", "vy", "heading", "cos_h", "sin_h", "cos_d", "sin_d", "long_off"]
BEHAVIOR = "highway_env.vehicle.behavior"


class Hurried(IDMVehicle):
    """A user's driver with other numbers."""

    TIME_WANTED = 0.6
    POLITENESS = 0.4


class Nervous(IDMVehicle):
    """A user's driver with another decision."""

    def act(self, action=None):
        super().act(action)
        self.action["steering"] += 0.001


DRIVERS = [f"{BEHAVIOR}.{name}" for name in ("IDMVehicle", "LinearVehicle", "AggressiveVehicle", "DefensiveVehicle")]
DRIVERS += [f"{__name__}.Hurried", f"{__name__}.Nervous"]


def observation(rng, action):
    if rng.random() < 0.2 and action == "DiscreteMetaAction":  # needs the agent's target speeds
        return {"type": "TimeToCollision", "horizon": int(rng.integers(3, 12))}
    features = [str(name) for name in rng.choice(FEATURES, rng.integers(1, 8), replace=False)]
    if rng.random() < 0.5:
        return {
            "type": "Kinematics",
            "features": features,
            "vehicles_count": int(rng.integers(2, 12)),
            **{name: bool(rng.random() < 0.5) for name in ("absolute", "normalize", "clip", "see_behind")},
            "include_obstacles": bool(rng.random() < 0.7),
            "observe_intentions": bool(rng.random() < 0.7),
            "order": str(rng.choice(["sorted", "shuffled"])),
        }
    size = float(rng.choice([15.0, 27.5, 40.0]))
    return {
        "type": "OccupancyGrid",
        "features": [*features, *["on_road"] * (rng.random() < 0.7)],
        "grid_size": [[-size, size], [-size / 2, size]],
        "grid_step": [float(rng.choice([2.0, 3.0, 5.0])), 4],
        **{name: bool(rng.random() < 0.5) for name in ("align_to_vehicle_axes", "clip", "as_image")},
        **({"features_range": {"x": [-60, 60], "vx": [-20, 20]}} if rng.random() < 0.3 else {}),
    }


def configuration(name, rng):
    """A configuration that the environment has keys for; some of them make highway-env fail, which must be the same."""
    env = gymnasium.make(name, disable_env_checker=True).unwrapped
    default, config = env.default_config(), {}
    for count in ("vehicles_count", "initial_vehicle_count", "other_vehicles"):  # mostly few: plain highway-env is slow
        if count in default:
            config[count] = int(rng.integers(0, 14 if rng.random() < 0.2 else 5))
    if "lanes_count" in default:
        config["lanes_count"] = int(rng.integers(1, 6))
    config["simulation_frequency"] = int(rng.choice([4, 5, 10, 15], p=[0.3, 0.3, 0.25, 0.15]))
    config["policy_frequency"] = int(rng.choice([1, 2, 4]))  # with a higher one than the above, nothing would move
    config["other_vehicles_type"] = DRIVERS[rng.integers(len(DRIVERS))]
    config["neighbour_vehicles_connected_lanes"] = bool(rng.random() < 0.3)
    if "spawn_probability" in default:
        config["spawn_probability"] = float(rng.choice([0.1, 0.3, 0.6]))
    config["duration"] = float(rng.choice([12, 60]))
    single = "MultiAgent" not in default["observation"]["type"] and "goal" not in default["observation"]["type"].lower()
    if not single and "controlled_vehicles" in default:
        config["controlled_vehicles"] = int(rng.integers(1, 4))
    if single and name != "lane-keeping-v0" and rng.random() < 0.3:  # which needs the dynamic bicycle model
        kinds = ["DiscreteMetaAction", "DiscreteAction", "ContinuousAction"]
        # These rewards need the number of an action.
        kind = str(rng.choice(kinds[:2] if name.startswith(("merge", "roundabout", "two-way")) else kinds))
        config["action"] = {"type": kind, **({"dynamical": True} if kind[0] == "C" and rng.random() < 0.5 else {})}
    if single and rng.random() < 0.8:
        config["observation"] = observation(rng, config.get("action", default["action"])["type"])
    if single and "controlled_vehicles" in default and rng.random() < 0.3:
        config["controlled_vehicles"] = 2
        for part in ("observation", "action"):
            one = config.get(part, default[part])
            config[part] = {"type": f"MultiAgent{part.capitalize()}", f"{part}_config": one}
    return config


def state(env):
    things = [{key: exact(inner) for key, inner in vars(thing).items()} for thing in env.road.vehicles]
    return things, str(env.np_random.bit_generator.state), str(env.road.np_random.bit_generator.state)


def trace(name, config, seed, steps):
    found, seeds = [], iter(range(seed, seed + steps + 1))

    def reset(env):  # highway-env samples the action in its `info` without a seed, and makes a new action space
        number = next(seeds)
        found.append((exact(env.reset(seed=number, options={"config": config})[0]), state(env)))
        env.action_space.seed(number)

    try:
        env = gymnasium.make(name, disable_env_checker=True).unwrapped  # some do not accept a configuration here
        reset(env)
        for _ in range(steps):
            *seen, info = env.step(env.action_space.sample())
            found.append((exact(seen), exact(info), state(env)))
            if seen[2]:
                reset(env)
    except Exception as error:
        found.append(repr(error))
    return found


def compare(name, number, steps):
    """Compare one configuration; return whether highway-env ran it without an error."""
    rng = np.random.default_rng((IDS.index(name), number))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Gymnasium warns of environments with a newer version
        config, seed = configuration(name, rng), int(rng.integers(2**31))
        switch_off()
        slow = trace(name, config, seed, steps)
        assert not switch_on()
        try:
            fast = trace(name, config, seed, steps)
        finally:
            switch_off()
    assert len(slow) == len(fast), (name, number, config, slow[-1:], fast[-1:])
    for step, (one, two) in enumerate(zip(slow, fast, strict=True)):
        assert one == two, (name, number, config, step)
    return not isinstance(slow[-1], str)


@pytest.mark.parametrize("name", ["highway-fast-v0", "merge-v1", "racetrack-v1"])
def test_random_configuration_has_the_bits_of_highway_env(name):
    assert compare(name, 0, 4) in (True, False)


@pytest.mark.nightly
@pytest.mark.timeout(3600)  # minutes, and many more on a loaded machine
@pytest.mark.parametrize("name", IDS)
def test_many_random_configurations_have_the_bits_of_highway_env(name):
    ran = [compare(name, number, STEPS) for number in range(PER_ENVIRONMENT)]
    assert sum(ran) > len(ran) / 4  # highway-env fails for some
