"""Whole hunts on the toy, in the process of the test: what they record, keep, confirm and report."""

from __future__ import annotations

import errno
import json
import os
import sys
from contextlib import closing
from dataclasses import replace

import pytest
from made_up_trials import leave_own_code_out
from test_hunt_loop import TOY

import crashhunt
from crashhunt.base.errors import InternalError
from crashhunt.crashes import list_bundles, list_near_misses
from crashhunt.errors import HuntDirectoryError, UsageError
from crashhunt.hunts import check
from crashhunt.ledger import Ledger
from crashhunt.results import hunt_state
from crashhunt.statistics import measure_rates

OPTIONS = {"scenario": "toy.toml", "seed": 4, "snapshot_code": False}


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    (tmp_path / "toy.toml").write_text(TOY)
    monkeypatch.chdir(tmp_path)
    leave_own_code_out(monkeypatch)


def rows(hunt):
    with closing(Ledger(hunt / "ledger.sqlite")) as ledger:
        return {one.spec.number: (str(one.outcome), one.digest) for one in ledger.results()}


@pytest.mark.long
def test_a_hunt_records_confirms_audits_and_keeps_near_misses(tmp_path):
    hunt, seen = tmp_path / "h", []
    options = OPTIONS | {"keep_going": True, "near_misses": 2, "audit": 1.0, "keep": 1}
    report = crashhunt.run(hunt, 2, 5, 60, watch=seen.append, **options)
    found = rows(hunt)
    crashed = [number for number, (outcome, _) in found.items() if outcome == "collision"]
    fine = [number for number in found if number not in crashed]
    assert sorted(found) == list(range(5))
    assert len(crashed) >= 2
    assert len(fine) >= 2
    assert (report.stopped_because, report.directory) == ("all_trials", hunt)
    assert report.outcomes == {"collision": len(crashed), "survived": len(fine)}
    assert (report.audit.trials, report.audit.differences, report.audit.not_finished) == (len(fine), (), 0)
    # Of one kind of crashes, the shortest is kept, and it has been confirmed.
    (kind,) = report.kinds
    (kept,) = report.crashes
    assert kind.count == len(crashed)
    assert kept.confirmed
    with closing(Ledger(hunt / "ledger.sqlite")) as ledger:
        steps = {one.spec.number: one.steps for one in ledger.results()}
        assert ledger.most_dangerous(2) == [bundle.result.spec.number for bundle in report.near_misses]
        assert report.trial_steps == sum(steps.values()) == ledger.trial_steps()
        assert report.steps_total == ledger.steps_total() >= report.trial_steps
        (dropped,) = ledger.facts()["dropped"].values()
    assert kept.result.steps == min(steps[number] for number in crashed)
    assert sorted([*dropped, kept.result.spec.number]) == crashed
    assert [bundle.confirmed for bundle in report.near_misses] == [True, True]
    assert list_near_misses(hunt) == list(report.near_misses)
    assert {status.phase for status in seen} >= {"hunting", "done"}
    audits = [status.progress for status in seen if status.phase == "auditing"]  # none if the last trial has left none
    assert all(one.total <= len(fine) for one in audits)
    assert not audits or audits[0].done == 0 < audits[-1].done == audits[-1].total
    assert (seen[-1].done, seen[-1].planned, seen[-1].crashes) == (5, 5, len(crashed))
    data = report.to_json()
    assert data["crashes_found"] == len(crashed) > len(list_bundles(hunt))
    assert json.loads(json.dumps(data)) == data
    assert data["trials_run"] == data["trials_planned"] == 5
    assert [one["id"] for one in data["crashes"]] == [kept.id]
    assert len(data["near_misses"]) == 2
    assert data["audit"] == {"trials": len(fine), "not_finished": 0, "differences": []}
    (checked,) = check(hunt)
    assert checked.fine
    assert {path.name for path in hunt.glob(".*")} <= {".lock"}
    assert not (hunt / "trials").exists()  # nothing is kept of what was audited

    # The same command runs nothing again; more trials are added to those that are there.
    again = crashhunt.run(hunt, 2, 5, 60, **options)
    assert (again.outcomes, again.steps_total) == (report.outcomes, report.steps_total)
    assert "replanned" not in facts_of(hunt)
    more = crashhunt.run(hunt, 1, 6, 60, **options)
    assert facts_of(hunt)["replanned"] is True  # which forbids a p-value
    assert sum(more.outcomes.values()) == 6
    assert {number: rows(hunt)[number] for number in range(5)} == found
    state, (rate,) = hunt_state(hunt), measure_rates(hunt, per="trial")
    assert state.rate["certain"] == rate.to_json()["certain"]  # over all trials, also those of earlier runs
    assert (state.rate["trials"], state.rate["crashes"]) == (6, state.crashes)
    fewer = crashhunt.run(hunt, 1, 4, 60, **options)
    assert (sum(fewer.outcomes.values()), hunt_state(hunt).trials_planned) == (6, 4)
    for other in ({"seed": 5}, {"sampler": "sobol"}):
        with pytest.raises((HuntDirectoryError, UsageError)):
            crashhunt.run(hunt, 2, 5, 60, **options | other)
    anew = crashhunt.run(hunt, 2, 1, 60, overwrite=True, **OPTIONS)
    assert sum(anew.outcomes.values()) == 1
    assert rows(hunt) == {0: found[0]}


def facts_of(hunt):
    with closing(Ledger(hunt / "ledger.sqlite")) as ledger:
        return ledger.facts()


@pytest.mark.long
@pytest.mark.nightly
def test_a_hunt_ends_with_its_first_crash_and_does_not_depend_on_how_many_run_at_a_time(tmp_path, monkeypatch, capfd):
    # Hunting from a script without a guard: if a worker imported it again, this would run there.
    (tmp_path / "script.py").write_text(f"print('again')\nopen({str(tmp_path / 'again')!r}, 'w')\n")
    monkeypatch.setattr(sys.modules["__main__"], "__file__", str(tmp_path / "script.py"), raising=False)
    monkeypatch.setattr(sys.modules["__main__"], "__spec__", None)
    found = {}
    for parallel in (1, 3):
        hunt = tmp_path / f"h{parallel}"
        report = crashhunt.run(hunt, parallel, 30, 60, deterministic=True, **OPTIONS)
        assert report.stopped_because == "crash"
        crash = min(report.crashes, key=lambda bundle: bundle.result.spec.number)
        assert crash.confirmed
        number = crash.result.spec.number
        assert set(range(number + 1)) <= rows(hunt).keys()
        assert all(rows(hunt)[before][0] == "survived" for before in range(number))
        assert hunt_state(hunt).state == "crashed"
        again = crashhunt.run(hunt, parallel, 30, 60, deterministic=True, **OPTIONS)  # states again what it found
        assert [(one.id, one.confirmed) for one in again.crashes] == [(one.id, True) for one in report.crashes]
        assert (again.stopped_because, again.outcomes) == ("crash", report.outcomes)
        found[parallel] = number, crash.result.digest, [rows(hunt)[before] for before in range(number)]
        assert (report.kinds, report.audit, report.to_json()["audit"]) == (None, None, None)
        assert "kinds" not in report.to_json()
    assert found[1] == found[3]
    assert capfd.readouterr() == ("", "")
    assert not (tmp_path / "again").exists()


@pytest.mark.parametrize(
    ("number", "kind", "says"),
    [
        (errno.ENOSPC, HuntDirectoryError, "No space left on device; free some space"),
        (errno.EPIPE, InternalError, "crashhunt itself failed: BrokenPipeError: .*Broken pipe; report it"),
    ],
)
def test_only_an_error_of_the_disk_is_blamed_on_the_disk(tmp_path, monkeypatch, number, kind, says):
    def fail(*_, **__):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("crashhunt.base.reaper.subprocess.Popen", fail)  # of the thread of the pool
    with pytest.raises(kind, match=says) as caught:
        crashhunt.run(tmp_path / "h", 1, 2, 20, **OPTIONS)
    state = hunt_state(tmp_path / "h")
    assert state.state == "error"
    assert os.strerror(number) in state.detail
    if kind is InternalError:
        assert "in fail" in caught.value.traceback


def test_a_hunt_whose_watcher_fails_records_why_it_ended(tmp_path):
    def watch(status):
        raise RuntimeError("the screen is gone")

    with pytest.raises(RuntimeError, match="the screen is gone"):
        crashhunt.run(tmp_path / "h", 1, 3, 60, watch=watch, **OPTIONS)
    state = hunt_state(tmp_path / "h")
    assert (state.state, state.detail, state.damaged) == ("error", "RuntimeError: the screen is gone", False)


@pytest.mark.nightly
@pytest.mark.parametrize(
    "options",
    [
        {"until_rate": "0.3/trial", "most": 40},
        {"trials": 20, "rare": True, "disturb": ["brake=0.02"], "arguments": {"speed": 9.0}},
    ],
    ids=["until a rate", "rare"],
)
def test_full_disk_under_a_hunt_for_a_rate_changes_no_number(tmp_path, monkeypatch, options):
    words = {"trials": 0, "max_steps": 60, "keep_going": True, "keep": 1, **OPTIONS, **options}
    whole = crashhunt.run(tmp_path / "whole", 1, **words)
    recorded = 0
    record = Ledger.record

    def fill(ledger, result, *, snapshot):
        nonlocal recorded
        recorded += 1
        if recorded > 4:
            ledger._database.execute("PRAGMA max_page_count = 1")  # SQLite makes it the present size of the file
        record(ledger, result, snapshot=snapshot)

    with monkeypatch.context() as patch:
        patch.setattr(Ledger, "record", fill)
        with pytest.raises(
            HuntDirectoryError, match=r"the disk is full \(.*\); free some space and run the same"
        ) as caught:
            crashhunt.run(tmp_path / "h", 1, **words)
    assert "\n" not in str(caught.value)
    state = hunt_state(tmp_path / "h")
    assert (state.state, state.damaged) == ("error", False)
    assert 4 <= state.trials_run < sum(whole.outcomes.values())
    (checked,) = check(tmp_path / "h")
    assert checked.fine
    resumed = crashhunt.run(tmp_path / "h", 1, **words)
    assert rows(tmp_path / "h") == rows(tmp_path / "whole")
    assert resumed.outcomes == whole.outcomes
    if whole.rate is not None:
        assert resumed.rate == replace(whole.rate, dir=str(tmp_path / "h"))
    if whole.rare is not None:
        assert resumed.rare.estimate == whole.rare.estimate
