"""What an agent omitted on highway-env: bugs planted in agents, and crashes that no driver could have avoided."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("crashhunt.highway._fast_import", exc_type=ImportError)  # without pandas and matplotlib
from highway_env.vehicle.kinematics import Vehicle

from crashhunt.analysis import _causes, _omissions
from crashhunt.episode import overruled_agent, run_episode
from crashhunt.highway import HighwaySimulator
from crashhunt.highway._descriptor import HighwaySetup
from crashhunt.oracles import OffRoad, ReportedCollision
from crashhunt.recording import BlackBox, Recording, read_black_box
from crashhunt.report._judgement_words import about_reference
from crashhunt.scenario import AgentSetup, ObservationSetup, Scenario
from crashhunt.trial import Outcome, Overruled, TrialSpec
from crashhunt.trial_reruns import EndedRun
from crashhunt.world import Motion

CONFIG = {"simulation_frequency": 15, "policy_frequency": 5, "vehicles_count": 1, "lanes_count": 3, "duration": 999}
STEERED = {"action": {"type": "ContinuousAction"}}
LEFT, IDLE, SLOWER = 0, 1, 4
STEPS = 60


class Placed(HighwaySimulator):
    """A straight road with the agent in the middle lane, and one vehicle that drives straight on at a constant speed.

    Args:
        speed: of the agent, in m/s.
        other: lane of the other vehicle from the left, its distance ahead in m, and its speed in m/s.
        more: further configuration of highway-env.
    """

    def __init__(self, speed, other, more):
        self.speed, self.other = speed, other
        tables = {"highway": HighwaySetup(id="highway-fast-v0", config=CONFIG | more)}
        agents, observation = {"ego": AgentSetup()}, ObservationSetup(vehicles=3)
        super().__init__(
            Scenario(simulator="highway", agents=agents, tables=tables, observation=observation), stage=None
        )

    def _adopt(self, env):
        super()._adopt(env)
        ego, (lane, ahead_m, speed) = env.vehicle, self.other
        ego.position[:] = (100.0, 4.0)
        ego.lane_index = ego.target_lane_index = ("0", "1", 1)
        ego.lane = env.road.network.get_lane(ego.lane_index)
        ego.heading, ego.speed, ego.target_speed = 0.0, self.speed, self.speed
        if hasattr(ego, "speed_index"):
            ego.speed_index = ego.speed_to_index(self.speed)
        env.road.vehicles[:] = [ego, Vehicle(env.road, [100.0 + ahead_m, 4.0 * lane], 0.0, speed)]


class BrakesLate:
    """Brakes for the vehicle ahead only when it is very near."""

    def reset(self, seed):
        pass

    def act(self, observation):
        near = [row for row in observation[1:] if row[0] and 0 < row[1] < 8.0 and abs(row[2]) < 2.0]
        return SLOWER if near else IDLE


class IgnoresTheTargetLane(BrakesLate):
    """Changes to the left after a second, whatever is there."""

    def reset(self, seed):
        self.step = 0

    def act(self, observation):
        self.step += 1
        return LEFT if self.step == 6 else super().act(observation)


class SteersLate(BrakesLate):
    """Drives straight on by continuous actions, and brakes for the vehicle ahead only when it is very near."""

    def act(self, observation):
        return np.array([-1.0 if super().act(observation) == SLOWER else 0.0, 0.0], np.float32)


class Steers(BrakesLate):
    """Steers to one side after a second, whatever is there, and later drives parallel to the road again."""

    side, again = -1.0, 9

    def reset(self, seed):
        self.step = 0

    def act(self, observation):
        self.step += 1
        turn = (6 <= self.step < 8) - (self.again <= self.step < self.again + 2)
        return np.array([0.0, self.side * 0.08 * turn], np.float32)


class SteersOffTheRoad(Steers):
    """Steers to the right until it leaves the road."""

    side, again = 1.0, STEPS


@pytest.fixture
def find(tmp_path, monkeypatch):
    """Run a trial and, if it is a crash, find the omission; return the crash and what was found."""
    monkeypatch.setattr(_causes, "read_lanes", lambda _: [])  # they only add what else a run changes

    def look(driver, speed, other, **more):
        simulator = Placed(speed, other, more)

        def run(place, spec):
            made = []

            def make(agent, simulator, arguments):
                made.append(overruled_agent(driver(), simulator, spec.overruled) if spec.overruled else driver())
                return made[0]

            path = tmp_path / f"{place}"
            path.unlink(missing_ok=True)
            box = BlackBox(path)
            box.begin(pid=0, trial=0, started=0.0)
            result = run_episode(
                spec, simulator=simulator, make_agent=make, box=box, oracles=(ReportedCollision(), OffRoad())
            )
            box.close()
            responses = tuple(getattr(made[0], "responses", ()))
            return EndedRun(place, result, Recording(read_black_box(path)), tmp_path, responses=responses)

        class InProcess:
            def run(self, specs):
                return [run(place, spec) for place, spec in enumerate(specs)]

        try:
            crash = run(-1, TrialSpec(0, 1, {"ego": {}}, {}, STEPS))
            assert crash.result.outcome in (Outcome.COLLISION, Outcome.OFF_ROAD)
            bundle = SimpleNamespace(result=crash.result, driver="ego", path=tmp_path)
            rerun = SimpleNamespace(bundle=bundle, recorded=crash.recording, spec=crash.result.spec)
            return crash.result, _omissions._Search(rerun, InProcess(), 20, lambda: None).find("differs")
        finally:
            simulator.close()

    return look


def headline(reference):
    return about_reference(reference, lambda step: f"step {step}", "ego")[0].strip()


def test_headline_names_the_vehicle_for_which_an_agent_braked_late(find):
    crash, found = find(BrakesLate, 30.0, (1, 70.0, 21.0))
    omission = found.omission
    assert (omission.faculty, omission.kind, omission.actor) == ("longitudinal", "vehicle", "vehicle.1")
    assert omission.step < crash.steps - 10  # not the last possible rescue
    assert [run.ending for run in found.deciding] == ["none"] * len(found.deciding)
    assert headline(found).startswith("Cause: ego braked too little for vehicle.1 (65.0 m ahead, 30.0 m/s where")


def test_headline_names_the_vehicle_ahead_in_the_target_lane(find):
    _, found = find(IgnoresTheTargetLane, 25.0, (0, 20.0, 15.0))
    omission = found.omission
    assert (omission.faculty, omission.actor, omission.step) == ("lateral", "vehicle.1", 5)
    assert headline(found).startswith(
        "Cause: ego changed to the left lane although vehicle.1 was 5.0 m ahead (15.0 m/s"
    )


@pytest.mark.parametrize(
    ("speed", "other"),
    [
        (25.0, (1, 12.0, 5.0)),  # a slow vehicle that is too near from the start
        (20.0, (1, -40.0, 32.0)),  # a vehicle that does not brake comes from behind
    ],
)
@pytest.mark.parametrize(("driver", "more"), [(BrakesLate, {}), (SteersLate, STEERED)])
def test_crash_that_no_driver_could_avoid_has_no_omission(find, speed, other, driver, more):
    crash, found = find(driver, speed, other, **more)
    assert (found.omission, found.why_not) == (None, "")
    assert crash.collision.other == "vehicle.1"


def test_late_braking_with_continuous_actions_is_an_omission(find):
    crash, found = find(SteersLate, 30.0, (1, 70.0, 21.0), **STEERED)
    omission = found.omission
    assert (omission.faculty, omission.kind, omission.actor) == ("longitudinal", "vehicle", "vehicle.1")
    assert omission.step < crash.steps - 10
    assert [run.ending for run in found.deciding] == ["none"] * len(found.deciding)


def test_steering_into_the_next_lane_is_an_omission(find):
    crash, found = find(Steers, 25.0, (0, 20.0, 15.0), **STEERED)
    omission = found.omission
    assert (omission.faculty, omission.actor) == ("lateral", "vehicle.1")
    assert omission.kind.endswith("left")
    assert 5 <= omission.step <= crash.steps


def test_steering_off_the_road_is_an_omission(find):
    crash, found = find(SteersOffTheRoad, 25.0, (0, 90.0, 25.0), **STEERED)
    assert crash.outcome is Outcome.OFF_ROAD
    assert (found.omission.faculty, found.omission.kind) == ("lateral", "no lane right")


def drive(driver, other, faculty):
    """Let a reference driver drive from the start; return it, and whether the vehicle stayed on the road."""
    simulator = Placed(25.0, other, STEERED)
    try:
        shown, _ = simulator.reset(seed=1)
        made = overruled_agent(driver, simulator, Overruled("ego", 0, reference=faculty))
        made.reset(1)
        for _ in range(STEPS):
            action = simulator.actions["ego"].encode(made.act(shown["ego"]))
            shown, *_ = simulator.step({"ego": action})
            if simulator.scene().off_road:
                return made, False
        return made, True
    finally:
        simulator.close()


def test_steering_into_a_safe_gap_is_not_corrected():
    made, stays = drive(Steers(), (2, 80.0, 25.0), "both")
    assert (made.responses, stays) == ([], True)


class Swerves(BrakesLate):
    """Steers to random sides."""

    def reset(self, seed):
        self.draw = np.random.default_rng(seed)

    def act(self, observation):
        return np.array([0.0, self.draw.normal(0.0, 0.1)], np.float32)


@pytest.mark.parametrize(("faculty", "stays"), [("none", False), ("lateral", True)])
def test_reference_driver_keeps_a_swerving_vehicle_on_the_road(faculty, stays):
    assert drive(Swerves(), (1, 300.0, 25.0), faculty)[1] is stays


def test_corrected_actions_reach_the_speed_and_the_middle_of_the_lane():
    simulator, nothing = Placed(25.0, (0, 300.0, 25.0), STEERED), np.zeros(2, np.float32)
    try:
        simulator.reset(seed=1)
        vehicle = simulator._controlled["ego"]
        vehicle.position[1] += 0.8
        for speed in (24.5, 24.0, 25.0, 24.9):
            action = simulator.action_with("ego", nothing, speed_mps=speed, keeps_lane=True)
            assert simulator.motion_of("ego", action) == Motion(speed_mps=pytest.approx(speed), lane_change=0)
            simulator.step({"ego": action})
            assert vehicle.speed == pytest.approx(speed)
        for _ in range(10):
            simulator.step({"ego": simulator.action_with("ego", nothing, speed_mps=None, keeps_lane=True)})
        assert abs(vehicle.lane.local_coordinates(vehicle.position)[1]) < 0.1
    finally:
        simulator.close()
