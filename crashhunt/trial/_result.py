"""What came of a trial, which is what is kept of every trial: frozen, small, expressible as JSON."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from crashhunt.base.plain import finite
from crashhunt.trial._branches import Branches
from crashhunt.trial._disturbance import Disturbance
from crashhunt.trial._evidence import KILLED, Collision, Escape, Failure
from crashhunt.trial._outcome import Outcome, outcome_of
from crashhunt.trial._specification import TrialSpec
from crashhunt.trial._stress import Stress
from crashhunt.trial._summary import summarize
from crashhunt.world import ClosestApproach, Event

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from crashhunt.trial._data import ResultData

__all__ = ["TrialResult", "in_effect"]


@dataclass(frozen=True, slots=True)
class TrialResult:
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
    disturbances: tuple[Disturbance, ...] = ()
    log_likelihood: float | None = None
    danger: float | None = None
    stress: Stress | None = None
    branches: Branches | None = None
    setup_steps: int | None = None
    why_no_escape: str = ""

    def to_json(self) -> ResultData:
        """Return plain dicts, strings and numbers; what is not a finite number is null."""
        data: ResultData = {
            "steps": self.steps,
            "sim_time_s": self.sim_time_s,
            "digest": self.digest,
            "wall_s": self.wall_s,
            "setup_s": self.setup_s,
            "worker": self.worker,
            "kept": self.kept,
            "outcome": str(self.outcome),
            "category": self.outcome.category,
            "spec": self.spec.to_json(),
            "closest": self.closest.to_json(),
            "collision": self.collision.to_json() if self.collision else None,
            "failure": self.failure.to_json() if self.failure else None,
            "escape": self.escape.to_json() if self.escape else None,
            "event": self.event.to_json() if self.event else None,
            "events": dict(self.events) if self.events is not None else None,
        }
        if not self.outcome.is_own:
            del data["category"]
        if self.disturbances:
            data["disturbances"] = [one.to_json() for one in self.disturbances]
        if self.log_likelihood is not None:
            data["log_likelihood"] = finite(self.log_likelihood)
        if self.danger is not None:
            data["danger"] = finite(self.danger)
        if self.stress is not None:
            data["stress"] = self.stress.to_json()
        if self.branches is not None:
            data["branches"] = self.branches.to_json()
        if self.setup_steps is not None:
            data["setup_steps"] = self.setup_steps
        if self.why_no_escape:
            data["why_no_escape"] = self.why_no_escape
        return data

    @classmethod
    def from_json(cls, data: ResultData) -> TrialResult:
        """Rebuild what `to_json` returned, of any version: what it adds is left out, what it lacks is the default."""
        hit, failure = data.get("collision"), data.get("failure")
        event, escape, stress = data.get("event"), data.get("escape"), data.get("stress")
        branches = data.get("branches")
        return cls(
            spec=TrialSpec.from_json(data["spec"]),
            outcome=outcome_of(data),
            closest=ClosestApproach.from_json(data.get("closest") or {}),
            collision=Collision.from_json(hit) if hit else None,
            failure=Failure.from_json(failure) if failure else None,
            escape=Escape.from_json(escape) if escape else None,
            event=Event.from_json(event) if event else None,
            events=data.get("events"),
            steps=data.get("steps", 0),
            sim_time_s=data.get("sim_time_s", 0.0),
            digest=data.get("digest", ""),
            wall_s=data.get("wall_s", 0.0),
            setup_s=data.get("setup_s", 0.0),
            worker=data.get("worker", 0),
            kept=data.get("kept", False),
            disturbances=tuple(map(Disturbance.from_json, data.get("disturbances") or ())),
            log_likelihood=data.get("log_likelihood"),
            danger=data.get("danger"),
            stress=Stress.from_json(stress) if stress else None,
            branches=Branches.from_json(branches) if branches else None,
            setup_steps=data.get("setup_steps"),
            why_no_escape=data.get("why_no_escape", ""),
        )

    @property
    def was_killed_from_outside(self) -> bool:
        """Whether its processes were killed from outside until no attempt was left: how it ends is not known."""
        return self.failure is not None and self.failure.kind == KILLED

    @property
    def is_to_be_run_again(self) -> bool:
        """Whether something outside of the trial kept answers from it, so that a resumed hunt runs it again.

        Its processes were killed from outside, or those of its copies.
        """
        unasked = (one for one in (self.stress, self.branches) if one is not None)
        return self.was_killed_from_outside or any(one.may_be_asked_again for one in unasked)

    @property
    def is_fully_asked(self) -> bool:
        """Whether every question to its copies has an answer; also where there were to be none."""
        unasked = self.stress is not None and self.stress.margin is None
        return not unasked and not (self.branches is not None and self.branches.unanswered)

    @property
    def steps_begun(self) -> int:
        """How many steps were begun: one more than were completed, where something failed in the next."""
        return self.steps + (self.failure is not None)

    @property
    def other_steps(self) -> int:
        """How many steps were simulated for it beside its own: before the first one, and by copies of it."""
        return (self.setup_steps or 0) + sum(one.steps for one in (self.stress, self.branches) if one is not None)

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
