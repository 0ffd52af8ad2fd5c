"""How a hunt is going, and what came of it."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.crashes import Bundle
    from crashhunt.hunts._audit import AuditReport
    from crashhunt.plans import HuntSettings
    from crashhunt.recording import BlackBoxHeader
    from crashhunt.trial import TrialResult

__all__ = ["HuntReport", "HuntStatus", "Progress", "StoppedBecause"]

StoppedBecause = Literal["crash", "all_trials", "interrupted", "no_valid_trial"]


@dataclass(frozen=True, slots=True)
class HuntStatus:
    """How a hunt is going, for people who watch.

    Args:
        phase: ``hunting``, ``saving``, ``auditing``, ``confirming`` or ``done``.
        planned: trials in all.
        done: trials that have ended, in earlier runs of the hunt too.
        outcomes: how they ended.
        rate_per_s: trials a second in this run.
        elapsed_s: wall time of this run.
        nearest: the trial that came nearest to a crash without one.
        workers: trial number to where it is.
        crashes: saved so far.
    """

    phase: str
    planned: int
    done: int
    outcomes: dict[str, int]
    rate_per_s: float
    elapsed_s: float
    nearest: TrialResult | None
    workers: dict[int, BlackBoxHeader]
    crashes: int


@dataclass(frozen=True, slots=True)
class HuntReport:
    """What came of a hunt.

    Args:
        directory: of the hunt.
        settings: what was asked.
        stopped_because: why it ended.
        outcomes: how the trials ended.
        steps_total: steps of all trials.
        wall_s: wall time of this run.
        crashes: what was found, the one with the fewest steps first.
        reason: in words, where not one trial was valid.
        notes: what people should know about how it went, such as trials that were run again.
        events: traffic events of all trials: kind to how many, and in how many trials.
        audit: what came of running trials without a crash again; None where nobody asked for it.
    """

    directory: Path
    settings: HuntSettings
    stopped_because: StoppedBecause
    outcomes: dict[str, int]
    steps_total: int
    wall_s: float
    crashes: tuple[Bundle, ...]
    reason: str = ""
    notes: tuple[str, ...] = ()
    events: dict[str, tuple[int, int]] = field(default_factory=dict)
    audit: AuditReport | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the shape that ``run --json`` prints."""
        return {
            "dir": str(self.directory),
            "hunt_seed": self.settings.seed,
            "trials_planned": self.settings.trials,
            "trials_run": sum(self.outcomes.values()),
            "outcomes": self.outcomes,
            "stopped_because": self.stopped_because,
            "wall_s": round(self.wall_s, 3),
            "steps_total": self.steps_total,
            "events": {kind: {"count": count, "trials": trials} for kind, (count, trials) in self.events.items()},
            "crashes": [bundle.summary() for bundle in self.crashes],
            "notes": list(self.notes),
            "audit": self.audit.to_json() if self.audit is not None else None,
        }


@dataclass(slots=True)
class Progress:
    """What this run of the hunt has seen."""

    began: float = field(default_factory=time.monotonic)
    ended_here: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    steps_total: int = 0
    crashes: list[Bundle] = field(default_factory=list)
    found: dict[int, TrialResult] = field(default_factory=dict)  # crashes that are not saved yet
    nearest: TrialResult | None = None
    last_invalid: TrialResult | None = None
    notes: list[str] = field(default_factory=list)
    audit: AuditReport | None = None
