"""Branches of episodes, and what becomes of them, for test_branching.py in a process that has one thread."""

from __future__ import annotations

import os
import time
from dataclasses import replace

from crashhunt.agents import KeepLaneWithSpeed
from crashhunt.base.plugins import locate
from crashhunt.base.processes import children_of
from crashhunt.disturbances import disturber_of, parse_rates
from crashhunt.episode import Brancher, run_episode
from crashhunt.oracles import Overlap, ReportedCollision
from crashhunt.recording import BlackBox
from crashhunt.scenario import AgentSetup, Scenario, argument_values, load_scenario
from crashhunt.trial import CRASHES, TrialSpec

RATES = ("brake=0.05", "late_observation=0.05", "stop=0.05")


class Place:
    """Runs trials."""

    def __init__(self, name, stage, speed, seed, steps):
        self.speed, self.seed, self.steps = speed, seed, steps
        scenario = Scenario(simulator="toy", agents={"ego": AgentSetup()}) if name == "toy" else load_scenario(name)
        self.simulator = locate("simulators", scenario.simulator)(scenario, stage)
        self.given = argument_values(scenario) if scenario.arguments else {"gap_m": 12.0}
        self.box = BlackBox(stage / "blackbox.bin")

    def run(self, asking=None, agent=None, steps=None, **more):
        self.box.begin(pid=os.getpid(), trial=0, started=0.0)
        spec = TrialSpec(0, self.seed, {}, self.given, steps or self.steps, **more)
        return run_episode(
            spec, simulator=self.simulator, make_agent=lambda *_: agent or KeepLaneWithSpeed(self.speed), box=self.box,
            oracles=[ReportedCollision(), Overlap()], asking=[asking] if asking else [],
        )  # fmt: skip


def branches(name, stage, speed, seed, steps):
    """What branches come to, and whether the trial is as it was and crashes as they did, from the start."""
    place, waited = Place(name, stage, speed, seed, steps), []
    brancher = Brancher(RATES, CRASHES, waited.append)
    plain, asked = place.run(), place.run(brancher)
    crashes = asked.branches.crashes if asked.branches else ()
    draws = disturber_of(parse_rates(RATES), agents=("ego",), step_length_s=place.simulator.step_length_s)
    starts = [place.run(disturbances=one.disturbances) for one in crashes]
    found = {
        "outcomes": [str(one.outcome) for one in (plain, asked)],
        "same": plain.digest == asked.digest,
        "branches": asked.branches.to_json(),
        "starts": [[str(one.outcome), one.steps, draws.log_likelihood_of(one)] for one in starts],
        "waited": min(waited) > 0,
        "left": len(children_of(os.getpid())),
        "why_not": brancher.fork_runner.why_not,
    }
    if name == "toy":
        again, itself = place.run(brancher), place.run(brancher, KeepLaneWithSpeed(20.0))
        found["again"] = again.branches == asked.branches and replace(again, wall_s=0.0, setup_s=0.0) == replace(
            asked, wall_s=0.0, setup_s=0.0
        )
        found["itself"] = [str(itself.outcome), itself.branches.to_json()]
        found["never"] = place.run(brancher, steps=5).branches
        place.given = {"gap_m": 400.0}
        found["alone"] = place.run(brancher, KeepLaneWithSpeed(5.0), steps=40).branches.to_json()
    return found


class Sleeps(KeepLaneWithSpeed):
    """Hangs as soon as it drives in a process that is not the first."""

    def __init__(self, how):
        super().__init__(9.5)
        self.pid, self.how = os.getpid(), how

    def act(self, observation):
        if os.getpid() != self.pid:
            self.how()
        return super().act(observation)


def ends(stage):
    """What becomes of branches that hang, die or raise what no agent should, and of the copies that are asleep."""
    import crashhunt.episode._branches as module
    import crashhunt.episode._forks as forks

    place, found = Place("toy", stage, 9.5, 2, 120), {}
    forks._PAUSES_S = (0.0, 0.0)
    for name, how in {"hangs": lambda: time.sleep(600), "dies": lambda: os.kill(os.getpid(), 9)}.items():
        module._PATIENCE_S = 0.3 if name == "hangs" else 60.0
        brancher = Brancher(RATES, CRASHES, lambda _: None)
        result = place.run(brancher, Sleeps(how))
        found[name] = [
            str(result.outcome), brancher.fork_runner.why_not, len(children_of(os.getpid())), result.branches.to_json()
        ]  # fmt: skip
    module.free_memory, told = lambda: 0.2, []
    result = place.run(Brancher(RATES, CRASHES, lambda _: None, told.append), steps=40)
    found["full"] = [str(result.outcome), result.branches.to_json(), told[0]]
    module.free_memory = lambda: 1.0
    brancher = Brancher(RATES, CRASHES, lambda _: None)
    brancher.close = lambda: None  # as if it were killed now
    place.run(brancher, steps=40)
    found["left"] = [sleeper.copy.pid for sleeper in brancher._asleep]
    return found


ANSWERS = {
    "ends": ends,
    "toy": lambda stage: branches("toy", stage, 9.5, 2, 120),
    "loop": lambda stage: branches("loop", stage, 15.0, 7, 150),
}
