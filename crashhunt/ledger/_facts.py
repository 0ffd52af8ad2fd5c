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
    """The facts about a hunt that are recorded in addition to its state; setting a fact to None removes it.

    Args:
        owner: the process that runs the hunt; None while no process runs it.
        began: time at which the hunt was started or resumed, in s since the epoch.
        heartbeat: time of the last sign of life of the hunt, in s since the epoch.
        elapsed_s: duration of this run of the hunt up to that sign of life, in s, by the monotonic clock.
        done_before: number of trials that had ended at the start of this run.
        planned: number of planned trials; 0 if only the time is limited.
        replanned: whether the number of planned trials was changed after some trials had ended.
        until: time at which the hunt's time limit ends, in s since the epoch; None if there is no time limit.
        hunt_seed: seed from which the trials of the hunt are drawn.
        independent: whether the trials were drawn independently of each other.
        plain_origin: origin of the independent trials, if the sampler also draws some trials that it does not guide;
            else None.
        lag: maximum number of trials by which results reach a learning sampler late.
        sampler_version: version of the proposals of a learning sampler; None for other samplers.
        origins: whether the sampler reports the origin of each trial.
        core: whether the compiled core of the simulator is used; None if the simulator has no compiled core.
        notices: what trials test otherwise than the user's files say, such as demand that the simulator omits;
            None if there is nothing.
        disturb: disturbances of the trials with their rates; None without disturbances.
        copies: the types of forks that the hunt makes of its trials: ``probes``, ``branches`` or both; None if the hunt
            makes no forks.
        confirmed: for ``probes`` and ``branches``: number of crashes of forks that were run from the start to the end,
            and number of these crashes that were confirmed.
        nodes: the machines of the last run, if there were several, each with the fields of `NodeFigures`.
        kinds: the crash types, the most frequent first, if the hunt collects all crash types.
        kinds_version: version of the rules that decide which crashes are of the same type.
        types_by_cause: number of crash types by cause, if the hunt counts causes.
        crash_on: the outcomes that count as a crash.
        dropped: trials of each crash type (in words) whose bundles were not kept because shorter crashes were kept.
        dropped_at_fault: those of the trials in `dropped` whose crashes are the agent's fault, if the hunt determines
            the fault.
        dropped_judged: the judged crashes among the trials in `dropped`, by crash type (in words) and number of the
            trial. Each has its cause, and the features that compare it with other crashes. None if there are none.
        newest_kind: time at which the last new crash type was found, in s since the epoch; None if there is none, or if
            it is unknown.
        audits_left: the trials that the audit has not yet run again; None if there are none.
        phase: phase of the hunt after its last trial, with the fields of `PhaseStatus`; None before the first
            phase and at the end.
        ends_at: time at which the last trial is expected to end, in s since the epoch; None if it is unknown.
        failed_steps: number of simulated steps of confirmations that failed.
        until_rate: the progress towards a threshold: ``bar`` (the threshold as the user gave it), ``decided_at``
            (number of the deciding trial) and ``verdict``; None if the hunt has no threshold.
        running_rate: the current crash rate; None if no rate is known.
        under_way: the greatest number of trials that were under way at a time, running or queued.
        code_versions: the versions of the code; None if all trials ran with the same code.
    """

    owner: HuntOwner | None
    began: float
    heartbeat: float
    elapsed_s: float
    done_before: int
    planned: int
    replanned: bool | None
    until: float | None
    hunt_seed: int
    independent: bool
    plain_origin: str | None
    lag: int | None
    sampler_version: int | None
    origins: bool
    core: str | None
    notices: list[str] | None
    disturb: list[str] | None
    copies: list[str] | None
    confirmed: Mapping[str, Sequence[int]] | None
    nodes: list[JsonObject]
    kinds: list[KindData]
    kinds_version: int
    types_by_cause: int
    crash_on: list[str]
    newest_kind: float | None
    audits_left: list[int] | None
    phase: JsonObject | None
    ends_at: float | None
    failed_steps: int
    dropped: dict[str, list[int]]
    dropped_at_fault: list[int]
    dropped_judged: dict[str, dict[str, JsonObject]] | None
    until_rate: UntilRate | None
    running_rate: RunningRate | None
    under_way: int
    code_versions: CodeVersionsData | None


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
