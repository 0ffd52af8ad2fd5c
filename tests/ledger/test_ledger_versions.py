"""Ledgers of other versions: version 1 is read for ever, what is older names who reads it, later ones say who may."""

from __future__ import annotations

import json
import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from crashhunt.base.integrity import digest_of_row
from crashhunt.base.older_versions import LAST_REVISION
from crashhunt.errors import HuntDirectoryError
from crashhunt.ledger import Ledger, Turn
from crashhunt.trial import Branches, Outcome, Stress, TrialResult, TrialSpec
from crashhunt.world import ClosestApproach

# Every version of the tables leaves one here, written by the crashhunt of then: `write` is what was called.
VERSIONS = Path(__file__).parent / "versions"
FROZEN = sorted(VERSIONS.glob("version-*.sqlite"))
ORIGIN = {"parent": 1, "origin": "climb"}
OUTCOMES = (Outcome.SURVIVED, Outcome.COLLISION, Outcome.FINISHED, Outcome.INVALID)
EVENTS = {2: {"running_a_red_light": 2, "emergency_braking": 1}, 6: {"running_a_red_light": 6, "emergency_braking": 1}}


def result(number):
    spec = TrialSpec(number, 7 * number, {"ego": {"speed": 1.5 + number}}, {"vehicles": number}, max_steps=20)
    closest = ClosestApproach(number / 3, 1.0, 2.0) if number % 3 else ClosestApproach()
    some = {"events": EVENTS[number]} if number in EVENTS else {}
    if number % 5:
        some["danger"] = 1 / number
    digest = f"{number:032x}"
    return TrialResult(spec, OUTCOMES[number % 4], steps=number, wall_s=0.125, closest=closest, digest=digest, **some)


def write(path):
    with closing(Ledger(path, writable=True)) as ledger:
        ledger.enter("running", owner=None, planned=12, hunt_seed=5)
        for number in range(10):
            ledger.record(result(number), snapshot="0123456789abcdef")
        ledger.replace([3])
        ledger.propose([Turn((), result(10).spec), Turn((1, 0), replace(result(11).spec, **ORIGIN))])
        ledger.enter("interrupted", "by somebody")


@pytest.fixture
def copy(request, tmp_path):
    shutil.copy(request.param, tmp_path / "ledger.sqlite")
    return tmp_path / "ledger.sqlite"


def version(path):
    with closing(sqlite3.connect(path)) as database:
        return database.execute("PRAGMA user_version").fetchone()[0]


def check(ledger):
    """See that a ledger says what was written."""
    trials = [result(number) for number in range(10)]
    gone = trials.pop(3)
    assert list(ledger.results()) == trials
    assert ledger.replaced() == [gone]
    assert ledger.facts() == {"planned": 12, "hunt_seed": 5, "state": "interrupted", "detail": "by somebody"}
    assert [event[1:] for event in ledger.events()] == [("running", ""), ("interrupted", "by somebody")]
    assert ledger.outcomes() == {"collision": 3, "finished": 2, "invalid": 1, "survived": 3}
    assert ledger.steps_total() == 42
    assert ledger.nearest_miss().spec.number == 2
    assert ledger.most_dangerous(3) == [2, 4, 6]
    assert ledger.snapshot_of(4) == "0123456789abcdef"
    assert ledger.traffic_events() == {"running_a_red_light": (8, 2), "emergency_braking": (2, 2)}
    assert sorted(row[0] for row in ledger.table()) == [0, 1, 2, 4, 5, 6, 7, 8, 9]
    assert list(ledger.turns()) == [Turn((), result(10).spec), Turn((1, 0), replace(result(11).spec, **ORIGIN))]


@pytest.mark.parametrize("copy", FROZEN, indirect=True, ids=[path.stem for path in FROZEN])
def test_a_ledger_of_version_1_is_read_as_it_is_and_continues(copy):
    was = copy.read_bytes()
    with closing(Ledger(copy)) as ledger:
        check(ledger)
    assert copy.read_bytes() == was
    Ledger(copy, writable=True).close()
    with closing(Ledger(copy)) as ledger:
        check(ledger)
        assert ledger.sealed
    with closing(Ledger(copy, writable=True)) as ledger:
        ledger.record(result(3), snapshot="")
        assert ledger.finished() == set(range(10))


@pytest.mark.parametrize("copy", [VERSIONS / "older.sqlite"], indirect=True)
@pytest.mark.parametrize("writable", [False, True])
def test_ledger_from_before_version_1_names_the_revision_that_reads_it(copy, writable):
    was = copy.read_bytes()
    with pytest.raises(HuntDirectoryError) as refused:
        Ledger(copy, writable=writable)
    assert refused.value.message == "the ledger is older than format version 1"
    assert f"crashhunt of git revision {LAST_REVISION} (pip install " in refused.value.fix
    assert copy.read_bytes() == was


def _plan(path):
    """How the trials with traffic events are found."""
    with closing(sqlite3.connect(path)) as database:
        query = """SELECT number FROM trials WHERE instr(result, '"events": {"') > 0"""
        return [row[-1] for row in database.execute(f"EXPLAIN QUERY PLAN {query}")]


def test_trials_with_traffic_events_are_found_without_reading_the_others(tmp_path):
    write(tmp_path / "new.sqlite")
    assert _plan(tmp_path / "new.sqlite") == ["SCAN trials USING INDEX trials_with_events"]


def newer(path, *, reader):
    """Make of a ledger what a later version might write: a table, a column and a fact that nobody here knows."""
    with closing(Ledger(path)) as ledger:
        seal = ledger._seal()
    with closing(sqlite3.connect(path)) as database, database:
        database.create_function("digest_of_row", -1, lambda *values: digest_of_row(values))
        database.execute("CREATE TABLE moods (number INTEGER, mood REAL)")
        database.execute("ALTER TABLE trials ADD COLUMN mood REAL")
        names = [name for _, name, *_ in database.execute("PRAGMA table_info(trials)") if name != "digest"]
        database.execute("UPDATE trials SET mood = 0.5")
        database.execute(f"UPDATE trials SET digest = digest_of_row({', '.join(names)})")
        facts = {"seal": {**seal, "moods": 3, "facts": seal["facts"] + 1}, "reader": reader, "climate": "warm"}
        for key, value in facts.items():
            row = (key, json.dumps(value))
            database.execute("INSERT OR REPLACE INTO hunt VALUES (?, ?, ?)", (*row, digest_of_row(row)))
        database.execute("PRAGMA user_version = 99")


def test_a_ledger_of_later_is_read_where_it_states_so_and_never_written(tmp_path):
    path = tmp_path / "ledger.sqlite"
    write(path)
    today = version(path)
    newer(path, reader=today)
    with closing(Ledger(path)) as ledger:
        assert ledger.facts()["climate"] == "warm"
        assert ledger.outcomes() == {"collision": 3, "finished": 2, "invalid": 1, "survived": 3}
        assert [trial.spec.number for trial in ledger.results()] == [0, 1, 2, 4, 5, 6, 7, 8, 9]
        assert ledger.result(4) == result(4)
        assert len(list(ledger.table())) == 9
    with pytest.raises(
        HuntDirectoryError, match=f"the ledger has version 99, but this crashhunt writes version {today}"
    ):
        Ledger(path, writable=True)
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("UPDATE trials SET mood = 0.4 WHERE number = 4")
    with (
        closing(Ledger(path)) as ledger,
        pytest.raises(HuntDirectoryError, match="trial 4 has changed since it was written"),
    ):
        list(ledger.results())


def test_a_ledger_of_later_that_asks_for_more_is_refused(tmp_path):
    path = tmp_path / "ledger.sqlite"
    write(path)
    newer(path, reader=98)
    for writable in (False, True):
        with pytest.raises(HuntDirectoryError, match="has version 99, but this crashhunt reads versions up to"):
            Ledger(path, writable=writable)


def test_what_trials_cost_besides_is_summed(tmp_path):
    path = tmp_path / "ledger.sqlite"
    write(path)
    with closing(Ledger(path, writable=True)) as ledger:
        ledger.record(replace(result(3), setup_steps=200, stress=Stress(1.0, steps=30)), snapshot="")
        ledger.record(replace(result(4), setup_steps=0, branches=Branches(steps=500)), snapshot="")
        ledger.note(failed_steps=7)
        assert (ledger.trial_steps(), ledger.steps_total()) == (45, 45 + 200 + 30 + 500 + 7)
    with closing(Ledger(path)) as ledger:
        assert ledger.steps_total() == 782
        assert [ledger.result(number).setup_steps for number in (2, 3, 4)] == [None, 200, 0]


def test_of_trials_as_dangerous_the_first_is_the_nearest_miss(tmp_path):
    with closing(Ledger(tmp_path / "ledger.sqlite", writable=True)) as ledger:
        for number, danger, ttc in ((0, None, 0.1), (2, 0.5, 9.0), (4, 0.75, 8.0), (6, 0.75, 2.0), (1, 1.0, 0.0)):
            closest = ClosestApproach(ttc, 1.0, 2.0)
            ledger.record(replace(result(number), danger=danger, closest=closest), snapshot="")
        assert ledger.nearest_miss().spec.number == 4
        ledger.replace([2, 4, 6])
        assert ledger.nearest_miss().spec.number == 0  # nobody measured it: by time to collision
