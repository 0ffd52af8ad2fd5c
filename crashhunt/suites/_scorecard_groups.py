"""The groups of cases of a scorecard, and the hunts that run them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from crashhunt.base.errors import UsageError
from crashhunt.base.text import one_of
from crashhunt.crashes import COMPETENT_DRIVERS
from crashhunt.suites._suite_file import SuiteEntry
from crashhunt.trial import parse_spec

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from crashhunt.plans import Given

STEPS = 400
"""Steps of each case. The published comparison of the driver models has 350 steps."""

_WITHOUT_CUT_IN = tuple(model for model in COMPETENT_DRIVERS if model != "reg157")
_NO_CUT_IN = "the requirement applies to cut-ins only"
_SPEEDS_KMH = (1, 250)


@dataclass(frozen=True, slots=True, kw_only=True)
class Group:
    """A group of cases of a regulation.

    Args:
        id: name of the group.
        paragraph: where the regulation describes it.
        x: the argument along the horizontal axis of the maps.
        y: the argument along the vertical axis of the maps.
        axes: the values of these and further arguments, in the notation of ``--set``.
        constants: values of further arguments.
        models: the models that apply.
        why_not: why the other models do not apply.
    """

    id: str
    paragraph: str
    x: str
    y: str
    axes: Mapping[str, str]
    constants: Mapping[str, str]
    models: tuple[str, ...] = _WITHOUT_CUT_IN
    why_not: str = _NO_CUT_IN

    @property
    def scenario(self) -> str:
        """The name of the scenario."""
        return f"r157-{self.id}"


_R157 = (
    Group(
        id="cut-in", paragraph="4.4", x="gap_m", y="lateral_mps",
        axes={"gap_m": "0:60:5", "lateral_mps": "0.5:3:0.5"}, constants={"side": "1"},
        models=COMPETENT_DRIVERS, why_not="",
    ),
    Group(
        id="cut-out", paragraph="4.5", x="front_m", y="lateral_mps",
        axes={"front_m": "10:100:10", "lateral_mps": "0.5:3:0.5"}, constants={"headway_s": "2", "side": "1"},
    ),
    Group(
        id="deceleration", paragraph="4.3", x="headway_s", y="decel_mps2",
        axes={"headway_s": "1:3:0.25", "decel_mps2": "1:10:1"}, constants={},
    ),
    Group(
        id="lane-keeping", paragraph="4.1", x="swerve_m", y="beside_m",
        axes={"swerve_m": "0:0.8:0.2", "beside_m": "-5:5:2.5"},
        constants={"headway_s": "2", "period_s": "8", "side": "1"},
    ),
    Group(
        id="following", paragraph="4.3", x="offset_m", y="slower_kmh",
        axes={"offset_m": "-1.75:1.75:0.5", "slower_kmh": "0:20:5"}, constants={"headway_s": "2", "period_s": "10"},
    ),
    Group(
        id="blocked-lane", paragraph="4.2", x="offset_m", y="distance_m",
        axes={"offset_m": "-2:2:0.5", "distance_m": "50:125:25"}, constants={},
    ),
    Group(
        id="multiple-targets", paragraph="4.2", x="offset_m", y="between_m",
        axes={"offset_m": "-2:2:0.5", "between_m": "1:21:5"}, constants={"distance_m": "100"},
    ),
    Group(
        id="pedestrian", paragraph="4.2", x="distance_m", y="impact_m",
        axes={"distance_m": "20:100:10", "impact_m": "-0.2:0.2:0.1"}, constants={"walk_kmh": "5", "from_side": "1"},
        models=(), why_not="the models do not apply to persons",
    ),
    Group(
        id="detection-range", paragraph="4.6", x="seen_m", y="offset_m",
        axes={"seen_m": "20:70:5", "offset_m": "-5.25|0|5.25"}, constants={"distance_m": "150"},
    ),
)  # fmt: skip

SCORECARD_SUITES: Mapping[str, tuple[Group, ...]] = {"r157": _R157}
"""The groups of each suite of cases, by name."""


def groups_of(suite: str, names: Sequence[str] = ()) -> tuple[Group, ...]:
    """Return the groups of a suite; with names, only these groups.

    Raises:
        UsageError: the suite or a group does not exist.
    """
    if suite not in SCORECARD_SUITES:
        raise UsageError(f"--suite is {suite!r}", fix=one_of(suite, SCORECARD_SUITES))
    known = {group.id: group for group in SCORECARD_SUITES[suite]}
    for name in names:
        if name not in known:
            raise UsageError(f"--group {name!r} is no group of the suite {suite!r}", fix=one_of(name, known))
    return tuple(group for group in known.values() if not names or group.id in names)


def entries_of(
    groups: Sequence[Group], agent: str, speeds: Sequence[int], *, grid: bool, options: Given
) -> Iterator[tuple[Group, SuiteEntry]]:
    """Yield the hunts that run the cases of some groups.

    Args:
        groups: the groups.
        agent: the agent that drives.
        speeds: speeds of the agent at the beginning, in km/h.
        grid: whether every case runs; otherwise the boundary between crashes and survived cases is searched.
        options: further options of the hunts.

    Raises:
        UsageError: a speed is out of range.
    """
    low, high = _SPEEDS_KMH
    for speed in speeds:
        if not low <= speed <= high:
            raise UsageError(f"--speeds contains {speed} (allowed: {low} to {high})", fix="give speeds in km/h")
    for group in groups:
        for name, extra in _parts(group, speeds):
            values = {**group.constants, **group.axes, **extra}
            yield (
                group,
                SuiteEntry(
                    **{
                        "keep": 1,
                        **options,
                        "id": name,
                        "scenario": group.scenario,
                        "agent": agent,
                        "scenario_arguments": values,
                        "sampler": "grid" if grid else "boundary",
                        "trials": _cells(values),
                        "max_steps": STEPS,
                        "keep_going": True,
                    }
                ),
            )


def _parts(group: Group, speeds: Sequence[int]) -> Iterator[tuple[str, Mapping[str, str]]]:
    """Yield the name and the remaining arguments of each hunt of a group.

    A cut-in needs a slower vehicle, so it has a hunt for each speed.
    """
    if group.id != "cut-in":
        yield group.id, {"ego_kmh": "|".join(map(str, speeds))}
        return
    for speed in speeds:
        slower = (speed - 1) // 10 * 10
        others = f"10:{slower}:10" if slower > 10 else str(slower or speed // 2)
        yield f"{group.id}-{speed}", {"ego_kmh": str(speed), "other_kmh": others}


def _cells(values: Mapping[str, str]) -> int:
    return math.prod(len(parse_spec(text, "float").grid(1)) for text in values.values())
