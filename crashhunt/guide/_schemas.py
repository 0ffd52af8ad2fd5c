"""The output of each command with ``--json`` as JSON Schema, in one file per command in ``reference/schemas``.

Types that other modules declare are imported from these modules. All further types are declared here; tests validate
all real outputs.
"""

from __future__ import annotations

import json
from typing import Any, Literal, NotRequired, TypedDict

from crashhunt.analysis import Counts
from crashhunt.base.codec import JsonObject
from crashhunt.base.json_types import ErrorData, Plain
from crashhunt.base.schemas import json_schema
from crashhunt.crashes import CrashSummary, Ending, JudgementVerdict, Reference, Verdict as FaultVerdict, Why
from crashhunt.hunts import AuditReport, CheckFinding, StoppedBecause
from crashhunt.ledger import KindData
from crashhunt.replays import Code, Verdict
from crashhunt.report import ListingEntry
from crashhunt.results import HuntState
from crashhunt.statistics import PairVerdict
from crashhunt.trial import Kind, Value

__all__ = ["SCHEMAS", "describe_schemas"]

_PUBLIC_NAMES = {
    "Code": Code,
    "Verdict": Verdict,
    "Kind": Kind,
    "Value": Value,
    "JsonObject": JsonObject,
    "Plain": Plain,
    "Json": Any,
}
CaseResult = Literal["still", "fixed", "changed", "cannot_run"]


class Bounds(TypedDict):
    """An interval; null for an unknown end."""

    low: float | None
    high: float | None


class EventCount(TypedDict):
    """The number of traffic events of a type, and of trials with such an event."""

    count: int
    trials: int


class Exposure(TypedDict):
    """The distance and time that the agents drove."""

    trials: int
    hours: float
    km: float


class RatePartData(TypedDict):
    """The rate of a part of the crashes, or in a part of the trials."""

    by: str
    name: str
    trials: int
    crashes: int
    estimate: float | None
    certain: Bounds | None


class CountedTrials(TypedDict):
    """The trials that do not count for a rate: number of trials by reason."""

    left_out: dict[str, int]


class RateEntry(CountedTrials):
    """The crash rate of the agents of a hunt."""

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
    code_versions: NotRequired[list[JsonObject]]


class DivergenceData(TypedDict):
    """The first difference between a recording and its replay."""

    step: int
    agent: str
    field: str
    recorded: Any
    replayed: Any


class ReplayData(TypedDict):
    """A replay of a crash, compared with its recording."""

    crash: str
    verdict: Verdict
    code: Code
    steps_recorded: int
    steps_replayed: int
    digest_recorded: str
    digest_replayed: str
    divergence: DivergenceData | None
    outcome_recorded: str
    outcome_replayed: str
    reason: str
    code_differences: list[str] | None
    edits: list[str]
    warnings: list[str]
    times: int
    agreed: int
    verdicts: dict[Verdict, int]
    table: NotRequired[list[Plain]]


class OneReplay(ReplayData):
    """``crashhunt replay`` of one crash; ``written`` has the pictures of each film."""

    written: NotRequired[dict[str, int]]


class SeveralReplays(TypedDict):
    """The output of ``crashhunt replay`` that films several crashes, or one from its log without a replay."""

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
    findings: list[CheckFinding]


class Salvaged(TypedDict):
    """The result of ``--salvage``."""

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
    known_by: NotRequired[Literal["cause", "type"] | None]
    new_causes: NotRequired[list[str]]
    causes: NotRequired[list[JsonObject]]


class CrashesData(TypedDict):
    """``crashhunt crashes``."""

    groups: list[CrashGroup]
    types_by_cause: NotRequired[int]
    by_cause: NotRequired[list[JsonObject]]
    left_out: list[str]
    code_versions: NotRequired[dict[str, dict[str, dict[str, int]]]]


class PlainRunData(TypedDict):
    """``crashhunt init``: the result of the traffic without an agent in one run."""

    demand: float
    simulated_s: float
    wanted: int
    entered: int
    arrived: int
    running: int
    halting: int
    teleports: int
    collisions: int
    mean_speed_mps: float
    persons: int


class FirstTrial(TypedDict):
    """The trial that ``crashhunt init`` runs."""

    outcome: str
    steps: int
    wall_s: float


class InitData(TypedDict):
    dir: str
    map: str
    lanes_km: float
    roads: int
    junctions: int
    traffic_lights: int
    crossings: int
    routes: int
    ego_routes: int
    vehicles_per_hour: float
    plain: list[PlainRunData]
    trial: FirstTrial | None
    max_steps: int
    notes: list[str]
    next: list[str]


"""``crashhunt init``."""


class AttemptData(TypedDict):
    """The runs of one evasive manoeuvre."""

    manoeuvre: str
    endings: dict[str, Ending]
    last_step: int | None
    too_late_step: int | None
    all_later_run: bool
    deceleration: float | None
    changed: list[str]


class JudgementData(TypedDict):
    """The result of ``crashhunt judge`` for one crash."""

    avoidable: bool | None
    manoeuvre: str
    last_step: int | None
    runs: int
    why_not: str
    attempts: list[AttemptData]
    verdict: JudgementVerdict
    visible_step: int | None
    why: NotRequired[Why]
    reference: NotRequired[Reference]


class JudgedCrash(JudgementData):
    """The result of ``crashhunt judge`` for one crash, with the id of the crash."""

    crash: str


class JudgeData(TypedDict):
    """``crashhunt judge``."""

    judged: list[JudgedCrash]


class RuleFinding(TypedDict):
    """A fault rule that blames an actor."""

    rule: str
    blames: FaultVerdict
    words: str
    source: str


class FaultData(TypedDict):
    """The vehicle at fault, with the findings of the rules."""

    verdict: FaultVerdict
    findings: list[RuleFinding]


class BrakingData(TypedDict):
    """The last step from which braking avoids the crash, and how it was found."""

    by: Literal["running it", "calculation"] | None
    how: str | None
    too_late_step: int | None
    why_not: str


class NearestMoment(TypedDict):
    """The closest moment of a near miss."""

    step: int
    danger: float
    agent: str
    other: str


class DangerSummary(TypedDict):
    """The criticality of a trial, with its greatest value."""

    over_the_trial: float
    greatest: float
    step: int | None
    other: str | None


class DangerStep(TypedDict):
    """Criticality after one step; null if unknown."""

    step: int
    own: float | None
    from_behind: float | None


class DangerData(TypedDict):
    """Criticality of a trial."""

    ranked_by: float
    own: DangerSummary
    from_behind: DangerSummary
    steps: list[DangerStep]


class MomentData(TypedDict):
    """The states of the agent and the collision partner after one step; null for unknown or infinite values."""

    step: int
    time_s: float
    speed: float | None
    other_speed: float | None
    closing_speed: float | None
    gap_to_other_m: float | None
    time_to_other_s: float | None
    time_to_collision_s: float | None
    gap_m: float | None
    required_deceleration: float | None
    action: list[float] | str | None


class ShowData(TypedDict):
    """``crashhunt show``."""

    crash: str
    summary: str
    agent: str
    other: str
    words: list[str]
    full_braking: float | None
    last_escape_step: int | None
    braking: BrakingData
    judged: JudgementData | None
    fault: FaultData
    nearest: NearestMoment | None
    danger: DangerData | None
    moments: list[MomentData]


class DashboardData(TypedDict):
    """``crashhunt dashboard``: the address of the dashboard, printed before the server starts."""

    url: str
    host: str
    port: int
    token: str


ExportData = TypedDict(
    "ExportData",
    {
        "crash": str,
        "file": str,
        "bytes": int,
        "as": NotRequired[Literal["openscenario", "commonroad"]],
        "actors": NotRequired[dict[str, list[str | int]]],
    },
)
"""``crashhunt export``."""


class SuiteRunData(TypedDict):
    """``crashhunt suite run``."""

    hunts: list[HuntState]
    groups: NotRequired[list[CrashGroup]]
    not_compared: NotRequired[list[str]]


class RerunData(TypedDict):
    """``crashhunt rerun``."""

    hunts: list[HuntState]
    replaced: list[str]


class Origin(TypedDict):
    """Trusted code that may run."""

    fingerprint: str
    path: str
    runs: str
    trusted_at: str


class TrustedData(TypedDict):
    """``crashhunt trust``."""

    trusted: list[Origin]


class RemovedData(TypedDict):
    """``crashhunt trust --remove``."""

    removed: list[Origin]


class SplitCrash(TypedDict):
    """A crash in the training part or the test part."""

    id: str
    hunt: str
    path: str
    seed: int


class SplitData(TypedDict):
    """``crashhunt split``."""

    test: float
    training: list[SplitCrash]
    held_out: list[SplitCrash]
    software_faults: int


class ComparedHunt(CountedTrials):
    """One hunt of a comparison."""

    dir: str
    state: str
    agents: dict[str, str]
    trials: int
    crashes: int
    crash_rate: float | None
    interval: tuple[float, float | None] | None
    why_not: str
    median_steps_to_crash: float | None
    median_time_to_collision_s: float | None
    outcomes: dict[str, int]
    counted: str
    disturbed: int | None
    excluded: int
    per: Literal["trial", "hour", "1000km"]


class ComparedPair(TypedDict):
    """The comparison of the first hunt with another hunt."""

    first: str
    second: str
    trials: int
    only_first: int
    only_second: int
    both: int
    p_value: float | None
    caution: str
    test: Literal["pairs", "intervals", ""]
    why_unpaired: str
    counts: tuple[int, int, int, int]
    evidence: float | None
    difference: Bounds | None
    units: int
    excluded: int
    answer: Literal["first", "second", "undecided", ""]
    not_started: tuple[int, int]
    without_result: int
    per: Literal["trial", "hour", "1000km"]
    verdict: str


class CompareData(TypedDict):
    """``crashhunt compare``."""

    hunts: list[ComparedHunt]
    pairs: list[ComparedPair]


class OfBoth(TypedDict):
    """A number for each of the versions that a gate compares."""

    base: int
    head: int


class InvalidPairs(TypedDict):
    """Pairs that are invalid for both versions, and trials that only one version cannot start or finish."""

    invalid: int
    not_started: OfBoth
    killed: OfBoth
    unknown: OfBoth


class ScenarioPairs(InvalidPairs):
    """The pairs of trials in one scenario."""

    name: str
    pairs: int
    only_base: int
    only_head: int
    both: int


class GateCrashType(OfBoth):
    """The number of crashes of a type in the pairs."""

    type: str


class GateCorpus(TypedDict):
    """The corpus cases that a gate ran with HEAD."""

    ok: bool
    cases: int
    failed: list[str]
    cannot_run: list[str]


class Compared(TypedDict):
    """The commits or agents that a gate compares."""

    base: str
    head: str


class GateData(InvalidPairs):
    """``crashhunt gate``."""

    verdict: PairVerdict
    pairs: int
    base: RateEntry | None
    head: RateEntry | None
    difference: Bounds | None
    corpus: GateCorpus | None
    compared: Compared
    only_base: int
    only_head: int
    both: int
    evidence: float | None
    margin: float
    confidence: float
    seed: int | None
    scenarios: list[ScenarioPairs]
    crash_types: list[GateCrashType]
    cautions: list[str]
    why: str
    interrupted: bool
    dir: str | None
    trained_on: int


class ListData(TypedDict, total=False):
    """``crashhunt list``; with WHAT, only its key."""

    agents: list[ListingEntry]
    disturbances: list[ListingEntry]
    oracles: list[ListingEntry]
    scenarios: list[ListingEntry]


class Topic(TypedDict):
    """A page of the guide."""

    topic: str
    section: str
    title: str


class TopicText(Topic):
    """A page of the guide with its text."""

    text: str


class TopicsData(TypedDict):
    """``crashhunt guide`` without a topic."""

    topics: list[Topic]


SCHEMAS: dict[str, Any] = {
    "run": RunData,
    "init": InitData,
    "replay": OneReplay | SeveralReplays,
    "show": ShowData,
    "report": ReportData,
    "dashboard": DashboardData,
    "export": ExportData,
    "suite-run": SuiteRunData,
    "status": StatusData,
    "rerun": RerunData,
    "crashes": CrashesData,
    "judge": JudgeData,
    "whatif": Counts,
    "shrink": ShrinkData,
    "corpus-add": CorpusListData,
    "corpus-run": CorpusRunData,
    "corpus-list": CorpusListData,
    "bisect": BisectData,
    "trust": TrustedData | RemovedData,
    "check": CheckData,
    "split": SplitData,
    "compare": CompareData,
    "gate": GateData,
    "rate": RatesData,
    "list": ListData,
    "guide": TopicsData | TopicText,
    "error": ErrorData,
}
"""Every command that has ``--json``, with the type of its output; ``error`` is the output of each if it fails."""


def describe_schemas() -> dict[str, str]:
    """Return the text of each schema file, by the file's name without its ending."""
    return {
        name: json.dumps(json_schema(kind, f"crashhunt {name.replace('-', ' ')} --json", _PUBLIC_NAMES), indent=1)
        + "\n"
        for name, kind in SCHEMAS.items()
    }
