"""The shapes of what commands print with ``--json``, as JSON Schema: a file each in ``reference/schemas``.

A shape that its own module declares is used from there. The others are declared here; tests validate all real outputs.
"""

from __future__ import annotations

import json
from typing import Any, Literal, NotRequired, TypedDict

from crashhunt.base.codec import JsonObject
from crashhunt.base.json_types import ErrorData, Plain
from crashhunt.base.schemas import json_schema
from crashhunt.crashes import CrashSummary
from crashhunt.hunts import AuditReport, Finding, HuntState, StoppedBecause
from crashhunt.ledger import KindData
from crashhunt.recording import DivergenceData
from crashhunt.replays import Code, ReplayData
from crashhunt.trial import Value

__all__ = ["SCHEMAS", "describe_schemas"]

_NAMES = {
    "Code": Code,
    "DivergenceData": DivergenceData,
    "Value": Value,
    "JsonObject": JsonObject,
    "Plain": Plain,
    "Json": Any,
}
CaseResult = Literal["still", "fixed", "changed", "cannot_run"]


class Bounds(TypedDict):
    """An interval; null for an end that is not known."""

    low: float | None
    high: float | None


class EventCount(TypedDict):
    """How often a traffic event occurred, and in how many trials."""

    count: int
    trials: int


class Exposure(TypedDict):
    """What the agents drove."""

    trials: int
    hours: float
    km: float


class RatePartData(TypedDict):
    """The rate of some of the crashes, or in some of the trials."""

    by: str
    name: str
    trials: int
    crashes: int
    estimate: float | None
    certain: Bounds | None


class RateEntry(TypedDict):
    """How often the agents of a hunt crash."""

    dir: str
    per: Literal["trial", "hour", "1000km"]
    confidence: float
    method: Literal["plain", "rare"]
    units: int
    crashes: int
    exposure: Exposure
    estimate: float | None
    certain: Bounds | None
    estimated: Bounds | None
    why_not: str
    left_out: dict[str, int]
    parts: list[RatePartData]
    steps: int
    plain_equivalent_steps: float | None
    bar: NotRequired[float]
    verdict: NotRequired[Literal["below", "above", "undecided"]]


class RunData(TypedDict):
    """``crashhunt run``."""

    dir: str
    hunt_seed: int
    trials_planned: int
    trials_run: int
    outcomes: dict[str, int]
    stopped_because: StoppedBecause
    wall_s: float
    steps_total: int
    events: dict[str, EventCount]
    crashes_found: int
    crashes: list[CrashSummary]
    notes: list[str]
    audit: AuditReport | None
    unanswered: int
    unconfirmed: int
    probes: NotRequired[JsonObject]
    branches: NotRequired[JsonObject]
    kinds: NotRequired[list[KindData]]
    near_misses: NotRequired[list[CrashSummary]]
    at_fault: NotRequired[list[int]]
    copied: NotRequired[str]
    rare: NotRequired[JsonObject]
    rate: NotRequired[RateEntry]


class OneReplay(ReplayData):
    """``crashhunt replay`` of one crash; ``written`` has the pictures of each film."""

    written: NotRequired[dict[str, int]]


class SeveralReplays(TypedDict):
    """``crashhunt replay`` that films several crashes, or one from its log: then nothing is replayed."""

    crashes: list[ReplayData]
    written: dict[str, int]


class StatusData(TypedDict):
    """``crashhunt status``."""

    hunts: list[HuntState]


class RatesData(TypedDict):
    """``crashhunt rate``."""

    rates: list[RateEntry]


class ShrinkData(TypedDict):
    """``crashhunt shrink``."""

    crash: str
    path: str | None
    verdict: Literal["shrunk", "unchanged", "not_reproduced"]
    ended: Literal["done", "budget", "time", "interrupted", "error"]
    why: str
    signature_kept: bool
    confirmed: bool | None
    actors_before: int
    actors_after: int
    steps_before: int
    steps_after: int
    trials_run: int
    steps_run: int
    removed: list[str]
    changed: dict[str, tuple[Any, Any]]
    scripted: list[str] | None
    steps_cut: int
    notes: list[str]


class CheckedHunt(TypedDict):
    """A hunt, a crash or a file that was checked."""

    dir: str
    kind: Literal["hunt", "crash", "file"]
    fine: bool
    protected: bool
    trials: int
    damaged_trials: list[int]
    crashes: list[str]
    damaged_crashes: list[str]
    findings: list[Finding]


class Salvaged(TypedDict):
    """What ``--salvage`` copied."""

    trials: int
    crashes: int


class CheckData(TypedDict):
    """``crashhunt check``."""

    fine: bool
    hunts: list[CheckedHunt]
    salvaged: Salvaged | None


class BisectData(TypedDict):
    """``crashhunt bisect``."""

    commit: str | None
    subject: str
    candidates: list[str]
    tried: dict[str, CaseResult]


class CaseRun(TypedDict):
    """A case of a corpus that was run."""

    path: str
    expected: Literal["still", "fixed"]
    got: CaseResult
    ok: bool
    may_be_tightened: bool
    was: str
    now: str
    warnings: list[str]
    kept: NotRequired[str]


class CorpusRunData(TypedDict):
    """``crashhunt corpus run``."""

    cases: list[CaseRun]


class Case(TypedDict):
    """A case of a corpus."""

    path: str
    expected: Literal["still", "fixed"]
    note: str
    crash: str
    bytes: int
    log: bool
    new: NotRequired[bool]


class CorpusListData(TypedDict):
    """``crashhunt corpus list`` and ``crashhunt corpus add``."""

    cases: list[Case]


class ReportData(TypedDict):
    """``crashhunt report``."""

    file: str
    bytes: int
    crashes: list[str]
    crashes_found: int
    crashes_saved: int
    near_misses: NotRequired[list[str]]
    near_misses_saved: NotRequired[int]


class CrashGroup(TypedDict):
    """A crash type."""

    words: str
    signature: JsonObject
    count: int
    saved: int
    outcome: str
    manner: str
    fault: str
    avoidable: bool | None
    first: str
    shortest: str
    members: list[str]
    known: NotRequired[str | None]
    causes: NotRequired[list[JsonObject]]


class CrashesData(TypedDict):
    """``crashhunt crashes``."""

    groups: list[CrashGroup]
    left_out: list[str]


SCHEMAS: dict[str, Any] = {
    "run": RunData,
    "replay": OneReplay | SeveralReplays,
    "status": StatusData,
    "rate": RatesData,
    "crashes": CrashesData,
    "shrink": ShrinkData,
    "check": CheckData,
    "bisect": BisectData,
    "corpus-run": CorpusRunData,
    "corpus-list": CorpusListData,
    "corpus-add": CorpusListData,
    "report": ReportData,
    "error": ErrorData,
}
"""Commands with the types of what they print; ``error`` is what each prints if it fails."""


def describe_schemas() -> dict[str, str]:
    """Return the text of each schema file, by its name without the suffix."""
    return {
        name: json.dumps(json_schema(kind, f"crashhunt {name.replace('-', ' ')} --json", _NAMES), indent=1) + "\n"
        for name, kind in SCHEMAS.items()
    }
