"""The facts about a hunt in its ledger, besides trials: state, owner, rates, crash types, versions of the code."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NotRequired, TypedDict

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.base.codec import JsonObject


class KindData(TypedDict):
    """A crash type, in the form in which the ledger and ``--json`` have it."""

    words: str
    count: int
    first: str
    shortest: str


class HuntOwner(TypedDict):
    """Identifies a process by host, process id, and start time in ticks since the machine started.

    The token also names the boot and the namespaces (`crashhunt.base.temporary.OwnerProcess`).
    """

    host: str
    pid: int
    started: int
    token: NotRequired[str]


class UntilRate(TypedDict):
    """The progress of a hunt with ``--until-rate``; ``decided_at`` is the number of the deciding trial."""

    bar: str
    decided_at: int | None
    verdict: str


class RateBounds(TypedDict):
    """A confidence interval of a rate."""

    low: float  # the lower bound
    high: float | None  # the upper bound; None if there is no upper bound


class RunningRate(TypedDict):
    """The current crash rate of a hunt, as ``status --json`` reports it."""

    # either ``plain`` for counted trials, or ``rare`` for forks with forced disturbances together with plain trials
    method: Literal["plain", "rare"]
    # the unit of exposure to which the rate refers, such as a trial or a kilometre
    per: Literal["trial", "hour", "1000km"]
    confidence: float  # confidence of all intervals, in percent
    units: int  # number of independent units that count: trials, traffic seeds, or trials from which forks start
    trials: int  # number of plain trials that count
    crashes: int  # number of crashes in the trials that ``trials`` counts
    origin: str  # the origin of the trials that count; empty if all trials count
    certain: RateBounds | None  # interval that is valid whenever the user looks at it; None if there is none
    estimate: float | None  # crash probability per trial, estimated from the forks; None if there is no estimate
    estimated: RateBounds | None  # interval of the estimate; None if there are too few trials from which forks start
    why_not: str  # why the certain interval or the estimated interval is missing; empty if neither is missing
    bar: float | None  # threshold with which the rate is compared; None if there is no threshold
    verdict: str  # either ``below``, ``above`` or ``undecided``; empty if there is no threshold
    # number of trials that do not count because an agent was trained on their traffic; missing if all trials count
    trained_on: NotRequired[int]


class CodeVersionsData(TypedDict):
    """The versions of the code with which the trials of a hunt ran."""

    snapshots: list[list[str]]  # digests of the snapshots of each version, the first version first
    newest: int  # position in ``snapshots`` of the version that ran last
    # number of the first trial that counts for figures of this version. No trial from this number on had begun with
    # another version.
    first: int


class Noted(TypedDict, total=False):
    """The facts about a hunt that are recorded in addition to its state; setting a fact to None removes it."""

    owner: HuntOwner | None  # the process that runs the hunt; None while no process runs it
    began: float  # time at which the hunt was started or resumed, in s since the epoch
    heartbeat: float  # time of the last sign of life of the hunt, in s since the epoch
    elapsed_s: float  # duration of this run of the hunt up to that sign of life, in s, by the monotonic clock
    done_before: int  # number of trials that had ended at the start of this run
    planned: int  # number of planned trials; 0 if only the time is limited
    replanned: bool | None  # whether the number of planned trials was changed after some trials had ended
    # time at which the hunt's time limit ends, in s since the epoch; None if there is no time limit
    until: float | None
    hunt_seed: int  # seed from which the trials of the hunt are drawn
    independent: bool  # whether the trials were drawn independently of each other
    # origin of the independent trials, if the sampler also draws some trials that it does not guide; else None
    plain_origin: str | None
    lag: int | None  # maximum number of trials by which results reach a learning sampler late
    sampler_version: int | None  # version of the proposals of a learning sampler; None for other samplers
    origins: bool  # whether the sampler reports the origin of each trial
    core: str | None  # whether the compiled core of the simulator is used; None if the simulator has no compiled core
    # what trials test otherwise than the user's files say, such as demand that the simulator omits; None if there is
    # nothing
    notices: list[str] | None
    disturb: list[str] | None  # disturbances of the trials with their rates; None without disturbances
    # the types of forks that the hunt makes of its trials: ``probes``, ``branches`` or both; None if the hunt makes no
    # forks
    copies: list[str] | None
    # for ``probes`` and ``branches``: number of crashes of forks that were run from the start to the end, and number of
    # these crashes that were confirmed
    confirmed: Mapping[str, Sequence[int]] | None
    # the machines of the last run, if there were several, each with the fields of `NodeFigures`
    nodes: list[JsonObject]
    kinds: list[KindData]  # the crash types, the most frequent first, if the hunt collects all crash types
    kinds_version: int  # version of the rules that decide which crashes are of the same type
    types_by_cause: int  # number of crash types by cause, if the hunt counts causes
    crash_on: list[str]  # the outcomes that count as a crash
    # time at which the last new crash type was found, in s since the epoch; None if there is none, or if it is unknown
    newest_kind: float | None
    audits_left: list[int] | None  # the trials that the audit has not yet run again; None if there are none
    # phase of the hunt after its last trial, with the fields of `PhaseStatus`; None before the first phase and at the
    # end
    phase: JsonObject | None
    # time at which the last trial is expected to end, in s since the epoch; None if it is unknown
    ends_at: float | None
    failed_steps: int  # number of simulated steps of confirmations that failed
    # trials of each crash type (in words) whose bundles were not kept because shorter crashes were kept
    dropped: dict[str, list[int]]
    # those of the trials in `dropped` whose crashes are the agent's fault, if the hunt determines the fault
    dropped_at_fault: list[int]
    # the judged crashes among the trials in `dropped`, by crash type (in words) and number of the trial. Each has its
    # cause, and the features that compare it with other crashes. None if there are none.
    dropped_judged: dict[str, dict[str, JsonObject]] | None
    # the progress towards a threshold: ``bar`` (the threshold as the user gave it), ``decided_at`` (number of the
    # deciding trial) and ``verdict``; None if the hunt has no threshold
    until_rate: UntilRate | None
    running_rate: RunningRate | None  # the current crash rate; None if no rate is known
    under_way: int  # the greatest number of trials that were under way at a time, running or queued
    code_versions: CodeVersionsData | None  # the versions of the code; None if all trials ran with the same code


class Facts(Noted, total=False):
    """All facts about a hunt."""

    state: str  # the last recorded state: ``running``, ``error``, or the reason why the hunt stopped
    detail: str | None  # the reason for the state, as text


class Seal(TypedDict):
    """The contents of a ledger when it was closed."""

    outcomes: Mapping[str, int]
    steps: int
    table: str
    dangers: str
    other_steps: int
    events: int
    replaced: int
    proposals: int
    facts: int
