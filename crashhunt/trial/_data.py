"""The shapes of a trial's plain data, as it crosses between processes and stands in ledgers and bundles.

What an earlier version did not write need not be there, and what a later one has added may be there as well.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NotRequired, TypedDict

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.trial._space import Value
    from crashhunt.world import ClosestData, EventData, PathsData

__all__ = [
    "BranchData",
    "BranchesData",
    "CollisionData",
    "DisturbanceData",
    "EscapeData",
    "FailureData",
    "OverruledData",
    "ResultData",
    "SpecData",
    "SpecExtras",
    "StressData",
]


class OverruledData(TypedDict):
    """Of an `Overruled`."""

    agent: str
    after: int
    manoeuvre: NotRequired[str]
    keeps: NotRequired[str]


class DisturbanceData(TypedDict):
    """Of a `Disturbance`."""

    step: int
    who: str
    what: str
    how_strong: float
    how_long: float
    agent: str
    vehicle: NotRequired[str]


class SpecExtras(TypedDict, total=False):
    """What of a `TrialSpec` is left out where there is none; ``requires`` names what another version must know."""

    overruled: OverruledData
    parent: int
    origin: str
    disturbances: list[DisturbanceData]
    only: list[str]
    script: PathsData
    requires: list[str]


class SpecData(SpecExtras):
    """Of a `TrialSpec`."""

    number: int
    seed: int
    arguments: Mapping[str, Mapping[str, Value]]
    scenario_arguments: Mapping[str, Value]
    max_steps: int


class CollisionData(TypedDict):
    """Of a `Collision`; null where nobody knows a number."""

    agent: str
    role: str
    collider: str
    victim: str
    seen_by: Sequence[str]
    kind: str
    x: float | None
    y: float | None
    lane: str
    collider_speed: float | None
    victim_speed: float | None
    time_s: float | None


class FailureData(TypedDict):
    """Of a `Failure`."""

    kind: str
    message: str
    traceback: str
    agent: str
    exit_code: int | None
    last_output: str


class EscapeData(TypedDict):
    """Of an `Escape`."""

    step: int | None
    too_late: int | None
    braking: float | None
    how: str


class StressData(TypedDict):
    """Of a `Stress`; its margin is null where not all was asked."""

    margin: float | None
    probes: int
    steps: int
    left_out: int
    disturbance: DisturbanceData | None
    outcome: str
    step: int
    moments: NotRequired[int]
    moments_asked: NotRequired[int]
    margin_upper_bound: NotRequired[float | None]
    why_unasked: NotRequired[str]
    may_be_asked_again: NotRequired[bool]


class BranchData(TypedDict):
    """Of a `Branch`."""

    disturbances: list[DisturbanceData]
    branched: int
    outcome: str
    step: int
    log_likelihood: float | None


class BranchesData(TypedDict):
    """Of `Branches`."""

    moments: int
    asked: int
    steps: int
    left_out: int
    crashes: list[BranchData]
    unanswered: NotRequired[int]
    why_unanswered: NotRequired[str]
    may_be_asked_again: NotRequired[bool]


class ResultData(TypedDict):
    """Of a `TrialResult`; ``category`` is that of an outcome which an oracle has brought."""

    steps: int
    sim_time_s: float
    digest: str
    wall_s: float
    setup_s: float
    worker: int
    kept: bool
    outcome: str
    category: NotRequired[str]
    spec: SpecData
    closest: ClosestData
    collision: CollisionData | None
    failure: FailureData | None
    escape: NotRequired[EscapeData | None]
    event: NotRequired[EventData | None]
    events: NotRequired[dict[str, int] | None]
    disturbances: NotRequired[list[DisturbanceData]]
    log_likelihood: NotRequired[float | None]
    danger: NotRequired[float | None]
    stress: NotRequired[StressData]
    branches: NotRequired[BranchesData]
    setup_steps: NotRequired[int | None]
    why_no_escape: NotRequired[str]
