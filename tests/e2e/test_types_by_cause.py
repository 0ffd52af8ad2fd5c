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


@pytest.mark.nightly
def test_hunt_ends_and_keeps_by_cause(toy):
    trials = ("200", "--scenario", "toy", "--arg", "speed=12:16", "--seed", "1")
    report = toy.crashhunt(
        "run", "h", "2", "12", *trials, "--keep-going", "--keep", "1", "--by-cause", "2", "--json"
    ).json
    assert report["types_by_cause"] == 1
    assert sum(kind["count"] for kind in report["kinds"]) > len(report["crashes"]) == 1
    (group,) = toy.crashhunt("crashes", "h", "--by-cause", "--json").json["groups"]
    assert [part["cause"]["what"] for part in group["causes"]] == ["ego.speed"]
    assert len(group["causes"][0]["judged"]) == 1  # the bundle that stayed is one with the runs
    said = toy.crashhunt("run", "d", "2", "60", *trials, "--distinct", "1", "--by-cause", "2").out
    assert "Found 1 crash type, 1 by cause (--distinct 1)." in said
