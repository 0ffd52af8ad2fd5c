"""Which collisions the models of a competent driver decide."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from scenes import scene

from crashhunt.analysis import _driver_runs

FOLLOWS = {"is_disputed": False, "same_way": True, "follower": "ego", "changers": ()}


@pytest.mark.parametrize(
    ("other", "contact", "aside", "why", "is_cut_in"),
    [
        ("car", {}, 0.0, "", False),
        ("car", {"changers": ("car",)}, 3.0, "", True),
        ("car", {"changers": ("car",), "follower": "third"}, 3.0, "", True),
        ("car", {"changers": ("car",)}, 1.9, "", False),  # it has never been outside the agent's path
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
    monkeypatch.setattr(_driver_runs, "contact_record", lambda bundle, recording: record)
    places = [aside] * 5 + [0.0] * 5
    recording = SimpleNamespace(
        scenes=lambda: [scene(("ego", k, 0, 0, 10), (other, k + 20, y, 0, 10)) for k, y in enumerate(places)],
        prologue=SimpleNamespace(step_length_s=0.1),
    )
    hit = SimpleNamespace(collision=SimpleNamespace(agent="ego", other=other))
    rerun = SimpleNamespace(bundle=SimpleNamespace(result=hit), recorded=recording)
    found, cut_in = _driver_runs._applies(rerun)
    assert found.startswith(why)
    assert bool(found) is bool(why)
    assert cut_in is is_cut_in


@pytest.mark.parametrize(
    ("x", "y", "heading", "outside"),
    [(20, 2.1, 0, True), (20, -2.1, 0, True), (20, 1.9, 0, False), (20, 4, 0.4, False), (20, -4, 0.4, True)],
)
def test_vehicle_is_outside_the_path_beyond_half_of_both_widths_also_in_a_bend(x, y, heading, outside):
    def was(steps_ago, step_s=0.1):
        elsewhere = [scene(("ego", 0, 0, 0, 10), ("car", 20, 0, 0, 10)), scene(("ego", 0, 0, 0, 10))]
        scenes = [*elsewhere, scene(("ego", 0, 0, 0, 10), ("car", x, y, heading, 10)), *elsewhere * (steps_ago // 2)]
        recording = SimpleNamespace(scenes=lambda: scenes, prologue=SimpleNamespace(step_length_s=step_s))
        return _driver_runs._was_in_other_lane(recording, "ego", "car")

    assert was(98) is outside
    assert not was(100)  # more than 10 s ago
