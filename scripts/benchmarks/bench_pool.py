"""Trials on plain highway-env with ``multiprocessing.Pool``, and the same trials as a scenario of a hunt.

highway-fast-v0 as it is registered, with its own observation. The agent answers SLOWER, with which it rarely crashes:
most trials have all their steps.
"""

from __future__ import annotations

import gc
import importlib
import json
import os
import sys
import time
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from multiprocessing.pool import Pool

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


def forked_trial_s(trials: int, steps: int) -> float:
    """Return the CPU time of a trial with the accelerator, each in a fork that ends with it, without crashhunt, in s.

    The forked process has constructed the environment, as that of a hunt.
    """
    import gymnasium

    importlib.import_module("crashhunt.highway")  # imports highway-env without matplotlib, as a hunt does
    from crashhunt.highway.accelerator import switch_on

    reason = switch_on()
    if reason:
        raise RuntimeError(reason)
    env = gymnasium.make("highway-fast-v0", config={"duration": DURATION_S}, disable_env_checker=True).unwrapped
    gc.collect()
    gc.freeze()
    before = sum(os.times()[:4])
    for seed in range(trials):
        pid = os.fork()
        if pid == 0:
            env.reset(seed=seed)
            for _ in range(steps):
                _, _, terminated, truncated, _ = env.step(SLOWER)
                if terminated or truncated:
                    break
            os._exit(0)
        os.waitpid(pid, 0)
    return (sum(os.times()[:4]) - before) / trials


def main() -> None:
    """Print the wall time of trials in a pool as JSON, or the CPU time of forked trials.

    The first trials of the pool, one a process, are not counted.
    """
    what, *numbers = sys.argv[1:]
    if what == "forks":
        print(json.dumps({"cpu_s": forked_trial_s(*map(int, numbers))}))
        return
    processes, trials, steps = map(int, numbers)
    with get_context("fork").Pool(processes) as pool:
        run = partial(trial, steps=steps)
        pool.map(run, range(processes), chunksize=1)
        began, before = time.monotonic(), _cpu_s(pool)
        pool.map(run, range(trials), chunksize=1)
        rate = 60 * trials / (time.monotonic() - began)
        print(json.dumps({"per_minute": rate, "cpu_s": (_cpu_s(pool) - before) / trials}))


def _cpu_s(pool: Pool) -> float:
    """Return the CPU time of all processes of a pool, in s."""
    pids = [process.pid for process in pool._pool]  # type: ignore[attr-defined]
    fields = [Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split() for pid in pids]
    return sum(int(one[11]) + int(one[12]) for one in fields) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()
