"""The ledger, fact by fact: what is counted, ranked, sealed, restored and refused."""

from __future__ import annotations

import math
import os
import sqlite3
import stat
from contextlib import closing
from dataclasses import replace

import pytest

from crashhunt.errors import HuntDirectoryError
from crashhunt.ledger import Ledger, Turn, _schema, has_begun
from crashhunt.trial import KILLED, Failure, Outcome, TrialResult, TrialSpec
from crashhunt.world import ClosestApproach


def result(number, outcome=Outcome.SURVIVED, *, ttc=3.0, steps=10, events=None):
    spec = TrialSpec(number, 7 * number, {"ego": {"speed": 1.5}}, {"vehicles": 3}, max_steps=20)
    return TrialResult(spec, outcome, steps=steps, wall_s=0.25, closest=ClosestApproach(ttc, 1.5, 2.5), events=events)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "ledger.sqlite"


@pytest.fixture
def ledger(path):
    ledger = Ledger(path, writable=True)
    yield ledger
    ledger.close()


def raw(path, query):
    with closing(sqlite3.connect(path)) as database, database:
        return database.execute(query).fetchall()


def test_a_row_has_what_ranks_it_next_to_its_text(ledger, path):
    ledger.record(result(3, Outcome.COLLISION, ttc=math.inf, steps=4), snapshot="abc")
    columns = "number, seed, outcome, steps, time_to_collision_s, gap_m, required_deceleration, wall_s, snapshot"
    (row,) = raw(path, f"SELECT {columns} FROM trials")
    assert row == (3, 21, "collision", 4, None, 1.5, 2.5, 0.25, "abc")
    assert ledger.snapshot_of(3) == "abc"
    assert ledger.snapshot_of(4) == ""
    assert ledger.result_text(4) is None
    assert ledger.result(3).closest.time_to_collision_s == math.inf
    (plain,) = ledger.plain_results()
    assert plain["outcome"] == "collision"
    assert list(ledger.table()) == [(3, 21, "collision", 4, None)]


def test_the_nearest_miss_is_the_least_of_both_ways_to_survive(ledger):
    assert ledger.nearest_miss() is None
    survived, finished = Outcome.SURVIVED, Outcome.FINISHED
    cases = (survived, 2.5, 0), (Outcome.COLLISION, 0.0, 0), (finished, 2.0, 2), (survived, 2.0, 2), (survived, 1.9, 4)
    for number, (outcome, ttc, nearest) in enumerate(cases):
        ledger.record(result(number, outcome, ttc=ttc), snapshot="")
        assert ledger.nearest_miss().spec.number == nearest


def test_endings_are_in_the_order_of_trials_and_name_what_was_killed(ledger):
    killed = replace(result(0, Outcome.INVALID), failure=Failure(KILLED, "out of memory"))
    random = replace(result(1), spec=replace(result(1).spec, origin="random"))
    for one in (result(2, Outcome.COLLISION), random, killed, result(5, Outcome.INVALID)):
        ledger.record(one, snapshot="")
    assert list(ledger.endings()) == [
        (0, 0, "invalid", "", True), (1, 7, "survived", "random", False), (2, 14, "collision", "", False),
        (5, 35, "invalid", "", False),
    ]  # fmt: skip


def test_what_is_replaced_is_moved_once(ledger):
    for number in range(3):
        ledger.record(result(number), snapshot="")
    assert ledger.replace([1]) == 1
    assert ledger.replace([1]) == 0
    assert ledger.replaced() == [result(1)]
    assert ledger.result(1) is None
    ledger.record(result(1, Outcome.HANG), snapshot="")
    assert ledger.replace([0, 1, 2]) == 3
    assert [found.spec.number for found in ledger.replaced()] == [1, 0, 1, 2]


def test_states_and_remarks_have_their_times(ledger):
    ledger.enter("running")
    ledger.remark("a worker died")
    ledger.enter("all_trials", "done", trials=4)
    found = ledger.events()
    assert [event[1:] for event in found] == [("running", ""), ("remark", "a worker died"), ("all_trials", "done")]
    assert found[0][0] <= found[1][0] <= found[2][0]
    assert ledger.facts() == {"state": "all_trials", "detail": "done", "trials": 4}
    ledger.note(trials=None, state="x")
    assert ledger.facts() == {"state": "x", "detail": "done"}
    ledger.enter("running")
    assert "detail" not in ledger.facts()


def test_a_ledger_that_was_removed_is_written_again(path, tmp_path):
    writer = Ledger(path, writable=True)
    writer.record(result(0), snapshot="")
    assert writer.restore() is False
    old = writer._database
    path.unlink()
    assert writer.restore() is True
    assert writer.restore() is False
    with pytest.raises(sqlite3.ProgrammingError, match="closed"):
        old.execute("SELECT 1")
    assert writer._database.execute("PRAGMA journal_mode").fetchone() == ("wal",)
    writer.record(result(1), snapshot="")
    with closing(Ledger(path)) as reader:
        assert reader.finished() == {0, 1}
    path.unlink()
    path.write_text("another")
    with pytest.raises(HuntDirectoryError, match="another file replaced the ledger"):
        writer.restore()
    path.unlink()
    moved = tmp_path.rename(f"{tmp_path}-moved")
    try:
        with pytest.raises(HuntDirectoryError, match=r"the folder does not exist|cannot be written again"):
            writer.restore()
    finally:
        moved.rename(tmp_path)
    writer.close()


def test_what_sqlite_states_is_said_in_our_words(path, monkeypatch, tmp_path):
    with pytest.raises(HuntDirectoryError, match="is not the directory of a hunt") as caught:
        Ledger(path)
    assert "give the directory" in caught.value.fix
    assert not has_begun(path)
    with pytest.raises(HuntDirectoryError, match="the folder does not exist"):
        Ledger(tmp_path / "gone" / "ledger.sqlite", writable=True)
    path.mkdir()
    for writable in (False, True):
        with pytest.raises(HuntDirectoryError, match="a folder is where the file should be"):
            Ledger(path, writable=writable)
    path.rmdir()
    Ledger(path, writable=True).close()
    assert has_begun(path)
    with closing(sqlite3.connect(path, isolation_level=None)) as busy:
        ledger = Ledger(path, writable=True)
        ledger._database.execute("PRAGMA busy_timeout = 1")
        ledger.record(result(0), snapshot="")
        monkeypatch.setattr(_schema, "_BUSY_S", 0.0)
        busy.execute("BEGIN IMMEDIATE")
        for act in (
            lambda: ledger.record(result(0), snapshot=""),
            lambda: ledger.note(x=1),
            lambda: ledger.remark("x"),
            lambda: ledger.replace([0]),
        ):
            with pytest.raises(HuntDirectoryError, match="another program keeps it busy"):
                act()
        busy.execute("ROLLBACK")
        ledger.close()
    if os.getuid():
        path.chmod(0)
        with pytest.raises(HuntDirectoryError, match="may not be read"):
            Ledger(path)
        path.chmod(stat.S_IRUSR | stat.S_IWUSR)


@pytest.mark.parametrize(
    "act",
    [
        lambda ledger: ledger.record(result(1), snapshot=""),
        lambda ledger: ledger.note(detail="x"),
        lambda ledger: ledger.remark("x"),
        lambda ledger: ledger.replace([0]),
        lambda ledger: ledger.propose([Turn((), result(2).spec)]),
        lambda ledger: ledger.close(),
    ],
)
def test_writer_waits_while_a_backup_locks_the_ledger(path, monkeypatch, act):
    monkeypatch.setattr(_schema, "_LOOK_EVERY_S", 0.001)
    Ledger(path, writable=True).close()
    with closing(sqlite3.connect(path, isolation_level=None)) as backup:
        with closing(Ledger(path, writable=True)) as ledger:
            waited = []

            def wait(waited_s):
                waited.append(waited_s)
                if len(waited) == 3:
                    backup.execute("ROLLBACK")

            ledger.wait_while_locked(wait)
            with ledger.together():
                ledger.record(result(0), snapshot="")
            backup.execute("BEGIN EXCLUSIVE")
            act(ledger)
            assert len(waited) == 3
            assert waited == sorted(waited)
        with closing(Ledger(path)) as reader:
            assert 0 in reader.finished() or reader.replaced_count() == 1


def test_writer_may_wait_while_a_backup_locks_the_ledger_that_it_opens(path, monkeypatch):
    monkeypatch.setattr(_schema, "_LOOK_EVERY_S", 0.001)
    monkeypatch.setattr(_schema, "_BUSY_S", 0.0)
    Ledger(path, writable=True).close()
    with closing(sqlite3.connect(path, isolation_level=None)) as backup:
        backup.execute("BEGIN EXCLUSIVE")
        with pytest.raises(HuntDirectoryError, match="another program keeps it busy"):
            Ledger(path, writable=True)
        Ledger(path, writable=True, wait=lambda _: backup.execute("ROLLBACK")).close()


def test_writer_of_trials_may_stop_waiting_and_loses_no_earlier_one(path, monkeypatch):
    monkeypatch.setattr(_schema, "_LOOK_EVERY_S", 0.001)
    ledger = Ledger(path, writable=True)
    ledger.record(result(0), snapshot="")
    with closing(sqlite3.connect(path, isolation_level=None)) as backup:
        backup.execute("BEGIN EXCLUSIVE")

        def wait(waited_s):
            raise HuntDirectoryError("locked for too long")

        ledger.wait_while_locked(wait)
        with pytest.raises(HuntDirectoryError, match="locked for too long"), ledger.together():
            ledger.record(result(1), snapshot="")
        backup.execute("ROLLBACK")
        assert ledger.finished() == {0}
        ledger.record(result(1), snapshot="")
        assert ledger.finished() == {0, 1}
        ledger.close()


def test_reads_are_the_same_in_pieces(path, monkeypatch):
    with closing(Ledger(path, writable=True)) as writer:
        for number in range(10):
            writer.record(
                result(number, Outcome.COLLISION if number % 3 else Outcome.FINISHED, ttc=5.0 - number / 3), snapshot=""
            )
    with closing(Ledger(path)) as reader:
        whole = list(reader.table())
        monkeypatch.setattr("crashhunt.ledger._reader._CHUNK_ROWS", 3)
        assert list(reader.table()) == whole
        assert sorted(whole)[4] == (4, 28, "collision", 10, 5.0 - 4 / 3)


def test_a_full_disk_is_reported_of_and_what_was_written_stays(path):
    ledger = Ledger(path, writable=True)
    ledger.record(result(0), snapshot="")
    pages = ledger._database.execute("PRAGMA page_count").fetchone()[0]
    ledger._database.execute(f"PRAGMA max_page_count = {pages}")
    with pytest.raises(HuntDirectoryError, match="the disk is full") as caught:
        ledger.record(result(1), snapshot="x" * 100_000)
    assert "free some space" in caught.value.fix
    with pytest.raises(HuntDirectoryError, match="the disk is full"):
        ledger.note(long="x" * 100_000)
    ledger._database.execute("PRAGMA max_page_count = 100000")
    ledger.note(state="error")
    ledger.close()
    with closing(Ledger(path)) as reader:
        assert reader.result(0) == result(0)
        assert reader.facts() == {"state": "error"}


def test_how_lasting_it_is(path):
    ledger = Ledger(path, writable=True)

    def pragma(name):
        return ledger._database.execute(f"PRAGMA {name}").fetchone()[0]

    assert (pragma("journal_mode"), pragma("synchronous")) == ("wal", 1)
    ledger.note(a=1)
    ledger.enter("running")
    assert pragma("synchronous") == 1  # as cheap as before, once it has waited for the disk
    ledger.close()
    # A log of what was there before is none of the new file's.
    path.unlink()
    path.with_name(f"{path.name}-wal").write_bytes(b"x" * 4096)
    with closing(Ledger(path, writable=True)) as again:
        assert again.facts() == {}


def test_damaged_pages_are_found(path):
    with closing(Ledger(path, writable=True)) as writer:
        for number in range(200):
            writer.record(result(number), snapshot="")
    with closing(Ledger(path)) as reader:
        reader.check_pages()
    data = bytearray(path.read_bytes())
    page = 4096 * (len(data) // 4096 // 2)
    data[page : page + 200] = bytes(200)
    path.write_bytes(data)
    with closing(Ledger(path)) as reader, pytest.raises(HuntDirectoryError, match="the ledger is damaged"):
        reader.check_pages()


def test_turns_with_a_sampler_are_kept_in_their_order(path):
    ledger = Ledger(path, writable=True)
    turns = [Turn((), result(4).spec), Turn((4,), result(2).spec), Turn((), result(7).spec)]
    assert list(ledger.turns()) == []
    ledger.propose(turns[:2])
    ledger.propose([])
    assert list(ledger.turns()) == turns[:2]
    with pytest.raises(HuntDirectoryError):
        ledger.propose([Turn((2,), result(8).spec), Turn((), result(4).spec)])  # a trial is proposed once
    ledger.close()
    with closing(Ledger(path, writable=True)) as again:
        assert list(again.turns()) == turns[:2]  # all of a call or nothing
        again.propose(turns[2:])
        assert list(again.turns()) == again.intact_turns() == turns
    assert raw(path, "SELECT turn, number FROM proposals ORDER BY turn") == [(1, 4), (2, 2), (3, 7)]
    raw(path, "UPDATE proposals SET told = '[5]' WHERE turn = 2")
    with closing(Ledger(path)) as reader:
        with pytest.raises(HuntDirectoryError, match="damaged"):
            list(reader.turns())
        assert reader.intact_turns() == [turns[0], turns[2]]
    raw(path, "DELETE FROM proposals WHERE turn = 3")
    with closing(Ledger(path)) as reader, pytest.raises(HuntDirectoryError, match="damaged"):
        list(reader.turns())
    with pytest.raises(HuntDirectoryError, match="damaged"):
        Ledger(path, writable=True)
