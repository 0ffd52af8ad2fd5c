"""The parts of a gate without any trial: commits in work trees, the corpus, locks, reasons and origins of modules."""

from __future__ import annotations

import json
import sys
import time
from contextlib import closing, nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from crashhunt.base import layout
from crashhunt.base.errors import BusyError, CrashhuntError, HuntDirectoryError, NoValidTrialError, UsageError
from crashhunt.ledger import Ledger
from crashhunt.plans import AgentSettings, ArgumentSpec, HuntSettings, Request, RunSettings, write_settings
from crashhunt.statistics import SideCounts
from crashhunt.statistics._hunt_pairs import ScenarioCounts
from crashhunt.suites import Gate, GateVersion, RunRequest, _gate_corpus, _gate_runs as _gate, _gate_versions
from crashhunt.suites._request_file import REQUEST, write_request
from crashhunt.trial import KILLED, Failure, Outcome, TrialResult, TrialSpec


def request(folder, **more):
    given = {"scenario": "loop", "trials": 1, "max_steps": 9, "seed": 4} | more
    return RunRequest(Request(**given), str(folder))


def gate(folder, *, commits=("", ""), hunts=None, **more):
    versions = [
        GateVersion(word, {} if commit else {"": word}, commit)
        for word, commit in zip(("mine:Old", "mine:New"), commits, strict=True)
    ]
    given = {"most": 4, "is_suite": hunts is not None and len(hunts) > 1, **more}
    return Gate(base=versions[0], head=versions[1], hunts=hunts or {"loop": request(folder)}, folder=folder, **given)


@pytest.fixture
def work(tmp_path, monkeypatch):
    """A repository in `top` with the user in `top/sub`, whose commits are checked out into `trees`."""
    found = SimpleNamespace(
        top=tmp_path / "top", folder=tmp_path / "top/sub", trees={}, ran=[], asked=[],
        answers={"origin": None, "corpus": "", "code": 0, "status": ""},
    )  # fmt: skip
    found.folder.mkdir(parents=True)

    def checked_out(top, commit, *, purpose, name):
        found.asked.append((top, commit, purpose, name))
        found.trees[name] = tree = tmp_path / f"tree-{commit}"
        (tree / "sub").mkdir(parents=True, exist_ok=True)
        return nullcontext(tree)

    def run_to_end(command, folder, environment):
        found.ran.append((command, folder, environment))
        if command[2] == "-c":
            origin = (command[-1] != "yours" and found.answers["origin"]) or folder / "mine.py"
            return SimpleNamespace(stdout=f"{origin}\n", returncode=found.answers["code"])
        return SimpleNamespace(stdout=found.answers["corpus"], stderr="crashhunt: it  does\nnot run", returncode=2)

    monkeypatch.setattr(_gate_versions, "top_of", lambda folder: found.top)
    monkeypatch.setattr(_gate_versions, "checked_out", checked_out)
    monkeypatch.setattr(
        _gate_versions, "import_environment", lambda folder, tree: {"FOLDER": str(folder), "TREE": str(tree)}
    )
    for module in (_gate_versions, _gate_corpus):
        monkeypatch.setattr(module, "run_to_end", run_to_end)
    monkeypatch.setattr(_gate, "git", lambda folder, *words, skipped: found.answers["status"])
    return found


def started(asked, place):
    """Return a gate that has planned its hunts."""
    place.mkdir(exist_ok=True)
    return _gate._Run(asked, place, SimpleNamespace(enter_context=lambda entered: entered.enter_result
                      if hasattr(entered, "enter_result") else entered.__enter__()), None, is_kept=True)  # fmt: skip


AGENT = {"": "mine:Driver"}


def of_commits(work, **more):
    hunts = {"loop": request(work.folder, agents=AGENT)}
    return gate(work.folder, commits=("aaaa", "bbbb"), hunts=hunts, **more)


def test_commits_are_imported_from_their_work_trees(work, tmp_path):
    run = started(of_commits(work), tmp_path / "g")
    assert work.asked == [(work.top, "aaaa", "gate", "base"), (work.top, "bbbb", "gate", "head")]
    folders = [RunRequest.read(tmp_path / f"g/{side}/{REQUEST}").folder for side in ("base", "head")]
    assert folders == [str(work.trees[side] / "sub") for side in ("base", "head")]
    assert run._trees.folder_of("head", tmp_path / "elsewhere") == work.trees["head"]
    assert [command[-1] for command, *_ in work.ran] == ["mine", "mine"]
    for (_, folder, environment), side in zip(work.ran, ("base", "head"), strict=True):
        assert folder == work.trees[side] / "sub"
        assert environment == {"FOLDER": str(folder), "TREE": str(work.trees[side])}
    description = json.loads((tmp_path / "g/gate.json").read_text())
    assert {name: description[name] for name in ("base", "head", "hunts", "seed")} == {
        "base": "aaaa", "head": "bbbb", "hunts": ["loop"], "seed": 4,
    }  # fmt: skip


def test_each_commit_is_built_once_in_the_folder_of_the_command(work, tmp_path, monkeypatch):
    built, tracked = [], []
    monkeypatch.setattr(_gate_versions, "run_build", lambda *words, **more: built.append((*words, more)))
    monkeypatch.setattr(_gate_versions, "copy_built", lambda tree, place: (place.mkdir(), (place / "planner").touch()))
    monkeypatch.setattr(_gate_versions, "track_built", tracked.append)
    asked = of_commits(work, build="make", build_limit_s=7.0)
    started(asked, tmp_path / "g")
    log = tmp_path / "g/build-base.log"
    assert built[0][:3] == ("make", work.trees["base"] / "sub", log)
    assert {name: built[0][3][name] for name in ("limit_s", "name")} == {
        "limit_s": 7.0,
        "name": "BASE (mine:Old (aaaa))",
    }
    assert [folder for _, folder, *_ in built] == [work.trees[side] / "sub" for side in ("base", "head")]
    assert tracked == list(work.trees.values())
    started(asked, tmp_path / "g")  # the same command again: with the same files, and not with those of a second build
    assert len(built) == 2
    assert (work.trees["head"] / "planner").exists()
    with pytest.raises(HuntDirectoryError, match="with other versions, hunts or seeds, or with another --build"):
        started(of_commits(work, build="make -j2"), tmp_path / "g")
    with pytest.raises(HuntDirectoryError, match="with other versions, hunts or seeds, or with another --build"):
        started(of_commits(work), tmp_path / "g")
    with pytest.raises(UsageError, match="--build is given, but BASE and HEAD are agents"):
        gate(tmp_path, build="make").run(tmp_path / "h")


def test_file_that_both_commits_share_is_a_warning(work, tmp_path):
    told = []
    run = started(of_commits(work), tmp_path / "g")
    run._tell = told.append
    (real,) = run._hunts
    (tmp_path / "planner").touch()
    arguments = {"binary": ArgumentSpec(spec=str(tmp_path / "planner")), "mode": ArgumentSpec(spec="fast")}
    for folder in real.folders:
        run._find_same_files(real)
        assert told == []
        ended(folder, "all_trials", agents={"ego": AgentSettings(agent="mine:Driver", arguments=arguments)})
    run._find_same_files(real)
    run._find_same_files(real)
    (caution,) = told
    assert caution.startswith(
        f"BASE and HEAD use the same file: {tmp_path / 'planner'} (ego.binary); name it on the command line"
    )
    run._write = lambda report: None
    assert run._gate_report().cautions == (caution,)


def test_agent_from_elsewhere_than_the_commit_is_refused(work, tmp_path):
    work.answers["origin"] = tmp_path / "site/mine.py"
    with pytest.raises(UsageError, match=r"'mine' is imported from .*site/mine\.py, and not from the commit"):
        started(of_commits(work), tmp_path / "g")
    work.answers["code"] = 1  # the hunt reports it
    started(of_commits(work), tmp_path / "g2")
    hunts = {"loop": request(work.folder, agents={"a": "mine:A", "b": "yours:B"})}
    work.answers["code"] = 0
    started(replace(of_commits(work), hunts=hunts), tmp_path / "g3")  # one of the two is of the commit
    assert [command[-1] for command, *_ in work.ran[-4:]] == ["mine", "yours"] * 2


def test_modules_are_those_of_agents_however_they_are_named(work, tmp_path):
    assert _gate._modules_of(request(tmp_path, agents={"a": "mine:A", "b": "keep-lane"})) == {
        "mine", "crashhunt.agents",
    }  # fmt: skip
    assert _gate._modules_of(request(tmp_path)) == {"crashhunt.agents"}  # those of the scenario
    assert _gate._modules_of(request(tmp_path, scenario="nowhere")) == set()


def cautions(work, commits, status=""):
    work.answers["status"] = status
    return list(gate(work.folder, commits=commits).cautions())


def test_gate_warns_of_equal_commits_and_of_changes_that_it_leaves_out(work):
    same, changed = cautions(work, ("a" * 40, "a" * 40), " M mine.py")
    assert same == "BASE and HEAD are the same commit (aaaaaaaaaa)"
    assert changed == "the work tree has changes that are not committed; the gate does not compare them"
    assert cautions(work, ("aaaa", "bbbb")) == []
    assert cautions(work, ("", ""), " M mine.py") == []
    with pytest.raises(UsageError, match="'mine:Old' is a commit and 'mine:New' is an agent"):
        gate(work.folder, commits=("aaaa", "")).run(work.folder / "g")
    for margin in (-0.01, 1):
        with pytest.raises(UsageError, match=f"^--margin is {margin}; give a share from 0 to below 1"):
            gate(work.folder, margin=margin).run(work.folder / "g")


@pytest.mark.parametrize(
    ("more", "option"),
    [
        ({"sampler": "guided"}, "the sampler guided"), ({"seeds": 3}, "--seeds"), ({"rare": "forcing"}, "--rare"),
        ({"distinct": 2}, "--distinct"),
        ({"only_at_fault": True}, "--only-at-fault"),
        ({"until_rate": "0.1/trial"}, "--until-rate"),
    ],
)  # fmt: skip
def test_gate_refuses_what_has_no_pairs_of_trials(tmp_path, more, option):
    with pytest.raises(UsageError, match=f"^a gate compares single trials and does not support {option}; omit it$"):
        gate(tmp_path, hunts={"loop": request(tmp_path, **more)}).run(tmp_path / "g")
    with pytest.raises(UsageError, match=r"^b: a gate compares"):
        gate(tmp_path, hunts={"a": request(tmp_path), "b": request(tmp_path, **more)}).run(tmp_path / "g")
    _gate._check_request(request(tmp_path), "")


def test_folder_of_a_gate_is_empty_or_has_a_gate_and_has_one_at_a_time(tmp_path):
    place = tmp_path / "g"
    with _gate._locked(place):
        (place / "gate.json").touch()
        with pytest.raises(BusyError, match="another gate is running in this folder"), _gate._locked(place):
            pass
    for name in ("gate.json", ".lock"):
        (place / name).unlink()
    (place / "notes").touch()
    with pytest.raises(HuntDirectoryError, match="the folder is not empty"), _gate._locked(place):
        pass
    (place / "gate.json").touch()
    with _gate._locked(place):
        pass
    with pytest.raises(HuntDirectoryError, match="cannot be used: No such file"), _gate._locked(tmp_path / "no/g"):
        pass
    (place / layout.HUNT).touch()
    (place / layout.LEDGER).touch()
    with pytest.raises(HuntDirectoryError, match="the folder is not empty"), _gate._locked(place):
        pass


def test_description_of_a_gate_that_is_damaged_or_of_another_is_refused(tmp_path):
    asked = gate(tmp_path)
    started(asked, tmp_path / "g")
    for changed in (
        replace(asked, base=replace(asked.base, agents={"": "mine:Other"})),
        replace(asked, hunts={"other": request(tmp_path)}),
        replace(asked, hunts={"loop": request(tmp_path, seed=5)}),
    ):
        with pytest.raises(HuntDirectoryError, match="a gate with other versions, hunts or seeds"):
            started(changed, tmp_path / "g")
    with pytest.raises(HuntDirectoryError, match="was begun with other options"):
        started(replace(asked, hunts={"loop": request(tmp_path, max_steps=8)}), tmp_path / "g")
    started(replace(asked, most=9, trusted=True), tmp_path / "g")  # more pairs of the same
    assert RunRequest.read(tmp_path / f"g/base/{REQUEST}").request.trials == 9
    (tmp_path / "g/gate.json").write_text("[]")
    with pytest.raises(HuntDirectoryError, match="is damaged"):
        started(asked, tmp_path / "g")


def test_requests_of_both_versions_keep_few_bundles_and_never_stop(tmp_path):
    run = started(gate(tmp_path, most=5, hunts={"a": request(tmp_path), "b": request(tmp_path)}), tmp_path / "g")
    for name, most in (("a", 3), ("b", 2)):
        for side, agent in (("base", "mine:Old"), ("head", "mine:New")):
            asked = RunRequest.read(tmp_path / f"g/{name}/{side}/{REQUEST}")
            assert (asked.request.trials, asked.request.agents, asked.folder) == (most, {"": agent}, str(tmp_path))
            found = asked.request.run
            assert (found.keep_going, found.keep, found.parallel) == (True, 3, 1)
    assert [(one.name, one.most) for one in run._hunts] == [("a", 3), ("b", 2)]


@pytest.fixture
def corpus(work, monkeypatch):
    """A corpus of two cases in HEAD's tree and in the user's folder."""
    cases = []

    def find_cases(places):
        if isinstance(work.cases, Exception):
            raise work.cases
        cases.append(places)
        return work.cases

    work.cases, work.places = [Path("x/1"), Path("x/2")], cases
    monkeypatch.setattr(_gate_corpus, "find_cases", find_cases)
    monkeypatch.setattr(_gate_corpus, "_drivers_of", lambda case: {"mine:New"} if case.name == "1" else {"other"})
    work.answers["corpus"] = json.dumps({"cases": [
        {"path": "x/1", "expected": "fixed", "got": "fixed"},
        {"path": "x/2", "expected": "still", "got": "cannot_run", "now": "no map"},
    ]})  # fmt: skip
    return work


def test_corpus_of_a_commit_runs_with_its_code(corpus, tmp_path):
    run = started(of_commits(corpus, parallel=3), tmp_path / "g")
    assert run._run_corpus() is None  # it has none
    (corpus.trees["head"] / "sub/crashes").mkdir()
    found = run._run_corpus()
    assert [(one.name, one.expected, one.got, one.now) for one in found] == [
        ("1", "fixed", "fixed", ""), ("2", "still", "cannot_run", "no map"),
    ]  # fmt: skip
    command, folder, environment = corpus.ran[-1]
    assert command == [
        sys.executable, "-P", "-m", "crashhunt", "corpus", "run", "x/1", "x/2", "--json", "--parallel", "3", "--trust",
    ]  # fmt: skip
    assert folder == corpus.trees["head"] / "sub"
    assert environment == {"FOLDER": str(folder), "TREE": str(corpus.trees["head"])}
    assert corpus.places == [[folder / "crashes"]]
    corpus.answers["corpus"] = "{}"
    with pytest.raises(CrashhuntError, match="the corpus of HEAD cannot be run: it does not run"):
        run._run_corpus()
    corpus.cases = UsageError("no cases", fix="add one")
    assert run._run_corpus() is None
    asked = replace(run._gate, corpus=Path("crashes"))
    run = started(asked, tmp_path / "g4")
    with pytest.raises(UsageError, match="no cases"):
        run._run_corpus()


def test_corpus_of_an_agent_has_its_cases_only(corpus, tmp_path):
    (corpus.folder / "crashes").mkdir()
    assert started(gate(corpus.folder), tmp_path / "g")._run_corpus() is None  # crashes are a commit's
    asked = gate(corpus.folder, corpus=Path("cases"), parallel=1)
    run = started(asked, tmp_path / "g2")
    with pytest.raises(UsageError, match="--corpus cases is not a folder in HEAD"):
        run._run_corpus()
    (corpus.folder / "cases").mkdir()
    run._run_corpus()
    command, folder, environment = corpus.ran[-1]
    assert command[5:] == ["run", "x/1", "--json", "--parallel", "1"]
    assert folder == corpus.folder
    assert environment["PATH"]
    run = started(replace(asked, trusted=True), tmp_path / "g3")
    run._run_corpus()
    assert corpus.ran[-1][0][-1] == "--trust"
    corpus.cases = [Path("x/2")]
    with pytest.raises(UsageError, match=r"--corpus cases has no case .*mine:New"):
        run._run_corpus()


def test_crash_that_has_come_back_is_worse_without_a_hunt(corpus, tmp_path, monkeypatch):
    corpus.answers["corpus"] = json.dumps({"cases": [{"path": "x/1", "expected": "fixed", "got": "still"}]})
    (corpus.folder / "cases").mkdir()
    monkeypatch.setattr(_gate, "run_all", None)
    report = gate(corpus.folder, corpus=Path("cases")).run(tmp_path / "g")
    assert (report.verdict, report.pairs, report.rates) == ("worse", 0, None)
    assert report.why == "a crash of the corpus that was fixed has come back"
    assert (report.dir, report.seed) == (str(tmp_path / "g"), 4)
    written = json.loads((tmp_path / "g/gate.json").read_text())
    assert written["report"]["verdict"] == "worse"
    assert written["schema"] == 1


def test_gate_whose_corpus_cannot_run_is_undecided(corpus, tmp_path):
    run = started(gate(corpus.folder), tmp_path / "g")
    cases = [SimpleNamespace(name=name, got="cannot_run") for name in "abcd"]
    run._corpus = tuple(cases)
    run._write = lambda report: None
    report = run._gate_report(verdict="better")
    assert (report.verdict, report.why) == ("undecided", "HEAD cannot run 4 of the corpus: a, b, c")
    assert run._gate_report(verdict="worse").verdict == "worse"
    run._corpus = (SimpleNamespace(name="a", got="fixed"),)
    assert run._gate_report(verdict="better").verdict == "better"


def ended(folder, state, detail="", *, trials=4, **more):
    """Write a hunt that has ended."""
    settings = HuntSettings(
        scenario="loop", scenario_digest="0", trials=trials, max_steps=9, seed=4, run=RunSettings(), **more
    )
    write_settings(folder / layout.HUNT, settings, ["crashhunt", "gate"])
    with closing(Ledger(folder / layout.LEDGER, writable=True)) as ledger:
        ledger.enter(state, detail, planned=trials)


def paired(**given):
    counts = ScenarioCounts(name="loop", pairs=9, only_base=0, only_head=0, both=0)
    plain = {"name": "loop", "is_hopeless": False, "failure": lambda: None, "why_not": "", "is_complete": True,
             "trained_on": 0, "counts": counts}  # fmt: skip
    return SimpleNamespace(**plain | given)


def test_failed_hunt_is_an_error_of_its_version(tmp_path, monkeypatch):
    run = started(gate(tmp_path), tmp_path / "g")
    assert not run._refuse_failed(paired())
    assert run._refuse_failed(paired(is_hopeless=True, why_not="too many invalid"))
    assert run._why == "loop: too many invalid"
    counted = []
    monkeypatch.setattr(run, "_count_pairs", lambda one, **_: counted.append(one.name))
    run._hunts = paired(name="a", is_hopeless=True, why_not="too many invalid"), paired(name="b")
    run._run_hunts()
    assert counted == ["a"]  # no more hunts start
    with pytest.raises(NoValidTrialError, match="no trial can be set up: no map") as caught:
        run._refuse_failed(paired(failure=lambda: ("base", "no_valid_trial", "no map")))
    assert caught.value.where == "BASE (mine:Old)"
    with pytest.raises(HuntDirectoryError, match="the hunt cannot run: no map") as caught:
        run._refuse_failed(paired(failure=lambda: ("head", "error", "no map")))
    assert caught.value.where == "HEAD (mine:New)"


@pytest.mark.parametrize(
    ("build", "fix"), [("", "if the agent needs files that Git does not track, give --build COMMAND"), ("make", "")]
)
def test_commit_that_cannot_run_without_a_build_is_offered_one(work, tmp_path, monkeypatch, build, fix):
    for name in ("run_build", "track_built", "copy_built"):
        monkeypatch.setattr(_gate_versions, name, lambda *words, **more: words[1].mkdir() if len(words) == 2 else None)
    run = started(of_commits(work, build=build), tmp_path / "g")
    for state in ("error", "no_valid_trial"):
        with pytest.raises(CrashhuntError, match="no such file") as caught:
            run._refuse_failed(paired(failure=lambda state=state: ("head", state, "no such file: build/planner")))
        assert caught.value.fix == fix


def test_version_that_never_starts_is_worse_as_head_and_an_error_as_base(tmp_path):
    run = started(gate(tmp_path), tmp_path / "g")
    never = SideCounts(not_started=9, example="trial 0: ValueError: no weights")
    counts = ScenarioCounts(name="loop", pairs=9, only_base=9, only_head=0, both=0, sides=(never, SideCounts()))
    with pytest.raises(NoValidTrialError, match="no trial can be set up: trial 0: ValueError: no weights") as caught:
        run._refuse_failed(paired(counts=counts))
    assert caught.value.where == "BASE (mine:Old)"
    run._pairs.verdict = "worse"
    failure = ("head", "no_valid_trial", "no weights")
    counts = replace(counts, sides=counts.sides[::-1])
    assert not run._refuse_failed(paired(counts=counts, failure=lambda: failure))


def test_gate_without_a_verdict_has_a_reason(tmp_path):
    run = started(gate(tmp_path), tmp_path / "g")
    (real,) = run._hunts

    def why(*hunts, **watch):
        run._hunts = hunts
        run._until = watch.get("until", time.monotonic() + 9)
        return run._why_undecided()

    assert why(paired(), paired(name="b", why_not="too many")) == "b: too many"
    assert why(paired(), until=0.0).startswith("the time is up; give --for more")
    assert why(paired()) == "all 4 pairs have ended; give more with --most, or a greater --margin"
    lost = ScenarioCounts(name="loop", pairs=1, only_base=0, only_head=0, both=0, sides=(SideCounts(killed=3),) * 2)
    assert why(paired(counts=lost)).startswith("all 4 pairs have ended, of which 6 have no result; find out why")
    with pytest.raises(UsageError, match="an agent was trained on all 7 traffics of this gate"):
        why(paired(trained_on=3), paired(trained_on=4))
    for folder in real.folders:
        ended(folder, "all_trials")
    assert why(real).startswith("all 4 pairs")
    ended(real.folders[1], "interrupted")
    assert _gate._ended_early(real) == "the hunt of HEAD ended early (interrupted): no output"
    (real.folders[1] / layout.RUN_LOG).write_text("first\nlast words \n\n")
    assert why(real) == "the hunt of HEAD ended early (interrupted): last words"


def test_hunt_is_done_once_all_its_trials_have_ended(tmp_path, monkeypatch):
    ended(tmp_path, "all_trials")
    for state, trials, done in (
        ("finished", 4, True), ("crashed", 5, True), ("finished", 3, False), ("interrupted", 4, False),
    ):  # fmt: skip
        monkeypatch.setattr(
            _gate,
            "hunt_state",
            lambda folder, given=(state, trials): SimpleNamespace(state=given[0], trials_run=given[1]),
        )
        assert _gate._Run._is_done(tmp_path, 4) is done
    monkeypatch.setattr(_gate, "hunt_state", lambda folder: SimpleNamespace(state="finished", trials_run=4))
    with closing(Ledger(tmp_path / layout.LEDGER, writable=True)) as ledger:
        killed = Failure(KILLED, "killed from outside 3 times")
        ledger.record(TrialResult(TrialSpec(0, 0, {}, {}, 9), Outcome.INVALID, failure=killed), snapshot="0")
    assert not _gate._Run._is_done(tmp_path, 4)  # the hunt runs it again


def test_gate_waits_for_a_hunt_whose_gate_was_killed(tmp_path, monkeypatch):
    busy, slept = [True, True, False], []

    class Place:
        def __init__(self, hunt):
            assert hunt == tmp_path

        def locked(self):
            if busy.pop(0):
                raise BusyError("busy", fix="wait", where="here")
            return nullcontext()

    monkeypatch.setattr(_gate, "HuntDirectory", Place)
    monkeypatch.setattr(_gate.time, "sleep", slept.append)
    _gate._wait_until_free(tmp_path)
    assert slept == [_gate._LOOK_EVERY_S] * 2
    monkeypatch.setattr(_gate, "_BUSY_S", -1.0)
    busy[:] = [True]
    with pytest.raises(BusyError):
        _gate._wait_until_free(tmp_path)


def test_work_trees_of_a_killed_gate_stay_until_its_hunts_have_ended(work, tmp_path, monkeypatch):
    asked = of_commits(work)
    started(asked, tmp_path / "g")
    work.asked.clear()
    waited = []
    monkeypatch.setattr(_gate, "_wait_until_free", lambda hunt: waited.append((hunt.name, len(work.asked))))
    started(asked, tmp_path / "g")
    assert waited == [("base", 0), ("head", 0)]
    assert [name for *_, name in work.asked] == ["base", "head"]


def test_existing_hunts_run_on_only_where_they_are_trusted(tmp_path, monkeypatch):
    asked, checked = gate(tmp_path), []
    started(asked, tmp_path / "g")
    monkeypatch.setattr(_gate, "refuse_untrusted_hunt", checked.append)
    monkeypatch.setattr(_gate, "_wait_until_free", checked.append)
    started(asked, tmp_path / "g")
    base, head = (tmp_path / f"g/{side}" for side in ("base", "head"))
    assert checked == [base, head, base, head]
    checked.clear()
    started(replace(asked, trusted=True), tmp_path / "g")
    assert checked == [base, head]
    write_request(base, replace(RunRequest.read(base / REQUEST), folder="/moved"))
    started(replace(asked, trusted=True), tmp_path / "g")  # the folder of a tree is another each time
    assert RunRequest.read(base / REQUEST).folder == str(tmp_path)


def test_rates_are_those_of_the_only_hunt(tmp_path, monkeypatch):
    run = started(gate(tmp_path, confidence=90.0), tmp_path / "g")
    (real,) = run._hunts
    assert run._rates() is None  # none has begun
    for folder in real.folders:
        ended(folder, "all_trials")
    asked = []
    monkeypatch.setattr(_gate, "measure_rates", lambda folder, **given: asked.append((folder, given)) or [folder.name])
    monkeypatch.setattr(_gate, "held_out_traffics", lambda settings, folders: (settings.seed, tuple(folders)))
    assert run._rates() is None  # no pair has ended
    pairs = SimpleNamespace(folders=real.folders, counts=SimpleNamespace(pairs=1))
    run._hunts = [pairs]
    assert run._rates() == ("base", "head")
    assert [folder for folder, _ in asked] == list(real.folders)
    assert asked[0][1] == {"per": "trial", "confidence": 90.0, "held_out": (4, real.folders)}
    run._hunts = [pairs, pairs]
    assert run._rates() is None
