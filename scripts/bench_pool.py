"""Trials on plain highway-env with ``multiprocessing.Pool``, and the same trials as a scenario of a hunt.

highway-fast-v0 as it is registered, with its own observation. The agent answers SLOWER, with which it rarely crashes:
most trials have all their steps.
"""

from __future__ import annotations

import json
import sys
import time
from functools import partial
from multiprocessing import get_context
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["scenario"]

SLOWER = 4
DURATION_S = 1_000_000  # otherwise the environment ends an episode after 30 steps

_SCENARIO = f"""
title = "highway-fast-v0 as it is"
schema = 1
simulator = "highway"
[highway]
id = "highway-fast-v0"
config = {{ duration = {DURATION_S} }}
[agents.ego]
agent = "slower:Slower"
"""
_AGENT = f"""
class Slower:
    def reset(self, seed): ...
    def act(self, observation):
        return {SLOWER}
"""


def scenario(folder: Path) -> Path:
    """Write the scenario of a hunt with its agent into a folder; return its file."""
    (folder / "slower.py").write_text(_AGENT)
    (folder / "scenario.toml").write_text(_SCENARIO)
    return folder / "scenario.toml"


def trial(seed: int, steps: int) -> int:
    """Run a trial on plain highway-env; return its number of steps."""
    import gymnasium
    import highway_env

    assert highway_env
    env = gymnasium.make("highway-fast-v0", config={"duration": DURATION_S}, disable_env_checker=True).unwrapped
    env.reset(seed=seed)
    for step in range(1, steps + 1):
        _, _, terminated, truncated, _ = env.step(SLOWER)
        if terminated or truncated:
            return step
    return steps


def main() -> None:
    """Print the wall time of trials in a pool as JSON; the first ones, one a process, are not counted."""
    processes, trials, steps = map(int, sys.argv[1:])
    with get_context("fork").Pool(processes) as pool:
        run = partial(trial, steps=steps)
        pool.map(run, range(processes), chunksize=1)
        began = time.monotonic()
        pool.map(run, range(trials), chunksize=1)
        print(json.dumps({"per_minute": 60 * trials / (time.monotonic() - began)}))


if __name__ == "__main__":
    main()
