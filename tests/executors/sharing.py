"""Agents and simulators of test_warm_traffics.py."""

from __future__ import annotations

import os
import random
import threading
import time

import numpy as np

from crashhunt.simulators.toy import ToySimulator


class Agent:
    """Drives as the generators of the process say, prints, and does worse."""

    def __init__(self, what: str = "", speed: float = 9.0):
        self.what, self.speed = what, speed

    def reset(self, seed):
        self.step = 0

    def act(self, observation):
        self.step += 1
        if self.step == 5:
            print("here")
            if self.what == "thread":
                threading.Thread(target=threading.Event().wait, daemon=True).start()
            if self.what == "raises":
                raise ValueError("enough")
            if self.what == "program":
                os.spawnlp(os.P_NOWAIT, "sleep", "sleep", "60")
            if self.what == "segfaults":
                os.kill(os.getpid(), 11)
            if self.what == "exits":
                os._exit(7)
        return self.speed + random.random() + np.random.random(), 0  # noqa: NPY002


class Draws(ToySimulator):
    """Draws from the generators of the process while it is reset, as environments of others do, and takes its time."""

    def reset(self, **asked):
        random.random()
        np.random.random()  # noqa: NPY002
        self.setup_steps = 40
        time.sleep(0.03)
        return super().reset(**asked)
