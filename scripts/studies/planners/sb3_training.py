"""Trains the policy of sb3_agent.py in Gymnasium environments on SUMO.

usage: python sb3_training.py POLICY.zip STEPS
"""

import sys

import gymnasium
import numpy as np
from sb3_agent import LIMITS, PARTS, features
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import DummyVecEnv


class Seen(gymnasium.ObservationWrapper):
    """The features as observation, and shares of the limits as action; a crash costs 10."""

    def __init__(self, scenario):
        kind = {"action": "acceleration_steering", "observation": PARTS, "max_steps": 300, "process": True}
        super().__init__(gymnasium.make("crashhunt:crashhunt/SUMO-v0", scenario=scenario, **kind))
        self.observation_space = gymnasium.spaces.Box(-5, 5, (12,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def observation(self, observation):
        return features(observation)

    def step(self, action):
        seen, _, ended, cut, info = self.env.step(np.clip(action, -1, 1) * LIMITS)
        speed, offset = (found := features(seen))[0], abs(found[5]) * 10
        return found, float(min(speed, 1) * (1 - min(1, offset)) - 10 * ended), ended, cut, info


if __name__ == "__main__":
    check_env(Seen("loop"))
    envs = DummyVecEnv([lambda name=name: Seen(name) for name in ("loop", "intersection", "merge")])
    PPO("MlpPolicy", envs, n_steps=512, seed=1, device="cpu", verbose=1).learn(int(sys.argv[2])).save(sys.argv[1])
