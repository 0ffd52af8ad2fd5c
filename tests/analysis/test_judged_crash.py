"""What `judge` finds about a crash on the toy of which the causes are known: the leader brakes, and ego is too fast."""

from __future__ import annotations

from dataclasses import replace

import pytest

from crashhunt.analysis import _avoidability, judge, judge_bundle
from crashhunt.crashes import INTERRUPTED, find_bundle, judgement_of


def hunted(toy):
    """One crash, for `made_once`: ego drives into the leader at step 77, which brakes from step 60 on."""
    words = ("--arg", "speed=10:12", "--set", "gap_m=20:30", "--disturb", "brake@60=ahead:8:2", "--seed", "1")
    toy.crashhunt("run", "h", "1", "1", "300", "--scenario", "toy", *words)


@pytest.fixture
def crash(toy, made_once):
    return find_bundle(made_once(hunted, toy).folder / "h")


def endings(factor):
    return [(run.given, run.ending) for run in factor.runs]


def test_last_step_and_causes_of_a_crash_are_those_that_its_physics_give(crash):
    watched = []
    found = judge(crash, runs=60, why=80, reference=5, drivers=True, watch=lambda *given: watched.append(given))

    brake, left, right = found.attempts
    late = dict.fromkeys(range(71, 77), "hit")
    assert brake.endings == {64: "avoided", 70: "avoided", **late}
    assert (brake.manoeuvre, brake.last_step, brake.too_late_step, brake.changed) == ("brake", 70, 71, ())
    assert brake.deceleration == pytest.approx(8.0)
    assert (left.manoeuvre, right.manoeuvre) == ("left", "right")
    assert left.endings == right.endings == late  # the road has one lane
    assert (found.verdict, found.visible_step, found.why_not) == ("avoidable", 0, "")

    factors = {(one.kind, one.name, one.what): one for one in found.why.factors}
    assert list(factors) == [
        ("disturbance", "leader", "brake"), ("agent", "ego", "sped up"), ("other", "leader", "braked"),
        ("argument", "gap_m", "default"), ("argument", "gap_m", "drawn"), ("argument", "ego.speed", "default"),
        ("argument", "ego.speed", "drawn"), ("seed", "seed", "drawn"), ("other", "leader", "there"),
    ]  # fmt: skip
    assert endings(factors["disturbance", "leader", "brake"]) == [(59, "none")]
    assert endings(factors["agent", "ego", "sped up"]) == [(0, "same")]  # it keeps 10 m/s, as the leader does
    braked = factors["other", "leader", "braked"]
    assert (braked.step, braked.was, endings(braked)) == (59, 10.0, [(59, "none"), (54, "none"), (49, "none")])
    there = factors["other", "leader", "there"]  # the toy cannot remove a vehicle
    assert endings(there) == [(47, "unclear"), (37, "unclear"), (27, "unclear")]
    assert {run.into for one in found.why.factors for run in one.runs} == {""}
    spec = crash.result.spec
    for name, was, default, ending, low, high in (
        ("gap_m", spec.scenario_arguments["gap_m"], 30.0, "same", 20, 30),
        ("ego.speed", spec.arguments["ego"]["speed"], 8.0, "none", 10, 12),
    ):
        assert endings(factors["argument", name, "default"]) == [(default, ending)]
        drawn = factors["argument", name, "drawn"]
        values = {run.given for run in drawn.runs} - {was, default}
        assert (len(values), drawn.was, drawn.same) == (8, was, 8)
        assert all(low <= value <= high for value in values)
    seeds = factors["seed", "seed", "drawn"]
    assert (len({run.given for run in seeds.runs}), seeds.was, seeds.same) == (8, spec.seed, 8)
    assert (found.why.runs, found.why.steps, found.why.left) == (34, 204, 0)

    assert found.reference.why_not.startswith("a reference driver cannot drive ego")
    assert {one.why_not for one in found.drivers.runs} >= {"the simulator reports no surroundings of the vehicle"}
    others = 1 + 3  # the reference driver that watches, and the models of which the toy has no surroundings
    assert watched == [(done, 60 + 80 + 5 + 4) for done in range(1, 20 + 34 + others + 1)]


def test_judging_again_keeps_the_parts_that_it_does_not_compute(crash, monkeypatch):
    first = judge_bundle(crash, runs=1, why=2, reference=0, drivers=False, parallel=1)
    assert (judgement_of(first).runs, judgement_of(first).why.runs, judgement_of(first).why.left) == (1, 2, 32)

    def judged_again(_bundle, _options, *, runs, **_):  # without processes: what it finds is not the question here
        brake = replace(judgement_of(first).attempts[0], endings=dict.fromkeys(range(runs), "hit"))
        return replace(judgement_of(first), attempts=(brake,), why=None)

    with monkeypatch.context() as patch:
        patch.setattr(_avoidability, "judge", judged_again)
        unwritten = judge_bundle(crash, runs=2, why=0, reference=0, drivers=False, parallel=1, write=False)
        assert judgement_of(find_bundle(crash.hunt)) == judgement_of(first)
        assert (judgement_of(unwritten).runs, judgement_of(unwritten).why) == (2, None)
        second = judge_bundle(find_bundle(crash.hunt), runs=3, why=0, reference=0, drivers=False, parallel=1)
        assert (judgement_of(second).runs, judgement_of(second).why) == (3, judgement_of(first).why)
    stopped = judge_bundle(second, runs=9, why=9, reference=9, drivers=True, parallel=1, stopped=lambda: True)
    assert (judgement_of(stopped).why_not, judgement_of(stopped).runs) == (INTERRUPTED, 0)
    assert judgement_of(find_bundle(crash.hunt)) == judgement_of(second)
