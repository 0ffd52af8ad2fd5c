"""Which verdict a replay has, from how it ended and where it first differs."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from crashhunt.base.errors import CrashhuntError
from crashhunt.recording import AgentChannel, Divergence, Prologue
from crashhunt.replays import Look, _debugger, _replay
from crashhunt.trial import Collision, Failure, Outcome, TrialResult, TrialSpec

EGO = AgentChannel("ego", "float32", (8, 7), "float64", (2,))
PROLOGUE = Prologue((EGO,), 0.1)
HIT = Collision("ego", "collider", "ego", "x", ("overlap",), "overlap", 1.0, 2.0)
CRASH = TrialResult(TrialSpec(4, 1, {}, {}, 90), Outcome.COLLISION, steps=30, collision=HIT)
FINE = replace(CRASH, outcome=Outcome.SURVIVED, steps=90, collision=None)
THERE = Divergence(step=5, agent="", field="x", recorded=1, replayed=2)


@pytest.fixture
def judge(monkeypatch):
    monkeypatch.setattr(_replay, "load_order_change", lambda scenario, recorded: "")
    monkeypatch.setattr(_replay, "environment_changes", lambda environment: {"numpy": ("1", "2")})

    def judge(result, divergence=THERE, *, whole=True, now=PROLOGUE, versions=(), near_miss=False, **given):
        backend = SimpleNamespace(versions=versions)
        rerun = SimpleNamespace(**{
            "recorded": SimpleNamespace(prologue=PROLOGUE), "code": "snapshot", "edits": (), "other_traffic": (),
            "snapshot": SimpleNamespace(environment=dict), "bundle": SimpleNamespace(is_near_miss=near_miss),
            "worker": SimpleNamespace(crash_on=("collision",), scenario=SimpleNamespace(backend=backend)), **given,
        })  # fmt: skip
        return _replay._judge(rerun, SimpleNamespace(prologue=now), result, divergence, whole=whole)

    return judge


def test_without_a_difference_it_is_reproduced(judge):
    assert judge(CRASH, None) == ("reproduced", "")
    assert judge(FINE, None, code="current") == ("reproduced", "")


def test_the_code_of_the_hunt_diverges_and_other_code_is_fixed_or_changed(judge):
    assert judge(CRASH) == judge(FINE) == ("diverged", "")
    for given in ({"code": "current"}, {"edits": ("speed",)}):
        assert judge(CRASH, **given) == ("changed", "")
        assert judge(FINE, **given) == ("fixed", "")
        assert judge(FINE, whole=False, **given) == ("diverged", "")  # it may crash later
        assert judge(FINE, near_miss=True, **given) == ("diverged", "")
        verdict, why = judge(FINE, other_traffic=("the seed is 5",), **given)
        assert verdict == "not_comparable"
        assert why.startswith("no crash, but the seed is 5, ")


def test_another_simulator_cannot_be_compared(judge, monkeypatch):
    assert judge(FINE, code="current", versions=("libsumo",)) == ("fixed", "")  # of which numpy is no part
    assert judge(FINE, versions=("numpy",)) == ("not_comparable", "the simulator differs: numpy was 1 and is 2")
    monkeypatch.setattr(_replay, "load_order_change", lambda scenario, recorded: "another order")
    assert judge(FINE) == ("not_comparable", "the simulator differs: another order")


@pytest.mark.parametrize(
    ("now", "says"),
    [
        (Prologue((EGO,), 0.5), "the step length was 0.1 s and is 0.5 s"),
        (Prologue((EGO, EGO), 0.1), "the agents were ego and are ego, ego"),
        (
            Prologue((AgentChannel("ego", "float32", (5, 5), "int64", ()),), 0.1),
            "ego's channel was (8, 7) float32 → (2,) float64 and is (5, 5) float32 → () int64",
        ),
    ],
)
def test_other_channels_cannot_be_compared(judge, now, says):
    assert judge(CRASH, now=now) == ("not_comparable", f"what is recorded is another: {says}")


def test_equal_recordings_may_end_differently():
    def ends(now, code="snapshot", was=CRASH):
        found = _replay._end_divergence(was, now, code)
        return found and (found.field, found.recorded, found.replayed)

    assert ends(CRASH) is None
    assert ends(FINE) == ("outcome", "collision", "survived")
    assert ends(replace(CRASH, steps=31)) == ("steps", 30, 31)
    other = replace(CRASH, collision=replace(HIT, victim="y"))
    assert ends(other) == ends(other, "current") == ("collision.victim", "x", "y")
    words = replace(CRASH, collision=replace(HIT, x=1.5))
    assert ends(words) == ("collision.x", 1.0, 1.5)
    assert ends(words, "current") is None  # another version may describe it otherwise
    assert ends(FINE, "log", was=replace(CRASH, outcome=Outcome.HANG, collision=None)) is None


def test_elsewhere_a_crash_is_another_one_and_none_is_no_fix():
    rerun = SimpleNamespace(elsewhere=True, worker=SimpleNamespace(crash_on=("collision",)), other_traffic=("the map",))
    there = _replay.judged(rerun, None, None, CRASH)
    assert (there.verdict, there.replayed) == ("changed", CRASH)
    fine = _replay.judged(rerun, None, None, FINE)
    assert fine.verdict == "not_comparable"
    assert fine.reason.startswith("no crash, but the map, ")


def test_a_replay_that_cannot_be_set_up_is_an_error_with_the_reason(monkeypatch):
    failure = Failure("invalid", "the agent needs a map")
    result = replace(FINE, outcome=Outcome.INVALID, steps=0, failure=failure)
    monkeypatch.setattr(_debugger, "debug", lambda rerun, look: (result, None))
    with pytest.raises(CrashhuntError, match="as far as the first step: the agent needs a map") as caught:
        _replay._look_into(SimpleNamespace(bundle=SimpleNamespace(id="000004-collision")), Look(until=3))
    assert caught.value.where == "000004-collision"
