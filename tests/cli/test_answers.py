"""What commands print and with which code they end, with the work itself replaced."""

from __future__ import annotations

import io
import json
import sys
from argparse import Namespace
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
from command_line import run

from crashhunt import cli
from crashhunt.cli import _corpus, _gate, _judge, _rate, _suite
from crashhunt.corpus import CaseReport
from crashhunt.errors import UntrustedError, UsageError
from crashhunt.results import HuntState
from crashhunt.suites import GateProgress


@pytest.mark.parametrize(
    ("verdicts", "code"),
    [(["below"], 0), (["below", "above"], 1), (["undecided", "above"], 1), (["below", "undecided"], 3), ([], 3)],
)
def test_rate_ends_with_its_worst_verdict(verdicts, code):
    assert _rate.exit_code_of(verdicts) == code


@pytest.mark.parametrize(
    ("words", "asked", "code"),
    [
        ([], {"per": None, "bar": None, "by": "", "confidence": 95.0}, 0),
        (["--by", "kind"], {"per": "trial", "bar": None, "by": "kind", "confidence": 95.0}, 0),
        (["--bar", "2/hour"], {"per": "hour", "bar": 2.0, "by": "", "confidence": 95.0}, 1),
        (["--bar", "2/hour", "--per", "hour"], {"per": "hour", "bar": 2.0, "by": "", "confidence": 95.0}, 1),
        (["--per", "trial", "--confidence", "80"], {"per": "trial", "bar": None, "by": "", "confidence": 80.0}, 0),
    ],
)
def test_rate_is_measured_as_asked(monkeypatch, capsys, words, asked, code):
    calls = []

    def measure(hunt, **options):
        calls.append((hunt, options))
        return [SimpleNamespace(verdict="above", to_json=lambda: {"hunt": hunt})]

    monkeypatch.setattr("crashhunt.statistics.measure_rates", measure)
    monkeypatch.setattr("crashhunt.results.find_searches", lambda directory: [f"{directory}/0", f"{directory}/1"])
    monkeypatch.setattr("crashhunt.report.describe_rates", lambda rates: f"{len(rates)} rates")
    for json_words in ([], ["--json"]):
        calls.clear()
        assert run("rate", "a", "b", "a", *words, *json_words) == code
        assert calls == [(hunt, asked) for hunt in ("a/0", "a/1", "b/0", "b/1")]
    out, err = capsys.readouterr()
    plain, data = out.splitlines()
    assert plain == err.strip() == "4 rates"
    assert json.loads(data) == {"rates": [{"hunt": hunt} for hunt in ("a/0", "a/1", "b/0", "b/1")]}


def test_rate_refuses_two_units():
    with pytest.raises(UsageError, match="--per trial contradicts --bar 2/hour; give --per hour, or no --per"):
        run("rate", "a", "--bar", "2/hour", "--per", "trial")
    with pytest.raises(UsageError, match="--bar is 2"):
        run("rate", "a", "--bar", "2")


@pytest.mark.parametrize(
    ("verdict", "interrupted", "code"),
    [
        ("better", False, 0), ("no difference", False, 0), ("worse", False, 1), ("undecided", False, 3),
        ("undecided", True, 130), ("worse", True, 1), ("better", True, 0),
    ],
)  # fmt: skip
def test_gate_ends_with_its_verdict(verdict, interrupted, code):
    assert _gate._exit_code(SimpleNamespace(verdict=verdict, is_interrupted=interrupted)) == code


def test_margin_is_a_share_or_percent():
    assert _gate._margin("0.02") == 0.02
    assert _gate._margin("2%") == 0.02
    with pytest.raises(UsageError, match="--margin 'two%' is not a share"):
        _gate._margin("two%")


def test_gate_has_a_line_each_30_s_without_terminal(monkeypatch, capsys):
    clock = [0.0]
    monkeypatch.setattr(_gate.time, "monotonic", lambda: clock[0])
    progress = GateProgress(name="town", done=1200, most=4000, only_base=3, only_head=5, evidence=1.234567)
    line = "town: 1,200 of 4,000 pairs; only BASE crashes in 3, only HEAD in 5; evidence 1.23\n"
    with _gate._watched(as_json=False) as watch:
        for second, lines in ((29.0, 0), (30.0, 1), (59.0, 1), (60.0, 2)):
            clock[0] = second
            watch(progress)
            assert capsys.readouterr().err == (line if second in (30.0, 60.0) else ""), lines


def test_options_on_a_command_line_are_known_with_and_without_values():
    assert _gate._flags(["gate", "--seed=3", "--json", "x=y"]) == {"gate", "--seed", "--json", "x"}


def report(name, expected, got, **more):
    return CaseReport(path=Path(name), expected=expected, got=got, was="was", now="now", note="", **more)


def test_corpus_summary_counts_what_is_not_as_expected():
    reports = [
        report("a", "fixed", "still"), report("b", "still", "still"), report("c", "still", "fixed"),
        report("d", "fixed", "fixed"), report("e", "still", "cannot_run"),
    ]  # fmt: skip
    lines = _corpus._summary_of(reports, 6).splitlines()
    assert lines[-1].startswith("6 cases: 2 still crash, 2 fixed, 1 cannot run; interrupted after 5")
    wrong = sum(not one.ok for one in reports)
    assert lines[-1].endswith(f"; {wrong} not as expected")
    assert any(line.startswith("b: ") for line in lines)
    assert any(line.startswith("c: fixed; to be warned if it crashes again, set expect = 'fixed'") for line in lines)
    assert not any(line.startswith("d: ") for line in lines)
    assert _corpus._summary_of(reports[3:4], 1) == "1 case: 1 fixed"
    assert _corpus._summary_of([], 1) == "1 case: none has ended; interrupted after 0"


@pytest.mark.parametrize(
    ("reports", "code"),
    [
        ([report("a", "fixed", "fixed"), report("b", "still", "still")], 0),
        ([report("a", "fixed", "still"), report("b", "still", "still")], 1),
        ([report("a", "fixed", "fixed")], 130),
    ],
)
def test_corpus_run_ends_with_1_where_a_case_is_not_as_expected(monkeypatch, capsys, reports, code):
    asked = []
    monkeypatch.setattr("crashhunt.corpus.find_cases", lambda places: [Path("a"), Path("b")])
    monkeypatch.setattr("crashhunt.corpus.untrusted_case", lambda path: None)
    monkeypatch.setattr("crashhunt.corpus.run_cases", lambda *words, **more: asked.append((words, more)) or reports)
    assert run("corpus", "run", "corpus", "--parallel", "3", "--json") == code
    ((words, more),) = asked
    assert words == ([Path("a"), Path("b")],)
    assert (more["parallel"], more["trusted"], more["stopped"]()) == (3, True, False)
    assert len(json.loads(capsys.readouterr().out)["cases"]) == len(reports)
    with pytest.raises(UsageError, match="--parallel is -1; give at least 0"):
        run("corpus", "run", "corpus", "--parallel", "-1")


def test_size_and_log_of_an_added_case_are_named():
    for log, said in (("whole", ""), ("compact", ", with a compact log"), ("", ", without a log")):
        assert _corpus._added("c/x", 20 * 1024, log=log, new=True) == f"c/x is new (20 KiB{said})"
    assert _corpus._added("c/x", 1024, log="whole", new=False) == "c/x was there already (1 KiB)"
    assert (_corpus._note(""), _corpus._note("n")) == ("", ", note 'n'")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--runs", "0"], "--runs is 0; give at least 1"),
        (["--why", "-1"], "--why is -1; give at least 0"),
        (["--reference", "-1"], "--reference is -1; give at least 0"),
        (["--parallel", "-1"], "--parallel is -1; give at least 0"),
        (["--all", "--crash", "3"], "--all and --crash 3 contradict each other"),
    ],
)
def test_judge_refuses_what_is_out_of_range(words, message):
    with pytest.raises(UsageError) as caught:
        run("judge", "h", *words)
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize("stopped", [False, True])
def test_judge_analyses_each_crash_once(monkeypatch, capsys, stopped):
    judged, checked, stops = [], [], [1] if stopped else []

    @contextmanager
    def requests():
        yield stops

    monkeypatch.setattr("crashhunt.base.signals.stop_requests", requests)
    monkeypatch.setattr(_judge, "_unjudged", lambda options: ["a", "b"])
    monkeypatch.setattr(_judge, "run_trusted", lambda run, bundle, *_: checked.append(bundle))
    monkeypatch.setattr(
        _judge, "_judge_one", lambda options, bundle, *words, write: judged.append((bundle, write)) or {"crash": bundle}
    )
    assert run("judge", "h", "--all", "--json") == (130 if stopped else 0)
    assert checked == ["a", "b"]
    assert judged == ([] if stopped else [("a", True), ("b", True)])
    assert json.loads(capsys.readouterr().out) == {"judged": [{"crash": bundle} for bundle, _ in judged]}


def test_states_of_a_suite_end_it_with_1_after_an_error(capsys):
    good, bad = HuntState(dir="g", state="crashed"), HuntState(dir="h", state="error", detail="no map")
    stopped, refused = HuntState(dir="i", state="interrupted"), HuntState(dir="k", state="interrupted", detail="full")
    assert _suite._print_states([good, stopped], Path("s"), as_json=False) == 0
    assert "could not run" not in capsys.readouterr().out
    assert _suite._print_states([good, bad], Path("s"), as_json=True, more={"replaced": ["old"]}) == 1
    out, err = capsys.readouterr()
    data = json.loads(out)
    assert [one["dir"] for one in data["hunts"]] == ["g", "h"]
    assert data["replaced"] == ["old"]
    assert "1 hunt could not run; see crashhunt logs s --errors-only, then crashhunt rerun s" in err
    assert _suite._print_states([bad, refused], Path("s"), as_json=False) == 1
    assert "2 hunts could not run" in capsys.readouterr().out


def test_change_of_a_state_has_a_line(capsys):
    watch, finish = _suite.states_watcher(as_json=False)
    for first, second in (("queued", "running"), ("running", "running"), ("crashed", "running"), ("crashed", "error")):
        watch([HuntState(dir="a", state=first, crashes=2), HuntState(dir="b", state=second)])
    finish()
    assert capsys.readouterr().out.splitlines() == ["b: running", "a: running", "a: finished, 2 crashes", "b: error"]


def test_each_hunt_of_a_suite_is_asked_for_once(monkeypatch):
    refusals = ["a", "b"]
    trusted, answers = [], {"a": True, "b": True}

    def suite(is_trusted):
        left = [name for name in refusals if name not in trusted]
        if left and not is_trusted:
            raise UntrustedError("no", fix="x", where=left[0])
        return "done"

    monkeypatch.setattr("crashhunt.suites.trust_hunt", lambda hunt, place: trusted.append(str(place)))
    monkeypatch.setattr(_suite, "ask_to_trust", lambda refusal, as_json: answers[refusal.where])
    options = Namespace(trust=False, json=False)
    assert _suite.run_with_trust(suite, options) == "done"
    assert trusted == ["a", "b"]
    trusted.clear()
    answers["b"] = False
    with pytest.raises(UntrustedError):
        _suite.run_with_trust(suite, options)
    assert trusted == ["a"]
    assert _suite.run_with_trust(suite, Namespace(trust=True, json=False)) == "done"
    monkeypatch.setattr("crashhunt.suites.trust_hunt", lambda hunt, place: None)  # which changes nothing
    answers["b"] = True
    with pytest.raises(UntrustedError):
        _suite.run_with_trust(suite, options)


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["run", "--rare", "h", "splitting"], ["run", "--rare", "h", "splitting"]),
        (["init", "--bbox", "-1.5,2", "x"], ["init", "--bbox=-1.5,2", "x"]),
        (["init", "--bbox", "1.5,2", "x"], ["init", "--bbox", "1.5,2", "x"]),
        (["init", "--bbox", "-x"], ["init", "--bbox", "-x"]),
        (["init", "--bbox"], ["init", "--bbox"]),
        (["scenarios", "--json"], ["list", "scenarios", "--json"]),
        (["trials", "agents"], ["trials", "agents"]),
    ],
)
def test_words_are_spelled_out_for_argparse(words, found):
    assert cli._spell_out(words) == found


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (None, 0, ""),
        (UsageError("x is 3", fix="give 2"), 2, "crashhunt: x is 3; give 2\n"),
        (UsageError("is full", fix="free it", where="my\nhunt"), 2, "crashhunt: $'my\\x0ahunt': is full; free it\n"),
        (KeyboardInterrupt(), 130, ""),
        (ValueError("odd"), 2, "crashhunt: "),
        (OSError(28, "No space left on device", "file"), 2, "crashhunt: "),
    ],
)
def test_end_of_the_command_line_has_one_line_and_a_code(monkeypatch, capsys, error, code, message):
    def fail(options, words):
        if error is not None:
            raise error
        return 0

    monkeypatch.delenv("CRASHHUNT_TRACEBACK", raising=False)
    parser = SimpleNamespace(parse_args=lambda words: Namespace(command=fail))
    monkeypatch.setattr(cli, "make_parser", lambda: parser)
    monkeypatch.setattr(cli, "complete", lambda parser: None)
    monkeypatch.setattr(cli, "remove_leftovers", lambda: None)
    for words in (["x"], ["x", "--json"]):
        with pytest.raises(SystemExit) as left:
            cli.main(words)
        out, err = capsys.readouterr()
        assert left.value.code == code
        assert err.startswith(message)
        assert err.count("\n") == bool(message)
        assert bool(out) == (bool(message) and "--json" in words)
        if out:
            assert json.loads(out)


def test_letter_that_the_output_does_not_know_is_escaped(monkeypatch):
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding="ascii"))
    parser = SimpleNamespace(parse_args=lambda words: Namespace(command=lambda options, words: print("8 m/s²") or 0))
    monkeypatch.setattr(cli, "make_parser", lambda: parser)
    monkeypatch.setattr(cli, "complete", lambda parser: None)
    monkeypatch.setattr(cli, "remove_leftovers", lambda: None)
    with pytest.raises(SystemExit) as left:
        cli.main(["x"])
    assert (left.value.code, written.getvalue()) == (0, b"8 m/s\\xb2\n")


def test_removed_current_directory_is_refused(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "gone"
    folder.mkdir()
    monkeypatch.chdir(folder)
    folder.rmdir()
    with pytest.raises(SystemExit) as left:
        cli.main(["status", str(tmp_path)])
    assert left.value.code == 2
    said = (
        "crashhunt: the current directory cannot be used: No such file or directory; change to an existing directory\n"
    )
    assert capsys.readouterr().err == said


def test_argument_that_is_no_text_is_named():
    with pytest.raises(UsageError, match=r"the argument 'a\\udcff' is not valid UTF-8"):
        cli._check_names(["b", "a\udcff"])


def test_help_lists_every_command_once(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    text = cli.make_parser().format_help()
    for name in ("run", "list", "completion", "trust"):
        assert len([line for line in text.splitlines() if line.startswith(f"  {name} ") or line == f"  {name}"]) == 1
    assert max(map(len, text.partition("exit codes")[0].splitlines())) <= 120
    assert cli._listed("run", "a b") == "run         a b"
    long = cli._listed("disturbances", "or " * 60).splitlines()
    assert long[0] == "disturbances"
    assert all(line.startswith(" " * 12 + "or") and len(line) <= 76 for line in long[1:])


def test_closed_standard_streams_are_opened(monkeypatch):
    for name in ("stdin", "stdout", "stderr"):
        monkeypatch.setattr(sys, name, None)
    cli._open_standard_streams()
    opened = [getattr(sys, name) for name in ("stdin", "stdout", "stderr")]
    assert [stream.name for stream in opened] == ["/dev/null"] * 3
    assert [stream.mode for stream in opened] == ["r", "w", "w"]
    for stream in opened:
        stream.close()


def test_split_lists_both_parts_or_the_folders_of_one(monkeypatch, capsys):
    def crash(name, seed):
        return SimpleNamespace(name=f"h/{name}", seed=seed, bundle=SimpleNamespace(path=Path("h") / name))

    one, two, three = (crash(name, number) for number, name in enumerate("abc"))
    found = SimpleNamespace(
        training=(one, two), held_out=(three,), crashes=(one, two, three), faults=4, to_json=lambda: {"test": 0.5}
    )
    asked = []
    monkeypatch.setattr("crashhunt.training.split_crashes", lambda *words: asked.append(words) or found)
    assert run("split", "h", "--test", "0.3") == 0
    assert capsys.readouterr().out.splitlines() == [
        "3 crashes: 2 to train on, 1 held out", "training  h/a  seed 0", "training  h/b  seed 1",
        "test      h/c  seed 2", "omitted: 4 software faults",
    ]  # fmt: skip
    assert run("split", "h", "--part", "training") == run("split", "h", "--part", "test") == 0
    assert capsys.readouterr().out.splitlines() == ["h/a", "h/b", "h/c"]
    found.held_out = ()
    assert run("split", "h", "--part", "test", "--json") == 0
    assert capsys.readouterr() == ('{"test": 0.5}\n', "")
    assert asked[0] == ([Path("h")], 0.3)


def test_table_of_trials_goes_to_its_file_or_to_the_output(monkeypatch, capsys, tmp_path):
    asked = []

    def write(hunt, file, form, *, outcomes):
        asked.append((hunt, form, outcomes))
        file.write("number\n")
        return 7

    monkeypatch.setattr("crashhunt.results.HuntResults", lambda directory: directory)
    monkeypatch.setattr("crashhunt.results.write_text", write)
    monkeypatch.setattr("crashhunt.results.write_parquet", lambda hunt, out, outcomes: 8)
    assert run("trials", "h", "--outcome", "hang,collision", "--format", "json") == 0
    assert run("trials", "h", "--out", str(tmp_path / "t.csv")) == 0
    assert run("trials", "h", "--out", "t.parquet", "--format", "parquet") == 0
    assert asked == [(Path("h"), "json", ["hang", "collision"]), (Path("h"), "csv", [])]
    assert (tmp_path / "t.csv").read_text() == "number\n"
    assert capsys.readouterr() == ("number\n", f"{tmp_path / 't.csv'} has 7 trials\nt.parquet has 8 trials\n")
    run("trials", "h", "--out", "my\ntable", "--format", "parquet")
    assert capsys.readouterr().err == "$'my\\x0atable' has 8 trials\n"
    with pytest.raises(UsageError, match="--format parquet cannot be printed on a terminal; give --out FILE"):
        run("trials", "h", "--format", "parquet")
    with pytest.raises(UsageError, match="--outcome: there is no outcome 'hangs'; did you mean 'hang'"):
        run("trials", "nowhere", "--outcome", "hangs")
