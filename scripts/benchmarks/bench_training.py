"""Environment steps per second in training, as ratios within one run; for ``scripts/bench training``.

Needs Stable-Baselines3 for PPO on highway-env, and sumo-rl for SUMO: what is not installed is omitted.
"""

from __future__ import annotations

import importlib.util
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

_SCENARIO = """
schema = 1
simulator = "sumo"
step_length_s = 1.0
warmup_s = 100.0
[sumo]
net = "single-intersection.net.xml"
routes = ["single-intersection-vhvh.rou.xml"]
[agents.ego]
agent = "keep-lane"
route = "{route}"
"""
_KEEP_LANE = (8.0, 0)  # target speed in m/s, and no lane change
_CRASHES = ("--scenario", "highway", "--seed", "1", "--keep-going", "--arg", "headway_s=0.2:0.5")


def has(*modules: str) -> bool:
    """Return whether modules are installed."""
    return all(importlib.util.find_spec(module) is not None for module in modules)


def child_ppo(name: str, steps: str, rounds: str) -> dict[str, float]:
    """Environment steps/s of PPO on highway-env, gradient steps included, plain and accelerated in turns."""
    import gymnasium
    import highway_env
    from stable_baselines3 import PPO

    from crashhunt.highway.accelerator import switch_off, switch_on

    assert highway_env
    slow: list[float] = []
    fast: list[float] = []
    for number in range(int(rounds)):
        for rates, switch in ((slow, switch_off), (fast, switch_on)):
            reason = switch()
            assert not reason, reason
            env = gymnasium.make(name)
            model = PPO("MlpPolicy", env, n_steps=int(steps), batch_size=32, n_epochs=10, seed=number, device="cpu")
            began = time.perf_counter()
            model.learn(int(steps))
            rates.append(int(steps) / (time.perf_counter() - began))
            env.close()
    return _compared(slow, fast)


def child_crashes(rounds: str) -> dict[str, float]:
    """Steps/s of an environment with episodes that begin before crashes, against plain episodes; with their resets."""
    import crashhunt

    crashhunt_command = str(Path(sys.executable).parent / "crashhunt")
    with tempfile.TemporaryDirectory(prefix="crashhunt-bench-") as folder:
        hunt = f"{folder}/hunt"
        command = [crashhunt_command, "run", hunt, "2", "40", "60", *_CRASHES]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        plain: list[float] = []
        crashes: list[float] = []
        for number in range(int(rounds)):
            for rates, share in ((plain, 0.0), (crashes, 1.0)):
                env = crashhunt.make_training_env(hunt, share=share, test=0.0)
                env.reset(seed=number)
                steps, began = 0, time.perf_counter()
                while time.perf_counter() - began < 1.0:
                    _, _, terminated, truncated, _ = env.step(1)
                    steps += 1
                    if terminated or truncated:
                        env.reset()
                rates.append(steps / (time.perf_counter() - began))
                env.close()
    return _compared(plain, crashes)


def child_sumo_rl(steps: str) -> dict[str, float]:
    """Steps/s of sumo-rl on its own crossing, through libsumo: an observation and random lights per SUMO step."""
    import sumo

    os.environ |= {"SUMO_HOME": sumo.SUMO_HOME, "LIBSUMO_AS_TRACI": "1"}
    from sumo_rl import SumoEnvironment

    folder = _nets()
    env: Any = SumoEnvironment(
        net_file=str(folder / "single-intersection.net.xml"),
        route_file=str(folder / "single-intersection-vhvh.rou.xml"),
        single_agent=True, delta_time=1, yellow_time=0, min_green=1, sumo_seed=1, num_seconds=100_000,
        begin_time=100, sumo_warnings=False, add_system_info=False, add_per_agent_info=False,
    )  # fmt: skip
    env.action_space.seed(1)
    return _rate_of(env, int(steps), env.action_space.sample)


def child_sumo(steps: str) -> dict[str, float]:
    """Steps/s of ``crashhunt/SUMO-v0`` on the same crossing with the same traffic.

    The vehicle keeps its lane. With random actions it crashes after 3 steps, and SUMO's first steps are slow.
    """
    import shutil

    import gymnasium

    import crashhunt

    assert crashhunt
    with tempfile.TemporaryDirectory(prefix="crashhunt-bench-") as name:
        folder = Path(name)
        for file in ("single-intersection.net.xml", "single-intersection-vhvh.rou.xml"):
            shutil.copy(_nets() / file, folder / file)
        (folder / "scenario.toml").write_text(_SCENARIO.format(route="route_ns"))
        env = gymnasium.make("crashhunt/SUMO-v0", scenario=folder, disable_env_checker=True)
        found = _rate_of(env, int(steps), lambda: _KEEP_LANE)
        env.close()
    return found


def _rate_of(env: Any, steps: int, act: Callable[[], object]) -> dict[str, float]:
    """Return the steps per second of processor time of an environment, without the time of its resets."""
    env.reset(seed=1)
    spent = 0.0
    for _ in range(steps):
        action = act()
        began = time.thread_time()
        _, _, terminated, truncated, _ = env.step(action)
        spent += time.thread_time() - began
        if terminated or truncated:
            env.reset()
    return {"rate": steps / spent}


def _nets() -> Path:
    spec = importlib.util.find_spec("sumo_rl")
    assert spec is not None
    assert spec.origin is not None
    return Path(spec.origin).parent / "nets" / "2way-single-intersection"


def _compared(slow: list[float], fast: list[float]) -> dict[str, float]:
    ratios = sorted(two / one for one, two in zip(slow, fast, strict=True))
    return {
        "ratio": statistics.median(ratios), "low": ratios[0], "high": ratios[-1],
        "slow": statistics.median(slow), "fast": statistics.median(fast),
    }  # fmt: skip


if __name__ == "__main__":
    import json

    print(json.dumps(globals()[sys.argv[1]](*sys.argv[2:])))
