"""The danger of a crash over time, where the agent is not there all the time, and some steps have no scene."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from crashhunt.crashes import danger_course
from crashhunt.recording import Prologue, StepRecord
from crashhunt.world import Actor, Roster, Scene

CARS = tuple(Actor(name, "car", 5.0, 2.0) for name in ("ego", "ahead"))
BOTH, ALONE = Roster(CARS), Roster(CARS[1:])
DT = 0.1


def recording(steps, there):
    """The ego follows with 10 m between them, at 10 m/s."""
    scenes = []
    for step in range(steps):
        ahead = (15.0 + step, 0.0)
        scenes.append(
            Scene(step * DT, BOTH, [(float(step), 0.0), ahead], [0.0, 0.0], [10.0, 10.0])
            if step in there
            else Scene(step * DT, ALONE, [ahead], [0.0], [10.0])
        )
    records = [StepRecord(number, scene) for number, scene in enumerate(scenes)]
    records.append(StepRecord(steps, None))
    return SimpleNamespace(all_steps=records, scenes=lambda: scenes, prologue=Prologue((), DT))


def test_there_is_none_where_the_agent_is_not_and_at_the_end_where_no_one_knows():
    found = danger_course(recording(100, range(20, 90)), "ego")
    assert found.steps == tuple(range(100))
    assert np.isnan(found.own[:20]).all()
    assert np.isnan(found.own[90:]).all()
    assert found.own[21:60] == pytest.approx(np.exp(-1 / 1.2), abs=0.02)
    assert found.greatest.other == "ahead"
    assert 20 <= found.greatest.step < 90
    assert found.of_step(30) == (found.own[30], 0.0)
    assert found.of_step(100) is None
    assert danger_course(recording(5, ()), "ego") is None
