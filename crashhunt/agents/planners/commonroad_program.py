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

PARTS = ["ego", "actors:rows=9", "predictions:rows=9", "route:behind=20"]
SPEED = {"desired_speed": {"range": "8:20", "unit": "m/s", "default": 14.0}}
answers, sys.stdout = sys.stdout, sys.stderr  # the planner prints


def _start(length, width):
    config = ReactivePlannerConfiguration()
    vehicle, sampling, config.planning.time_steps_computation = config.vehicle, config.sampling, 20
    vehicle.length, vehicle.width, vehicle.wb_front_axle = length, width, 0.3 * length
    vehicle.wb_rear_axle, sampling.num_sampling_levels, sampling.d_min, sampling.d_max = 0.3 * length, 2, -0.5, 0.5
    config.debug.multiproc, config.debug.logging_level, config.scenario = False, "ERROR", Scenario(dt=0.1)
    config.planning_problem = None
    return ReactivePlanner(config)


def _plan(planner, wanted, seen):
    """Return x, y, heading and speed for now and each 0.1 s from now."""
    x, y, heading, speed, acceleration, yaw_rate, steering, length = seen["ego"][:8]
    turn, back, checker = np.array([np.cos(heading), np.sin(heading)]), 0.3 * length, CollisionChecker()
    route = np.array([row for row in seen["route"] if row[0]])
    wanted = min(wanted, np.sqrt(route[:, 4] ** 2 + 2 * np.hypot(*(route[:, 1:3] - (x, y)).T)).min())  # at 1 m/s²
    path = np.vstack([route[:, 1:3], 51 * route[-1, 1:3] - 50 * route[-2, 1:3]])  # beyond its end
    planner.set_reference_path(coordinate_system=CoordinateSystem(path, clcs_params=CLCSParams()))
    for actor, poses in zip(seen["actors"], seen["predictions"], strict=True):
        moving = TimeVariantCollisionObject(1)
        for px, py, yaw, _ in poses if actor[0] else ():
            moving.append_obstacle(RectOBB(actor[7] / 2 + 0.3, actor[8] / 2 + 0.2, yaw, px, py))
        checker.add_collision_object(moving)
    state = ReactivePlannerState(0, (x, y) - back * turn, steering, speed, heading, acceleration, yaw_rate)
    planner.reset(initial_state_cart=state, collision_checker=checker)
    planner.set_desired_velocity(wanted, max(speed, 0.01))
    found = planner.plan()
    if found is None:  # brake
        return [
            [x, y, heading, speed],
            [*((x, y) + turn * max(0.0, 0.1 * speed - 0.04)), heading, max(0.0, speed - 0.8)],
        ]
    plan = [(one.position, one.orientation, max(0.0, one.velocity)) for one in found[0].state_list]
    return [[*(at + back * np.array([np.cos(h), np.sin(h)])), h, v] for at, h, v in plan]


for message in map(json.loads, sys.stdin):
    answer = {"type": "ok"}
    if message["type"] == "hello":
        planner, plan, age, wanted = None, [], 0, float(message["arguments"].get("desired_speed", 14))
        answer = {"type": "ready", "action": "trajectory", "observation": PARTS, "arguments": SPEED}
    elif message["type"] == "observe":
        planner = planner or _start(*message["observation"]["ego"][7:9])
        plan, age = plan[1:], age + 1
        if age == planner.config.planning.replanning_frequency or len(plan) < 2:
            plan, age = _plan(planner, wanted, message["observation"]), 0
        answer = {"type": "act", "action": [[0.1 * k, *pose] for k, pose in enumerate(plan)]}
    print(json.dumps(answer), file=answers, flush=True)
