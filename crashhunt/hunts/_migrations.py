"""Ledgers of earlier versions become ledgers of this one, a version at a time, when somebody goes on with them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.base.integrity import digest_of_row
from crashhunt.hunts._ledger_schema import (
    DANGER_INDEX,
    EVENTS_INDEX,
    FIRST,
    OUTCOME_INDEX,
    PROPOSALS,
    VERSION,
    note_reader,
)

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Callable

__all__ = ["MIGRATIONS", "migrate"]


def _add_digests(database: sqlite3.Connection) -> None:
    """What is there now is what digests will vouch for."""
    database.create_function("digest_of_row", -1, lambda *values: digest_of_row(values), deterministic=True)
    for table, columns in FIRST.items():
        database.execute(f"ALTER TABLE {table} ADD COLUMN digest INTEGER NOT NULL DEFAULT 0")
        database.execute(f"UPDATE {table} SET digest = digest_of_row({', '.join(columns)})")


def _add_proposals(database: sqlite3.Connection) -> None:
    database.execute(PROPOSALS)
    database.execute(EVENTS_INDEX)
    note_reader(database)


def _add_danger(database: sqlite3.Connection) -> None:
    """Nobody measured the danger of what is there; a row that is not as it was written keeps a digest that says so."""
    database.create_function("digest_of_row", -1, lambda *values: digest_of_row(values), deterministic=True)
    database.execute("ALTER TABLE trials ADD COLUMN danger REAL")
    was = ", ".join(FIRST["trials"])
    database.execute(f"UPDATE trials SET digest = digest_of_row({was}, danger) WHERE digest = digest_of_row({was})")
    database.execute(DANGER_INDEX)


def _add_other_steps(database: sqlite3.Connection) -> None:
    """Of what is there, copies said how many steps they took; warm-ups did not, and nobody knows."""
    database.create_function("digest_of_row", -1, lambda *values: digest_of_row(values), deterministic=True)
    database.execute("ALTER TABLE trials ADD COLUMN other_steps INTEGER")
    was = ", ".join((*FIRST["trials"], "danger"))
    data = "iif(json_valid(result), result, '{}')"
    copies = " + ".join(f"coalesce(json_extract({data}, '$.{name}.steps'), 0)" for name in ("stress", "branches"))
    now = f"other_steps = {copies}, digest = digest_of_row({was}, {copies})"
    database.execute(f"UPDATE trials SET {now} WHERE digest = digest_of_row({was})")
    database.execute("DROP INDEX IF EXISTS trials_by_outcome")
    database.execute(OUTCOME_INDEX)


MIGRATIONS: dict[int, Callable[[sqlite3.Connection], None]] = {
    1: _add_digests,
    2: _add_proposals,
    3: _add_danger,
    4: _add_other_steps,
}
"""Version to what makes of a ledger of it one of the next.

A version may add tables, and columns at the end of a table, each with a value for the rows that are there. The digest
of a row is over all columns in the order of the table, so that versions before can check rows that have columns which
they do not know. A version that those before would read wrongly raises what it asks of whoever reads it.
"""


def migrate(database: sqlite3.Connection, version: int) -> None:
    """Bring the tables of an earlier version to this one: all the way, or not at all."""
    database.execute("BEGIN IMMEDIATE")
    try:
        for earlier in range(version, VERSION):
            MIGRATIONS[earlier](database)
        database.execute(f"PRAGMA user_version = {VERSION}")
        database.execute("COMMIT")
    except BaseException:
        if database.in_transaction:
            database.execute("ROLLBACK")
        raise
