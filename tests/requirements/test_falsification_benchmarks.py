"""The benchmarks of ARCH-COMP behave as their equations say, and as was computed for known inputs elsewhere."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from crashhunt.requirements import parse

STUDY = Path(__file__).parents[2] / "scripts" / "studies" / "falsification"


@pytest.fixture(autouse=True)
def study(monkeypatch):
    monkeypatch.syspath_prepend(STUDY)
    yield
    for name in ("chasing_cars", "transmission"):
        sys.modules.pop(name, None)


def simulate(env, action, duration_s, step_s):
    _, info = env.reset(seed=0)
    rows = [info]
    for _ in range(round(duration_s / step_s)):
        observation, _, _, _, info = env.step(np.array(action))
        rows.append(info)
    return observation, {name: np.array([row[name] for row in rows]) for name in rows[0]}


def robustness(module, trace, step_s):
    return {name: parse(text).robustness(trace, step_s) for name, text in module.REQUIREMENTS.items()}


def test_chasing_cars_violate_what_they_are_known_to_violate():
    import chasing_cars as cars

    env = cars.ChasingCars()
    positions, trace = simulate(env, [1.0, 0.0], cars.DURATION_S, cars.STEP_S)
    found = robustness(cars, trace, cars.STEP_S)
    assert positions[0] == pytest.approx(-5000, abs=1)  # -t² / 2
    assert found["CC1"] == pytest.approx(-251.8, abs=1)
    assert found["CC3"] == pytest.approx(-1.77, abs=0.1)
    positions, trace = simulate(env, [0.0, 0.0], cars.DURATION_S, cars.STEP_S)
    assert positions.tolist() == [0, 10, 20, 30, 40]
    assert robustness(cars, trace, cars.STEP_S)["CC2"] == -5


def test_the_transmission_reaches_the_known_speeds_at_full_throttle():
    import transmission

    env = transmission.Transmission()
    _, trace = simulate(env, [1.0, 0.0], transmission.DURATION_S, transmission.STEP_S)
    assert trace["speed"][200] == pytest.approx(120.21, abs=0.05)
    assert trace["rpm"][:101].max() == pytest.approx(4764, abs=3)
    found = robustness(transmission, trace, transmission.STEP_S)
    assert found["AT1"] < 0
    assert found["AT2"] < 0
    assert found["AT6a"] > 0
