"""FISS+ and FOP+ of fiss-planner as agents."""

import math

import fiss_planner as fp
import numpy as np


class FissPlanner:
    """Plans a trajectory for the next seconds in each step, and stops at red lights."""

    observation, action = ("ego", "actors", "actor_ids", "signals"), "trajectory"
    planner_type = "fiss_plus"

    def __init__(self, map, vehicle, desired_speed: float = 14.0):
        numbers = {name: number for number, name in enumerate(map.lanes, start=1)}
        self.roads, self.route = fp.RoadMap(), [numbers[name] for name in map.route]
        for lane in (one for one in map.lanes.values() if one.is_open):
            one = fp.MapLane()
            one.id, one.speed_limit = numbers[lane.id], lane.speed_limit
            one.centerline, one.left, one.right = lane.center, lane.left_line, lane.right_line
            one.successors = [numbers[name] for name in lane.successors if map.lanes[name].is_open]
            one.can_change_left, one.can_change_right = lane.can_change_left, lane.can_change_right
            one.left_neighbor, one.right_neighbor = numbers.get(lane.left, -1), numbers.get(lane.right, -1)
            self.roads.add_lane(one)
        self.lines = {number: line.ends.mean(axis=0) for number, line in enumerate(map.stop_lines) if line.signal}
        for number in self.lines:
            line, lane = fp.StopLine(), map.stop_lines[number].lane
            line.id, line.lane_id, line.s, line.active = number, numbers[lane], map.lanes[lane].length - 1.0, False
            self.roads.add_stop_line(line)
        self.roads.finalize()
        size, config = fp.VehicleParams(), fp.LocalPlannerConfig()
        size.length, size.width, size.wheelbase = vehicle.length, vehicle.width, vehicle.wheelbase
        size.rear_axle_to_center, size.max_speed = vehicle.rear_axle_offset, vehicle.max_speed
        size.max_accel, size.max_decel = vehicle.max_acceleration, vehicle.emergency_deceleration
        config.planner, config.desired_speed = fp.make_config(self.planner_type), desired_speed
        self.curvature = math.tan(vehicle.max_steering) / vehicle.wheelbase
        self.planner = fp.LocalPlanner(config, size)

    def reset(self, seed):
        self.planner.reset()
        self.planner.set_map(self.roads, self.route)

    def act(self, observation):
        x, y, heading, speed, acceleration, yaw_rate, _, length, *_, time = observation["ego"].tolist()
        front = x + length / 2 * math.cos(heading), y + length / 2 * math.sin(heading)
        red = [row[2] for row in observation["signals"].tolist() if row[0] and row[1] == 2]
        for number, middle in self.lines.items():  # those as far away as a red light on the route
            self.planner.set_stop_line_active(number, any(abs(math.dist(front, middle) - one) < 3 for one in red))
        state = fp.EgoState(x, y, heading, speed, acceleration, yaw_rate / speed if speed > 1.0 else 0.0)
        others = []
        for number, row in zip(observation["actor_ids"].tolist(), observation["actors"].tolist(), strict=True):
            if row[0]:
                place = int(number), *row[1:4], math.hypot(*row[4:6]), *row[7:9]
                others.append(fp.predict_lane_following(self.roads, *place, 6.0, 0.1))
        plan = self.planner.step(time, state, others).trajectory
        # The planner derives headings from places, which turn at random where the vehicle is slow: turn as wheels can.
        yaw = [heading]
        for angle, v in zip(plan.yaw, plan.v, strict=True):
            most = max(v, 0.0) * 0.1 * self.curvature
            yaw.append(yaw[-1] + min(max(math.remainder(angle - yaw[-1], math.tau), -most), most))
        return np.column_stack((np.maximum(plan.t, 0.0), plan.x, plan.y, yaw[1:], plan.v))[:64]


class FopPlanner(FissPlanner):
    """Evaluates all samples."""

    planner_type = "fop_plus"
