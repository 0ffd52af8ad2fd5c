"""What agents in other languages are told of a simulator, and what the same driver in Python answers."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces
from programs import DRIVER

from crashhunt.simulators import SpeedAndLaneChange

COLUMNS = ("presence", "x", "y", "vx", "vy", "cos_h", "sin_h")
SPACE = spaces.Box(-1e6, 1e6, (8, 7), np.float32)


class Simulated:
    """A simulator that is asked for its spaces only."""

    def __init__(self, form=None, space=SPACE, step_length_s=0.1):
        self.actions, self.observation_spaces = {"ego": form or SpeedAndLaneChange()}, {"ego": space}
        self.observation_names = COLUMNS if space is SPACE else ()
        self.step_length_s = step_length_s


def observations(count=20):
    rng = np.random.default_rng(1)
    return [rng.uniform(-30, 30, (8, 7)).astype(np.float32) for _ in range(count)]


def answers_in_python(**arguments):
    """The actions of the driver in Python."""
    names: dict = {}
    exec(DRIVER, names)
    driver = names["Driver"](**arguments)
    return [driver.act(seen) for seen in observations()]
