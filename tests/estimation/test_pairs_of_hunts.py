"""Which hunts can be compared trial by trial: those in which the same number is the same traffic."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from crashhunt.estimation._comparison import why_unpaired
from crashhunt.trial import Constant, Range

HUNT = {
    "rare": False, "seeds": 0, "trials": 100, "scenario_digest": "a", "disturb": (),
    "scenario_arguments": {"cars": Range(1, 9, integer=True)},
}  # fmt: skip


@pytest.mark.parametrize(
    ("one", "other", "reason"),
    [
        ({}, {}, ""),
        ({}, {"trials": 50}, ""),
        ({"seeds": 10}, {"seeds": 10}, ""),
        ({"seeds": 10, "trials": 10}, {"seeds": 10}, ""),
        ({"seeds": 10, "trials": 9}, {"seeds": 10}, "they have fewer trials than the 10 traffics"),
        ({"seeds": 10}, {"seeds": 10, "trials": 9}, "they have fewer trials than the 10 traffics"),
        ({"seeds": 10}, {}, "they have 10 traffics and one per trial (--seeds)"),
        ({"rare": True}, {"rare": True}, "they are in rare mode"),
        ({"rare": True}, {}, "one is in rare mode"),
        ({"scenario_digest": "b"}, {}, "they are of two scenarios"),
        ({"disturb": ("brake=0.1", "stop=0.1")}, {}, "they have the disturbances brake=0.1, stop=0.1 and no disturb"),
        ({"scenario_arguments": {}}, {}, "they do not try the same values of cars,"),
        ({"scenario_arguments": {"cars": Constant(3)}}, {}, "they do not try the same values of cars,"),
    ],
    ids=str,
)
def test_hunts_are_paired_if_the_same_number_is_the_same_traffic(one, other, reason):
    found = why_unpaired(SimpleNamespace(**HUNT | one), SimpleNamespace(**HUNT | other))
    assert found.startswith(reason)
    assert bool(found) == bool(reason)
