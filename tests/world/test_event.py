"""Traffic events, as JSON and in words."""

from __future__ import annotations

import json
import math

from crashhunt.world import EVENT_WORDS, LIMITS, Event, event_counts


def test_an_event_is_given_back_by_its_json():
    event = Event("red_light", "ego", "ego ran 'c'", ("a", "b"), "x_0", 1.5, -2.5, 3.5)
    data = json.loads(json.dumps(event.to_json(), allow_nan=False))
    assert (data["others"], data["x"], data["speed"]) == (["a", "b"], 1.5, 3.5)
    assert Event.from_json(data) == event
    unknown = Event("teleport", "ego", "gone")
    data = unknown.to_json()
    assert (data["x"], data["y"], data["speed"], data["lane"]) == (None, None, None, "")
    assert repr(Event.from_json(data)) == repr(unknown)
    assert Event.from_json({**event.to_json(), "later": 1}) == event
    assert Event.from_json({"kind": "teleport", "agent": "ego", "what": "gone"}).others == ()


def test_limits_have_a_value_and_a_unit():
    assert LIMITS["not_moving"] == (60.0, "s")
    value, unit = LIMITS["hard_braking"]
    assert math.isnan(value)
    assert unit == "m/s²"


def test_counts_in_words():
    assert event_counts({"red_light": 2, "teleport": 1, "off_route": 0}) == "2 red lights run, 1 teleport"
    assert event_counts({"own": 3}) == "3 own"
    assert event_counts({}) == ""
    assert [event_counts({kind: 1}) for kind in EVENT_WORDS] == [
        "1 red light run", "1 wrong-way drive", "1 route missed", "1 scheduled stop missed", "1 long standstill",
        "1 collision of others",
        "1 hard braking of another", "1 teleport", "1 stop sign run", "1 drive over a kerb",
    ]  # fmt: skip
    assert [event_counts({kind: 2}) for kind in EVENT_WORDS] == [
        "2 red lights run", "2 wrong-way drives", "2 routes missed", "2 scheduled stops missed", "2 long standstills",
        "2 collisions of others",
        "2 hard brakings of others", "2 teleports", "2 stop signs run", "2 drives over a kerb",
    ]  # fmt: skip
