"""commonroad-reactive-planner as a program for --agent exec:, in an environment of its own: it needs protobuf 3."""

import json
import sys

import numpy as np
from commonroad.scenario.scenario import Scenario
from commonroad_clcs.config import CLCSParams
from commonroad_dc.pycrcc import CollisionChecker, RectOBB, TimeVariantCollisionObject
from commonroad_rp.reactive_planner import ReactivePlanner
from commonroad_rp.state import ReactivePlannerState
from commonroad_rp.utility.config import ReactivePlannerConfiguration
from commonroad_rp.utility.utils_coordinate_system import CoordinateSystem

READY = {
    "type": "ready", "action": "trajectory", "observation": ["ego", "actors", "predictions", "route", "speed_limit"],
    "arguments": {"desired_speed": {"range": "8:20", "unit": "m/s", "default": 14.0}},
}  # fmt: skip
answers, sys.stdout = sys.stdout, sys.stderr  # the planner prints


def start(length, width):
    """Return the planner for a vehicle."""
    config = ReactivePlannerConfiguration()
    config.planning.time_steps_computation, config.debug.multiproc, config.debug.logging_level = 20, False, "ERROR"
    config.vehicle.length, config.vehicle.width = length, width
    config.vehicle.wb_front_axle = config.vehicle.wb_rear_axle = 0.3 * length
    config.sampling.num_sampling_levels, config.sampling.d_min, config.sampling.d_max = 2, -0.5, 0.5
    config.scenario, config.planning_problem = Scenario(dt=0.1), None
    return ReactivePlanner(config)


def act(planner, driven, wanted, seen):
    """Return a trajectory; the path driven so far continues the route backwards."""
    x, y, heading, speed, acceleration, yaw_rate, steering, length, _ = seen["ego"][:9]
    turn, back = np.array([np.cos(heading), np.sin(heading)]), 0.3 * length  # it plans for the rear axle
    ahead = np.array([row[1:3] for row in seen["route"] if row[0]])
    driven.extend([ahead[0] - far * turn for far in range(20, 0, -2)] if not driven else ())
    planner.set_reference_path(coordinate_system=CoordinateSystem(np.vstack([driven, ahead]), clcs_params=CLCSParams()))
    if np.hypot(*(driven[-1] - ahead[0])) > 1.0:
        driven[:] = [*driven[-20:], ahead[0]]
    checker = CollisionChecker()
    for actor, path in zip(seen["actors"], seen["predictions"], strict=True):
        if actor[0]:
            moving = TimeVariantCollisionObject(1)
            for px, py, yaw, _ in path:
                moving.append_obstacle(RectOBB(actor[7] / 2 + 0.3, actor[8] / 2 + 0.2, yaw, px, py))
            checker.add_collision_object(moving)
    state = ReactivePlannerState(0, (x, y) - back * turn, steering, speed, heading, acceleration, yaw_rate)
    planner.reset(initial_state_cart=state, collision_checker=checker)
    planner.set_desired_velocity(min(wanted, seen["speed_limit"][0]), max(speed, 0.01))
    found = planner.plan()
    if found is None:  # brake
        times = [(time, min(time, speed / 8)) for time in (0.1, 0.2)]
        return [[time, *((x, y) + turn * t * (speed - 4 * t)), heading, speed - 8 * t] for time, t in times]
    axles = [
        (one.orientation, np.array([np.cos(one.orientation), np.sin(one.orientation)]), one)
        for one in found[0].state_list
    ]
    return [
        [0.1 * k, *(one.position + back * turn), h, max(0.0, one.velocity)] for k, (h, turn, one) in enumerate(axles)
    ]


for message in map(json.loads, sys.stdin):
    if message["type"] == "hello":
        planner, driven, wanted, answer = None, [], float(message["arguments"].get("desired_speed", 14)), READY
    elif message["type"] == "reset":
        answer = {"type": "ok"}
    elif message["type"] == "observe":
        planner = planner or start(*message["observation"]["ego"][7:9])
        answer = {"type": "act", "action": act(planner, driven, wanted, message["observation"])}
    else:
        break
    print(json.dumps(answer), file=answers, flush=True)
