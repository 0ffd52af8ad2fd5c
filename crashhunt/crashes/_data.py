"""The shapes of what a crash consists of on disk: ``crash.json``, and the index of an archive.

What an earlier version did not write need not be there, and what a later one has added may be there as well.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NotRequired, TypedDict

if TYPE_CHECKING:
    from collections.abc import Mapping

    from crashhunt.base.integrity import FileEntry
    from crashhunt.recording import DivergenceData
    from crashhunt.trial import CollisionData, DisturbanceData, EscapeData, FailureData, Value
    from crashhunt.world import ClosestData, EventData, PathsData

__all__ = ["ArchiveIndex", "CrashData", "CrashSummary", "Protected"]


class Protected(TypedDict):
    """What says of itself, and of the files beside it, what they were when they were written."""

    schema: int
    files: dict[str, FileEntry]
    integrity: NotRequired[str]


class CrashData(Protected):
    """``crash.json``."""

    id: str
    hunt_seed: int
    trial: int
    seed: int
    max_steps: int
    arguments: Mapping[str, Mapping[str, Value]]
    scenario_arguments: Mapping[str, Value]
    outcome: str
    category: NotRequired[str]
    summary: str
    step: int
    sim_time_s: float
    collision: CollisionData | None
    failure: FailureData | None
    escape: NotRequired[EscapeData | None]
    event: NotRequired[EventData | None]
    events: NotRequired[dict[str, int] | None]
    closest_approach: ClosestData
    digest: str
    snapshot: str
    versions: dict[str, str]
    confirmed: bool | None
    divergence: DivergenceData | None
    disturbed: NotRequired[bool]
    log_likelihood: NotRequired[float | None]
    danger: NotRequired[float | None]
    disturbances: NotRequired[list[DisturbanceData]]
    planned_disturbances: NotRequired[list[DisturbanceData]]
    only: NotRequired[list[str] | None]
    script: NotRequired[PathsData | None]
    why_unconfirmed: NotRequired[str]
    why_no_escape: NotRequired[str]
    authentication_code: NotRequired[str]


class CrashSummary(TypedDict):
    """A crash as ``run --json`` prints it."""

    id: str
    trial: int
    seed: int
    outcome: str
    step: int
    arguments: Mapping[str, Mapping[str, Value]]
    scenario_arguments: Mapping[str, Value]
    path: str
    digest: str
    confirmed: bool | None
    why_unconfirmed: NotRequired[str]
    disturbed: NotRequired[bool]
    log_likelihood: NotRequired[float | None]
    danger: NotRequired[float | None]


class ArchiveIndex(TypedDict):
    """The index of an archive."""

    schema: int
    crash: str
    made_by: str
    made_at: str
    files: dict[str, FileEntry]
    signature: NotRequired[str]
