"""The categories and the order of outcomes, and the outcomes that oracles add."""

from __future__ import annotations

import pickle

import pytest

from crashhunt.trial import CRASHES, EVENTS, Outcome, in_order, outcome_of

TRAFFIC, SOFTWARE = {"collision", "off_road"}, {"agent_error", "simulator_error", "process_died", "hang"}


def test_every_outcome_has_its_category():
    assert {str(one) for one in Outcome if one.is_traffic_crash} == TRAFFIC
    assert {str(one) for one in Outcome if one.is_software_fault} == SOFTWARE
    assert {str(one) for one in Outcome if one.category == "no crash"} == {"survived", "finished", "invalid"}
    events = {one for one in Outcome if one.is_traffic_event}
    assert events == set(Outcome) - {Outcome(name) for name in (*TRAFFIC, *SOFTWARE, "survived", "finished", "invalid")}
    assert set(EVENTS) == events
    assert {str(one) for one in CRASHES} == TRAFFIC | SOFTWARE


def test_outcome_of_an_oracle_keeps_its_name_and_category_in_other_processes():
    own = Outcome.own("too_close_a", "traffic crash")
    assert (own.value, own.name, str(own), own.is_own) == ("too_close_a", "TOO_CLOSE_A", "too_close_a", True)
    assert own.is_traffic_crash
    assert own not in list(Outcome)
    copy = pickle.loads(pickle.dumps(own))
    assert (copy, copy.category) == (own, "traffic crash")
    assert outcome_of({"outcome": "too_close_b", "category": "traffic crash"}).is_traffic_crash
    assert outcome_of({"outcome": "too_close_c"}).category == "traffic event"
    assert not Outcome.COLLISION.is_own
    assert pickle.loads(pickle.dumps(Outcome.COLLISION)) is Outcome.COLLISION


@pytest.mark.parametrize(
    ("name", "category"),
    [("collision", "traffic event"), ("Too close", "traffic crash"), ("too_close_d", "a crash"), ("", "traffic crash")],
)
def test_invalid_outcome_of_an_oracle_is_refused(name, category):
    with pytest.raises(ValueError, match=r"."):
        Outcome.own(name, category)


def test_outcomes_are_in_the_order_of_the_enumeration_and_own_ones_last():
    own = Outcome.own("too_close_e", "traffic event")
    given = [str(own), "hang", "survived", "collision"]
    assert [str(one) for one in in_order(given)] == ["survived", "collision", "hang", "too_close_e"]
