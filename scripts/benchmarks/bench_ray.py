"""What hunts on Ray cost, against hunts on one machine; for ``scripts/bench ray``."""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import resource
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator

    from crashhunt.episode import WorkerSettings
    from crashhunt.executors import Executor

CRASHHUNT = Path(sys.executable).parent / "crashhunt"
_TOY = """
schema = 1
simulator = "toy"
[agents.ego]
agent = "crashhunt.agents:KeepLaneWithSpeed"
[agents.ego.arguments.speed]
default = 1.0
range = "1:2"
"""
_BEATS = """
import os, pathlib, time


class Agent:
    def __init__(self, number: int = 0):
        self.number = number
        self.beat = pathlib.Path("BEATS", f"{number}-{os.getpid()}")

    def reset(self, seed): pass

    def act(self, observation):
        time.sleep(0.002)
        self.beat.touch()
        if self.number == 0 and len(list(self.beat.parent.iterdir())) >= SLOTS:
            pathlib.Path("BEATS.at").open("a").write(f"{time.time()}\\n")
            raise RuntimeError("on purpose")
        return 1.0, 0
"""

_SWING, _TRIALS = 4, 40
"""Trials before somebody is timed, and during that."""


@contextmanager
def cluster(*cpus: int, head: int = 0) -> Iterator[str]:
    """A cluster whose head and nodes have so many CPUs; yields its address."""
    from ray.cluster_utils import Cluster

    with tempfile.TemporaryDirectory(prefix="bench-", dir="/tmp") as short:  # Ray makes sockets there
        # Ray has its workers yield to all others; on an idle machine that changes nothing, on a busy one everything.
        variables = {"RAY_TMPDIR": short, "RAY_worker_niceness": "0"}
        os.environ |= variables
        Path(short, "ray").mkdir()
        first = {"num_cpus": head, "include_dashboard": False, "temp_dir": short}
        found = Cluster(initialize_head=True, head_node_args=first)
        try:
            for count in cpus:
                found.add_node(num_cpus=count)
            yield str(found.address)
        finally:
            found.shutdown()
            for name in variables:
                del os.environ[name]


def settings(folder: Path, name: str) -> WorkerSettings:
    """Those of trials on a scenario that comes with crashhunt, or on one of one's own."""
    from crashhunt.episode import WorkerSettings
    from crashhunt.scenario import load_scenario

    (folder / "scratch").mkdir(parents=True)
    oracles = ("reported-collision", "overlap", "off-road")
    scenario = load_scenario(name)
    agents = {agent: replace(setup, agent="keep-lane") for agent, setup in scenario.agents.items()}
    scenario = replace(scenario, agents=agents)
    return WorkerSettings(scenario=scenario, oracles=oracles, crash_on=(), scratch=folder / "scratch")


def run(
    executor: Executor, first: int, count: int, steps: int, speed: float, arguments: dict[str, Any] | None = None
) -> float:
    """Run trials that are to survive; return for how long.

    Raises:
        RuntimeError: one did not.
    """
    from crashhunt.trial import Outcome, TrialSpec

    began = time.perf_counter()
    submitted = done = 0
    while done < count:
        while submitted < count and submitted - done < 2 * executor.capacity:
            number = first + submitted
            executor.submit(
                TrialSpec(
                    number=number,
                    seed=number,
                    arguments={"ego": {"speed": speed}},
                    scenario_arguments=arguments or {},
                    max_steps=steps,
                )
            )
            submitted += 1
        for result in executor.completed(1.0):
            done += 1
            if result.outcome is not Outcome.SURVIVED:
                raise RuntimeError(f"trial {result.spec.number}: {result.outcome}: {result.failure}")
    return time.perf_counter() - began


def child_rate(address: str, rounds: str) -> dict[str, Any]:
    """What a pool of two workers does in a second, and for how much CPU, against Ray on the same cores.

    Pool, Ray, Ray, pool, and so on: what else the machine does burdens both alike. Both run the same trials, and are
    timed while their workers have something to do all the time. To Ray's CPU belong all processes of the cluster, of
    which a pool has none; the rate is that of a machine on which the cluster runs in any case.
    """
    from crashhunt.executors import PoolExecutor
    from crashhunt.executors.ray import RayExecutor
    from crashhunt.scenario import argument_values

    taken: dict[str, list[tuple[float, float]]] = {"pool": [], "ray": []}
    with tempfile.TemporaryDirectory() as name:
        here, there = settings(Path(name, "pool"), "loop"), settings(Path(name, "ray"), "loop")
        kinds: dict[str, Executor] = {
            "pool": PoolExecutor(here, parallel=2),
            "ray": RayExecutor(there, parallel=2, argument=address),
        }
        arguments = argument_values(here.scenario)
        try:
            for executor in kinds.values():
                run(executor, 0, 8, 100, 5.0, arguments)
            for turn in range(int(rounds)):
                for kind in sorted(kinds, reverse=bool(turn % 2)):
                    taken[kind].append(_in_full_swing(kinds[kind], kind, 1000 * (turn + 1), arguments))
        finally:
            for executor in kinds.values():
                executor.close()
    found: dict[str, Any] = {"load": os.getloadavg()[0]}
    for index, figure in enumerate(("wall", "cpu")):
        pairs = [(pool[index], ray[index]) for pool, ray in zip(taken["pool"], taken["ray"], strict=True)]
        ratios = [pool / ray for pool, ray in pairs]
        found[figure] = {
            "ratio": statistics.median(ratios), "interval": _interval_of_median(ratios),
            "pool": statistics.median(pool for pool, _ in pairs), "ray": statistics.median(ray for _, ray in pairs),
        }  # fmt: skip
    return found


def _in_full_swing(executor: Executor, kind: str, first: int, arguments: dict[str, Any]) -> tuple[float, float]:
    """Seconds, and seconds of CPU, that a trial takes while others run before and after it."""
    from crashhunt.trial import TrialSpec

    number = first
    began, spent, done = 0.0, 0.0, 0
    while done < _SWING + _TRIALS:
        while number - first - done < 2 * executor.capacity:
            executor.submit(
                TrialSpec(
                    number=number,
                    seed=number,
                    arguments={"ego": {"speed": 5.0}},
                    scenario_arguments=arguments,
                    max_steps=1000,
                )
            )
            number += 1
        for _ in executor.completed(1.0):
            done += 1
            if done == _SWING:
                began, spent = time.perf_counter(), _spent_by(kind)
            if done == _SWING + _TRIALS:
                found = (time.perf_counter() - began) / _TRIALS, (_spent_by(kind) - spent) / _TRIALS
    while done < number - first:
        done += sum(1 for _ in executor.completed(1.0))
    return found


def _spent_by(kind: str) -> float:
    """Seconds of CPU that this process and those of its executor have taken; to Ray belongs the cluster beside it."""
    bridge: list[int] = []
    others: list[int] = []
    for pid in _with_descendants(os.getpid())[1:]:
        with contextlib.suppress(OSError):
            is_bridge = b"crashhunt.executors.ray._bridge" in Path(f"/proc/{pid}/cmdline").read_bytes()
            (bridge if is_bridge else others).append(pid)
    if kind == "ray":
        whole = _with_descendants(os.getppid())
        others = [pid for pid in whole if pid not in (os.getppid(), os.getpid(), *bridge, *others)]
    return sum(map(_spent_of, [os.getpid(), *others, *(bridge if kind == "ray" else [])]))


def _interval_of_median(values: list[float]) -> tuple[float, float]:
    """Where the median of what was drawn from lies in 19 cases out of 20, whatever its distribution."""
    count = len(values)
    below, beyond = 0, 0.0
    while beyond + math.comb(count, below) / 2**count <= 0.025:
        beyond += math.comb(count, below) / 2**count
        below += 1
    lowest = max(0, below - 1)
    return sorted(values)[lowest], sorted(values)[count - 1 - lowest]


def child_wire(address: str) -> dict[str, float]:
    """Bytes over the connections of a node's actor: for each trial that costs nothing, and in a second without any."""
    from crashhunt.executors.ray import RayExecutor

    with tempfile.TemporaryDirectory() as name:
        (Path(name) / "toy").mkdir()
        (Path(name) / "toy" / "scenario.toml").write_text(_TOY)
        executor = RayExecutor(settings(Path(name), str(Path(name) / "toy")), parallel=2, argument=address)
        try:
            run(executor, 0, 50, 1, 1.0)
            found = [_over_the_wire()]
            began = time.monotonic()
            while time.monotonic() - began < 10:
                list(executor.completed(1.0))
            idle_s = time.monotonic() - began
            found.append(_over_the_wire())
            spent = _spent()
            busy_s = run(executor, 50, 3000, 1, 1.0)
            spent = _spent() - spent
            found.append(_over_the_wire())
        finally:
            executor.close()
    idle = (found[1] - found[0]) / idle_s
    return {"idle": idle, "trial": (found[2] - found[1] - idle * busy_s) / 3000, "ms": 1000 * spent / 3000}


def _spent() -> float:
    """Seconds of CPU that the bridge has taken, which is below this process; Ray's own threads are part of it."""
    return sum(map(_spent_of, _with_descendants(os.getpid())[1:]))


def _spent_of(pid: int) -> float:
    """Seconds of CPU that a process has taken, with those below it that have ended."""
    with contextlib.suppress(OSError):
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")
    return 0.0


def _over_the_wire() -> int:
    """The bytes that the actors of this machine have sent and received, as the kernel counts them."""
    said = subprocess.run(["ss", "-tinpH"], stdout=subprocess.PIPE, text=True, check=True).stdout
    total = 0
    for line in re.sub(r"\n\s+", " ", said).splitlines():
        if '("ray::Site' in line:
            total += sum(int(count) for count in re.findall(r"bytes_(?:sent|received):(\d+)", line))
    return total


def first_trial(*options: str) -> dict[str, float]:
    """Seconds from a command to the end of its first trial, and what the command takes in all."""
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        (place / "toy").mkdir()
        (place / "toy" / "scenario.toml").write_text(_TOY)
        words = ["run", "h", "2", "2", "1", "--scenario", "toy", "--keep-going", *options]
        before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.time()
        process = subprocess.Popen([CRASHHUNT, *words], cwd=place, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        most = 0
        while process.poll() is None:
            most = max(most, _memory(process.pid))
            time.sleep(0.2)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        with contextlib.closing(sqlite3.connect(place / "h" / "ledger.sqlite")) as ledger:
            (ended,) = ledger.execute("select min(ended_at) from trials").fetchone()
        cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        return {"first": float(ended) - began, "cpu": cpu, "mb": most / 1e6}


def _memory(pid: int) -> int:
    """What a process and all below it have in memory, in bytes; what several share is counted once."""
    total = 0
    for one in _with_descendants(pid):
        with contextlib.suppress(OSError):
            said = re.search(r"^Pss:\s+(\d+)", Path(f"/proc/{one}/smaps_rollup").read_text(), re.MULTILINE)
            total += 1024 * int(said.group(1)) if said else 0
    return total


def _with_descendants(pid: int) -> list[int]:
    """A process, and all below it."""
    children: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            children.setdefault(int(stat.read_text().rpartition(")")[2].split()[1]), []).append(int(stat.parent.name))
    found = [pid]
    for one in found:
        found += children.get(one, [])
    return found


def stopped(address: str, slots: str) -> dict[str, float]:
    """Seconds from a crash to the last step on any node, where so many trials run."""
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        (place / "beats").mkdir()
        (place / "beating.py").write_text(_BEATS.replace("BEATS", str(place / "beats")).replace("SLOTS", slots))
        (place / "toy").mkdir()
        toy = _TOY.replace("crashhunt.agents:KeepLaneWithSpeed", "beating:Agent").replace("speed", "number")
        (place / "toy" / "scenario.toml").write_text(toy.replace("1.0", "0").replace('"1:2"', '"0:39"'))
        words = ["run", "h", "0", "40", "100000", "--scenario", "toy", "--sampler", "grid", "--points", "40"]
        words += ["--arg", "number=0:39"]
        done = subprocess.run(
            [CRASHHUNT, *words, "--executor", f"ray:{address}"], cwd=place, stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE, check=False, timeout=180,
        )  # fmt: skip
        if done.returncode:
            raise RuntimeError(done.stderr.decode(errors="replace"))
        raised = float((place / "beats.at").read_text().split()[0])  # what follows is the crash's confirmation
        late = [beat.stat().st_mtime for beat in (place / "beats").iterdir() if not beat.name.startswith("0-")]
        return {"last": max(late) - raised, "running": len(late)}


def main() -> None:
    """Run one of the above in a process of its own."""
    print(json.dumps(globals()[sys.argv[1]](*sys.argv[2:])))


def in_child(function: str, *arguments: str) -> dict[str, Any]:
    """The same, for whoever wants what it returns."""
    done = subprocess.run([sys.executable, __file__, function, *arguments], check=True, stdout=subprocess.PIPE)
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


if __name__ == "__main__":
    main()
