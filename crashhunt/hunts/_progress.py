"""How a hunt is going."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING

from crashhunt.base.faculties import offers
from crashhunt.executors import HasNodes

if TYPE_CHECKING:
    from crashhunt.crashes import Bundle
    from crashhunt.executors import Executor, NodeFigures
    from crashhunt.hunts._audit import AuditReport
    from crashhunt.hunts._data import Noted
    from crashhunt.recording import BlackBoxHeader
    from crashhunt.trial import TrialResult

__all__ = ["HuntStatus", "Progress"]


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
        nodes: the machines that take part now; None where there is this one only.
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
    nodes: tuple[NodeFigures, ...] | None = None


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
    nodes: tuple[NodeFigures, ...] | None = None

    def look_at(self, executor: Executor) -> None:
        """Take note of where trials run."""
        self.nodes = tuple(executor.nodes()) if offers(executor, HasNodes) else None

    def noted(self) -> Noted:
        """Return what the ledger is to say about now."""
        nodes: Noted = {} if self.nodes is None else {"nodes": [asdict(node) for node in self.nodes]}
        return {"heartbeat": time.time(), **nodes}
