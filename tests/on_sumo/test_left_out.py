"""Episodes in which not everybody takes part."""

from __future__ import annotations

import numpy as np
import pytest

from crashhunt.scenario import argument_values, load_scenario
from crashhunt.sumo import SumoSimulator
from crashhunt.trial import ALL_AGENTS

STEPS = 30


@pytest.fixture(scope="module")
def simulator(tmp_path_factory):
    made = SumoSimulator(load_scenario("loop"), tmp_path_factory.mktemp("stage"))
    yield made
    made.close()


def driven(simulator, **options):
    """Everybody who was seen, and where they were in the end, after some steps at a steady speed."""
    arguments = {**argument_values(simulator._scenario), "vehicles": 12}
    simulator.reset(seed=3, options={"arguments": arguments, **options})
    action = simulator.actions["ego"].encode((12.0, 0))
    seen = {}
    for _ in range(STEPS):
        simulator.step({"ego": action})
        scene = simulator.scene()
        seen |= dict(zip([actor.id for actor in scene.roster.actors], scene.points, strict=True))
    return seen


def test_only_those_take_part_that_are_named(simulator):
    everybody = driven(simulator)
    assert simulator.entered == []
    assert driven(simulator, only=(ALL_AGENTS,)) == everybody
    entered = list(simulator.entered)
    assert everybody.keys() <= {*entered, "ego"}
    assert len(set(entered)) == len(entered) > 3
    assert driven(simulator, only=tuple(entered)) == everybody
    assert driven(simulator, only=()).keys() == {"ego"}
    assert simulator.entered == entered
    others = [name for name in everybody if name != "ego"]
    assert any((found := driven(simulator, only=(other, "nobody"))).keys() == {"ego", other} for other in others)
    assert not np.allclose(list(found.values()), 0.0)
    assert driven(simulator) == everybody
