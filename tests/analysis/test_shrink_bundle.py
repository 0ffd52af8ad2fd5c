"""A bundle is made smaller, in the process that asks for it."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from crashhunt.analysis import _minimization as _shrink, shrink
from crashhunt.crashes import find_bundle
from crashhunt.errors import UntrustedError, UsageError
from crashhunt.trial import Outcome

FROZEN = Path(__file__).parents[1] / "e2e" / "frozen" / "version-1" / "hunt"


@pytest.fixture
def crash(tmp_path):
    """A crash on the toy at 14.45 m/s, which an older version recorded without code."""
    return find_bundle(Path(shutil.copytree(FROZEN, tmp_path / "h")), "0")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"budget": 0}, "the budget is 0; give at least 1 trial"),
        ({"time_s": 0}, "the time limit is 0 s; give more than 0"),
        ({"time_s": float("nan")}, "the time limit is nan s; give more than 0"),
    ],
)
def test_a_budget_or_time_that_is_none_is_refused(crash, options, message):
    with pytest.raises(UsageError) as refused:
        shrink(crash, **options)
    assert str(refused.value) == message


def test_what_is_small_or_no_crash_is_refused(crash):
    for outcome in (Outcome.SURVIVED, Outcome.FINISHED):
        with pytest.raises(UsageError, match="is a near miss, not a crash"):
            shrink(replace(crash, result=replace(crash.result, outcome=outcome)))
    small = replace(crash, path=crash.path.with_name(f"{crash.id}.small"))
    with pytest.raises(
        UsageError, match="is already minimized; give --crash 000000-collision to minimize the original crash again"
    ):
        shrink(small)
    with pytest.raises(UntrustedError):
        shrink(crash, trusted=False)


@pytest.mark.long
def test_what_is_left_is_written_next_to_it_and_confirmed(crash):
    with_budget = shrink(crash, budget=1, parallel=1, trusted=True)
    assert (with_budget.verdict, with_budget.ended, with_budget.small) == ("unchanged", "budget", None)
    assert with_budget.to_json()["path"] is None
    memory = crash.path.with_name(".000000-collision.small.jsonl")
    assert len(memory.read_text().splitlines()) == 1
    seen = []
    found = shrink(crash, parallel=1, trusted=True, watch=lambda count, budget: seen.append((count, budget)))
    assert (found.verdict, found.ended, found.why) == ("shrunk", "done", "")
    assert not memory.exists()
    assert seen[-1] == (found.trials, 500)
    small = found.small
    assert small.path == crash.path.with_name("000000-collision.small")
    assert small.confirmed is True
    assert small.result.outcome is Outcome.COLLISION
    assert small.added["shrunk"]["of"] == crash.id
    assert small.added["shrunk"]["changed"] == {name: list(values) for name, values in found.changed.items()}
    assert {name: now for name, (_, now) in found.changed.items()} == {
        **{f"ego.{name}": value for name, value in small.result.spec.arguments["ego"].items()
           if value != crash.result.spec.arguments["ego"][name]},
        **{name: value for name, value in small.result.spec.scenario_arguments.items()
           if value != crash.result.spec.scenario_arguments[name]},
    }  # fmt: skip
    assert "ego.speed" in found.changed
    told = found.to_json()
    assert (told["crash"], told["path"], told["verdict"]) == (crash.id, str(small.path), "shrunk")
    assert (told["steps_before"], told["steps_after"]) == (52, small.result.steps)
    assert (told["actors_before"], told["actors_after"], found.others) == (2, 2, (1, 1))
    assert (told["signature_kept"], told["confirmed"], told["scripted"], told["steps_cut"]) == (True, True, None, 0)
    assert told["trials_run"] == found.trials > 3
    assert told["steps_run"] == found.steps > 52
    assert any("cannot exclude actors" in note for note in told["notes"])
    fewer = replace(found, actors=(5, 2), agents=(3, 1))
    assert (fewer.to_json()["actors_before"], fewer.to_json()["actors_after"], fewer.others) == (5, 2, (2, 1))


class AskedError(Exception):
    """Ends `shrink` where it would begin to run."""


@pytest.mark.parametrize("parallel", [0, 3])
def test_as_many_run_at_a_time_as_is_asked_or_as_there_are_cores(crash, monkeypatch, parallel):
    def runs(*_, **options):
        raise AskedError(options)

    monkeypatch.setattr(_shrink, "Runs", runs)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1, 2, 3, 4} if pid == 0 else {0})
    with pytest.raises(AskedError) as asked:
        shrink(crash, parallel=parallel, trusted=True)
    assert asked.value.args[0]["parallel"] == (parallel or 5)
    assert (asked.value.args[0]["budget"], asked.value.args[0]["time_s"]) == (500, None)


def test_processes_end_where_the_search_raises(crash, monkeypatch):
    closed = []

    class Fails:
        def __init__(self, *_):
            raise AskedError

    monkeypatch.setattr(_shrink, "Runs", lambda *_, **__: SimpleNamespace(close=lambda: closed.append(True)))
    monkeypatch.setattr(_shrink, "Minimizer", Fails)
    with pytest.raises(AskedError):
        shrink(crash, trusted=True)
    assert closed == [True]


@pytest.mark.parametrize(("confirmed", "tries"), [(True, 1), (False, 3)])
def test_of_what_does_not_come_again_the_next_larger_is_taken(crash, monkeypatch, confirmed, tries):
    crash = replace(crash, confirmed=confirmed)
    earlier = crash.path.with_name("000000-collision.small")
    shutil.copytree(crash.path, earlier)
    specs = [replace(crash.result.spec, number=number) for number in range(3)]
    ran = []

    def run_fresh(rerun, spec, name):
        ran.append(spec.number)
        path = crash.path.with_name(name)
        path.mkdir()
        return replace(crash, path=path, result=replace(crash.result, spec=spec))

    search = SimpleNamespace(
        smaller=specs, best=None, removed=lambda: ("a",), changed=lambda: {"ego.speed": (1.0, 2.0)}, steps_cut=7
    )
    monkeypatch.setattr(_shrink, "_run_fresh", run_fresh)
    monkeypatch.setattr(_shrink, "_confirm_smallest", lambda small, final: small)
    monkeypatch.setattr(_shrink, "is_same", lambda found, wanted, spec: spec.number == 1)
    monkeypatch.setattr(_shrink, "signature_of", lambda bundle: None)
    small = _shrink._write_smallest(SimpleNamespace(bundle=crash), search, None)
    assert ran == [2] * tries + [1]
    assert search.best is specs[1]
    assert small.added["shrunk"] == {
        "of": crash.id, "removed": ["a"], "changed": {"ego.speed": [1.0, 2.0]}, "steps_cut": 7,
    }  # fmt: skip
    monkeypatch.setattr(_shrink, "is_same", lambda found, wanted, spec: False)
    assert _shrink._write_smallest(SimpleNamespace(bundle=crash), search, None) is None
    assert sorted(path.name for path in crash.path.parent.glob("*000000*")) == [crash.id, earlier.name]


def test_earlier_minimized_crash_stays_until_the_next_one_is_confirmed(crash, monkeypatch):
    final = crash.path.with_name("000000-collision.small")
    shutil.copytree(crash.path, final)
    (final / "earlier").touch()

    def small():
        return replace(crash, path=Path(shutil.copytree(crash.path, crash.path.with_name(".building"))))

    def stops(bundle, *, trusted):
        raise KeyboardInterrupt

    building = small()
    monkeypatch.setattr(_shrink, "confirm", stops)
    with pytest.raises(KeyboardInterrupt):
        _shrink._confirm_smallest(building, final)
    assert (final / "earlier").exists()
    monkeypatch.setattr(_shrink, "confirm", lambda bundle, *, trusted: replace(bundle, confirmed=False))
    assert _shrink._confirm_smallest(building, final).path == final
    assert not (final / "earlier").exists()
    assert find_bundle(crash.hunt, final.name).confirmed is False
    shutil.rmtree(crash.path.with_name(".building"))  # the earlier one, which `_write_smallest` removes
    monkeypatch.setattr(_shrink, "confirm", lambda bundle, *, trusted: None)
    assert _shrink._confirm_smallest(replace(small(), confirmed=None), final).confirmed is None
    assert find_bundle(crash.hunt, final.name).confirmed is None


def test_a_crash_that_does_not_come_again_is_reported(crash, monkeypatch):
    runs = SimpleNamespace(
        most_steps=9, count=3, steps=30, first=lambda specs, *, again=False: None, close=lambda: None
    )  # fmt: skip
    monkeypatch.setattr(_shrink, "Runs", lambda *_, **options: runs)
    found = shrink(crash, trusted=True)
    assert (found.verdict, found.ended, found.why) == ("not_reproduced", "done", "it did not come again in 3 runs")
    assert (found.small, found.actors, found.trials, found.steps) == (None, (2, 2), 3, 30)
    assert found.to_json()["signature_kept"] is False
