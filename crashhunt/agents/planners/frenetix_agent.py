"""frenetix as an agent: it samples curves along the route, and drives the cheapest feasible one."""

from itertools import product

import frenetix as fx
import numpy as np
from frenetix.trajectory_functions import FillCoordinates, cost_functions as costs, feasability_functions as limits

PARTS = "ego actors:rows=9 predictions:rows=9 prediction_covariance:rows=9:along=0.3:across=0.1 route:behind=20"


class Frenetix:
    """Samples end speeds, end times and end offsets; drives the cheapest curve that touches no predicted actor."""

    observation, action = PARTS.split(), "trajectory"

    def __init__(self, vehicle, desired_speed: float = 14.0, caution: float = 1e4):
        self.size, self.wheelbase = (vehicle.length, vehicle.width, vehicle.rear_axle_offset), vehicle.wheelbase
        self.desired_speed, self.caution = desired_speed, caution

    def reset(self, seed): ...

    def act(self, observation):
        x, y, heading, speed, acceleration, _, steering = observation["ego"][:7].tolist()
        wheelbase, is_slow = self.wheelbase, speed < 4
        path, limit = (route := observation["route"][observation["route"][:, 0] > 0])[:, 1:3], route[:, 4]
        wanted = min(self.desired_speed, np.sqrt(limit**2 + 2 * np.hypot(*(path - (x, y)).T)).min())  # at 1 m/s²
        frame = fx.CoordinateSystemWrapper(np.vstack([path, path[-1] + 50 * (path[-1] - path[-2])]))  # beyond its end
        state = fx.CartesianPlannerState(np.array([x, y]), heading, speed, acceleration, steering)
        start = fx.compute_initial_state(frame, state, wheelbase, is_slow)
        ends = product((1.0, 1.5, 2.0, 3.0), np.linspace(0, wanted, 6), (-0.5, 0, 0.5))
        rows = [(0, time, *start.x0_lon, v, 0, *start.x0_lat, offset, 0, 0) for time, v, offset in ends]
        handler = fx.TrajectoryHandler(0.1)
        handler.add_function(FillCoordinates(is_slow, heading, frame, 3))
        handler.add_feasability_function(limits.CheckAccelerationConstraint(8.0, 8.0, False))
        handler.add_feasability_function(limits.CheckCurvatureConstraint(0.6, wheelbase, False))
        handler.add_cost_function(costs.CalculateLateralJerkCost("lateral", 0.2))
        handler.add_cost_function(costs.CalculateLongitudinalJerkCost("longitudinal", 0.2))
        handler.add_cost_function(costs.CalculateDistanceToReferencePathCost("path", 5.0))
        handler.add_cost_function(costs.CalculateVelocityOffsetCost("speed", 1.0, wanted, 0.1, 1.5, False, 2))
        risk = "risk", self.caution, _predicted(observation), *self.size
        handler.add_cost_function(costs.CalculateCollisionProbabilityFast(*risk))
        handler.generate_trajectories(np.array(rows), is_slow)
        handler.evaluate_all_current_functions(True)
        valid = [one for one in handler.get_sorted_trajectories() if one.valid]  # the first is the cheapest
        feasible = [one.cartesian for one in valid if one.feasible] or [valid[0].cartesian]
        # To drive through an actor fast has a smaller sum of probabilities than to brake, so exclude it; else brake.
        free = (one for one in feasible if not self._touches(one, observation))
        plan = next(free, None) or min(feasible, key=lambda one: one.v[5])
        return np.column_stack((np.arange(len(plan.x)) * 0.1, plan.x, plan.y, plan.theta, plan.v))

    def _touches(self, plan, observation):
        for actor, poses in zip(observation["actors"], observation["predictions"], strict=True):
            last = min(len(poses), len(plan.x) - 1) if actor[0] else 0
            own = np.column_stack([plan.x, plan.y, plan.theta])[1 : last + 1]
            (dx, dy, turn), c, s = (poses[:last, :3] - own).T, np.cos(own[:, 2]), np.sin(own[:, 2])
            sizes = np.abs([np.cos(turn), np.sin(turn)]).T @ [actor[7:9], actor[8:6:-1]] + self.size[:2]
            if (sizes / 2 > np.abs([dx * c + dy * s, dy * c - dx * s]).T).all(axis=1).any():  # outlines overlap
                return True
        return False


def _predicted(observation):
    actors, others = observation["actors"], {}
    around = observation["predictions"], observation["prediction_covariance"]
    for number in np.flatnonzero(actors[:, 0]).tolist():
        poses = []
        for (x, y, yaw, _), (a, b, c) in zip(*(one[number] for one in around), strict=True):
            place, turn = np.array([x, y, 0]), np.array([0, 0, np.sin(yaw / 2), np.cos(yaw / 2)])
            poses.append(fx.PoseWithCovariance(place, turn, np.pad([[a + 0.1, c], [c, b + 0.1]], (0, 4))))
        others[number] = fx.PredictedObject(number, poses, *actors[number, 7:9])
    return others
