from __future__ import annotations

import sqlite3
import subprocess
import sys
from contextlib import closing, suppress
from dataclasses import replace

from conftest import examples
from hypothesis import given, settings, strategies as st

from crashhunt.hunts._next_trials import find_unanswered
from crashhunt.ledger import Ledger, has_begun
from crashhunt.results import TrialRow
from crashhunt.results._hunt_state import sums_of_branches, sums_of_probes
from crashhunt.trial import KILLED, Branches, Failure, Outcome, Stress, TrialResult, TrialSpec
from crashhunt.world import ClosestApproach


def result(number: int, outcome: Outcome = Outcome.SURVIVED, *, ttc: float = 3.0, steps: int = 10) -> TrialResult:
    spec = TrialSpec(number, 7 * number, {"ego": {"speed": 1.5}}, {"vehicles": 3}, max_steps=20)
    return TrialResult(spec, outcome, steps=steps, wall_s=0.1, closest=ClosestApproach(ttc, 1.0, 2.0))


def test_a_ledger_in_a_folder_that_is_not_writable_is_read(tmp_path, monkeypatch):
    """On a read-only file system, SQLite cannot create its auxiliary files next to the ledger."""
    path = tmp_path / "ledger.sqlite"
    with closing(Ledger(path, writable=True)) as writer:
        writer.record(result(1), snapshot="")
    monkeypatch.setattr("os.access", lambda place, mode: place != tmp_path)
    with closing(Ledger(path)) as reader:
        assert reader.finished() == {1}
        assert {file.name for file in tmp_path.iterdir()} == {"ledger.sqlite"}


def test_what_is_recorded_together_is_there_at_once_and_whatever_happens(tmp_path):
    path = tmp_path / "ledger.sqlite"
    with closing(Ledger(path, writable=True)) as writer, closing(Ledger(path)) as reader:
        with writer.together():
            with closing(sqlite3.connect(path, timeout=0.0)) as other:
                other.execute("BEGIN IMMEDIATE")  # nobody is locked out before something is recorded
            writer.record(result(1), snapshot="")
            writer.record(result(2), snapshot="")
            assert reader.finished() == set()
            assert writer.finished() == {1, 2}
        assert reader.finished() == {1, 2}
        with suppress(KeyError), writer.together():
            writer.record(result(3), snapshot="")
            raise KeyError
        assert reader.finished() == {1, 2, 3}
        writer.note(heartbeat=1.0)
        assert reader.facts()["heartbeat"] == 1.0


def test_remark_among_what_is_recorded_together_comes_after_the_records_before_it(tmp_path):
    path = tmp_path / "ledger.sqlite"
    with closing(Ledger(path, writable=True)) as writer, closing(Ledger(path)) as reader:
        with writer.together():
            writer.record(result(1), snapshot="")
            writer.remark("odd")
            writer.note(origins=True)
            assert (reader.finished(), reader.facts()["origins"]) == ({1}, True)
            writer.record(result(2), snapshot="")
            assert reader.finished() == {1}
        assert reader.finished() == {1, 2}
        assert [event[1:] for event in reader.events()] == [("remark", "odd")]


def test_what_is_recorded_together_is_not_kept_back_while_trials_are_waited_for(tmp_path, monkeypatch):
    path = tmp_path / "ledger.sqlite"
    now = 100.0
    monkeypatch.setattr("time.monotonic", lambda: now)
    with closing(Ledger(path, writable=True)) as writer, closing(Ledger(path)) as reader, writer.together():
        writer.record(result(1), snapshot="")
        now += 0.4
        writer.record(result(2), snapshot="")
        assert reader.finished() == set()
        now += 0.2
        writer.record(result(3), snapshot="")
        assert reader.finished() == {1, 2, 3}
        writer.record(result(4), snapshot="")
        assert reader.finished() == {1, 2, 3}
    now += 1.0  # from here on, each is written by itself
    with closing(Ledger(path, writable=True)) as writer, closing(Ledger(path)) as reader:
        with writer.together():
            writer.record(result(5), snapshot="")
        now += 1.0
        writer.record(result(6), snapshot="")
        assert reader.finished() == {1, 2, 3, 4, 5, 6}


def test_an_empty_file_is_no_ledger_yet(tmp_path):
    path = tmp_path / "ledger.sqlite"
    with closing(sqlite3.connect(path)) as database:  # as whoever looks too early does
        database.execute("PRAGMA schema_version")
    assert path.exists()
    assert not has_begun(path)
    Ledger(path, writable=True).close()
    assert has_begun(path)
    with closing(Ledger(path)) as ledger:
        assert ledger.outcomes() == {}


READS_WHEN_THERE = """
import sys, time
from pathlib import Path
from crashhunt.errors import HuntDirectoryError
from crashhunt.ledger import Ledger

print("ready", flush=True)
end = time.monotonic() + 60
for number in range(80):
    path = Path(sys.argv[1], f"{number}.sqlite")
    while not path.exists():  # at once, without a pause
        if time.monotonic() > end:
            sys.exit("it never came")
    try:
        Ledger(path).close()
    except HuntDirectoryError as error:
        print(error)
"""


def test_the_one_that_sees_a_ledger_can_read_it(tmp_path):
    command = [sys.executable, "-c", READS_WHEN_THERE, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as reader:
        try:
            assert reader.stdout.readline() == "ready\n"
            for number in range(80):
                Ledger(tmp_path / f"{number}.sqlite", writable=True).close()
            assert reader.communicate(timeout=300) == ("", None)
        finally:
            reader.kill()
    assert reader.returncode == 0


def test_a_trial_that_ran_again_counts_once(tmp_path):
    ledger = Ledger(tmp_path / "ledger.sqlite", writable=True)
    ledger.record(result(1, Outcome.HANG), snapshot="")
    ledger.record(result(1), snapshot="")
    assert ledger.outcomes() == {"survived": 1}
    ledger.close()


# Not what the ledger says of itself, which Hypothesis knows from its source.
NAMES = st.text().filter(lambda name: name not in ("seal", "reader"))


@settings(max_examples=examples(20))  # each is a ledger of its own
@given(st.dictionaries(NAMES, st.none() | st.integers() | st.text() | st.lists(st.floats(allow_nan=False))))
def test_facts_are_kept_and_none_removes_one(tmp_path_factory, facts):
    ledger = Ledger(tmp_path_factory.mktemp("ledger") / "ledger.sqlite", writable=True)
    ledger.note(**dict.fromkeys(facts, "before"))
    ledger.note(**facts)
    assert ledger.facts() == {key: value for key, value in facts.items() if value is not None}
    ledger.close()


def test_trials_that_run_again_are_those_with_a_cause_outside_of_them(tmp_path):
    ledger = Ledger(tmp_path / "ledger.sqlite", writable=True)
    killed = Failure(KILLED, "killed from outside 3 times")
    forged = Failure("KeyError", '"may_be_asked_again": true, "kind": "killed from outside"')
    half = Stress(None, moments=9, moments_asked=1, margin_upper_bound=1.0, why_unasked="a copy was killed by SIGKILL")
    asked = [
        result(0),
        replace(result(1), stress=replace(half, may_be_asked_again=True)),
        replace(result(2), stress=half),  # as copies failed by themselves
        replace(result(3), branches=Branches(asked=3, unanswered=1, may_be_asked_again=True)),
        replace(result(4, Outcome.INVALID), failure=killed),
        replace(result(5), failure=forged),
        replace(result(6), stress=Stress(0.5, moments=9, moments_asked=9)),
    ]
    for one in asked:
        ledger.record(one, snapshot="")
    assert find_unanswered(ledger) == [asked[4]]  # of a hunt without copies, which is not read for them
    ledger.note(copies=["probes", "branches"])
    assert find_unanswered(ledger) == [asked[1], asked[3], asked[4]]
    assert [one.is_fully_asked for one in asked] == [True, False, False, False, True, True, True]
    assert [TrialRow(one.to_json()).is_fully_asked for one in asked] == [one.is_fully_asked for one in asked]
    facts = {"copies": ["probes", "branches"]}
    probes, branches = sums_of_probes(ledger, facts), sums_of_branches(ledger, facts)
    assert (probes["trials"], probes["not_fully_asked"], probes["least"], probes["trial"]) == (1, 2, 0.5, 6)
    assert (branches["trials"], branches["not_fully_asked"]) == (1, 1)
    ledger.close()
