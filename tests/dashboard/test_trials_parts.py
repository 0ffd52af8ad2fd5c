"""Counts and samples of trials for the dashboard, without a ledger's file where that does not matter."""

from __future__ import annotations

import math
from itertools import pairwise
from types import SimpleNamespace

import pytest

from crashhunt.base.errors import HuntDirectoryError
from crashhunt.dashboard import _plotted_trials, _trial_counts as _trials
from crashhunt.dashboard._plotted_trials import Sample, _point, is_drawn
from crashhunt.dashboard._trial_counts import TrialCounts
from crashhunt.report._page import _rounded
from crashhunt.results import TrialRow
from crashhunt.trial import Outcome, TrialResult, TrialSpec

CRASH_ON = (Outcome.COLLISION,)


def plain(number, outcome=Outcome.SURVIVED, **more):
    spec = TrialSpec(
        number=number, seed=1, arguments={"ego": {"speed": 2.0}}, scenario_arguments={"cars": 3}, max_steps=9
    )
    data = TrialResult(spec, outcome, steps=7, danger=0.123456).to_json()
    return {**data, **more}


def ledger_of(trials, damaged=()):
    """A ledger with these outcomes by number."""

    def plain_trial(number):
        if number in damaged:
            raise HuntDirectoryError(f"trial {number} is damaged")
        return plain(number, trials[number]) if number in trials else None

    return SimpleNamespace(
        plain_trial=plain_trial,
        numbers_of=lambda outcomes: [number for number, outcome in trials.items() if str(outcome) in outcomes],
    )


def test_drawn_trials_are_evenly_spaced_and_of_a_smaller_share_a_subset():
    whole = range(2_000)
    assert all(is_drawn(number, 1.0) for number in whole)
    assert not any(is_drawn(number, 0.0) for number in whole)
    for share in (0.5, 0.25, 0.125):
        drawn = [number for number in whole if is_drawn(number, share)]
        assert len(drawn) == pytest.approx(2_000 * share, abs=3)
        assert all(is_drawn(number, 2 * share) for number in drawn)
        gaps = {after - before for before, after in pairwise(drawn)}
        assert max(gaps) <= 3 / share


def test_first_sample_has_the_trials_that_each_one_is_asked_for(monkeypatch):
    """What is read of all numbers at once is what is drawn of each number."""
    monkeypatch.setattr(_plotted_trials, "_CHUNK_TRIALS", 64)
    for most, last, crashes, most_crashes in ((100, 99, 10, 10), (100, 100, 10, 10), (30, 399, 20, 19), (7, 499, 9, 3)):
        monkeypatch.setattr(_plotted_trials, "MAX_POINTS", most)
        monkeypatch.setattr(_plotted_trials, "MAX_CRASHES", most_crashes)
        trials = {n: Outcome.COLLISION if n % 50 == 1 else Outcome.SURVIVED for n in range(last + 1)}
        share, crash_share = 1.0, 1.0
        while (last + 1) * share > most:
            share /= 2
        while crashes * crash_share > most_crashes:
            crash_share /= 2
        sample = Sample(CRASH_ON)
        sample.begin(ledger_of(trials), last, crashes)
        assert (sample.share, sample.crash_share) == (share, crash_share)
        expected = [n for n in trials if is_drawn(n, max(share, crash_share) if n % 50 == 1 else share)]
        assert [point["number"] for point in sample.points] == expected
        assert sample.generation == 0


@pytest.mark.parametrize("outcome", [Outcome.SURVIVED, Outcome.COLLISION])
def test_sample_is_halved_when_it_has_one_too_many(monkeypatch, outcome):
    monkeypatch.setattr(_plotted_trials, "MAX_POINTS", 20)
    monkeypatch.setattr(_plotted_trials, "MAX_CRASHES", 20)
    other = Outcome.COLLISION if outcome is Outcome.SURVIVED else Outcome.SURVIVED
    trials = {n: outcome if n < 60 else other for n in range(70)}
    sample = Sample(CRASH_ON)
    sample.add(ledger_of(trials), [(n, str(trials[n])) for n in range(60, 70)])
    sample.add(ledger_of(trials), [(n, str(trials[n])) for n in range(20)])
    assert (len(sample.points), sample.generation, sample.share, sample.crash_share) == (30, 0, 1.0, 1.0)
    cursor = sample.since("")[1]
    assert cursor == "0.30"
    sample.add(ledger_of(trials), [(20, str(outcome))])
    shares = (0.5, 1.0) if outcome is Outcome.SURVIVED else (1.0, 0.5)
    assert (sample.generation, (sample.share, sample.crash_share)) == (1, shares)
    assert sorted(point["number"] for point in sample.points) == [
        *[n for n in range(21) if is_drawn(n, 0.5)], *range(60, 70)
    ]  # fmt: skip
    assert sample.since(cursor)[2]
    sample.add(ledger_of(trials), [(n, str(outcome)) for n in range(21, 60)])
    kept = [point["number"] for point in sample.points if point["number"] < 60]
    share = min(sample.share, sample.crash_share)
    assert share == 0.25
    assert kept == [n for n in range(60) if is_drawn(n, 0.25)]
    before = len(sample.points)
    sample.add(ledger_of(trials), [(0, str(outcome))])
    assert len(sample.points) == before + 1  # the counts are those of what was kept
    assert sample.generation == 2


def test_sample_omits_damaged_and_missing_trials_and_reports_ten():
    sample = Sample(CRASH_ON)
    sample.add(ledger_of({n: Outcome.SURVIVED for n in range(30) if n != 29}, damaged=range(3, 20)), [
        (n, "survived") for n in range(31)
    ])  # fmt: skip
    assert [point["number"] for point in sample.points] == [0, 1, 2, *range(20, 29)]
    assert len(sample.problems) == 10
    assert sample.problems[0] == "trial 3 is damaged"
    assert sample.problems[-1] == "trial 19 is damaged"


@pytest.mark.parametrize(
    ("cursor", "points", "is_all"),
    [("0.0", 5, False), ("0.2", 3, False), ("0.5", 0, False), ("0.9", 0, False), ("1.2", 5, True), ("0", 5, True),
     ("", 5, True), ("0.", 5, True), ("0.999999999", 0, False), ("0.1000000000", 5, True), (".2", 5, True)],
)  # fmt: skip
def test_cursor_is_the_generation_and_the_number_of_points(cursor, points, is_all):
    sample = Sample(CRASH_ON)
    sample.add(ledger_of(dict.fromkeys(range(5), Outcome.SURVIVED)), [(n, "survived") for n in range(5)])
    found, now, replaces = sample.since(cursor)
    assert (len(found), now, replaces) == (points, "0.5", is_all)
    assert [point["number"] for point in found] == list(range(5 - points, 5))


def test_point_of_a_trial_has_what_a_plot_shows():
    data = plain(4, Outcome.COLLISION, disturbances=[1, 2, 3])
    row = TrialRow(data)
    assert _point(data, {"collision"}) == {
        "number": 4, "outcome": "collision", "category": Outcome.COLLISION.category, "crash": True, "steps": 7,
        "danger": 0.1235, "ttc": None, "origin": row.origin, "parent": None, "disturbances": 3,
        "values": {"speed": 2.0, "cars": 3},
    }  # fmt: skip
    assert not _point(data, {"hang"})["crash"]
    data.pop("disturbances")
    assert _point(data, {"hang"})["disturbances"] == 0
    assert [_rounded(value) for value in (None, math.nan, math.inf, -math.inf, 0.0, 1.23456)] == [
        None, None, None, None, 0.0, 1.2346,
    ]  # fmt: skip


def counts_of(rows, killed=()):
    """Counts that have read these trials: number, outcome and steps."""
    counts = TrialCounts(CRASH_ON)
    counts.last = 0  # so that the first look is over
    asked = []

    def ended_between(first, last):
        asked.append((first, last))
        return [row for row in rows if first <= row[0] <= last]

    ledger = SimpleNamespace(
        last_number=lambda: max(row[0] for row in rows),
        ended_between=ended_between,
        killed_numbers=lambda first=0: {number for number in killed if number >= first},
    )
    return counts, ledger, asked


def test_only_gaps_and_what_follows_are_read(monkeypatch):
    rows = [(number, "survived", 2) for number in (0, 1, 2, 4, 5, 8, 9)]
    counts, ledger, asked = counts_of(rows)
    assert counts.refresh(ledger) == [(number, "survived") for number, *_ in rows]
    assert asked == [(0, 9)]
    assert counts.refresh(ledger) == []
    assert asked[1:] == [(3, 3), (6, 7)]
    rows += [(3, "collision", 5), (10, "survived", 2)]
    assert counts.refresh(ledger) == [(3, "collision"), (10, "survived")]
    assert asked[3:] == [(3, 3), (6, 7), (10, 10)]
    assert counts.prefix == (6, 0, 1, 15, 3)
    monkeypatch.setattr(_trials, "_MAX_GAPS", 2)
    rows += [(number, "survived", 2) for number in (12, 14)]
    counts.refresh(ledger)
    del asked[:]
    counts.refresh(ledger)  # 6-7, 11, 13
    assert asked == [(6, 14)]
    monkeypatch.setattr(_trials, "_MAX_GAPS", 3)
    counts.refresh(ledger)
    assert asked[1:] == [(6, 7), (11, 11), (13, 13)]


def test_trials_after_a_killed_one_wait_and_it_is_not_counted_as_excluded():
    rows = [(0, "survived", 2), (1, "invalid", 4), (2, "invalid", 8), (3, "collision", 16)]
    counts, ledger, _ = counts_of(rows, killed=[2])
    counts.refresh(ledger)
    assert counts.prefix == (1, 1, 0, 2, 1)  # without the steps of the invalid trial
    assert (counts.trials, counts.crashes) == (4, 1)
    assert counts.last == 3


def test_parts_are_joined_in_pairs_when_there_are_too_many(monkeypatch):
    monkeypatch.setattr(_trials, "PARTS", 4)
    counts, ledger, _ = counts_of([(n, "collision" if n in (2, 9) else "survived", n) for n in range(10)])
    counts.refresh(ledger)
    assert counts.parts() == [
        {"first": 0, "last": 3, "steps": 6, "outcomes": {"survived": 3, "collision": 1}},
        {"first": 4, "last": 7, "steps": 22, "outcomes": {"survived": 4}},
        {"first": 8, "last": 9, "steps": 17, "outcomes": {"survived": 1, "collision": 1}},
    ]
    assert counts.curve() == [[0, 0, 0], [4, 6, 1], [8, 28, 1], [10, 45, 2]]
    assert counts.curve(4) == counts.curve()
    assert counts.curve(3) == [[0, 0, 0], [8, 28, 1], [10, 45, 2]]
    assert counts.curve(2) == [[0, 0, 0], [10, 45, 2]]


def test_first_look_reads_single_trials_only_from_the_first_incomplete_part_on(monkeypatch):
    """Of a million trials, only sums are read of the others; the most frequent outcome is not read at all."""
    monkeypatch.setattr(_trials, "PARTS", 4)
    monkeypatch.setattr(_trials, "_TAIL", 12)
    for missing, killed, first_read, widths in (({29}, [], 24, 8), ({29}, [5], 0, 8), (set(), [], 32, 8)):
        rows = [(n, "collision" if n % 10 == 3 else "invalid" if n == 12 else "survived", 9 if n % 10 != 3 else n)
                for n in range(32) if n not in missing]  # fmt: skip
        asked = []

        def parts_of(width, outcome, rows=rows, asked=asked):
            asked.append((width, outcome))
            found = {}
            for number, said, steps in rows:
                if said == outcome:
                    trials, total = found.get(number // width, (0, 0))
                    found[number // width] = trials + 1, total + steps
            return [(part, *sums) for part, sums in sorted(found.items())]

        def ended_between(first, last, rows=rows, asked=asked):
            asked.append((first, last))
            return [row for row in rows if first <= row[0] <= last]

        steps = {name: [row[2] for row in rows if row[1] == name] for name in ("collision", "invalid", "survived")}
        ledger = SimpleNamespace(
            last_number=lambda: 31,
            steps_by_outcome=lambda steps=steps: {
                name: (len(found), min(found), max(found)) for name, found in steps.items()
            },
            parts_of=parts_of, ended_between=ended_between, killed_numbers=lambda killed=killed: killed,
        )  # fmt: skip
        counts = TrialCounts(CRASH_ON)
        assert counts.refresh(ledger) == []
        assert sorted(pair for pair in asked if isinstance(pair[1], str)) == [
            (widths, "collision"),
            (widths, "invalid"),
        ]
        assert asked[-1] == (first_read, 31)
        assert counts.trials == len(rows)
        assert counts.outcomes == {name: len(found) for name, found in steps.items()}
        assert sum(part["steps"] for part in counts.parts()) == sum(row[2] for row in rows)
        end = killed[0] if killed else min(missing, default=32)
        before = [row for row in rows if row[0] < end]
        assert counts.prefix[:4] == (
            sum(row[1] != "invalid" for row in before),
            sum(row[1] == "invalid" for row in before),
            sum(row[1] == "collision" for row in before),
            sum(row[2] for row in before if row[1] != "invalid"),
        )
