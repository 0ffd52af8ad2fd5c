"""How `crashhunt status` writes the states of hunts, with states made by hand."""

from __future__ import annotations

import io
import json
from argparse import Namespace
from pathlib import Path

import pytest
from rich.console import Console

from crashhunt.cli import _status
from crashhunt.results import HuntState

PROBES = {
    "trials": 9, "not_fully_asked": 1, "least": 0.254, "trial": 4, "probes": 30, "steps": 100, "left_out": 0,
    "crashed_trials": 3, "run_again": 0, "confirmed": 0,
}  # fmt: skip
BRANCHES = {
    "trials": 8, "moments": 5, "branches": 20, "steps": 100, "left_out": 0, "crashed": 6, "crashed_trials": 2,
    "not_fully_asked": 0, "run_again": 4, "confirmed": 3,
}  # fmt: skip


def written(*states, width=200):
    text = io.StringIO()
    _status.show_states(list(states), Console(file=text, width=width, highlight=False))
    return [line.rstrip() for line in text.getvalue().splitlines() if line.strip()]


def test_row_has_counts_pace_and_outcomes():
    state = HuntState(
        dir="h", state="running", trials_planned=40, trials_run=10, outcomes={"survived": 7, "collision": 3}, crashes=3,
        errors=2, rate_per_s=2.0, seconds_left=15.0,
    )  # fmt: skip
    head, _, row = written(state)
    assert head.split() == ["hunt", "state", "trials", "pace", "left", "crashes", "errors", "outcomes"]
    assert row.split()[:3] == ["h", "running", "10/40"]
    assert row.split()[3:] == ["2.0/s", "0:15", "3", "2", "survived", "7,", "collision", "3"]
    resumed = written(HuntState(dir="h", state="finished", trials_planned=2, trials_run=6))[-1]
    assert resumed.split()[:3] == ["h", "finished", "6"]
    empty = written(HuntState(dir="h", state="queued"))[-1]
    assert empty.split() == ["h", "queued", "0", "-", "-", "0", "0"]


def test_nodes_are_listed_up_to_twenty():
    nodes = [{"name": f"node{n}", "parallel": n, "trials": 3 * n, "rate_per_s": 1.0} for n in range(1, 23)]
    for count, more in ((20, 0), (22, 2)):
        lines = written(HuntState(dir="h", state="running", nodes=nodes[:count]))
        assert sum("at a time" in line for line in lines) == 20
        assert any("node3 (3 at a time)" in line and " 9 " in line for line in lines)
        assert [line.strip() for line in lines if "more" in line] == ([f"and {more} more"] if more else [])


@pytest.mark.parametrize(
    ("facts", "line"),
    [
        ({"crashes": 1, "crashes_saved": 0}, "h: 1 crash: 0 saved"),
        ({"crashes": 5, "crashes_saved": 2, "disturbed": 3}, "h: 5 crashes: 2 saved, 3 disturbed"),
        ({"core": "on"}, "h: compiled core on"),
        (
            {"probes": PROBES},
            (
                "h: least robustness margin 0.25 (trial 4); probes 30, made to crash 3 of 10 trials, "
                "not fully asked 1 trial"
            ),
        ),
        (
            {"probes": PROBES | {"least": None, "trial": None, "not_fully_asked": 2, "run_again": 3, "confirmed": 1}},
            (
                "h: no robustness margin yet; probes 30, made to crash 3 of 11 trials, confirmed 1 of 3, "
                "not fully asked 2 trials"
            ),
        ),
        (
            {"branches": BRANCHES},
            "h: branches 20 (moments 5), crashed 6 (in 2 of 8 trials), confirmed 3 of 4",
        ),
    ],
)
def test_further_facts_have_a_line_each(facts, line):
    lines = written(HuntState(dir="h", state="running", **facts))
    assert lines[3:] == [line]


@pytest.mark.parametrize(
    ("rate", "counted", "remark"),
    [
        ({}, 151, "; 4 trials after a trial that has not ended are excluded"),
        ({}, 154, "; 1 trial after a trial that has not ended is excluded"),
        ({}, 155, ""),
        ({"per": "hour"}, 151, ""),  # its trials are those of whole units
        ({"bar": 0.3, "verdict": "above"}, 151, ""),  # its trials are those up to the decision
        ({"origin": "guided"}, 151, ""),  # its trials are the random ones
        ({"trained_on": 4}, 151, ""),
    ],
)
def test_rate_of_fewer_trials_than_have_finished_has_the_reason(rate, counted, remark):
    rate = {
        "method": "plain", "per": "trial", "bar": None, "certain": {"low": 0.2, "high": 0.5}, "origin": None,
        "crashes": 62, "trials": counted, "confidence": 95.0,
    } | rate  # fmt: skip
    outcomes = {"collision": 63, "survived": 92, "invalid": 1}
    state = HuntState(dir="h", state="interrupted", trials_run=156, outcomes=outcomes, rate=rate)
    (line,) = (line for line in written(state, width=400) if line.startswith("h: crash rate"))
    said = line.partition(" %)")[2]
    assert said == remark or (not remark and "not ended" not in said)


def test_newest_type_has_an_age_while_the_hunt_runs():
    kinds = [{"name": "rear", "count": 3}, {"name": "side", "count": 1}]
    for state, newest_s, has_age in (("running", 12.0, True), ("running", None, False), ("crashed", 12.0, False)):
        line = written(HuntState(dir="h", state=state, crashes=4, kinds=kinds, newest_kind_s=newest_s))[3]
        assert line.startswith("h: 4 crashes: 2 ")
        assert ("last new" in line) == has_age


def test_error_is_shown_with_the_first_line_of_its_reason():
    lines = written(HuntState(dir="h", state="error", detail="no map\nmore"), HuntState(dir="g", state="finished"))
    assert lines[-1] == "h: no map"
    assert not any("more" in line for line in lines)


def test_phase_replaces_the_state():
    phase = {"name": "shrinking", "done": 2, "total": 5}
    row = written(HuntState(dir="h", state="running", phase=phase))[2]
    assert "2" in row
    assert "5" in row
    assert "running" not in row


@pytest.mark.parametrize("damaged", [False, True])
def test_damaged_hunt_ends_the_command_with_2(monkeypatch, capsys, damaged):
    states = [HuntState(dir="g", state="finished"), HuntState(dir="h", state="error", damaged=damaged)]
    monkeypatch.setattr(_status, "_states", lambda directories: states if directories == [Path("d")] else [])
    for as_json in (True, False):
        options = Namespace(directories=[Path("d")], json=as_json, watch=False)
        assert _status._status(options, []) == (2 if damaged else 0)
    first, *rest = capsys.readouterr().out.splitlines()
    assert [one["dir"] for one in json.loads(first)["hunts"]] == ["g", "h"]
    assert any("finished" in line for line in rest)


def test_watched_states_are_read_until_all_hunts_have_ended(monkeypatch):
    reads, naps = [], []
    rows = iter([["queued", "running"], ["running", "finished"], ["crashed", "finished"]])
    monkeypatch.setattr(
        _status, "_states", lambda _: reads.append(1) or [HuntState(dir="h", state=state) for state in next(rows)]
    )
    monkeypatch.setattr(_status.time, "sleep", naps.append)
    assert _status._status(Namespace(directories=[], json=False, watch=True), []) == 0
    assert (len(reads), naps) == (3, [1.0, 1.0])


def test_table_without_terminal_has_120_columns():
    assert _status.states_console().width == 120
    assert _status.states_console(stderr=True).stderr is True


@pytest.mark.parametrize(
    ("columns", "kept"),
    [
        (120, {"pace", "left", "errors", "outcomes"}),
        (80, {"left", "errors", "outcomes"}),
        (66, {"left", "outcomes"}),
        (60, {"outcomes"}),
        (40, set()),
        (30, {"no crashes"}),
        (22, {"no crashes", "no trials"}),
    ],
)
def test_narrow_terminal_shows_fewer_columns_and_no_cut_number(columns, kept):
    state = HuntState(
        dir="hunts/one", state="crashed", trials_run=40, trials_planned=40, rate_per_s=0.17, crashes=28,
        seconds_left=90, outcomes={"collision": 28, "finished": 12},
    )  # fmt: skip
    header, _, *rows = written(state, width=columns)
    values = {"trials": "40/40", "crashes": "28"}
    shown = {name for name in values if f"no {name}" not in kept}
    kept = {name for name in kept if not name.startswith("no ")}
    assert set(header.split()) == {"hunt", "state", *shown, *kept}
    assert {"hunts/one", "finished", *(values[name] for name in shown)} <= set(rows[0].split())
    assert ("collision 28" in rows[0]) == ("outcomes" in kept)
    assert ("5.9 s/trial" in rows[0]) == ("pace" in kept)
    assert all(len(row) <= columns for row in rows)
