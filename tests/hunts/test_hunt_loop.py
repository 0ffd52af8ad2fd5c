"""The loop of a hunt, whose executor makes up results: what it submits, records in the ledger and reports."""

from __future__ import annotations

import math
import sys
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from made_up_trials import Inline, leave_own_code_out, survives

import crashhunt
from crashhunt.errors import CallError, CrashhuntError, HuntDirectoryError, ScenarioError
from crashhunt.hunts import _hunt, _next_trials
from crashhunt.hunts._hunt import Hunt
from crashhunt.hunts._next_trials import GREATEST_LAG, Pace
from crashhunt.ledger import Ledger
from crashhunt.results._hunt_state import ledger_owner
from crashhunt.trial import UNUSABLE_VALUE, Branches, Failure, Outcome, TrialResult, TrialSpec

TOY = """
title = "A toy"
schema = 1
simulator = "toy"
[arguments.gap_m]
default = 12.0
[agents.ego]
agent = "crashhunt.agents:KeepLaneWithSpeed"
[agents.ego.arguments.speed]
default = 8.0
range = "6:14"
"""


def is_invalid(spec):
    return TrialResult(spec, Outcome.INVALID, steps=0, failure=Failure("ScenarioError", "no road"))


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Returns a function that runs a hunt of the given length on made-up results."""
    (tmp_path / "toy.toml").write_text(TOY)
    monkeypatch.chdir(tmp_path)
    leave_own_code_out(monkeypatch)

    def hunt(trials, ends=survives, *, parallel=2, **options):
        def make(name, settings, *, parallel):
            found.executor = Inline(settings, parallel=parallel, ends=ends)
            return found.executor

        found = SimpleNamespace(seen=[], path=tmp_path / "h", executor=None)
        monkeypatch.setattr(_hunt, "make_executor", make)
        given = {"scenario": "toy.toml", "seed": 4, "snapshot_code": False, "watch": found.seen.append} | options
        found.report = crashhunt.run(found.path, parallel, trials, 60, **given)
        with closing(Ledger(found.path / "ledger.sqlite")) as ledger:
            found.facts, found.events = ledger.facts(), [event[1:] for event in ledger.events()]
            found.numbers = [data["spec"]["number"] for data in ledger.plain_results()]
        return found

    return hunt


def test_progress_that_no_function_can_receive_is_refused_in_one_line(run):
    with pytest.raises(CallError, match=r"^run\(\): watch is 5; give a function"):
        run(1, watch=5)


def test_loop_submits_as_many_trials_as_workers_need_and_ends_with_the_last(run):
    found = run(9)
    executor, report = found.executor, found.report
    assert [spec.number for spec in executor.submitted] == found.numbers == list(range(9))
    assert executor.most == 4  # two run, and each worker has its next
    assert (executor.parallel, executor.settings.scratch.name[:8]) == (2, ".scratch")
    assert executor.cancelled == [-1]
    assert executor.closed == 2
    assert (report.stopped_because, report.outcomes) == ("all_trials", {"survived": 9})
    assert (report.trial_steps, report.steps_total) == (sum(range(10, 19)), sum(range(10, 19)))
    assert report.notes == ("a note",)
    assert found.events == [("running", ""), ("remark", "a note"), ("all_trials", "")]
    assert report.crashes == report.near_misses == ()
    assert (report.unanswered, report.unconfirmed, report.reason) == (0, 0, "")
    assert (report.audit, report.kinds, report.probes, report.branches, report.rare, report.rate) == (None,) * 6
    last = found.seen[-1]
    assert (last.phase, last.done, last.planned, last.outcomes) == ("done", 9, 9, {"survived": 9})
    assert last.workers == {}
    assert last.rate_per_s == pytest.approx(9 / last.elapsed_s)
    assert found.seen[0].workers == dict.fromkeys((1, 2, 3), "header")
    assert all(status.disturbed is None and status.kinds is None for status in found.seen)
    assert last.time_left_s == math.inf
    assert (last.crashes, last.branched, last.stressed) == (0, 0, None)


@pytest.mark.parametrize("keep_going", [True, False])
def test_late_value_that_cannot_be_compared_ends_the_hunt_and_its_trial_is_recorded(run, tmp_path, keep_going):
    def ends(spec):
        if spec.number < 4:
            return survives(spec)
        failure = Failure(UNUSABLE_VALUE, "info['hit'] is of type dict", party="environment", place="info")
        return replace(survives(spec), outcome=Outcome.SIMULATOR_ERROR, failure=failure)

    with pytest.raises(ScenarioError, match=r"of trial 4 \(seed \d+\): info\['hit'\] is of type dict$"):
        run(9, ends, keep_going=keep_going, crash_on=["collision"])
    with closing(Ledger(tmp_path / "h/ledger.sqlite")) as ledger:
        assert ledger.outcomes() == {"survived": 4, "simulator_error": 1}
        assert ledger.facts()["state"] == "error"


def test_hunt_waits_while_it_is_far_ahead_of_its_partner(run, tmp_path, monkeypatch):
    """The partner finishes ten trials at every second look, and has ended at trial 60."""
    looks, started = [], []

    def finished(place):
        assert place == tmp_path / "other"
        looks.append(max(started, default=-1))
        count = 10 * (len(looks) // 2)
        return count if count < 60 else None

    def begin(*given, **more):
        return Hunt(*given, **more, partner=tmp_path / "other")

    def ends(spec):
        started.append(spec.number)
        assert len(looks) >= 12 or spec.number < 10 * (len(looks) // 2) + 16
        return survives(spec)

    monkeypatch.setattr("crashhunt.hunts.Hunt", begin)
    monkeypatch.setattr(_next_trials, "trials_of_running", finished)
    monkeypatch.setattr(_next_trials, "_LOOK_EVERY_S", 0.0)
    monkeypatch.setattr(_hunt, "_MAX_LEAD_S", 0.0)
    found = run(99, ends)
    assert found.numbers == list(range(99))
    assert found.report.stopped_because == "all_trials"
    assert len(looks) >= 12  # it has waited, until the other one had ended


def test_pace_is_that_of_the_other_hunt_while_it_runs(tmp_path, monkeypatch):
    pace = Pace(tmp_path)
    monkeypatch.setattr(_next_trials, "_LOOK_EVERY_S", 0.0)
    assert pace.room(500, 4) == sys.maxsize  # it has not begun
    with closing(Ledger(tmp_path / "ledger.sqlite", writable=True)) as ledger:
        for number in range(3):
            ledger.record(survives(TrialSpec(number, 1, {}, {}, 9)), snapshot="")
        ledger.enter("running", owner=ledger_owner(), heartbeat=time.time())
        assert [pace.room(number, 4) for number in (0, 6, 7, 9)] == [7, 1, 0, 0]
        ledger.record(survives(TrialSpec(3, 1, {}, {}, 9)), snapshot="")
        assert (pace.room(7, 4), pace.room(7, 9), pace.room(None, 4)) == (1, 6, sys.maxsize)
        monkeypatch.setattr(_next_trials, "_LOOK_EVERY_S", 60.0)
        ledger.record(survives(TrialSpec(4, 1, {}, {}, 9)), snapshot="")
        assert pace.room(8, 4) == 0  # it has just been looked at
        monkeypatch.setattr(_next_trials, "_LOOK_EVERY_S", 0.0)
        ledger.enter("all_trials", owner=None)
    assert pace.room(9, 4) == sys.maxsize
    (tmp_path / "ledger.sqlite").write_bytes(b"no database" * 99)
    assert pace.room(9, 4) == sys.maxsize


def test_fewer_trials_than_workers_need_fewer_workers(run):
    found = run(2, parallel=8)
    assert found.executor.parallel == 2
    assert run(2, parallel=8).executor.submitted == []  # all of them have ended


@pytest.mark.parametrize(
    ("sampler", "deterministic", "lag", "version"),
    [
        ("random", True, None, None),
        ("random", False, None, None),
        ("mutation", True, GREATEST_LAG, "version"),
        ("mutation", False, None, "version"),
    ],
)
def test_ledger_has_the_lag_and_the_version_of_a_sampler_that_learns(run, sampler, deterministic, lag, version):
    facts = run(3, sampler=sampler, deterministic=deterministic).facts
    assert facts.get("lag") == lag
    assert isinstance(facts.get("sampler_version"), int) is (version is not None)
    assert facts["independent"] is (sampler == "random")
    again = run(4, sampler=sampler, deterministic=deterministic).facts
    assert [again.get(name) for name in ("lag", "sampler_version")] == [
        facts.get(name) for name in ("lag", "sampler_version")
    ]


def test_refused_resumption_changes_neither_state_nor_settings_of_a_hunt(run):
    found = run(3, sampler="mutation")
    settings = (found.path / "hunt.toml").read_bytes()
    (snapshot,) = (found.path / "snapshots").iterdir()
    snapshot.rename(snapshot.with_name("earlier"))
    with closing(Ledger(found.path / "ledger.sqlite", writable=True)) as ledger:
        ledger.note(sampler_version=1)
        before = ledger.facts()
    with pytest.raises(HuntDirectoryError, match="the hunt began with version 1 of the sampler"):
        run(9, sampler="mutation")
    assert (found.path / "hunt.toml").read_bytes() == settings
    assert [path.name for path in (found.path / "snapshots").iterdir()] == ["earlier"]
    with closing(Ledger(found.path / "ledger.sqlite")) as ledger:
        assert ledger.facts() == before
        assert ledger.events()[-1][1] == "remark"
    again = run(3, sampler="mutation")  # which needs no proposal
    assert (again.report.stopped_because, again.facts["state"]) == ("all_trials", "all_trials")


def test_ledger_has_the_settings_of_the_hunt_and_of_this_run(run, monkeypatch):
    entered = []
    enter = Ledger.enter

    def note(ledger, state, detail="", **facts):
        entered.append((state, facts))
        enter(ledger, state, detail, **facts)

    monkeypatch.setattr(Ledger, "enter", note)
    facts = run(3).facts
    (state, first), (last, _) = entered
    assert (state, last) == ("running", "all_trials")
    assert first["owner"]["pid"] > 0
    assert "owner" not in facts
    assert first["began"] == pytest.approx(time.time(), abs=60)
    assert first["heartbeat"] == pytest.approx(time.time(), abs=60)
    assert (first["done_before"], first["planned"], first["replanned"], first["until"]) == (0, 3, None, None)
    assert (first["hunt_seed"], first["crash_on"][0]) == (4, "collision")
    assert (first["disturb"], first["copies"], first["until_rate"], first["audits_left"]) == (None,) * 4
    assert (first["core"], first["phase"], first["ends_at"]) == (None, None, None)
    assert facts["running_rate"]["trials"] == 3
    assert "phase" not in facts

    entered.clear()
    found = run(3, duration="60s")
    assert entered[0][1]["until"] == pytest.approx(time.time() + 60, abs=30)
    assert (entered[0][1]["done_before"], entered[0][1]["replanned"]) == (3, None)
    assert found.report.stopped_because == "all_trials"
    entered.clear()
    run(5)
    assert (entered[0][1]["done_before"], entered[0][1]["replanned"]) == (3, True)
    entered.clear()
    assert run(5).facts["replanned"] is True  # it stays


def test_hunt_without_a_valid_trial_ends_early_with_its_reason(run):
    found = run(900, is_invalid)
    assert found.report.stopped_because == "no_valid_trial"
    assert found.report.outcomes == {"invalid": 10}
    assert "no road" in found.report.reason
    assert found.events[-1] == ("no_valid_trial", found.report.reason)
    assert found.executor.closed


def test_hunt_whose_few_trials_are_all_invalid_has_no_valid_trial_either(run):
    assert run(3, is_invalid).report.stopped_because == "no_valid_trial"

    def one(spec):
        return survives(spec) if spec.number == 1 else is_invalid(spec)

    found = run(4, one, overwrite=True)
    assert (found.report.stopped_because, found.report.reason) == ("all_trials", "")


def test_hunt_with_a_time_limit_ends_when_it_is_over(run, monkeypatch):
    clock = SimpleNamespace(now=time.monotonic())
    monkeypatch.setattr(time, "monotonic", lambda: clock.now)  # it stands still between trials

    def slow(spec):
        clock.now += 10.0
        return survives(spec)

    found = run(0, slow, duration="45s")
    assert found.report.stopped_because == "time"
    assert found.numbers == list(range(8))  # what runs when the time is over still counts
    assert found.facts["planned"] == 0
    assert 0 < found.report.wall_s <= 80.001  # the first time is that of the real clock


def test_heartbeat_notes_the_progress_about_once_a_second(run, monkeypatch):
    noted, clock = [], SimpleNamespace(now=500.0)
    note = Ledger.note
    monkeypatch.setattr(time, "monotonic", lambda: clock.now)

    def listen(ledger, **facts):
        noted.append((clock.now, facts))
        note(ledger, **facts)

    def slow(spec):
        clock.now += {3: 1.0, 6: 1.1, 8: 1.2}.get(spec.number, 0.0)
        return survives(spec)

    monkeypatch.setattr(Ledger, "note", listen)
    run(9, slow)
    beats = [
        now for now, facts in noted if set(facts) >= {"heartbeat", "phase", "running_rate"} and "state" not in facts
    ]
    assert beats == [500.0, 500.0, pytest.approx(502.1), pytest.approx(503.3)]  # at the start, and in the loop
    assert noted[-1][1]["owner"] is None


def test_stopped_hunt_is_interrupted_and_resumes(run, monkeypatch):
    stops = []

    def stop(spec):
        if spec.number == 3:
            stops.append(2)
        return survives(spec)

    init = Hunt.__init__

    def watch(hunt, *words, **options):
        init(hunt, *words, **options)
        monkeypatch.setattr(_hunt, "stop_requests", lambda: Stops(stops))

    monkeypatch.setattr(Hunt, "__init__", watch)
    found = run(9, stop)
    assert found.report.stopped_because == "interrupted"
    assert found.numbers == [0, 1, 2, 3]
    assert found.facts["state"] == "interrupted"
    stops.clear()
    assert run(9).numbers == list(range(9))


class Stops:
    """In place of the requests to stop."""

    def __init__(self, stops):
        self.stops = stops

    def __enter__(self):
        return self.stops

    def __exit__(self, *_):
        pass


def test_hunt_until_a_rate_ends_with_its_verdict(run):
    found = run(0, until_rate="0.5/trial", most=60)
    assert found.report.stopped_because == "rate"
    assert found.report.rate.verdict == "below"
    assert found.facts["until_rate"]["verdict"] == "below"
    decided = found.facts["until_rate"]["decided_at"]
    assert decided is not None
    assert decided <= max(found.numbers) <= decided + 4
    again = run(0, until_rate="0.5/trial", most=60)
    assert again.executor is None
    assert again.report.stopped_because == "rate"
    assert again.facts["until_rate"] == found.facts["until_rate"]


def test_hunt_until_a_rate_ends_above_it_with_an_interval_above_it(run, bundles):
    rate = run(0, crashes_from(*range(60)), until_rate="0.001/trial", most=60, keep=1).report.rate
    assert (rate.verdict, rate.crashes) == ("above", rate.units)
    assert rate.certain.low >= 0.001


def crashes_from(*numbers):
    def ends(spec):
        found = survives(spec)
        return replace(found, outcome=Outcome.COLLISION, danger=None) if spec.number in numbers else found

    return ends


@pytest.mark.parametrize("deterministic", [False, True])
def test_first_crash_ends_a_hunt(run, bundles, deterministic):
    found = run(30, crashes_from(3, 5), deterministic=deterministic)
    assert found.report.stopped_because == "crash"
    assert [bundle.result.spec.number for bundle in found.report.crashes] == bundles == [3]
    assert found.numbers == [0, 1, 2, 3]
    assert found.report.outcomes == {"survived": 3, "collision": 1}
    assert found.report.tally.found == found.seen[-1].crashes == 1
    assert {status.phase for status in found.seen} == {"hunting", "saving", "done"}
    assert found.executor.cancelled == [3 if deterministic else -1, -1]
    assert found.facts["state"] == "crash"
    assert (found.report.unanswered, found.report.unconfirmed) == (0, 0)


def test_hunt_that_has_found_its_crash_ends_with_any_version_of_its_sampler(run, bundles, monkeypatch):
    run(30, crashes_from(3), sampler="mutation")
    with closing(Ledger(Path("h/ledger.sqlite"), writable=True)) as ledger:
        ledger.note(sampler_version=1)
    bundle = SimpleNamespace(
        result=crashes_from(3)(TrialSpec(3, 1, {}, {}, 60)), id="000003-collision", confirmed=True, snapshot=""
    )
    monkeypatch.setattr(_hunt, "list_bundles", lambda directory: [bundle])
    assert run(30, sampler="mutation").report.stopped_because == "crash"


def test_deterministic_hunt_waits_for_trials_below_its_crash(run, bundles, monkeypatch):
    monkeypatch.setattr(Inline, "first", -1)  # the last submitted trial ends first
    found = run(30, crashes_from(*range(30)), deterministic=True)
    assert found.report.stopped_because == "crash"
    assert bundles == [0]
    assert found.numbers == [0]
    assert found.executor.cancelled == [3, 2, 1, 0, -1]
    monkeypatch.setattr(Inline, "first", 0)
    other = run(30, crashes_from(*range(30)), deterministic=False, overwrite=True)
    assert other.executor.cancelled == [-1, -1]


def test_hunt_that_keeps_going_reports_its_shortest_crash_first(run, bundles, monkeypatch):
    monkeypatch.setattr(_hunt, "prune_bundles", lambda ledger, kinds, crashes, keep, *, final=True: crashes)
    kinds = SimpleNamespace(
        until=None, added=[], types_by_cause=None, at_fault=(2, 4), newest=None, newest_trial=None,
        groups=lambda **_: (), refresh=lambda crashes: None, next_to_judge=lambda: None, count_to_judge=lambda: 0,
    )  # fmt: skip
    kinds.add = lambda bundle, ended, recording: kinds.added.append((bundle.result.spec.number, ended))
    monkeypatch.setattr("crashhunt.hunts._progress.Kinds", lambda *_, **__: kinds)

    def ends(spec):
        return replace(crashes_from(2, 4, 6)(spec), steps={2: 9, 4: 5, 6: 5}.get(spec.number, 20))

    found = run(8, ends, keep_going=True)
    assert found.report.stopped_because == "all_trials"
    assert [bundle.result.spec.number for bundle in found.report.crashes] == [4, 6, 2]
    assert kinds.added == [(2, 3), (4, 5), (6, 7)]
    assert found.report.at_fault == (2, 4)
    assert found.report.kinds == ()
    assert found.report.outcomes == {"survived": 5, "collision": 3}
    assert found.executor.cancelled == [-1]


def test_error_in_a_file_of_the_scenario_names_the_file_of_the_user(run):
    def fails(spec):
        where = f"{made.executor.settings.scenario.origin}: line 3"
        raise CrashhuntError("no road", fix="draw one", where=where)

    made = SimpleNamespace()
    init = Inline.__init__

    def listen(executor, *words, **options):
        made.executor = executor
        init(executor, *words, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Inline, "__init__", listen)
        with pytest.raises(ScenarioError, match="no road; draw one") as caught:
            run(3, fails)
        assert caught.value.where == f"{Path.cwd() / 'toy.toml'}: line 3"
        assert caught.value.where != f"{made.executor.settings.scenario.origin}: line 3"
        assert made.executor.closed == 1

        def elsewhere(spec):
            raise CrashhuntError("no disk", fix="buy one", where="/dev/sda")

        with pytest.raises(CrashhuntError, match="no disk") as caught:
            run(3, elsewhere, overwrite=True)
        assert type(caught.value) is CrashhuntError
        assert caught.value.where == "/dev/sda"


def test_parts_of_a_hunt_are_closed_at_its_end(run, monkeypatch):
    closed = []

    def note(kind, name):
        method = kind.close

        def close(part, *words):
            closed.append(name)
            method(part, *words)

        monkeypatch.setattr(kind, "close", close)

    for kind in (_hunt.Audit, _hunt.Confirmation, _hunt.SharedReruns):
        note(kind, kind.__name__)
    released = []
    monkeypatch.setattr(
        _hunt, "release_shared_memory", lambda scratch, *, of_ended: released.append((scratch, of_ended))
    )
    found = run(3)
    assert closed == ["Audit", "Confirmation", "SharedReruns"]
    assert [(scratch.name[:8], of_ended) for scratch, of_ended in released[:1]] == [(".scratch", True)]
    closed.clear()

    def fails(spec):
        raise ValueError("odd")

    with pytest.raises(ValueError, match="odd"):
        run(3, fails, overwrite=True)
    assert closed == ["Audit", "Confirmation", "SharedReruns"]
    assert list(found.path.glob(".scratch*")) == []


def test_trial_that_is_another_one_when_it_runs_again_does_not_end_the_hunt(run):
    found = run(3)
    asked_again = Branches(unanswered=1, may_be_asked_again=True)
    with closing(Ledger(found.path / "ledger.sqlite", writable=True)) as ledger:
        snapshot = ledger.snapshot_of(1)
        ledger.record(replace(ledger.result(1), branches=asked_again, digest="f" * 32), snapshot=snapshot)
        ledger.note(copies=["branches"])
    again = run(3)
    assert [spec.number for spec in again.executor.submitted] == [1]
    assert again.report.stopped_because == "all_trials"
    (note,) = [note for note in again.report.notes if note != "a note"]
    assert note.startswith("trial 1 was run again for the answers of its copies, and differs")
    assert ("remark", note) in again.events


def test_bundle_whose_row_is_missing_is_recorded_when_a_hunt_resumes(run, monkeypatch):
    """A hunt is killed between the bundle of a crash and its row."""
    run(2)
    bundle = SimpleNamespace(
        result=replace(survives(SimpleNamespace(number=2)), spec=TrialSpec(2, 99, {"ego": {"speed": 7.0}}, {}, 60)),
        id="000002-collision", snapshot="0f", confirmed=True,
    )  # fmt: skip
    monkeypatch.setattr(_hunt, "list_bundles", lambda directory: [bundle])
    monkeypatch.setattr(_hunt.TrialReruns, "confirm", lambda again, crashes: list(crashes))
    found = run(4, keep_going=False)
    assert 2 in found.numbers
    assert found.executor is None or 2 not in [spec.number for spec in found.executor.submitted]
    with closing(Ledger(found.path / "ledger.sqlite")) as ledger:
        assert ledger.result(2) == bundle.result
        assert ledger.snapshot_of(2) == "0f"
