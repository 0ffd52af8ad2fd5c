"""What a hunt says about itself: its state on disk, the figures while it runs, and the report at its end."""

from __future__ import annotations

import json
import shutil
import sqlite3
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

import crashhunt
from crashhunt.base import layout
from crashhunt.errors import CrashhuntError, HuntDirectoryError
from crashhunt.hunts import _hunt, check, salvage
from crashhunt.hunts._next_trials import Unanswered, find_unanswered
from crashhunt.hunts._progress import Progress
from crashhunt.ledger import Ledger
from crashhunt.plans import RunSettings
from crashhunt.results import find_hunts, find_searches, hunt_state, is_hunt, load
from crashhunt.results._hunt_state import draws_independently, sums_of_branches, sums_of_probes
from crashhunt.statistics import CountingRule, RateWatch
from crashhunt.trial import KILLED, Branches, Disturbance, Failure, Outcome, Stress, TrialResult, TrialSpec

FROZEN = Path(__file__).parents[1] / "e2e" / "frozen" / "version-1" / "hunt"


@pytest.fixture
def hunt(tmp_path):
    """A hunt of four trials on the toy, of which 0 and 2 crashed."""
    return Path(shutil.copytree(FROZEN, tmp_path / "h"))


def note(hunt, **facts):
    with closing(Ledger(hunt / "ledger.sqlite", writable=True)) as ledger:
        ledger.note(**facts)


def spec(number):
    return TrialSpec(number, 1, {"ego": {"speed": 1.0}}, {}, 20)


def result(number, outcome=Outcome.SURVIVED, **more):
    return TrialResult(spec(number), outcome, steps=5, digest=f"{number:032x}", **more)


@pytest.mark.parametrize(
    ("said", "state"),
    [
        ("crash", "crashed"), ("distinct", "crashed"), ("all_trials", "crashed"), ("time", "crashed"),
        ("no_valid_trial", "error"), ("error", "error"), ("interrupted", "interrupted"), ("queued", "queued"),
        ("something later", "error"), ("running", "killed"),
    ],
)  # fmt: skip
def test_how_a_hunt_ended_is_its_state(hunt, said, state):
    note(hunt, state=said, detail="why", owner=None)
    found = hunt_state(hunt)
    assert found.state == state
    assert found.detail == "why"
    note(hunt, state=said, detail=None)
    assert hunt_state(hunt).detail == ("its process is gone" if state == "killed" else "")
    assert found.failed is (state in ("error", "interrupted", "killed"))
    assert (found.trials_planned, found.trials_run, found.crashes, found.errors) == (4, 4, 2, 0)
    shutil.rmtree(hunt / "crashes")
    found = hunt_state(hunt)
    assert (found.state, found.crashes, found.crashes_saved) == (state, 2, 0)  # counts are over all trials


def test_what_not_every_hunt_has_is_in_its_json_only_where_it_has_it(hunt):
    plain = hunt_state(hunt).to_json()
    assert plain["dir"] == str(hunt)
    assert {"disturbed", "core", "nodes", "probes", "branches", "kinds", "newest_kind_s"}.isdisjoint(plain)
    kind = {"words": "w", "count": 2, "first": "a", "shortest": "b"}
    note(hunt, disturb=["brake=0.1"], core="used", kinds=[kind], newest_kind=time.time() - 30, types_by_cause=3)
    more = hunt_state(hunt).to_json()
    assert more.keys() - plain.keys() == {"disturbed", "core", "kinds", "newest_kind_s", "types_by_cause"}
    assert more["types_by_cause"] == 3
    assert (more["disturbed"], more["core"], more["kinds"]) == (0, "used", [kind])
    assert more["newest_kind_s"] == 0.0  # its clock has ended with its last trial, before this time


def test_hunt_that_fails_before_its_first_trial_has_the_facts_of_a_hunt_that_ran(tmp_path, monkeypatch):
    def fail(*_, **__):
        raise CrashhuntError("no worker can be started")

    monkeypatch.setattr(_hunt, "make_executor", fail)
    monkeypatch.chdir(tmp_path)
    Path("toy.toml").write_text('title = "A toy"\nschema = 1\nsimulator = "toy"\n[agents.ego]\n')
    with pytest.raises(CrashhuntError, match="no worker"):
        crashhunt.run(
            tmp_path / "h",
            1,
            3,
            9,
            scenario="toy.toml",
            agent="crashhunt.agents:KeepLaneWithSpeed",
            seed=4,
            keep_going=True,
            snapshot_code=False,
        )
    found = hunt_state(tmp_path / "h")
    assert (found.state, found.detail, found.kinds) == ("error", "no worker can be started", [])
    assert found.rate["why_not"] == "no valid trial has finished"
    assert found.to_json()["newest_kind_s"] is None


def test_a_hunt_that_is_planned_is_queued_and_one_without_its_ledger_is_damaged(hunt, tmp_path):
    planned = tmp_path / "p"
    planned.mkdir()
    assert not is_hunt(planned)
    with pytest.raises(HuntDirectoryError, match="there is no hunt in"):
        find_hunts(planned)
    (planned / "request.json").write_text(json.dumps({"request": {"trials": 7}}))
    assert is_hunt(planned)
    found = hunt_state(planned)
    assert (found.state, found.trials_planned, found.damaged) == ("queued", 7, False)
    (planned / "request.json").write_text("{}")
    assert hunt_state(planned).trials_planned == 0
    (hunt / "ledger.sqlite").unlink()
    found = hunt_state(hunt)
    assert (found.state, found.damaged) == ("error", True)
    assert "it is missing, or empty" in found.detail
    (hunt / "ledger.sqlite").write_bytes(b"no database" * 99)
    assert (hunt_state(hunt).state, hunt_state(hunt).damaged) == ("error", True)
    with pytest.raises(HuntDirectoryError, match="does not exist"):
        hunt_state(tmp_path / "nowhere")


def test_hunts_of_a_suite_are_in_the_order_of_their_numbers(tmp_path):
    for name in ("a/10", "a/2", "b", "a/.hidden", f"a/2{layout.REPLACED}1", "c/d/e"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "hunt.toml").touch()
    found = [path.relative_to(tmp_path).as_posix() for path in find_hunts(tmp_path)]
    assert found == ["a/2", "a/10", "b"]  # one that was replaced or is hidden is none, nor what lies deeper


def test_cases_of_a_corpus_are_not_hunts(tmp_path):
    for name in ("hunt", "crashes/000003-collision-ed0ffe", "crashes/000003-collision-ed0ffe/snapshots/abc"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "hunt.toml").touch()
    (tmp_path / "crashes/000003-collision-ed0ffe" / layout.CASE).touch()
    assert find_searches(tmp_path) == [tmp_path / "hunt"]
    with pytest.raises(HuntDirectoryError, match="cases of a corpus, but no hunt; run crashhunt corpus list"):
        find_searches(tmp_path / "crashes")


def test_trials_are_independent_where_the_sampler_said_so(hunt):
    settings = load(hunt).settings
    assert draws_independently({}, settings)
    assert not draws_independently({}, replace(settings, sampler="guided"))
    assert draws_independently({"independent": True}, replace(settings, sampler="guided"))
    assert not draws_independently({"independent": False}, settings)
    assert not draws_independently({"independent": True}, replace(settings, seeds=3))


def test_a_status_sums_up_probes_and_how_many_of_their_crashes_were_confirmed(tmp_path):
    brake = Disturbance(20, "ahead", "brake", 4.0, 2.0, "ego")
    with closing(Ledger(tmp_path / "l.sqlite", writable=True)) as ledger:
        for number, margin, disturbance in ((0, 0.8, brake), (1, 0.3, brake), (2, 1.0, None), (3, None, None)):
            stress = Stress(margin=margin, probes=2, steps=9, left_out=1, disturbance=disturbance)
            ledger.record(result(number, stress=stress), snapshot="0")
        facts = {"copies": ["probes"], "state": "finished", "confirmed": {"probes": [3, 2]}}
        assert sums_of_probes(ledger, facts) == {
            "trials": 3, "not_fully_asked": 1, "least": 0.3, "trial": 1, "probes": 8, "steps": 36, "left_out": 4,
            "crashed_trials": 2, "run_again": 3, "confirmed": 2,
        }  # fmt: skip
        running = sums_of_probes(ledger, facts | {"state": "running"})
        assert (running["run_again"], running["confirmed"]) == (None, None)  # those are of an earlier run
        assert sums_of_probes(ledger, facts | {"copies": ["branches"]}) is None
        assert sums_of_branches(ledger, facts) is None


def saved(number):
    return SimpleNamespace(result=result(number, Outcome.COLLISION), id=str(number))


def test_new_type_is_of_the_trial_that_is_counted_after_its_row(monkeypatch):
    progress, added = Progress(), []
    progress.resume([], RunSettings(keep_going=True), {})
    monkeypatch.setattr(progress.kinds, "add", lambda bundle, *given: added.append(given))
    progress.count(result(0), crashed=False, planned=9)
    progress.save(saved(1), "recording")
    assert added == [(2, "recording")]


def test_what_the_ledger_is_to_know_now_is_noted():
    progress = Progress(failed_steps=3)
    assert progress.noted()["heartbeat"] == pytest.approx(time.time(), abs=60)
    assert progress.noted()["failed_steps"] == 3
    progress.failed = [result(1, setup_steps=None)]
    assert progress.noted()["failed_steps"] == 3 + 5 + progress.failed[0].other_steps
    assert {"nodes", "kinds", "audits_left"}.isdisjoint(Progress().noted())
    assert "failed_steps" not in Progress().noted()
    progress.resume(
        [], SimpleNamespace(keep_going=True, only_at_fault=False, distinct=2, by_cause=0), {"newest_kind": 5.0}
    )
    assert (progress.noted()["kinds"], progress.noted()["newest_kind"]) == ([], 5.0)
    assert progress.failed_steps == 0
    only = Progress()
    only.resume([], SimpleNamespace(keep_going=False, only_at_fault=False, distinct=0, by_cause=0), {"failed_steps": 4})
    assert (only.kinds, only.failed_steps) == (None, 4)


KILLED_TRIAL = Failure(KILLED, "somebody killed it")


def test_trials_that_were_killed_are_run_again_and_counted_once(tmp_path):
    with closing(Ledger(tmp_path / "ledger.sqlite", writable=True)) as ledger:
        for number in range(4):
            ledger.record(
                result(number, Outcome.INVALID, failure=KILLED_TRIAL) if number in (1, 3) else result(number),
                snapshot="",
            )
        assert [one.spec.number for one in find_unanswered(ledger)] == [1, 3]
        unanswered, progress = Unanswered(ledger), Progress()
        progress.outcomes.update({"survived": 2, "invalid": 2})
        assert [one.number for one in unanswered.specs] == [1, 3]
        assert len(unanswered) == 2
        again = replace(result(1), digest="f" * 32)
        assert unanswered.account(again, progress)
        assert progress.outcomes["invalid"] == 1
        assert len(progress.notes) == 1
        assert "differs: it is not determined by its specification" in progress.notes[0]
        assert not unanswered.account(result(3, Outcome.INVALID, failure=KILLED_TRIAL), progress)
        assert progress.outcomes["invalid"] == 1
        assert len(unanswered) == 1  # in the next run of the hunt
        assert unanswered.account(result(9), progress)
        assert len(unanswered) == 1


def test_trials_that_run_again_count_once_for_the_rate(tmp_path):
    """Of two traffics with three trials each, trial 0 was not fully asked, and trial 1 was killed."""
    asked_again = Branches(unanswered=1, may_be_asked_again=True)
    with closing(Ledger(tmp_path / "ledger.sqlite", writable=True)) as ledger:
        ledger.note(copies=["branches"])
        ledger.record(result(0, branches=asked_again), snapshot="")
        ledger.record(result(1, Outcome.INVALID, failure=KILLED_TRIAL), snapshot="")
        unanswered, progress = Unanswered(ledger), Progress()
        progress.counted = RateWatch(CountingRule(max_steps=9, traffics=2, planned=6), "trial", ("collision",))
        progress.counted.add(result(0))  # as a resumed hunt reads it
        for number in (0, 1, 2, 3):
            assert unanswered.account(result(number), progress)
            progress.count(result(number), crashed=False, planned=6)
        assert progress.running_rate(now=True)["units"] == 0  # trials 4 and 5 are left, of one traffic each
        progress.count(result(4), crashed=False, planned=6)
        assert (progress.running_rate(now=True)["units"], progress.counted.sequence.valid) == (1, 3)
        progress.count(result(5), crashed=False, planned=6)
        assert (progress.running_rate(now=True)["units"], progress.counted.sequence.valid) == (2, 6)


def test_what_is_whole_is_saved_into_another_directory(hunt, tmp_path):
    (hunt / "crashes" / "000000-collision" / "log.mcap").write_bytes(b"")
    (checked,) = check(hunt)
    assert [salvage(checked, tmp_path / "s") for _ in range(2)] == [{"trials": 3, "crashes": 1}] * 2
    assert sorted(path.name for path in (tmp_path / "s" / "crashes").iterdir()) == ["000002-collision"]
    found = hunt_state(tmp_path / "s")
    assert (found.state, found.trials_run, found.trials_planned, found.crashes) == ("interrupted", 3, 4, 1)
    assert [trial.spec.number for trial in load_quietly(tmp_path / "s").results()] == [1, 2, 3]
    assert load_quietly(tmp_path / "s").settings == load(hunt).settings


def test_salvaged_hunt_keeps_that_its_number_of_trials_was_changed_or_is_not_known(hunt, tmp_path, monkeypatch):
    def replanned(to):
        (checked,) = check(hunt)
        salvage(checked, tmp_path / to)
        with closing(Ledger(tmp_path / to / "ledger.sqlite")) as ledger:
            return ledger.facts().get("replanned")

    assert replanned("never") is None
    with closing(Ledger(hunt / "ledger.sqlite", writable=True)) as ledger:
        ledger.note(replanned=True)
    assert replanned("changed") is True
    with closing(Ledger(hunt / "ledger.sqlite", writable=True)) as ledger:
        ledger.note(replanned=None)
    (checked,) = check(hunt)
    facts = Ledger.facts

    def lost(self):
        if self._path == hunt / "ledger.sqlite":
            raise HuntDirectoryError("the ledger is damaged")
        return facts(self)

    monkeypatch.setattr(Ledger, "facts", lost)
    salvage(checked, tmp_path / "lost")
    monkeypatch.undo()
    with closing(Ledger(tmp_path / "lost" / "ledger.sqlite")) as ledger:
        assert ledger.facts()["replanned"] is True


def test_salvaged_hunt_keeps_how_its_trials_were_drawn_and_which_wait_for_their_audit(hunt, tmp_path):
    drawn = {"sampler_version": 5, "lag": 32, "independent": False, "plain_origin": "random", "audits_left": [2]}
    drawn |= {"under_way": 4, "code_versions": {"snapshots": [["0f"], ["1f"]], "newest": 1, "first": 2}}
    with closing(Ledger(hunt / "ledger.sqlite", writable=True)) as ledger:
        ledger.note(**drawn, newest_kind=1.0)
    (checked,) = check(hunt)
    salvage(checked, tmp_path / "s")
    with closing(Ledger(tmp_path / "s" / "ledger.sqlite")) as ledger:
        facts = ledger.facts()
    assert {name: facts.get(name) for name in drawn} == drawn
    assert not facts.keys() & {"newest_kind", "began", "owner", "done_before"}  # of a run that the copy has not had


def test_salvaged_hunt_keeps_the_crashes_whose_bundles_were_deleted(hunt, tmp_path):
    shutil.rmtree(hunt / "crashes" / "000000-collision")
    note(hunt, dropped={"rear end": [0]}, dropped_at_fault=[0])
    (checked,) = check(hunt)
    assert checked.fine
    assert salvage(checked, tmp_path / "s") == {"trials": 4, "crashes": 1}
    (again,) = check(tmp_path / "s")
    assert (again.fine, again.dropped, again.trials) == (True, {0}, {0, 1, 2, 3})
    assert hunt_state(tmp_path / "s").crashes == 2
    with closing(sqlite3.connect(hunt / "ledger.sqlite")) as database, database:
        database.execute("UPDATE trials SET seed = 99 WHERE number = 1")  # then the deleted bundles are not known
    (checked,) = check(hunt)
    assert salvage(checked, tmp_path / "part") == {"trials": 2, "crashes": 1}
    with closing(Ledger(tmp_path / "part" / "ledger.sqlite")) as ledger:
        assert not ledger.facts().keys() & {"dropped", "dropped_at_fault"}


def test_salvage_refuses_a_directory_that_has_something_and_names_what_cannot_be_copied(hunt, tmp_path, monkeypatch):
    (hunt / "crashes" / "000000-collision" / "log.mcap").write_bytes(b"")
    (checked,) = check(hunt)
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "notes.txt").touch()
    with pytest.raises(HuntDirectoryError, match="the directory exists already"):
        salvage(checked, taken)
    assert [path.name for path in taken.iterdir()] == ["notes.txt"]
    (tmp_path / "file").touch()
    for place, says in ((tmp_path / "file", "exists already"), (tmp_path / "no" / "where", "cannot be written")):
        with pytest.raises(HuntDirectoryError, match=says):
            salvage(checked, place)

    def fail(*_):
        raise shutil.Error([("source", "copy", "[Errno 5] Input/output error")])

    monkeypatch.setattr("crashhunt.hunts._salvage.shutil.copytree", fail)
    with pytest.raises(HuntDirectoryError, match=r"cannot be written: \[Errno 5\] Input/output error"):
        salvage(checked, tmp_path / "s")
    assert not (tmp_path / "s").exists()


def load_quietly(path):
    with pytest.warns(UserWarning, match="is not finished"):
        return load(path)
