"""What came of a trial: frozen, small, expressible as JSON."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from crashhunt.trial._evidence import Collision, Escape, Failure, finite
from crashhunt.trial._outcome import Outcome, outcome_of
from crashhunt.trial._specification import TrialSpec
from crashhunt.world import ClosestApproach, Event

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["TrialResult"]


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
        events: how many traffic events of which kind there were; None where nobody looked.
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

    def to_json(self) -> dict[str, Any]:
        """Return plain dicts, strings and numbers; what is not a finite number is null."""
        data = {name: getattr(self, name) for name in _PLAIN}
        return {
            **data,
            "outcome": str(self.outcome),
            **({"category": self.outcome.category} if self.outcome.is_own else {}),
            "spec": self.spec.to_json(),
            "closest": self.closest.to_json(),
            "collision": finite(asdict(self.collision)) if self.collision else None,
            "failure": asdict(self.failure) if self.failure else None,
            "escape": asdict(self.escape) if self.escape else None,
            "event": self.event.to_json() if self.event else None,
            "events": dict(self.events) if self.events is not None else None,
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> TrialResult:
        """Rebuild what `to_json` returned, of any version: what it adds is left out, what it lacks is the default."""
        hit, failure, event, escape = (data.get(name) for name in ("collision", "failure", "event", "escape"))
        return cls(
            spec=TrialSpec.from_json(data["spec"]),
            outcome=outcome_of(data),
            closest=ClosestApproach.from_json(data.get("closest") or {}),
            collision=Collision.from_json(hit) if hit else None,
            failure=Failure.from_json(failure) if failure else None,
            escape=Escape.from_json(escape) if escape else None,
            event=Event.from_json(event) if event else None,
            events=data.get("events"),
            **{name: data[name] for name in _PLAIN if name in data},
        )

    @property
    def summary(self) -> str:
        """The outcome in one line, for people."""
        if self.collision is not None:
            hit = self.collision
            if hit.role == "alone":
                what = "left the road" if self.outcome is Outcome.OFF_ROAD else f"crashed ({hit.kind})"
                return f"{hit.agent} {what} at step {self.steps}"
            verb = "drove into" if hit.role == "collider" else "was hit by"
            return f"{hit.agent} {verb} {hit.other} at step {self.steps}"
        if self.event is not None:
            return f"{self.event.what}, at step {self.steps}"
        if self.failure is not None:
            failure = self.failure
            if failure.traceback and failure.exit_code is None and failure.kind != "timeout":
                whose = f"{failure.agent}: " if failure.agent else ""
                return f"{whose}{failure.kind}: {failure.message}"
            return failure.message
        return f"{self.outcome} after {self.steps} steps"


# A field with a plain value is written and read if it is named here.
_PLAIN = ("steps", "sim_time_s", "digest", "wall_s", "setup_s", "worker", "kept")
