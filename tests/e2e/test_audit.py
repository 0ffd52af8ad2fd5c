"""A sample of the trials without a crash is run again in fresh processes; a difference is told."""

from __future__ import annotations

import pytest

from crashhunt.episode import WorkerSettings, scratch_of
from crashhunt.hunts._audits import Audit
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.trial import KILLED, Failure, Outcome, TrialResult, TrialSpec

WORDS = ("run", "h", "2", "6", "20", "--scenario", "toy", "--seed", "4", "--json")


@pytest.mark.nightly  # by day, test_reused_programs.py has differences
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
    line = (
        f"trial {first['trial']} differs when replayed in a new process: at step {first['step']}, action[target_speed]"
    )
    assert line in done.err
    assert f"audit: {line}" in toy.crashhunt("logs", "h").out


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
