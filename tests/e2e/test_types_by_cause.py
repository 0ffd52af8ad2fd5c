"""Crash types by cause, on the command line."""

from __future__ import annotations

import pytest


@pytest.mark.nightly
def test_types_are_divided_by_cause_and_the_runs_are_kept(toy):
    toy.crashhunt(
        "run", "h", "2", "6", "200", "--scenario", "toy", "--arg", "speed=12:16", "--seed", "1", "--keep-going"
    )
    found = toy.crashhunt("crashes", "h", "--by-cause", "1", "--json").json
    (group,), (joined,) = found["groups"], found["by_cause"]
    (part,) = group["causes"]
    assert (joined["cause"], joined["count"], joined["shortest"]) == (part["cause"], part["count"], part["shortest"])
    assert joined["types"] == [{"words": group["words"], "count": group["count"], "judged": 1}]
    assert (part["count"], part["members"]) == (group["count"], group["members"])
    assert (part["cause"]["kind"], part["cause"]["what"]) == ("argument", "ego.speed")  # at its default it is safe
    assert len(part["judged"]) == 1
    said = toy.crashhunt("crashes", "h", "--by-cause", "1").out
    assert "argument: ego.speed" in said
    assert "1 type by cause:" in said
    plain = toy.crashhunt("crashes", "h", "--json").json
    assert "by_cause" not in plain
    assert "causes" not in plain["groups"][0]
