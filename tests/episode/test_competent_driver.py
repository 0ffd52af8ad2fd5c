"""A model of a competent driver takes control of the speed, whatever form the agent's actions have."""

from __future__ import annotations

import numpy as np
import pytest
from onlookers import Always
from sumo_runs import SumoRuns

from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.episode._reference_driver_takeover import CompetentDriver
from crashhunt.trial import Overruled

CASE = {"ego_kmh": 60.0, "other_kmh": 20.0, "gap_m": 35.0, "lateral_mps": 1.5, "side": 1}
KEEPS_SPEED = {
    "speed_and_lane": (60 / 3.6, 0),
    "speed_and_lateral": (60 / 3.6, 0.0),
    "acceleration": (0.0, 0),
    "acceleration_steering": (0.0, 0.0),
}


class OpenLoop(Always):
    """Follows the plan of the first step, wherever the vehicle is."""

    def act(self, observation):
        scene = self.action.scene()
        if not hasattr(self, "pose"):
            self.pose, self.steps = [*scene.centers[0].tolist(), float(scene.headings[0])], 0
        x, y, heading = self.pose
        self.steps += 1
        away = 6 / 3.6 * self.steps
        return [[0.1, x + away * np.cos(heading), y + away * np.sin(heading), heading, 60 / 3.6]]


def driven(folder, form):
    """Return the speeds of the vehicle, and what the driver reports."""
    with SumoRuns(folder) as runs:
        simulator, observations = runs.begin("r157-cut-in", 1, CASE, action=form)
        agent = OpenLoop(simulator) if form == "trajectory" else Always(KEEPS_SPEED.get(form, 1))
        driver = CompetentDriver(agent, simulator, Overruled("ego", 0, reference="fsm", other="other"))
        driver.reset(1)
        speeds = []
        for _ in range(60):
            action = simulator.actions["ego"].encode(driver.act(observations["ego"]))
            observations, *_ = simulator.step({"ego": action})
            scene = simulator.scene()
            speeds.append(float(scene.speeds[scene.roster.index["ego"]]))
        return np.array(speeds), driver.responses[0]


@pytest.fixture(scope="module")
def by_target_speed(tmp_path_factory):
    return driven(tmp_path_factory.mktemp("by_target_speed"), "speed_and_lane")


@pytest.mark.parametrize("form", [*(form for form in KEEPS_SPEED if form != "speed_and_lane"), "trajectory"])
def test_driver_brakes_as_with_a_target_speed(tmp_path, by_target_speed, form):
    expected, seen = by_target_speed
    speeds, also_seen = driven(tmp_path, form)
    assert expected.min() < 8 < expected[0]  # the driver brakes
    assert speeds == pytest.approx(expected, abs=0.15)
    assert also_seen["first"] == seen["first"]
    assert also_seen["least_gap_m"] == pytest.approx(seen["least_gap_m"], abs=0.3)
    assert seen["least_gap_m"] > 0


def test_driver_has_no_answer_for_actions_without_a_speed(tmp_path):
    with pytest.raises(InvalidEpisodeError, match="set neither a speed nor an acceleration"):
        driven(tmp_path, "meta")
