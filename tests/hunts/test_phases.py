"""The time left of a hunt, and the progress of what it does after its last trial."""

from __future__ import annotations

import heapq
import json
import random
import signal
import time
from contextlib import closing
from itertools import pairwise
from typing import TYPE_CHECKING

import pytest
from conftest import copy_files, keeps_going, wait_for

from crashhunt.hunts._progress import PhaseClock, RemainingTime
from crashhunt.ledger import Ledger
from crashhunt.report import describe_phase, format_pace
from crashhunt.results import hunt_state
from crashhunt.results._hunt_state import ledger_owner
from crashhunt.statistics import compare

if TYPE_CHECKING:
    from crashhunt.hunts import PhaseStatus

WAITS = """
import time
from pathlib import Path

RUNS = Path("{folder}", "runs")  # the second run of a seed begins the confirmation of its crash


class Driver:
    def __init__(self, speed: float = 20.0):
        self.speed = speed

    def reset(self, seed):
        mine = RUNS / f"{{seed}}.{{len([*RUNS.glob(f'{{seed}}.*')])}}"
        mine.touch()
        confirmed = sorted(RUNS.glob("*.1"), key=lambda run: run.stat().st_mtime_ns)
        while mine in confirmed[2:] and not Path("{folder}", "go").exists():
            time.sleep(0.01)

    def act(self, observation):
        return (self.speed, 0)
"""


def ends_of(durations, parallel):
    """Return when each trial ends, where so many run at a time."""
    free, ends = [0.0] * parallel, []
    for duration in durations:
        begins = heapq.heappop(free)
        heapq.heappush(free, begins + duration)
        ends.append(begins + duration)
    return sorted(ends)


def shown(ends, parallel, *, by_mean_rate=False):
    """Return the time left that a screen shows each second, with the truth: (time, shown, true)."""
    found, done, remaining = [], 0, RemainingTime(0.0)
    for now in range(int(ends[-1])):
        while ends[done] <= now:
            done += 1
            remaining.ended(ends[done - 1], len(ends) - done, parallel)
        left = len(ends) - done
        value = remaining.seconds_left(now, left, parallel)
        if by_mean_rate:
            value = left * now / done if done else float("inf")
        found.append((now, value, ends[-1] - now))
    return found


def longest_rise(series):
    """Return for how many seconds the time left rose in a row, at most; a jump takes 1 s."""
    longest = here = 0
    for (_, before, _), (_, after, _) in pairwise(series):
        here = here + 1 if after > before + 1e-9 else 0
        longest = max(longest, here)
    return longest


def draws(kind, count):
    rng = random.Random(7)
    return {
        "constant": lambda: [60.0] * count,
        "similar": lambda: [rng.uniform(50, 70) for _ in range(count)],
        "exponential": lambda: [rng.expovariate(1 / 40) for _ in range(count)],
        "short or long": lambda: [rng.choice([5.0, 5.0, 120.0]) for _ in range(count)],
        "slower and slower": lambda: [20.0 + 60.0 * place / count for place in range(count)],
        "one hangs": lambda: [10.0] * (count // 2) + [300.0] + [10.0] * (count // 2),
    }[kind]()


KINDS = ["constant", "similar", "exponential", "short or long", "slower and slower", "one hangs"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("parallel", [1, 2, 8])
def test_the_time_left_does_not_rise_for_long_and_is_about_right(kind, parallel):
    series = shown(ends_of(draws(kind, 200), parallel), parallel)
    assert longest_rise(series) <= 10  # s in a row, and trials take 40 s or so
    total = series[-1][0]
    if kind == "one hangs":
        return  # the time of that trial cannot be foreseen
    late = [(value, true) for now, value, true in series if now > total / 2]
    off = [abs(value - true) / total for value, true in late]
    assert max(off) < 0.25
    assert sum(off) / len(off) < 0.1
    assert all(value >= 1.0 for _, value, _ in series)


def test_by_the_mean_rate_it_rises_for_as_long_as_a_trial_takes():
    ends = ends_of(draws("constant", 60), 2)
    assert longest_rise(shown(ends, 2, by_mean_rate=True)) >= 50
    series = shown(ends, 2)
    assert longest_rise(series) <= 1
    assert all(true - 2 <= value <= true + 60 for now, value, true in series if now > 61)


def test_nothing_is_known_before_a_trial_has_ended_and_nothing_is_left_after_the_last():
    remaining = RemainingTime(10.0)
    assert remaining.seconds_left(50.0, 5, 2) == float("inf")
    assert remaining.seconds_left(50.0, 0, 2) == 0.0
    for _ in range(3):  # several in one tick
        remaining.ended(50.0, 2, 2)
    assert 0.0 < remaining.seconds_left(50.0, 2, 2) < 60.0


def test_a_stall_neither_raises_nor_ends_the_time_left():
    remaining = RemainingTime(0.0)
    for second in range(1, 11):
        remaining.ended(float(second), 20 - second, 1)
    values = [remaining.seconds_left(10.0 + wait, 10, 1) for wait in (0, 1, 2, 5, 500)]
    assert values == [10.0, 9.0, 8.0, 8.0, 8.0]


def test_a_phase_shows_what_has_ended_and_not_what_a_stop_has_left():
    seen: list[PhaseStatus] = []
    clock = PhaseClock(seen.append, 2)
    clock.tick(force=True)
    clock.advance()
    assert seen == []  # no phase has begun
    clock.begin("confirming", 6, 2)
    assert clock.run(lambda item: item * 2, [1, 2, 3, 4], counts=lambda result: result != 6) == [2, 4, 6, 8]
    assert (seen[0].done, seen[0].total, seen[0].seconds_left) == (2, 6, None)
    assert [one.done for one in seen if one.seconds_left is not None][:3] == [3, 4, 5]
    assert seen[-1].done == 5
    with pytest.raises(ValueError, match="no"):
        clock.run(lambda _: (_ for _ in ()).throw(ValueError("no")), [1])


@pytest.mark.parametrize(
    ("rate", "words"),
    [(0.0, "-/s"), (4.61, "4.6/s"), (0.96, "1.0/s"), (0.5, "2.0 s/trial"), (0.0123, "81 s/trial"), (310.0, "310.0/s")],
)
def test_a_slow_rate_is_in_seconds_for_each_trial(rate, words):
    assert format_pace(rate) == words


def test_a_phase_in_words():
    assert describe_phase("confirming", 24, 60, 40.0) == "confirming 24 of 60, 0:40 left"
    assert describe_phase("probes", 0, 6, None) == "confirming crashes of probes 0 of 6"


def test_confirmation_is_seen_while_it_runs_and_resumed_after_an_interrupt(toy):
    """Screen, status and JSON have the phase; Ctrl-C leaves the rest for the next start."""
    (toy.folder / "driver.py").write_text(WAITS.format(folder=toy.folder))  # from the third confirmation on
    (toy.folder / "runs").mkdir()
    words = ("run", "h", "2", "5", "99", "--scenario", "toy", "--agent", "driver:Driver", "--arg", "speed=14:20",
             "--seed", "1", "--keep-going", "--no-snapshot", "--json")  # fmt: skip
    process = toy.begin(*words)

    def confirming():
        found = hunt_state(toy.folder / "h") if (toy.folder / "h" / "ledger.sqlite").exists() else None
        return found if found and found.phase and found.phase["done"] == 2 else None

    state = wait_for(confirming, every_s=0.1, process=process)
    assert (state.state, state.trials_run, state.phase["name"], state.phase["total"]) == ("running", 5, "confirming", 5)
    assert "confirming" in toy.crashhunt("status", "h").out
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=200)
    assert process.returncode == 130, err
    report = json.loads(out)
    assert ([crash["confirmed"] for crash in report["crashes"]].count(True), report["unconfirmed"]) == (2, 3)
    assert "Interrupted: 3 of 5 crashes are not confirmed." in err
    assert "confirming " in err.split("Interrupted")[0]  # the log
    state = hunt_state(toy.folder / "h")
    assert (state.state, state.phase) == ("interrupted", None)

    (toy.folder / "go").touch()
    done = toy.crashhunt(*words)
    assert (done.json["unconfirmed"], done.json["stopped_because"]) == (0, "all_trials")
    assert all(crash["confirmed"] for crash in done.json["crashes"])
    assert "confirming 2 of 5" in done.err
    with closing(Ledger(toy.folder / "h" / "ledger.sqlite")) as ledger:
        assert ledger.facts().get("phase") is None


def test_a_comparison_knows_whether_trials_are_left_or_only_confirmations(toy, made_once):
    made_once(keeps_going, toy)
    hunt = toy.folder / "b"
    copy_files(toy.folder / "h", hunt)

    def compared(**facts):
        with closing(Ledger(hunt / "ledger.sqlite", writable=True)) as ledger:
            ledger.enter("running", owner=ledger_owner(), heartbeat=time.time(), **facts)
        found = compare(toy.folder / "h", hunt)
        return found.hunts[1], found.pairs[0]

    phase = {"name": "confirming", "done": 3, "total": 9, "seconds_left": 4.0}
    whole, pair = compared(planned=12)
    assert (whole.state, whole.interval is not None, pair.test) == ("running", True, "pairs")
    figures, pair = compared(planned=15)
    assert (figures.interval, pair.test) == (whole.interval, "pairs")  # both hold at any time
    began = time.time()
    figures, pair = compared(planned=0, phase=phase)  # its time was up
    assert (figures.interval, pair.test) == (whole.interval, "pairs")
    state = hunt_state(hunt)
    assert state.phase == {"name": "confirming", "done": 3, "total": 9}
    assert max(0.0, 4.0 - (time.time() - began)) <= state.seconds_left <= 4.0
