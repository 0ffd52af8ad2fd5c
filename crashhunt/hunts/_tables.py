"""Trials as tables in files: CSV, JSON, JSON lines and Parquet, written row by row."""

from __future__ import annotations

import csv
import json
from itertools import islice
from typing import IO, TYPE_CHECKING

from crashhunt.base.errors import UsageError
from crashhunt.base.files import whole_file
from crashhunt.base.temporary import temporary_beside, temporary_name
from crashhunt.trial import EVENTS

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from crashhunt.hunts._results import HuntResults
    from crashhunt.hunts._row import Cell

__all__ = ["write_parquet", "write_text"]

_LOOKED_AT = 1000  # rows, to find out the type of an argument of which nobody says it


def write_text(hunt: HuntResults, out: IO[str], form: str, *, outcomes: Sequence[str] = ()) -> int:
    """Write the trials of a hunt as text; return how many.

    Args:
        hunt: whose.
        out: where.
        form: ``csv``, ``json`` (one array) or ``jsonl`` (an object per line).
        outcomes: only those; empty for all.
    """
    names = hunt.columns
    count = 0
    if form == "csv":
        writer = csv.writer(out)
        writer.writerow(names)
        for row in hunt.rows(outcomes=outcomes):
            writer.writerow([_cell(value) for value in row.values()])
            count += 1
        return count
    opening, between, closing = ("[\n", ",\n", "\n]\n") if form == "json" else ("", "\n", "\n")
    out.write(opening)
    for row in hunt.rows(outcomes=outcomes):
        out.write((between if count else "") + json.dumps(row))
        count += 1
    out.write(closing if count or form == "json" else "")
    return count


def write_parquet(hunt: HuntResults, path: Path, *, outcomes: Sequence[str] = ()) -> int:
    """Write the trials of a hunt as a Parquet file; return how many.

    Raises:
        UsageError: polars is not installed.
    """
    try:
        # Not pyarrow: libsumo brings an Arrow of its own along, and warns of every other in the same environment.
        import polars as pl
    except ImportError:
        raise UsageError("Parquet needs polars", fix="pip install 'crashhunt[parquet]', or give csv") from None
    kinds = _kinds(hunt, list(islice(hunt.rows(outcomes=outcomes), _LOOKED_AT)))
    schema = {name: getattr(pl, kind) for name, kind in kinds.items()}
    with (
        whole_file(path) as temporary,
        temporary_beside(path, name=temporary_name(path, ".csv")) as plain,
        plain.open("w", encoding="utf-8", newline="") as table,
    ):
        count = write_text(hunt, table, "csv", outcomes=outcomes)
        table.flush()
        pl.scan_csv(plain, schema=schema).sink_parquet(temporary)
    return count


def _kinds(hunt: HuntResults, batch: list[dict[str, Cell]]) -> dict[str, str]:
    """The type of each column, which a row group cannot find out by itself."""
    settings = hunt.settings
    specs = {f"scenario.{name}": spec for name, spec in settings.scenario_arguments.items()}
    for agent, chosen in settings.agents.items():
        specs |= {f"{agent}.{name}": spec for name, spec in chosen.arguments.items()}
    known = {"int": "Int64", "float": "Float64", "bool": "Boolean", "str": "String"}
    kinds = {"number": "Int64", "seed": "Int64", "steps": "Int64", "outcome": "String", "digest": "String"}
    kinds |= dict.fromkeys(EVENTS, "Int64")
    kinds |= {"parent": "Int64", "origin": "String", "disturbances": "Int64"}
    kinds |= {"stress_asked": "String", "branches_asked": "String"}
    columns = hunt.columns
    for name in columns:
        kind = specs[name].kind if name in specs else "float"
        if kind is None:  # the agent does not say; what was tried first does
            numeric = all(isinstance(row[name], int | float | None) for row in batch)
            kind = "float" if numeric else "str"
        kinds.setdefault(name, known[kind])
    return {name: kinds[name] for name in columns}


def _cell(value: Cell) -> Cell:
    if isinstance(value, bool):
        return str(value).lower()
    return "" if value is None else value
