"""A policy of Stable-Baselines3 as an agent that accelerates and steers; sb3_training.py trains it."""

import numpy as np
from stable_baselines3 import PPO

PARTS = ("ego", "actors:rows=8", "route:points=16:spacing=2", "speed_limit")
LIMITS = np.array([4.0, 0.25])  # m/s² and rad


def features(observation):
    """The speed, four points of the route, and the nearest actor on the way ahead, relative to the vehicle."""
    x, y, heading, speed = observation["ego"][:4]
    turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    points = (observation["route"][:, 1:3] - (x, y)) @ turn
    gap, closing = 60.0, 0.0
    for row in observation["actors"]:
        along, left = (row[1:3] - (x, y)) @ turn
        if row[0] and along > 0 and np.abs(points[:, 1:] - left).min() < 1.8 and along - 5.0 < gap:
            gap, closing = along - 5.0, speed - row[4:6] @ turn[:, 0]
    room = [speed / 15, gap / 30, closing / 10, observation["speed_limit"][0] / 15]
    return np.array([*room, *(points[[2, 4, 7, 12]] / 10).ravel()], np.float32).clip(-5, 5)


class Policy:
    """Drives with a trained policy."""

    observation, action = PARTS, "acceleration_steering"

    def __init__(self, path: str = "policy.zip"):
        self.model = PPO.load(path, device="cpu")

    def reset(self, seed): ...

    def act(self, observation):
        action, _ = self.model.predict(features(observation), deterministic=True)
        return np.clip(action, -1, 1).astype(float) * LIMITS
