"""What is run again for a hunt counts only where it does the same, and what a hunt knows of itself while it runs."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from crashhunt.base import layout
from crashhunt.base.errors import BundleError, CrashhuntError
from crashhunt.episode import WorkerSettings, scratch_of
from crashhunt.executors import NodeFigures
from crashhunt.hunts import _audits, _progress, _verification
from crashhunt.hunts._audits import Audit, PendingAudits, _finish
from crashhunt.hunts._progress import PhaseClock, Progress, RemainingTime, StrategyTally
from crashhunt.hunts._verification import ForkCrash, Judged, TrialReruns, VerificationRuns
from crashhunt.plans import RunSettings
from crashhunt.recording import Divergence
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.trial import (
    KILLED,
    Branch,
    Branches,
    Collision,
    Disturbance,
    Failure,
    Outcome,
    Stress,
    TrialResult,
    TrialSpec,
)

HIT = Collision("ego", "collider", "ego", "b", ("overlap",), "overlap", 1.0, 2.0)


def spec(number, **more):
    return TrialSpec(number, number, {}, {}, 20, **more)


def result(number, outcome=Outcome.SURVIVED, **more):
    return TrialResult(spec(number), outcome, **{"steps": 5, "digest": f"{number:032x}"} | more)


KILL = Failure(KILLED, "killed 3 times", exit_code=-9)


def killed(number):
    return result(number, Outcome.INVALID, failure=KILL)


class Phases:
    """In place of the progress of a hunt: it notes what is begun, and runs all in this thread."""

    def __init__(self):
        self.calls = []

    def begin(self, *given):
        self.calls.append(given)

    def advance(self):
        self.calls.append("one")

    def run(self, function, items, *, counts=lambda one: True):
        found = [function(item) for item in items]
        self.calls += ["counted" for one in found if counts(one)]
        return found


@dataclass
class Again:
    """In place of what runs trials again: `ends` are the results."""

    place: object
    ends: list
    is_stopped: bool = False

    def __post_init__(self):
        self.phases, self.progress, self.asked, self.written = Phases(), Progress(), [], []
        self.setup = SimpleNamespace(place=self.place)

    def run(self, specs, folder):
        self.asked.append(([one.number for one in specs], folder))
        for end in self.ends:
            if isinstance(end, Exception):
                raise end
            yield SimpleNamespace(result=end, scratch=self.place.path / "scratch", write=self.write)

    def write(self, given):
        bundle = Bundle(given, self.place.path / "near" / f"{given.spec.number:06d}")
        bundle.path.mkdir(parents=True)
        self.written.append(given)
        return bundle


@dataclass(frozen=True)
class Bundle:
    """In place of the bundle of a crash."""

    result: TrialResult
    path: Path = Path()
    confirmed: bool | None = None

    @property
    def id(self):
        return f"{self.result.spec.number:06d}"

    def write(self):
        (self.path / "written").touch()


@pytest.fixture
def again(tmp_path):
    def make(*ends, **more):
        return Again(SimpleNamespace(path=tmp_path), list(ends), **more)

    return make


def found(number, outcome="collision", step=5):
    return ForkCrash(spec(number), outcome, step)


def crash(number, **more):
    return result(number, Outcome.COLLISION, collision=HIT, **more)


@pytest.fixture
def confirms(monkeypatch):
    """How each crash is confirmed, by its number; none that is missing is stopped."""
    verdicts = {}

    def confirm(bundle, stopped, *, failed, trusted):
        assert (stopped(), trusted) == (False, True)
        verdict = verdicts.get(bundle.result.spec.number, True)
        return None if verdict == "stopped" else replace(bundle, confirmed=verdict)

    monkeypatch.setattr(_verification, "confirm", confirm)
    return verdicts


def test_crashes_of_forks_count_where_they_come_again_from_the_start(again, confirms, tmp_path):
    confirms.update({5: False, 6: None, 7: "stopped"})
    late = result(9, Outcome.HANG)  # as on a busy machine: it is run again by the same command
    runs = again(crash(1), crash(2, steps=6), result(3), killed(4), *map(crash, (5, 6, 7)), late)
    (tmp_path / "near/old").mkdir(parents=True)
    disturber = SimpleNamespace(log_likelihood_of=lambda given: -2.0)
    crashes, unanswered = VerificationRuns(runs, disturber).crashes([found(n) for n in range(1, 10)], "near", "probes")
    assert [(one.id, one.confirmed, one.result.log_likelihood) for one in crashes] == [("000001", True, -2.0)]
    assert unanswered == 5  # 4, 6, 7, 8 and 9
    assert runs.asked == [([1, 2, 3, 4, 5, 6, 7, 8, 9], "near")]
    assert [one.spec.number for one in runs.progress.failed] == [2, 3, 5, 6, 7]
    assert [path.name for path in (tmp_path / "near").iterdir()] == ["000001"]
    assert (tmp_path / "near/000001/written").exists()
    assert runs.phases.calls[0] == ("probes", 18)
    assert runs.phases.calls.count("one") == 8


def test_verified_crash_of_a_fork_is_kept_and_not_run_again(again, confirms, tmp_path):
    runs = again(crash(1))
    verified = VerificationRuns(runs, None)
    bundle = verified.crash(found(1), "near")
    assert (bundle.id, bundle.result.log_likelihood) == ("000001", None)
    runs.ends[:] = [crash(2)]
    (tmp_path / "near/old").mkdir()
    crashes, unanswered = verified.crashes([found(2), found(1)], "near", "branches")
    assert ([one.id for one in crashes], unanswered) == (["000002", "000001"], 0)
    assert runs.asked == [([1], "near"), ([2], "near")]
    assert runs.phases.calls[-4:] != []
    assert ("branches", 2) in runs.phases.calls
    assert sorted(path.name for path in (tmp_path / "near").iterdir()) == ["000001", "000002"]
    runs.ends[:] = [crash(3, steps=9)]
    assert verified.crash(found(3), "near") is None
    calls = list(runs.phases.calls)
    runs.ends.clear()
    assert [one.id for one in verified.crashes([found(1)], "near", "probes")[0]] == ["000001"]
    assert runs.phases.calls == calls  # nothing has begun
    runs.is_stopped = True
    assert verified.is_stopped
    assert verified.crashes([found(1)], "near", "probes") == ((), 0)
    assert verified.crash(found(1), "near") is None
    assert (tmp_path / "near/000001").is_dir()


def test_fork_whose_trial_cannot_run_is_noted(again, confirms):
    runs = again(crash(1), CrashhuntError("no map", fix="draw one"))
    crashes, unanswered = VerificationRuns(runs, None).crashes([found(1), found(2)], "near", "probes")
    assert ([one.id for one in crashes], unanswered) == (["000001"], 1)
    assert runs.progress.notes == ["what copies have found could not be run from the start: no map; draw one"]


def test_causes_are_searched_one_after_another(tmp_path):
    wanted, settled, asked = [Bundle(crash(1)), Bundle(crash(2))], [], []
    phases = Phases()
    kinds = SimpleNamespace(
        count_to_judge=lambda: len(wanted), next_to_judge=lambda: wanted.pop(0) if wanted else None,
        settle=settled.append,
    )  # fmt: skip
    progress = SimpleNamespace(kinds=kinds, crashes=[Bundle(crash(2)), Bundle(crash(9))])
    progress.replace = lambda crashes: setattr(progress, "crashes", crashes)
    setup = SimpleNamespace(stops=[])

    class Runs(TrialReruns):
        def judge_one(self, bundle, stopped=lambda: False):
            asked.append(bundle.id)
            return Judged(replace(bundle, confirmed=True), "cause", is_stopped=bundle.id == "000001")

    runs = Runs(setup, None, progress, None, phases)
    runs.judge()
    assert asked == ["000001", "000002"]
    assert [one.is_stopped for one in settled] == [True, False]
    assert phases.calls == [("causes", 2), "counted"]
    assert [one.confirmed for one in progress.crashes] == [True, None]
    runs.judge()  # nothing is left
    progress.kinds = None
    runs.judge()
    assert len(phases.calls) == 2
    wanted[:] = [Bundle(crash(3))]
    progress.kinds = kinds
    setup.stops.append(2)
    runs.judge()
    assert len(asked) == 2


# The audit.


@pytest.fixture
def audit(tmp_path, monkeypatch):
    """Makes an audit whose trials end as the next of `ends`; equal recordings have no divergence."""
    executors = []

    class Executor:
        def __init__(self, settings):
            self.settings, self.capacity, self.specs, self.ends, self.closed = settings, 1, [], [], False
            executors.append(self)

        def submit(self, given):
            self.specs.append(given)

        def completed(self, timeout_s):
            self.timeout_s = timeout_s
            ends, self.ends = self.ends, []
            yield from ends

        def close(self):
            self.closed = True

    def read(path):
        if "damaged" in path.read_text():
            raise BundleError("damaged")
        return path.read_text()

    def divergence(recorded, replayed):
        if recorded == replayed:
            return None
        return Divergence(step=4, agent="ego", field="x", recorded=recorded, replayed=replayed)

    monkeypatch.setattr(_audits, "FreshProcessExecutor", Executor)
    monkeypatch.setattr(_audits, "read_black_box", read)
    monkeypatch.setattr(_audits, "Recording", lambda content: content)
    monkeypatch.setattr(_audits, "first_divergence", divergence)
    scenario = Scenario(simulator="toy", agents={"ego": AgentSetup(agent="keep-lane")})
    settings = WorkerSettings(scenario=scenario, oracles=(), crash_on=(), scratch=tmp_path, audit=1.0)

    def make(**more):
        failed = []
        made = Audit(replace(settings, **more), failed)
        return made, executors[-1], failed

    make.settings = settings
    return make


def ran(tmp_path, number, text="same"):
    """Write the recording of a trial."""
    folder = scratch_of(tmp_path, number)
    folder.mkdir(parents=True)
    (folder / layout.BLACK_BOX).write_text(text)


def test_sampled_trials_are_run_again_and_compared(audit, tmp_path):
    made, executor, failed = audit()
    assert executor.settings.audit == 0.0
    assert executor.settings.keep_trials
    assert executor.settings.scratch == tmp_path / "audit"
    made.parallel = 3
    assert (made.parallel, executor.capacity) == (3, 3)
    assert made.look() == []
    for number in range(7):
        ran(tmp_path, number)
        assert made.add(result(number, kept=True)) == result(number, kept=False)
        assert not scratch_of(tmp_path, number).exists()
    assert [one.number for one in executor.specs] == [0, 1, 2, 3, 4, 5, 6]
    assert (made.waiting, made.left) == (7, [0, 1, 2, 3, 4, 5, 6])
    for number, text in ((0, "same"), (1, "other"), (2, "damaged"), (3, "same"), (5, "same"), (6, "other")):
        ran(tmp_path / "audit", number, text)
    executor.ends = [result(0), result(1), result(2), replace(result(3), outcome=Outcome.FINISHED), killed(4)]
    executor.ends += [replace(result(number), outcome=Outcome.HANG) for number in (5, 6)]  # as on a busy machine
    differences = made.look(0.5)
    assert executor.timeout_s == 0.5
    assert [(one.trial, one.step, one.agent, one.field, one.recorded, one.replayed) for one in differences] == [
        (1, 4, "ego", "x", "same", "other"), (3, 5, "", "the outcome", "survived", "finished"),
        (6, 4, "ego", "x", "same", "other"),
    ]  # fmt: skip
    assert [one.spec.number for one in failed] == [1, 3, 6]
    assert (made.report.trials, made.report.differences, made.report.not_finished) == (5, tuple(differences), 2)
    assert (made.waiting, made.left) == (0, [4, 5])
    assert list((tmp_path / "audit").iterdir()) == []
    made.close()
    assert executor.closed


def test_trial_that_is_not_sampled_or_is_kept_stays_as_it_is(audit, tmp_path):
    made, executor, _ = audit(audit=0.0)
    assert made.add(result(1, kept=True)) == result(1, kept=True)
    assert executor.specs == []
    made, executor, _ = audit(keep_trials=True)
    ran(tmp_path, 2)
    assert made.add(result(2, kept=True)) == result(2, kept=True)
    assert scratch_of(tmp_path, 2).is_dir()
    assert (tmp_path / "audit/recorded-000002" / layout.BLACK_BOX).read_text() == "same"


def test_audits_of_an_earlier_run_are_made_up_for(audit, again):
    ended = [result(4), result(5)]
    ledger = SimpleNamespace(
        results_where=lambda where, since: ended if since == 7.0 else [], remarks=[],
        result=lambda number: None if number == 9 else result(number, digest="" if number == 8 else f"{number:032x}"),
    )  # fmt: skip
    ledger.remark = ledger.remarks.append
    before = {"audits_left": [2], "state": "running", "heartbeat": 7.0}
    assert PendingAudits(ledger, before, audit.settings).numbers == [2, 4, 5]
    assert PendingAudits(ledger, before | {"state": "error"}, audit.settings).numbers == [2]
    assert PendingAudits(ledger, before, replace(audit.settings, audit=0.0)).numbers == []
    pending = PendingAudits(ledger, {"audits_left": [9, 2, 3, 8, 4]}, audit.settings)
    report = SimpleNamespace(trials=5, differences=(), not_finished=1)
    runs = again(result(2), result(3, digest="f" * 32), killed(4))
    progress, runs.ledger = runs.progress, ledger
    pending.note(SimpleNamespace(report=report, left=[7, 3]), progress)
    assert (progress.audit, progress.audits_left) == (report, [2, 3, 4, 7, 8, 9])
    pending.finish(runs)
    assert runs.asked == [([2, 3, 4], "audits")]
    assert (progress.audit.trials, progress.audit.not_finished) == (7, 2)
    ((trial, step, field),) = [(one.trial, one.step, one.field) for one in progress.audit.differences]
    assert (trial, step, field) == (3, None, "the digest")
    assert ledger.remarks[0].startswith("audit: ")
    assert [one.spec.number for one in progress.failed] == [3]
    assert progress.audits_left == [4, 7]
    assert runs.phases.calls == [("auditing", 3), "one", "one"]
    nothing = again()
    nothing.ledger = ledger
    assert _finish(nothing, [9])[1] == []
    assert nothing.phases.calls == []


# What runs again, and what a hunt knows.


def test_progress_of_a_hunt_ends_with_its_lowest_crash():
    progress = Progress()
    assert (progress.ended_here, progress.branched, progress.not_fully_asked, progress.failed_steps) == (0, 0, 0, 0)
    assert (progress.parallel, progress.until, progress.last_wanted) == (1, math.inf, None)
    assert not progress.is_done
    for number in (5, 3):
        progress.count(crash(number), crashed=True, planned=9)
    assert progress.ended_here == 2
    assert progress.last_wanted == 3
    assert progress.unsaved == crash(3)
    assert (progress.crash_count, progress.disturbed, progress.ended_by_copy) == (1, 0, None)
    progress.save(Bundle(crash(3)))
    assert (progress.unsaved, progress.crash_count) == (None, 1)
    assert progress.is_done
    progress.copied[1] = "bundle"
    assert (progress.last_wanted, progress.ended_by_copy, progress.unsaved) == (1, "bundle", None)
    assert [progress.why_stopped(keep_going=one) for one in (False, True)] == ["crash", "distinct"]
    progress.rate = SimpleNamespace(decided_at=None)
    assert not progress.is_done
    assert progress.last_wanted == 1
    progress.rate.decided_at = 0
    assert progress.is_done
    assert progress.last_wanted == 0
    assert progress.why_stopped(keep_going=False) == "rate"
    progress.until = time.monotonic() - 5
    assert progress.time_left_s == 0.0
    progress.until = time.monotonic() + 50
    assert progress.time_left_s == pytest.approx(50, abs=5)


def test_resumed_hunt_knows_which_types_it_wants(monkeypatch):
    made = []
    monkeypatch.setattr(_progress, "Kinds", lambda *given, **more: made.append((given, more)) or "kinds")
    noted = {"dropped": {"a": [1]}, "dropped_at_fault": [1], "dropped_judged": {"a": {"1": {"cause": None}}}}
    before = {"failed_steps": 7, "newest_kind": 5.0, **noted}
    for run, wanted in (
        (RunSettings(), None), (RunSettings(keep_going=True, distinct=4), 4), (RunSettings(only_at_fault=True), 1),
    ):  # fmt: skip
        made.clear()
        progress = Progress()
        progress.resume(["crash"], run, before, {3})
        assert (progress.crashes, progress.failed_steps) == (["crash"], 7)
        assert progress.kinds == (None if wanted is None else "kinds")
        if wanted is not None:
            more = {"only_at_fault": run.only_at_fault, "by_cause": 0, "apart": {3}, **noted}
            assert made == [((wanted, ["crash"], 5.0), more)]


def test_trials_that_run_again_do_not_count_twice_for_the_rate():
    counted, progress = [], Progress()
    progress.counted = SimpleNamespace(add=lambda one: counted.append(one.spec.number), running=lambda *, now: now)
    progress.counted_before = {1}
    for number in (1, 2):
        progress.count(result(number), crashed=False, planned=9)
    assert counted == [2]
    assert (progress.running_rate(), progress.running_rate(now=True)) == (False, True)
    progress.rare = SimpleNamespace(running=lambda *, now: "rare")
    assert progress.running_rate() == "rare"
    progress.counted = progress.rare = None
    assert progress.running_rate() is None
    progress.count(result(3, Outcome.INVALID), crashed=True, planned=9)
    assert progress.last_invalid is None
    progress.count(result(4, Outcome.INVALID), crashed=False, planned=9)
    assert progress.last_invalid == result(4, Outcome.INVALID)


def test_age_of_the_newest_type_has_trials_and_seconds():
    progress = Progress()
    assert progress.about_kinds() == (None, None, None)
    progress.kinds = SimpleNamespace(newest=None, newest_trial=None, groups=lambda *, running: ("groups", running))
    assert progress.about_kinds(running=True) == (("groups", True), None, None)
    progress.kinds.newest, progress.kinds.newest_trial, progress.ended_here = time.time() - 30, 4, 11
    _, since_s, trials = progress.about_kinds()
    assert (since_s, trials) == (pytest.approx(30, abs=5), 7)


def test_ledger_records_failed_runs_and_the_phase():
    progress = Progress()
    assert progress.noted().keys() == {"heartbeat", "elapsed_s", "phase", "ends_at", "running_rate", "under_way"}
    progress.failed_steps, progress.failed = 7, [result(1, steps=3), result(2, steps=4)]
    progress.ends_at = 5.0
    progress.rate = SimpleNamespace(noted=lambda: "bar", decided_at=None)
    progress.audit, progress.audits_left = "report", []
    noted = progress.noted()
    assert noted["failed_steps"] == 14 + sum(one.other_steps for one in progress.failed)
    assert (noted["ends_at"], noted["until_rate"], noted["audits_left"], noted["phase"]) == (5.0, "bar", None, None)
    progress.audits_left = [3]
    assert progress.noted()["audits_left"] == [3]


def test_strategies_count_trials_of_earlier_runs(monkeypatch):
    clock = SimpleNamespace(now=50.0)
    monkeypatch.setattr(_progress.time, "monotonic", lambda: clock.now)
    tally = StrategyTally()
    assert tally.status() == _progress.SearchStatus()
    tally.resume(6, [("a", 4, 2, 0.5, 1), ("b", 2, 0, 0.0, 0)])
    tally.take(result(1), crashed=False)  # by no strategy
    tally.take(TrialResult(spec(2, origin="b"), Outcome.COLLISION, steps=1), crashed=True)
    tally.take(TrialResult(spec(3, origin="b"), Outcome.SURVIVED, steps=1, danger=0.25), crashed=False)
    tally.grow()
    clock.now = 60.0
    before = tally.status()
    assert (before.grown_trials, before.grown_s) == (0, 10.0)
    tally.take(TrialResult(spec(4, origin="c"), Outcome.SURVIVED, steps=1), crashed=False)
    status = tally.status()
    assert status.grown_trials == 1
    assert [(one.name, one.trials, one.share, one.danger, one.crashes) for one in status.strategies] == [
        ("a", 4, 0.4, 0.25, 1), ("b", 4, 0.4, 0.625, 1), ("c", 1, 0.1, None, 0),
    ]  # fmt: skip


def test_time_left_is_a_mean_of_the_last_batch():
    remaining = RemainingTime(0.0)
    for now, left in ((10.0, 3), (20.0, 2)):
        remaining.ended(now, left, 1)
    assert remaining.seconds_left(20.0, 2, 1) == pytest.approx(20.0)
    assert remaining.seconds_left(25.0, 2, 1) == pytest.approx(15.0)
    assert remaining.seconds_left(39.9, 2, 1) == 1.0
    two = RemainingTime(0.0)
    for now, left in ((10.0, 4), (10.0, 3), (20.0, 2), (22.0, 1)):
        two.ended(now, left, 2)
    # 20 + 2 trials at 2 in 10 s, and 22 + 1 trial at 4 in 22 s.
    assert two.seconds_left(22.0, 1, 2) == pytest.approx(((20 + 10) + (22 + 5.5)) / 2 - 22)


def test_phase_is_shown_ten_times_a_second_at_most(monkeypatch):
    clock = SimpleNamespace(now=50.0)
    monkeypatch.setattr(_progress.time, "monotonic", lambda: clock.now)
    shown = []
    phases = PhaseClock(shown.append, 0)
    phases.tick(force=True)
    assert shown == []
    phases.begin("confirming", 4, 1)
    for now in (50.05, 50.09, 50.1, 50.15, 50.25):
        clock.now = now
        phases.tick()
    assert [(one.name, one.done, one.total, one.seconds_left) for one in shown] == [("confirming", 1, 4, None)] * 3
    clock.now = 52.0
    phases.advance()
    assert (shown[-1].done, shown[-1].seconds_left) == (2, pytest.approx(4.0))


def test_each_finished_trial_updates_the_time_left(monkeypatch):
    clock = SimpleNamespace(now=50.0)
    monkeypatch.setattr(_progress.time, "monotonic", lambda: clock.now)
    ended, progress = [], Progress(parallel=3)
    progress.remaining = SimpleNamespace(ended=lambda *given: ended.append(given))
    progress.outcomes.update({"survived": 4})
    for number in range(3):
        progress.count(result(number), crashed=False, planned=6)
    assert ended == [(50.0, 1, 3), (50.0, 0, 3), (50.0, 0, 3)]


def test_trials_that_crashed_or_failed_are_no_near_misses_but_their_forks_count():
    progress = Progress()
    branch = Branch((), 1, "collision", 5, -2.0)
    forks = {"branches": Branches(crashes=(branch, branch))}
    progress.count(result(1, danger=0.9, collision=HIT, **forks), crashed=False, planned=9)
    progress.count(result(2, danger=0.9, failure=Failure("ValueError", "no")), crashed=False, planned=9)
    assert (progress.nearest, progress.branched) == (None, 2)
    assert progress.searching.status().grown_trials is None
    progress.count(result(3, danger=0.5, **forks), crashed=False, planned=9)
    progress.count(result(4, danger=0.5), crashed=False, planned=9)  # of two that are equal, the first
    assert (progress.nearest.spec.number, progress.branched) == (3, 4)
    assert progress.searching.status().grown_trials == 1
    progress.count(result(5, danger=0.75), crashed=False, planned=9)
    assert progress.nearest.spec.number == 5
    assert progress.searching.status().grown_trials == 0


def test_robustness_of_a_hunt_is_that_of_the_first_trial_with_the_least_margin():
    progress = Progress()
    for number, margin in ((1, 1.0), (2, 0.5), (3, 0.5), (4, 0.75)):
        stress = Stress(margin, disturbance=Disturbance(2, "ahead", "brake", 4.0, 2.0, "ego"))
        progress.count(result(number, stress=stress), crashed=False, planned=9)
        assert (progress.stressed and progress.stressed.spec.number) == (None if number == 1 else 2)


def test_crash_that_is_not_saved_yet_counts_with_its_disturbances():
    progress = Progress()
    erring = (Disturbance(2, "ahead", "brake", 4.0, 2.0, "ego"),)
    progress.tally.found, progress.tally.disturbed = 4, 2
    progress.count(crash(5, disturbances=erring), crashed=True, planned=9)
    assert (progress.crash_count, progress.disturbed) == (5, 3)
    progress.found = {5: crash(5)}
    assert (progress.crash_count, progress.disturbed) == (5, 2)
    progress.crashes = [Bundle(crash(4)), Bundle(crash(5))]
    assert (progress.unsaved, progress.crash_count) == (None, 4)


def test_machines_of_a_hunt_are_noted_if_there_are_several():
    progress = Progress()
    progress.look_at(SimpleNamespace(nodes=lambda: [NodeFigures("a", 2, 3, 0.5)]))
    assert progress.nodes == (NodeFigures("a", 2, 3, 0.5),)
    assert progress.noted()["nodes"] == [{"name": "a", "parallel": 2, "trials": 3, "rate_per_s": 0.5}]
    progress.look_at(SimpleNamespace())
    assert progress.nodes is None
    progress.kinds = SimpleNamespace(groups=list, newest=5.0, types_by_cause=None)
    assert "types_by_cause" not in progress.noted()
    progress.kinds.types_by_cause = 0
    assert progress.noted()["types_by_cause"] == 0
    progress.counted = SimpleNamespace(running=lambda *, now: now)
    assert [progress.noted(now=now)["running_rate"] for now in (False, True)] == [False, True]
    assert progress.noted()["running_rate"] is False
    progress.phase = _progress.PhaseStatus(name="probes", done=1, total=2, seconds_left=3.0)
    assert progress.noted()["phase"] == {"name": "probes", "done": 1, "total": 2, "seconds_left": 3.0}
