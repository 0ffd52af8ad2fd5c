"""An MPC on OSQP as an agent: a quadratic program for the accelerations of 5 s, and pure pursuit of the route."""

import numpy as np
import osqp
from scipy import sparse

STEPS, STEP_S = 25, 0.2


class Mpc:
    """Reaches its speed, and keeps a distance from every predicted actor on the route; bends bound the speed."""

    observation = ("ego", "actors", "predictions:steps=25:interval=0.2", "speed_limit")
    action = "acceleration_steering"

    def __init__(self, map, vehicle, desired_speed: float = 14.0, headway: float = 1.0, gap: float = 4.0):
        self.path, self.vehicle, self.desired_speed = map.reference_path, vehicle, desired_speed
        self.headway, self.gap = headway, gap
        self.s = np.append(0.0, np.cumsum(np.hypot(*np.diff(self.path, axis=0).T)))
        self.heading = np.unwrap(np.arctan2(*np.gradient(self.path, axis=0).T[::-1]))
        one, late = sparse.eye(STEPS), sparse.eye(STEPS, k=-1)
        total = sparse.csc_matrix(np.tril(np.ones((STEPS, STEPS))))
        self.speeds = STEP_S * total
        self.places = STEP_S * total @ (self.speeds + late @ self.speeds) / 2
        cost = self.speeds.T @ self.speeds + 0.5 * one + 2.0 * (one - late).T @ (one - late)
        self.hessian = sparse.triu(sparse.block_diag([cost, [[1e3]]]), format="csc")  # at last: to come too close
        near = sparse.hstack([self.places + headway * self.speeds, -np.ones((STEPS, 1))])
        zero = sparse.csc_matrix((STEPS, 1))
        self.rows = sparse.vstack([sparse.hstack([one, zero]), sparse.hstack([self.speeds, zero]), near], format="csc")

    def reset(self, seed):
        self.at = 0

    def act(self, observation):
        x, y, heading, speed = observation["ego"][:4].tolist()
        self.at += int(np.hypot(*(self.path[self.at : self.at + 40] - (x, y)).T).argmin())
        bend = np.abs(np.diff(self.heading[self.at : self.at + 20])).max(initial=0.0) / 2.0
        wanted = min(self.desired_speed, observation["speed_limit"][0], np.sqrt(2.5 / max(bend, 1e-3)))
        gradient = np.append(self.speeds.T @ np.full(STEPS, speed - wanted), 0.0)
        low = np.concatenate([np.full(STEPS, -8.0), np.full(STEPS, -speed), np.full(STEPS, -np.inf)])
        times = STEP_S * np.arange(1, STEPS + 1)
        room = self.room(observation["actors"], observation["predictions"]) - speed * (times + self.headway)
        high = np.concatenate([np.full(STEPS, 3.0), np.full(STEPS, 60.0), room])
        problem = osqp.OSQP()
        problem.setup(self.hessian, gradient, self.rows, low, high, verbose=False)
        dx, dy = self.path[min(self.at + 2 + int(0.4 * speed), len(self.path) - 1)] - (x, y)
        turn = 2 * self.vehicle.wheelbase * np.sin(np.arctan2(dy, dx) - heading) / max(1.0, np.hypot(dx, dy))
        return float(np.clip(problem.solve().x[0], -10, 10)), float(np.clip(np.arctan(turn), -0.6, 0.6))

    def room(self, actors, paths):
        """Return the distance to the next actor on the route, for each step."""
        ahead, room = self.path[self.at : self.at + 60], np.full(STEPS, 1e3)
        for number in np.flatnonzero(actors[:, 0]):
            away = np.hypot(*(paths[number][:, None, :2] - ahead).transpose(2, 0, 1))
            nearest, (length, width) = self.at + away.argmin(1), actors[number, 7:9]
            turn = paths[number][:, 2] - self.heading[nearest]
            along, across = np.abs(np.cos(turn)), np.abs(np.sin(turn))  # a truck that crosses is wide, and not long
            center = self.s[nearest] - self.s[self.at]
            front = center - (length * along + width * across + self.vehicle.length) / 2 - self.gap
            side = (length * across + width * along + self.vehicle.width) / 2 + 0.3
            room = np.where((away.min(1) < side) & (center > 0), np.minimum(room, front), room)
        return room
