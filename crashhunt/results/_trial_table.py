"""The columns of a trial: the projection of a result that tables and pages share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

from crashhunt.crashes import COMPETENT_DRIVERS
from crashhunt.trial import EVENTS, Branches, Stress, outcome_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.base.codec import JsonObject
    from crashhunt.plans import HuntSettings
    from crashhunt.trial import Outcome, Value


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
"""Further columns of hunts with probes: the robustness margin (0 to 1), the number of moments that were asked, and the
margin's upper bound if not all moments were asked."""

BRANCHES = ("branches", "branch_crashes", "branches_asked")
"""Further ones, of hunts with branches: number of branches, how many crashed, and how many of all have an answer."""

PREVENTABLE = tuple(f"preventable_by.{model}" for model in COMPETENT_DRIVERS)
"""Further columns of hunts with judged crashes: whether each model of a competent driver prevents the crash."""

CODE_VERSION = "code_version"
"""A further column of hunts whose code has changed: the number of the version with which a trial ran."""

Cell: TypeAlias = "Value | None"
"""What a table has in one place; None if a trial has no such value."""


@dataclass(frozen=True, slots=True)
class TrialRow:
    """One trial as a row of a table.

    Values that an earlier version did not write are missing. The row is based on the JSON data of a ledger, because a
    table may have a million trials, and creating a `TrialResult` takes three times as long.
    """

    data: JsonObject

    @property
    def number(self) -> int:
        """The number of the trial in the hunt."""
        return int(self.data["spec"]["number"])

    @property
    def outcome(self) -> Outcome:
        """The outcome of the trial."""
        return outcome_of(self.data)

    @property
    def time_to_collision_s(self) -> float | None:
        """The least time to collision, in s; None if no paths crossed."""
        return _closest(self.data).get("time_to_collision_s")

    @property
    def danger(self) -> float | None:
        """Criticality of the trial, from 0 to 1; None if it was not measured."""
        return self.data.get("danger")

    @property
    def origin(self) -> str:
        """The strategy of the sampler that proposed the trial; empty if there is none."""
        return str(self.data["spec"].get("origin", ""))

    @property
    def parent(self) -> int | None:
        """The number of the trial from which the sampler derived this trial; None if there is none."""
        found: int | None = self.data["spec"].get("parent")
        return found

    @property
    def stress_margin(self) -> float | None:
        """The robustness margin of the trial, from 0 to 1; None if it was not measured, or not completely."""
        stress = self.data.get("stress")
        return stress.get("margin") if stress else None

    @property
    def is_fully_asked(self) -> bool:
        """Whether all planned probes and branches have a result; true if none were planned."""
        stress, branches = self.data.get("stress"), self.data.get("branches")
        return not (stress and stress.get("margin") is None) and not (branches and branches.get("unanswered"))

    @property
    def arguments(self) -> Mapping[str, Mapping[str, Value]]:
        """The arguments of the agents, by agent and name."""
        found: Mapping[str, Mapping[str, Value]] = self.data["spec"].get("arguments", {})
        return found

    @property
    def scenario_arguments(self) -> Mapping[str, Value]:
        """The arguments of the scenario, by name."""
        found: Mapping[str, Value] = self.data["spec"].get("scenario_arguments", {})
        return found

    def cells(self, columns: Sequence[str]) -> dict[str, Cell]:
        """Return the trial as a row of a table with the given columns.

        Args:
            columns: names of columns from `FACTS`, `DISTURBANCES`, `STRESS`, `BRANCHES` and `ORIGINS`, and
                ``AGENT.ARGUMENT`` and ``scenario.ARGUMENT``.
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
        if events is not None:  # the simulator reports events
            found |= dict.fromkeys(EVENTS, 0)
            found |= events
        for agent, given in self.arguments.items():
            for name, value in given.items():
                found[f"{agent}.{name}"] = value
        for name, value in self.scenario_arguments.items():
            found[f"scenario.{name}"] = value
        return {name: found.get(name) for name in columns}


def _closest(data: JsonObject) -> JsonObject:
    return data.get("closest") or {}


def columns_of(settings: HuntSettings) -> tuple[str, ...]:
    """Return the columns of a table of trials: facts, then ``AGENT.ARGUMENT``, then ``scenario.ARGUMENT``."""
    arguments = [f"{agent}.{name}" for agent, chosen in settings.agents.items() for name in sorted(chosen.arguments)]
    return (*FACTS, *arguments, *(f"scenario.{name}" for name in sorted(settings.scenario_arguments)))
