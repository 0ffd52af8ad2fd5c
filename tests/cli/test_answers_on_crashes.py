"""What the commands on crashes ask for, print and end with, with the work itself replaced."""

from __future__ import annotations

import importlib
import json
import signal
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
from command_line import parser, run

from crashhunt.cli import _check, _guide, _judge, _replay, _shrink, _trust, _whatif
from crashhunt.corpus import KnownType
from crashhunt.crashes import Cause, TrustedOrigin
from crashhunt.errors import BundleError, HuntDirectoryError, UsageError
from crashhunt.render import FilmOptions
from crashhunt.replays import ReplayOptions
from crashhunt.trial import Outcome
from crashhunt.trial_reruns import StoppedError


def named(name, **more):
    """Return an object whose JSON is its name."""
    return SimpleNamespace(to_json=lambda: name, **more)


def crash(steps=50, outcome=Outcome.COLLISION, **more):
    spec = SimpleNamespace(max_steps=90)
    result = SimpleNamespace(steps=steps, outcome=outcome, spec=spec, summary="it crashed", collision=None)
    recording = SimpleNamespace(prologue=SimpleNamespace(step_length_s=0.1), steps=steps)
    usual = {"id": "000003-collision", "is_near_miss": False, "driver": "ego", "path": Path("h/crashes/3")}
    return SimpleNamespace(**{**usual, "result": result, "recording": lambda: recording, **more})


@pytest.fixture
def opened(monkeypatch):
    """Opens a crash in place of that of a directory, and notes which was asked for."""
    asked = []

    def open_it(bundle, *modules):
        @contextmanager
        def opened_crash(directory, crash):
            asked.append((directory, crash))
            yield bundle, "archive"

        for module in modules:
            monkeypatch.setattr(module, "opened_crash", opened_crash)
            monkeypatch.setattr(module, "run_trusted", lambda run, *words: asked.append(words) or run("trusted"), False)
        return asked

    return open_it


# crashhunt compare


def test_compare_prints_a_text_a_table_or_json(monkeypatch, capsys, tmp_path):
    (tmp_path / "begun").mkdir()
    (tmp_path / "begun" / "hunt.toml").touch()
    hunts = {"suite": [tmp_path / "begun", tmp_path / "later"], "hunt": [Path("hunt")]}
    asked, pages = [], []
    found = SimpleNamespace(to_json=lambda: {"hunts": 2}, write_csv=lambda file: file.write("dir\n"))
    monkeypatch.setattr("crashhunt.results.find_searches", lambda directory: hunts[str(directory)])
    monkeypatch.setattr("crashhunt.statistics.compare", lambda *words, per: asked.append((*words, per)) or found)
    monkeypatch.setattr("crashhunt.report.describe_comparison", lambda comparison: "better")
    monkeypatch.setattr("crashhunt.report.comparison_page", lambda *words: pages.append(words))
    excluded = f"{tmp_path / 'later'} has not begun, and is excluded\n"
    assert run("compare", "hunt", "suite") == 0
    assert capsys.readouterr() == ("better\n", excluded)
    assert run("compare", "hunt", "suite", "--json") == 0
    assert capsys.readouterr() == ('{"hunts": 2}\n', f"{excluded}better\n")
    assert run("compare", "hunt", "suite", "--csv", "--html", "p.html") == 0
    assert capsys.readouterr() == ("dir\n", f"{excluded}p.html has the plots\n")
    assert run("compare", "hunt", "suite", "--html", "p.html") == 0
    assert capsys.readouterr() == ("better\np.html has the plots\n", excluded)
    assert run("compare", "hunt", "suite", "--per", "1000km") == 0
    capsys.readouterr()
    assert asked == [*[(Path("hunt"), tmp_path / "begun", "trial")] * 4, (Path("hunt"), tmp_path / "begun", "1000km")]
    assert pages == [(found, Path("p.html"))] * 2


# crashhunt crashes


@pytest.fixture
def grouped(monkeypatch):
    """Groups two crash types, of which the first is in a corpus."""
    groups = [
        named({"type": name}, signature=name, first=SimpleNamespace(hunt=f"h{number}"))
        for number, name in enumerate(("rear", "side"))
    ]
    asked = {"hunts": [], "divided": [], "trust": [], "told": [], "stops": []}

    def group_crashes(bundles, dropped):
        asked["hunts"].append(([*bundles], dropped))
        return SimpleNamespace(groups=groups, left_out=["h/crashes/9 is damaged"])

    @contextmanager
    def requests():
        yield asked["stops"]

    monkeypatch.setattr("crashhunt.results.find_hunts", lambda directory: [directory / "0", directory / "1"])
    monkeypatch.setattr("crashhunt.crashes.list_bundles", lambda hunt: [f"{hunt} crash"])
    monkeypatch.setattr("crashhunt.results.dropped_crashes", lambda hunts: len(hunts))
    monkeypatch.setattr("crashhunt.results.crashes_by_version", lambda hunts, groups: {})
    monkeypatch.setattr("crashhunt.crashes.group_crashes", group_crashes)
    monkeypatch.setattr("crashhunt.report.describe_groups", lambda groups, known: f"types; known: {known}")
    monkeypatch.setattr("crashhunt.report.describe_causes", lambda types, causes: f"{types is groups}: {len(causes)}")
    monkeypatch.setattr("crashhunt.crashes.join_causes", lambda groups, causes: [named("joined")])
    monkeypatch.setattr("crashhunt.crashes.count_causes", lambda joined: (5, 6))
    monkeypatch.setattr("crashhunt.base.signals.stop_requests", requests)
    monkeypatch.setattr("crashhunt.analysis.divide_by_cause", lambda group, chosen, **more: (
        asked["divided"].append((group.signature, chosen, more)) or (named("why"),)
    ))  # fmt: skip
    monkeypatch.setattr("crashhunt.cli._crashes.check_trust", lambda *words: asked["trust"].append(words))
    monkeypatch.setattr("crashhunt.cli._crashes.tell", lambda options, *words: asked["told"].append(words))
    monkeypatch.setattr("crashhunt.report.findings_of", lambda types, known: (types is groups, known))
    monkeypatch.setattr(
        "crashhunt.report.crashes_summary", lambda findings, compared: f"{findings[0]}, compared: {compared}"
    )
    monkeypatch.setattr("crashhunt.report.crash_annotations", lambda findings: ["::error"])
    monkeypatch.setattr("crashhunt.report.write_sarif", lambda findings, path: asked["told"].append(path))
    return groups, asked


def test_crashes_are_grouped_over_all_hunts(grouped, capsys):
    _, asked = grouped
    assert run("crashes", "a", "b", "a") == 0
    hunts = ["a/0", "a/1", "b/0", "b/1"]
    assert asked["hunts"] == [([f"{hunt} crash" for hunt in hunts], 4)]
    assert capsys.readouterr() == ("types; known: None\n", "skipped: h/crashes/9 is damaged\n")
    assert run("crashes", "a", "--json") == 0
    out, err = capsys.readouterr()
    assert json.loads(out) == {"groups": [{"type": "rear"}, {"type": "side"}], "left_out": ["h/crashes/9 is damaged"]}
    assert err == "types; known: None\nskipped: h/crashes/9 is damaged\n"
    assert (asked["divided"], asked["told"]) == ([], [])


@pytest.mark.parametrize(("words", "most"), [(["--by-cause"], 8), (["--by-cause", "1"], 1)])
@pytest.mark.parametrize("interrupted", [False, True])
def test_types_are_divided_by_cause(grouped, capsys, words, most, interrupted):
    _, asked = grouped
    asked["stops"] += [1] if interrupted else []
    assert run("crashes", "a", *words, "--json") == (130 if interrupted else 0)
    out, err = capsys.readouterr()
    data = json.loads(out)
    assert data["groups"] == [{"type": "rear", "causes": ["why"]}, {"type": "side", "causes": ["why"]}]
    assert (data["types_by_cause"], data["by_cause"]) == (5, ["joined"])
    assert "True: 2\n" in err
    assert ("Interrupted: some causes are not known yet." in err) == interrupted
    assert [bundle.hunt for bundle, _ in asked["trust"]] == ["h0", "h1"]
    assert {trusted for _, trusted in asked["trust"]} == {None}
    assert [name for name, _, _ in asked["divided"]] == ["rear", "side"]
    for _, chosen, more in asked["divided"]:
        assert (chosen.force, chosen.trusted, more["most"], more["stopped"]()) == (True, True, most, interrupted)
        assert more["parallel"] >= 1


def test_number_of_analysed_crashes_is_at_least_1(grouped):
    with pytest.raises(UsageError, match="--by-cause is 0; give at least 1"):
        run("crashes", "a", "--by-cause", "0")


def test_types_of_a_corpus_are_marked(grouped, monkeypatch, capsys, tmp_path):
    _, asked = grouped
    case = SimpleNamespace(path=Path("corpus/case"))
    monkeypatch.setattr("crashhunt.corpus.find_cases", lambda places: [*places, "other"])
    monkeypatch.setattr("crashhunt.corpus.read_case", lambda path: case)
    known = {}

    def compare_types(groups, cases, causes):
        return {name: KnownType(case, *more) for name, (case, *more) in known.items()} if cases else {}

    monkeypatch.setattr("crashhunt.corpus.compare_types", compare_types)
    known["rear"] = (case, "cause")
    words = ("--known", tmp_path / "corpus", "--json")
    assert run("crashes", "a", *words, "--sarif", "s.sarif") == 0
    assert [one["known"] for one in json.loads(capsys.readouterr().out)["groups"]] == ["corpus/case", None]
    assert asked["told"] == [Path("s.sarif"), ("True, compared: True", ["::error"])]
    (tmp_path / "corpus").mkdir()  # without a case, which is no error
    assert run("crashes", "a", *words) == 0
    assert [one["known"] for one in json.loads(capsys.readouterr().out)["groups"]] == [None, None]
    asked["told"].clear()
    assert run("crashes", "a", "--annotate") == 0
    assert asked["told"] == [("True, compared: False", ["::error"])]


def test_new_crash_fails_where_that_is_asked_for(grouped, monkeypatch, capsys, tmp_path):
    case, known, left_out = SimpleNamespace(path=Path("corpus/case")), {}, []
    monkeypatch.setattr("crashhunt.corpus.find_cases", lambda places: places)
    monkeypatch.setattr("crashhunt.corpus.read_case", lambda path: case)
    monkeypatch.setattr("crashhunt.corpus.compare_types", lambda groups, cases, causes: known)
    groups = grouped[0]
    found = SimpleNamespace(groups=groups, left_out=left_out)
    monkeypatch.setattr("crashhunt.crashes.group_crashes", lambda bundles, dropped: found)
    words = ("crashes", "a", "--known", tmp_path)
    known["rear"] = KnownType(case, "cause")
    assert (run(*words), run(*words, "--fail-on-new")) == (0, 1)
    assert capsys.readouterr().out.endswith("\n1 new crash type\n")
    known["side"] = KnownType(case, "type")
    assert run(*words, "--fail-on-new") == 0
    assert "not judged: 'side' is known by its type alone, so another cause would be hidden" in capsys.readouterr().out
    known["side"] = KnownType(case, "cause", (Cause("omission", "gap left", "changed lanes"),))
    assert run(*words, "--fail-on-new", "--json") == 1
    data = json.loads(capsys.readouterr().out)["groups"]
    assert [(one["known"], one["known_by"]) for one in data] == [("corpus/case", "cause"), (None, "cause")]
    assert data[1]["new_causes"] == ["omission: changes to the left lane into a gap that is not safe"]
    del known["side"]
    groups.pop()
    left_out.append("h/crashes/9 is damaged")  # which may be of any type
    assert (run(*words), run(*words, "--fail-on-new")) == (0, 1)
    left_out.clear()
    groups.clear()
    assert run(*words, "--fail-on-new") == 0  # no crash
    with pytest.raises(UsageError, match="--fail-on-new has no corpus"):
        run("crashes", "a", "--fail-on-new")


def test_hunt_is_not_taken_for_an_empty_corpus(grouped, tmp_path):
    hunt = tmp_path / "other"
    hunt.mkdir()
    (hunt / "hunt.toml").touch()
    with pytest.raises(UsageError, match="is a hunt, not a corpus; make a corpus of it: crashhunt corpus add "):
        run("crashes", "a", "--known", hunt)


# crashhunt replay


@pytest.mark.parametrize(
    ("near_miss", "last_s", "panels"),
    [(False, 0.0, 0), (False, 2.0, 29), (False, 9.0, 0), (True, 0.0, 0), (True, 2.0, 19)],
)
def test_panels_are_drawn_from_the_step_before_the_first_that_a_film_shows(monkeypatch, near_miss, last_s, panels):
    monkeypatch.setattr("crashhunt.crashes.most_dangerous", lambda recording: SimpleNamespace(step=30))
    found = crash(is_near_miss=near_miss)
    with _replay.filmed(ReplayOptions(), found, FilmOptions(last_s=last_s)) as options:
        first, folder = options.look.panels
        assert (first, folder.is_dir(), options.look.until, options.look.quiet) == (panels, True, 90, True)
    assert not folder.exists()
    with _replay.filmed(chosen := ReplayOptions(), found, FilmOptions(last_s=last_s, panels=False)) as options:
        assert options is chosen


@pytest.mark.parametrize(
    ("words", "look"),
    [
        ([], None),
        (["--until", "20"], (20, 0, False, None)),
        (["--before", "0"], (50, 0, False, None)),
        (["--before", "49", "--json"], (1, 0, True, None)),
        (["--pdb"], (50, 50, False, None)),
        (["--pdb", "--until", "7"], (7, 7, False, None)),
        (["--gui"], (90, 0, False, 0.1)),
        (["--gui", "--sleep", "0", "--before", "5"], (45, 0, False, 0.0)),
        (["--gui", "--pdb", "--json"], None),
    ],
)
def test_steps_of_a_replay_to_look_at(words, look):
    options = parser().parse_args(["replay", "h", *words])
    if {"--pdb", "--json"} <= {*words}:
        with pytest.raises(UsageError, match="--pdb needs a terminal"):
            _replay._view_of(options, crash())
        return
    found = _replay._view_of(options, crash())
    assert (found and (found.until, found.stop_at, found.to_stderr, found.window)) == look


def test_debugger_stops_in_the_step_in_which_the_agent_failed():
    options = parser().parse_args(["replay", "h", "--pdb"])
    assert _replay._view_of(options, crash(outcome=Outcome.AGENT_ERROR)).stop_at == 51
    assert _replay.look_at_all(crash(outcome=Outcome.HANG)).until == 50
    assert _replay.look_at_all(crash(outcome=Outcome.PROCESS_DIED, steps=0)) is None
    assert _replay.look_at_all(crash(), quiet=True).quiet
    assert not _replay.look_at_all(crash()).quiet
    gui = parser().parse_args(["replay", "h", "--gui"])
    with pytest.raises(UsageError, match="ended before its first step, so there is nothing to show; omit --gui"):
        _replay._view_of(gui, crash(outcome=Outcome.PROCESS_DIED, steps=0))


def test_closest_moment_is_that_of_a_near_miss(monkeypatch):
    options = parser().parse_args(["replay", "h", "--before", "3"])
    near = SimpleNamespace(step=20, agent="ego", other="x")
    monkeypatch.setattr("crashhunt.crashes.most_dangerous", lambda recording: near)
    bundle = crash(is_near_miss=True)
    assert _replay._last_step(options, bundle) == 17
    options.before = 20
    with pytest.raises(UsageError, match="--before is 20, but the closest moment is at step 20; give 0 to 19"):
        _replay._last_step(options, bundle)
    near.step = 0
    assert _replay._last_step(options, bundle) == 30
    options.before = 50
    with pytest.raises(UsageError, match="--before is 50, but the trial ended at step 50; give 0 to 49"):
        _replay._last_step(options, bundle)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--before", "50"], "--before is 50, but the crash is at step 50; give 0 to 49"),
        (["--before", "-1"], "--before is -1, but the crash is at step 50"),
        (["--until", "0"], "--until is 0; give at least 1"),
        (["--sleep", "1"], "--sleep is 1; give "),
        (["--gui", "--sleep", "-1"], "--sleep is -1"),
        (["--gui", "--sleep", "inf"], "--sleep is inf"),
        (["--times", "0"], "--times is 0"),
        (["--times", "2", "--until", "3"], "--until examines one run, so it cannot be combined with --times 2"),
        (["--times", "2", "--gif", "a.gif"], "a film examines one run"),
        (["--crash", "1,2"], "--crash '1,2' names several crashes; give one crash, or "),
        (["--scenario", "loop", "--pdb"], "--pdb cannot be combined with --scenario"),
        (["--scenario", "loop", "--print", "x"], "--print cannot be combined with --scenario"),
        (["--scenario", "loop", "--gif", "a.gif"], "a film cannot be combined with --scenario"),
        (["--from-log", "--gif", "a.gif", "--times", "2"], "--times cannot be used with --from-log"),
        (["--from-log", "--gif", "a.gif", "--until", "2"], "--until cannot be used with --from-log"),
        (["--gif", "a.gif", "--size", "960"], "--size '960' is not a size; write WIDTHxHEIGHT"),
        (["--gif", "a.gif", "--size", "9x-1"], "--size '9x-1' is not a size"),
    ],
)
def test_replay_refuses_what_it_would_ignore(opened, words, message):
    opened(crash(), _replay)
    with pytest.raises(UsageError) as caught:
        run("replay", "h", *words)
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize(
    ("words", "verdicts", "code"),
    [
        ([], ["reproduced"], 0), ([], ["reproduced", "fixed"], 1), ([], ["fixed"], 1),
        (["--expect", "fixed"], ["fixed"], 0), (["--expect", "fixed"], ["reproduced"], 1),
    ],
)  # fmt: skip
def test_replay_ends_with_1_without_the_expected_verdict(opened, monkeypatch, capsys, words, verdicts, code):
    asked = []
    report = SimpleNamespace(verdicts=verdicts, times=2, to_json=lambda: {"verdict": verdicts[0]}, recording="recorded")
    monkeypatch.setattr("crashhunt.replays.replay", lambda bundle, chosen, stopped: asked.append(chosen) or report)
    monkeypatch.setattr("crashhunt.report.describe_replay", lambda report: "as it was")
    bundle = crash()
    calls = opened(bundle, _replay)
    more = ["--set", "speed=3", "--times", "2", "--code", "current", "--no-accelerate", "--force", "--scenario", "x"]
    assert run("replay", "h", "--crash", "3", *more, *words) == code
    assert calls[0] == (Path("h"), "3")
    assert calls[1][:2] == (bundle, "archive")
    (chosen,) = asked
    assert (chosen.code, chosen.changes, chosen.times) == ("current", {"speed": "3"}, 2)
    assert (chosen.accelerate, chosen.force, chosen.scenario, chosen.trusted) == (False, True, "x", "trusted")
    assert capsys.readouterr() == ("as it was\n", "")
    assert run("replay", "h", "--from-log", "--json", *words) == code
    assert (asked[1].code, asked[1].accelerate, asked[1].look) == ("log", True, None)
    assert json.loads(capsys.readouterr().out) == {"verdict": verdicts[0]}


@pytest.mark.parametrize("finished", [0, 3])
def test_interrupted_replays_report_those_that_finished(opened, monkeypatch, capsys, finished):
    def replay(bundle, chosen, stopped):
        assert not stopped()
        signal.raise_signal(signal.SIGINT)
        assert stopped()
        if not finished:
            raise StoppedError
        return SimpleNamespace(verdicts={"reproduced": finished}, times=finished, to_json=lambda: {"times": finished})

    monkeypatch.setattr("crashhunt.replays.replay", replay)
    monkeypatch.setattr("crashhunt.report.describe_replay", lambda report: f"of {report.times} runs")
    opened(crash(), _replay)
    assert run("replay", "h", "--times", "9", "--json") == 130
    out, err = capsys.readouterr()
    assert out == ('{"times": 3}\n' if finished else "")
    assert err.splitlines() == (
        ["of 3 runs", "Interrupted: 3 of 9 replays finished."]
        if finished
        else ["Interrupted: none of 9 replays finished."]
    )


def test_values_of_each_step_are_printed(opened, monkeypatch, capsys):
    report = SimpleNamespace(verdicts=["reproduced"], to_json=dict, recording="replayed")
    asked, checked = [], []
    monkeypatch.setattr("crashhunt.replays.replay", lambda bundle, chosen, stopped: report)
    monkeypatch.setattr("crashhunt.report.describe_replay", lambda report: "as it was")
    monkeypatch.setattr("crashhunt.report.check_fields", lambda *words: checked.append(words))
    monkeypatch.setattr("crashhunt.report.steps_table", lambda *words: asked.append(words) or ["table"])
    monkeypatch.setattr("crashhunt.report.format_table", lambda table: ["x  y"])
    monkeypatch.setattr("crashhunt.crashes.partner", lambda result: "leader")
    bundle = crash()
    opened(bundle, _replay)
    fields = ["x", "observation[0,vx]", "speed"]
    assert run("replay", "h", "--print", ",".join(fields)) == 0
    assert capsys.readouterr().out == "x  y\n\nas it was\n"
    assert asked == [("replayed", fields, "ego", "leader")]
    assert checked == [(bundle.recording(), fields, "ego")]
    assert run("replay", "h", "--print", "x", "--code", "current", "--json") == 0
    assert json.loads(capsys.readouterr().out) == {"table": ["table"]}
    assert len(checked) == 1  # today's code may be shown other observations
    near = SimpleNamespace(agent="ego", other="near", step=3)
    monkeypatch.setattr("crashhunt.crashes.most_dangerous", lambda recording: near)
    bundle.is_near_miss = True
    run("replay", "h", "--print", "x")
    near.agent = "second"
    run("replay", "h", "--print", "x")
    assert [words[3] for words in asked[2:]] == ["near", "leader"]


def test_film_has_the_options_that_are_given(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    words = ["--gif", "a.gif", "--fps", "5", "--size", "320x200", "--last-seconds", "3", "--no-panels"]
    words += ["--last-step-repeats", "7", "--blank-frames", "2"]
    film = _replay.film_options(parser().parse_args(["replay", "h", *words]))
    assert (film.fps, film.size, film.last_s, film.panels) == (5.0, (320, 200), 3.0, False)
    assert (film.last_step_repeats, film.blank_frames) == (7, 2)
    usual = _replay.film_options(parser().parse_args(["replay", "h", "--video", "a.mp4"]))
    assert (usual.fps, usual.size, usual.last_s, usual.panels) == (0.0, (960, 540), 0.0, True)
    assert (usual.last_step_repeats, usual.blank_frames) == (10, 10)
    assert _replay.film_options(parser().parse_args(["replay", "h", "--fps", "5"])) is None


def test_films_of_several_crashes_are_written_together(opened, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    written = []
    monkeypatch.setattr(_replay, "recorded_shot", lambda bundle: f"shot of {bundle.id}")
    for name in ("write_video", "write_gif", "write_frames"):
        monkeypatch.setattr(
            f"crashhunt.render.{name}",
            lambda path, shots, film, watch, name=name: written.append((name, path, shots)) or len(written),
        )
    calls = opened(crash(), _replay)
    words = ("--crash", "3,4", "--from-log", "--gif", "a.gif", "--frames", "pictures", "--video", "a.mp4", "--json")
    assert run("replay", "h", *words) == 0
    shots = ["shot of 000003-collision"] * 2
    names = (("write_video", "a.mp4"), ("write_gif", "a.gif"), ("write_frames", "pictures"))
    assert written == [(name, Path(path), shots) for name, path in names]
    assert calls == [(Path("h"), "3"), (Path("h"), "4")]
    out, err = capsys.readouterr()
    assert json.loads(out) == {"crashes": [], "written": {"a.mp4": 1, "a.gif": 2, "pictures": 3}}
    assert err.splitlines()[0] == "a.mp4 has 1 pictures"


# crashhunt whatif and shrink


@pytest.mark.parametrize("stopped", [False, True])
def test_whatif_asks_for_the_change_that_is_named(opened, monkeypatch, capsys, stopped):
    asked = []
    counts = SimpleNamespace(lines=lambda: ["3 of 5", "crash"], to_json=lambda: {"runs": 5})

    @contextmanager
    def requests():
        yield [1] if stopped else []

    monkeypatch.setattr("crashhunt.base.signals.stop_requests", requests)
    monkeypatch.setattr(
        "crashhunt.analysis.interventions_of", lambda *words, **more: asked.append((words, more)) or "x"
    )
    monkeypatch.setattr("crashhunt.analysis.what_if", lambda *words: asked.append(words) or counts)
    bundle = crash()
    opened(bundle, _whatif)
    words = ["--set", "speed=3", "--from-step", "20", "--agent", "idm", "--arg", "a=b", "--futures", "--times", "5"]
    words += ["--overrule", "brake", "--leave-out", "x,,y", "--parallel", "3", "--for", "90s", "--json"]
    assert run("whatif", "h", *words) == (130 if stopped else 0)
    (given, more), (of, change, options) = asked
    assert (given, of, change) == ((bundle,), bundle, "x")
    assert more == {
        "changes": {"speed": "3"}, "from_step": 20, "before_s": None, "agent": "idm", "arguments": {"a": "b"},
        "futures": True, "overrule": "brake", "leave_out": ("x", "y"), "code": None,
    }  # fmt: skip
    assert (options.code, options.times, options.parallel, options.time_s) == ("current", 5, 3, 90.0)
    assert (options.trusted, options.stopped()) == ("trusted", stopped)
    assert capsys.readouterr() == ('{"runs": 5}\n', "3 of 5\ncrash\n")
    run("whatif", "h", "--before", "2.5")
    assert (asked[2][1]["before_s"], asked[2][1]["leave_out"], asked[3][2].code) == (2.5, (), "snapshot")
    assert asked[3][2].parallel >= 1
    run("whatif", "h", "--code", "current")
    assert asked[5][2].code == "current"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["whatif", "h", "--times", "0"], "--times is 0; give at least 1"),
        (
            ["whatif", "h", "--times", str(2**63)],
            f"argument --times: '{2**63}' is out of range (allowed: up to {2**63 - 1})",
        ),
        (["whatif", "h", "--parallel", "-1"], "--parallel is -1; give at least 0 (0: one per core)"),
        (["whatif", "h", "--for", "soon"], "--for is 'soon'; give a time above 0, such as 90s"),
        (["shrink", "h", "--budget", "0"], "--budget is 0; give at least 1"),
        (["shrink", "h", "--parallel", "-1"], "--parallel is -1; give at least 0 (0: one per core)"),
        (["shrink", "h", "--for", "soon"], "--for is 'soon'; give a time above 0, such as 90s"),
        (["show", "h", "--last-seconds", "0"], "--last-seconds is 0; give a number above 0"),
        (["show", "h", "--last-seconds", "inf"], "--last-seconds is inf"),
        (["show", "h", "--braking", "0.09"], "--braking is 0.09; give a number of at least 0.1"),
        (["show", "h", "--last-seconds", "-1"], "--last-seconds is -1"),
        (["show", "h", "--braking", "inf"], "--braking is inf"),
        (["show", "h", "--braking", "nan"], "--braking is nan"),
        (["show", "h", "--braking", "1e-9"], "--braking is 1e-09"),
        (
            ["export", "h", "a.xosc"],
            "a.xosc: without --as, export writes a zip file; add --as openscenario, or name it",
        ),
        (
            ["export", "h", "a.gif"],
            "a.gif: without --as, export writes a zip file; use crashhunt replay --gif FILE, or",
        ),
        (["export", "h", "a.zip", "--recorded-agent"], "--recorded-agent has no effect without --as; add --as common"),
        (["export", "h", "a.zip", "--as", "commonroad"], "a.zip: --as commonroad writes a .xml file; name it a.xml"),
        (["logs", "h", "--errors-only", "--type", "run"], "--errors-only and --type run contradict each other"),
        (["logs", "h", "--trial", "-1"], "--trial is -1; give at least 0"),
        (["report", "h", "--crashes", "-1"], "--crashes is -1; give at least 0"),
        (["trust", "h", "--remove", "x"], "DIR and --remove cannot be combined"),
    ],
)
def test_options_out_of_range_are_named(words, message):
    with pytest.raises(UsageError) as caught:
        run(*words)
    assert str(caught.value).startswith(message)


def shrunk(**more):
    usual = {
        "bundle": crash(), "verdict": "minimized", "ended": "done", "small": None, "why": "", "others": (8, 1),
        "agents": (2, 2), "trials": 40, "steps_cut": 0, "notes": (), "scripted": None, "changed": {},
        "to_json": lambda: {"trials": 40},
    }  # fmt: skip
    return SimpleNamespace(**{**usual, **more})


@pytest.mark.parametrize(
    ("found", "code"),
    [
        (shrunk(), 0), (shrunk(ended="time"), 0), (shrunk(ended="interrupted"), 130),
        (shrunk(verdict="not_reproduced"), 1), (shrunk(verdict="not_reproduced", ended="interrupted"), 130),
    ],
)  # fmt: skip
def test_shrink_ends_with_1_where_the_crash_does_not_reproduce(opened, monkeypatch, capsys, found, code):
    asked = []
    monkeypatch.setattr("crashhunt.analysis.shrink", lambda bundle, **more: asked.append((bundle, more)) or found)
    bundle = crash()
    opened(bundle, _shrink)
    words = ["--budget", "7", "--for", "1m", "--form", "scripted", "--parallel", "2", "--json"]
    assert run("shrink", "h", *words) == code
    ((of, more),) = asked
    assert of is bundle
    assert [more[name] for name in ("budget", "time_s", "form", "parallel", "trusted")] == [
        7, 60.0, "scripted", 2, "trusted"
    ]  # fmt: skip
    assert json.loads(capsys.readouterr().out) == {"trials": 40}
    assert run("shrink", "h") == code
    assert [asked[1][1][name] for name in ("budget", "form", "parallel")] == [500, "either", 0]


def test_exported_crash_cannot_be_minimized(tmp_path):
    (tmp_path / "a.zip").touch()
    with pytest.raises(UsageError, match="cannot write into an exported file; unpack this zip file"):
        run("shrink", tmp_path / "a.zip")


@pytest.mark.parametrize(
    ("found", "line"),
    [
        (shrunk(), "nothing can be removed"),
        (shrunk(why="each removal changes the type"), "nothing can be removed: each removal changes the type"),
        (shrunk(ended="budget"), "nothing has been removed yet: budget"),
        (shrunk(ended="interrupted", why="w"), "nothing has been removed yet: w"),
        (shrunk(verdict="not_reproduced", why="it survives"), "cannot be minimized: it survives"),
    ],
)
def test_crash_that_stays_as_it_is_is_described(found, line):
    found.notes = ("SUMO differs",)
    assert _shrink._summary_of(found).splitlines() == [
        "000003-collision: it crashed", f"  {line}", "  note: SUMO differs"
    ]  # fmt: skip


def test_minimized_crash_is_described():
    small = crash(steps=20, id="000003-collision.small", confirmed=True, why_unconfirmed="")
    found = shrunk(
        small=small, agents=(2, 1), scripted=("a", "b"), steps_cut=5, changed={"speed": (9.5, 10)}, notes=("n",)
    )
    lines = [line.strip() for line in _shrink._summary_of(found).splitlines()]
    assert lines == [
        "000003-collision: it crashed",
        "000003-collision.small: it crashed",
        "other actors: 8 before, 1 now; steps: 50 before, 20 now",
        "agents: 2 before, 1 now",
        "a, b are moved as recorded, independent of the agent",
        "the first 5 steps are removed",
        "speed was 9.5 and is 10",
        "40 trials",
        "saved in h/crashes/3",
        "confirmed: bit-identical when replayed in a new process",
        "note: n",
    ]
    (was, now) = (SimpleNamespace(other=name) for name in ("left.3", "left.5"))
    with_partners = shrunk(bundle=crash(), small=crash(confirmed=True))
    with_partners.bundle.result.collision, with_partners.small.result.collision = was, was
    assert "instead" not in _shrink._summary_of(with_partners)
    with_partners.small.result.collision = now
    assert "\n  the crash type is the same, with left.5 instead of left.3\n" in _shrink._summary_of(with_partners)
    odd = crash(path=Path("a\nb/crashes/3"), confirmed=True)
    assert "\n  saved in $'a\\x0ab/crashes/3'\n" in _shrink._summary_of(shrunk(small=odd))
    plain = _shrink._summary_of(shrunk(small=small, ended="budget")).splitlines()
    assert len(plain) == 6
    assert plain[3].strip() == "40 trials; stopped early: budget"
    assert _shrink._replaced_words(()) == "no traffic"
    assert _shrink._replaced_words(("a",)) == "a is moved as recorded, independent of the agent"
    for confirmed, why, line in (
        (False, "", "flaky: the replay in a new process deviates"), (None, "", "not confirmed: interrupted"),
        (None, "no time", "not confirmed: no time"),
    ):  # fmt: skip
        small.confirmed, small.why_unconfirmed = confirmed, why
        assert _shrink._confirmation_words(small).strip() == line


# crashhunt bisect, export and show


@pytest.mark.parametrize(
    ("commit", "line"),
    [("c" * 40, "cccccccccccc is the first in which it crashes: faster"), (None, "it is one of aaaaaaaaaaaa, bbbb")],
)
def test_bisect_ends_with_1_where_it_stays_open(opened, monkeypatch, capsys, commit, line):
    from crashhunt.cli import _bisect

    found = SimpleNamespace(
        commit=commit, subject="faster", candidates=("a" * 40, "bbbb"), to_json=lambda: {"commit": commit}
    )
    asked = []

    def bisect(bundle, good, **more):
        more.pop("watch")("f" * 40, "cannot_run", "no weights")
        more.pop("tell")("every revision uses the same file")
        asked.append((bundle, good, more))
        return found

    monkeypatch.setattr("crashhunt.corpus.bisect", bisect)
    monkeypatch.setattr(_bisect, "check_trust", lambda *words: asked.append(words))
    bundle = crash()
    opened(bundle, _bisect)
    no_build = {"build": "", "build_limit_s": 3600.0}
    assert run("bisect", "h", "--good", "v1", "--bad", "v2", "--from", "f") == int(commit is None)
    assert asked == [(bundle, "trusted"), (bundle, "v1", {"bad": "v2", "folder": Path("f"), **no_build})]
    said = capsys.readouterr()
    assert said.out == f"ffffffffffff  cannot run: no weights\n{line}\n"
    assert said.err == "crashhunt: every revision uses the same file\n"
    run("bisect", "h", "--good", "v1", "--json", "--build", "make -j4", "--build-timeout", "2m")
    assert asked[3][2] == {"bad": "HEAD", "folder": None, "build": "make -j4", "build_limit_s": 120.0}
    assert capsys.readouterr().out == json.dumps({"commit": commit}) + "\n"
    with pytest.raises(UsageError, match="the following arguments are required: --good"):
        run("bisect", "h")


def test_interrupted_bisect_reports_that_the_commit_is_not_known(opened, monkeypatch, capsys):
    from crashhunt.cli import _bisect

    def bisect(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("crashhunt.corpus.bisect", bisect)
    monkeypatch.setattr(_bisect, "check_trust", lambda *_: None)
    opened(crash(), _bisect)
    with pytest.raises(KeyboardInterrupt):
        run("bisect", "h", "--good", "v1")
    assert capsys.readouterr().out.startswith("Interrupted: the commit is not known yet.")


def test_crash_is_exported_as_a_zip_file_or_as_a_scenario(opened, monkeypatch, capsys, tmp_path):
    from crashhunt.cli import _export

    asked = []
    bundle = crash()

    def write(form):
        def write_it(given, file, *, with_agents):
            asked.append((form, given, file, with_agents))
            for suffix in (file.suffix, ".xodr"):
                file.with_suffix(suffix).write_bytes(b"x" * 10_000)
            return 4

        return write_it

    monkeypatch.setattr("crashhunt.crashes.export_crash", lambda given, file, watch: asked.append(file) or 2_345_678)
    monkeypatch.setattr("crashhunt.formats.write_commonroad", write("commonroad"))
    monkeypatch.setattr("crashhunt.formats.write_openscenario", write("openscenario"))
    opened(bundle, _export)
    monkeypatch.chdir(tmp_path)
    assert run("export", "h", "a.zip", "--json") == 0
    out, err = capsys.readouterr()
    assert json.loads(out) == {"crash": bundle.id, "file": "a.zip", "bytes": 2_345_678}
    assert err == f"{bundle.id} is in a.zip (2.35 MB)\n"
    assert run("export", "h", "a.xml", "--as", "commonroad", "--json") == 0
    out, err = capsys.readouterr()
    assert json.loads(out) == {"crash": bundle.id, "file": "a.xml", "bytes": 10_000, "as": "commonroad", "actors": 4}
    assert run("export", "h", "a.xosc", "--as", "openscenario", "--recorded-agent") == 0
    assert capsys.readouterr().out == f"{bundle.id} is in a.xosc and a.xodr (0.02 MB), for openscenario\n"
    assert asked == [
        Path("a.zip"), ("commonroad", bundle, Path("a.xml"), False), ("openscenario", bundle, Path("a.xosc"), True)
    ]  # fmt: skip


def test_crash_is_described_for_as_long_as_is_asked(opened, monkeypatch, capsys):
    from crashhunt.cli import _show

    asked = []
    story = SimpleNamespace(to_json=lambda: {"steps": 3}, describe=lambda: "it\x1b crashed")
    monkeypatch.setattr("crashhunt.report.Story", lambda bundle, **more: asked.append((bundle, more)) or story)
    bundle = crash()
    opened(bundle, _show)
    assert run("show", "h") == run("show", "h", "--last-seconds", "2", "--braking", "0.1", "--json") == 0
    assert asked == [(bundle, {"last_s": 5.0, "braking": None}), (bundle, {"last_s": 2.0, "braking": 0.1})]
    text, data = capsys.readouterr().out.splitlines()
    assert "\x1b" not in text
    assert data == '{"steps": 3}'


# crashhunt check, guide, trust and logs


def checked(**more):
    usual = {
        "dir": "h", "kind": "hunt", "trials": [1, 2], "crashes": ["000001-collision"], "damaged_trials": [],
        "damaged_crashes": [], "findings": (), "fine": True, "to_json": lambda: {"dir": "h"}, "near_misses": [],
        "minimized": 0, "crash_count": 1,
    }  # fmt: skip
    return SimpleNamespace(**{**usual, **more})


def test_check_names_what_is_intact_damaged_and_lost():
    finding = SimpleNamespace(damaged=True, where="ledger.sqlite", what="cut off", lost="trial 3", fix="salvage it")
    note = SimpleNamespace(damaged=False, where="run.log", what="missing", lost="", fix="")
    assert _check._describe(checked()) == "h: 2 trials and 1 crash are intact"
    assert _check._describe(checked(trials=[1], crash_count=0)) == "h: 1 trial and 0 crashes are intact"
    assert _check._describe(checked(minimized=1)) == "h: 2 trials, 1 crash and 1 minimized crash are intact"
    near = checked(near_misses=["000002-survived", "000003-survived"])
    assert _check._describe(near) == "h: 2 trials, 1 crash and 2 near misses are intact"
    assert _check._describe(checked(kind="crash")) == "h: 1 crash is intact"
    assert _check._describe(checked(kind="crash", crash_count=0)) == "h: 0 crashes are intact"
    alone = checked(kind="crash", crash_count=0, near_misses=["000002-survived"])
    assert _check._describe(alone) == "h: 1 near miss is intact"
    damaged = checked(fine=False, damaged_trials=[3, 4], damaged_crashes=[5], findings=(finding, note))
    assert _check._describe(damaged).splitlines() == [
        "h: 2 trials and 1 crash are intact; damaged: 2 trials, 1 crash",
        "  damaged: ledger.sqlite: cut off",
        "    lost: trial 3",
        "    salvage it",
        "  note: run.log: missing",
    ]
    assert _check._describe(checked(fine=False)).endswith("; damaged: see below")


@pytest.mark.parametrize(("fine", "code"), [((True,), 0), ((True, False), 1), ((False,), 1)])
def test_check_ends_with_1_where_something_is_damaged(monkeypatch, capsys, fine, code):
    monkeypatch.setattr("crashhunt.hunts.check", lambda directory: [checked(fine=one) for one in fine])
    monkeypatch.setattr("crashhunt.hunts.salvage", lambda found, to: {"trials": 7, "crashes": 2, "to": str(to)})
    assert run("check", "h", "--json") == code
    out, err = capsys.readouterr()
    assert json.loads(out) == {"fine": not code, "hunts": [{"dir": "h"}] * len(fine), "salvaged": None}
    assert len(err.splitlines()) == len(fine)
    if len(fine) > 1:
        with pytest.raises(UsageError, match="--salvage takes one hunt, but 2 hunts were found"):
            run("check", "h", "--salvage", "to")
        return
    assert run("check", "h", "--salvage", "to", "--json") == code
    out, err = capsys.readouterr()
    assert json.loads(out)["salvaged"] == {"trials": 7, "crashes": 2, "to": "to"}
    assert "7 trials and 2 crashes are in to; resume the hunt there with crashhunt run" in err


def test_guide_shows_a_page_or_the_pages_with_a_word(capsys):
    assert run("guide") == 0
    listed = capsys.readouterr().out.splitlines()
    assert listed[0] == "crashhunt guide TOPIC shows one of these:"
    assert listed[1] == ""
    assert listed[2].endswith(":")
    columns = {line.index(line.split(maxsplit=1)[1], 3) for line in listed if line.startswith("  ")}
    assert len(columns) == 1
    assert run("guide", "--json") == 0
    topics = json.loads(capsys.readouterr().out)["topics"]
    assert len(topics) == sum(line.startswith("  ") for line in listed)
    topic = topics[0]["topic"]
    assert run("guide", topic, "--json") == 0
    page = json.loads(capsys.readouterr().out)
    assert {**topics[0], "text": page["text"]} == page
    assert run("guide", topic) == 0
    assert page["title"] in capsys.readouterr().out
    assert run("guide", "blake2b") == 0
    assert capsys.readouterr().out.startswith("crashhunt guide TOPIC shows the pages about 'blake2b', the best first:")
    assert run("guide", "blake2b", "--json") == 0
    found = json.loads(capsys.readouterr().out)["topics"]
    assert 0 < len(found) < len(topics)
    assert found[0].keys() == {"topic", "section", "title", "heading"}
    assert run("guide", "my", "crash", "does", "not", "reproduce") == 0
    assert "  troubleshooting  " in capsys.readouterr().out.splitlines()[2]
    with pytest.raises(UsageError):
        run("guide", "no", "page", "has", "xyzzy")
    assert _guide._MAX_COLUMNS == 120


@pytest.fixture
def origins(monkeypatch):
    def origin(number):
        return TrustedOrigin(f"{number}" * 16, path=f"p{number}", runs="code", trusted_at="today")

    monkeypatch.setattr("crashhunt.crashes.list_trusted", lambda: [origin(1), origin(2)])
    monkeypatch.setattr("crashhunt.crashes.remove_trusted", lambda names: [origin(len(names))])
    monkeypatch.setattr("crashhunt.suites.trust_hunt", lambda hunt, place: [origin(len(hunt.name))])
    return origin


def test_trust_lists_adds_and_removes_code(origins, monkeypatch, capsys, tmp_path):
    assert run("trust") == 0
    assert capsys.readouterr().out == "111111111111  today  p1: code\n222222222222  today  p2: code\n"
    assert run("trust", "--json") == 0
    out, err = capsys.readouterr()
    assert [one["path"] for one in json.loads(out)["trusted"]] == ["p1", "p2"]
    assert json.loads(out)["trusted"][0] == {
        "fingerprint": "1" * 16, "path": "p1", "runs": "code", "trusted_at": "today"
    }  # fmt: skip
    assert err.count("\n") == 2
    assert run("trust", "--remove", "a", "--remove", "b", "--json") == 0
    out, err = capsys.readouterr()
    assert [one["path"] for one in json.loads(out)["removed"]] == ["p2"]
    assert err == "no longer trusted: 222222222222  today  p2: code\n"
    for name in ("ab", "abc"):
        (tmp_path / name).mkdir()
    monkeypatch.setattr("crashhunt.results.find_hunts", lambda place: [place])
    assert run("trust", tmp_path / "abc", tmp_path / "ab", tmp_path / "ab") == 0
    assert capsys.readouterr().out == "trusted: 333333333333  today  p3: code\ntrusted: 222222222222  today  p2: code\n"
    monkeypatch.setattr("crashhunt.crashes.list_trusted", list)
    assert run("trust", "--json") == 0
    assert capsys.readouterr() == (
        '{"trusted": []}\n', "You trust no code besides what you made on this machine.\n"
    )  # fmt: skip


def test_what_has_no_code_cannot_be_trusted(origins, monkeypatch, tmp_path):
    def refuse(*_):
        raise HuntDirectoryError("no hunt", fix="x")

    monkeypatch.setattr("crashhunt.results.find_hunts", refuse)
    with pytest.raises(BundleError, match="the folder has no code that could run; give the directory of a hunt"):
        _trust._trust_place(tmp_path)
    with pytest.raises(BundleError, match=r"'.*nowhere' does not exist; .*give a folder or a file"):
        _trust._trust_place(tmp_path / "nowhere")
    place = tmp_path / "hunt" / "crashes" / "000001-collision"
    place.mkdir(parents=True)
    (place / "crash.json").touch()
    (origin,) = _trust._trust_place(place)
    assert origin.path == "p4"  # the hunt of the crash, whose name has four letters


def test_logs_are_of_the_type_and_the_trial_that_are_named(monkeypatch, capsys):
    asked, states = [], ["running", "queued", "done"]
    texts = {"town/0": [[("trial 3", "one\rtwo\r\n\n")], []], ".": [[("run.log", "here")], [("run.log", "more")]]}

    class Reader:
        def __init__(self, hunt, kinds, *, trial):
            asked.append((hunt, kinds, trial))
            self.hunt, self.looks = hunt, iter([*texts[hunt], [], []])

        def fresh(self):
            return next(self.looks)

    monkeypatch.setattr("crashhunt.results.LogReader", Reader)
    monkeypatch.setattr("crashhunt.results.hunt_state", lambda hunt: SimpleNamespace(state=states.pop(0)))
    monkeypatch.setattr("crashhunt.cli._logs.chosen_runs", lambda directory, runs: {run: run for run in runs or ["."]})
    monkeypatch.setattr("crashhunt.cli._logs.time", SimpleNamespace(sleep=asked.append))
    assert run("logs", "s", "--run", "town/0", "--trial", "3", "--type", "run") == 0
    assert asked == [("town/0", ("run",), 3)]
    assert capsys.readouterr() == ("==> town/0: trial 3 <==\none\ntwo\n\n", "")
    asked.clear()
    assert run("logs", "s", "--follow") == 0
    assert asked == [(".", ("run", "error", "state"), None), 0.5, 0.5]
    assert capsys.readouterr().out == "==> run.log <==\nhere\n\n==> run.log <==\nmore\n\n"
    texts["."] = [[]]
    assert run("logs", "s", "--errors-only") == 0
    assert asked[-1] == (".", ("error",), None)
    assert capsys.readouterr() == ("", "there is nothing to show\n")


# crashhunt dashboard and run


def test_dashboard_is_served_as_asked_and_announced(monkeypatch, capsys):
    asked = []

    def serve(paths, *, announce, **options):
        asked.append((paths, options))
        announce(SimpleNamespace(url="http://h:1/", host="h", port=1, token="t"))
        raise KeyboardInterrupt

    monkeypatch.setattr("crashhunt.dashboard.serve", serve)
    assert run("dashboard", "a", "b", "--host", "h", "--port", "1", "--token", "t", "--allow-control") == 0
    assert capsys.readouterr() == ("http://h:1/\nCtrl-C ends the dashboard.\n", "")
    assert run("dashboard", "--json") == 0
    out, err = capsys.readouterr()
    assert json.loads(out) == {"url": "http://h:1/", "host": "h", "port": 1, "token": "t"}
    assert err == "http://h:1/\nCtrl-C ends the dashboard.\n"
    run("dashboard", "--no-browser")
    assert [paths for paths, _ in asked] == [[Path("a"), Path("b")], [Path()], [Path()]]
    assert asked[0][1] == {"host": "h", "port": 1, "token": "t", "browser": True, "allow_control": True}
    assert [options["browser"] for _, options in asked] == [True, False, False]
    assert (asked[1][1]["port"], asked[1][1]["token"], asked[1][1]["allow_control"]) == (8642, "", False)


@pytest.mark.parametrize(
    ("words", "report", "code"),
    [
        ([], {"crashes": ["one"]}, 0), (["--fail-on-crash"], {"crashes": ["one"]}, 1), (["--fail-on-crash"], {}, 0),
        (["--fail-on-crash"], {"copied": "one"}, 1), ([], {"stopped_because": "no_valid_trial"}, 3),
        ([], {"stopped_because": "interrupted", "crashes": ["one"]}, 130), ([], {"unconfirmed": 2}, 130),
        ([], {"rate": SimpleNamespace(verdict="below")}, 0), ([], {"rate": SimpleNamespace(verdict="above")}, 1),
    ],
)  # fmt: skip
def test_run_ends_with_the_code_of_its_report(monkeypatch, capsys, words, report, code):
    usual = {"stopped_because": "all_trials", "crashes": [], "copied": None, "unconfirmed": 0, "rate": None}
    found = named("the report", **usual | report)
    setup = SimpleNamespace(agents={"ego": SimpleNamespace(agent="keep-lane")})
    hunt = SimpleNamespace(settings=setup, scenario=SimpleNamespace(name="toy", notes=()), run=lambda watcher: found)
    monkeypatch.setattr("signal.signal", lambda *_: None)
    monkeypatch.setattr("crashhunt.api.prepare", lambda *words, **options: hunt)
    monkeypatch.setattr("crashhunt.report.describe_hunt", lambda report, **_: "found in [b]:car:h")
    assert run("run", "h", "1", "5", "60", *words, "--json") == code
    assert capsys.readouterr() == ('"the report"\n', "found in [b]:car:h\n")


def test_ctrl_c_after_a_hunt_does_not_say_that_the_hunt_has_not_begun(monkeypatch, capfd):
    setup = SimpleNamespace(agents={"ego": SimpleNamespace(agent="keep-lane")})
    hunt = SimpleNamespace(settings=setup, scenario=SimpleNamespace(name="toy", notes=()), run=lambda watcher: None)
    monkeypatch.setattr("crashhunt.api.prepare", lambda *words, **options: hunt)
    monkeypatch.setattr("crashhunt.report.describe_hunt", lambda report, **_: signal.raise_signal(signal.SIGINT))
    monkeypatch.setattr(importlib.import_module("crashhunt.cli._run"), "_leave", lambda code: None)
    before = signal.getsignal(signal.SIGINT)
    try:
        with pytest.raises(KeyboardInterrupt):
            run("run", "h", "1", "5", "60", "--json")
    finally:
        signal.signal(signal.SIGINT, before)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(("ego", "starts"), [(None, True), ("", True), ("any", True), ("car.3", False)])
def test_long_wait_is_explained_where_traffic_is_surveyed(monkeypatch, capsys, tmp_path, ego, starts):
    module = importlib.import_module("crashhunt.cli._run")
    timers = []

    class Timer:
        def __init__(self, seconds, tell):
            self.seconds, self.tell, self.started = seconds, tell, False
            timers.append(self)

        def start(self):
            self.started = True

    monkeypatch.setattr(module, "threading", SimpleNamespace(Timer=Timer))
    configured = SimpleNamespace(endings=(".sumocfg",), waiting="SUMO simulates the traffic first")
    monkeypatch.setattr("crashhunt.scenario.configurations", lambda: [configured])
    scenario = tmp_path / "town.sumocfg"
    timer = module._start_wait_notice(SimpleNamespace(ego=ego, scenario=scenario))
    assert timers == [timer]
    assert (timer.seconds, timer.started, timer.daemon) == (3.0, starts, True)
    timer.tell()
    assert capsys.readouterr().err == ""  # there is no such file
    scenario.touch()
    timer.tell()
    assert capsys.readouterr().err == "SUMO simulates the traffic first\n"


def test_one_crash_is_judged_and_not_saved_in_an_exported_file(opened, monkeypatch, capsys):
    judged = []
    monkeypatch.setattr(
        _judge, "_judge_one", lambda options, bundle, stops, trusted, *, write: judged.append(
            (bundle, [*stops], trusted, write)
        ) or {"verdict": "avoidable"}
    )  # fmt: skip
    bundle = crash()
    calls = opened(bundle, _judge)
    assert run("judge", "h", "--crash", "3", "--json") == 0
    assert judged == [(bundle, [], "trusted", False)]
    assert calls[0] == (Path("h"), "3")
    assert calls[1][:2] == (bundle, "archive")
    assert json.loads(capsys.readouterr().out) == {"judged": [{"verdict": "avoidable"}]}
