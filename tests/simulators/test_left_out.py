"""Episodes in which not everybody takes part, on SUMO and on highway-env."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest

from crashhunt.highway import HighwaySimulator
from crashhunt.scenario import argument_values, load_scenario
from crashhunt.sumo import SumoSimulator
from crashhunt.trial import ALL_AGENTS

CASES = {
    "loop": (SumoSimulator, {"vehicles": 12}, (12.0, 0), 30),
    "intersection-highway-env": (HighwaySimulator, {}, 1, 8),
}


@pytest.mark.parametrize("name", CASES)
def test_only_those_take_part_that_are_named(tmp_path, name):
    kind, arguments, action, steps = CASES[name]
    scenario = load_scenario(name)
    arguments = {**argument_values(scenario), **arguments}
    with closing(kind(scenario, tmp_path)) as simulator:

        def driven(**options):
            """Everybody who was seen, where they were in the end, and what the agent saw."""
            shown, _ = simulator.reset(seed=3, options={"arguments": arguments, **options})
            seen, saw = {}, [shown["ego"]]
            for _ in range(steps):
                if not simulator.agents:
                    break
                shown, *_ = simulator.step({"ego": simulator.actions["ego"].encode(action)})
                scene = simulator.scene()
                seen |= dict(zip([actor.id for actor in scene.roster.actors], scene.points, strict=True))
                saw.append(shown["ego"])
            return seen, np.array(saw)

        everybody, saw = driven()
        assert simulator.entered == []
        again, seen = driven(only=(ALL_AGENTS,))
        assert again == everybody
        np.testing.assert_array_equal(seen, saw)
        entered = list(simulator.entered)
        assert everybody.keys() <= {*entered, "ego"}
        assert len(set(entered)) == len(entered) > 3
        assert driven(only=tuple(entered))[0] == everybody
        alone, seen = driven(only=())
        assert alone.keys() == {"ego"}
        assert not np.array_equal(seen[0], saw[0])  # not even in the first observation is anybody else
        others = [other for other in everybody if other != "ego"]
        assert any((found := driven(only=(other, "absent"))[0]).keys() == {"ego", other} for other in others)
        assert not np.allclose(list(found.values()), 0.0)
        assert driven()[0] == everybody
