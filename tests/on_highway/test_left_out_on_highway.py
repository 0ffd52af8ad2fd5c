"""Episodes on highway-env in which not everybody takes part."""

from __future__ import annotations

import numpy as np
import pytest

from crashhunt.highway import HighwaySimulator
from crashhunt.scenario import load_scenario
from crashhunt.trial import ALL_AGENTS


@pytest.fixture(scope="module")
def simulator(tmp_path_factory):
    made = HighwaySimulator(load_scenario("intersection-highway-env"), tmp_path_factory.mktemp("stage"))
    yield made
    made.close()


def driven(simulator, steps=8, **options):
    """Everybody who was seen, where they were in the end, and what the agent saw."""
    shown, _ = simulator.reset(seed=3, options={"arguments": {}, **options})
    seen, saw = {}, [shown["ego"]]
    action = simulator.actions["ego"].encode(1)
    for _ in range(steps):
        if not simulator.agents:
            break
        shown, *_ = simulator.step({"ego": action})
        scene = simulator.scene()
        seen |= dict(zip([actor.id for actor in scene.roster.actors], scene.points, strict=True))
        saw.append(shown["ego"])
    return seen, np.array(saw)


def test_only_those_take_part_that_are_named(simulator):
    everybody, saw = driven(simulator)
    assert simulator.entered == []
    again, seen = driven(simulator, only=(ALL_AGENTS,))
    assert again == everybody
    np.testing.assert_array_equal(seen, saw)
    entered = list(simulator.entered)
    assert everybody.keys() <= {*entered, "ego"}
    assert len(entered) > 3
    alone, seen = driven(simulator, only=())
    assert alone.keys() == {"ego"}
    assert not np.array_equal(seen[0], saw[0])  # not even in the first observation is anybody else
    one = entered[0]
    assert driven(simulator, only=(one,))[0].keys() == {"ego", one}
    assert driven(simulator)[0] == everybody
