"""What the functions for Python pass on to the parts that do the work, and their defaults."""

from __future__ import annotations

import inspect
import os
from pathlib import Path
from types import SimpleNamespace

import pytest

import crashhunt
from crashhunt import analysis, api, cli, crash_api, crashes, replays
from crashhunt.base.plugins import import_module
from crashhunt.errors import HuntWhileImportingError, UsageError
from crashhunt.plans import HuntOptions


@pytest.fixture
def work(monkeypatch):
    """Replace the parts that do the work; each call is noted."""
    calls = SimpleNamespace(found=[], replayed=[], asked=[], counted=[], judged=[], shrunk=[])

    def find(path, crash_id):
        calls.found.append((path, crash_id))
        return "found"

    def note(place, answer):
        def call(*words, **more):
            place.append((words, more))
            return answer

        return call

    monkeypatch.setattr(crashes, "find_bundle", find)
    monkeypatch.setattr(replays, "replay", note(calls.replayed, "report"))
    monkeypatch.setattr(analysis, "interventions_of", note(calls.asked, ("change",)))
    monkeypatch.setattr(analysis, "what_if", note(calls.counted, "counts"))
    monkeypatch.setattr(analysis, "judge_bundle", note(calls.judged, "judged"))
    monkeypatch.setattr(analysis, "shrink", note(calls.shrunk, "shrunk"))
    monkeypatch.setattr(crashes, "judgement_of", "the judgement of {}".format)
    return calls


def test_replay_passes_on_what_is_given(work):
    assert crashhunt.replay("h") == "report"
    assert crashhunt.replay(
        Path("h"), "3", code="current", changes={"speed": 3}, times=4, force=True, scenario=Path("s"),
        accelerate=False, trust=True,
    ) == "report"  # fmt: skip
    assert work.found == [(Path("h"), ""), (Path("h"), "3")]
    ((plain, _), (full, _)) = work.replayed
    assert plain == ("found", replays.ReplayOptions())
    wanted = replays.ReplayOptions(
        code="current", changes={"speed": "3"}, times=4, force=True, scenario="s", accelerate=False, trusted=True
    )
    assert full == ("found", wanted)
    assert plain[1].trusted is None  # it is determined, and not assumed
    assert (plain[1].code, plain[1].times, plain[1].scenario) == ("snapshot", 1, "")


def test_what_if_passes_on_what_is_given(work, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", {0: range(6)}.__getitem__)  # of this process
    assert crashhunt.what_if("h", from_step=4) == "counts"
    assert crashhunt.what_if(
        "h", "3", changes={"speed": 3}, before_s=2.0, agent="idm", arguments={"b": 1}, futures=True, overrule="brake",
        leave_out=["x"], interventions=["y"], times=7, parallel=2, time_s=9.0, trust=True,
    ) == "counts"  # fmt: skip
    crashhunt.what_if("h", agent="idm", code="snapshot")
    none = {
        "changes": {}, "from_step": None, "before_s": None, "agent": "", "arguments": {}, "futures": False,
        "overrule": "", "leave_out": (), "code": None, "more": (),
    }  # fmt: skip
    assert [words for words, _ in work.asked] == [("found",)] * 3
    assert work.asked[0][1] == {**none, "from_step": 4}
    assert work.asked[1][1] == {
        "changes": {"speed": "3"}, "from_step": None, "before_s": 2.0, "agent": "idm", "arguments": {"b": "1"},
        "futures": True, "overrule": "brake", "leave_out": ("x",), "code": None, "more": ("y",),
    }  # fmt: skip
    found = [words for words, _ in work.counted]
    assert [words[:2] for words in found] == [("found", ("change",))] * 3
    plain, full, chosen = (words[2] for words in found)
    assert work.found == [(Path("h"), ""), (Path("h"), "3"), (Path("h"), "")]
    assert plain == analysis.WhatIfOptions(code="snapshot", times=0, time_s=None, parallel=6, trusted=None)
    assert full == analysis.WhatIfOptions(code="current", times=7, time_s=9.0, parallel=2, trusted=True)
    assert chosen.code == "snapshot"


def test_judge_and_shrink_pass_on_what_is_given(work):
    assert crashhunt.judge("h") == "the judgement of judged"
    crashhunt.judge("h", "3", runs=1, why=2, reference=3, drivers=False, parallel=4, trust=True)
    ((plain, first), (full, second)) = work.judged
    assert (plain, full) == (
        ("found", replays.ReplayOptions(force=True)), ("found", replays.ReplayOptions(force=True, trusted=True)),
    )  # fmt: skip
    assert first == {"runs": 60, "why": 80, "reference": 20, "drivers": True, "parallel": 0}
    assert second == {"runs": 1, "why": 2, "reference": 3, "drivers": False, "parallel": 4}
    assert crashhunt.shrink("h") == "shrunk"
    crashhunt.shrink("h", "3", budget=9, time_s=5.0, form="scripted", parallel=2, trust=True)
    assert [words for words, _ in work.shrunk] == [("found",), ("found",)]
    assert [more for _, more in work.shrunk] == [
        {"budget": 500, "time_s": None, "form": "either", "parallel": 0, "trusted": None},
        {"budget": 9, "time_s": 5.0, "form": "scripted", "parallel": 2, "trusted": True},
    ]


def test_crash_of_a_hunt_is_taken_as_it_is(work, monkeypatch):
    class Bundle:
        pass

    monkeypatch.setattr(crashes, "Bundle", Bundle)
    bundle = Bundle()
    crashhunt.replay(bundle)
    crashhunt.what_if(bundle)
    assert work.found == []
    assert work.replayed[0][0][0] is work.asked[0][0][0] is work.counted[0][0][0] is bundle


def test_nothing_is_overwritten_trusted_or_changed_by_default():
    prepared, run, replayed, asked = (
        inspect.signature(call).parameters
        for call in (crashhunt.prepare, crashhunt.run, crashhunt.replay, crashhunt.what_if)
    )
    for parameters in (prepared, run):
        assert parameters["overwrite"].default is False
        for name in ("snapshot", "command"):
            assert parameters[name].default is None
    assert run["watch"].default is None
    for parameters in (replayed, asked):
        assert parameters["trust"].default is False
    assert (replayed["times"].default, replayed["force"].default, replayed["accelerate"].default) == (1, False, True)
    assert (asked["times"].default, asked["parallel"].default, asked["futures"].default) == (0, 0, False)


def test_judge_has_the_same_limits_in_python_and_as_a_command():
    asked = cli.make_parser().parse_args(["judge", "h"])
    for call in (crashhunt.judge, analysis.judge_bundle):
        limits = {name: inspect.signature(call).parameters[name].default for name in ("runs", "why", "reference")}
        assert limits == {"runs": asked.runs, "why": asked.why, "reference": asked.reference}
    assert inspect.signature(analysis.judge).parameters["runs"].default == asked.runs


@pytest.fixture
def hunt(monkeypatch):
    """Replace hunts and plans."""
    made = []

    class Hunt:
        def __init__(self, *words, **more):
            made.append((words, more))

        def run(self, watch):
            return ("report", watch)

    code = SimpleNamespace(imported=("module",))
    monkeypatch.setattr("crashhunt.plans.plan_with_code", lambda request, survey: (request, "settings", code))
    monkeypatch.setattr("crashhunt.hunts.Hunt", Hunt)
    return made, Hunt


def test_hunt_is_prepared_as_asked(hunt):
    from crashhunt.snapshots import SnapshotOptions

    made, kind = hunt
    assert isinstance(crashhunt.prepare("h", 2, 30, 100), kind)
    watch = print
    own = SnapshotOptions()
    found = crashhunt.run(
        Path("h"), 3, 40, 200, seed=5, agent="idm", snapshot=own, overwrite=True, command=("crashhunt", "run"),
        watch=watch, snapshot_limit_mb=7,
    )  # fmt: skip
    assert found == ("report", watch)
    (first, plain), (second, full) = made
    assert (first[0], first[2], second[0]) == (Path("h"), "settings", Path("h"))
    assert (first[1].trials, first[1].max_steps, first[1].run.parallel) == (30, 100, 2)
    assert (second[1].trials, second[1].max_steps, second[1].run.parallel, second[1].seed) == (40, 200, 3, 5)
    assert plain == {
        "command": None, "overwrite": False, "seed_given": False, "imported": ("module",),
        "snapshot": SnapshotOptions.of(HuntOptions()),
    }  # fmt: skip
    assert full == {
        "command": ["crashhunt", "run"], "overwrite": True, "seed_given": True, "imported": ("module",),
        "snapshot": own,
    }  # fmt: skip
    crashhunt.prepare("h", 2, 30, 100, snapshot_limit_mb=7)
    assert made[-1][1]["snapshot"] == SnapshotOptions.of(HuntOptions(snapshot_limit_mb=7)) != plain["snapshot"]


def test_traffic_is_surveyed_in_the_directory_of_the_hunt(hunt, monkeypatch):
    surveyed = []

    def survey(directory, *, overwrite):
        return lambda *words: surveyed.append((directory, overwrite, words)) or "surveyed"

    def plan(request, survey):
        assert survey("scenario", "request", "settings") == "surveyed"
        return "scenario", "settings", SimpleNamespace(imported=())

    monkeypatch.setattr("crashhunt.hunts.TrafficSurveyor", survey)
    monkeypatch.setattr("crashhunt.plans.plan_with_code", plan)
    crashhunt.prepare("h", 2, 30, 100)
    crashhunt.prepare("g", 2, 30, 100, overwrite=True)
    words = ("scenario", "request", "settings")
    assert surveyed == [(Path("h"), False, words), (Path("g"), True, words)]


def test_values_out_of_range_are_refused_before_anything_is_made(hunt):
    made, _ = hunt
    for words in ((-1, 30, 100), (2, -1, 100), (2, 30, 0)):
        with pytest.raises(UsageError):
            crashhunt.prepare("h", *words)
    assert made == []
    assert vars(api).keys() >= {"prepare", "run"}
    assert vars(crash_api).keys() >= {"replay", "what_if", "judge", "shrink"}


@pytest.mark.parametrize("threads", [False, True])
def test_module_that_starts_a_hunt_when_it_is_imported_is_refused(tmp_path, monkeypatch, threads):
    """A script without ``if __name__ == "__main__"`` that names its own class: each import would hunt again."""
    (tmp_path / "hunts_again.py").write_text(
        "import crashhunt\nclass Mine: ...\n"
        "crashhunt.run('h', 1, 1, 9, scenario='loop', agents={'ego': 'hunts_again:Mine'})\n"
    )
    monkeypatch.chdir(tmp_path)
    if threads:  # then the module is imported in this process
        monkeypatch.setattr("crashhunt.base.isolation._is_embedded", lambda: True)
    message = r"^the module 'hunts_again' runs trials when it is imported; put the call below: if __name__ =="
    with pytest.raises(HuntWhileImportingError, match=message):
        crashhunt.run("h", 1, 1, 9, scenario="loop", agents={"ego": "hunts_again:Mine"})
    assert not (tmp_path / "h").exists()


@pytest.mark.parametrize("call", ["replay", "what_if", "judge", "shrink"])
def test_module_that_examines_a_crash_when_it_is_imported_is_refused(tmp_path, monkeypatch, call):
    more = ", []" if call == "what_if" else ""
    (tmp_path / f"{call}s_again.py").write_text(f"import crashhunt\ncrashhunt.{call}('h'{more})\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(HuntWhileImportingError, match=f"^the module '{call}s_again' runs trials when it is imported"):
        import_module(f"{call}s_again")
