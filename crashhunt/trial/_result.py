"""The result of a trial, which the ledger stores for every trial: immutable, small, convertible to JSON.

A crash has evidence: the collision, the software fault, and the last step at which braking avoids it.
"""

from __future__ import annotations

import errno
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Self

from crashhunt.base.codec import (
    OMIT_DEFAULT,
    JsonObject,
    Serializable,
    from_plain,
    null_is,
    plain_types,
    typed_where_there,
    written_if,
)
from crashhunt.base.integrity import typed
from crashhunt.base.signals import is_sent_from_outside
from crashhunt.base.text import count_of, encodable
from crashhunt.trial._disturbance import Disturbance
from crashhunt.trial._outcome import Outcome, outcome_of
from crashhunt.trial._specification import TrialSpec
from crashhunt.world import ClosestApproach, Event

KILLED: Final = "killed from outside"
"""Kind of the failure of a trial whose processes were killed from outside until no attempt was left."""
BAD_ACTION: Final = "bad action"
"""Kind of the failure of an agent whose action crashhunt refuses."""
UNUSABLE_VALUE: Final = "unusable value"
"""Kind of the failure of a trial in which a value of the user's code is neither a bool nor a number."""
_OF_SURROUNDINGS: Final = frozenset({
    errno.EAGAIN, errno.ECONNREFUSED, errno.ECONNRESET, errno.EDQUOT, errno.EHOSTUNREACH, errno.EIO, errno.EMFILE,
    errno.ENETUNREACH, errno.ENFILE, errno.ENOMEM, errno.ENOSPC, errno.EROFS, errno.ESTALE, errno.ETIMEDOUT,
})  # fmt: skip
_ERROR_NUMBER: Final = re.compile(r"\[Errno (\d+)\]")
_USERS: Final = ("agent", "environment", "oracle")


@dataclass(frozen=True, slots=True)
class Collision(Serializable):
    """A collision, or a departure from the road.

    Args:
        agent: The controlled vehicle that collided or left the road.
        role: The agent's role: ``collider`` (it drove into the other actor), ``victim``, or ``alone``.
        collider: Identifier of the actor that drove into the other actor.
        victim: Identifier of the actor that was hit; empty if there was none.
        seen_by: The oracles that detected the collision, sorted by name. If the simulator's report or the overlap of
            outlines is missing here, the two oracles disagree.
        kind: The simulator's type of the collision, such as ``collision`` or ``junction``.
        x: x of the controlled vehicle's front bumper, in m.
        y: y of the controlled vehicle's front bumper, in m.
        lane: The lane of the controlled vehicle.
        collider_speed: Speed of the collider at the first contact, in m/s.
        victim_speed: Speed of the victim at the first contact, in m/s.
        time_s: Simulation time of the first contact, which lies within the step, in s; NaN if it is unknown.
        cell: For a simulator without scenes, the flags and short texts that describe the state after the collision.
            Samplers search for crashes with different cells. The cell does not belong to the crash type, because one
            fault may end in several cells.
    """

    agent: str
    role: str
    collider: str
    victim: str = ""
    seen_by: tuple[str, ...] = ()
    kind: str = ""
    x: float = field(default=math.nan, metadata=null_is(math.nan))
    y: float = field(default=math.nan, metadata=null_is(math.nan))
    lane: str = ""
    collider_speed: float = field(default=math.nan, metadata=null_is(math.nan))
    victim_speed: float = field(default=math.nan, metadata=null_is(math.nan))
    time_s: float = field(default=math.nan, metadata=null_is(math.nan))
    cell: str = field(default="", metadata=OMIT_DEFAULT)

    def __eq__(self, other: object) -> bool:
        return self.equals(other)

    def involves(self, actor: str) -> bool:
        """Return whether an actor collided or left the road."""
        return actor in (self.agent, self.collider, self.victim)

    @property
    def other(self) -> str:
        """The collision partner of the agent; empty if the agent was alone."""
        if self.role == "alone":
            return ""
        return self.victim if self.role == "collider" else self.collider


@dataclass(frozen=True, slots=True)
class Escape(Serializable):
    """The last step at which full braking avoids a collision, found by counterfactual runs.

    Args:
        step: Full braking after this step avoids the collision; None if no such step was found.
        too_late: Full braking after this step does not avoid the collision. If ``step`` exists, ``too_late`` is the
            next step.
        braking: The greatest deceleration in these runs, in m/s²; None if the vehicle never slowed down.
        how: A description of the braking, as in `FullBraking`.
        why_not: The reason why neither `step` nor `too_late` is known; empty if one of them is known.
        changed: Further differences of the agent in the run that avoids the collision, such as ``ego does not change
            lanes``.
    """

    step: int | None = None
    too_late: int | None = None
    braking: float | None = None
    how: str = ""
    why_not: str = field(default="", metadata=OMIT_DEFAULT)
    changed: tuple[str, ...] = field(default=(), metadata=OMIT_DEFAULT)


@dataclass(frozen=True, slots=True)
class Failure(Serializable):
    """The evidence of a software fault.

    Args:
        kind: The exception's type, ``exit code``, ``signal``, ``timeout``, ``unusable value`` or ``killed from
            outside``.
        message: The message of the exception or failure, in one line.
        traceback: The traceback of the exception, or the stack of the stuck thread.
        agent: The agent whose code failed; empty if the code was not an agent's.
        party: The owner of the code that failed: ``agent``, ``environment``, ``simulator`` or ``oracle``; empty if it
            is unknown.
        place: The purpose for which this code was called, such as ``act``, ``step`` or ``space conversion``; empty if
            unknown.
        exit_code: The exit code of a process that died; negative for a signal, as in `subprocess`.
        last_output: The last output of the process.
    """

    kind: str = ""
    message: str = ""
    traceback: str = ""
    agent: str = ""
    exit_code: int | None = None
    last_output: str = ""
    party: str = field(default="", metadata=OMIT_DEFAULT)
    place: str = field(default="", metadata=OMIT_DEFAULT)

    def __post_init__(self) -> None:
        # The texts are written to JSON, logs and terminals, but an exception's message may contain invalid characters.
        for name in ("kind", "message", "traceback", "last_output"):
            object.__setattr__(self, name, encodable(getattr(self, name)))

    @property
    def line(self) -> str:
        """The kind and the message, in one line."""
        # A bare `assert`, or `next` at the end of an iterator, has no message.
        return f"{self.kind}: {self.message}" if self.message else self.kind

    @property
    def is_of_users_code(self) -> bool:
        """Whether code of the user certainly failed, and not its surroundings: memory, disk, network or a signal.

        A failure of the simulator itself is not certain either: what the user asked of it may be the cause.
        """
        if self.exit_code is not None:
            return self.exit_code >= 0 or not is_sent_from_outside(self.exit_code)
        number = _ERROR_NUMBER.search(self.message)
        lacks = self.kind.endswith("MemoryError") or (number is not None and int(number[1]) in _OF_SURROUNDINGS)
        return not lacks and (bool(self.agent) or self.party in _USERS)


def _summarize(
    outcome: Outcome, steps: int, *, collision: Collision | None, event: Event | None, failure: Failure | None
) -> str:
    """Return a sentence about the outcome of a trial, in one line."""
    if collision is not None:
        if collision.role == "alone":
            what = "left the road" if outcome is Outcome.OFF_ROAD else f"crashed ({collision.kind})"
            return f"{collision.agent} {what} at step {steps}"
        verb = "drove into" if collision.role == "collider" else "was hit by"
        return f"{collision.agent} {verb} {collision.other} at step {steps}"
    if event is not None:
        return f"{event.what}, at step {steps}"
    if failure is not None:
        if failure.traceback and failure.exit_code is None and failure.kind != "timeout":
            whose = f"{failure.agent}: " if failure.agent else ""
            if failure.party not in ("", "agent", "simulator"):
                whose = f"{failure.party} ({failure.place}): "
            return f"{whose}{failure.line}"
        return failure.message
    return f"{outcome} after {count_of(steps, 'step')}"


# Checks the JSON data of trials, which processes exchange and which ledgers and bundles contain.
#
# Keys that an earlier version did not write may be missing. Keys that a later version has added are accepted.


def check_disturbances(disturbances: Sequence[JsonObject] | None) -> None:
    """Check the types and ranges of a list of disturbances; None is valid.

    Raises:
        ValueError: A value has a wrong type or range; the message names the value.
    """
    typed({"disturbances": disturbances}, {"disturbances": list | None})
    for one in disturbances or ():
        typed({"disturbance": one}, {"disturbance": dict})
        _check(one, Disturbance)
        if one["step"] < 1 or not math.isfinite(one["how_strong"]) or not 0 < one["how_long"] < math.inf:
            raise ValueError("the step, strength or duration of a disturbance is out of its range")


def check_parts(
    closest: object, collision: object, failure: object, escape: object = None, event: object = None
) -> None:
    """Check the types of the evidence on the end of a trial; None is valid.

    Raises:
        ValueError: A value has a wrong type; the message names the value.
    """
    for name, part, kind in (
        ("closest", closest, ClosestApproach), ("collision", collision, Collision), ("failure", failure, Failure),
        ("escape", escape, Escape), ("event", event, Event),
    ):  # fmt: skip
        typed({name: part}, {name: dict if name == "closest" else dict | None})
        if isinstance(part, dict):
            _check(part, kind)


def _check(part: JsonObject, kind: Any) -> None:
    needed, known = plain_types(kind)
    typed(part, needed)
    typed_where_there(part, known)


_NOT_ALL_ANSWERED = written_if(lambda branches: branches.unanswered)
_NOT_ALL_ASKED = written_if(lambda stress: stress.margin is None)


MAX_ROBUSTNESS = 1e300
"""Represents an infinite robustness of a part of a requirement."""


# Branches: forks of a trial that continue with other disturbances.


@dataclass(frozen=True, slots=True)
class Branch(Serializable):
    """A branch that crashed, as a specification that repeats the crash from the start."""

    # the trial's disturbances up to the step of the branch, and the disturbances of the branch
    disturbances: tuple[Disturbance, ...]
    branched: int  # the step after which the branch differs from the trial
    outcome: str  # the outcome of the branch
    step: int  # the number of the branch's last step
    # natural logarithm of the probability that exactly these disturbances begin in these steps; None if the hunt's
    # models cannot draw them
    log_likelihood: float | None = field(default=None, metadata=null_is(None))


@dataclass(frozen=True, slots=True)
class Branches(Serializable):
    """The results of the branches of a trial."""

    moments: int = 0  # number of steps after which branches were started
    asked: int = 0  # number of completed branches
    steps: int = 0  # number of simulated steps of the branches
    left_out: int = 0  # number of branches that were skipped because the budget of steps was used up
    crashes: tuple[Branch, ...] = ()  # the branches that crashed, in the order in which they were found
    unanswered: int = field(default=0, metadata=_NOT_ALL_ANSWERED)  # number of planned branches that have no result
    # the reason for the first missing result; empty if no result is missing
    why_unanswered: str = field(default="", metadata=_NOT_ALL_ANSWERED)
    # whether a reason lies outside of the trial, so that another run may complete all branches
    may_be_asked_again: bool = field(default=False, metadata=_NOT_ALL_ANSWERED)

    @property
    def extent(self) -> str:
        """Return the number of completed branches as text, such as "asked 12 of 13"."""
        return f"asked {self.asked} of {self.asked + self.unanswered}"


# Rare mode: forks of a root, each with a forced first onset.


@dataclass(frozen=True, slots=True)
class ForcedCopy(Serializable):
    """The result of a copy with a forced first disturbance."""

    cell: str  # the model and strength of the first disturbance, as in `Forcing.ratios`
    # step in which the first disturbance begins; with a forced second disturbance, the step in which the second
    # disturbance begins
    onset: int
    weight: float  # probability of the disturbances that this copy represents, given the root trial
    branched: int  # the step after which the copy was forked from the root trial, or from another copy
    crash: str = ""  # the outcome if it counts as a crash in the hunt, else empty
    step: int = 0  # the step at which the copy ended
    disturbed: bool = True  # whether any disturbance had an effect in the copy
    # if the copy crashed, all disturbances that were planned from the start of the trial
    disturbances: tuple[Disturbance, ...] = field(default=(), metadata=OMIT_DEFAULT)
    # conditional probability of this copy, given its first disturbance. The probability is 1 if later disturbances are
    # drawn as usual. With forced second disturbances, it is the probability of the forced second disturbance, or of
    # none.
    within: float = field(default=1.0, metadata=OMIT_DEFAULT)
    # the cell (model and strength) of the forced second disturbance; empty if there is none
    second: str = field(default="", metadata=OMIT_DEFAULT)


@dataclass(frozen=True, slots=True)
class Forced(Serializable):
    """The results of the copies of a root trial."""

    survival: float  # probability that no first disturbance begins before the root trial ends
    # probability, by cell, that the first disturbance belongs to the cell and begins before the root trial ends
    masses: Mapping[str, float]
    # copies in the order of their first disturbances; each copy is followed by its own copies, with a second
    # disturbance
    copies: tuple[ForcedCopy, ...] = ()
    steps: int = 0  # number of simulated steps of the copies
    unanswered: int = field(default=0, metadata=_NOT_ALL_ANSWERED)  # number of planned copies without a result
    # the reason for the first missing result; empty if no result is missing
    why_unanswered: str = field(default="", metadata=_NOT_ALL_ANSWERED)
    # whether a reason lies outside of the trial, so that another run may return all results
    may_be_asked_again: bool = field(default=False, metadata=_NOT_ALL_ANSWERED)

    def by_first_onset(self) -> list[tuple[ForcedCopy, ...]]:
        """Return the copies of each first disturbance: the copy of the root trial, then its own copies."""
        groups: list[tuple[ForcedCopy, ...]] = []
        for copy in self.copies:
            if copy.second:
                groups[-1] += (copy,)
            else:
                groups.append((copy,))
        return groups


# Robustness probes: the minimal disturbance that makes a fork of the trial crash.


@dataclass(frozen=True, slots=True)
class Stress(Serializable):
    """The results of the robustness probes of a trial."""

    # The robustness margin: strength of the minimal disturbance that made a probe crash, as a share of the strongest
    # plausible disturbance. The margin is 1 if no probe crashed, and 0 if the trial crashed without a disturbance. The
    # margin is None if a probe has no result.
    margin: float | None
    probes: int = 0  # number of probes
    steps: int = 0  # number of simulated steps of the probes
    left_out: int = 0  # number of probes that were skipped because the budget of steps was used up
    disturbance: Disturbance | None = None  # the minimal disturbance that made a probe crash; None if no probe crashed
    outcome: str = ""  # the outcome of the probe with the minimal disturbance
    step: int = 0  # the last step of the probe with the minimal disturbance
    moments: int = 0  # number of steps after which probes were planned; 0 in results of earlier versions
    moments_asked: int = 0  # number of these steps for which all probes have a result
    # if a probe has no result, an upper bound of the margin from the other probes
    margin_upper_bound: float | None = field(default=None, metadata=_NOT_ALL_ASKED)
    # the reason why a probe has no result; empty if all probes have a result
    why_unasked: str = field(default="", metadata=_NOT_ALL_ASKED)
    # whether the reason lies outside of the trial, so that another run may complete all probes
    may_be_asked_again: bool = field(default=False, metadata=_NOT_ALL_ASKED)

    @property
    def least(self) -> float:
        """The margin, or its upper bound if a probe has no result."""
        found = self.margin_upper_bound if self.margin is None else self.margin
        return 1.0 if found is None else found

    @property
    def extent(self) -> str:
        """Return the number of steps with completed probes as text, such as "asked 1 of 9"."""
        return f"asked {self.moments_asked} of {self.moments}"


@dataclass(frozen=True, slots=True)
class TrialResult(Serializable):
    """The result of a trial.

    Args:
        spec: The specification of the trial.
        outcome: How the trial ended.
        steps: Number of completed steps; if the trial crashed, the step of the crash.
        sim_time_s: Simulation time at the end, in s.
        digest: BLAKE2b over the whole recording, in hexadecimal; equal digests mean bit-identical runs.
        closest: The closest approach to another actor.
        collision: The evidence of a traffic crash.
        event: The evidence of a traffic event that ``--crash-on`` names.
        failure: The evidence of a software fault, or the reason why the episode could not be set up.
        wall_s: Wall time of the trial, in s.
        setup_s: Wall time before the first step, which is part of ``wall_s``.
        worker: The process id of the worker.
        kept: Whether the worker left its scratch folder for the hunt to collect.
        escape: The last step at which braking avoids the crash; None if the search was not run or found no answer.
        why_no_escape: The reason why the search for the last braking step did not end, if its process
            was killed from outside; otherwise empty.
        events: Number of traffic events by type; None if they were not counted.
        disturbances: The disturbances that took place, with their vehicles.
        log_likelihood: Natural logarithm of the probability, under the hunt's models, that exactly these disturbances
            begin in these steps; None if the hunt has no models.
        danger: The criticality, from 0 (nothing near) to 1 (contact); None if it was not measured.
        stress: The results of robustness probes; None if there were none.
        branches: The results of branches; None if there were none.
        setup_steps: Number of simulated steps before the first step of the trial, such as a warm-up of traffic; None if
            they were not counted. If several trials share a warm-up, only the first trial counts it.
        driven_m: Distance that all agents together drove after the warm-up, in m; None if it is unknown.
        driven_s: Time that all agents together drove, in s of simulation time; None if it is unknown.
        step_length_s: Step length of the simulator, in s; None if it is unknown.
        forced: The results of forks with a forced first disturbance; None if there were none.
        robustness: The robustness of each requirement by name, negative if it is violated; None if it is infinite. The
            mapping is None if the trial had no requirements.
        conjuncts: For each requirement, a row per conjunct with the robustness of its disjuncts. Infinite values are
            `MAX_ROBUSTNESS`, with their sign.
        slack_s: For each requirement, the time by which each conjunct holds, in s, limited in the same way.
    """

    spec: TrialSpec
    outcome: Outcome
    steps: int = 0
    sim_time_s: float = 0.0
    digest: str = ""
    closest: ClosestApproach = field(default_factory=ClosestApproach)
    collision: Collision | None = None
    failure: Failure | None = None
    wall_s: float = 0.0
    setup_s: float = 0.0
    worker: int = 0
    kept: bool = False
    escape: Escape | None = None
    event: Event | None = None
    events: Mapping[str, int] | None = None
    disturbances: tuple[Disturbance, ...] = field(default=(), metadata=OMIT_DEFAULT)
    log_likelihood: float | None = field(default=None, metadata={**OMIT_DEFAULT, **null_is(None)})
    danger: float | None = field(default=None, metadata={**OMIT_DEFAULT, **null_is(None)})
    stress: Stress | None = field(default=None, metadata=OMIT_DEFAULT)
    branches: Branches | None = field(default=None, metadata=OMIT_DEFAULT)
    setup_steps: int | None = field(default=None, metadata=OMIT_DEFAULT)
    why_no_escape: str = field(default="", metadata=OMIT_DEFAULT)
    driven_m: float | None = field(default=None, metadata={**OMIT_DEFAULT, **null_is(None)})
    driven_s: float | None = field(default=None, metadata={**OMIT_DEFAULT, **null_is(None)})
    step_length_s: float | None = field(default=None, metadata={**OMIT_DEFAULT, **null_is(None)})
    forced: Forced | None = field(default=None, metadata=OMIT_DEFAULT)
    robustness: Mapping[str, float | None] | None = field(default=None, metadata=OMIT_DEFAULT)
    conjuncts: Mapping[str, tuple[tuple[float, ...], ...]] | None = field(default=None, metadata=OMIT_DEFAULT)
    slack_s: Mapping[str, tuple[float, ...]] | None = field(default=None, metadata=OMIT_DEFAULT)

    json_keys = (
        "steps", "sim_time_s", "digest", "wall_s", "setup_s", "worker", "kept", "outcome", "category?", "spec",
        "closest", "collision", "failure", "escape", "event", "events", "disturbances", "log_likelihood", "danger",
        "stress", "branches", "setup_steps", "why_no_escape", "driven_m", "driven_s",
        "step_length_s", "forced", "robustness", "conjuncts", "slack_s",
    )  # fmt: skip

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Return the result from the data of `to_json` of any version; an oracle's own outcome keeps its category."""
        outcome_of(data)
        return from_plain(cls, data)

    @property
    def category(self) -> str | None:
        """The category of an outcome that an oracle has added; None for built-in outcomes."""
        return self.outcome.category if self.outcome.is_own else None

    def is_identical_run(self, other: TrialResult) -> bool:
        """Return whether two runs had the same outcome and bit-identical steps."""
        return (self.outcome, self.digest) == (other.outcome, other.digest)

    @property
    def was_killed_from_outside(self) -> bool:
        """Whether processes of the trial were killed from outside in every attempt, so that its outcome is unknown."""
        return self.failure is not None and self.failure.kind == KILLED

    def is_no_answer_to(self, first: str) -> bool:
        """Return whether this second run of a trial says nothing about the outcome of the ``first`` run.

        It was killed from outside, or it exceeded the time limit and the first run did not, as on a busy machine.
        """
        return self.was_killed_from_outside or (self.outcome is Outcome.HANG and first != Outcome.HANG)

    @property
    def is_to_be_run_again(self) -> bool:
        """Whether a resumed hunt runs the trial again, because its processes or forks were killed from outside."""
        unasked = (one for one in (self.stress, self.branches, self.forced) if one is not None)
        return self.was_killed_from_outside or any(one.may_be_asked_again for one in unasked)

    @property
    def is_fully_asked(self) -> bool:
        """Whether all planned probes and branches have a result; true if none were planned."""
        unasked = self.stress is not None and self.stress.margin is None
        asked = (one for one in (self.branches, self.forced) if one is not None)
        return not unasked and not any(one.unanswered for one in asked)

    @property
    def steps_begun(self) -> int:
        """Number of steps that were begun: one more than the completed steps if a software fault ended the trial."""
        return self.steps + (self.failure is not None)

    @property
    def other_steps(self) -> int:
        """Number of further simulated steps: before the first step of the trial, and in its forks."""
        return (self.setup_steps or 0) + sum(
            one.steps for one in (self.stress, self.branches, self.forced) if one is not None
        )

    @property
    def nearness(self) -> tuple[float, float]:
        """The sort key of trials by criticality; a greater key means a more critical trial.

        Trials without a measured criticality come last, sorted by time to collision.
        """
        return -1.0 if self.danger is None else self.danger, -self.closest.time_to_collision_s

    @property
    def disturbed(self) -> bool:
        """Whether a disturbance took place in the trial."""
        return bool(self.disturbances)

    @property
    def summary(self) -> str:
        """A sentence that describes the outcome, in one line."""
        return _summarize(self.outcome, self.steps, collision=self.collision, event=self.event, failure=self.failure)


def in_effect(result: TrialResult, reported: Iterable[Disturbance]) -> TrialResult:
    """Return a result without those reported disturbances that had no effect before the end of the trial."""
    found = tuple(one for one in reported if one.vehicle and one.step <= result.steps_begun)
    return replace(result, disturbances=found) if found else result
