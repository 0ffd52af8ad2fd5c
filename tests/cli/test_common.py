"""What the commands share: the parser's errors, options, trust and progress."""

from __future__ import annotations

import argparse
import io
import os
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from command_line import parser as whole_parser

from crashhunt.base.signals import stop_requests
from crashhunt.cli import _common, _trust
from crashhunt.cli._common import Parser
from crashhunt.errors import HuntDirectoryError, UntrustedError, UsageError


@pytest.fixture
def parser():
    made = Parser(prog="crashhunt run")
    made.add_argument("place", metavar="DIR")
    made.add_argument("--scenario")
    made.add_argument("--seed", type=_common.integer)
    made.add_argument("--share", type=_common.number)
    made.add_argument("--code", choices=("current", "log"))
    made.add_argument("--json", action="store_true")
    return made


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["h", "--scenari", "x", "--seeed", "3"],
            "there is no option '--seeed'; did you mean '--seed'? see crashhunt run",
        ),
        (["h", "--code", "logs"], "--code 'logs' is none of its choices; did you mean 'log'? give one of current, log"),
        (["h", "--json=3"], "--json takes no value, but '3' is given; write --json alone"),
        (["h", "--seed", "3.5"], "argument --seed: '3.5' is not a whole number; see crashhunt run --help"),
        (["h", "--share", "x"], "argument --share: 'x' is not a number; see crashhunt run --help"),
        (["h", "--seed", "-3x"], "--seed has no value; give one, as --seed=VALUE if it begins with a hyphen"),
        ([], "the following arguments are required: DIR; see crashhunt run --help"),
    ],
)
def test_wrong_words_are_refused_in_one_line(parser, words, message):
    with pytest.raises(UsageError) as caught:
        parser.parse_args(words)
    assert str(caught.value).startswith(message)


def test_right_words_are_read(parser):
    found = parser.parse_args(["--scen", "x", "--seed=3", "--share", "0.5", "--code", "log", "--", "--seeed"])
    assert vars(found) == {
        "place": "--seeed", "scenario": "x", "seed": 3, "share": 0.5, "code": "log", "json": False,
    }  # fmt: skip


def test_unknown_command_is_named_and_its_own_options_are_left_to_it():
    made = Parser(prog="crashhunt")
    verbs = made.add_subparsers(metavar="COMMAND", required=True)
    verbs.add_parser("show").add_argument("--all", action="store_true")
    verbs.add_parser("run")
    assert made.parse_args(["show", "--all"]).all is True
    with pytest.raises(UsageError, match=r"^too many arguments: h g; see crashhunt show --help$"):
        made.parse_args(["show", "h", "--all", "g"])
    with pytest.raises(UsageError, match=r"^there is no option '-x'; see crashhunt show --help; if it is a file or "):
        made.parse_args(["show", "-x"])
    with pytest.raises(UsageError, match="there is no command 'shoe'; did you mean 'show'"):
        made.parse_args(["shoe"])


def test_name_that_begins_with_a_hyphen_is_no_missing_argument():
    """argparse reports only that MAX_STEPS is missing."""
    with pytest.raises(
        UsageError, match=r"^there is no option '-dash'; see .*; if it is a file or folder, write ./-dash$"
    ):
        whole_parser().parse_args(["run", "-dash", "1", "1", "1"])
    with pytest.raises(
        UsageError, match=r"^--agent has no value; give one, as --agent=VALUE if it begins with a hyphen"
    ):
        whole_parser().parse_args(["run", "h", "1", "1", "1", "--agent", "-dash"])
    assert whole_parser().parse_args(["rate", "h", "--bar=-1"]).bar == "-1"


def test_help_that_cannot_be_written_is_an_error(parser):
    class Full(io.StringIO):
        def write(self, text):
            raise OSError

    with pytest.raises(OSError):  # noqa: PT011 - nothing else raises it
        parser.print_help(Full())
    parser._print_message("", Full())


@pytest.mark.parametrize(
    ("words", "named", "found"),
    [
        (["a=1", "b=x=y"], True, {"a": "1", "b": "x=y"}),
        (["a=1", "driver"], False, {"a": "1", "": "driver"}),
        (["a"], True, "--arg 'a' has no name; write --arg NAME=VALUE"),
        (["=a"], False, "--arg '=a' has no name; write --arg NAME=VALUE"),
        (["a=1", "a=2"], True, "--arg 'a=2': 'a' is given twice; give it once"),
        (["x", "y"], False, "--arg 'y': an agent without ID= is given twice; give it once"),
    ],
)
def test_pairs_are_divided_at_the_first_sign(words, named, found):
    if isinstance(found, dict):
        assert _common.pairs(words, "--arg", named=named) == found
        return
    with pytest.raises(UsageError) as caught:
        _common.pairs(words, "--arg", named=named)
    assert str(caught.value) == found


def test_text_goes_to_stderr_if_json_is_printed(capsys):
    _common.CommandOptions(json=False).answer("plain", {})
    _common.CommandOptions(json=True).answer("beside", {"answer": 1})
    assert capsys.readouterr() == ('plain\n{"answer": 1}\n', "beside\n")


def test_runs_of_a_suite_are_chosen_by_hunt_or_number(tmp_path, monkeypatch):
    places = [tmp_path / name for name in ("town/0", "town/1", "road/0")]
    monkeypatch.setattr("crashhunt.results.find_searches", lambda directory: places)
    names = ["town/0", "town/1", "road/0"]
    for runs, expected in (
        ([], names), (["town"], names[:2]), (["road/0"], names[2:]), (["road", "town/1"], names[1:]),
    ):  # fmt: skip
        assert list(_common.chosen_runs(tmp_path, runs).values()) == expected
    assert _common.chosen_runs(tmp_path, ["road"]) == {tmp_path / "road/0": "road/0"}
    with pytest.raises(UsageError, match="--run: there is no run 'town/2'; did you mean 'town/"):
        _common.chosen_runs(tmp_path, ["road", "town/2"])
    places[:] = [tmp_path]
    with pytest.raises(UsageError, match=r"no run 'town'; omit --run, because .+ is a single hunt"):
        _common.chosen_runs(tmp_path, ["town"])


def asked(monkeypatch, answer, *, terminal=True, stdin=True):
    class Terminal(io.StringIO):
        def isatty(self):
            return terminal

    monkeypatch.setattr(sys, "stdin", Terminal(answer) if stdin else None)
    monkeypatch.setattr(sys, "stderr", Terminal())
    refusal = UntrustedError("not trusted", fix="trust it", where="place")
    return _trust.ask_to_trust(refusal, as_json=False), sys.stderr.getvalue()


def test_trust_is_asked_for_at_a_terminal_only(monkeypatch):
    question = "place: not trusted\nTrust this code from now on and run it? [y/N] "
    for answer, found in (("y\n", True), (" YES \n", True), ("n\n", False), ("\n", False), ("", False)):
        assert asked(monkeypatch, answer) == (found, question)
    assert asked(monkeypatch, "y\n", terminal=False) == (False, "")
    assert asked(monkeypatch, "y\n", stdin=False) == (False, "")
    asked(monkeypatch, "y\n")
    assert _trust.ask_to_trust(UntrustedError("not trusted", fix="trust it"), as_json=True) is False


def test_interrupt_at_the_question_for_trust_is_not_only_collected(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

        def readline(self):
            os.kill(os.getpid(), signal.SIGINT)
            return "y\n"

    monkeypatch.setattr(sys, "stdin", Terminal())
    monkeypatch.setattr(sys, "stderr", Terminal())
    with stop_requests() as stops:
        with pytest.raises(KeyboardInterrupt):
            _trust.ask_to_trust(UntrustedError("not trusted", fix="trust it"), as_json=False)
        os.kill(os.getpid(), signal.SIGINT)
        assert stops == [signal.SIGINT]


@pytest.mark.parametrize("faults", [[], ["damaged"]])
@pytest.mark.parametrize("answer", [True, False])
def test_code_runs_after_trust_and_not_before(monkeypatch, faults, answer):
    calls, trusted, made = [], [], []

    def run(is_trusted):
        calls.append(is_trusted)
        if not is_trusted:
            raise UntrustedError("not trusted", fix="trust it")
        return "done"

    snapshot = SimpleNamespace(faults=lambda: faults)
    monkeypatch.setattr("crashhunt.crashes.snapshot_of", lambda bundle: snapshot)
    monkeypatch.setattr("crashhunt.crashes.trust_snapshot", lambda *words: trusted.append(words))
    monkeypatch.setattr(
        "crashhunt.crashes.refuse_untrusted",
        lambda bundle, **more: made.append(more) or UntrustedError("refused", fix="trust it"),
    )
    monkeypatch.setattr(_trust, "ask_to_trust", lambda refusal, as_json: answer)
    options = argparse.Namespace(trust=False, json=False, directory=Path("h"))
    archive = SimpleNamespace(made_here=False, made_by="x", made_at="y")
    if answer and not faults:
        assert _trust.run_trusted(run, "bundle", archive, options) == "done"
        assert (calls, trusted) == ([None, True], [(snapshot, Path("h"))])
    else:
        with pytest.raises(UntrustedError, match="refused"):
            _trust.run_trusted(run, "bundle", archive, options, path=Path("p"))
        assert (calls, trusted) == ([None], [])
    assert made == [{"where": "h" if answer and not faults else "p", "made_by": "x on y"}]
    calls.clear()
    options.trust = True
    assert _trust.run_trusted(run, "bundle", None, options) == "done"
    options.trust, archive.made_here = False, True
    assert _trust.run_trusted(run, "bundle", archive, options) == "done"
    assert calls == [True, True]


def test_code_of_a_stranger_is_refused_where_it_is_checked(monkeypatch):
    known = []
    monkeypatch.setattr("crashhunt.crashes.is_bundle_trusted", lambda bundle: bundle in known)
    monkeypatch.setattr("crashhunt.crashes.refuse_untrusted", lambda bundle: UntrustedError("refused", fix="x"))
    with pytest.raises(UntrustedError):
        _trust.check_trust("bundle", None)
    _trust.check_trust("bundle", True)
    known.append("bundle")
    _trust.check_trust("bundle", None)


def test_progress_is_shown_on_a_terminal_if_no_json_is_printed(monkeypatch):
    from rich.console import Console

    for as_json, terminal, shown in ((False, True, True), (True, True, False), (False, False, False)):
        monkeypatch.setattr(Console, "is_terminal", terminal)
        with _common.shown_progress("writing", as_json=as_json) as watch:
            assert (watch is not None) == shown
            if watch is not None:
                watch(1, 2)


def test_summary_is_added_to_its_file_and_annotations_are_printed_if_asked_for(tmp_path, capsys):
    place = tmp_path / "summary.md"
    for options in (
        _common.CommandOptions(summary=place, annotate=True, json=False),
        _common.CommandOptions(summary=place, annotate=False, json=False),
        _common.CommandOptions(summary=None, annotate=True, json=True),
    ):
        _common.tell(options, "# yes", ["::one", "::two"])
    assert place.read_text() == "# yes\n# yes\n"
    assert capsys.readouterr() == ("::one\n::two\n", "::one\n::two\n")
    with pytest.raises(HuntDirectoryError, match="cannot be written"):
        _common.tell(_common.CommandOptions(summary=tmp_path, annotate=False, json=False), "", [])


def hunt_parser(names=()):
    made = Parser(prog="crashhunt run")
    groups = _Groups(made)
    _common.add_options(groups, names)
    return made


class _Groups(dict):
    def __init__(self, parser):
        self.parser = parser

    def __missing__(self, name):
        self[name] = self.parser.add_argument_group(name)
        return self[name]


def test_options_of_a_hunt_are_read_as_python_has_them():
    given = hunt_parser().parse_args(
        ["--arg", "speed=3", "--arg", "ego.mode=x", "--agent", "idm", "--seed", "7", "--crash-on", "hang, ,collision"]
    )
    found = _common.chosen_options(given)
    assert found["arguments"] == {"speed": "3", "ego.mode": "x"}
    assert found["seed"] == 7
    assert found["crash_on"] == ("hang", "collision")
    assert found["accelerate"] is True
    assert found["agents"] == {"": "idm"}
    off = hunt_parser(("accelerate", "seed")).parse_args(["--no-accelerate"])
    assert _common.chosen_options(off, ("accelerate", "seed")) == {"accelerate": False, "seed": None}


@pytest.mark.parametrize(
    ("words", "counted"),
    [
        (("whatif", "h", "--leave-out", "a", "--leave-out", "b,c"), {"leave_out": "a,b,c"}),
        (("replay", "h", "--print", "x", "--print", "y,speed", "--print", "x"), {"fields": "x,y,speed,x"}),
        (("trials", "h", "--outcome", "hang", "--outcome", "survived"), {"outcome": "hang,survived"}),
        (("logs", "h", "--run", "a", "--run", "b/0"), {"run": ["a", "b/0"]}),
        (("run", "h", "1", "1", "1", "--disturb", "brake=1", "--disturb", "stop=1"), {"disturb": "brake=1,stop=1"}),
        (("run", "h", "1", "1", "1", "--crash-on", "hang", "--crash-on", "collision"), {"crash_on": "hang,collision"}),
        (("run", "h", "1", "1", "1", "--seed", "1", "--seed", "2"), {"seed": 2}),
        (("rate", "h", "--by", "fault", "--by", "fault"), {"by": "fault"}),
    ],
)
def test_all_values_of_an_option_with_a_list_count(words, counted):
    given = vars(whole_parser().parse_args(words))
    assert {name: given[name] for name in counted} == counted


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("rate", "h", "--by", "fault", "--by", "speed:3"), "--by is given twice: fault and speed:3; give it once"),
        (("logs", "h", "--trial", "0", "--trial", "3"), "--trial is given twice: 0 and 3; give it once"),
        (("logs", "h", "--type", "run", "--type", "error"), "--type is given twice: run and error; give it once"),
        (("show", "h", "--crash", "1", "--crash", "4"), "--crash is given twice: 1 and 4; give it once"),
        (("whatif", "h", "--agent", "a=m:A", "--agent", "b=m:B"), "--agent is given twice: a=m:A and b=m:B; give it"),
    ],
)
def test_option_of_which_a_user_expects_both_values_to_count_is_refused_twice(words, message):
    with pytest.raises(UsageError) as caught:
        whole_parser().parse_args(words)
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize("text", ["", " ", "3,", ",3", "3,,4"])
@pytest.mark.parametrize(
    "words", [("replay", "h"), ("show", "h"), ("note", "h", "text"), ("corpus", "add", "h", "--to", "c")]
)
def test_empty_id_of_a_crash_is_refused(words, text):
    with pytest.raises(UsageError) as caught:
        whole_parser().parse_args([*words, "--crash", text])
    assert str(caught.value).startswith(f"--crash {text!r} has an empty id; give the id of a crash or the number of")


def test_options_of_the_machine_count_only_where_they_are_given():
    made = Parser(prog="crashhunt suite run")
    _common.add_options_of_machine(made)
    assert _common.chosen_of_machine(made.parse_args([])) == {}
    found = _common.chosen_of_machine(made.parse_args(["--executor", "fresh"]))
    assert found == {"executor": "fresh"}
    assert "as in each hunt" in made.format_help()
