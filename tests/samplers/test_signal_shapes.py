"""A guided hunt over input signals tries corners first, then random shapes and changes of parts of signals."""

from __future__ import annotations

import numpy as np
from spaces import ask, spec_of

from crashhunt.samplers import Cube, GuidedSampler
from crashhunt.samplers._signal_shapes import SignalShapes
from crashhunt.space import Constant, Range
from crashhunt.trial import Outcome, TrialResult

COUNT = 12


def signal_space(*names, others=()):
    space = {("car", name): Range(0.0, 1.0) for name in others}
    for name in names:
        space["car", name] = Constant(f"signal:constant:{COUNT}:60.0")
        space |= {("car", f"{name}[{number}]"): Range(0.0, 1.0) for number in range(COUNT)}
    return space


def values_of(proposal, name):
    return [proposal.arguments["car", f"{name}[{number}]"] for number in range(COUNT)]


def test_points_of_a_signal_are_in_the_order_of_time():
    space = signal_space("throttle", "brake", others=["a", "list[3]"])
    cube = Cube(space)
    names = [name for name in sorted(space) if not isinstance(space[name], Constant)]
    points = [[names[place][1] for place in places] for places in cube.signals]
    assert points == [[f"{name}[{number}]" for number in range(COUNT)] for name in ("brake", "throttle")]


def test_the_first_guided_trials_are_the_corners():
    sampler, found = GuidedSampler(signal_space("throttle", "brake", others=["a"])), set()
    for number in range(1, 5):
        proposal = ask(sampler, number, 1)
        pair = [set(values_of(proposal, name)) for name in ("throttle", "brake")]
        assert [len(of) for of in pair] == [1, 1]
        found.add(tuple(min(of) for of in pair))
    assert found == {(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)}


def test_shapes_have_ends_of_the_range_and_long_pieces_and_leave_other_arguments():
    shapes, rng = SignalShapes([range(1, 13)]), np.random.default_rng(1)
    drawn = np.array([shapes.with_shapes(np.full(13, 0.3), rng) for _ in range(500)])
    assert (drawn[:, 0] == 0.3).all()
    assert 0.3 < np.isin(drawn[:, 1:], [0.0, 1.0]).mean() < 0.7
    pieces = 1 + (np.diff(drawn[:, 1:], axis=1) != 0).sum(axis=1)
    assert set(range(1, 13)) >= set(pieces.tolist()) >= {1, 2, 3, 12}


def test_changes_stay_in_the_cube_and_in_the_signals():
    shapes, rng = SignalShapes([range(1, 13), range(13, 16)]), np.random.default_rng(1)
    points = rng.random((400, 17))
    changed = shapes.changed(points, rng)
    assert ((changed >= 0) & (changed <= 1)).all()
    assert (changed[:, [0, 16]] == points[:, [0, 16]]).all()
    moved = (changed != points).sum(axis=1)
    assert (moved == 0).mean() < 0.05
    assert {1, 2, 3, 12} <= set(moved.tolist())


def test_a_violation_that_needs_a_long_extreme_input_is_found():
    """Uniform draws of 12 points never have six of them in a row above 0.9."""
    sampler, space = GuidedSampler(signal_space("throttle")), []
    for number in range(250):
        proposal = ask(sampler, number, 2)
        values = np.array(values_of(proposal, "throttle"))
        lowest = max(values[start : start + 6].min() for start in range(7))
        if lowest > 0.9 and values[-1] < 0.05:
            return
        rob = max(0.9 - lowest, values[-1] - 0.05)
        sampler.tell(TrialResult(spec_of(number, proposal), Outcome.SURVIVED, danger=1 / (1 + max(rob, 0.0))))
        space.append(rob)
    raise AssertionError(space)
