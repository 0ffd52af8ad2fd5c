"""FISS+ of fiss-planner as an agent; with ``planner="fop_plus"``, its older brother FOP+."""

import fiss_planner as fp
import numpy as np


class FissPlanner:
    """Plans a trajectory for the next seconds in each step."""

    observation = ("ego", "actors")
    action = "trajectory"

    def __init__(self, map, vehicle, columns, planner: str = "fiss_plus", desired_speed: float = 14.0):
        self.columns = columns
        numbers = {name: number for number, name in enumerate(map.lanes, start=1)}
        roads = fp.RoadMap()
        for lane in map.lanes.values():
            if not lane.is_open:
                continue
            one = fp.MapLane()
            one.id, one.speed_limit = numbers[lane.id], lane.speed_limit
            one.centerline, one.left, one.right = lane.center, lane.left_line, lane.right_line
            one.successors = [numbers[name] for name in lane.successors if map.lanes[name].is_open]
            one.can_change_left, one.can_change_right = lane.can_change_left, lane.can_change_right
            if lane.left:
                one.left_neighbor = numbers[lane.left]
            if lane.right:
                one.right_neighbor = numbers[lane.right]
            roads.add_lane(one)
        roads.finalize()
        size = fp.VehicleParams()
        size.length, size.width, size.wheelbase = vehicle.length, vehicle.width, vehicle.wheelbase
        size.rear_axle_to_center, size.max_speed = vehicle.rear_axle_offset, vehicle.max_speed
        size.max_accel, size.max_decel = vehicle.max_acceleration, vehicle.emergency_deceleration
        config = fp.LocalPlannerConfig()
        config.planner, config.desired_speed = fp.make_config(planner), desired_speed
        self.planner, self.roads = fp.LocalPlanner(config, size), roads
        self.route = [numbers[name] for name in map.route]

    def reset(self, seed):
        self.planner.reset()
        self.planner.set_map(self.roads, self.route)

    def act(self, observation):
        ego = dict(zip(self.columns["ego"], observation["ego"].tolist(), strict=True))
        state = fp.EgoState(ego["x"], ego["y"], ego["heading"], ego["speed"], ego["acceleration"], 0.0)
        others = []
        for number, values in enumerate(observation["actors"].tolist()):
            row = dict(zip(self.columns["actors"], values, strict=True))
            if row["present"]:
                speed = float(np.hypot(row["vx"], row["vy"]))
                place = row["x"], row["y"], row["heading"], speed, row["length"], row["width"]
                others.append(fp.predict_lane_following(self.roads, number, *place, 6.0, 0.1))
        plan = self.planner.step(ego["time"], state, others).trajectory
        return np.column_stack((np.maximum(plan.t, 0.0), plan.x, plan.y, plan.yaw, plan.v))[:64]


class FopPlanner(FissPlanner):
    """FOP+ of the same package, which evaluates all samples."""

    def __init__(self, map, vehicle, columns, desired_speed: float = 14.0):
        super().__init__(map, vehicle, columns, "fop_plus", desired_speed)
