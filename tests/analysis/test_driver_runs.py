"""Which collisions the models of a competent driver decide."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
from hypothesis import assume, given, strategies as st
from scenes import scene

from crashhunt.analysis import _driver_runs
from crashhunt.crashes import DriverRun
from crashhunt.trial import Outcome

angles = st.floats(-math.pi, math.pi)
FOLLOWS = {"is_disputed": False, "same_way": True, "follower": "ego", "changers": ()}


@pytest.mark.parametrize(
    ("other", "contact", "aside", "why", "is_cut_in"),
    [
        ("car", {}, 0.0, "", False),
        ("car", {"changers": ("car",)}, 3.0, "", True),
        ("car", {"changers": ("car",), "follower": "third"}, 3.0, "", True),
        ("car", {"changers": ("car",)}, 2.0, "", False),  # it has never been outside the agent's path
        ("car", {}, 3.0, "", False),  # it was there, but the agent drove behind it
        ("person 1", {}, 0.0, "person 1 is a person", False),
        ("car", None, 0.0, "the scenes do not show the contact", False),
        ("car", {"is_disputed": True}, 0.0, "the scenes do not show the contact", False),
        ("car", {"same_way": False}, 0.0, "the two vehicles did not drive in the same direction", False),
        ("car", {"follower": "car"}, 0.0, "car drove into the back of ego", False),
        ("car", {"changers": ("ego", "car")}, 3.0, "ego changed lanes, and the models do not", False),
        ("car", {"follower": ""}, 3.0, "neither a rear-end collision nor a cut-in", False),
    ],
    ids=str,
)
def test_models_decide_rear_end_collisions_and_cut_ins(monkeypatch, other, contact, aside, why, is_cut_in):
    words = FOLLOWS | (contact or {})
    changers = words.pop("changers")
    record = SimpleNamespace(**words, lane_changers=lambda seconds: changers) if contact is not None else None
    places = [aside] * 5 + [0.0] * 5
    recording = SimpleNamespace(
        scenes=lambda: [scene(("ego", k, 0, 0, 10), (other, k + 20, y, 0, 10)) for k, y in enumerate(places)],
        prologue=SimpleNamespace(step_length_s=0.1),
    )
    hit = SimpleNamespace(collision=SimpleNamespace(agent="ego", other=other))
    rerun = SimpleNamespace(bundle=SimpleNamespace(result=hit), recorded=recording)
    records = {(id(rerun.bundle), id(recording)): record}
    monkeypatch.setattr(_driver_runs, "contact_record", lambda bundle, of: records[id(bundle), id(of)])
    found, cut_in = _driver_runs._applies(rerun)
    assert found.startswith(why)
    assert bool(found) is bool(why)
    assert cut_in is is_cut_in


@given(angles, st.floats(20, 200), st.floats(-1, 1), st.floats(-4, 4), st.floats(-1e3, 1e3))
def test_vehicle_is_outside_the_path_beyond_half_of_both_widths_on_any_circle(angle, radius, arc, aside, x):
    """Across the heading halfway, a point of a circle is aside * cos(arc / 2) from one on a circle around it."""
    assume(abs(abs(aside) * math.cos(arc / 2) - 2.0) > 1e-6)

    def on_circle(name, at, of_radius):
        heading = at + math.pi / 2
        front = (of_radius * math.cos(at) + 2.5 * math.cos(heading), of_radius * math.sin(at) + 2.5 * math.sin(heading))
        return name, x + front[0], front[1], math.remainder(heading, math.tau), 10

    def was(steps_ago):
        meets = scene(on_circle("ego", angle, radius), on_circle("car", angle + arc, radius + aside))
        behind = scene(on_circle("ego", angle, radius), on_circle("car", angle + 0.1, radius))
        scenes = [behind, meets, *[behind, scene(on_circle("ego", angle, radius))] * (steps_ago // 2)]
        recording = SimpleNamespace(scenes=lambda: scenes, prologue=SimpleNamespace(step_length_s=1.0))
        return _driver_runs._was_in_other_lane(recording, "ego", "car")

    assert was(8) is (abs(aside) * math.cos(arc / 2) > 2.0)
    assert not was(10)  # more than 10 s ago


def seen(gap_m, closing_mps, **more):
    """What a run reports of a model that perceived a risk after step 7."""
    end = {"last_gap_m": gap_m, "last_closing_mps": closing_mps, "least_gap_m": 1.5}
    return {"first": 7, "gap_m": 20.0, "speed_mps": 12.0, "actor_speed_mps": 8.0, **end, **more}


@pytest.mark.parametrize(
    ("ending", "outcome", "report", "prevented", "why_not"),
    [
        ("avoided", Outcome.SURVIVED, seen(9.0, 9.0), True, ""),
        ("avoided", Outcome.SURVIVED, seen(9.0, 9.0, in_junction=True), None, "the paths of both vehicles meet in a"),
        ("avoided", Outcome.SURVIVED, {}, None, "the model perceived no risk"),
        ("hit", Outcome.COLLISION, seen(0.0, 9.0), False, ""),
        ("unclear", Outcome.SURVIVED, seen(8.0, 4.0), True, ""),  # 1 m/s² suffices: 4² / (2 * 8)
        ("unclear", Outcome.FINISHED, seen(8.0, -9.0), True, ""),  # it falls back
        ("unclear", Outcome.SURVIVED, seen(7.9, 4.0), None, "the run ends before the outcome is clear"),
        ("unclear", Outcome.SURVIVED, seen(0.0, 0.0), None, "the run ends before the outcome is clear"),
        ("unclear", Outcome.OFF_ROAD, seen(8.0, 0.0), None, "the run ends before the outcome is clear"),
        ("other", Outcome.COLLISION, seen(8.0, 0.0), None, "another crash follows"),
        ("diverged", Outcome.SURVIVED, seen(8.0, 0.0), None, "the trial was not bit-identical"),
        ("impossible", Outcome.SURVIVED, seen(8.0, 0.0), None, "the vehicle stops harder than any vehicle can"),
    ],
)
def test_model_prevents_a_collision_only_if_the_end_of_its_run_shows_it(
    monkeypatch, ending, outcome, report, prevented, why_not
):
    rerun = SimpleNamespace(bundle=SimpleNamespace(result="crash"), recorded="as recorded")
    result = SimpleNamespace(outcome=outcome, failure=None)
    known = {("crash", "as recorded", 3, id(result), "run"): ending}
    monkeypatch.setattr(_driver_runs, "ending_of", lambda was, of, since, now, run: known[was, of, since, id(now), run])
    found = _driver_runs._answer(rerun, "fsm", 3, SimpleNamespace(result=result, recording="run", responses=(report,)))
    facts = {"perceived_step": 7, "gap_m": 20.0, "speed_mps": 12.0, "other_speed_mps": 8.0} if report else {}
    assert found.why_not.startswith(why_not)
    assert bool(found.why_not) is bool(why_not)
    assert found == DriverRun(
        model="fsm", prevented=prevented, why_not=found.why_not, margin_m=1.5 if prevented else None, **facts
    )


@pytest.mark.parametrize(
    ("outcome", "failure", "recording", "responses", "why_not"),
    [
        (Outcome.INVALID, SimpleNamespace(message="no model"), "run", ({},), "no model"),
        (Outcome.INVALID, None, "run", ({},), "the trial cannot run"),
        (Outcome.SURVIVED, None, None, ({},), "the run reported nothing"),
        (Outcome.SURVIVED, None, "run", None, "the run reported nothing"),
    ],
)
def test_run_without_a_report_is_no_answer(outcome, failure, recording, responses, why_not):
    result = SimpleNamespace(outcome=outcome, failure=failure)
    ended = SimpleNamespace(result=result, recording=recording, responses=responses)
    assert _driver_runs._answer(None, "fsm", 3, ended) == DriverRun(model="fsm", why_not=why_not)
