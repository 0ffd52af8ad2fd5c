"""A model of a competent driver takes over from an agent in a risk: on a road of its own, computed by hand."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from onlookers import Steady

from crashhunt.agents import REFERENCE_MODELS
from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.episode import overruled_agent
from crashhunt.episode._reference_driver_takeover import _measured
from crashhunt.simulators import MetaAction, SpeedAndLaneChange
from crashhunt.trial import Overruled
from crashhunt.world import Actor, Crossing, Neighbor, Roster, Scene, Side, Surroundings

STEP_S, LENGTH_M = 0.1, 5.0


class StraightRoad:
    """Two cars on a straight road; the agent has the speed of its action, and the other car a constant speed."""

    step_length_s = STEP_S

    def __init__(self, *, gap, speed=20.0, other=10.0, beside=0.0, lateral=0.0):
        self.gap, self.speed, self.other, self.beside, self.lateral = gap, speed, other, beside, lateral
        self.actions = {"ego": SpeedAndLaneChange()}
        self.crossing = ()

    def scene(self):
        actors = tuple(Actor(name, "passenger", LENGTH_M, 2.0) for name in ("ego", "lead"))
        points = [(0.0, 0.0), (self.gap + LENGTH_M, self.beside)]
        return Scene(0.0, Roster(actors), points, [0.0, 0.0], [self.speed, self.other])

    def surroundings(self, agent):
        return Surroundings(speed_mps=self.speed, acceleration_mps2=3.0, braking_mps2=9.0, crossing=self.crossing)

    def drive(self, action):
        self.speed = action[0]
        self.gap -= (self.speed - self.other) * STEP_S
        self.beside = max(0.0, self.beside - self.lateral * STEP_S)


def taken_over(road, model, *, steps=120, after=0):
    made = overruled_agent(Steady(20.0), road, Overruled("ego", after, reference=model, other="lead"))
    made.reset(0)
    speeds = []
    for _ in range(steps):
        road.drive(made.act(None))
        speeds.append(road.speed)
        if road.gap <= 0 and road.beside < 2.0:
            break
    return speeds, made.responses


@pytest.mark.parametrize("model", REFERENCE_MODELS)
def test_model_avoids_a_cut_in_that_leaves_it_time(model):
    road = StraightRoad(gap=32.0, beside=3.5, lateral=1.5)
    speeds, (response,) = taken_over(road, model)
    assert road.gap > 0
    assert speeds[-1] <= 10.0
    assert 0 < response["least_gap_m"] <= response["gap_m"]
    assert (response["kind"], response["actor"], response["in_junction"]) == (model, "lead", False)


@pytest.mark.parametrize("model", REFERENCE_MODELS)
def test_model_does_not_avoid_a_cut_in_right_before_it(model):
    road = StraightRoad(gap=4.0, beside=3.5, lateral=3.0)
    taken_over(road, model)
    assert road.gap <= 0


def test_agent_drives_until_the_model_perceives_the_risk():
    road = StraightRoad(gap=50.0, beside=3.5, lateral=1.0)
    speeds, (response,) = taken_over(road, "cc_human")
    first = response["first"]
    assert speeds[:first] == [20.0] * first
    assert first == 15  # 1.5 m at 1 m/s: then the sides are in line
    assert speeds[first] == pytest.approx(20.0 - 0.04)
    assert speeds[first + 8] < speeds[first + 7] - 0.1  # the foot is on the brake after 0.75 s


def test_model_without_a_risk_changes_nothing_and_reports_nothing():
    road = StraightRoad(gap=100.0, beside=3.5)
    speeds, responses = taken_over(road, "fsm", steps=30)
    assert (set(speeds), responses) == ({20.0}, [])


def test_model_watches_only_after_its_step():
    road = StraightRoad(gap=12.0)
    speeds, (response,) = taken_over(road, "cc_human", after=5)
    assert response["first"] == 5
    assert speeds[:5] == [20.0] * 5


def test_paths_that_meet_in_a_junction_are_reported():
    road = StraightRoad(gap=12.0)
    road.crossing = (
        Crossing(
            actor="lead",
            distance_m=5.0,
            exit_m=10.0,
            actor_distance_m=5.0,
            actor_exit_m=10.0,
            speed_mps=10.0,
            braking_mps2=4.5,
            has_right_of_way=True,
        ),
    )
    assert taken_over(road, "cc_human")[1][0]["in_junction"]


def test_model_needs_actions_with_a_speed_and_a_simulator_that_knows_the_road():
    road = StraightRoad(gap=12.0)
    road.actions = {"ego": MetaAction()}
    with pytest.raises(InvalidEpisodeError, match="set neither a speed nor an acceleration"):
        overruled_agent(Steady(20.0), road, Overruled("ego", 0, reference="fsm", other="lead"))
    with pytest.raises(InvalidEpisodeError, match="reports no surroundings"):
        overruled_agent(Steady(20.0), SimpleNamespace(), Overruled("ego", 0, reference="fsm", other="lead"))


def in_bend(turn, distance):
    """Two cars on a circular arc: the other one is ``distance`` ahead and has turned by ``turn``."""
    actors = tuple(Actor(name, "passenger", LENGTH_M, 2.0) for name in ("ego", "lead"))
    radius = distance / turn
    x, y = radius * np.sin(turn), radius * (1 - np.cos(turn))
    center = np.array([x, y]) - np.array([LENGTH_M / 2, 0.0])
    front = center + LENGTH_M / 2 * np.array([np.cos(turn), np.sin(turn)])
    return Scene(0.0, Roster(actors), [(0.0, 0.0), tuple(front.tolist())], [0.0, turn], [20.0, 10.0])


def test_near_vehicle_in_a_slight_bend_is_in_the_path():
    around = Surroundings(speed_mps=20.0, acceleration_mps2=3.0, braking_mps2=9.0)
    gap, lateral_gap, speed, _ = _measured(in_bend(0.05, 25.0), "ego", "lead", around)
    assert gap == pytest.approx(20.0, abs=0.1)
    assert lateral_gap == pytest.approx(-2.0, abs=0.1)
    assert speed == 10.0


def test_far_vehicle_in_a_bend_is_measured_by_the_road():
    ahead = Neighbor(actor="lead", gap_m=56.0, speed_mps=10.0, braking_mps2=4.5)
    around = Surroundings(speed_mps=20.0, acceleration_mps2=3.0, braking_mps2=9.0, ahead=(ahead,))
    gap, lateral_gap, *_ = _measured(in_bend(0.8, 60.0), "ego", "lead", around)
    assert (gap, lateral_gap) == (56.0, -2.0)
    around = Surroundings(
        speed_mps=20.0, acceleration_mps2=3.0, braking_mps2=9.0, sides={1: Side(exists=True, ahead=ahead)}
    )
    gap, lateral_gap, *_ = _measured(in_bend(0.8, 60.0), "ego", "lead", around)
    assert gap == 56.0
    assert lateral_gap >= 1.0
    around = Surroundings(speed_mps=20.0, acceleration_mps2=3.0, braking_mps2=9.0)
    assert _measured(in_bend(0.8, 60.0), "ego", "lead", around) is None
