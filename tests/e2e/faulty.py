"""Agents that go wrong at a certain step. Tests copy this file to where they work, as a user would have it."""

import ctypes
import math
import os
import sys
import time
from pathlib import Path


class Fine:
    def __init__(self, at: int = 20, speed: float = 8.0):
        self.at = at
        self.speed = speed

    def reset(self, seed):
        self.step = 0

    def act(self, observation):
        self.step += 1
        if self.step == self.at:
            print("about to go wrong")
            return self.go_wrong()
        return self.speed, 0

    def go_wrong(self):
        return self.speed, 0


class Raises(Fine):
    def go_wrong(self):
        raise ValueError("no plan")


class ExitsPython(Fine):
    def go_wrong(self):
        sys.exit(1)


class Exits3(Fine):
    def go_wrong(self):
        os._exit(3)


class Exits0(Fine):
    def go_wrong(self):
        os._exit(0)


class Segfaults(Fine):
    def go_wrong(self):
        ctypes.string_at(0)


class Hangs(Fine):
    def go_wrong(self):
        time.sleep(1000)


class HangsHoldingTheInterpreter(Fine):
    def go_wrong(self):
        ctypes.PyDLL(None).sleep(1000)


class Nan(Fine):
    def go_wrong(self):
        return math.nan, 0


class OutOfSpace(Fine):
    def go_wrong(self):
        return 10.0, 2


class ReturnsNone(Fine):
    def go_wrong(self):
        return None


class FailsToStart:
    def __init__(self):
        raise RuntimeError("no weights")


class DiesAtStart:
    def __init__(self):
        os._exit(7)


class HangsUnlessFirst(Fine):
    """In trial 0 it raises at step 150; in every other trial it hangs at once, holding the interpreter."""

    def __init__(self, at: int = 150, number: int = 0):
        super().__init__(at)
        self.number = number

    def act(self, observation):
        if self.number:
            ctypes.PyDLL(None).sleep(1000)
        return super().act(observation)

    def go_wrong(self):
        raise ValueError("no plan")


class Waits(Fine):
    """Stops before the step that the file ``wait-at`` names, and writes its process into the file ``waits``."""

    def act(self, observation):
        if Path("wait-at").exists() and Path("wait-at").read_text() == str(self.step):
            Path("waits.part").write_text(str(os.getpid()))
            Path("waits.part").rename("waits")
            time.sleep(1000)
        return super().act(observation)
