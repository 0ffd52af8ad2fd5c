"""A sample of the trials without a crash is run again in fresh processes; a difference is told."""

from __future__ import annotations

from crashhunt.episode import WorkerSettings, scratch_of
from crashhunt.hunts._audits import Audit
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.trial import KILLED, Failure, Outcome, TrialResult, TrialSpec


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
