"""Manoeuvres of UN R157 on SUMO: the paths of the other vehicles, and the agreement with the plain computation."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from onlookers import Steady

from crashhunt.base.errors import InvalidEpisodeError, ScenarioError
from crashhunt.scenario import load_scenario
from crashhunt.sumo._options import SumoSetup
from crashhunt.world import manoeuvre_motions

CUT_IN = {"ego_kmh": 60.0, "other_kmh": 40.0, "gap_m": 12.5, "lateral_mps": 0.9}


@pytest.fixture
def simulate(sumo_runs):
    def begin(name, **arguments):
        simulator, observations = sumo_runs.begin(name, 1, arguments)
        return simulator, observations["ego"]

    return begin


def drive(simulator, observation, agent, steps):
    """Drive until a contact; return the scenes."""
    agent.reset(0)
    scenes = [simulator.scene()]
    for _ in range(steps):
        action = simulator.actions["ego"].encode(agent.act(observation))
        observations, *_ = simulator.step({"ego": action})
        observation = observations["ego"]
        scenes.append(simulator.scene())
    return scenes


@pytest.mark.parametrize("side", [1, -1])
def test_vehicle_cuts_in_at_the_gap_and_with_the_lateral_speed_of_the_arguments(simulate, side):
    scenes = drive(*simulate("r157-cut-in", **CUT_IN, side=side), Steady(60 / 3.6), 60)
    ego, other = (np.array([scene.points[scene.roster.index[name]] for scene in scenes]) for name in ("ego", "other"))
    gaps, lateral = other[:, 0] - 4.3 - ego[:, 0], (other[:, 1] - ego[:, 1]) * side
    assert gaps[6] == pytest.approx(12.5)  # after six steps of 0.15 m/s, the lateral speed is 0.9 m/s
    assert lateral[6] == pytest.approx(3.5)
    assert -np.diff(lateral)[6:40] == pytest.approx(0.09)
    assert lateral[-1] == pytest.approx(0.0, abs=1e-6)
    assert np.diff(gaps) == pytest.approx(-20 / 3.6 * 0.1)


STRAIGHT = {
    "deceleration": {"decel_mps2": 5.0, "headway_s": 2.0},
    "cut-out": {"front_m": 60.0, "lateral_mps": 1.5, "headway_s": 2.0, "side": 1},
    "lane-keeping": {"swerve_m": 0.5, "period_s": 8.0, "beside_m": 5.0, "headway_s": 2.0, "side": 1},
    "following": {"offset_m": 0.5, "slower_kmh": 20.0, "period_s": 10.0, "headway_s": 2.0},
    "blocked-lane": {"distance_m": 100.0, "offset_m": -0.5},
    "multiple-targets": {"distance_m": 100.0, "between_m": 10.0, "offset_m": 0.5},
    "pedestrian": {"distance_m": 100.0, "walk_kmh": 5.0, "impact_m": 0.2, "from_side": -1},
    "detection-range": {"seen_m": 46.0, "distance_m": 150.0, "offset_m": 5.25},
}


@pytest.mark.parametrize("name", STRAIGHT)
def test_other_road_users_are_at_the_places_of_their_motions(simulate, name):
    values, side = {"ego_kmh": 60.0, **STRAIGHT[name]}, STRAIGHT[name].get("side", -1)
    scenes = drive(*simulate(f"r157-{name}", **values), Steady(60 / 3.6), 80)
    motions = manoeuvre_motions(name.replace("-", "_"), values, -3.5 - 1.75 * side, -3.5 + 1.75 * side, 0.1)
    for step, (scene, motion) in enumerate(zip(scenes, motions, strict=False)):
        found = {name: (*scene.points[row], scene.speeds[row]) for name, row in scene.roster.index.items()}
        assert found.pop("ego")[:2] == pytest.approx((300 + step * 6 / 3.6, -3.5 - 1.75 * side), abs=0.01)
        assert found == {name: pytest.approx((one.x, one.y, one.speed), abs=0.01) for name, one in motion.items()}


def test_invalid_arguments_of_a_manoeuvre_are_refused(simulate):
    for value in (math.nan, -1.0, 1e9):
        with pytest.raises(InvalidEpisodeError, match="the argument gap_m is"):
            simulate("r157-cut-in", **{**CUT_IN, "gap_m": value})


def test_scenario_with_a_manoeuvre_needs_its_arguments(tmp_path):
    scenario = load_scenario("r157-cut-in")
    assert scenario.table(SumoSetup).manoeuvre == "cut_in"
    less = replace(scenario, arguments={name: one for name, one in scenario.arguments.items() if name != "side"})
    with pytest.raises(ScenarioError, match="has no 'side', which the manoeuvre 'cut_in' needs"):
        less.backend.check(less, "scenario.toml")


def signal(name, kind, duration_s, *points):
    return {name: f"signal:{kind}:{len(points)}:{duration_s}"} | {f"{name}[{at}]": one for at, one in enumerate(points)}


def test_vehicle_ahead_drives_a_speed_profile(simulate):
    profile = signal("slower_kmh", "linear", 8.0, 0.0, 36.0, 18.0, 80.0, 20.0)
    values = STRAIGHT["following"] | profile
    scenes = drive(*simulate("r157-following", ego_kmh=60.0, **values), Steady(60 / 3.6), 80)
    speeds = [scene.speeds[scene.roster.index["leader"]] for scene in scenes]
    slower = np.interp(np.arange(81) * 0.1, [0, 2, 4, 6, 8], [0, 36, 18, 80, 20])
    assert speeds == pytest.approx(np.maximum(0, 60 - slower) / 3.6)
    jump = STRAIGHT["following"] | signal("slower_kmh", "constant", 8.0, 36.0)
    scenes = drive(*simulate("r157-following", ego_kmh=60.0, **jump), Steady(60 / 3.6), 20)
    speeds = [scene.speeds[scene.roster.index["leader"]] for scene in scenes]
    assert speeds == pytest.approx(np.maximum(24 / 3.6, 60 / 3.6 - np.arange(21)))  # 10 m/s² at most


def test_deceleration_of_the_vehicle_ahead_follows_a_signal(simulate):
    profile = signal("decel_mps2", "constant", 4.0, 2.0, 0.0, 6.0)
    scenes = drive(*simulate("r157-deceleration", ego_kmh=60.0, headway_s=2.0, **profile), Steady(60 / 3.6), 40)
    speeds = [scene.speeds[scene.roster.index["leader"]] for scene in scenes]
    changes = np.where(np.arange(40) * 0.1 < 4 / 3 - 1e-9, 2.0, np.where(np.arange(40) * 0.1 < 8 / 3 - 1e-9, 0.0, 6.0))
    assert -np.diff(speeds) / 0.1 == pytest.approx(changes)


def test_walk_of_the_person_follows_a_signal_to_the_place_of_impact(simulate):
    profile = signal("walk_kmh", "linear", 12.0, 1.0, 9.0, 3.0)
    values = STRAIGHT["pedestrian"] | profile
    scenes = drive(*simulate("r157-pedestrian", ego_kmh=60.0, **values), Steady(60 / 3.6), 70)
    y = np.array([scene.points[scene.roster.index["person walker"]][1] for scene in scenes])
    walks = np.interp(np.arange(70) * 0.1, [0, 6, 12], [1.0, 9.0, 3.0]) / 3.6
    moving = np.diff(y) > 1e-9
    assert np.diff(y)[moving][1:] / 0.1 == pytest.approx(walks[moving][1:])
    assert y[60] == pytest.approx(-1.75 - 0.2)  # 100 m at 60 km/h take 6 s


def test_a_point_of_a_signal_out_of_range_is_refused(simulate):
    with pytest.raises(InvalidEpisodeError, match=r"decel_mps2 is -1\.0 \(allowed: 0 to 1000\)"):
        simulate("r157-deceleration", ego_kmh=60.0, headway_s=2.0, **signal("decel_mps2", "linear", 4.0, 2.0, -1.0))
