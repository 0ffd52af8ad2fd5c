"""What a film shows above its last step."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from crashhunt.cli import _replay
from crashhunt.oracles import REQUIREMENT, RequirementOracle
from crashhunt.trial import Outcome

VIOLATED = Outcome.own(REQUIREMENT, RequirementOracle.outcomes[REQUIREMENT])


@pytest.mark.parametrize(
    ("outcome", "words"),
    [
        (Outcome.COLLISION, "CRASH"),
        (Outcome.OFF_ROAD, "CRASH"),
        (Outcome.AGENT_ERROR, "AGENT ERROR"),
        (Outcome("red_light"), "RED LIGHT"),
        (VIOLATED, "VIOLATION"),
    ],
)
def test_only_a_traffic_crash_is_called_a_crash(monkeypatch, tmp_path, outcome, words):
    for name in ("read_lanes", "read_obstacles"):
        monkeypatch.setattr(f"crashhunt.recording.{name}", lambda _: [])
    bundle = SimpleNamespace(path=tmp_path, is_near_miss=False, driver="ego", files={})
    result = SimpleNamespace(outcome=outcome, collision=None)
    shot = _replay._shot(bundle, SimpleNamespace(steps=7), result, {}, crashed=True)
    assert (shot.crash_words, shot.crash_step) == (words, 7)
