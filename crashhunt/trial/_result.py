"""What came of a trial, which is what is kept of every trial: frozen, small, expressible as JSON."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Self

from crashhunt.base.codec import OMIT_DEFAULT, Serializable, from_plain, null_is, written_if
from crashhunt.trial._disturbance import Disturbance
from crashhunt.trial._evidence import KILLED, Collision, Escape, Failure
from crashhunt.trial._outcome import Outcome, outcome_of
from crashhunt.trial._specification import TrialSpec
from crashhunt.world import ClosestApproach, Event

__all__ = ["Branch", "Branches", "Forced", "ForcedCopy", "Stress", "TrialResult", "in_effect", "summarize"]


_NOT_ALL_ANSWERED = written_if(lambda branches: branches.unanswered)
_NOT_ALL_ASKED = written_if(lambda stress: stress.margin is None)


# What else might have happened: copies of a trial that went on with other disturbances.


@dataclass(frozen=True, slots=True)
class Branch(Serializable):
    """A branch that crashed, as a specification from the start.

    Args:
        disturbances: those of the trial up to where it branched, and those of the branch.
        branched: after which step it left the trial.
        outcome: of the branch.
        step: at which it ended.
        log_likelihood: that just what took place begins in these steps: the natural logarithm of the probability; None
            where it is none that the hunt's models would draw.
    """

    disturbances: tuple[Disturbance, ...]
    branched: int
    outcome: str
    step: int
    log_likelihood: float | None = field(default=None, metadata=null_is(None))


@dataclass(frozen=True, slots=True)
class Branches(Serializable):
    """What came of the branches of a trial.

    Args:
        moments: from how many copies went on.
        asked: how many branches there were.
        steps: how many steps they took.
        left_out: how many were left out, because branches had taken enough steps.
        crashes: those that crashed, in the order in which they were found.
        unanswered: how many more there were to be, of which no copy answered.
        why_unanswered: the reason for the first of them, in words; empty where there is none.
        may_be_asked_again: whether a reason lies outside of the trial, so that another run may get all answers.
    """

    moments: int = 0
    asked: int = 0
    steps: int = 0
    left_out: int = 0
    crashes: tuple[Branch, ...] = ()
    unanswered: int = field(default=0, metadata=_NOT_ALL_ANSWERED)
    why_unanswered: str = field(default="", metadata=_NOT_ALL_ANSWERED)
    may_be_asked_again: bool = field(default=False, metadata=_NOT_ALL_ANSWERED)

    @property
    def extent(self) -> str:
        """How much of it was asked, in words: "asked 12 of 13"."""
        return f"asked {self.asked} of {self.asked + self.unanswered}"


# How often it would have crashed: copies of a root, each with a first onset that was forced.


@dataclass(frozen=True, slots=True)
class ForcedCopy(Serializable):
    """What came of a copy with a forced first onset.

    Args:
        cell: the model and strength of the onset, as in `Forcing.ratios`.
        onset: step of the onset.
        weight: probability of the onsets that this copy represents, given the root.
        branched: the step after which it left the root.
        crash: the outcome where that is one of the hunt's crashes, else empty.
        step: at which the copy ended.
        disturbed: whether any disturbance had an effect on the copy.
        disturbances: of a crash, all that were planned from the start of the trial.
    """

    cell: str
    onset: int
    weight: float
    branched: int
    crash: str = ""
    step: int = 0
    disturbed: bool = True
    disturbances: tuple[Disturbance, ...] = field(default=(), metadata=OMIT_DEFAULT)


@dataclass(frozen=True, slots=True)
class Forced(Serializable):
    """What came of the copies of a root.

    Args:
        survival: probability that no first onset begins before the root ends.
        masses: by cell, the probability that the first onset is of this cell and begins before the root ends.
        copies: in the order of their onsets.
        steps: how many steps they took.
        unanswered: how many further copies there were to be, of which nothing is known.
        why_unanswered: the reason for the first of them; empty where there is none.
        may_be_asked_again: whether a reason lies outside of the trial, so that another run may get all answers.
    """

    survival: float
    masses: Mapping[str, float]
    copies: tuple[ForcedCopy, ...] = ()
    steps: int = 0
    unanswered: int = field(default=0, metadata=_NOT_ALL_ANSWERED)
    why_unanswered: str = field(default="", metadata=_NOT_ALL_ANSWERED)
    may_be_asked_again: bool = field(default=False, metadata=_NOT_ALL_ANSWERED)


# How little it would have taken: what copies of a trial have found out while it ran.


@dataclass(frozen=True, slots=True)
class Stress(Serializable):
    """What came of asking copies of a trial.

    Args:
        margin: the strength of the mildest disturbance that made it crash, as a share of the strongest that is
            plausible; 1 where none did, 0 where it crashed without any. None where not all was asked.
        probes: how many copies were asked.
        steps: how many steps they took.
        left_out: how many questions were left out, because copies had taken enough steps.
        disturbance: the mildest that made it crash; None where none did.
        outcome: of that copy.
        step: at which it ended.
        moments: at how many moments copies were to be asked; 0 where an earlier version wrote it.
        moments_asked: at how many of these every copy that was asked answered.
        margin_upper_bound: where not all was asked, the margin of what was: the whole margin is not greater.
        why_unasked: why not all was asked, in words; empty where all was.
        may_be_asked_again: whether the reason lies outside of the trial, so that another run may get all answers.
    """

    margin: float | None
    probes: int = 0
    steps: int = 0
    left_out: int = 0
    disturbance: Disturbance | None = None
    outcome: str = ""
    step: int = 0
    moments: int = 0
    moments_asked: int = 0
    margin_upper_bound: float | None = field(default=None, metadata=_NOT_ALL_ASKED)
    why_unasked: str = field(default="", metadata=_NOT_ALL_ASKED)
    may_be_asked_again: bool = field(default=False, metadata=_NOT_ALL_ASKED)

    @property
    def least(self) -> float:
        """The margin, or what it is at most where not all was asked."""
        found = self.margin_upper_bound if self.margin is None else self.margin
        return 1.0 if found is None else found

    @property
    def extent(self) -> str:
        """How much of it was asked, in words: "asked 1 of 9"."""
        return f"asked {self.moments_asked} of {self.moments}"


# A result in one sentence, "ego drove into main.31 at step 47": what commands, screen and page say of a trial.


def summarize(result: TrialResult) -> str:
    """Return the outcome of a trial in one line, for people."""
    if result.collision is not None:
        hit = result.collision
        if hit.role == "alone":
            what = "left the road" if result.outcome is Outcome.OFF_ROAD else f"crashed ({hit.kind})"
            return f"{hit.agent} {what} at step {result.steps}"
        verb = "drove into" if hit.role == "collider" else "was hit by"
        return f"{hit.agent} {verb} {hit.other} at step {result.steps}"
    if result.event is not None:
        return f"{result.event.what}, at step {result.steps}"
    if result.failure is not None:
        failure = result.failure
        if failure.traceback and failure.exit_code is None and failure.kind != "timeout":
            whose = f"{failure.agent}: " if failure.agent else ""
            return f"{whose}{failure.kind}: {failure.message}"
        return failure.message
    return f"{result.outcome} after {result.steps} steps"


@dataclass(frozen=True, slots=True)
class TrialResult(Serializable):
    """What came of one trial.

    Args:
        spec: what was asked.
        outcome: how it ended.
        steps: how many steps were completed; for a crash, the step at which it happened.
        sim_time_s: simulation time at the end, in s.
        digest: BLAKE2b over everything recorded, in hexadecimal; equal digests mean runs equal to the bit.
        closest: how near to a crash it came.
        collision: the evidence of a traffic crash.
        event: the evidence of a traffic event that somebody asked for.
        failure: the evidence of a software fault, or why the episode is invalid.
        wall_s: how long it took, in s of wall time.
        setup_s: the part of it before the first step.
        worker: the process id.
        kept: whether the worker left its scratch folder for the hunt to collect.
        escape: until when braking would have avoided it; None where nobody tried, or where it cannot be told.
        why_no_escape: why the search for it did not come to its end, where it was killed from outside; else empty.
        events: how many traffic events of which kind there were; None where nobody looked.
        disturbances: those that took place, with who turned out to be meant.
        log_likelihood: that just these disturbances begin in these steps, and no others: the natural logarithm of the
            probability, as the hunt's models have it; None where the hunt has none.
        danger: how near to a crash it came, from 0 (nothing near) to 1 (touched); None where nobody measured it.
        stress: how little it would have taken; None where nobody asked.
        branches: what else might have happened where it came near to a crash; None where nobody asked.
        setup_steps: how many steps were simulated before the first one, as for traffic to warm up; None where nobody
            counted. Where trials share a warm-up, it is that of the first of them.
        forced: what came of copies with a forced first onset; None where there were to be none.
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
    forced: Forced | None = field(default=None, metadata=OMIT_DEFAULT)

    json_keys = (
        "steps", "sim_time_s", "digest", "wall_s", "setup_s", "worker", "kept", "outcome", "category?", "spec",
        "closest", "collision", "failure", "escape", "event", "events", "disturbances", "log_likelihood", "danger",
        "stress", "branches", "setup_steps", "why_no_escape", "forced",
    )  # fmt: skip

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Rebuild what `to_json` returned, of any version; an oracle's own outcome keeps its category."""
        outcome_of(data)
        return from_plain(cls, data)

    @property
    def category(self) -> str | None:
        """The category of an outcome that an oracle has brought; None for the outcomes that every hunt has."""
        return self.outcome.category if self.outcome.is_own else None

    @property
    def was_killed_from_outside(self) -> bool:
        """Whether its processes were killed from outside until no attempt was left: how it ends is not known."""
        return self.failure is not None and self.failure.kind == KILLED

    @property
    def is_to_be_run_again(self) -> bool:
        """Whether something outside of the trial kept answers from it, so that a resumed hunt runs it again.

        Its processes were killed from outside, or those of its copies.
        """
        unasked = (one for one in (self.stress, self.branches, self.forced) if one is not None)
        return self.was_killed_from_outside or any(one.may_be_asked_again for one in unasked)

    @property
    def is_fully_asked(self) -> bool:
        """Whether every question to its copies has an answer; also where there were to be none."""
        unasked = self.stress is not None and self.stress.margin is None
        asked = (one for one in (self.branches, self.forced) if one is not None)
        return not unasked and not any(one.unanswered for one in asked)

    @property
    def steps_begun(self) -> int:
        """How many steps were begun: one more than were completed, where something failed in the next."""
        return self.steps + (self.failure is not None)

    @property
    def other_steps(self) -> int:
        """How many steps were simulated for it beside its own: before the first one, and by copies of it."""
        return (self.setup_steps or 0) + sum(
            one.steps for one in (self.stress, self.branches, self.forced) if one is not None
        )

    @property
    def nearness(self) -> tuple[float, float]:
        """What ranks trials by how near to a crash they came, the greater the nearer.

        By danger; those of which nobody measured it come last, by time to collision.
        """
        return -1.0 if self.danger is None else self.danger, -self.closest.time_to_collision_s

    @property
    def disturbed(self) -> bool:
        """Whether anything disturbed it: if not, it took place in the traffic as it is."""
        return bool(self.disturbances)

    @property
    def summary(self) -> str:
        """The outcome in one line, for people."""
        return summarize(self)


def in_effect(result: TrialResult, told: Iterable[Disturbance]) -> TrialResult:
    """Return a result with those disturbances that had an effect by the end, of all that were told."""
    found = tuple(one for one in told if one.vehicle and one.step <= result.steps_begun)
    return replace(result, disturbances=found) if found else result
