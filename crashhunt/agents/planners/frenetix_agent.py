"""frenetix as an agent: it samples curves along the route, and drives the cheapest feasible one."""

import frenetix as fx
import numpy as np
from frenetix.trajectory_functions import FillCoordinates, cost_functions as costs, feasability_functions as limits

PARTS = "ego actors:rows=9 predictions:rows=9 prediction_covariance:rows=9:along=0.3:across=0.1 route"
ENDS = np.array(np.meshgrid((1, 1.5, 2, 3), np.linspace(0, 1, 6), (-0.5, 0, 0.5))).reshape(3, -1).T


class Frenetix:
    """Samples end speeds, end times and end offsets; drives the cheapest curve that touches no predicted actor."""

    observation, action = PARTS.split(), "trajectory"

    def __init__(self, map, vehicle, desired_speed: float = 14.0, caution: float = 1e4):
        path = map.reference_path  # which continues straight on before its start and beyond its end
        path = np.vstack([path[0] - 20 * (path[1] - path[0]), path, path[-1] + 50 * (path[-1] - path[-2])])
        along = np.append(0, np.hypot(*np.diff(path, axis=0).T).cumsum())
        smooth = [np.convolve(np.interp(np.arange(along[-1]), along, v), np.ones(7) / 7, "valid") for v in path.T]
        self.path = np.column_stack(smooth)  # without corners, in steps of 1 m
        self.size, self.wheelbase = (vehicle.length, vehicle.width, vehicle.rear_axle_offset), vehicle.wheelbase
        self.desired_speed, self.caution, self.at = desired_speed, caution, 0

    def reset(self, seed): ...

    def act(self, observation):
        x, y, yaw, v, acceleration, _, steering = observation["ego"][:7].tolist()
        ahead, limit = (route := observation["route"][observation["route"][:, 0] > 0])[:, 1:3], route[:, 4]
        wanted = min(self.desired_speed, np.sqrt(limit**2 + 2 * np.hypot(*(ahead - (x, y)).T)).min())  # at 1 m/s²
        self.at += np.hypot(*(self.path[self.at : self.at + 500] - (x, y)).T).argmin()
        frame = fx.CoordinateSystemWrapper(self.path[max(0, self.at - 20) : self.at + 150])
        state = fx.CartesianPlannerState(np.array([x, y]), yaw, v, acceleration, steering)
        start = fx.compute_initial_state(frame, state, self.wheelbase, is_slow := v < 4)
        rows = [(0, t, *start.x0_lon, end, 0, *start.x0_lat, d, 0, 0) for t, end, d in ENDS * (1, wanted, 1)]
        handler = fx.TrajectoryHandler(0.1)
        handler.add_function(FillCoordinates(is_slow, yaw, frame, 3))
        handler.add_feasability_function(limits.CheckAccelerationConstraint(8.0, 8.0, False))
        handler.add_feasability_function(limits.CheckCurvatureConstraint(0.6, self.wheelbase, False))
        handler.add_cost_function(costs.CalculateLateralJerkCost("lateral", 0.2))
        handler.add_cost_function(costs.CalculateLongitudinalJerkCost("longitudinal", 0.2))
        handler.add_cost_function(costs.CalculateDistanceToReferencePathCost("path", 5.0))
        handler.add_cost_function(costs.CalculateVelocityOffsetCost("speed", 1.0, wanted, 0.1, 1.5, False, 2))
        seen = zip(*(observation[one] for one in ("actors", "predictions", "prediction_covariance")), strict=True)
        others = {n: fx.PredictedObject(n, list(map(_pose, p, c)), *a[7:9]) for n, (a, p, c) in enumerate(seen) if a[0]}
        handler.add_cost_function(costs.CalculateCollisionProbabilityFast("risk", self.caution, others, *self.size))
        handler.generate_trajectories(np.array(rows), is_slow)
        handler.evaluate_all_current_functions(True)
        feasible = [one.cartesian for one in handler.get_sorted_trajectories() if one.valid and one.feasible]
        # To drive through an actor fast has a smaller sum of probabilities than to brake, so exclude it; else brake.
        free = (one for one in feasible if not self._touches(one, observation))  # the first is the cheapest
        plan = next(free, None) or min(feasible, key=lambda one: one.v[5], default=None)
        if plan:
            return np.column_stack((np.arange(len(plan.x)) * 0.1, plan.x, plan.y, plan.theta, plan.v))
        s = (t := np.minimum(at := np.arange(31) * 0.1, v / 8)) * (v - 4 * t)  # else brake straight on
        return np.column_stack((at, np.add((x, y), np.outer(s, (np.cos(yaw), np.sin(yaw)))), 0 * s + yaw, v - 8 * t))

    def _touches(self, plan, observation):
        for actor, poses in zip(observation["actors"], observation["predictions"], strict=True):
            last = min(len(poses), len(plan.x) - 1) if actor[0] else 0
            own = np.column_stack([plan.x, plan.y, plan.theta])[1 : last + 1]
            (dx, dy, turn), c, s = (poses[:last, :3] - own).T, np.cos(own[:, 2]), np.sin(own[:, 2])
            sizes = np.abs([np.cos(turn), np.sin(turn)]).T @ [actor[7:9], actor[8:6:-1]] + self.size[:2]
            if (sizes / 2 > np.abs([dx * c + dy * s, dy * c - dx * s]).T).all(axis=1).any():  # outlines overlap
                return True
        return False


def _pose(pose, covariance):
    (x, y, yaw, _), (a, b, c) = pose, covariance
    place, turn = np.array([x, y, 0]), np.array([0, 0, np.sin(yaw / 2), np.cos(yaw / 2)])
    return fx.PoseWithCovariance(place, turn, np.pad([[a + 0.1, c], [c, b + 0.1]], (0, 4)))
