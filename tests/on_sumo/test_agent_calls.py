"""Tests of agents that call libsumo: reading is allowed, and a call that changes something is the agent's error."""

from __future__ import annotations

from contextlib import suppress

import libsumo
import numpy as np
import pytest

from crashhunt.episode import Episode, overruled_agent
from crashhunt.oracles import OffRoad
from crashhunt.scenario import argument_values, load_scenario
from crashhunt.sumo import Fleet, SumoSimulator
from crashhunt.sumo._agent_calls import commanded_elsewhere, refused_calls
from crashhunt.trial import Outcome, Overruled, TrialSpec


class Calls:
    """Calls a function in its third step."""

    def __init__(self, call, place="act"):
        self.call, self.place, self.step = call, place, 0

    def reset(self, seed):
        if self.place == "reset":
            self.call()

    def act(self, observation):
        self.step += 1
        if self.step == 3 and self.place == "act":
            self.call()
        return 15.0, 0


@pytest.fixture(scope="module")
def simulator(tmp_path_factory):
    made = SumoSimulator(load_scenario("loop"), tmp_path_factory.mktemp("stage"))
    yield made
    made.close()


def driven(simulator, call, place="act", steps=6, oracles=(), overruled=None):
    values = {**argument_values(load_scenario("loop")), "vehicles": 12}
    spec = TrialSpec(number=0, seed=1, arguments={}, scenario_arguments=values, max_steps=steps)

    def make_agent(*_):  # once there is a network
        agent = Calls(call, place)
        return agent if overruled is None else overruled_agent(agent, simulator, overruled)

    with Episode(spec, simulator=simulator, make_agent=make_agent, oracles=oracles) as episode:
        result = episode.start()
        while result is None:
            result = episode.step()
    return result


def other():
    return next(name for name in libsumo.vehicle.getIDList() if name != "ego")


@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("vehicle.setSpeed", lambda: libsumo.vehicle.setSpeed(other(), 0.0)),
        ("vehicle.changeLane", lambda: libsumo.vehicle.changeLane("ego", 1, 1.0)),
        ("vehicle.moveToXY", lambda: libsumo.vehicle.moveToXY("ego", "", -1, 0.0, 0.0)),
        ("vehicle.remove", lambda: libsumo.vehicle.remove(other())),
        ("simulationStep", lambda: libsumo.simulationStep()),
        ("simulation.load", lambda: libsumo.load(["-n", "none"])),
        ("close", lambda: libsumo.close()),
    ],
)  # fmt: skip
def test_call_that_changes_the_simulation_is_an_error_of_the_agent_and_has_no_effect(simulator, name, call):
    result = driven(simulator, call)
    assert (result.outcome, result.steps) == (Outcome.AGENT_ERROR, 2)
    assert f"the agent called libsumo's {name}, which changes the simulation" in str(result.failure)
    assert libsumo.isLoaded()
    assert driven(simulator, lambda: None).outcome is Outcome.SURVIVED


def test_agent_that_changes_the_simulation_in_reset_makes_the_trial_invalid(simulator):
    result = driven(simulator, lambda: libsumo.vehicle.setSpeed(other(), 0.0), "reset")
    assert result.outcome is Outcome.INVALID
    assert "vehicle.setSpeed" in str(result.failure)


@pytest.mark.parametrize(
    "way", [{"manoeuvre": "brake"}, {"keeps": "lane"}, {"reference": "both"}, {"reference": "fsm"}]
)
def test_agent_that_is_overruled_cannot_change_the_simulation_either(simulator, way):
    result = driven(simulator, lambda: libsumo.vehicle.setSpeed(other(), 0.0), overruled=Overruled("ego", 4, **way))
    assert (result.outcome, result.steps) == (Outcome.AGENT_ERROR, 2)
    assert "the agent called libsumo's vehicle.setSpeed" in str(result.failure)


def test_reading_is_allowed_and_changes_nothing(simulator):
    def read():
        libsumo.vehicle.subscribe("ego")
        assert libsumo.vehicle.getSpeed(other()) >= 0.0
        assert libsumo.simulation.convertRoad(0.0, -64.8)[0]
        assert libsumo.vehicle.getNextTLS("ego") == ()

    ended = []
    for call in (read, lambda: None):
        assert driven(simulator, call).outcome is Outcome.SURVIVED
        ended.append([libsumo.vehicle.getPosition(name) for name in libsumo.vehicle.getIDList()])
    assert ended[0] == ended[1]


def test_call_of_an_agent_that_hides_the_error_ends_the_trial_and_has_changed_nothing(simulator):
    speeds = []

    def swallow():
        speeds.append(libsumo.vehicle.getSpeed(other()))
        for call in (lambda: libsumo.vehicle.setSpeed(other(), 0.0), libsumo.simulationStep):
            with suppress(Exception):
                call()
        speeds.append(libsumo.vehicle.getSpeed(other()))

    result = driven(simulator, swallow)
    assert (result.outcome, result.steps, result.failure.agent) == (Outcome.AGENT_ERROR, 2, "ego")
    assert "the agent called libsumo's vehicle.setSpeed, which changes the simulation" in str(result.failure)
    assert speeds[0] == speeds[1]
    assert driven(simulator, lambda: None).outcome is Outcome.SURVIVED


def test_refused_call_is_no_error_of_a_simulation_that_begins_later(simulator):
    driven(simulator, libsumo.simulationStep)
    assert refused_calls
    with Fleet(np.array([20.0]), length_m=5.0, step_s=0.1) as fleet:
        assert fleet.drive(np.zeros(1)) == pytest.approx([2.0])


def test_oracle_of_a_user_and_a_program_may_command_sumo(simulator):
    class Commands(OffRoad):
        def check(self, scene, agents):
            libsumo.vehicle.setSpeed(other(), 3.0)
            return []

    assert driven(simulator, lambda: None, oracles=[Commands()]).outcome is Outcome.SURVIVED
    name = other()
    for call, commanded in (
        (lambda: libsumo.vehicle.setSpeed(name, -1.0), False),
        (lambda: libsumo.vehicle.setAcceleration(name, -3.0, 1.0), True),  # it brakes
        (lambda: libsumo.vehicle.setSpeed(vehID=name, speed=-1.0), False),
        (lambda: libsumo.vehicle.slowDown(name, 1.0, 1.0), True),
    ):
        call()
        assert (name in commanded_elsewhere) == commanded
