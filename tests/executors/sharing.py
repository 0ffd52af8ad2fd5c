"""Run by test_warm_copies.py in a process of one thread: trials with and without a shared warm-up. Prints JSON."""

from __future__ import annotations

import itertools
import json
import os
import random
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np

from crashhunt.base import forks
from crashhunt.episode import WorkerSettings, scratch_of
from crashhunt.executors._remains import died
from crashhunt.executors._warm import WarmCopies
from crashhunt.executors._worker import Worker
from crashhunt.recording import Recording, read_black_box
from crashhunt.scenario import AgentSetup, Scenario, argument_values, load_scenario
from crashhunt.simulators.toy import ToySimulator
from crashhunt.trial import Outcome, TrialSpec

NOTES = []
HERE = os.getpid()


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
    """Draws from the generators of the process while it is reset, as environments of others do."""

    def reset(self, **asked):
        random.random()
        np.random.random()  # noqa: NPY002
        self.setup_steps = 40
        return super().reset(**asked)


def spec(number, seed, what="", speed=9.0, **arguments):
    return TrialSpec(number, seed, {"ego": {"what": what, "speed": speed}}, arguments, 30)


def settings(stage, scenario, **more):
    (stage / "code").mkdir(exist_ok=True)
    if scenario == "toy":
        made = Scenario(simulator="sharing:Draws", agents={"ego": AgentSetup(agent="sharing:Agent")})
    else:
        made = load_scenario(scenario).with_agents({"ego": "sharing:Agent"})
    return WorkerSettings(scenario=made, oracles=("overlap",), crash_on=(Outcome.AGENT_ERROR,), scratch=stage, **more)


def told(result):
    return {**replace(result, worker=0, wall_s=0.0, setup_s=0.0).to_json(), "shared": result.worker != HERE}


def worker_of(stage, scenario, most):
    worker = Worker(settings(stage, scenario), warm_copies=most)
    if most:
        worker._warm = WarmCopies(most, NOTES.append, worth_s=0.0)
    return worker


def same(stage, scenario="toy"):
    """The same trials, with their warm-up shared and not."""
    specs = [
        spec(0, 1), spec(1, 2), spec(2, 1, speed=8.0), spec(3, 2, "thread"), spec(4, 1, "program"),
        spec(5, 2, "raises"), spec(6, 1), spec(7, 1),
    ]  # fmt: skip
    if scenario == "toy":
        specs[7] = replace(specs[7], scenario_arguments={"gap_m": 40.0})
    else:
        values = argument_values(load_scenario(scenario))
        specs = [replace(one, scenario_arguments=values) for one in specs]
    found = {}
    for most in (4, 0):
        place = stage / str(most)
        place.mkdir()
        worker = worker_of(place, scenario, most)
        found[most] = [told(worker.run(one)) for one in specs]
        if most:
            folder = scratch_of(place, 5)
            found["log"] = (folder / "run.log").read_text()
            found["kept"] = Recording(read_black_box(folder / "blackbox.bin")).digest
            found["asleep"] = len(worker._warm.processes)
            found["change"] = worker.change
    return {**found, "notes": NOTES}


def turns(stage):
    """Which of many trials share, where they take turns in more traffics than there are copies."""
    worker = worker_of(stage, "toy", 2)
    return {"shared": [told(worker.run(spec(number, number % 3)))["shared"] for number in range(9)]}


def deaths(stage):
    """How a worker ends whose trial dies, in a copy or not, and what it has written by then."""
    found = {}
    for what, most in itertools.product(("segfaults", "exits"), (2, 0)):
        place = stage / f"{what}-{most}"
        place.mkdir()
        pid = os.fork()
        if pid == 0:
            worker = worker_of(place, "toy", most)
            worker.run(spec(0, 1))
            worker.run(spec(1, 1, what))
            os._exit(0)
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        result = died(spec(1, 1), place, code)
        stack = (scratch_of(place, 1) / "stack.txt").read_text()
        found[place.name] = [code, result.steps, result.setup_steps, stack.count("Fatal Python error")]
    return found


def lost(stage):
    """Trials whose sleeping copies have been killed, or cannot be copied."""
    worker = worker_of(stage, "toy", 2)
    found = [told(worker.run(spec(0, 1)))]
    for pid in worker._warm.processes:
        os.kill(pid, 9)
        os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)
    found.append(told(worker.run(spec(1, 1))))
    found.append(told(worker.run(spec(2, 1))))

    def refuse():
        raise forks.CannotForkError("no process could be started: too many")

    forks._fork = refuse
    found.append(told(worker.run(spec(3, 2))))
    return {"found": [(one["outcome"], one["shared"]) for one in found], "notes": NOTES}


if __name__ == "__main__":
    out = os.dup(1)
    what, place = sys.argv[1], Path(sys.argv[2])
    found = {"turns": turns, "deaths": deaths, "lost": lost}.get(what, lambda stage: same(stage, what))(place)
    os.write(out, json.dumps(found).encode())
    os._exit(0)
