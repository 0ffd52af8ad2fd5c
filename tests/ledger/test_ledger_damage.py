"""A ledger that is not as it was written: nobody gives out other numbers, and nobody ends in a traceback."""

from __future__ import annotations

import random
import shutil
import sqlite3
from contextlib import closing

import pytest
from conftest import examples

from crashhunt.errors import HuntDirectoryError
from crashhunt.ledger import Ledger
from crashhunt.trial import Outcome, TrialResult, TrialSpec
from crashhunt.world import ClosestApproach

OUTCOMES = (Outcome.SURVIVED, Outcome.COLLISION, Outcome.FINISHED, Outcome.INVALID)


def result(number: int) -> TrialResult:
    spec = TrialSpec(number, 7 * number, {"ego": {"speed": 1.5 + number}}, {"vehicles": number}, max_steps=20)
    closest = ClosestApproach(number / 3, 1.0, 2.0) if number % 3 else ClosestApproach()
    return TrialResult(spec, OUTCOMES[number % 4], steps=number, wall_s=0.1, closest=closest)


def written(path, count=60, *, close=True):
    ledger = Ledger(path, writable=True)
    for number in range(count + 1):
        ledger.record(result(number), snapshot="0123456789abcdef")
    ledger.replace([count])
    ledger.enter("all_trials", planned=count)
    if close:
        ledger.close()
    return ledger


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "ledger.sqlite"
    written(path)
    return path


@pytest.fixture
def copy(whole, tmp_path):
    shutil.copy(whole, tmp_path / "ledger.sqlite")
    return tmp_path / "ledger.sqlite"


READS = {
    "trials": lambda ledger: list(ledger.plain_results()),
    "results": lambda ledger: list(ledger.results()),
    "crashes": lambda ledger: list(ledger.results(outcomes=("collision",))),
    "table": lambda ledger: sorted(ledger.table()),
    "outcomes": Ledger.outcomes,
    "steps": Ledger.steps_total,
    "facts": Ledger.facts,
    "states": Ledger.events,
    "replaced": Ledger.replaced,
    "one": lambda ledger: ledger.result(5) or "no trial",
    "last": Ledger.last_ended_at,
}


def answers(path, reads=READS, *, writable=False):
    """What each read answers, None where it refuses."""
    found = {}
    for name, read in reads.items():
        try:
            with closing(Ledger(path, writable=writable)) as ledger:
                found[name] = read(ledger)
        except HuntDirectoryError as error:
            assert "\n" not in str(error)
            assert error.fix
            found[name] = None
    return found


def change(path, *statements):
    with closing(sqlite3.connect(path)) as database, database:
        for statement in statements:
            database.execute(statement)


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE trials SET outcome = 'survived' WHERE number = 5",
        "UPDATE trials SET seed = seed + 1 WHERE number = 5",
        "UPDATE trials SET steps = 6 WHERE number = 5",
        "UPDATE trials SET time_to_collision_s = 0.5 WHERE number = 5",
        "UPDATE trials SET result = replace(result, '6.5', '7.5') WHERE number = 5",
        "UPDATE trials SET digest = 1 WHERE number = 5",
        "UPDATE trials SET danger = 0.25 WHERE number = 5",
        "UPDATE trials SET other_steps = 30 WHERE number = 5",
        "DELETE FROM trials WHERE number = 5",
        "UPDATE trials SET number = 500 WHERE number = 5",
        "INSERT INTO trials SELECT 99, seed, outcome, steps, 1, 1, 1, 1, 1, '', result, 0, 0, 0 FROM trials LIMIT 1",
    ],
)
def test_no_trial_that_was_changed_is_given_out(whole, copy, statement):
    right = answers(whole)
    change(copy, statement)
    found = answers(copy)
    assert found["trials"] is None
    elsewhere = any(
        f"{name} =" in statement for name in ("result", "digest", "danger", "other_steps")
    )  # the table has none of them
    assert found["table"] is None or elsewhere
    assert found["table"] in (None, right["table"])
    for name in ("results", "crashes", "outcomes", "steps"):
        assert found[name] in (None, right[name]), name
    assert found["one"] in (None, right["one"]) or "SET number" in statement  # there are as many as before
    if "result" not in statement and "digest" not in statement:
        with pytest.raises(HuntDirectoryError, match="crashhunt check"):
            Ledger(copy, writable=True)


@pytest.mark.parametrize(
    ("statement", "says"),
    [
        (
            "ALTER TABLE trials DROP COLUMN digest",
            "the table trials differs from that of version 1 in the columns digest",
        ),
        ("ALTER TABLE hunt DROP COLUMN digest", "the table hunt differs from that of version 1 in the columns digest"),
        ("DROP TABLE events", "the table events of version 1 is missing"),
        ("DROP INDEX trials_by_outcome", "no such index"),
        ("PRAGMA user_version = 0", "its version is 0 of 63726831"),
        ("PRAGMA application_id = 9", "its version is 1 of 9"),
        ("DROP TABLE proposals", "the table proposals of version 1 is missing"),
        ("UPDATE hunt SET value = '61' WHERE key = 'planned'", "a fact has changed since it was written"),
        (
            "UPDATE hunt SET value = replace(value, '15', '16') WHERE key = 'seal'",
            "its seal has changed since it was written",
        ),
        ("UPDATE events SET detail = 'no disk'", "an entry on the state of the hunt has changed since it was written"),
        ("DELETE FROM events", "differ from those"),
        ("DELETE FROM replaced", "differ from those"),
        ("DELETE FROM hunt WHERE key = 'planned'", "differ from those"),
    ],
)
def test_tables_and_facts_that_were_changed_are_refused(copy, statement, says):
    change(copy, statement)
    with pytest.raises(HuntDirectoryError) as refused, closing(Ledger(copy)) as ledger:
        [read(ledger) for read in (Ledger.facts, Ledger.events, Ledger.replaced, Ledger.outcomes, READS["table"])]
    assert says in str(refused.value)
    assert f"crashhunt check {copy.parent}" in str(refused.value)


def test_any_damage_is_reported_or_changes_nothing(whole, tmp_path):
    generator = random.Random(10)
    right = answers(whole)
    data = whole.read_bytes()
    for _ in range(examples(60)):
        damage = bytearray(data)
        kind, place = generator.randrange(4), generator.randrange(len(data))
        if kind == 0:
            damage[place] ^= 1 << generator.randrange(8)
        elif kind == 1:
            damage = damage[:place]
        elif kind == 2:
            page = place // 4096 * 4096
            damage[page : page + 4096] = bytes(4096)
        else:
            damage[place : place + 20] = generator.randbytes(20)
        path = tmp_path / "ledger.sqlite"
        for name in ("-wal", "-shm"):
            path.with_name(path.name + name).unlink(missing_ok=True)
        path.write_bytes(damage)
        found = answers(path)
        wrong = [name for name in READS if found[name] is not None and found[name] != right[name]]
        assert not wrong, (kind, place)


def test_one_that_was_killed_is_read_whole(tmp_path):
    path = tmp_path / "ledger.sqlite"
    ledger = written(path, close=False)
    shutil.copytree(tmp_path, tmp_path / "killed")
    ledger.close()
    killed = tmp_path / "killed" / "ledger.sqlite"
    with closing(Ledger(killed)) as found:
        assert not found.sealed
        assert found.outcomes() == {str(outcome): 15 for outcome in sorted(OUTCOMES)}
        assert len(list(found.table())) == 60
    change(killed, "UPDATE trials SET steps = 6 WHERE number = 5")
    found = answers(killed)
    assert (found["trials"], found["table"], found["one"]) == (None, None, None)
    with closing(Ledger(killed)) as ledger:
        rows = list(ledger.intact_rows([4, 5, 6, 99]))
        assert [(number, row is None) for number, row in rows] == [(4, False), (5, True), (6, False)]
    with pytest.raises(HuntDirectoryError, match="trial 5 has changed since it was written"):
        Ledger(killed, writable=True)


def test_what_is_no_ledger_is_reported(tmp_path, copy):
    copy.write_text("my notes, which are long enough to be read as the header of a file " * 2)
    with pytest.raises(HuntDirectoryError, match="not a ledger of crashhunt"):
        Ledger(copy)
    # A write-ahead log of nobody knows what is not taken for ours.
    written(tmp_path / "other.sqlite")
    shutil.copy(tmp_path / "other.sqlite", copy)
    copy.with_name("ledger.sqlite-wal").write_bytes(b"x" * 5000)
    with closing(Ledger(copy)) as ledger:
        assert len(list(ledger.results())) == 60


def test_an_added_trial_is_sealed_with_the_others(copy):
    with closing(Ledger(copy, writable=True)) as ledger:
        assert not ledger.sealed
        ledger.record(result(60), snapshot="")
        ledger.replace([3])
        ledger.close()  # twice is once
    with closing(Ledger(copy)) as ledger:
        assert ledger.sealed
        assert "seal" not in ledger.facts()
        assert sum(ledger.outcomes().values()) == 60
        assert [trial.spec.number for trial in ledger.replaced()] == [60, 3]
        assert len(list(ledger.table())) == len(list(ledger.results())) == 60
