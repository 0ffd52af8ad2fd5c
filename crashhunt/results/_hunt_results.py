"""The results of hunts on disk, as objects: ``crashhunt.load(directory)``."""

from __future__ import annotations

import csv
import json
import warnings
from contextlib import closing, suppress
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np

from crashhunt.base import layout
from crashhunt.base.calls import clear_calls
from crashhunt.base.errors import BundleError, HuntDirectoryError, UntrustedError, UsageError
from crashhunt.base.extras import install_command
from crashhunt.base.files import output_file
from crashhunt.base.temporary import temporary_beside, temporary_folder, temporary_name
from crashhunt.base.text import count_of, one_of, out_of
from crashhunt.crashes import (
    Bundle,
    crash_folders,
    describe_code,
    is_hunt_trusted,
    list_bundles,
    preventable_by,
    read_bundle,
)
from crashhunt.episode import Parts, WorkerSettings
from crashhunt.ledger import Ledger, has_begun
from crashhunt.plans import HuntSettings, read_settings, with_settings
from crashhunt.results._code_versions import CodeVersions
from crashhunt.results._hunt_state import HuntState, draws_independently, find_hunts, hunt_state
from crashhunt.results._trial_table import (
    BRANCHES,
    CODE_VERSION,
    DISTURBANCES,
    ORIGINS,
    PREVENTABLE,
    STRESS,
    Cell,
    TrialRow,
    columns_of,
)
from crashhunt.snapshots import Snapshot, latest_snapshot
from crashhunt.trial import EVENTS

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray
    from pandas import DataFrame

    from crashhunt.agents import Agent
    from crashhunt.ledger import Facts
    from crashhunt.scenario import Scenario
    from crashhunt.trial import TrialResult

_JUDGED = b'"drivers"'  # the key of a judgement with answers of competent drivers


class IncompleteHuntWarning(UserWarning):
    """Warning that a loaded hunt or suite has not finished."""


class HuntResults:
    """The results of a finished or running hunt.

    Raises:
        HuntDirectoryError: the directory contains no hunt.
    """

    def __init__(self, directory: Path | str) -> None:
        self.directory = Path(directory)
        self.state: HuntState = hunt_state(self.directory)

    def __repr__(self) -> str:
        state = self.state
        return (
            f"<hunt {str(self.directory)!r}: {state.state}, {out_of(state.trials_run, state.trials_planned)} trials, "
            f"{count_of(state.crashes, 'crash')}>"
        )

    @cached_property
    def settings(self) -> HuntSettings:
        """The settings of the hunt.

        Raises: HuntDirectoryError: hunt.toml is missing or damaged, or the ledger belongs to another hunt.
        """
        settings = read_settings(self.directory / layout.HUNT)
        if not has_begun(self.directory / layout.LEDGER):
            return settings
        seed = self.facts.get("hunt_seed", settings.seed)
        if seed != settings.seed:
            raise HuntDirectoryError(
                f"hunt.toml has seed {settings.seed}, but the trials have seed {seed}",
                fix="restore hunt.toml or the ledger of the same hunt",
                where=str(self.directory),
            )
        return settings

    @cached_property
    def facts(self) -> Facts:
        """The facts about the hunt in its ledger, as they are when this attribute is first read."""
        with closing(self._ledger()) as ledger:
            return ledger.facts()

    @cached_property
    def independent(self) -> bool:
        """Whether every trial was drawn independently, so that the share of crashes estimates the crash rate."""
        return draws_independently(self.facts, self.settings)

    @cached_property
    def plain_origin(self) -> str:
        """The origin of the independently drawn trials, if only a part of the trials is independent; else empty."""
        return self.facts.get("plain_origin") or ""

    @cached_property
    def columns(self) -> tuple[str, ...]:
        """The columns of a table of the trials, with ``parent`` and ``origin`` if the sampler reports them.

        If the hunt has disturbances, the columns also contain ``disturbances`` and ``log_likelihood``; with probes,
        those in `STRESS`; with branches, those in `BRANCHES`. If the code has changed, there is `CODE_VERSION`.
        """
        origins = ORIGINS if self.facts.get("origins") else ()
        stress = STRESS if self.settings.probe else ()
        disturbances = DISTURBANCES if self.settings.disturb else ()
        branches = BRANCHES if self.settings.branch else ()
        versions = (CODE_VERSION,) if self.code_versions.are_several else ()
        preventable = PREVENTABLE if self._preventable else ()
        return (*columns_of(self.settings), *disturbances, *stress, *branches, *origins, *preventable, *versions)

    @cached_property
    def _preventable(self) -> dict[int, dict[str, bool | None]]:
        """The answers of the models of a competent driver, by the number of the trial."""
        found = {}
        for folder in crash_folders(self.directory):
            with suppress(OSError, BundleError):  # damaged bundles are reported by other commands
                if _JUDGED in (folder / layout.CRASH).read_bytes():  # without parsing all others
                    bundle = read_bundle(folder)
                    found[bundle.result.spec.number] = preventable_by(bundle)
        return {number: answers for number, answers in found.items() if answers is not None}

    @cached_property
    def code_versions(self) -> CodeVersions:
        """The versions of the code with which the trials ran."""
        return CodeVersions.of(self.facts)

    @property
    def crashes(self) -> list[Bundle]:
        """The saved crashes, in the order of their trials; `Bundle.recording` returns the recorded arrays."""
        return list_bundles(self.directory)

    @property
    def scenario(self) -> Scenario:
        """The scenario with the agents that drove."""
        return with_settings(self._snapshot().scenario, self.settings)

    def results(self, *, outcomes: Sequence[str] = ()) -> Iterator[TrialResult]:
        """Yield the trials in the order of their numbers: all trials, or those with the given outcomes."""
        with closing(self._ledger()) as ledger:
            yield from ledger.results(outcomes=tuple(outcomes))

    def rows(self, *, outcomes: Sequence[str] = ()) -> Iterator[dict[str, Cell]]:
        """Yield the trials as rows of the table that `trials` returns."""
        names = self.columns
        with closing(self._ledger()) as ledger:
            ran = [(ledger.numbers_from(one), place) for place, one in enumerate(self.code_versions.snapshots, 1)]
            for data in ledger.plain_results(outcomes=tuple(outcomes)):
                row = TrialRow(data)
                cells = row.cells(names)
                for model, answer in self._preventable.get(row.number, {}).items():
                    cells[f"preventable_by.{model}"] = answer
                if ran:
                    cells[CODE_VERSION] = next((version for numbers, version in ran if row.number in numbers), None)
                yield cells

    def trial_rows(self) -> Iterator[TrialRow]:
        """Yield the trials as `TrialRow` objects, which takes a third of the time of `results`."""
        with closing(self._ledger()) as ledger:
            yield from map(TrialRow, ledger.plain_results())

    def trial(self, number: int) -> TrialResult:
        """Return the result of one trial.

        Raises:
            UsageError: the trial has not ended.
        """
        with closing(self._ledger()) as ledger:
            found = ledger.result(number)
        if found is None:
            raise UsageError(
                f"trial {number} has not ended", fix=f"choose one of the {self.state.trials_run} trials that have ended"
            )
        return found

    def trials(self) -> NDArray[np.generic]:
        """Return a table with a row for each trial, as a structured array of shape (trials,).

        The fields of the array are the columns of ``crashhunt trials``; times are in s, distances in m, decelerations
        in m/s². A missing number is NaN.
        """
        names = self.columns
        columns: dict[str, list[Cell]] = {name: [] for name in names}
        for row in self.rows():
            for name, value in row.items():
                columns[name].append(value)
        arrays = {name: _column(values) for name, values in columns.items()}
        table = np.empty(len(columns["number"]), [(name, array.dtype) for name, array in arrays.items()])
        for name, array in arrays.items():
            table[name] = array
        return table

    def dataframe(self) -> DataFrame:
        """Return the table of `trials` as a `pandas.DataFrame`.

        Raises:
            UsageError: pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError:
            raise UsageError("a dataframe needs pandas", fix="pip install pandas, or use trials()") from None
        return pd.DataFrame(self.trials())

    def agent(self, trial: int, agent: str = "", *, trust: bool = False) -> Agent:
        """Return an agent with the arguments of a trial, created from the current code.

        Args:
            trial: number of the trial.
            agent: id of the vehicle; may be empty if the hunt has a single controlled vehicle.
            trust: whether to import the modules that the hunt names, even if the hunt is neither made here nor trusted.

        Raises:
            UsageError: the vehicle or the trial does not exist.
            UntrustedError: code of the hunt would run, but the hunt is neither made on this machine nor trusted.
        """
        if not trust and not is_hunt_trusted(self.directory, self._snapshot()):
            runs = describe_code(self._snapshot(), self.settings)
            raise UntrustedError(
                "nothing proves that you began this hunt on this machine, and this call would import the code that it "
                f"names: {runs}",
                fix="run crashhunt trust DIR once, or give trust=True, if you trust that code",
                where=str(self.directory),
            )
        arguments = self.trial(trial).spec.arguments
        name = agent or next(iter(arguments))
        if name not in arguments:
            raise UsageError(f"there is no controlled vehicle {name!r}", fix=one_of(name, arguments))
        with temporary_folder("agent") as scratch:
            settings = WorkerSettings(scenario=self.scenario, oracles=(), crash_on=(), scratch=scratch)
            parts = Parts(settings)
            return parts.agent(name, parts.simulator(), arguments[name])

    def _ledger(self) -> Ledger:
        return Ledger(self.directory / layout.LEDGER)

    def _snapshot(self) -> Snapshot:
        found = latest_snapshot(self.directory)
        if found is None:
            raise HuntDirectoryError(
                "the hunt has not begun: it has no snapshot", fix="run the hunt first", where=str(self.directory)
            )
        return found


class SuiteResults(dict[str, HuntResults]):
    """The hunts of a suite: a mapping from id and run, such as ``town/0``, to the results of the hunt."""

    def __init__(self, directory: Path, hunts: Sequence[Path]) -> None:
        super().__init__({path.relative_to(directory).as_posix(): HuntResults(path) for path in hunts})
        self.directory = directory

    def __repr__(self) -> str:
        states = [hunt.state.state for hunt in self.values()]
        counts = ", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states))
        return f"<suite {str(self.directory)!r}: {len(self)} hunts, {counts}>"


@clear_calls()
def load(directory: Path | str) -> HuntResults | SuiteResults:
    """Load a hunt, or all hunts of a suite. For an unfinished hunt, the finished trials are loaded, with a warning.

    Raises:
        HuntDirectoryError: the directory contains no hunt.
    """
    place = Path(directory)
    hunts = find_hunts(place)
    found: HuntResults | SuiteResults = HuntResults(place) if hunts == [place] else SuiteResults(place, hunts)
    for hunt in [found] if isinstance(found, HuntResults) else found.values():
        if hunt.state.state not in ("finished", "crashed"):
            detail = f": {hunt.state.detail}" if hunt.state.detail else ""
            # The second frame is of what checks the call.
            warnings.warn(f"{hunt!r} is not finished{detail}", IncompleteHuntWarning, stacklevel=3)
    return found


def _column(values: list[Cell]) -> NDArray[np.generic]:
    if not values:
        return np.empty(0)
    if all(isinstance(value, bool) for value in values):
        return np.array(values, bool)
    if all(isinstance(value, int) for value in values):
        return np.array(values, np.int64)
    if all(value is None or isinstance(value, int | float) for value in values):
        return np.array([np.nan if value is None else value for value in values], float)
    return np.array(["" if value is None else str(value) for value in values])


# Trials as tables in files: CSV, JSON, JSON lines and Parquet, written row by row.

_MAX_INSPECTED_ROWS = 1000  # rows, to infer the type of an argument without a declared type


def write_text(hunt: HuntResults, out: IO[str], form: str, *, outcomes: Sequence[str] = ()) -> int:
    """Write the trials of a hunt as text; return the number of trials.

    The form is ``csv``, ``json`` (one array) or ``jsonl`` (one object per line). Without ``outcomes``, all trials are
    written.
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
    """Write the trials of a hunt as a Parquet file; return the number of trials.

    Raises:
        UsageError: polars is not installed.
    """
    try:
        # Not pyarrow: libsumo brings an Arrow of its own along, and warns of every other in the same environment.
        import polars as pl
    except ImportError:
        raise UsageError("Parquet needs polars", fix=f"{install_command('parquet')}, or give csv") from None
    kinds = _kinds(hunt, list(islice(hunt.rows(outcomes=outcomes), _MAX_INSPECTED_ROWS)))
    schema = {name: getattr(pl, kind) for name, kind in kinds.items()}
    with (
        output_file(path) as temporary,
        temporary_beside(path, name=temporary_name(path, ".csv")) as plain,
        plain.open("w", encoding="utf-8", newline="") as table,
    ):
        count = write_text(hunt, table, "csv", outcomes=outcomes)
        table.flush()
        pl.scan_csv(plain, schema=schema).sink_parquet(temporary)
    return count


def _kinds(hunt: HuntResults, batch: list[dict[str, Cell]]) -> dict[str, str]:
    """Return the type of each column, because a single row group may not show the type."""
    settings = hunt.settings
    specs = {f"scenario.{name}": spec for name, spec in settings.scenario_arguments.items()}
    for agent, chosen in settings.agents.items():
        specs |= {f"{agent}.{name}": spec for name, spec in chosen.arguments.items()}
    known = {"int": "Int64", "float": "Float64", "bool": "Boolean", "str": "String"}
    kinds = {"number": "Int64", "seed": "Int64", "steps": "Int64", "outcome": "String", "digest": "String"}
    kinds |= dict.fromkeys(EVENTS, "Int64")
    kinds |= {"parent": "Int64", "origin": "String", "disturbances": "Int64"}
    kinds |= {CODE_VERSION: "Int64", "stress_asked": "String", "branches_asked": "String"}
    columns = hunt.columns
    for name in columns:
        kind = specs[name].kind if name in specs else "float"
        if kind in (None, "float|str"):  # the agent does not say; what was tried first does
            numeric = all(isinstance(row[name], int | float | None) for row in batch)
            kind = "float" if numeric else "str"
        kinds.setdefault(name, known[kind])
    return {name: kinds[name] for name in columns}


def _cell(value: Cell) -> Cell:
    if isinstance(value, bool):
        return str(value).lower()
    return "" if value is None else value
