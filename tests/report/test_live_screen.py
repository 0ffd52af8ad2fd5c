"""The status screen on terminals of all sizes, and the line of commands that take their time."""

from __future__ import annotations

import io
import os
import pty
import threading
from dataclasses import replace
from types import SimpleNamespace

import pytest
from conftest import keeps_going
from rich.console import Console

from crashhunt.executors import NodeFigures
from crashhunt.hunts import HuntStatus, PhaseStatus, SearchStatus
from crashhunt.hunts._progress import StrategyStatus
from crashhunt.recording import BlackBoxHeader, Phase
from crashhunt.report import Watcher, describe_running
from crashhunt.report._argument_words import format_inputs
from crashhunt.report._live_screen import _line, _nearest_words, describe_kinds
from crashhunt.trial import Disturbance, Outcome, Stress, TrialResult, TrialSpec
from crashhunt.world import ClosestApproach

TITLE = "crashhunt: intersection-two-agents, crashhunt.agents:CarFollowing, crashhunt.agents:KeepLaneWithSpeed"


def status(workers: int) -> HuntStatus:
    traffic = {"vehicles": 29, "imperfection": 0.569, "speed_spread": 0.1034, "trucks_per_100_cars": 34}
    spec = TrialSpec(123, 1, {"ego": {"speed": 17.2, "headway_s": 1.25}}, traffic, max_steps=1500)
    nearest = TrialResult(spec, Outcome.SURVIVED, closest=ClosestApproach(0.42, 1.2, 3.0))
    phases = [Phase.SETUP, *(phase for phase in Phase if phase not in (Phase.SETUP, Phase.DONE))]
    boxes = {
        120 + n: BlackBoxHeader(4711231 + n, 120 + n, 0.0, 0, 100 + n, phases[min(n, 1)], 0) for n in range(workers)
    }
    outcomes = {"collision": 2, "survived": 110, "finished": 8, "invalid": 3, "agent_error": 1}
    return HuntStatus("hunting", 1000, 123, outcomes, 12.3, 65.0, nearest, boxes, 2)


def screen_of(status, *, width=100, height=12):
    """Return what a terminal of that size shows of a status."""
    console = Console(width=width, height=height, force_terminal=True, color_system=None)
    with console.capture() as shown:
        console.print(Watcher(console, TITLE)._screen(status))
    return shown.get()


def screen(width: int, height: int, workers: int) -> list[str]:
    return [line.rstrip() for line in screen_of(status(workers), width=width, height=height).splitlines()]


@pytest.mark.parametrize(("width", "height", "workers"), [(40, 24, 8), (40, 13, 8), (40, 12, 4), (120, 12, 32)])
def test_every_worker_is_on_the_screen(width, height, workers):
    lines = screen(width, height, workers)
    assert len(lines) < height
    assert max(map(len, lines)) <= width
    assert "running   1:05" in lines[0]
    assert "123/1000" in lines[1]
    for number in range(120, 120 + workers):
        shown = "setting up" if number == 120 else f"step {number - 20}"
        assert any(str(number) in line and shown in line for line in lines), number


def test_what_the_search_tries_and_when_danger_last_grew_is_shown_where_there_is_room():
    tried = StrategyStatus("mutation", 60, 0.6, 0.3125, 1), StrategyStatus("random", 40, 0.4, None, 0)
    found = replace(status(2), search=SearchStatus(tried, 1, 65.0))
    for height, shown in ((12, True), (6, False)):
        seen = screen_of(found, width=120, height=height)
        assert (
            "search: mutation 60 % of trials (mean criticality 0.31, 1 crash), random 40 % of trials" in seen
        ) is shown
        assert "nearest miss (1 trial / 1:05 ago): trial 123" in seen


def test_plain_lines_of_a_phase_are_printed_on_change_only(monkeypatch):
    now = iter(range(0, 1000, 10))
    monkeypatch.setattr("crashhunt.report._live_screen.time.monotonic", lambda: next(now))
    out = io.StringIO()
    watch = Watcher(Console(file=out, width=100), TITLE)
    for done in (3, 4, 4, 4, 5):
        watch(replace(status(0), phase="confirming", progress=PhaseStatus("confirming", done, 5, None)))
    assert out.getvalue().splitlines() == [f"confirming {done} of 5" for done in (3, 4, 5)]


def test_the_least_stress_margin_is_shown_where_there_is_room():
    found = status(2)
    brake = Disturbance(80, "ahead", "brake", 2.25, 3.0, "ego")
    stressed = replace(found.nearest, stress=Stress(0.375, 20, 900, 0, brake, "collision", 120))
    for height, shown in ((12, True), (6, False)):
        captured = screen_of(replace(found, stressed=stressed), width=100, height=height)
        line = "least robustness margin: 0.38, trial 123, the actor ahead of ego brakes with 2.25 m/s² for 3 s"
        assert (line in captured) is shown


@pytest.mark.parametrize(("arguments", "words"), [({}, ""), ({"ego": {"speed": 2.5}}, ", speed=2.5")])
def test_line_of_a_trial_without_arguments_ends_after_its_seed(arguments, words):
    spec = TrialSpec(number=3, seed=5, arguments=arguments, scenario_arguments={}, max_steps=9)
    result = TrialResult(spec, Outcome.SURVIVED)
    assert format_inputs(result) == f"seed 5{words}"
    assert _nearest_words(result) == f"trial 3, never on a collision course{words}"


def test_margin_that_is_not_fully_asked_is_shown_as_such():
    found = status(2)
    brake = Disturbance(80, "ahead", "brake", 2.25, 3.0, "ego")
    half = Stress(None, 20, 900, 0, brake, "collision", 120, moments=9, moments_asked=1, margin_upper_bound=0.375)
    shown = replace(found, stressed=replace(found.nearest, stress=half), not_fully_asked=2)
    captured = screen_of(shown)
    assert "least robustness margin: at most 0.38 (asked 1 of 9), trial 123" in captured
    assert "2 trials were not fully probed: copies of them died" in captured


def test_kinds_of_crashes_and_when_the_last_new_one_came():
    kind = SimpleNamespace(signature="rear end, the agent into the other", count=2)
    found = replace(status(2), kinds=(kind, kind), newest_kind_s=192.0, newest_kind_trials=1)
    for width in (40, 100):
        shown = screen_of(found, width=width, height=12)
        lines = [line.rstrip() for line in shown.splitlines()]
        assert len(lines) < 12
        assert any(line.startswith("2 crash types (last new type: 1 trial") for line in lines)
    assert any("(last new type: 1 trial / 3:12 ago): rear end, the" in line for line in lines)
    assert describe_kinds(replace(found, newest_kind_trials=None)).endswith("(last new type: 3:12 ago)")
    by_cause = replace(found, newest_kind_s=None, types_by_cause=5)  # --by-cause 8
    assert describe_kinds(by_cause) == "2 crash types, 5 by cause"


def test_long_lines_fold_on_a_screen_of_80_columns():
    kind = SimpleNamespace(signature="rear end, the agent into the other, while the agent changes lanes", count=2)
    rate = PLAIN | {"crashes": 1, "origin": "random", "certain": {"low": 1e-4, "high": 0.02}}
    found = replace(status(2), rate=rate, kinds=(kind,), newest_kind_s=192.0, newest_kind_trials=1)
    shown = screen_of(found, width=80, height=40)
    text = " ".join(shown.split())
    assert describe_running(rate) in text
    assert "while the agent changes lanes (2)" in text
    assert "…" not in text.partition("crash rate")[2]


@pytest.mark.parametrize(
    ("phase", "head"),
    [("auditing", "auditing"), ("causes", "finding causes"), ("near misses", "confirming"), ("saving", "saving")],
)
def test_first_line_has_the_phase(phase, head):
    progress = PhaseStatus(name=phase, done=1, total=4, seconds_left=None) if phase != "saving" else None
    console = Console(width=100, height=12, force_terminal=True, color_system=None)
    with console.capture() as shown:
        console.print(Watcher(console, "a hunt")._screen(replace(status(2), phase=phase, progress=progress)))
    assert shown.get().splitlines()[0].rstrip() == f"a hunt   {head}   1:05"


@pytest.mark.parametrize(
    ("crashes", "disturbed", "said"),
    [(2, 1, "1 of 2 crashes with disturbances"), (1, 0, "0 of 1 crash with disturbances"), (0, 0, ""), (2, None, "")],
)
def test_how_many_crashes_had_disturbances(crashes, disturbed, said):
    found = replace(status(2), crashes=crashes, disturbed=disturbed)
    *screen, line = f"{screen_of(found)}{_line(found)}".splitlines()
    for told in ("\n".join(screen), line):
        assert (said in told) if said else ("disturbances" not in told)


def test_where_not_all_fit_it_states_how_many_more():
    lines = screen(40, 12, 64)
    assert len(lines) < 12
    assert "and 53 more" in lines[-1]
    assert lines[4].startswith("nearest miss: trial 123, least TTC 0.42")


def test_locked_ledger_is_in_the_line_in_every_phase():
    progress = PhaseStatus(name="causes", done=1, total=4, seconds_left=None)
    for found in (replace(status(2), phase="waiting"), replace(status(2), phase="waiting", progress=progress)):
        assert _line(found).startswith("waiting for another program that has locked ledger.sqlite: ")


def test_nodes_are_on_the_screen_and_in_the_line():
    nodes = tuple(NodeFigures(f"n{number}", 4, 10 * number, 1.25) for number in range(9))
    for shown, expected in (
        (nodes[:2], ["node n0   4 at a time   0 trials   1.2/s", "node n1   4 at a time   10 trials   1.2/s"]),
        (nodes, ["node n0   4 at a time   0 trials   1.2/s", "and 8 more nodes"]),
        ((), ["no node is connected; the hunt waits"]),
    ):
        captured = screen_of(replace(status(2), nodes=shown), width=60, height=12)
        lines = [line.rstrip() for line in captured.splitlines()]
        assert len(lines) < 12
        assert [line for line in lines if "node" in line] == expected or len(shown) == 9
        assert expected[-1] in lines or len(shown) == 9
    plain = Console(width=200, force_terminal=False)
    for shown, expected in ((nodes, "left; connected nodes: 9"), ((), "left; no node is connected")):
        with plain.capture() as captured:
            Watcher(plain, TITLE)(replace(status(2), nodes=shown))
        assert captured.get().rstrip().endswith(expected)


def on_a_terminal(shell, *words: str) -> tuple[int, str]:
    """Run a command whose standard error is a terminal; return its exit code and what was shown there."""
    ours, theirs = pty.openpty()
    codes = []

    def run():
        try:
            codes.append(shell.crashhunt(*words, expect=None, terminal=theirs).code)
        finally:
            os.close(theirs)

    running = threading.Thread(target=run)
    running.start()
    shown = b""
    try:
        while more := os.read(ours, 4096):
            shown += more
    except OSError:  # Linux says so when the other end is closed
        pass
    os.close(ours)
    running.join()
    return codes[0], shown.decode(errors="replace")


@pytest.mark.nightly
def test_reports_exports_and_films_say_how_far_they_are(toy, made_once):
    pytest.importorskip("PIL")
    made_once(keeps_going, toy)
    for words, file in (
        (("report", "h"), "h/report.html"),
        (("export", "h", "h.zip"), "h.zip"),
        (("replay", "h", "--from-log", "--gif", "h.gif", "--last-seconds", "0.3"), "h.gif"),
    ):
        code, shown = on_a_terminal(toy, *words)
        assert code == 0, shown
        assert f"writing {file}" in shown
        assert "\x1b[?25h" in shown  # the cursor is there again
    code, shown = on_a_terminal(toy, "report", "h", "--json")
    assert code == 0
    assert "writing" not in shown
    assert "\x1b" not in shown
    assert toy.crashhunt("export", "h", "h.zip").err == ""


def test_a_hunt_without_a_last_trial_goes_by_the_clock():
    by_clock = replace(status(2), planned=0, time_left_s=195.0)
    shown = screen_of(by_clock, width=80, height=24)
    line = shown.splitlines()[1]
    assert "123 trials" in line
    assert "3:15 left" in line
    assert line.count("━") == 7 + 23 or "╸" in line  # a quarter of the time is over


PLAIN = {
    "method": "plain", "per": "trial", "confidence": 95.0, "units": 500, "trials": 500, "crashes": 0, "origin": "",
    "certain": {"low": 0.0, "high": 0.0067}, "estimate": None, "estimated": None, "why_not": "", "bar": None,
    "verdict": "",
}  # fmt: skip
RARE = PLAIN | {
    "method": "rare", "units": 400, "trials": 1600, "certain": {"low": 1.1e-5, "high": 1.9e-3}, "estimate": 2.0e-5,
    "estimated": {"low": 1.3e-5, "high": 2.7e-5},
}  # fmt: skip


@pytest.mark.parametrize(
    ("rate", "words"),
    [
        (PLAIN, "crash rate: at most 0.0067 per trial (0 crashes in 500 trials, 95 %)"),
        (
            PLAIN | {"crashes": 1, "origin": "random", "certain": {"low": 1e-4, "high": 0.02}},
            "crash rate: at least 0.0001, at most 0.02 per trial (1 crash in 500 random trials, 95 %)",
        ),
        (
            PLAIN | {"certain": None, "why_not": "no trial counts yet"},
            "crash rate: not known yet (no trial counts yet)",
        ),
        (
            PLAIN | {"per": "hour", "certain": {"low": 2.0, "high": None}, "bar": 1.0, "verdict": "above"},
            (
                "crash rate: at least 2, at most any number per hour (0 crashes in 500 trials, 95 %); "
                "bar 1 per hour: above"
            ),
        ),
        (
            RARE,
            (
                "crash rate: 2e-5 per trial (1.3e-5 to 2.7e-5, estimated from 400 roots); "
                "certain: at least 1.1e-5, at most 0.0019 (95 %)"
            ),
        ),
        (
            RARE | {"estimated": None, "units": 1, "certain": None},
            "crash rate: 2e-5 per trial (no interval from 1 root yet)",
        ),
        (RARE | {"estimate": None, "why_not": "none", "certain": None}, "crash rate: not known yet (none)"),
    ],
)
def test_running_rate_is_on_the_screen_and_in_the_line(rate, words):
    assert describe_running(rate) == words
    found = replace(status(2), rate=rate)
    assert _line(found).endswith(f"; {words}")
    assert words not in _line(replace(found, done=0))  # before the first result, it says nothing
    shown = screen_of(found, width=160, height=12)
    assert words in shown


def test_screen_of_a_terminal_needs_no_thread():
    """With a thread, the command could not be forked, and would import foreign modules itself."""
    before = threading.active_count()
    console = Console(width=100, height=12, force_terminal=True, color_system=None, file=io.StringIO())
    with Watcher(console, TITLE) as watcher:
        watcher(status(1))
        assert threading.active_count() == before
        assert TITLE[:60] in console.file.getvalue()
