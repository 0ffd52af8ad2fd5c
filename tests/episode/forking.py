"""Copies of episodes, and what becomes of them, for test_fork.py in a process that has one thread."""

from __future__ import annotations

import mmap
import os
import random
import signal
import socket
import subprocess
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np
from gymnasium.spaces import Discrete

from crashhunt.agents import KeepLaneWithSpeed
from crashhunt.base.errors import CrashhuntError
from crashhunt.base.forks import ends as ends_of_copies
from crashhunt.base.plugins import locate
from crashhunt.base.processes import adopt_orphans, children_of
from crashhunt.episode import Episode, Nearness, Prober, Recorder, run_episode, seed_everything
from crashhunt.oracles import OffRoad, Overlap, ReportedCollision
from crashhunt.recording import BlackBox
from crashhunt.scenario import AgentSetup, Scenario, argument_values, load_scenario
from crashhunt.trial import CRASHES, Disturbance, TrialSpec

STEPS, FIRST, SECOND = 60, 20, 35


class Wanders:
    """Draws from the generators of the process, and from a file that it reads and one that it writes, as it goes."""

    def __init__(self, simulator):
        self.chooses = isinstance(simulator.actions["ego"].space, Discrete)

    def reset(self, seed):
        self.rng = np.random.default_rng(seed)
        self.read = Path(__file__).open("rb", buffering=0)  # noqa: SIM115 - for as long as it drives
        self.notes = TemporaryFile(buffering=0)  # noqa: SIM115

    def act(self, observation):
        self.notes.write(self.read.read(7))
        self.notes.seek(-3, os.SEEK_CUR)
        drawn = sum(self.notes.read(3)) / 1000 + random.random() + np.random.random() + self.rng.random()  # noqa: NPY002
        return int(5 * drawn) % 5 if self.chooses else (6.0 + drawn, 0)

    def close(self):
        self.read.close()
        self.notes.close()


@contextmanager
def begun(simulator, scenario, stage, agent=None, **more):
    box = BlackBox(stage / "blackbox.bin")
    box.begin(pid=os.getpid(), trial=0, started=time.monotonic())
    spec = TrialSpec(0, 5, {}, argument_values(scenario) if scenario.arguments else {}, STEPS, **more)
    seed_everything(spec.seed)
    episode = Episode(
        spec, simulator=simulator, make_agent=lambda name, made, _: agent or Wanders(made),
        oracles=[ReportedCollision(), Overlap(), OffRoad()], forks=True,
        observers=(Recorder(box, simulator), Nearness(box.take_frames)),
    )  # fmt: skip
    with episode:
        assert episode.start() is None
        yield episode, box
    box.close()


def to_end(episode):
    while episode.step() is None:
        pass
    return told(episode)


def told(episode):
    result = replace(episode.result, wall_s=0.0)
    return {"digest": result.digest, "steps": result.steps, "closest": result.closest.to_json(), "said": str(result)}


def same(name, stage):
    """The end of a trial, of its copy, and of a copy of that; and the trial again, after its copies."""
    scenario = Scenario(simulator="toy", agents={"ego": AgentSetup()}) if name == "toy" else load_scenario(name)
    simulator = locate("simulators", scenario.simulator)(scenario, stage)
    disturbed = Disturbance(25, "ahead", "brake", 4.0, 2.0, "ego")
    found = []
    for forks in (False, True):
        with begun(simulator, scenario, stage, disturbances=(disturbed,)) as (episode, box):
            for step in range(STEPS):
                if forks and step == FIRST:
                    before = bytes(box.committed())
                    first = episode.fork(lambda copy: once_more(copy))
                    answer = first.answer(60.0)
                    assert answer is not None, first.raised
                    found += answer["found"]
                    assert bytes(box.committed()) == before
                if episode.step() is not None:
                    break
            found.append(told(episode))
    return {"ends": found}


def once_more(copy):
    print("nobody is to see this")
    while copy.steps < SECOND:
        copy.step()
    copies = copy.fork(lambda again: to_end(again))
    second = copies.answer(60.0)
    assert second is not None, copies.raised
    return {"found": [second, to_end(copy)]}


def refused(stage):
    """What each of these has a process say that is to be copied."""
    scenario = Scenario(simulator="toy", agents={"ego": AgentSetup()})
    simulator = locate("simulators", "toy")(scenario, stage)
    found = {}

    def thread():
        event = threading.Event()
        thread = threading.Thread(target=event.wait)
        thread.start()
        return event.set, thread.join

    def process():
        running = subprocess.Popen(["sleep", "60"])
        return running.kill, running.wait

    cases = {
        "nothing": lambda: (),
        "thread": thread,
        "process": process,
        "socket": lambda: (one := socket.socket()) and (one.close,),
        "pipe": lambda: [(lambda end=end: os.close(end)) for end in os.pipe()],
        "memory": lambda: (mmap.mmap(-1, 4096).close,),
    }
    for name, make in cases.items():
        with begun(simulator, scenario, stage, agent=KeepLaneWithSpeed(10.0)) as (episode, _):
            kept = make()
            try:
                episode.fork(lambda copy: {}).answer(60.0)
                found[name] = ""
            except CrashhuntError as error:
                found[name] = str(error)
            for end in kept:
                end()
    return found


def ends(stage):
    """What becomes of copies that hang, die, or are left alone."""
    adopt_orphans()  # as workers do
    scenario = Scenario(simulator="toy", agents={"ego": AgentSetup()})
    simulator = locate("simulators", "toy")(scenario, stage)
    with begun(simulator, scenario, stage) as (episode, _):
        ways = {
            "hangs": lambda copy: time.sleep(600),
            "is killed": lambda copy: os.kill(os.getpid(), signal.SIGKILL),
            "segfaults": lambda copy: os.kill(os.getpid(), signal.SIGSEGV),
            "exits": lambda copy: os._exit(3),
            "divides": lambda copy: 1 / 0,
            "closes": lambda copy: (os.closerange(3, 100), time.sleep(600)),
            "forges": lambda copy: [os.write(end, b"[1]\n") for end in ends_of_copies],
        }
        copies = {name: episode.fork(how) for name, how in ways.items()}
        answers = {name: copy.answer(0.5 if name == "hangs" else 60.0) for name, copy in copies.items()}
        whys = {name: [copy.no_answer.why, copy.no_answer.is_from_outside] for name, copy in copies.items()}
        divides = copies["divides"]
        # What a copy has started that is killed goes with it, so that there can be another copy.
        for how in (lambda: os.kill(os.getpid(), signal.SIGKILL), lambda: time.sleep(600)):
            work = lambda _copy, how=how: (subprocess.Popen(["sleep", "600"]), how())  # noqa: E731
            assert episode.fork(work).answer(0.5) is None
            assert episode.fork(lambda copy: {}).answer(60.0) == {}
        sleeper = episode.suspend_fork(lambda copy, job: os.kill(os.getppid(), signal.SIGKILL) or time.sleep(600))
        assert sleeper.ask({}, 60.0) is None
        whys["sleeper"] = [sleeper.no_answer.why, sleeper.no_answer.is_from_outside, sleeper.is_usable]
        sleeper.end()
        assert episode.fork(lambda copy: {}).answer(60.0) == {}
        copies = [episode.fork(lambda copy: time.sleep(600)) for _ in range(2)]
        copies[0].end()
        copies[0].end()
    return {"answers": list(answers.values()), "whys": whys, "raised": divides.raised, "left": copies[1].pid}


def soak(stage, forks=2_000):
    """What so many copies leave behind in the process of which they are made."""
    scenario = load_scenario("loop")
    simulator = locate("simulators", "sumo")(scenario, stage)
    found = {}
    with begun(simulator, scenario, stage) as (episode, _):
        for number in range(forks):
            if number in (100, forks - 1):
                found[number] = {
                    "files": len([*Path("/proc/self/fd").iterdir()]),
                    "threads": len([*Path("/proc/self/task").iterdir()]),
                    "children": len(children_of(os.getpid())),
                    "resident_mib": int(Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE / 2**20,
                }
            answer = episode.fork(lambda copy: {"steps": copy.steps + (copy.step() is None)}, observed=False).answer(
                10.0
            )
            assert answer == {"steps": 1}
    return found


def probes(stage):
    """What copies of trials say, and whether the trials are as they were and crash as the copies did."""
    scenario = Scenario(simulator="toy", agents={"ego": AgentSetup()})
    simulator = locate("simulators", "toy")(scenario, stage)
    box = BlackBox(stage / "blackbox.bin")
    waited = []

    def run(make, prober=None, **more):
        box.begin(pid=os.getpid(), trial=0, started=0.0)
        spec = TrialSpec(0, 4, {}, {"gap_m": 12.0, **more.pop("arguments", {})}, more.pop("steps", 60), **more)
        oracles = [ReportedCollision(), Overlap()]
        return run_episode(
            spec, simulator=simulator, make_agent=make, box=box, oracles=oracles, asking=[prober] if prober else []
        )

    def starts_thread(*_):
        agent = KeepLaneWithSpeed(9.0)
        agent.thread = threading.Thread(target=threading.Event().wait, daemon=True)
        agent.thread.start()
        return agent

    def drives(*_):
        return KeepLaneWithSpeed(9.0)

    prober = Prober(1.0, CRASHES, waited.append)
    plain, asked, again = run(drives), run(drives, prober), run(drives, prober)
    stress = asked.stress
    milder = replace(stress.disturbance, how_strong=stress.disturbance.how_strong - 0.375)
    crashed = run(drives, disturbances=(stress.disturbance,))
    fine = run(drives, disturbances=(milder,), steps=milder.step + 50)
    late = Prober(100.0, CRASHES, waited.append)
    found = {
        "outcomes": [str(one.outcome) for one in (plain, asked, again, crashed, fine)],
        "same": plain.digest == asked.digest and asked.stress == again.stress and plain == replace(
            asked, stress=None, wall_s=plain.wall_s, setup_s=plain.setup_s
        ),
        "stress": stress.to_json(),
        "crashed": [str(crashed.outcome), crashed.steps],
        "waited": len(waited) > stress.probes + again.stress.probes and min(waited) > 0,
        "never": run(drives, late).stress,
        "by itself": run(lambda *_: KeepLaneWithSpeed(20.0), prober).stress.to_json(),
    }  # fmt: skip
    found["thread"] = run(starts_thread, prober).stress.to_json(), prober.fork_runner.why_not
    return found


ANSWERS = {"refused": refused, "ends": ends, "soak": soak, "probes": probes}
ANSWERS |= {name: partial(same, name) for name in ("toy", "loop", "highway")}
