"""What a result says of itself, in one line."""

from __future__ import annotations

import pytest

from crashhunt.trial import Collision, Failure, Outcome, TrialResult, TrialSpec
from crashhunt.world import Event

SPEC = TrialSpec(3, 7, {}, {}, max_steps=100)


def hit(role: str, collider: str, victim: str, kind: str = "") -> Collision:
    return Collision("ego", role, collider, victim, ("overlap",), kind)


@pytest.mark.parametrize(
    ("outcome", "evidence", "says"),
    [
        (Outcome.COLLISION, {"collision": hit("collider", "ego", "car 1")}, "ego drove into car 1 at step 9"),
        (Outcome.COLLISION, {"collision": hit("victim", "car 1", "ego")}, "ego was hit by car 1 at step 9"),
        (Outcome.COLLISION, {"collision": hit("alone", "ego", "", "fell")}, "ego crashed (fell) at step 9"),
        (Outcome.OFF_ROAD, {"collision": hit("alone", "ego", "", "off_road")}, "ego left the road at step 9"),
        (Outcome.RED_LIGHT, {"event": Event("red_light", "ego", "ego ran 'c'")}, "ego ran 'c', at step 9"),
        (Outcome.AGENT_ERROR, {"failure": Failure("KeyError", "'x'", "Trace", "ego")}, "ego: KeyError: 'x'"),
        (Outcome.SIMULATOR_ERROR, {"failure": Failure("KeyError", "'x'", "Trace")}, "KeyError: 'x'"),
        (Outcome.HANG, {"failure": Failure("timeout", "it hung", "the stack", "ego")}, "it hung"),
        (Outcome.PROCESS_DIED, {"failure": Failure("signal", "killed", "Trace", exit_code=-9)}, "killed"),
        (Outcome.INVALID, {"failure": Failure("invalid", "no vehicle")}, "no vehicle"),
        (Outcome.SURVIVED, {}, "survived after 9 steps"),
    ],
)
def test_a_result_in_one_line(outcome, evidence, says):
    assert TrialResult(SPEC, outcome, steps=9, **evidence).summary == says
