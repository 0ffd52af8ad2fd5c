"""What is read of a ledger besides whole trials, and how its file is opened, migrated and explained."""

from __future__ import annotations

import errno
import json
import os
import resource
import sqlite3
import threading
from contextlib import closing, suppress
from types import SimpleNamespace

import pytest

from crashhunt.base.integrity import digest_of_row
from crashhunt.errors import HuntDirectoryError
from crashhunt.ledger import Ledger, Turn, _schema, _writer
from crashhunt.trial import KILLED, Disturbance, Failure, Outcome, Stress, TrialResult, TrialSpec


def result(number, outcome=Outcome.SURVIVED, *, steps=10, origin="", **more):
    spec = TrialSpec(number, 7 * number, {"ego": {"speed": 1.5}}, {"vehicles": 3}, max_steps=20, origin=origin)
    return TrialResult(spec, outcome, steps=steps, wall_s=0.25, **more)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "ledger.sqlite"


@pytest.fixture
def ledger(path):
    ledger = Ledger(path, writable=True)
    yield ledger
    ledger.close()


def write(ledger, *results):
    for one in results:
        ledger.record(one, snapshot="s")


def spoil(path, number, text):
    """Write another text into a row, with a digest that fits."""
    columns = _schema.COLUMNS["trials"]
    with closing(sqlite3.connect(path)) as database, database:
        (row,) = database.execute(f"SELECT {', '.join(columns)} FROM trials WHERE number = ?", (number,))
        row = tuple(text if name == "result" else value for name, value in zip(columns, row, strict=True))
        values = (text, digest_of_row(row), number)
        database.execute("UPDATE trials SET result = ?, digest = ? WHERE number = ?", values)


# Trials are counted and ranked by parts of their rows.


def test_outcomes_have_their_trials_and_the_range_of_their_steps(ledger):
    assert ledger.steps_by_outcome() == {}
    write(ledger, result(0, steps=4), result(1, steps=9), result(2, steps=6), result(3, Outcome.HANG, steps=2))
    assert ledger.steps_by_outcome() == {"survived": (3, 4, 9), "hang": (1, 2, 2)}


def test_parts_of_a_hunt_have_the_trials_of_one_outcome(ledger):
    write(ledger, *(result(number, steps=number) for number in range(7)), result(8, Outcome.HANG, steps=50))
    assert sorted(ledger.parts_of(3, "survived")) == [(0, 3, 3), (1, 3, 12), (2, 1, 6)]
    assert list(ledger.parts_of(3, "hang")) == [(2, 1, 50)]


def test_trials_of_a_range_have_both_ends(ledger):
    write(ledger, *(result(number, steps=number + 1) for number in (5, 1, 3, 2)))
    assert list(ledger.ended_between(2, 5)) == [(2, "survived", 3), (3, "survived", 4), (5, "survived", 6)]
    assert list(ledger.ended_between(4, 4)) == []


def test_numbers_are_in_order_over_several_outcomes(ledger):
    outcomes = (Outcome.HANG, Outcome.SURVIVED, Outcome.COLLISION)
    write(ledger, *(result(number, outcomes[number % 3]) for number in range(7)))
    assert ledger.numbers_of(["survived", "hang"]) == [0, 1, 3, 4, 6]
    assert ledger.numbers_of([]) == []
    assert ledger.last_number() == 6
    assert ledger.replaced_count() == 0
    ledger.replace([6, 2])
    assert (ledger.last_number(), ledger.replaced_count()) == (5, 2)


def test_killed_trials_are_found_from_a_number_on(ledger):
    killed = Failure(KILLED, "out of memory")
    for number in (0, 3, 4):
        write(ledger, result(number, Outcome.INVALID, failure=killed))
    write(ledger, result(1, Outcome.INVALID), result(2, Outcome.PROCESS_DIED, failure=killed))
    assert ledger.killed_numbers() == [0, 3, 4]
    assert ledger.killed_numbers(3) == [3, 4]
    assert ledger.killed_numbers(5) == []


def test_plain_trial_is_the_trial_and_a_changed_one_is_refused(ledger, path):
    write(ledger, result(0), result(1))
    assert ledger.plain_trial(1) == result(1).to_json()
    assert json.loads(ledger.result_text(1)) == result(1).to_json()
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("UPDATE trials SET result = replace(result, '1.5', '2.5') WHERE number = 1")
    for read in (ledger.plain_trial, ledger.result_text, ledger.snapshot_of):
        with pytest.raises(HuntDirectoryError, match="trial 1 has changed"):
            read(1)
    with pytest.raises(HuntDirectoryError, match="trial 1 has changed"):
        ledger.last_ended_at()


def test_trials_by_a_condition_are_in_the_order_of_their_numbers(ledger):
    write(ledger, result(3, steps=5), result(1, steps=7), result(2, steps=9))
    assert list(ledger.results_where("steps < ?", 8)) == [result(1, steps=7), result(3, steps=5)]
    assert [data["steps"] for data in ledger.plain_results_where("steps BETWEEN ? AND ?", 7, 9)] == [7, 9]


def test_time_of_the_last_trial_is_that_of_its_row(ledger, monkeypatch):
    for number, now in ((2, 50.0), (1, 60.0)):
        monkeypatch.setattr("time.time", lambda now=now: now)
        write(ledger, result(number))
    assert ledger.last_ended_at() == 50.0  # of the greatest number


def test_nearest_trial_of_equal_ones_is_the_first_and_crashes_do_not_count(ledger):
    dangers = [(0, 0.5), (1, 0.9), (2, 0.9), (3, 0.0), (4, None)]
    write(ledger, *(result(number, danger=danger) for number, danger in dangers))
    write(ledger, result(5, Outcome.FINISHED, danger=0.7), result(6, Outcome.COLLISION, danger=1.0))
    assert ledger.most_dangerous(9) == [1, 2, 5, 0]
    assert ledger.most_dangerous(2) == [1, 2]
    assert ledger.nearest_miss().spec.number == 1


# Sums over the data of trials.


def test_sums_skip_what_has_no_value_and_what_cannot_be_read(ledger, path):
    margins = (0.5, None, 2.0, 4.0)
    write(ledger, *(result(number, stress=Stress(margin, steps=3)) for number, margin in enumerate(margins)))
    write(ledger, result(4), result(5, stress=Stress(64.0)))
    spoil(path, 5, "no JSON")
    query = "SELECT number, {stress.margin} AS margin, {stress.steps} AS steps"
    assert ledger.summed("count(margin), total(margin), total(steps)", query) == [(3, 6.5, 12.0)]
    assert ledger.summed("number", "SELECT number, {stress.margin} AS margin") == [(n,) for n in range(6)]


def test_likeliest_disturbed_crash_is_one_with_disturbances_and_a_crash(ledger):
    assert ledger.disturbed_crashes(("collision", "hang")) == (0, None)
    some = (Disturbance(5, "ahead", "brake", 4.0, 0.5, "ego", "other"),)
    write(
        ledger,
        result(0, Outcome.COLLISION, log_likelihood=-1.0),
        result(1, Outcome.COLLISION, disturbances=some, log_likelihood=-9.0),
        result(2, Outcome.HANG, disturbances=some, log_likelihood=-4.0),
        result(3, disturbances=some, log_likelihood=-2.0),
    )
    assert ledger.disturbed_crashes(("collision", "hang")) == (2, (2, "hang", -4.0))
    assert ledger.disturbed_crashes(("collision",)) == (1, (1, "collision", -9.0))
    assert ledger.disturbed_crashes(("off_road",)) == (0, None)


def test_origins_have_their_trials_criticality_and_crashes(ledger):
    write(
        ledger,
        result(0, origin="climb", danger=0.25),
        result(1, origin="climb"),
        result(2, Outcome.COLLISION, origin="climb"),
        result(3, origin="random", danger=0.5),
        result(4, danger=0.75),
    )
    assert sorted(ledger.tried_by_origin(("collision",))) == [("climb", 3, 2, 1.25, 1), ("random", 1, 1, 0.5, 0)]


# A reader sees one state, and a writer may come at any time.


def test_reads_of_one_moment_show_one_state(ledger, path):
    write(ledger, result(0))
    with closing(Ledger(path)) as reader:
        with reader.one_moment():
            assert reader.finished() == {0}
            write(ledger, result(1))
            assert reader.finished() == {0}
        assert reader.finished() == {0, 1}
        with suppress(KeyError), reader.one_moment():
            reader.last_number()
            raise KeyError
        assert not reader._database.in_transaction
        with reader.one_moment():
            reader._database.execute("ROLLBACK")


READS = {
    "outcomes": Ledger.outcomes,
    "trials": lambda reader: list(reader.plain_results()),
    "table": lambda reader: list(reader.table()),
    "steps": Ledger.steps_total,
    "facts": Ledger.facts,
    "turns": lambda reader: list(reader.turns()),
    "events": Ledger.events,
    "replaced": Ledger.replaced,
}


@pytest.mark.parametrize("read", READS.values(), ids=READS)
def test_writer_that_comes_during_a_read_is_no_damage(path, monkeypatch, read):
    with closing(Ledger(path, writable=True)) as first:
        write(first, result(0), result(5))
        first.note(a=1)
    writers = []
    with closing(Ledger(path)) as reader:
        seal = reader._seal

        def come():
            found = seal()
            if not writers:
                writers.append(Ledger(path, writable=True))
                write(writers[0], result(1, steps=3))
                writers[0].enter("x", b=1)
                writers[0].replace([5])
                writers[0].propose([Turn((), result(2).spec)])
            return found

        monkeypatch.setattr(reader, "_seal", come)
        read(reader)
        assert not reader.sealed
    writers[0].close()


def test_contents_that_contradict_their_digest_or_their_form_are_damage(path):
    with closing(Ledger(path, writable=True)) as writer:
        write(writer, result(0), result(1), result(2))
        writer.propose([Turn((0,), result(3).spec), Turn((), result(4).spec)])
    spoil(path, 1, '{"outcome": "survived"}')
    with closing(sqlite3.connect(path)) as database, database:
        row = (2, 4, "[", "{}")
        database.execute(
            "UPDATE proposals SET told = '[', spec = '{}', digest = ? WHERE turn = 2", (digest_of_row(row),)
        )
    with closing(Ledger(path)) as reader:
        for read in (lambda: reader.result(1), lambda: list(reader.results())):
            with pytest.raises(HuntDirectoryError, match="damaged: a trial cannot be read"):
                read()
        with pytest.raises(HuntDirectoryError, match="damaged: a proposal cannot be read"):
            list(reader.turns())
        assert reader.intact_turns() == [Turn((0,), result(3).spec)]


# How the file is opened.


def files(path):
    return sorted(file.name for file in path.parent.iterdir())


@pytest.mark.parametrize("how", ["asked", "inside"])
def test_ledger_of_another_user_is_read_without_a_trace(path, how):
    with closing(Ledger(path, writable=True)) as writer:
        write(writer, result(0))
    was = path.read_bytes(), files(path)

    def read():
        with closing(Ledger(path, read_only=how == "asked")) as reader:
            assert reader.finished() == {0}
            assert files(path) == ["ledger.sqlite"]
            with pytest.raises(sqlite3.OperationalError, match="readonly"):
                reader._database.execute("DELETE FROM trials")

    if how == "asked":
        read()
    else:
        with _schema.leave_untouched():
            assert _schema.is_untouched()
            read()
            with closing(Ledger(path, writable=True)) as writer:  # the own hunt is written all the same
                writer.note(a=1)
        was = path.read_bytes(), files(path)
    assert not _schema.is_untouched()
    assert (path.read_bytes(), files(path)) == was
    with closing(Ledger(path)) as reader:
        assert reader.finished() == {0}
        reader._database.execute("CREATE TABLE t (a)")  # it is not opened read-only


def test_ledger_on_a_full_disk_is_read(path, monkeypatch):
    """SQLite could not create its files next to it, so `crashhunt check` called an intact ledger damaged."""
    with closing(Ledger(path, writable=True)) as writer:
        write(writer, result(0))
    monkeypatch.setattr(os, "statvfs", lambda _: SimpleNamespace(f_blocks=9, f_bavail=0))
    with closing(Ledger(path)) as reader:
        assert (reader.finished(), files(path)) == ({0}, ["ledger.sqlite"])


def test_untouched_reader_sees_what_a_running_hunt_has_written(ledger, path):
    write(ledger, result(0))
    assert _schema.has_content(path.with_name("ledger.sqlite-wal"))
    with closing(Ledger(path, read_only=True)) as reader:
        assert reader.finished() == {0}
        write(ledger, result(1))
        assert reader.finished() == {0, 1}


@pytest.mark.parametrize("read_only", [False, True])
def test_ledger_is_used_by_several_threads(ledger, path, read_only):
    write(ledger, result(0))
    found = []
    with closing(Ledger(path, read_only=read_only)) as reader:
        thread = threading.Thread(target=lambda: found.append(reader.finished()))
        thread.start()
        thread.join()
    assert found == [{0}]


def test_reader_of_an_open_ledger_does_not_seal_it(path):
    writer = Ledger(path, writable=True)
    write(writer, result(0))
    Ledger(path).close()
    assert not writer.sealed
    writer._database.close()  # as a kill does
    Ledger(path).close()
    with closing(Ledger(path)) as reader:
        assert not reader.sealed


def test_ledger_that_is_refused_is_closed(path, monkeypatch):
    Ledger(path, writable=True).close()
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("DROP TABLE events")
    made = []
    monkeypatch.setattr(
        _writer, "opened", lambda *words, **more: made.append(_schema.opened(*words, **more)) or made[0]
    )
    with pytest.raises(HuntDirectoryError, match="the table events"):
        Ledger(path)
    with pytest.raises(sqlite3.ProgrammingError, match="closed"):
        made[0].execute("SELECT 1")


# How records become lasting.


def test_facts_are_written_together_and_wait_for_the_disk(ledger):
    said = []
    ledger._database.set_trace_callback(lambda text: said.append(" ".join(text.split()[:4])))
    ledger.note(a=1, b=None)
    ledger.remark("x")
    ledger._database.set_trace_callback(None)
    full, normal = "PRAGMA synchronous = FULL", "PRAGMA synchronous = NORMAL"
    assert said == [
        full, "BEGIN", "INSERT OR REPLACE INTO", "DELETE FROM hunt WHERE", "COMMIT", normal,
        full, "BEGIN", "INSERT INTO events VALUES", "COMMIT", normal,
    ]  # fmt: skip


def test_trials_are_replaced_all_or_none(ledger, path):
    write(ledger, result(0), result(1), result(2))
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("UPDATE trials SET seed = 99 WHERE number = 1")
    with pytest.raises(HuntDirectoryError, match="trial 1 has changed"):
        ledger.replace([0, 1, 2])
    assert ledger.finished() == {0, 1, 2}
    assert ledger.replaced() == []
    assert ledger.replace([2, 0]) == 2


def test_records_in_records_are_refused_in_our_words(ledger):
    with ledger.together(), pytest.raises(HuntDirectoryError, match="within a transaction"), ledger.together():
        pass
    write(ledger, result(0))
    assert ledger.finished() == {0}


def test_copied_row_has_the_columns_of_today(ledger, tmp_path):
    write(ledger, result(0, danger=0.5))
    (_, row) = next(ledger.intact_rows([0]))
    with closing(Ledger(tmp_path / "other.sqlite", writable=True)) as other:
        for count in (len(row), len(row) + 2):
            other.copy((*row, "later", "later")[:count])
            assert other.result(0).spec == result(0).spec
            (columns,) = other._database.execute("SELECT danger, other_steps FROM trials")
            assert columns == (*row[11:count], None, None)[:2]


# Versions.


def test_columns_in_another_order_are_named_so(path):
    Ledger(path, writable=True).close()
    with closing(sqlite3.connect(path)) as database, database:
        for old, new in (("state", "x"), ("detail", "state"), ("x", "detail")):
            database.execute(f"ALTER TABLE events RENAME COLUMN {old} TO {new}")
    with pytest.raises(HuntDirectoryError, match=r"the table events differs .* in the order of the columns"):
        Ledger(path)


def test_ledger_of_later_without_a_word_on_readers_is_refused(path):
    Ledger(path, writable=True).close()
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("DELETE FROM hunt WHERE key = 'reader'")
        database.execute("PRAGMA user_version = 99")
    with pytest.raises(HuntDirectoryError, match="reads versions up to"):
        Ledger(path)


# What SQLite reports.


@pytest.mark.parametrize(
    ("text", "says", "fix"),
    [
        ("database or disk is full", "the disk is full (database or disk is full)", "free some space"),
        ("disk I/O error", "the disk is full", "free some space"),
        ("database is locked", "another program keeps it busy", "close what has it open"),
        ("unable to open database file", "the folder is not writable", "choose another folder"),
        ("attempt to write a readonly database", "the folder is not writable", "choose another folder"),
        ("file is not a database", "not a ledger of crashhunt", "crashhunt check"),
        ("malformed\n database", "the ledger is damaged: malformed database", "crashhunt check"),
    ],
)
def test_error_of_sqlite_has_a_cause_and_a_fix(path, monkeypatch, text, says, fix):
    monkeypatch.setattr(resource, "getrlimit", lambda which: (resource.RLIM_INFINITY,) * 2)
    found = _schema._explanation(path, sqlite3.OperationalError(text))
    assert says in str(found)
    assert fix in found.fix
    assert found.where == str(path)


def test_limit_on_the_size_of_files_is_not_taken_for_a_full_disk(path, monkeypatch):
    monkeypatch.setattr(
        resource, "getrlimit", lambda which: (1 << 20, 1 << 20) if which == resource.RLIMIT_FSIZE else ()
    )
    found = _schema._explanation(path, sqlite3.OperationalError("disk I/O error"))
    assert "cannot be written (disk I/O error), because the limit on the size of a file is 1 MiB" in found.message
    assert found.fix == "raise it with ulimit -f"


def test_limit_on_open_files_is_not_taken_for_a_folder_that_is_not_writable(path, monkeypatch):
    monkeypatch.setattr(_schema, "error_of_next_files", lambda count: OSError(errno.EMFILE, "Too many open files"))
    monkeypatch.setattr(resource, "getrlimit", lambda which: (7, 7))
    found = _schema._explanation(path, sqlite3.OperationalError("unable to open database file"))
    assert found.message == "cannot be opened (Too many open files)"
    assert found.fix == "the limit on open files is 7: raise it with ulimit -n"


def test_file_that_cannot_be_opened_is_a_folder_or_forbidden_or_has_no_folder(path, monkeypatch):
    error = sqlite3.OperationalError("unable to open database file")

    def explained():
        return str(_schema._explanation(path, error))

    path.write_text("x")
    assert "is not writable" in explained()
    monkeypatch.setattr(os, "access", lambda place, mode: (place, mode) != (path, os.R_OK))
    assert "it may not be read" in explained()
    path.unlink()
    assert "the folder is not writable" in explained()
    path.parent.rmdir()
    assert "the folder does not exist" in explained()
    path.mkdir(parents=True)
    assert "a folder is where the file should be" in explained()
