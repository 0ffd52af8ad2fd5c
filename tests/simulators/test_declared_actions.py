"""Tests of the forms of actions that are numbers within bounds: encoding, limits, and refused values."""

import numpy as np
import pytest

from crashhunt.agents import KeepLaneWithSpeed
from crashhunt.base.errors import ActionError
from crashhunt.scenario import ACTIONS
from crashhunt.simulators import AccelerationAndLaneChange, NumbersAction, SimulatorDrives


def test_acceleration_is_encoded_as_two_float64():
    for action in ((-2.5, 1), np.array([-2.5, 1.0]), [np.float32(-2.5), True]):
        encoded = AccelerationAndLaneChange().encode(action)
        assert (encoded.dtype, encoded.tolist()) == (np.float64, [-2.5, 1.0])


@pytest.mark.parametrize("action", [(10.5, 0), (float("nan"), 0), (1.0, 2), (1.0,), None, {1.0: 0, 0: 0}, (1j, 0)])
def test_wrong_acceleration_is_refused_with_value_limit_and_fix(action):
    with pytest.raises(ActionError, match=r"the action .* is not \(acceleration, lane_change\)") as caught:
        AccelerationAndLaneChange().encode(action)
    assert "-10 and 10 m/s²" in caught.value.fix


def test_none_and_overrides_are_encoded_for_a_vehicle_that_the_simulator_drives():
    form = SimulatorDrives()
    assert [form.encode(action).tolist() for action in (None, (13.0, 0), (-1, 1))] == [[-1, 0], [13, 0], [-1, 1]]
    assert form.encode(form.encode(None)).tolist() == [-1.0, 0.0]
    with pytest.raises(ActionError, match=r"the speed override -0\.5 is neither -1 nor a speed"):
        form.encode((-0.5, 0))


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ((10.0, 5.1), r"lateral_speed is 5.1 in the action \(target_speed, lateral_speed\)"),
        ((float("nan"), 0.0), "target_speed is nan"),
        ((10.0,), "is not .target_speed, lateral_speed."),
        ("fast", "is not .target_speed, lateral_speed."),
        (np.ma.masked_array([1.0, 1.0], [True, False]), "is not"),
        (np.array([1.0, 1.0], object), "dtype=object. of the type object is not"),
        (np.ones((2, 1)), r"of the shape .2, 1. is not"),
    ],
)
def test_number_beyond_its_limit_is_named(action, message):
    with pytest.raises(ActionError, match=message):
        NumbersAction("speed_and_lateral").encode(action)


def test_bounds_of_the_space_are_those_of_the_table():
    form = NumbersAction("speed_and_lateral")
    assert [*zip(form.space.low, form.space.high, strict=True)] == [
        (one.low, one.high) for one in ACTIONS["speed_and_lateral"].components
    ]
    mine = np.array([3.0, 1.0])
    encoded = form.encode(mine)
    mine[:] = 0
    assert encoded.tolist() == [3.0, 1.0]


@pytest.mark.parametrize("form", [AccelerationAndLaneChange(), SimulatorDrives(), NumbersAction("speed_and_lateral")])
def test_agent_that_returns_speeds_refuses_a_space_of_other_numbers(form):
    with pytest.raises(ValueError, match="the agent can only choose actions"):
        KeepLaneWithSpeed(10.0, form.space)
