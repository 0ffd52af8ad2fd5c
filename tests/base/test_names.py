"""What somebody is told who wrote a name that there is not: on the command line, in a call, in a file."""

from __future__ import annotations

import os
import pickle
import sys
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

import crashhunt
from crashhunt.base.text import any_of, did_you_mean, listed, near_path, one_of
from crashhunt.cli import main
from crashhunt.crashes import Bundle, find_bundle
from crashhunt.errors import BundleError, CallError, CrashhuntError, PluginError, UsageError
from crashhunt.plans import Request, plan
from crashhunt.samplers import NamedSampler
from crashhunt.trial import Outcome, TrialResult, TrialSpec

if TYPE_CHECKING:
    from pathlib import Path


def test_one_is_meant():
    assert did_you_mean("Keep_Lane", ["idm", "keep-lane"]) == "did you mean 'keep-lane'?"
    assert did_you_mean("zzz", ["idm", "keep-lane"]) == ""
    assert one_of("rando", ["grid", "random"]) == "did you mean 'random'? give one of grid, random"
    assert one_of("rando", ["random"]) == "give random"  # once
    assert one_of("eg", ["ego"], give="it has") == "did you mean 'ego'?"
    assert one_of("x", ["ego"], give="it has") == "it has ego"
    assert one_of("x", [], give="it takes", none="nothing") == "it takes nothing"
    assert any_of(["a", "b", "c"]) == "a, b or c"
    assert any_of(["a"]) == "a"
    assert listed(map(str, range(1000))).endswith("18, 19, … (1000 in all)")


def test_a_neighbour_is_meant(tmp_path):
    for name in ("before", "after"):
        (tmp_path / name).mkdir()
    (tmp_path / "crash.zip").touch()
    assert near_path(tmp_path / "befor") == f"did you mean {str(tmp_path / 'before')!r}? "
    assert near_path(tmp_path / "crash.zp", ".zip") == f"did you mean {str(tmp_path / 'crash.zip')!r}? "
    assert near_path(tmp_path / "gone" / "befor") == ""
    assert near_path(tmp_path / "befor", with_file=("hunt.toml",)) == ""
    (tmp_path / "befora" / "0").mkdir(parents=True)
    (tmp_path / "befora" / "0" / "hunt.toml").touch()
    assert near_path(tmp_path / "befor", with_file=("hunt.toml",)) == f"did you mean {str(tmp_path / 'befora')!r}? "


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("rn", "there is no command 'rn'; did you mean 'run'?"),
        ("suite rnu", "did you mean 'run'?"),
        ("--verson", "did you mean '--version'?"),
        ("run o 1 1 10 --scenaro loop", "there is no option '--scenaro'; did you mean '--scenario'? see crashhunt run"),
        ("run o 1 1 --scenaro loop 10", "there is no option '--scenaro'"),  # not: 'loop' is not a whole number
        ("run o 1 1 10 --arg=x=1 --agnt=x", "did you mean '--agent'?"),
        ("replay o --code curent", "--code 'curent' is none of its choices; did you mean 'current'?"),
        ("run o 1 1 10 --sampler rando", "did you mean 'random'?"),
        ("run o 1 1 10 --agent kep-lane", "did you mean 'keep-lane'?"),
        ("run o 1 1 10 --scenario mrge", "did you mean 'merge'?"),
        ("run o 1 1 10 --crash-on colision", "did you mean 'collision'?"),
        ("run o 1 1 10 --set vehicle=3", "did you mean 'vehicles'?"),
        ("run o 1 1 10 --arg sped=3", "did you mean 'speed'?"),
        ("run o 1 1 10 --agent eg=idm", "did you mean 'ego'?"),
        ("trials o --outcome survivd", "did you mean 'survived'?"),
        ("run o -1 1 10", "PARALLEL is -1; give at least 0 (0: one per core)"),
        ("run o 1 0 10", "TRIALS is 0; give at least 1"),
        ("run o 1 1 10 --timeout soon", "'soon' is not a number"),
        ("run o 1 1 10 --snapshot-limit -1", "--snapshot-limit is -1; give MB above 0, or --no-snapshot"),
        ("run o 1 1 10 --snapshot-limit nan", "--snapshot-limit is nan"),
        ("logs o --trial -1", "--trial is -1; give at least 0"),
    ],
)
def test_a_command_line_states_what_was_meant(words, says, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("signal.signal", lambda *_: None)  # pytest's own Ctrl-C stays
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(words.split())
    told = capsys.readouterr().err
    assert ended.value.code == 2
    assert len(told.splitlines()) == 1
    assert says in told


def test_suites_and_reruns_refuse_the_same_numbers(tmp_path, capsys):
    (tmp_path / "suite.toml").write_text('schema = 1\n[[hunts]]\nid = "a"\n')
    for words in (["suite", "run", "suite.toml", "d", "-1"], ["rerun", "d", "--parallel", "-1"]):
        with pytest.raises(SystemExit):
            main([word if word not in ("suite.toml", "d") else str(tmp_path / word) for word in words])
        assert "PARALLEL is -1; give at least 0 (0: one per core)" in capsys.readouterr().err
        (tmp_path / "d").mkdir(exist_ok=True)
        (tmp_path / "d" / "request.json").touch()


def test_none_at_a_time_is_one_per_core():
    _, settings = plan(Request(trials=1, max_steps=1, parallel=0))
    assert settings.run.parallel >= 1


@pytest.mark.parametrize(
    ("function", "arguments", "says"),
    [
        (crashhunt.run, {"scenaro": 1}, "run() has no argument 'scenaro'; did you mean 'scenario'?"),
        (crashhunt.run, {"keepgoing": True}, "did you mean 'keep_going'?"),
        (crashhunt.prepare, {"wacth": 1}, "prepare() has no argument 'wacth'; it takes directory"),
        (crashhunt.replay, {"crash": "x", "cod": 1}, "did you mean 'code'?"),
        (crashhunt.load, {"dir": 1}, "load() has no argument 'dir'"),
        (crashhunt.compare, {"html": 1}, "compare() has no argument 'html'"),
        (crashhunt.run, {"directory": "x"}, "missing a required argument: 'parallel'; call run(directory, parallel,"),
    ],
)
def test_a_call_states_what_was_meant(function, arguments, says):
    with pytest.raises(CrashhuntError) as caught:
        function(**arguments)
    assert isinstance(caught.value, CallError | TypeError)
    assert isinstance(caught.value, UsageError)
    assert says in str(caught.value)
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


def crashes(folder: Path) -> None:
    for number, outcome in ((4, Outcome.COLLISION), (40, Outcome.HANG), (41, Outcome.OFF_ROAD)):
        path = folder / "crashes" / f"{number:06d}-{outcome}"
        path.mkdir(parents=True)
        result = replace(TrialResult(TrialSpec(number, 1, {}, {}, max_steps=9), outcome), steps=3)
        Bundle(path, result, 1, "s").write()


@pytest.mark.parametrize("word", ["4", "000004", "04", "000004-collision", "000004-"])
def test_a_crash_is_named_in_every_way_that_names_one(tmp_path, word):
    crashes(tmp_path)
    assert find_bundle(tmp_path, word).id == "000004-collision"


@pytest.mark.parametrize(
    ("word", "says"),
    [
        ("5", "there is no crash '5'; give one of 000004-collision, 000040-hang, 000041-off_road"),
        ("000004-colision", "did you mean '000004-collision'?"),
        ("00004", "give"),
        ("0000", "'0000' matches several crashes; give one of 000004-collision, 000040-hang, 000041-off_road"),
        ("²", "there is no crash"),
    ],
)
def test_a_crash_that_is_none_or_several_lists_them(tmp_path, word, says):
    crashes(tmp_path)
    if word == "00004":
        assert find_bundle(tmp_path, word).id == "000004-collision"
        return
    with pytest.raises(BundleError) as caught:
        find_bundle(tmp_path, word)
    assert says in str(caught.value)


class Leaving:
    """A sampler that ends its process."""

    learns = False

    def __init__(self, space, points=1):
        self.ask = {2: lambda *_: sys.exit(0), 3: lambda *_: os._exit(0)}[points]

    def tell(self, result):
        raise SystemExit


@pytest.mark.parametrize(("points", "says"), [(2, "SystemExit: 0"), (3, "SystemExit: os._exit(0)")])
def test_a_sampler_cannot_end_the_command(monkeypatch, points, says):
    monkeypatch.setattr(os, "_exit", lambda status: pytest.fail(f"left with {status}"))
    sampler = NamedSampler(f"{__name__}:Leaving", {}, points=points)
    with pytest.raises(PluginError, match="fails when it is asked for trial 7") as caught:
        sampler.ask(7, np.random.default_rng(1))
    assert says in caught.value.message
    with pytest.raises(PluginError, match="fails on the result of trial 0"):
        sampler.tell(TrialResult(TrialSpec(0, 1, {}, {}, max_steps=1), Outcome.SURVIVED))


class Careless:
    """A sampler that cannot be made."""

    def __init__(self, space, points=1):
        raise KeyError("weights")


def test_a_sampler_that_cannot_be_made_states_where():
    with pytest.raises(PluginError) as caught:
        plan(Request(trials=1, max_steps=1, sampler=f"{__name__}:Careless"))
    assert "KeyError: 'weights'" in caught.value.message
    assert caught.value.where.endswith(f"test_names.py, line {Careless.__init__.__code__.co_firstlineno + 1}")
