"""frenetix as an agent: it samples curves along the route, and the cheapest feasible one is driven."""

import itertools

import frenetix as fx
import numpy as np
from frenetix.trajectory_functions import FillCoordinates, cost_functions as costs, feasability_functions as limits

SPREADS = [np.diag([0.1 + 0.05 * step] * 2 + [0.0] * 4) for step in range(30)]  # m², in each step of a prediction


class Frenetix:
    """Samples end speeds, end times and end offsets; the probability of collisions is one of the costs."""

    observation = ("ego", "actors", "predictions", "speed_limit")
    action = "trajectory"

    def __init__(self, map, vehicle, columns, desired_speed: float = 14.0, caution: float = 1e4):
        self.path, self.vehicle, self.columns = map.reference_path.copy(), vehicle, columns["ego"]
        self.desired_speed, self.caution = desired_speed, caution

    def reset(self, seed):
        self.at, self.built = 0, -100

    def act(self, observation):
        x, y, heading, speed = observation["ego"][:4].tolist()
        self.at += int(np.hypot(*(self.path[self.at : self.at + 40] - (x, y)).T).argmin())
        if self.at > self.built + 10:  # the frame is a window of the route, because a ring crosses itself
            self.built = self.at
            self.frame = fx.CoordinateSystemWrapper(self.path[max(0, self.at - 15) : self.at + 75])
        wanted, wheelbase, slow = (
            min(self.desired_speed, observation["speed_limit"][0]),
            self.vehicle.wheelbase,
            speed < 2,
        )
        acceleration, steering = (observation["ego"][self.columns[name]] for name in ("acceleration", "steering"))
        state = fx.CartesianPlannerState(np.array([x, y]), heading, speed, acceleration, steering)
        start = fx.compute_initial_state(self.frame, state, wheelbase, slow)
        ends = itertools.product((1.5, 2.0, 3.0), np.linspace(0, wanted, 6), (-0.5, 0, 0.5))
        rows = [(0, time, *start.x0_lon, v, 0, *start.x0_lat, offset, 0, 0) for time, v, offset in ends]
        handler = fx.TrajectoryHandler(0.1)
        handler.add_function(FillCoordinates(slow, heading, self.frame, 3))
        handler.add_feasability_function(limits.CheckAccelerationConstraint(8.0, 8.0, False))
        handler.add_feasability_function(limits.CheckCurvatureConstraint(0.6, wheelbase, False))
        handler.add_cost_function(costs.CalculateLateralJerkCost("lateral", 0.2))
        handler.add_cost_function(costs.CalculateLongitudinalJerkCost("longitudinal", 0.2))
        handler.add_cost_function(costs.CalculateDistanceToReferencePathCost("path", 5.0))
        handler.add_cost_function(costs.CalculateVelocityOffsetCost("speed", 1.0, wanted, 0.1, 1.5, False, 2))
        size = self.vehicle.length, self.vehicle.width, self.vehicle.rear_axle_offset
        others = self.predictions(observation["actors"], observation["predictions"])
        handler.add_cost_function(costs.CalculateCollisionProbabilityFast("risk", self.caution, others, *size))
        handler.generate_trajectories(np.array(rows), slow)
        handler.evaluate_all_current_functions(True)
        valid = (one for one in handler.get_sorted_trajectories() if one.valid)
        plan = min(valid, key=lambda one: not one.feasible).cartesian  # the first is the cheapest
        return np.column_stack((np.arange(len(plan.x)) * 0.1, plan.x, plan.y, plan.theta, plan.v))

    def predictions(self, actors, paths):
        others = {}
        for number in np.flatnonzero(actors[:, 0]).tolist():
            poses = [
                fx.PoseWithCovariance(np.array([x, y, 0]), np.array([0, 0, np.sin(yaw / 2), np.cos(yaw / 2)]), spread)
                for (x, y, yaw, _), spread in zip(paths[number].tolist(), SPREADS, strict=True)
            ]
            others[number] = fx.PredictedObject(number, poses, actors[number, 7], actors[number, 8])
        return others
