"""Which of several hunts crashes more often, and whether that is more than chance."""

from __future__ import annotations

import csv
from contextlib import closing
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, TextIO

import numpy as np

from crashhunt.base import layout
from crashhunt.base.calls import clear_calls
from crashhunt.base.errors import HuntDirectoryError, UsageError
from crashhunt.base.json_types import finite_values
from crashhunt.hunts import HuntResults
from crashhunt.ledger import Ledger
from crashhunt.trial import Constant, Outcome

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from crashhunt.plans import HuntSettings

__all__ = ["Comparison", "HuntFigures", "Pair", "compare"]

_CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True)
class HuntFigures:
    """One hunt in numbers.

    Args:
        dir: its directory.
        state: where it stands.
        agents: vehicle to who drives it.
        trials: that were valid.
        crashes: of them.
        crash_rate: of them, from 0 to 1; NaN where there is no trial.
        interval: Clopper and Pearson's, of 95 % confidence; None where the trials do not allow one.
        why_not: why there is no interval.
        median_steps_to_crash: NaN where there was no crash.
        median_time_to_collision_s: of the trials without a crash, the least of each; infinite where most never were
            on a collision course.
        outcomes: how many trials ended how, invalid ones too; of all trials.
        counted: the origin of the trials that all other figures are of, if the hunt guided the rest of its trials. Only
            unguided trials show a crash rate. Empty if all trials count.
        disturbed: how many of the crashes had disturbances; None where the hunt has none.
    """

    dir: str
    state: str
    agents: dict[str, str]
    trials: int
    crashes: int
    crash_rate: float
    interval: tuple[float, float] | None
    why_not: str
    median_steps_to_crash: float
    median_time_to_collision_s: float
    outcomes: dict[str, int]
    counted: str = ""
    disturbed: int | None = None


@dataclass(frozen=True, slots=True)
class Pair:
    """Two hunts over the trials that have the same number, seed and traffic; or as a whole, where there are none.

    Args:
        first: directory.
        second: directory.
        trials: how many pairs.
        only_first: pairs in which only the first crashed.
        only_second: pairs in which only the second did.
        both: in which both did.
        p_value: that neither crashes more often; 1 where they do not differ.
        caution: why the answer may mean something else; empty for nothing.
        test: which test it is of: ``mcnemar``, the exact one over pairs; ``fisher``, the exact one over all trials of
            each; empty where there is none.
        why_unpaired: why there are no pairs; empty where there are.
        counts: crashes and valid trials of the first and of the second.
    """

    first: str
    second: str
    trials: int
    only_first: int
    only_second: int
    both: int
    p_value: float
    caution: str = ""
    test: str = "mcnemar"
    why_unpaired: str = ""
    counts: tuple[int, int, int, int] = (0, 0, 0, 0)

    @property
    def verdict(self) -> str:
        """The answer in words."""
        if not self.trials:
            return self._unpaired()
        counts = (
            f"of {self.trials} trials with the same seeds, {self.only_first} crash only in {self.first}, "
            f"{self.only_second} only in {self.second}, {self.both} in both "
            f"(McNemar's exact test: p = {self.p_value:.2g})"
        )
        if self.p_value >= 1 - _CONFIDENCE:
            return f"no difference that chance does not explain: {counts}"
        better = self.second if self.only_first > self.only_second else self.first
        return f"{better} crashes less: {counts}"

    def _unpaired(self) -> str:
        reason = f"{self.first} and {self.second}{self.why_unpaired.removeprefix('they')}"
        if not self.test:
            return reason
        a, trials_a, b, trials_b = self.counts
        counts = (
            f"{a} of {trials_a} trials crash in {self.first}, {b} of {trials_b} in {self.second} "
            f"(Fisher's exact test, unpaired: p = {self.p_value:.2g})"
        )
        if self.p_value >= 1 - _CONFIDENCE:
            return f"{reason}; no difference that chance does not explain: {counts}"
        better = self.second if a * trials_b > b * trials_a else self.first
        return f"{reason}; {better} crashes less: {counts}"


@dataclass(frozen=True, slots=True)
class Comparison:
    """Several hunts side by side.

    Args:
        hunts: in the order in which they were given.
        pairs: the first against each other one.
    """

    hunts: tuple[HuntFigures, ...]
    pairs: tuple[Pair, ...]

    def to_json(self) -> dict[str, object]:
        """Return the shape that ``compare --json`` prints; what is no finite number is null."""
        return {
            "hunts": [finite_values(asdict(hunt)) for hunt in self.hunts],
            "pairs": [{**finite_values(asdict(pair)), "verdict": pair.verdict} for pair in self.pairs],
        }

    def write_csv(self, out: TextIO) -> None:
        """Write a line per hunt."""
        names = ("dir", "state", "trials", "crashes", "crash_rate", "rate_low", "rate_high", "why_not",
                 "median_steps_to_crash", "median_time_to_collision_s", *map(str, Outcome))  # fmt: skip
        writer = csv.DictWriter(out, names)
        writer.writeheader()
        for hunt in self.hunts:
            low, high = hunt.interval or ("", "")
            row = {name: getattr(hunt, name) for name in names if hasattr(hunt, name)}
            counts = {str(kind): hunt.outcomes.get(kind, 0) for kind in Outcome}
            writer.writerow({**row, **counts, "rate_low": low, "rate_high": high})

    def __repr__(self) -> str:
        rates = ", ".join(f"{hunt.dir}: {hunt.crashes} of {hunt.trials}" for hunt in self.hunts)
        return f"<comparison {rates}>"


@clear_calls()
def compare(*directories: Path | str) -> Comparison:
    """Compare hunts: how often each crashed, and over trials with the same seeds, whether one crashes less.

    Raises:
        UsageError: fewer than two are given.
        HuntDirectoryError: one is not the directory of a hunt, or its ledger is damaged.
    """
    if len(directories) < 2:
        raise UsageError("there is nothing to compare with", fix="give the directories of two hunts or more")
    hunts = [HuntResults(directory) for directory in directories]
    for hunt in hunts:
        if hunt.state.damaged:
            raise HuntDirectoryError(hunt.state.detail)
    tables = [_table(hunt) for hunt in hunts]
    figures = tuple(_figures(hunt, table) for hunt, table in zip(hunts, tables, strict=True))
    pairs = tuple(_pair(hunts[0], tables[0], hunt, table) for hunt, table in zip(hunts[1:], tables[1:], strict=True))
    return Comparison(figures, pairs)


def _table(hunt: HuntResults) -> NDArray[np.void]:
    """Number, seed, steps, least time to collision, whether it counts and whether it crashed, in order of numbers.

    Of a hunt that guided its trials, those that it did not.
    """
    crash_on = hunt.settings.crash_on
    fields = [("number", "i8"), ("seed", "i8"), ("steps", "i8"), ("ttc", "f8"), ("valid", "?"), ("crash", "?")]
    with closing(Ledger(hunt.directory / layout.LEDGER)) as ledger:
        rows = (
            (number, seed, steps, np.inf if ttc is None else ttc, name != Outcome.INVALID, name in crash_on)
            for number, seed, name, steps, ttc in ledger.table()
        )
        table = np.fromiter(rows, fields)
    if hunt.plain_origin:
        plain = [row.number for row in hunt.trial_rows() if row.data["spec"].get("origin") == hunt.plain_origin]
        table = table[np.isin(table["number"], plain)]
    return np.sort(table, order="number")


def _disturbed(hunt: HuntResults, crashed: set[int]) -> int:
    found = hunt.results(outcomes=tuple(map(str, hunt.settings.crash_on)))
    return sum(result.disturbed for result in found if result.spec.number in crashed)


def _figures(hunt: HuntResults, table: NDArray[np.void]) -> HuntFigures:
    valid = table[table["valid"]]
    crashes = int(valid["crash"].sum())
    crashed, fine = valid[valid["crash"]], valid[~valid["crash"]]
    why_not = _why_no_interval(hunt)
    interval = None
    if not why_not and len(valid):
        from scipy.stats import binomtest

        found = binomtest(crashes, len(valid)).proportion_ci(_CONFIDENCE, "exact")
        interval = (float(found.low), float(found.high))
    return HuntFigures(
        dir=str(hunt.directory),
        state=hunt.state.state,
        agents={agent: chosen.agent for agent, chosen in hunt.settings.agents.items()},
        trials=len(valid),
        crashes=crashes,
        crash_rate=crashes / len(valid) if len(valid) else float("nan"),
        interval=interval,
        why_not=why_not if len(valid) else "there is no valid trial",
        median_steps_to_crash=float(np.median(crashed["steps"])) if crashes else float("nan"),
        median_time_to_collision_s=float(np.median(fine["ttc"])) if len(fine) else float("nan"),
        outcomes=hunt.state.outcomes,
        counted=hunt.plain_origin,
        disturbed=_disturbed(hunt, set(crashed["number"].tolist())) if hunt.settings.disturb else None,
    )


def _why_no_interval(hunt: HuntResults) -> str:
    settings = hunt.settings
    if settings.rare:
        return "in rare mode, trials run without the hunt's disturbances"
    if settings.seeds:
        return f"its trials take place in {settings.seeds} traffics (--seeds), and are not independent of each other"
    if not (hunt.independent or hunt.plain_origin):
        return f"the sampler {settings.sampler} does not draw trials independently"
    if not settings.run.keep_going and any(hunt.state.outcomes.get(kind) for kind in settings.crash_on):
        return "it stopped at its first crash, and the rate of such a hunt is too high; use --keep-going"
    if settings.run.distinct and (not settings.trials or hunt.state.trials_run < settings.trials):
        return f"it stopped at {settings.run.distinct} kinds of crashes, and the rate of such a hunt is too high"
    if hunt.state.state not in ("finished", "crashed"):
        return f"it is {hunt.state.state}, and quick trials are over-represented"
    return ""


def _pair(first: HuntResults, left: NDArray[np.void], second: HuntResults, right: NDArray[np.void]) -> Pair:
    (crashed, valid), (crashed_too, valid_too) = _counts(left), _counts(right)
    totals = (crashed, valid, crashed_too, valid_too)
    _, in_left, in_right = np.intersect1d(left["number"], right["number"], assume_unique=True, return_indices=True)
    left, right = left[in_left], right[in_right]
    same = (left["seed"] == right["seed"]) & left["valid"] & right["valid"]
    why_not = "" if same.any() else "they have no seed in common: run both with the same --seed"
    if not why_not:
        why_not = _other_traffic(first.settings, second.settings)
        if not why_not and not _same_draws(first, second):
            same &= _same_arguments(first, second, left["number"])
            why_not = "" if same.any() else "they have other values of the scenario's arguments with the same seeds"
        if why_not:
            same = np.zeros_like(same)
    a, b = left["crash"][same], right["crash"][same]
    only_first, only_second = int((a & ~b).sum()), int((~a & b).sum())
    p_value, test = 1.0, "mcnemar"
    if why_not:
        p_value, test = _unpaired_test(first, second, totals)
    elif only_first + only_second:
        from scipy.stats import binomtest

        p_value = float(binomtest(only_first, only_first + only_second).pvalue)
    return Pair(
        first=str(first.directory),
        second=str(second.directory),
        trials=int(same.sum()),
        only_first=only_first,
        only_second=only_second,
        both=int((a & b).sum()),
        p_value=p_value,
        caution=_caution(first, second),
        test=test,
        why_unpaired=why_not,
        counts=totals,
    )


def _counts(table: NDArray[np.void]) -> tuple[int, int]:
    """Crashes and valid trials."""
    return int((table["crash"] & table["valid"]).sum()), int(table["valid"].sum())


def _other_traffic(one: HuntSettings, other: HuntSettings) -> str:
    if shared := one.seeds or other.seeds:
        return f"trials take place in {shared} traffics (--seeds), and are not independent of each other"
    if one.scenario_digest != other.scenario_digest:
        return "they are of two scenarios, in which the same seed is another traffic"
    differing = [
        name
        for name in sorted(one.scenario_arguments.keys() | other.scenario_arguments.keys())
        if one.scenario_arguments.get(name) != other.scenario_arguments.get(name)
    ]
    if one.rare != other.rare:
        return "one is in rare mode, in which trials run without disturbances, so that the same seed is another traffic"
    if one.disturb != other.disturb:
        return f"they have {_disturbances(one)} and {_disturbances(other)}, so that the same seed is another traffic"
    if differing:
        return f"they do not try the same values of {', '.join(differing)}, so that the same seed is another traffic"
    return ""


def _disturbances(settings: HuntSettings) -> str:
    return f"the disturbances {', '.join(settings.disturb)}" if settings.disturb else "no disturbances"


def _same_draws(first: HuntResults, second: HuntResults) -> bool:
    """Whether it is sure that trials of the same number and seed have the same scenario arguments."""
    if all(isinstance(spec.distribution, Constant) for spec in first.settings.scenario_arguments.values()):
        return True
    # Independent samplers draw them before any agent's.
    return first.settings.sampler == second.settings.sampler and first.independent and second.independent


def _same_arguments(first: HuntResults, second: HuntResults, numbers: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Of each trial, whether the scenario's arguments had the same values."""
    found = [{row.number: row.scenario_arguments for row in hunt.trial_rows()} for hunt in (first, second)]
    return np.array([found[0][number] == found[1][number] for number in numbers.tolist()], bool)


def _unpaired_test(first: HuntResults, second: HuntResults, totals: tuple[int, int, int, int]) -> tuple[float, str]:
    a, trials_a, b, trials_b = totals
    if _why_no_interval(first) or _why_no_interval(second) or not (trials_a and trials_b):
        return 1.0, ""  # their trials say nothing about how often they crash
    from scipy.stats import fisher_exact

    return float(fisher_exact([[a, trials_a - a], [b, trials_b - b]]).pvalue), "fisher"


def _caution(first: HuntResults, second: HuntResults) -> str:
    one, other = first.settings, second.settings
    if one.max_steps != other.max_steps:
        return f"trials of the one have {one.max_steps} steps to crash in, those of the other {other.max_steps}"
    if one.crash_on != other.crash_on:
        return "they do not count the same outcomes as crashes"
    if one.disturb != other.disturb:
        return f"the one has {_disturbances(one)}, the other {_disturbances(other)}"
    if not (one.run.keep_going and other.run.keep_going):
        return "one that stops at its first crash runs fewer trials; use --keep-going"
    return ""
