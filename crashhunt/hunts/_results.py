"""What hunts have left on disk, as objects: ``crashhunt.load(directory)``."""

from __future__ import annotations

import warnings
from contextlib import closing
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.base import layout
from crashhunt.base.calls import clear_calls
from crashhunt.base.errors import HuntDirectoryError, UntrustedError, UsageError
from crashhunt.base.names import one_of
from crashhunt.base.temporary import temporary_folder
from crashhunt.crashes import Bundle, describe_code, is_hunt_trusted, list_bundles
from crashhunt.episode import Parts, WorkerSettings
from crashhunt.hunts._ledger import Ledger, has_begun
from crashhunt.hunts._row import BRANCHES, DISTURBANCES, FACTS, ORIGINS, STRESS, TrialRow
from crashhunt.hunts._state import HuntState, draws_independently, find_hunts, hunt_state
from crashhunt.plans import HuntSettings, read_settings, with_settings
from crashhunt.snapshots import Snapshot, latest_snapshot

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray
    from pandas import DataFrame

    from crashhunt.agents import Agent
    from crashhunt.hunts._row import Cell
    from crashhunt.scenario import Scenario
    from crashhunt.trial import TrialResult

__all__ = ["HuntResults", "SuiteResults", "UnfinishedWarning", "columns_of", "load"]


class UnfinishedWarning(UserWarning):
    """What was loaded is not, or not yet, what was asked for."""


class HuntResults:
    """A hunt that has been run, or is running.

    Args:
        directory: of the hunt.

    Raises:
        HuntDirectoryError: it is not one.
    """

    def __init__(self, directory: Path | str) -> None:
        self.directory = Path(directory)
        self.state: HuntState = hunt_state(self.directory)

    def __repr__(self) -> str:
        state = self.state
        return (
            f"<hunt {str(self.directory)!r}: {state.state}, {state.trials_run} of {state.trials_planned} trials, "
            f"{state.crashes} crash{'' if state.crashes == 1 else 'es'}>"
        )

    @cached_property
    def settings(self) -> HuntSettings:
        """What was asked.

        Raises:
            HuntDirectoryError: hunt.toml is missing or damaged, or the ledger is that of another hunt.
        """
        settings = read_settings(self.directory / layout.HUNT)
        if not has_begun(self.directory / layout.LEDGER):
            return settings
        with closing(self._ledger()) as ledger:
            seed = ledger.facts().get("hunt_seed", settings.seed)
        if seed != settings.seed:
            raise HuntDirectoryError(
                f"hunt.toml says seed {settings.seed}, and the trials are those of seed {seed}",
                fix="put the files of one hunt together, or write back the seed",
                where=str(self.directory),
            )
        return settings

    @cached_property
    def independent(self) -> bool:
        """Whether every trial was drawn independently of the others, so that the rate of crashes means something."""
        with closing(self._ledger()) as ledger:
            return draws_independently(ledger.facts(), self.settings)

    @cached_property
    def plain_origin(self) -> str:
        """The origin of the trials that were drawn independently of all others, where not all were; else empty."""
        with closing(self._ledger()) as ledger:
            return ledger.facts().get("plain_origin") or ""

    @cached_property
    def columns(self) -> tuple[str, ...]:
        """The columns of a table of its trials; ``parent`` and ``origin`` where its sampler says such a thing.

        Likewise ``disturbances`` and ``log_likelihood``, where it has any disturbances, those of `STRESS`, where
        it has probes, and those of `BRANCHES`, where it has branches.
        """
        with closing(self._ledger()) as ledger:
            origins = ORIGINS if ledger.facts().get("origins") else ()
        stress = STRESS if self.settings.probe else ()
        disturbances = DISTURBANCES if self.settings.disturb else ()
        branches = BRANCHES if self.settings.branch else ()
        return (*columns_of(self.settings), *disturbances, *stress, *branches, *origins)

    @property
    def crashes(self) -> list[Bundle]:
        """What was found, in order of the trials; `Bundle.recording` has the arrays."""
        return list_bundles(self.directory)

    @property
    def scenario(self) -> Scenario:
        """The scenario as it ran, with the agents at the wheel."""
        return with_settings(self._snapshot().scenario(), self.settings)

    def results(self, *, outcomes: Sequence[str] = ()) -> Iterator[TrialResult]:
        """Yield the trials in order of their numbers, all or those that ended in one of some ways."""
        with closing(self._ledger()) as ledger:
            yield from ledger.results(outcomes=tuple(outcomes))

    def rows(self, *, outcomes: Sequence[str] = ()) -> Iterator[dict[str, Cell]]:
        """Yield the trials as rows of the table that `trials` returns."""
        names = self.columns
        with closing(self._ledger()) as ledger:
            for data in ledger.plain_results(outcomes=tuple(outcomes)):
                yield TrialRow(data).cells(names)

    def trial_rows(self) -> Iterator[TrialRow]:
        """Yield the trials as what tables tell of them, which takes a third of the time of `results`."""
        with closing(self._ledger()) as ledger:
            yield from map(TrialRow, ledger.plain_results())

    def trial(self, number: int) -> TrialResult:
        """Return one trial.

        Raises:
            UsageError: it has not ended.
        """
        with closing(self._ledger()) as ledger:
            found = ledger.result(number)
        if found is None:
            raise UsageError(f"trial {number} has not ended", fix=f"{self.state.trials_run} trials have")
        return found

    def trials(self) -> NDArray[np.generic]:
        """Return a row per trial, as a structured array, shape (trials,).

        Its fields are those of ``crashhunt trials``; times in s, distances in m, decelerations in m/s². A number that
        there is none of is NaN.
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
        """Return the same as a `pandas.DataFrame`.

        Raises:
            UsageError: pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError:
            raise UsageError("a dataframe needs pandas", fix="pip install pandas, or take trials()") from None
        return pd.DataFrame(self.trials())

    def agent(self, trial: int, agent: str = "", *, trust: bool = False) -> Agent:
        """Return an agent made as in a trial, with today's code.

        Args:
            trial: its number.
            agent: the vehicle's id; may be empty where there is one.
            trust: import what the hunt names even if the hunt is neither made here nor trusted.

        Raises:
            UsageError: there is no such vehicle or trial.
            UntrustedError: what the hunt names would run, and the hunt is neither made here nor trusted.
        """
        if not trust and not is_hunt_trusted(self.directory, self._snapshot()):
            runs = describe_code(self._snapshot(), self.settings)
            raise UntrustedError(
                f"nothing proves that you began this hunt on this machine, and this would import what it names: {runs}",
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
            raise HuntDirectoryError("the hunt has not begun: it has no snapshot", where=str(self.directory))
        return found


class SuiteResults(dict[str, HuntResults]):
    """The hunts of a suite: id and run, such as ``town/0``, to the hunt."""

    def __init__(self, directory: Path, hunts: Sequence[Path]) -> None:
        super().__init__({path.relative_to(directory).as_posix(): HuntResults(path) for path in hunts})
        self.directory = directory

    def __repr__(self) -> str:
        states = [hunt.state.state for hunt in self.values()]
        counts = ", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states))
        return f"<suite {str(self.directory)!r}: {len(self)} hunts, {counts}>"


@clear_calls()
def load(directory: Path | str) -> HuntResults | SuiteResults:
    """Load a hunt, or all hunts of a suite. What is not finished is loaded as far as it is, with a warning.

    Raises:
        HuntDirectoryError: there is no hunt.
    """
    place = Path(directory)
    hunts = find_hunts(place)
    found: HuntResults | SuiteResults = HuntResults(place) if hunts == [place] else SuiteResults(place, hunts)
    for hunt in [found] if isinstance(found, HuntResults) else found.values():
        if hunt.state.state not in ("finished", "crashed"):
            detail = f": {hunt.state.detail}" if hunt.state.detail else ""
            # The second frame is of what checks the call.
            warnings.warn(f"{hunt!r} is not finished{detail}", UnfinishedWarning, stacklevel=3)
    return found


def columns_of(settings: HuntSettings) -> tuple[str, ...]:
    """Return the columns of a table of trials: facts, then ``AGENT.ARGUMENT``, then ``scenario.ARGUMENT``."""
    arguments = [f"{agent}.{name}" for agent, chosen in settings.agents.items() for name in sorted(chosen.arguments)]
    return (*FACTS, *arguments, *(f"scenario.{name}" for name in sorted(settings.scenario_arguments)))


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
