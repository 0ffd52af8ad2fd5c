"""Crash types by cause, on the command line."""

from __future__ import annotations

import pytest


@pytest.mark.nightly
def test_types_are_divided_by_cause_and_the_runs_are_kept(toy):
    toy.crashhunt(
        "run", "h", "2", "6", "200", "--scenario", "toy", "--arg", "speed=12:16", "--seed", "1", "--keep-going"
    )
    (group,) = toy.crashhunt("crashes", "h", "--by-cause", "1", "--json").json["groups"]
    (part,) = group["causes"]
    assert (part["count"], part["members"]) == (group["count"], group["members"])
    assert (part["cause"]["kind"], part["cause"]["what"]) == ("argument", "ego.speed")  # at its default it is safe
    assert len(part["judged"]) == 1
    said = toy.crashhunt("crashes", "h", "--by-cause", "1").out
    assert "argument: ego.speed" in said
    assert "causes" not in toy.crashhunt("crashes", "h", "--json").json["groups"][0]
    assert "--by-cause is -5" in toy.crashhunt("crashes", "h", "--by-cause", "-5", expect=2).err
