"""Cases of a corpus, in process: what their files say, where they are found, and how their reports read."""

from __future__ import annotations

import os
import shutil
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from crashhunt.base.errors import BundleError, CrashhuntError, UntrustedError, UsageError
from crashhunt.corpus import (
    CaseReport,
    _case_runs as _run,
    _cases,
    add_case,
    compare_types,
    find_cases,
    read_case,
    run_cases,
)
from crashhunt.corpus._cases import cases_of_type
from crashhunt.crashes import Cause, Judgement, Signature, judgement_of, with_judgement
from crashhunt.trial import Outcome, TrialResult, TrialSpec
from crashhunt.trial_reruns import EndedRun, StoppedError

FROZEN = Path(__file__).parents[1] / "e2e" / "frozen" / "case"


@pytest.fixture
def case(tmp_path):
    shutil.copytree(FROZEN, tmp_path / "kept" / "one")
    return read_case(tmp_path / "kept" / "one")


def test_case_names_its_crash_and_what_is_expected(case):
    assert (case.name, case.expect, case.note) == ("one", "still", "frozen: never made anew")
    assert case.crash == "ego drove into leader at step 52"
    assert case.signature["manner"] == "rear end"
    assert case.signature["disturbed"] is False
    assert case.bundle().id == "000000-collision"
    assert case.kind_of_log() == "whole"
    data = case.to_json()
    sizes = [file.stat().st_size for file in case.path.rglob("*") if file.is_file()]
    assert (data["path"], data["expected"], data["bytes"], data["log"]) == (str(case.path), "still", sum(sizes), True)
    assert (data["note"], data["crash"]) == (case.note, case.crash)
    (log,) = case.path.rglob("log.mcap")
    log.unlink()
    assert (case.kind_of_log(), case.to_json()["log"]) == ("", False)


def test_case_without_log_names_the_command_that_records_it(case, tmp_path, run, trials):
    """As of an earlier version."""
    (log,) = case.path.rglob("log.mcap")
    log.unlink()
    with pytest.raises(BundleError, match="the case has no log") as caught:
        case.bundle().recording()
    assert caught.value.fix.startswith(f"run crashhunt corpus run {case.path} --keep out, ")
    added = add_case(case.bundle(), tmp_path / "other").case  # as bisect adds it
    assert (added.kind_of_log(), added.crash) == ("", case.crash)
    run()  # which replaces what runs trials
    trials.results[:] = [Outcome.COLLISION]
    (found,) = run_cases([added.path], trusted=True)
    assert (found.got, found.was) == ("still", case.crash)


def test_case_has_exactly_one_crash(case):
    (crash,) = (case.path / "crashes").iterdir()
    shutil.copytree(crash, crash.with_name("000001-collision"))
    with pytest.raises(BundleError, match=r"\b2 crashes"):
        case.bundle()
    shutil.rmtree(case.path / "crashes")
    with pytest.raises(BundleError, match=r"\b(0|no) crash"):
        case.bundle()


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ((None, None), ("still", "frozen: never made anew")),
        (("fixed", None), ("fixed", "frozen: never made anew")),
        ((None, "new"), ("still", "new")),
        ((None, ""), ("still", "")),
    ],
)
def test_expectation_and_note_are_changed_in_the_file(case, given, expected):
    file = case.path / "crashhunt-case.toml"
    before = file.stat().st_mtime_ns
    changed = case.expecting(*given)
    assert (changed.expect, changed.note) == expected
    assert read_case(case.path) == changed
    assert (file.stat().st_mtime_ns == before) == (changed == case)
    first, second, schema, *_ = file.read_text().splitlines()
    assert first.startswith("# A crash that is kept")
    assert second.startswith("# expect is")
    assert schema == "schema = 1"
    assert changed.signature == case.signature


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("expect = [", "not valid TOML"),
        ("expect = 'maybe'", "expect"),
        ("schema = 2\nexpect = 'still'", "schema"),
        ("", "expect"),
    ],
)
def test_file_that_is_no_case_is_named(case, text, said):
    file = case.path / "crashhunt-case.toml"
    file.write_text(text)
    with pytest.raises(BundleError, match=said) as caught:
        read_case(case.path)
    assert caught.value.where == str(file)
    file.write_text("expect = 'fixed'\nlater = 1")  # of a later version
    assert (read_case(case.path).expect, read_case(case.path).signature) == ("fixed", {})
    file.unlink()
    with pytest.raises(BundleError, match="cannot be read: No such file"):
        read_case(case.path)


def test_cases_are_found_at_any_depth_and_not_in_hidden_folders(case, tmp_path):
    for name in ("a/deep", ".hidden", "b/.git/x", ".kept/inside"):
        (tmp_path / "kept" / name).mkdir(parents=True)
        shutil.copy(case.path / "crashhunt-case.toml", tmp_path / "kept" / name)
    kept = tmp_path / "kept"
    assert find_cases([kept]) == [kept / "a" / "deep", kept / "one"]
    assert find_cases([kept / "one", kept]) == [kept / "one", kept / "a" / "deep"]  # each once, in the given order
    assert find_cases([kept / ".kept"]) == [kept / ".kept" / "inside"]  # which is named itself
    (tmp_path / "empty").mkdir()
    with pytest.raises(BundleError) as caught:
        find_cases([kept, tmp_path / "empty"])
    assert caught.value.message == f"'{tmp_path / 'empty'}' has no case of a corpus"
    assert caught.value.fix == "add a case with crashhunt corpus add BUNDLE --to FOLDER"
    with pytest.raises(BundleError) as caught:
        find_cases([tmp_path / "kep"])
    assert caught.value.message == f"'{tmp_path / 'kep'}' does not exist"
    assert "kept" in caught.value.fix.partition("add one")[0]
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(BundleError, match=r"pipe' is not a folder; add a case"):
        find_cases([tmp_path / "pipe"])


def test_case_of_a_corpus_is_copied_whole_and_only_once(case, tmp_path):
    other = tmp_path / "other" / "folder"
    added = add_case(case.bundle(), other, note="moved")
    assert (added.new, added.changed, added.judged) == (True, False, False)
    assert (added.case.expect, added.case.note) == ("still", "moved")
    assert (added.case.crash, added.case.signature) == (case.crash, case.signature)
    digest = case.bundle().result.digest
    assert added.case.path == other / f"000000-collision-{digest[:6]}"
    inside = sorted(file.relative_to(added.case.path) for file in added.case.path.rglob("*"))
    assert inside == sorted(file.relative_to(case.path) for file in case.path.rglob("*"))
    assert added.case.bundle().result == case.bundle().result
    again = add_case(case.bundle(), other)
    assert (again.new, again.changed, again.case) == (False, False, added.case)
    again = add_case(case.bundle(), other, expect="fixed")
    assert (again.new, again.changed, again.case.expect, again.case.note) == (False, True, "fixed", "moved")
    assert [path.name for path in other.iterdir()] == [added.case.path.name]


def test_copied_case_is_authenticated_where_it_is(case, tmp_path, monkeypatch):
    monkeypatch.setattr(
        _cases, "authenticate_bundle", lambda bundle: f"code of {bundle.path.name} in {bundle.hunt.parent.name}"
    )
    added = add_case(case.bundle(), tmp_path / "other")
    assert added.case.bundle().authentication_code == "code of 000000-collision in other"


def test_log_of_a_case_has_no_views(case, tmp_path, monkeypatch):
    written, bundle = [], case.bundle()
    recording = bundle.recording()
    (case.path / "crashhunt-case.toml").unlink()  # as in a hunt
    monkeypatch.setattr(_cases, "without_code", lambda snapshot, folder: snapshot)
    monkeypatch.setattr(_cases, "_compact", lambda bundle, recording: "compact")
    monkeypatch.setattr(_cases, "write_log", lambda path, what, *, views: written.append((path.name, what, views)))
    for most, expected in ((100 * 1024, [recording]), (100, [recording, "compact"])):
        monkeypatch.setattr(_cases, "_MAX_BYTES_WITH_LOG", most)
        written.clear()
        added = add_case(bundle, tmp_path / str(most))
        assert [(name, views) for name, _, views in written] == [("log.mcap", False)] * len(expected)
        assert [what == "compact" for _, what, _ in written] == [what == "compact" for what in expected]
        assert added.new


@pytest.mark.parametrize("outcome", [Outcome.SURVIVED, Outcome.FINISHED])
def test_near_miss_is_not_added(outcome, tmp_path):
    bundle = SimpleNamespace(id="000003-near-miss", result=SimpleNamespace(outcome=outcome))
    with pytest.raises(UsageError, match="'000003-near-miss' is a near miss, not a crash"):
        add_case(bundle, tmp_path / "corpus")
    assert not (tmp_path / "corpus").exists()


def test_paths_below_the_current_folder_are_relative_in_a_case_there(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given = {"path": f"{tmp_path}/w/model.zip", "other": "/else/model.zip", "name": "w/model.zip", "speed": 3.0}
    spec = TrialSpec(0, 1, {"ego": given, "second": {"path": str(tmp_path / "x")}}, {"map": f"{tmp_path}/map"}, 9)
    found = _cases._with_relative_paths(spec, tmp_path / "kept" / "case")
    assert found.arguments == {"ego": {**given, "path": "w/model.zip"}, "second": {"path": "x"}}
    assert found.scenario_arguments == spec.scenario_arguments
    assert _cases._with_relative_paths(spec, tmp_path.parent / "case") is spec


@pytest.mark.parametrize(
    ("enough_m", "radii"),
    [
        (20, [20]),
        (100, [20, 40, 80, 160]),
        (1280, [20, 40, 80, 160, 320, 640, 1280]),
        (9999, [20, 40, 80, 160, 320, 640, 1280, float("inf")]),
    ],
)
def test_radius_of_a_compact_log_is_doubled_until_the_facts_are_the_same(monkeypatch, enough_m, radii):
    asked = []

    def compacted(always, radius_m, *, observations):
        asked.append((always, radius_m, observations))
        return SimpleNamespace(radius_m=radius_m)

    monkeypatch.setattr(_cases, "_facts", lambda bundle, recording: recording.radius_m >= enough_m)
    size = SimpleNamespace(nbytes=25 * 1024)
    recording = SimpleNamespace(
        compact=None, agents=("ego", "second"), observations=lambda agent: size, compacted=compacted, radius_m=1e9
    )
    hit = SimpleNamespace(collider="ego", victim="x")
    bundle = SimpleNamespace(result=SimpleNamespace(collision=hit))
    assert _cases._compact(bundle, recording).radius_m == radii[-1]
    assert asked == [(("ego", "x"), radius_m, True) for radius_m in radii]
    size.nbytes += 1  # together, more than 50 KiB
    bundle.result.collision = None
    _cases._compact(bundle, recording)
    assert asked[-1] == ((), radii[-1], False)
    recording.compact = "already"
    assert _cases._compact(bundle, recording) is recording


def test_types_that_a_corpus_has_are_those_of_crashes_that_are_still_expected():
    rear, crossing = Signature("collision", manner="rear end"), Signature("collision", manner="crossing from the left")

    def kept(name, expect, **parts):
        return SimpleNamespace(name=name, expect=expect, signature=parts)

    one, other = kept("one", "still", manner="rear end", later=True), kept("other", "still", manner="rear end")
    fixed = kept("fixed", "fixed", manner="crossing from the left")
    cases = [fixed, kept("early", "still"), one, other]
    assert (cases_of_type(rear, cases), cases_of_type(crossing, cases)) == ([one, other], [])
    assert cases_of_type(rear, [kept("x", "still", manner="rear end", disturbed=True), other]) == [other]


CAR, TRUCK = Cause("omission", "vehicle"), Cause("omission", "vehicle", actor="long")
GAP, UNKNOWN = Cause("omission", "gap left", "changed lanes"), Cause("unknown")


@pytest.mark.parametrize(
    ("crashes", "cases", "by", "new"),
    [
        ([CAR], [CAR], "cause", ()),
        ([GAP, CAR], [CAR], "cause", (GAP,)),  # one rear end in the corpus hides no other one
        ([GAP, CAR], [CAR, GAP], "cause", ()),
        ([TRUCK, UNKNOWN], [CAR], "cause", ()),  # a long vehicle is chance where cars are hit in the same way
        ([TRUCK], [TRUCK, UNKNOWN], "cause", ()),
        ([GAP], [TRUCK, UNKNOWN], "cause", (GAP,)),
        ([UNKNOWN], [CAR], "type", ()),  # not judged on one side
        ([CAR, GAP], [UNKNOWN], "type", ()),
    ],
)
def test_cause_decides_whether_a_crash_is_known_if_both_sides_have_causes(monkeypatch, crashes, cases, by, new):
    rear = Signature("collision", manner="rear end")
    said = {"expect": "still", "signature": {"manner": "rear end"}}
    kept = [SimpleNamespace(path=Path(str(cause)), bundle=lambda cause=cause: cause, **said) for cause in cases]
    monkeypatch.setattr(_cases, "judgement_of", lambda bundle: None)
    monkeypatch.setattr(_cases, "cause_of", lambda bundle, judgement: bundle)
    group = SimpleNamespace(signature=rear, bundles=crashes)
    for causes in (None, [crashes]):
        found = compare_types([group], kept, causes)[rear]
        assert (found.case, found.by, found.new_causes) == (kept[0], by, new)


def test_case_whose_stored_type_was_of_earlier_rules_is_still_known(case):
    today = _cases.signature_today(case.path)
    assert today.manner == "rear end"
    early = replace(case, signature={**case.signature, "manner": "crossing from the right"})
    early.write(case.path)
    group = SimpleNamespace(signature=today, bundles=())
    assert compare_types([group], [early])[today].case == early
    other = replace(today, manner="head-on")
    assert compare_types([SimpleNamespace(signature=other, bundles=())], [early]) == {}


def test_case_gets_the_causes_of_its_crash_when_this_is_judged_later(case, tmp_path):
    kept = add_case(case.bundle(), tmp_path / "corpus")
    assert judgement_of(kept.case.bundle()) is None
    judged = with_judgement(case.bundle(), Judgement(attempts=(), why_not="no brake"))
    again = add_case(judged, tmp_path / "corpus")
    assert (again.new, again.changed, again.judged) == (False, False, True)
    assert judgement_of(again.case.bundle()).why_not == "no brake"
    assert again.case.bundle().authentication_code == kept.case.bundle().authentication_code
    assert not add_case(judged, tmp_path / "corpus").judged


def report(**options):
    return CaseReport(**{"path": Path("kept/case"), "expected": "still", "got": "still", **options})


@pytest.mark.parametrize(
    ("expected", "got", "is_ok", "may_be_tightened"),
    [
        ("still", "still", True, False),
        ("still", "fixed", True, True),
        ("still", "changed", False, False),
        ("still", "cannot_run", False, False),
        ("fixed", "fixed", True, False),
        ("fixed", "still", False, False),
        ("fixed", "changed", False, False),
    ],
)
def test_report_states_whether_the_status_is_as_expected(expected, got, is_ok, may_be_tightened):
    found = report(expected=expected, got=got)
    assert (found.ok, found.may_be_tightened) == (is_ok, may_be_tightened)
    assert not report(expected=expected, got=got, warnings=("SUMO differs",)).may_be_tightened
    (first,) = found.describe().splitlines()
    assert first.endswith(", and " + f"{expected} was expected") == (not is_ok)
    assert found.to_json()["ok"] is is_ok
    assert found.to_json()["path"] == "kept/case"


def test_report_describes_the_crash_and_how_to_look_at_it():
    found = report(was="it hit", now="it hits", note="too\nfast", warnings=("a", "b"), kept=Path("out/case"))
    assert found.describe().splitlines() == [
        "case: still crashes",
        "  it was: it hit",
        "  now:    it hits",
        "  note: too fast",
        "  warning: a",
        "  warning: b",
        "  look at it: crashhunt show out/case",
    ]
    assert found.line == "it hits (too fast)"
    assert report(now="it hits").line == "it hits"
    words = [report(got=got).describe().partition(",")[0] for got in ("fixed", "changed", "cannot_run")]
    assert words == ["case: fixed", "case: crashes in another way", "case: cannot run"]
    assert "kept" not in report().to_json()


class Trials:
    """In place of runs in new processes: the trials end with the results of a list, several at a time."""

    def __init__(self):
        self.results, self.workers, self.running, self.most, self.lock = [], [], 0, 0, threading.Lock()
        self.begun = lambda stopped: None

    def run(self, worker, spec, stopped):
        with self.lock:
            self.workers.append(worker)
            result = self.results.pop(0)
            self.running += 1
            self.most = max(self.most, self.running)
        try:
            self.begun(stopped)
            if stopped():
                raise StoppedError
            if isinstance(result, Exception):
                raise result
            yield EndedRun(0, TrialResult(spec, result, 9), None, Path("scratch/trial"))
        finally:
            with self.lock:
                self.running -= 1


@pytest.fixture
def trials(monkeypatch):
    made = Trials()
    monkeypatch.setattr(_run, "run_alone", made.run)
    return made


@pytest.fixture
def run(trials, monkeypatch, tmp_path):
    """Runs cases whose trials end as given."""
    monkeypatch.setattr(_run, "write_bundle", lambda folder, result, *more, **options: SimpleNamespace(path=folder))

    def run_them(*results, manner="rear end", **options):
        trials.results[:] = results
        parts = {**read_case(FROZEN).signature, "manner": manner, "later": True}
        monkeypatch.setattr(_run, "signature_of", lambda bundle: SimpleNamespace(to_json=lambda: parts))
        paths = [tmp_path / str(number) for number in range(len(results))]
        for path in paths:
            shutil.copytree(FROZEN, path, dirs_exist_ok=True)
        return run_cases(paths, trusted=True, **{"parallel": 1, **options})

    return run_them


def test_status_of_a_case_is_that_of_its_trial(run, trials):
    outcomes = (Outcome.COLLISION, Outcome.SURVIVED, Outcome.FINISHED, Outcome.INVALID)
    watched = []
    found = run(*outcomes, watch=lambda done, count: watched.append((done, count)))
    assert [one.got for one in found] == ["still", "fixed", "fixed", "cannot_run"]
    assert [one.path.name for one in found] == ["0", "1", "2", "3"]
    assert {(one.expected, one.was, one.note, one.kept) for one in found} == {
        ("still", "ego drove into leader at step 52", "frozen: never made anew", None)
    }
    assert watched == sorted(watched)
    assert watched[-1] == (4, 4)
    assert {worker.keep_trials for worker in trials.workers} == {True}
    (other,) = run(Outcome.COLLISION, manner="side swipe")
    assert other.got == "changed"


def test_as_many_cases_run_at_a_time_as_are_asked_for(run, trials, monkeypatch):
    for parallel, cores, most in ((1, 3, 1), (2, 1, 2), (0, 3, 3), (0, None, 1)):
        trials.most = 0
        monkeypatch.setattr(_run.os, "cpu_count", lambda cores=cores: cores)
        barrier = threading.Barrier(most)
        trials.begun = lambda stopped, barrier=barrier: barrier.wait(300)
        assert len(run(*[Outcome.SURVIVED] * 6, parallel=parallel)) == 6
        assert trials.most == most


def wait_for(stopped):
    until = time.monotonic() + 300
    while not stopped() and time.monotonic() < until:
        time.sleep(0.01)


def test_stop_keeps_the_reports_of_the_cases_that_ended(run, trials):
    stop, begun = threading.Event(), []

    def begin(stopped):
        begun.append(1)
        if len(begun) == 2:
            stop.set()
            wait_for(stopped)

    trials.begun = begin
    found = run(*[Outcome.SURVIVED] * 3, stopped=stop.is_set)
    assert ([one.path.name for one in found], len(begun)) == (["0"], 2)


def test_ctrl_c_ends_the_running_cases(run, trials):
    def interrupt(done, count):
        raise KeyboardInterrupt

    trials.begun = wait_for
    with pytest.raises(KeyboardInterrupt):
        run(*[Outcome.SURVIVED] * 9, watch=interrupt)
    assert len(trials.workers) == 1


def test_what_keeps_a_case_from_running_is_its_result(run, tmp_path):
    errors = [BundleError("it died", fix="look", where="crash.json"), CrashhuntError("no room", fix="free some")]
    found = run(*errors, CrashhuntError("no room"))
    assert [(one.got, one.ok, one.now) for one in found] == [
        ("cannot_run", False, str(errors[0])),
        ("cannot_run", False, "no room (free some)"),
        ("cannot_run", False, "no room"),
    ]
    (tmp_path / "0" / "crashhunt-case.toml").write_text("expect = 'maybe'")
    (tmp_path / "1" / "hunt.toml").unlink()
    scenario = next((tmp_path / "2").glob("snapshots/*/scenario/scenario.toml"))
    scenario.write_text("schema = 1")
    first, second, third = run_cases([tmp_path / str(number) for number in range(3)], trusted=True)
    assert (first.expected, first.got, first.was) == ("fixed", "cannot_run", "")
    assert (second.expected, second.got, second.was) == ("still", "cannot_run", "ego drove into leader at step 52")
    assert "has changed; restore the case from the repository, or add the crash again" in third.now


def test_crash_is_kept_only_where_a_folder_is_given(run, tmp_path):
    for _ in range(2):  # also into the folder of an earlier run
        (found,) = run(Outcome.COLLISION, keep=tmp_path / "out")
        assert found.kept == tmp_path / "out" / "0"
    assert (found.kept / "hunt.toml").read_text().startswith("# ")
    assert [path.name for path in (found.kept / "snapshots").iterdir()]
    (found,) = run(Outcome.SURVIVED, keep=tmp_path / "out")
    assert found.kept is None


def test_kept_crashes_of_cases_with_the_same_name_have_their_own_folders(run, trials, tmp_path):
    run()
    trials.results[:] = [Outcome.COLLISION] * 3
    names = ("a/case", "b/case", "b/case-2")
    cases = [Path(shutil.copytree(FROZEN, tmp_path / name)) for name in names]
    found = run_cases(cases, trusted=True, parallel=1, keep=tmp_path / "out")
    assert [one.kept.relative_to(tmp_path / "out") for one in found] == [
        Path("case"), Path("case-2"), Path("case-2-2"),
    ]  # fmt: skip


def test_case_that_is_not_trusted_runs_nothing(run, trials, tmp_path, monkeypatch):
    run()
    shutil.copytree(FROZEN, tmp_path / "0")
    monkeypatch.setattr(_run, "is_bundle_trusted", lambda bundle, faults: False)
    with pytest.raises(UntrustedError, match=str(tmp_path / "0")):
        run_cases([tmp_path / "0"])
    assert trials.workers == []
    assert _run.untrusted_case(tmp_path / "0").id == "000000-collision"
    assert _run.untrusted_case(tmp_path) is None  # it cannot run anyway
    monkeypatch.setattr(_run, "is_bundle_trusted", lambda bundle, faults: True)
    assert _run.untrusted_case(tmp_path / "0") is None
