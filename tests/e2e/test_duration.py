"""Hunts that end by the clock."""

from __future__ import annotations

import json
import time

import pytest

from crashhunt.errors import UsageError
from crashhunt.ledger import Ledger
from crashhunt.plans import Request

HUNT = ("--no-snapshot", "--scenario", "toy", "--seed", "4", "--arg", "speed=1", "--set", "step_wall_s=0.001")


def test_a_hunt_ends_by_the_clock_and_continues_with_a_clock_of_its_own(toy):
    first = toy.crashhunt("run", "h", "1", "0", "20", *HUNT, "--for", "0.3s", "--json")
    assert first.json["stopped_because"] == "time"
    assert first.json["trials_planned"] == 0
    assert 2 <= (ran := first.json["trials_run"]) < 100
    assert f"{ran} trials, " in first.err
    assert "No crash was found within the time limit." in first.err
    (found,) = toy.crashhunt("status", "h", "--json").json["hunts"]
    assert (found["state"], found["trials_planned"], found["seconds_left"]) == ("finished", 0, None)
    assert f" {ran} " in toy.crashhunt("status", "h").out
    assert 'duration = "0.3s"' in (toy.folder / "h/hunt.toml").read_text()
    again = toy.crashhunt("run", "h", "1", "0", "20", *HUNT, "--for", "0.3s", "--json")
    assert again.json["trials_run"] > ran + 1
    rows = [json.loads(line) for line in toy.crashhunt("trials", "h", "--format", "jsonl").out.splitlines()]
    assert [row["number"] for row in rows] == list(range(again.json["trials_run"]))
    assert {row["outcome"] for row in rows} == {"survived"}


def test_trials_that_have_all_ended_are_all_trials(toy):
    done = toy.crashhunt("run", "h", "1", "2", "5", *HUNT, "--for", "1h", "--json")
    assert (done.json["stopped_because"], done.json["trials_run"]) == ("all_trials", 2)
    ledger = Ledger(toy.folder / "h/ledger.sqlite")
    assert 3500 < ledger.facts()["until"] - time.time() <= 3600
    ledger.close()


def test_no_limit_at_all_is_refused():
    with pytest.raises(UsageError, match=r"TRIALS is 0; give at least 1, or 0 \(no limit\) with --for or --until-rate"):
        Request(trials=0, max_steps=1).checked()
    assert Request(trials=0, max_steps=1, duration="1s").checked().trials == 0
