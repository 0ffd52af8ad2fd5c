"""What is told of a trial wherever trials are listed: the one projection of a result that tables and pages share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

from crashhunt.trial import EVENTS, Branches, Stress, outcome_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.trial import Outcome, ResultData, Value
    from crashhunt.world import ClosestData

__all__ = ["BRANCHES", "DISTURBANCES", "FACTS", "ORIGINS", "STRESS", "Cell", "TrialRow"]

FACTS = (
    "number", "seed", "outcome", "steps", "sim_time_s", "danger", "time_to_collision_s", "gap_m",
    "required_deceleration", "wall_s", "digest", *map(str, EVENTS),
)  # fmt: skip
"""The columns that every table of trials begins with."""

ORIGINS = ("parent", "origin")
"""Further ones, of trials that a sampler made of others, or by one of several strategies."""

DISTURBANCES = ("disturbances", "log_likelihood")
"""Further ones, of hunts with disturbances: how many took place, and how likely all of it was."""

STRESS = ("stress_margin", "stress_asked", "stress_margin_upper_bound")
"""Further ones, of hunts with probes: how little it would have taken, 0 to 1; at how many moments that was asked; and
what the margin is at most where that was not all of them."""

BRANCHES = ("branches", "branch_crashes", "branches_asked")
"""Further ones, of hunts with branches: how many there were, how many crashed, and how many of all have an answer."""

Cell: TypeAlias = "Value | None"
"""What a table has in one place; None where a trial has no such value."""


@dataclass(frozen=True, slots=True)
class TrialRow:
    """One trial of many.

    What an earlier version did not write is missing here. It is made of plain data, as ledgers yield them: a table has
    a million trials, and a `TrialResult` takes three times as long.

    Args:
        data: of the trial.
    """

    data: ResultData

    @property
    def number(self) -> int:
        """Its place in the hunt."""
        return self.data["spec"]["number"]

    @property
    def outcome(self) -> Outcome:
        """How it ended."""
        return outcome_of(self.data)

    @property
    def time_to_collision_s(self) -> float | None:
        """The least; None where no course ever crossed."""
        return _closest(self.data).get("time_to_collision_s")

    @property
    def danger(self) -> float | None:
        """How near to a crash it came, 0 to 1; None where nobody measured it."""
        return self.data.get("danger")

    @property
    def origin(self) -> str:
        """Which strategy of a sampler proposed it; empty where none did."""
        return self.data["spec"].get("origin", "")

    @property
    def parent(self) -> int | None:
        """The number of the trial that it was made from; None where there is none."""
        return self.data["spec"].get("parent")

    @property
    def stress_margin(self) -> float | None:
        """How little it would have taken, 0 to 1; None where that was not asked, or not fully."""
        stress = self.data.get("stress")
        return stress.get("margin") if stress else None

    @property
    def is_fully_asked(self) -> bool:
        """Whether every question to its copies has an answer; also where there were to be none."""
        stress, branches = self.data.get("stress"), self.data.get("branches")
        return not (stress and stress.get("margin") is None) and not (branches and branches.get("unanswered"))

    @property
    def arguments(self) -> Mapping[str, Mapping[str, Value]]:
        """What its agents were given, by agent and name."""
        return self.data["spec"].get("arguments", {})

    @property
    def scenario_arguments(self) -> Mapping[str, Value]:
        """What its scenario was given, by name."""
        return self.data["spec"].get("scenario_arguments", {})

    def cells(self, columns: Sequence[str]) -> dict[str, Cell]:
        """Return it as a row of a table that has some columns.

        Args:
            columns: some of `FACTS`, `DISTURBANCES`, `STRESS`, `BRANCHES` and `ORIGINS`, ``AGENT.ARGUMENT`` and
                ``scenario.ARGUMENT``.
        """
        data = self.data
        spec, closest, events = data["spec"], _closest(data), data.get("events")
        found: dict[str, Cell] = {
            "number": spec["number"],
            "seed": spec["seed"],
            "outcome": data["outcome"],
            "steps": data["steps"],
            "sim_time_s": data.get("sim_time_s"),
            "danger": data.get("danger"),
            "time_to_collision_s": closest.get("time_to_collision_s"),
            "gap_m": closest.get("gap_m"),
            "required_deceleration": closest.get("required_deceleration"),
            "wall_s": data.get("wall_s"),
            "digest": data.get("digest"),
            "parent": self.parent,
            "origin": self.origin,
            "disturbances": len(data.get("disturbances", ())),
            "log_likelihood": data.get("log_likelihood"),
            "stress_margin": self.stress_margin,
        }
        if stress := data.get("stress"):
            found["stress_margin_upper_bound"] = stress.get("margin_upper_bound")
            if stress.get("moments"):  # which earlier versions did not count
                found["stress_asked"] = Stress.from_json(stress).extent
        branches = data.get("branches")
        if branches is not None:
            found |= {
                "branches": branches.get("asked"),
                "branch_crashes": len(branches.get("crashes", ())),
                "branches_asked": Branches.from_json(branches).extent,
            }
        if events is not None:  # somebody has looked for them
            found |= dict.fromkeys(EVENTS, 0)
            found |= events
        for agent, given in self.arguments.items():
            for name, value in given.items():
                found[f"{agent}.{name}"] = value
        for name, value in self.scenario_arguments.items():
            found[f"scenario.{name}"] = value
        return {name: found.get(name) for name in columns}


def _closest(data: ResultData) -> ClosestData:
    return data.get("closest") or {}
