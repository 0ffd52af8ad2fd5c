"""Trains the policy that this scenario hunts: deep Q-learning in highway-env, with Stable-Baselines3.

python train.py [STEPS]   writes policy.npz beside this file; needs pip install 'crashhunt[sb3]' and some five minutes.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import gymnasium
import numpy as np
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.monitor import Monitor

from crashhunt.agents import NumpyPolicy
from crashhunt.highway import HighwaySimulator
from crashhunt.scenario import load_scenario

HERE = Path(__file__).resolve().parent
ROWS, COLUMNS = 8, np.array([0, 1, 2, 3, 4])
SCALE = np.array([1.0, 100.0, 12.0, 30.0, 10.0], np.float32)
SEED = 3


class Motorway(gymnasium.Env):
    """The scenario as an environment, with denser traffic than highway-env's default at times."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (ROWS * len(COLUMNS),), np.float32)
    action_space = gymnasium.spaces.Discrete(5)

    def __init__(self) -> None:
        self.simulator = HighwaySimulator(load_scenario(HERE), Path(tempfile.gettempdir()))

    def reset(self, *, seed=None, options=None):
        """Begin an episode."""
        super().reset(seed=seed)
        self.steps = 0
        arguments = {"vehicles_count": 25, "vehicles_density": float(self.np_random.uniform(0.8, 1.4))}
        shown, _ = self.simulator.reset(seed=int(self.np_random.integers(2**31)), options={"arguments": arguments})
        return self.see(shown), {}

    def step(self, action):
        """Decide once; the reward is highway-env's."""
        self.steps += 1
        shown, rewards, terminations, _, _ = self.simulator.step({"ego": np.array([action])})
        return self.see(shown), rewards["ego"], terminations["ego"], self.steps >= 40, {}

    def see(self, shown):
        """What the policy sees."""
        return NumpyPolicy.features(shown["ego"], ROWS, COLUMNS, SCALE)


def main() -> None:
    """Train, and write the weights."""
    steps = int(sys.argv[1]) if len(sys.argv) > 1 else 60_000
    model = DQN(
        "MlpPolicy",
        Motorway(),
        policy_kwargs={"net_arch": [128, 128]},
        learning_rate=3e-4,
        buffer_size=60_000,
        learning_starts=500,
        batch_size=128,
        gamma=0.92,
        train_freq=1,
        gradient_steps=1,
        target_update_interval=500,
        exploration_fraction=0.3,
        exploration_final_eps=0.02,
        seed=SEED,
        verbose=1,
        device="cpu",
    )
    with tempfile.TemporaryDirectory() as folder:
        best = EvalCallback(Monitor(Motorway()), n_eval_episodes=40, eval_freq=5_000, best_model_save_path=folder)
        model.learn(steps, callback=best, log_interval=200)
        model = DQN.load(Path(folder) / "best_model.zip", device="cpu")
    network = [layer for layer in model.q_net.q_net if hasattr(layer, "weight")]
    weights = {f"weight_{number}": layer.weight.detach().numpy() for number, layer in enumerate(network)}
    weights |= {f"bias_{number}": layer.bias.detach().numpy() for number, layer in enumerate(network)}
    np.savez_compressed(
        HERE / "policy.npz",
        **weights,
        rows=ROWS,
        columns=COLUMNS,
        scale=SCALE,
        period_s=1.0,
        target_speeds=np.array([20.0, 25.0, 30.0]),
    )


if __name__ == "__main__":
    main()
