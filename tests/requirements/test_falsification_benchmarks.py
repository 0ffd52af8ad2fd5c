"""The benchmarks of ARCH-COMP behave as their equations say, and as was computed for known inputs elsewhere."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from crashhunt.requirements import parse
from crashhunt.trial import TrialSpec, fold_signals

STUDY = Path(__file__).parents[2] / "scripts" / "studies" / "falsification"


@pytest.fixture(autouse=True)
def study(monkeypatch):
    monkeypatch.syspath_prepend(STUDY)
    yield
    for name in ("chasing_cars", "transmission", "falsification", "peers"):
        sys.modules.pop(name, None)


def driven(env, inputs):
    _, info = env.reset(seed=0)
    rows = [info]
    for action in inputs:
        observation, _, _, _, info = env.step(np.array(action))
        rows.append(info)
    return observation, {name: np.array([row[name] for row in rows]) for name in rows[0]}


def robustness(module, trace, step_s):
    return {name: parse(text).robustness(trace, step_s) for name, text in module.REQUIREMENTS.items()}


def test_chasing_cars_violate_what_they_are_known_to_violate():
    import chasing_cars as cars

    env = cars.ChasingCars(integration_s=0.01)
    positions, trace = driven(env, [(1.0, 0.0)] * 1000)
    found = robustness(cars, trace, cars.STEP_S)
    assert positions[0] == pytest.approx(-5000, abs=1)  # -t² / 2
    assert found["CC1"] == pytest.approx(-251.8, abs=1)
    assert found["CC3"] == pytest.approx(-1.77, abs=0.1)
    positions, trace = driven(env, [(0.0, 0.0)] * 1000)
    assert positions.tolist() == [0, 10, 20, 30, 40]
    assert robustness(cars, trace, cars.STEP_S)["CC2"] == -5


def test_the_transmission_reaches_the_known_speeds_at_full_throttle():
    import transmission

    env = transmission.Transmission()
    _, trace = driven(env, [(1.0, 0.0)] * 3000)
    assert trace["speed"][2000] == pytest.approx(120.21, abs=0.05)
    assert trace["rpm"][:1001].max() == pytest.approx(4764, abs=3)
    found = robustness(transmission, trace, transmission.STEP_S)
    assert found["AT1"] < 0
    assert found["AT2"] < 0
    assert found["AT6a"] > 0
    assert all(found[f"AT5{gear}"] >= 0 for gear in range(1, 5))


def test_a_whole_trial_at_once_has_the_trace_of_the_environment():
    """The study simulates without the overhead of episodes, and this must not change a bit."""
    import chasing_cars
    import falsification
    import transmission

    arguments: dict[str, object] = {}
    points = {"throttle": (0.9, 0.1, 0.8, 0.4), "brake": (0.0, 0.7, 0.2, 0.1)}
    for kind in ("constant", "linear"):
        for name, values in points.items():
            arguments[name] = f"signal:{kind}:4:3.0"
            arguments |= {f"{name}[{number}]": value for number, value in enumerate(values)}
        spec = TrialSpec(0, 1, {"car": arguments}, {}, 30)
        for module, env in (
            (chasing_cars, chasing_cars.ChasingCars(integration_s=0.01)),
            (transmission, transmission.Transmission()),
        ):
            inputs = falsification.inputs_of(spec, module.STEP_S, 3.0)
            signals = [fold_signals(arguments)[name] for name in points]
            times = np.arange(round(3.0 / module.STEP_S)) * module.STEP_S
            expected = np.array([[signal(time_s) for signal in signals] for time_s in times])
            np.testing.assert_allclose(np.array(inputs).T, expected, atol=1e-12)
            _, trace = driven(env, np.array(inputs).T)
            whole = module.simulate(*inputs, *((0.01,) if module is chasing_cars else ()))
            assert {name: values.tolist() for name, values in whole.items()} == {
                name: values.tolist() for name, values in trace.items()
            }
