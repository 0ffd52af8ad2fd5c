"""A sample of the trials without a crash is run again in fresh processes; a difference is told."""

from __future__ import annotations

import json
import signal
import sqlite3
import time
from contextlib import closing

import pytest

from crashhunt.base.integrity import digest_of_row
from crashhunt.episode import WorkerSettings, scratch_of
from crashhunt.hunts._verification import Audit
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.trial import KILLED, Failure, Outcome, TrialResult, TrialSpec

WORDS = ("run", "h", "2", "6", "20", "--scenario", "toy", "--seed", "4", "--json")


@pytest.mark.nightly  # by day, hunts/test_whole_hunts.py and report/test_result_texts.py
def test_trials_that_are_the_same_are_said_to_be(toy):
    done = toy.crashhunt(*WORDS, "--arg", "speed=5", "--audit", "0.5")
    audit = done.json["audit"]
    assert audit["differences"] == []
    assert 0 < audit["trials"] < 6
    assert f"Audit: {audit['trials']} replayed in new processes, {audit['trials']} bit-identical." in done.err
    assert not (toy.folder / "h" / "trials").exists()
    again = toy.crashhunt(*WORDS, "--arg", "speed=5", "--audit", "0.5", "--overwrite").json["audit"]
    assert again == audit  # which are chosen depends on the seed only


def test_a_difference_is_reported_with_the_first_step_and_field(toy):
    done = toy.crashhunt(*WORDS, "--agent", "faulty:Remembers", "--audit", "1")
    audit = done.json["audit"]
    assert audit["trials"] == 6
    assert audit["differences"]
    for found in audit["differences"]:
        assert found["step"] <= 3
        assert (found["agent"], found["field"]) == ("ego", "action[target_speed]")
        assert found["recorded"] < found["replayed"]
    others = done.json["steps_total"] - 6 * 20  # of runs that ended otherwise, which are as long
    assert others == 20 * len(audit["differences"])
    first = audit["differences"][0]
    line = f"trial {first['trial']} is another one in a fresh process: at step {first['step']}, action[target_speed]"
    assert line in done.err
    assert f"audit: {line}" in toy.crashhunt("logs", "h").out


@pytest.mark.nightly  # by day, hunts/test_whole_hunts.py
def test_no_one_pays_who_does_not_ask(toy):
    assert toy.crashhunt(*WORDS, "--arg", "speed=5").json["audit"] is None


@pytest.mark.parametrize("share", ["-0.1", "1.5", "nan"])
def test_a_share_that_cannot_be_meant_is_refused(toy, share):
    done = toy.crashhunt(*WORDS, f"--audit={share}", expect=2)
    assert f"--audit is {float(share):g}" in done.json["error"]["message"]


def left(toy):
    with closing(sqlite3.connect(toy.folder / "h" / "ledger.sqlite")) as ledger:
        rows = dict(ledger.execute("SELECT key, value FROM hunt WHERE key IN ('audits_left', 'state')"))
    return json.loads(rows.get("audits_left", "[]"))


@pytest.mark.nightly  # by day, hunts/test_verified_runs.py makes up for them
@pytest.mark.parametrize("how", [signal.SIGINT, pytest.param(signal.SIGKILL, marks=pytest.mark.nightly)])
def test_audits_of_a_hunt_that_was_stopped_are_made_up_for_when_it_is_resumed(toy, how):
    words = ("run", "h", "1", "6", "20", "--scenario", "toy", "--seed", "4", "--json", "--arg", "speed=5")
    words = (*words, "--set", "step_wall_s=0.001", "--audit", "0.5")
    settings = WorkerSettings(
        scenario=Scenario(simulator="toy"), oracles=(), crash_on=(), scratch=toy.folder, audit=0.5, hunt_seed=4
    )
    ended = [TrialResult(TrialSpec(number, 1, {}, {}, 9), Outcome.SURVIVED) for number in range(6)]
    sample = sum(map(settings.is_audited, ended))
    process = toy.start(*words)
    deadline = time.monotonic() + 300
    while len(list((toy.folder / "h").glob(".scratch-*/audit/recorded-*"))) < 2:
        assert time.monotonic() < deadline, "no trial waits for its audit"
        time.sleep(0.002)
    process.send_signal(how)
    out, _ = process.communicate(timeout=300)
    if how == signal.SIGINT:
        audit = json.loads(out)["audit"]
        assert audit["not_finished"] == len(left(toy)) > 0
    done = toy.crashhunt(*words)
    audit = done.json["audit"]
    assert (audit["differences"], audit["not_finished"]) == ([], 0)
    assert left(toy) == []
    if how == signal.SIGINT:
        assert audit["trials"] + json.loads(out)["audit"]["trials"] == sample
    else:
        assert 0 < audit["trials"] <= sample
    assert done.json["trials_run"] == 6


@pytest.mark.nightly  # by day, hunts/test_verified_runs.py and hunts/test_hunt_parts.py
def test_audit_left_over_of_a_trial_that_differs_is_reported_without_a_step(toy):
    toy.crashhunt(*WORDS, "--agent", "faulty:Remembers", "--audit", "1e-9")
    with closing(sqlite3.connect(toy.folder / "h" / "ledger.sqlite")) as ledger, ledger:
        row = ("audits_left", "[5]")
        ledger.execute("INSERT INTO hunt VALUES (?, ?, ?)", (*row, digest_of_row(row)))
        ledger.execute("DELETE FROM hunt WHERE key = 'seal'")
    done = toy.crashhunt(*WORDS, "--agent", "faulty:Remembers", "--audit", "1e-9")
    (found,) = done.json["audit"]["differences"]
    assert (found["trial"], found["step"], found["field"]) == (5, None, "the digest")
    assert f"trial 5 is another one in a fresh process: the digest was {found['recorded']} and is" in done.err
    assert left(toy) == []


def test_audit_that_is_killed_from_outside_is_no_difference(tmp_path, monkeypatch):
    settings = WorkerSettings(
        scenario=Scenario(simulator="toy", agents={"ego": AgentSetup()}), oracles=(), crash_on=(), scratch=tmp_path,
        audit=1.0, hunt_seed=1,
    )  # fmt: skip
    failed = []
    audit = Audit(settings, failed)
    spec = TrialSpec(3, 1, {}, {}, 9)
    killed = TrialResult(spec, Outcome.INVALID, failure=Failure(KILLED, "killed from outside 3 times"))
    monkeypatch.setattr(audit._executor, "submit", lambda _spec: None)
    monkeypatch.setattr(audit._executor, "completed", lambda _timeout_s: iter([killed]))
    folder = scratch_of(tmp_path, 3)
    folder.mkdir()
    (folder / "blackbox.bin").write_bytes(b"")
    audit.add(TrialResult(spec, Outcome.SURVIVED, digest="1"))
    assert audit.look() == []
    assert (audit.waiting, audit.left, failed) == (0, [3], [])
    assert audit.report.to_json() == {"trials": 0, "not_finished": 1, "differences": []}
    assert [*audit._scratch.iterdir()] == []
