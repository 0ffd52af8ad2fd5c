"""The parts of a hunt without any trial: when it cancels, what it notes, and how its crashes run again."""

from __future__ import annotations

import math
import os
import queue
import signal
import threading
import time
from collections import Counter
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from crashhunt.base import layout
from crashhunt.base.errors import BusyError, CrashhuntError, HuntDirectoryError, UntrustedError
from crashhunt.executors import PoolExecutor
from crashhunt.hunts import (
    HuntReport,
    _hunt,
    _next_trials,
    _preflight,
    _progress,
    _verification,
)
from crashhunt.hunts._hunt import Hunt, RunningHunt, TrialLoop
from crashhunt.hunts._next_trials import result_lag
from crashhunt.hunts._progress import PhaseClock, Progress
from crashhunt.hunts._reports import BranchReport, Difference, ProbeReport, RareReport, kind_data
from crashhunt.hunts._verification import Confirmation, Judged, RepeatedTrial, TrialReruns, is_settled
from crashhunt.ledger import Ledger
from crashhunt.plans import AgentSettings, ArgumentSpec, HuntSettings, RunSettings, read_settings
from crashhunt.results import _hunt_results as _results, _log_reader
from crashhunt.results._hunt_directory import HuntDirectory
from crashhunt.results._log_reader import LogReader
from crashhunt.statistics import TRIALS_PER_ROOT, RareEstimate, _rate_of_running_hunt, rate_of_bar
from crashhunt.statistics._rare import Estimated
from crashhunt.trial import Outcome, TrialResult, TrialSpec
from crashhunt.trial_reruns import EndedRun, StoppedError

SETTINGS = HuntSettings(
    scenario="toy", scenario_digest="0", trials=9, max_steps=20, seed=3, run=RunSettings(parallel=2)
)


def result(number, outcome=Outcome.SURVIVED, **more):
    return TrialResult(TrialSpec(number, number, {}, {}, 20), outcome, steps=5, **more)


@pytest.fixture
def hunt(tmp_path):
    return Hunt(tmp_path / "h", SimpleNamespace(origin="scenario.toml"), SETTINGS)


class Notes:
    """In place of a ledger: it notes what it is told."""

    def __init__(self):
        self.remarks, self.noted, self.entered, self.restored = [], [], [], False

    def remark(self, text):
        self.remarks.append(text)

    def note(self, **facts):
        self.noted.append(facts)

    def facts(self):
        return {name: value for facts in self.noted for name, value in facts.items()}

    def enter(self, state, detail="", **facts):
        self.entered.append((state, detail, facts))

    def restore(self):
        return self.restored


@pytest.fixture
def running(tmp_path):
    """A running hunt of which nothing has begun: `shown` are the phases that were shown."""
    found = object.__new__(RunningHunt)
    found.ledger, found.disturber, found.shown = Notes(), None, []
    found.progress = SimpleNamespace(notes=[], status=lambda phase, planned, workers, **more: (phase, planned))
    found.setup = SimpleNamespace(
        place=HuntDirectory(tmp_path / "h"), settings=SETTINGS, stops=(), parallel_here=2,
        conditions=SimpleNamespace(check_hunt=lambda: None),
        snapshot=SimpleNamespace(digest="0f"),
    )  # fmt: skip
    found._watch = found.shown.append
    return found


@pytest.fixture
def loop(running):
    """Makes the loop of a running hunt with such options of its run."""

    def make(**run):
        found = object.__new__(TrialLoop)
        found._hunt, found._ledger, found._in_flight = running, running.ledger, set()
        found._run_settings = replace(SETTINGS.run, **run)
        return found

    return make


def test_notice_of_an_absent_name_is_kept_until_the_name_occurs(running, loop):
    ledger, progress, found, occurred = running.ledger, running.progress, loop(), [(), ("x names",)]
    progress.look_at = lambda executor: None
    found._executor, found._audit = None, SimpleNamespace(look=lambda wait_s: [])
    found._notices = SimpleNamespace(
        take=lambda executor: ["a"], absent=lambda *, at_end: ["x names nothing"] * at_end,
        newly_occurred=lambda: occurred.pop(0),
    )  # fmt: skip
    found._receive_notices(at_end=True)
    assert progress.notes == ledger.facts()["notices"] == ["a", "x names nothing"]
    found._receive_notices()
    assert (progress.notes, ledger.facts()["notices"]) == (["a", "a"], ["a"])


def test_results_reach_the_sampler_late_enough_for_every_worker():
    free, fixed = RunSettings(deterministic=False), RunSettings(deterministic=True)
    assert _next_trials.trials_under_way(3) == 6
    assert result_lag({"lag": 7}, free, 2) == 4
    assert result_lag({"lag": 7}, fixed, 2) == 7
    assert result_lag({}, fixed, 2) == max(_next_trials.GREATEST_LAG, 4)
    assert result_lag({}, fixed, 1000) == 2000


def test_end_of_a_hunt_is_expected_by_trials_and_by_time():
    asked = []
    progress = Progress(outcomes=Counter(survived=4))
    progress.remaining = SimpleNamespace(
        seconds_left=lambda now, left, parallel: asked.append((left, parallel)) or 60.0
    )
    progress.expect_end(9, 3)
    assert asked == [(5, 3)]
    assert progress.parallel == 3
    assert progress.ends_at == pytest.approx(time.time() + 60, abs=5)
    progress.until = time.monotonic() + 20.0
    progress.expect_end(9, 3)
    assert progress.ends_at == pytest.approx(time.time() + 20, abs=5)
    progress.outcomes = Counter(survived=9)
    progress.expect_end(9, 3)
    assert len(asked) == 2
    assert progress.ends_at == pytest.approx(time.time(), abs=5)
    progress.expect_end(0, 3)
    assert progress.ends_at is None
    progress.outcomes, progress.until = Counter(), math.inf
    progress.remaining = SimpleNamespace(seconds_left=lambda *given: math.inf)
    progress.expect_end(9, 3)
    assert progress.ends_at is None


def test_notices_of_workers_and_differences_of_the_audit_are_noted(running, loop):
    looks, counted = [], []
    running.progress.look_at = looks.append
    running.audits_left = SimpleNamespace(note=lambda *given: counted.append(given))
    for share in (0.0, 0.5):
        found = loop(audit=share)
        found._executor = "executor"
        found._notices = SimpleNamespace(
            take=lambda executor: ["a", "b"] if executor == "executor" else [],
            absent=lambda *, at_end: [],
            newly_occurred=lambda: (),
        )
        found._audit = SimpleNamespace(look=lambda wait_s: ["differs"] if wait_s == 0.25 else [])
        found._receive_notices(wait_s=0.25)
    assert running.ledger.remarks == ["a", "b", "audit: differs"] * 2
    assert running.progress.notes == ["a", "b"] * 2
    assert running.ledger.noted == [{"notices": ["a"]}, {"notices": ["a", "b"]}]  # each once
    assert looks == ["executor"] * 2
    assert counted == [(found._audit, running.progress)]


def test_rest_of_an_audit_is_a_phase_of_its_own(running, loop):
    found, phases = loop(), []
    found._audit = audit = SimpleNamespace(waiting=3, parallel=0)
    running.reruns = SimpleNamespace(
        phases=SimpleNamespace(
            begin=lambda name, total: phases.append((name, total)), advance=lambda: phases.append("one"),
            tick=lambda: phases.append("tick"),
        )
    )  # fmt: skip

    def receive(*, wait_s):
        assert wait_s == _hunt._TICK_S
        audit.waiting -= 2 if audit.waiting == 3 else 1

    found._receive_notices = receive
    found._finish_audit()
    assert phases == [("auditing", 3), "one", "one", "tick", "one", "tick"]
    assert audit.parallel == 2
    audit.waiting, running.setup.stops = 3, (2,)
    phases.clear()
    found._finish_audit()
    assert phases == []


def test_ledger_that_was_removed_is_written_again_with_a_note(running):
    ledger, progress = running.ledger, running.progress
    running.restore_ledger()
    assert (ledger.remarks, progress.notes) == ([], [])
    ledger.restored = True
    running.restore_ledger()
    assert ledger.remarks == progress.notes
    assert "was removed while the hunt ran" in ledger.remarks[0]


def test_hunt_that_fails_records_why(hunt, monkeypatch):
    ledger, removed = Notes(), []
    hunt._place.has_begun = True
    monkeypatch.setattr(_hunt, "remove_scratch", removed.append)
    hunt._fail(ledger, "no disk")
    assert ledger.entered == [("error", "no disk", {})]
    assert removed == [hunt._place.scratch]
    hunt._running = SimpleNamespace(has_begun=False, progress=SimpleNamespace(noted=lambda *, now: {"kinds": now}))
    hunt._fail(ledger, "no disk")
    assert ledger.entered[1] == ledger.entered[0]
    hunt._running.has_begun = True
    hunt._fail(ledger, "bad \udcff")
    state, detail, facts = ledger.entered[2]
    assert (state, facts) == ("error", {"kinds": True})
    detail.encode()

    def fails(*given, **more):
        raise CrashhuntError("no disk", fix="x")

    ledger.enter = fails
    hunt._fail(ledger, "no disk")


def test_hunt_waits_for_a_locked_ledger_and_reports_it(running):
    for waited_s in (1.0, 2.0, 3.5, 60.0):
        running._wait_for_ledger(waited_s)
    assert running.shown == [("waiting", 9)] * 2
    assert running.progress.notes == [
        "the hunt waited for another program that had locked ledger.sqlite; no trial was lost"
    ]
    with pytest.raises(HuntDirectoryError, match="has locked the ledger for 601 s; close the program"):
        running._wait_for_ledger(601.0)
    running.setup.stops = (signal.SIGINT,)
    running._wait_for_ledger(1.0)
    with pytest.raises(HuntDirectoryError, match="has locked the ledger for 4 s"):
        running._wait_for_ledger(4.0)


def test_hunt_waits_for_a_locked_ledger_before_it_begins(hunt, caplog):
    for waited_s in (0.5, 4.0, 5.0):
        hunt._wait_to_begin(waited_s)
    assert caplog.messages == ["waiting for another program that has locked ledger.sqlite"]
    with pytest.raises(HuntDirectoryError, match="has locked the ledger for 601 s; close the program"):
        hunt._wait_to_begin(601.0)


def test_trial_is_written_recorded_and_counted(running, loop, monkeypatch):
    calls = []
    running.setup.settings = replace(SETTINGS, crash_on=(Outcome.COLLISION,))
    running.unanswered = SimpleNamespace(account=lambda given, progress: given.spec.number < 90)
    running.fork_crashes = SimpleNamespace(add=lambda given: calls.append(("copied", given.spec.number)))
    running.ledger.record = lambda given, *, snapshot: calls.append(("row", given.spec.number, snapshot))
    running.trials = SimpleNamespace(ended=lambda given: calls.append(("ended", given.spec.number)))
    running.progress = SimpleNamespace(
        kinds=object(), count=lambda given, *, crashed, planned: calls.append(("counted", crashed, planned)),
        save=lambda *given: calls.append(("saved", *given)),
    )  # fmt: skip
    found = loop()
    monkeypatch.setattr(_hunt, "write_trial", lambda _, given, scratch: calls.append(("files", scratch.name)))
    monkeypatch.setattr(_hunt, "read_map", lambda scratch, trial: "lanes")

    def write(folder, given, trial, **more):
        calls.append(("bundle", folder == running.setup.place.path, trial.name, more))
        return "bundle"

    monkeypatch.setattr(_hunt, "write_bundle", write)
    monkeypatch.setattr(_hunt, "read_black_box", lambda path: path.parent.name)
    monkeypatch.setattr(_hunt, "Recording", "recording of {}".format)

    def record(given):
        calls.clear()
        found._record_trial(given)
        return list(calls)

    assert record(result(4)) == [("row", 4, "0f"), ("counted", False, 9), ("copied", 4), ("ended", 4)]
    assert record(result(5, kept=True))[0] == ("files", "trial-000005")
    assert record(result(6, Outcome.INVALID)) == [("row", 6, "0f"), ("counted", False, 9), ("ended", 6)]
    assert record(result(99)) == [("ended", 99)]
    crash = result(7, Outcome.COLLISION)
    more = {"hunt_seed": 3, "snapshot": "0f", "lanes": "lanes", "recording": "recording of trial-000007"}
    assert record(crash) == [
        ("bundle", True, "trial-000007", more), ("saved", "bundle", more["recording"]), ("row", 7, "0f"),
        ("counted", True, 9), ("ended", 7),
    ]  # fmt: skip
    running.progress.kinds = None  # it is saved once it is the one that ends the hunt
    assert record(crash) == [("counted", True, 9), ("ended", 7)]
    running.disturber = SimpleNamespace(log_likelihood_of=lambda given: -given.spec.number)
    running.ledger.record = lambda given, *, snapshot: calls.append(given.log_likelihood)
    assert record(result(8))[0] == -8


def test_phases_after_the_last_trial_are_shown_and_noted_now_and_then(running, monkeypatch):
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(_hunt.time, "monotonic", lambda: clock.now)
    running.progress = progress = SimpleNamespace(
        phase=None, ends_at=5.0, noted=lambda: {"done": progress.phase.done}, notes=[],
        status=lambda phase, planned, workers, **more: (phase, progress.phase.done),
    )  # fmt: skip
    show = running._phase_display()
    for now, name, done in ((0.0, "a", 0), (0.5, "a", 1), (1.5, "a", 2), (1.6, "b", 0), (1.7, "b", 1)):
        clock.now = 100.0 + now
        show(SimpleNamespace(name=name, done=done))
    assert running.shown == [("a", 0), ("a", 1), ("a", 2), ("b", 0), ("b", 1)]
    assert running.ledger.noted == [{"done": 0}, {"done": 2}, {"done": 0}]
    assert progress.ends_at is None


def test_earlier_runs_count_on_the_screen(monkeypatch):
    ledger = SimpleNamespace(
        tried_by_origin=lambda crash_on: ("tried", tuple(crash_on)), result=lambda number: f"result {number}",
        outcomes=lambda: {"a": 3, "b": 4}, nearest_miss=lambda: "nearest",
    )  # fmt: skip
    resumed = []

    def counts(branches, probes, before=None):
        monkeypatch.setattr(_progress, "sums_of_branches", lambda given, facts: branches)
        monkeypatch.setattr(_progress, "sums_of_probes", lambda given, facts: probes)
        progress = Progress()
        progress.searching = SimpleNamespace(resume=lambda *given: resumed.append(given))
        progress.resume_counts(ledger, before or {}, SETTINGS.crash_on)
        assert (progress.outcomes, progress.nearest) == ({"a": 3, "b": 4}, "nearest")
        return progress.branched, progress.not_fully_asked, progress.stressed

    assert counts(None, None) == (0, 0, None)
    assert resumed == []
    probes = {"crashed_trials": 1, "trial": 7, "not_fully_asked": 2}
    assert counts({"crashed": 5, "not_fully_asked": 3}, probes, {"origins": 1}) == (5, 5, "result 7")
    assert resumed == [(7, ("tried", tuple(SETTINGS.crash_on)))]
    assert counts(None, {**probes, "crashed_trials": 0})[2] is None
    assert counts(None, {**probes, "trial": None})[2] is None


def test_rate_of_a_hunt_with_a_bar_has_no_estimate(monkeypatch, tmp_path):
    made = []

    @dataclass(frozen=True)
    class Rate:
        excluded: dict
        verdict: str = ""
        why_undecided: str = ""

    def make(name, per, counter, sequence, **more):
        made.append((name, per, counter, sequence, more))
        return Rate({"after_unfinished": 2, "invalid": 1})

    monkeypatch.setattr(_rate_of_running_hunt, "make_rate", make)
    watch = SimpleNamespace(per="trial", counter="c", sequence="s", alpha=0.05, bar=0.1, decided_at=None,
                            verdict="below", why_undecided="few")  # fmt: skip
    assert rate_of_bar(tmp_path, None) is None
    found = rate_of_bar(tmp_path, watch)
    assert (found.verdict, found.why_undecided, found.excluded) == (
        "below", "few", {"after_unfinished": 2, "invalid": 1},
    )  # fmt: skip
    watch.decided_at = 0
    assert rate_of_bar(tmp_path, watch).excluded == {"invalid": 1}
    assert [more["why_no_estimate"].partition(" ")[0] for *_, more in made] == ["--until-rate"] * 2
    assert made[0][:4] == (str(tmp_path), "trial", "c", "s")
    assert (made[0][4]["confidence"], made[0][4]["bar"]) == (pytest.approx(95.0), 0.1)


# The directory of a hunt.


def test_directory_has_one_hunt_at_a_time(tmp_path):
    place = HuntDirectory(tmp_path / "h")
    with place.locked():
        assert (tmp_path / "h/.lock").read_text() == str(os.getpid())
        with pytest.raises(BusyError, match=f"process {os.getpid()}"), HuntDirectory(tmp_path / "h").locked():
            pass
        place.has_begun = True
        assert place.scratch.parent == (tmp_path / "h").absolute()
        place.claim(SETTINGS, ["crashhunt"], overwrite=False, seed_given=True)
        assert place.scratch.is_dir()
    assert not place.scratch.exists()
    with HuntDirectory(tmp_path / "h").locked():
        pass
    (tmp_path / "file").touch()
    with pytest.raises(HuntDirectoryError, match="is a file"), HuntDirectory(tmp_path / "file").locked():
        pass
    with pytest.raises(HuntDirectoryError, match="cannot be used: No such"), HuntDirectory(tmp_path / "a/b").locked():
        pass


def test_directory_keeps_its_hunt_unless_it_is_overwritten(tmp_path):
    place = HuntDirectory(tmp_path)

    def claim(settings, **options):
        with place.locked():
            return place.claim(settings, ["crashhunt"], **{"overwrite": False, "seed_given": True} | options)

    claim(SETTINGS)
    (tmp_path / "crashes/000001-collision").mkdir(parents=True)
    other = replace(SETTINGS, seed=5)
    with pytest.raises(HuntDirectoryError, match="the directory contains another hunt: seed"):
        claim(other)
    with pytest.raises(HuntDirectoryError, match="max_steps was 20 and is now 40"):
        claim(replace(SETTINGS, max_steps=40))
    assert claim(other, seed_given=False).seed == 3
    many = replace(other, max_steps=7, crash_on=(), scenario="loop", scenario_digest="1", oracles=("overlap",))
    with pytest.raises(HuntDirectoryError) as caught:
        claim(many)
    assert caught.value.message.count(";") == 4
    assert caught.value.message.endswith(" more")
    (tmp_path / "mine.txt").touch()
    (tmp_path / ".scratch-of-another").mkdir()
    assert claim(other, overwrite=True).seed == 5
    assert read_settings(tmp_path / layout.HUNT).seed == 5
    assert {path.name for path in tmp_path.iterdir()} == {".lock", layout.HUNT, "mine.txt"}


@pytest.mark.parametrize("left", ["nothing", "snapshot", "crash", "kept trial", "row", "damaged ledger", "no ledger"])
def test_hunt_that_ended_before_its_first_trial_does_not_block_its_directory(tmp_path, left):
    place, other = HuntDirectory(tmp_path), replace(SETTINGS, max_steps=40)
    with place.locked():
        place.claim(SETTINGS, ["crashhunt"], overwrite=False, seed_given=True)
        ledger = Ledger(tmp_path / layout.LEDGER, writable=True)
        ledger.enter("error", "the environment does not exist")
        if left == "row":
            spec = TrialSpec(number=0, seed=1, arguments={}, scenario_arguments={}, max_steps=20)
            ledger.record(TrialResult(spec, Outcome.INVALID), snapshot="")
        ledger.close()
        place.has_begun = True
    folder = {"crash": "crashes/000000-collision", "kept trial": "trials/000000"}.get(left, "snapshots/00")
    (tmp_path / folder).mkdir(parents=True)
    if left == "damaged ledger":
        (tmp_path / layout.LEDGER).write_bytes(b"damaged" * 1000)
    if left == "no ledger":  # its rows may have been lost with it
        (tmp_path / layout.LEDGER).unlink()
    with place.locked():
        if left in ("nothing", "snapshot"):
            assert place.claim(other, ["crashhunt"], overwrite=False, seed_given=False) == other
            assert {path.name for path in tmp_path.iterdir()} == {".lock", layout.HUNT, place.scratch.name}
        else:
            with pytest.raises(HuntDirectoryError, match="the directory contains another hunt: max_steps"):
                place.claim(other, ["crashhunt"], overwrite=False, seed_given=True)
            assert (tmp_path / folder).exists()


def test_logs_are_read_from_their_ends_with_their_titles(tmp_path, monkeypatch):
    monkeypatch.setattr(_log_reader, "_MAX_LOG_BYTES", 10)
    for folder, text in (("", "x" * 20), ("crashes/000007-collision", "crash"), ("trials/000003", "trial"),
                         ("crashes/notes", "other")):  # fmt: skip
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
        (tmp_path / folder / "run.log").write_text(text)
    (tmp_path / "trials/000003/error.log").write_text("it failed")
    (tmp_path / "crashes/000007-collision/error.log").write_text(" \n")
    reader = LogReader(tmp_path, ("run", "error"))
    assert list(reader.fresh()) == [
        ("run", "x" * 10), ("trial 3, run", "trial"), ("trial 3, error", "it failed"), ("trial 7, run", "crash"),
    ]  # fmt: skip
    assert list(reader.fresh()) == []
    with (tmp_path / "run.log").open("a") as file:
        file.write("more")
    assert list(reader.fresh()) == [("run", "more")]
    assert list(LogReader(tmp_path, ("error",), trial=3).fresh()) == [("trial 3, error", "it failed")]
    assert list(LogReader(tmp_path, ("run", "state"), trial=7).fresh()) == [("trial 7, run", "crash")]
    with closing(Ledger(tmp_path / layout.LEDGER, writable=True)) as ledger:
        ledger.enter("running")
    states = LogReader(tmp_path, ("state",))
    ((title, text),) = states.fresh()
    assert title == "state"
    assert text.endswith("  running")
    with closing(Ledger(tmp_path / layout.LEDGER, writable=True)) as ledger:
        ledger.enter("error", "no disk")
    ((_, text),) = states.fresh()
    assert text.endswith("  error  no disk")
    assert "\n" not in text


# Crashes that run again.


@dataclass(frozen=True)
class Bundle:
    """In place of the bundle of a crash."""

    id: str
    path: Path = Path()
    confirmed: bool | None = None
    result: object = result(0)
    snapshot: str = "0f"
    written: list = None

    def write(self):
        self.written.append(self)


def reruns(tmp_path, stops=(), **more):
    setup = SimpleNamespace(
        place=SimpleNamespace(path=tmp_path, scratch=tmp_path / "scratch"), settings=SETTINGS, parallel_here=2,
        stops=stops, snapshot=SimpleNamespace(digest="0f"),
    )  # fmt: skip
    given = {"setup": setup, "ledger": None, "progress": Progress(), "executors": "executors", "phases": None}
    return TrialReruns(**given | more)


def test_crash_is_confirmed_once_and_written_if_it_is_still_there(tmp_path, monkeypatch):
    asked, written = [], []
    bundle = Bundle("a", tmp_path, written=written)

    def confirm(given, stopped, *, failed, executors, trusted):
        asked.append((given, stopped(), failed, executors, trusted))
        return found

    monkeypatch.setattr(_verification, "confirm", confirm)
    monkeypatch.setattr(_verification, "is_bundle_made_here", lambda given: True)
    again, found = reruns(tmp_path), replace(bundle, confirmed=True)
    assert again.confirm_one(bundle) is found
    assert written == [found]
    assert asked == [(bundle, False, again.progress.failed, "executors", True)]
    assert again.confirm_one(replace(bundle, snapshot="other")) is found
    assert asked[-1][-1] is None
    for unchanged in (
        lambda: again.confirm_one(found),
        lambda: again.confirm_one(bundle, lambda: True),
        lambda: reruns(tmp_path, stops=(2,)).confirm_one(bundle),
    ):
        count = len(asked)
        assert unchanged() in (found, bundle)
        assert len(asked) == count
    half = replace(found, result=result(0, why_no_escape="killed"))
    assert not is_settled(half)
    assert again.confirm_one(half) is found
    written.clear()
    gone = replace(bundle, path=tmp_path / "gone")
    assert again.confirm_one(gone) is gone
    found = None
    assert again.confirm_one(bundle) is bundle
    assert written == []

    def refuses(*given, **more):
        raise UntrustedError("it is not yours", fix="trust it")

    monkeypatch.setattr(_verification, "confirm", refuses)
    for _ in range(2):
        assert again.confirm_one(bundle) is bundle
    assert again.progress.notes == ["a was not confirmed: it is not yours; trust it"]


def test_crash_that_is_deleted_while_it_is_written_stays_unconfirmed(tmp_path, monkeypatch):
    class Deleted(Bundle):
        def write(self):
            if not kept:
                self.path.rmdir()
            raise HuntDirectoryError("cannot be written", fix="x")

    kept, bundle = False, Deleted("a", tmp_path / "a")
    monkeypatch.setattr(_verification, "confirm", lambda given, *_, **__: replace(given, confirmed=True))
    monkeypatch.setattr(_verification, "find_cause", lambda given, *_, **__: ("cause", replace(given, confirmed=True)))
    monkeypatch.setattr(_verification, "is_bundle_made_here", lambda given: True)
    again = reruns(tmp_path)
    for run, wanted in (
        (again.confirm_one, bundle),
        (again.judge_one, Judged(replace(bundle, confirmed=True), "cause")),
    ):
        kept = False
        bundle.path.mkdir()
        assert run(bundle) == wanted
        kept = True
        bundle.path.mkdir()
        with pytest.raises(HuntDirectoryError):
            run(bundle)
        bundle.path.rmdir()


def test_crashes_are_confirmed_in_a_phase_and_stay_in_order(tmp_path):
    began = []
    phases = SimpleNamespace(
        begin=lambda *given: began.append(given),
        run=lambda function, items, *, counts: [replace(item, confirmed=True) for item in items],
    )
    again = reruns(tmp_path, phases=phases)
    crashes = [Bundle("a"), Bundle("b", confirmed=False), Bundle("c")]
    assert [(one.id, one.confirmed) for one in again.confirm(crashes)] == [("a", True), ("b", False), ("c", True)]
    assert began == [("confirming", 3, 1)]
    assert again.confirm(crashes[1:2]) == crashes[1:2]
    assert len(began) == 1


def test_cause_of_a_crash_is_written_unless_it_was_stopped(tmp_path, monkeypatch):
    written, asked = [], []
    bundle = Bundle("a", tmp_path, written=written)
    other = replace(bundle, confirmed=True)
    answer = ["cause", other]

    def find(given, options, *, stopped):
        asked.append((options.force, options.trusted, stopped()))
        if isinstance(answer[0], Exception):
            raise answer[0]
        return tuple(answer)

    monkeypatch.setattr(_verification, "find_cause", find)
    monkeypatch.setattr(_verification, "is_bundle_made_here", lambda given: False)
    again = reruns(tmp_path)
    assert again.judge_one(bundle) == Judged(other, "cause")
    assert written == [other]
    assert asked == [(True, None, False)]
    answer[1] = bundle
    again.judge_one(bundle)
    answer[1] = other
    again.judge_one(replace(bundle, path=tmp_path / "gone"))
    assert written == [other]
    answer[1] = other
    assert again.judge_one(bundle, lambda: True) == Judged(bundle, is_stopped=True)
    assert reruns(tmp_path, stops=(2,)).judge_one(bundle) == Judged(bundle, is_stopped=True)
    answer[0] = CrashhuntError("no map", fix="x")
    assert again.judge_one(bundle) == again.judge_one(bundle) == Judged(bundle)
    assert again.progress.notes == ["a was not judged: no map"]
    assert written == [other]


def test_trials_run_again_with_the_code_that_they_ran_with(tmp_path, monkeypatch):
    made, removed = [], []
    again = reruns(
        tmp_path, ledger=SimpleNamespace(snapshot_of=lambda number: "0f" if number < 5 else "99"),
        phases=SimpleNamespace(tick=lambda: None),
    )  # fmt: skip
    again.setup.place.scratch.mkdir()
    monkeypatch.setattr(_verification, "Snapshot", lambda path: path)
    monkeypatch.setattr(_verification, "is_snapshot_trusted", lambda snapshot: snapshot.name == "trusted")
    monkeypatch.setattr(_verification, "settings_again", lambda *given: given)
    monkeypatch.setattr(_verification, "remove_scratch", removed.append)

    class Runs:
        closed = 0

        def __init__(self, *given, parallel, stopped):
            made.append((given, parallel))
            self.stopped = stopped

        def run(self, specs, *, recorded):
            assert not recorded
            assert not self.stopped()
            yield from (ran(place, one.number) for place, one in enumerate(specs))
            raise StoppedError  # which is no error

        def close(self):
            Runs.closed += 1

    def ran(place, number):
        return EndedRun(place, result(number), None, tmp_path / "scratch/near" / f"trial-{number:06d}")

    monkeypatch.setattr(_verification, "Reruns", Runs)
    specs = [TrialSpec(number, 1, {}, {}, 9) for number in (1, 7, 2)]
    found = list(again.run(specs, "near"))
    scratch = tmp_path / "scratch/near"
    assert found == [
        RepeatedTrial(ended=ran(place, number), runs=again, snapshot="0f", folder="near")
        for place, number in enumerate((1, 2))
    ]
    assert made == [(((SETTINGS, tmp_path / layout.SNAPSHOTS / "0f", scratch), "snapshot"), 2)]
    assert (removed, Runs.closed) == ([scratch], 1)
    (note,) = again.progress.notes
    assert note.startswith("1 trials for near did not run again: nothing proves that you took the snapshot 99 ")
    written = []
    monkeypatch.setattr("crashhunt.trial_reruns.read_map", lambda folder, trial: (folder, trial.name))
    monkeypatch.setattr(_verification, "write_bundle", lambda *given, **more: written.append((given, more)) or "bundle")
    assert found[0].write(result(1), confirmed=True) == "bundle"
    (((where, what, trial), more),) = written
    assert (where, what, trial.name) == (tmp_path, result(1), "trial-000001")
    assert more == {"hunt_seed": 3, "snapshot": "0f", "lanes": (scratch, "trial-000001"), "place": "near",
                    "confirmed": True}  # fmt: skip


class Runs:
    """In place of what runs crashes again: it waits until it may go on."""

    def __init__(self):
        self.asked, self.go, self.held = queue.SimpleQueue(), threading.Event(), []

    def confirm_one(self, bundle, stopped):
        self.asked.put(("confirm", bundle.id))
        assert self.go.wait(300)
        return bundle if stopped() else replace(bundle, confirmed=True)

    def judge_one(self, bundle, stopped):
        self.asked.put(("judge", bundle.id))
        assert self.go.wait(300)
        return Judged(bundle, "cause")


def test_crashes_are_confirmed_while_the_hunt_runs():
    runs, settled = Runs(), []
    executor = PoolExecutor.__new__(PoolExecutor)
    executor.held_back = 0
    wanted = [Bundle("b"), None, None, None]
    kinds = SimpleNamespace(settle=settled.append, next_to_judge=lambda: wanted.pop(0) if wanted else None)
    progress = SimpleNamespace(kinds=None, crashes=[Bundle("a"), Bundle("b"), Bundle("c", confirmed=False)])
    progress.replace = lambda crashes: setattr(progress, "crashes", crashes)
    confirmation = Confirmation(runs, executor)
    confirmation.look(progress)  # the first crash ends the hunt
    assert confirmation._thread is None
    progress.kinds = kinds
    confirmation.look(progress)
    assert runs.asked.get(timeout=300) == ("confirm", "a")
    assert executor.held_back == 1
    confirmation.look(progress)
    runs.go.set()
    assert [runs.asked.get(timeout=300) for _ in range(2)] == [("judge", "b"), ("confirm", "b")]
    deadline = time.monotonic() + 300
    while len(settled) < 1 or sum(bool(one.confirmed) for one in progress.crashes) < 2:
        assert time.monotonic() < deadline
        confirmation.look(progress)
        time.sleep(0.001)
    assert [one.confirmed for one in progress.crashes] == [True, True, False]
    assert settled == [Judged(Bundle("b"), "cause")]
    confirmation.close(progress)
    assert not confirmation._thread.is_alive()
    assert executor.held_back == 0
    assert runs.asked.empty()


def test_error_in_the_confirmation_of_a_crash_leaves_it_to_the_end_of_the_hunt_and_not_the_others():
    asked = queue.SimpleQueue()

    def confirm(bundle, stopped=lambda: False):
        asked.put(bundle.id)
        if bundle.id == "a":
            raise RuntimeError("a defect")
        return replace(bundle, confirmed=True)

    progress = SimpleNamespace(crashes=[Bundle("a"), Bundle("b")])
    progress.kinds = SimpleNamespace(next_to_judge=lambda: None)
    progress.replace = lambda crashes: setattr(progress, "crashes", crashes)
    confirmation = Confirmation(SimpleNamespace(confirm_one=confirm), None)
    confirmation.look(progress)
    assert [asked.get(timeout=300) for _ in range(2)] == ["a", "b"]
    confirmation.close(progress)
    assert [one.confirmed for one in progress.crashes] == [None, True]
    with pytest.raises(RuntimeError, match="a defect"):  # the end of the hunt confirms it again, and reports the error
        PhaseClock(lambda _: None, 1).run(confirm, progress.crashes[:1])


def test_crash_whose_cause_was_not_searched_for_before_the_end_of_the_hunt_is_chosen_again():
    settled, judged = [], []
    begun = threading.Event()

    def confirm(bundle, stopped):
        begun.set()
        while not stopped():
            time.sleep(0.001)
        return bundle

    wanted = [None, Bundle("a")]
    progress = SimpleNamespace(crashes=[Bundle("a")], replace=lambda crashes: None)
    progress.kinds = SimpleNamespace(settle=settled.append, next_to_judge=lambda: wanted.pop(0))
    runs = SimpleNamespace(confirm_one=confirm, judge_one=lambda bundle, stopped: judged.append(bundle))
    confirmation = Confirmation(runs, None)
    confirmation.look(progress)
    assert begun.wait(300)
    confirmation.look(progress)  # the search waits for the end of the confirmation
    confirmation.close(progress)
    assert judged == []
    assert settled == [Judged(Bundle("a"), is_stopped=True)]


def test_hunt_is_hopeless_once_enough_trials_could_not_be_set_up():
    def hopeless(invalid, survived=0, trials=900, parallel=2):
        settings = replace(SETTINGS, trials=trials, run=RunSettings(parallel=parallel))
        return _preflight.is_hopeless(settings, {"invalid": invalid, "survived": survived})

    enough = _preflight._MAX_INVALID_AT_START
    assert [hopeless(enough - 1), hopeless(enough), hopeless(enough + 1)] == [False, True, True]
    assert not hopeless(enough, survived=1)
    assert [hopeless(2, trials=3), hopeless(3, trials=3)] == [False, True]
    assert [hopeless(2 * enough - 1, parallel=enough), hopeless(2 * enough, parallel=enough)] == [False, True]


def test_report_of_a_hunt_has_what_it_was_asked_for(tmp_path):
    part = SimpleNamespace(to_json=lambda: "part")
    crash = SimpleNamespace(summary=lambda: "crash", path=tmp_path / "crash")
    plain = HuntReport(
        directory=tmp_path, settings=SETTINGS, stopped_because="all_trials", outcomes={"survived": 4, "collision": 1},
        trial_steps={}, steps_total=70, wall_s=1.23456, crashes=(crash,), reason="", notes=("a note",),
        events={"hard_braking": (3, 2)}, audit=None, unanswered=1, unconfirmed=2,
    )  # fmt: skip
    assert plain.to_json() == {
        "dir": str(tmp_path), "hunt_seed": 3, "trials_planned": 9, "trials_run": 5,
        "outcomes": {"survived": 4, "collision": 1}, "stopped_because": "all_trials", "wall_s": 1.235,
        "steps_total": 70, "events": {"hard_braking": {"count": 3, "trials": 2}}, "crashes_found": 0,
        "crashes": ["crash"], "notes": ["a note"], "audit": None, "unanswered": 1, "unconfirmed": 2,
    }  # fmt: skip
    near = replace(SETTINGS, run=replace(SETTINGS.run, near_misses=2))
    more = replace(
        plain, audit=part, probes=part, branches=part, kinds=(), types_by_cause=2, settings=near, near_misses=(crash,),
        at_fault=(4,), copied=crash, rare=part, rate=part,
    ).to_json()  # fmt: skip
    assert {name: more[name] for name in more.keys() - plain.to_json().keys() | {"audit"}} == {
        "audit": "part", "probes": "part", "branches": "part", "kinds": [], "types_by_cause": 2,
        "near_misses": ["crash"], "at_fault": [4], "copied": str(crash.path), "rare": "part", "rate": "part",
    }  # fmt: skip


def test_columns_of_a_table_have_the_kinds_of_their_arguments():
    def spec(kind):
        return ArgumentSpec(spec="1", kind=kind)

    agents = {"ego": AgentSettings(agent="x", arguments={"speed": spec("int"), "mode": spec(None), "gap": spec(None)})}
    settings = replace(SETTINGS, agents=agents, scenario_arguments={"rain": spec("bool"), "who": spec("str")})
    columns = ("number", "outcome", "scenario.rain", "scenario.who", "ego.speed", "ego.mode", "ego.gap", "danger")
    batch = [{"ego.mode": "fast", "ego.gap": 2}, {"ego.mode": 1, "ego.gap": None}]
    assert _results._kinds(SimpleNamespace(settings=settings, columns=columns), batch) == {
        "number": "Int64", "outcome": "String", "scenario.rain": "Boolean", "scenario.who": "String",
        "ego.speed": "Int64", "ego.mode": "String", "ego.gap": "Float64", "danger": "Float64",
    }  # fmt: skip


def test_report_of_copies_has_each_count_under_its_name(tmp_path):
    crash = SimpleNamespace(summary=lambda: "crash")
    counted = {"trials": 1, "moments": 2, "branches": 3, "steps": 4, "left_out": 5, "crashed": 6, "crashed_trials": 7,
               "not_fully_asked": 8}  # fmt: skip
    earlier = {"run_again": None, "confirmed": None}
    branches = BranchReport({**counted, **earlier}, "killed", run_again=9, not_finished=10, crashes=(crash, crash))
    assert branches.to_json() == {
        **counted, "run_again": 9, "not_finished": 10, "confirmed": 2, "crashes": ["crash", "crash"]
    }  # fmt: skip
    assert list(branches.to_json())[-4:] == ["run_again", "not_finished", "confirmed", "crashes"]
    sums = {"trials": 3, "not_fully_asked": 1, "least": 0.25, "probes": 2, "steps": 3, "left_out": 4}
    probes = ProbeReport(
        {**sums, **earlier, "trial": 8, "crashed_trials": 9}, margins=(0.5, 0.25, 1.0), why_unasked="killed",
        run_again=5, not_finished=6, crashes=(crash,), by=(),
    )  # fmt: skip
    assert probes.to_json() == {
        **sums, "median": 0.5, "run_again": 5, "not_finished": 6, "confirmed": 1, "crashes": ["crash"]
    }  # fmt: skip
    assert replace(probes, margins=()).to_json()["median"] is None
    rare = RareReport(SimpleNamespace(to_json=lambda: {"estimate": 0.1}), run_again=3, not_finished=1, crashes=(crash,))
    assert rare.to_json() == {
        "estimate": 0.1, "run_again": 3, "not_finished": 1, "confirmed": 1, "crashes": ["crash"],
    }  # fmt: skip
    group = SimpleNamespace(
        signature="rear-end", count=4, first=SimpleNamespace(id="a"), shortest=SimpleNamespace(id="b")
    )
    assert kind_data(group) == {"words": "rear-end", "count": 4, "first": "a", "shortest": "b"}


@pytest.mark.parametrize(
    ("step", "agent", "says"),
    [
        (None, "", "trial 7 differs when replayed in a new process: the digest was a and is b"),
        (0, "ego", "trial 7 differs when replayed in a new process: at step 0, the digest of ego was a and is b"),
    ],
)
def test_difference_of_an_audit_is_a_sentence(step, agent, says):
    found = Difference(trial=7, step=step, agent=agent, field="the digest", recorded="a", replayed="b")
    assert str(found) == says


RARE = RareEstimate(
    roots=60, estimate=0.0123, undisturbed=0.0023, disturbed=0.01, estimated=Estimated(0.005, 0.02, 41.6, 0.1, 9),
    estimated_disturbed=Estimated(0.004, 0.019, 40.0, 0.1, 9), why_not="", why_not_disturbed="", more_roots=None,
    certain=(0.001, 0.08), excluded=0, parts={f"cell{number}": 0.001 * number for number in range(1, 7)},
    undisturbed_crashes=5, plain=239, plain_crashes=4, steps=9000, plain_steps=700, plain_equivalent_steps=1.2e6,
    confidence=0.95,
)  # fmt: skip


def lines_of(verified=0, crashes=(), **changes):
    return RareReport(replace(RARE, **changes), verified, 0, crashes).lines


CERTAIN = "  certain: at least 0.001, at most 0.08 (95 %; 4 of 239 plain trials crashed)"
OMITS = "  the estimate omits failures that no copy has met; the certain bounds include them"


def test_estimate_of_rare_mode_is_explained_line_by_line():
    cells = "; ".join(f"cell{number} 0.00{number} ({number}0 %)" for number in range(1, 6))
    assert lines_of(verified=3, crashes=("a", "b")) == [
        "rare: 0.0123 per trial (0.005 to 0.02, estimated from 60 roots; effective sample size 42)",
        f"  undisturbed 5 of 299 trials; {cells}",
        "  5 of 6 parts shown; run --json has all of them",
        "  with a disturbance: 0.01 per trial (0.004 to 0.019)",
        "  9000 steps, 700 of them in plain trials; plain trials alone need about 1.2e6 steps",
        "  of the 3 weightiest crashes, 2 came again from the start",
        CERTAIN, OMITS,
    ]  # fmt: skip
    few = lines_of(parts={f"cell{number}": 0.002 for number in range(5)}, undisturbed_crashes=0, certain=None)
    assert [line[:30] for line in few[1:]] == [
        "  undisturbed 0 of 299 trials;", "  9000 steps, 700 of them in p", OMITS[:30],
    ]  # fmt: skip


def test_estimate_of_rare_mode_without_an_interval_gives_the_reason():
    found = lines_of(estimated=None, why_not="few crashes", more_roots=20, plain_equivalent_steps=None)
    assert found[0] == "rare: 0.0123 per trial"
    more = f"about {20 * TRIALS_PER_ROOT} more trials are needed"
    assert found[1] == f"  no interval (60 roots with their copies): few crashes; {more}"
    assert not any("steps" in line for line in found)
    found = lines_of(estimate=0.0, estimated=None, why_not="no crash", disturbed=0.0, estimated_disturbed=None)
    assert found[0] == "rare: no crash yet"
    assert found[1] == "  no interval (60 roots with their copies): no crash"
    assert found[2] == "  undisturbed 5 of 299 trials"  # nothing is divided by an estimate of zero
    nothing = {"estimate": None, "estimated": None}
    assert lines_of(**nothing, why_not="", roots=60) == ["rare: no estimate: no root has ended"]
    assert lines_of(**nothing, why_not="few", roots=0) == ["rare: no estimate: few", CERTAIN]
