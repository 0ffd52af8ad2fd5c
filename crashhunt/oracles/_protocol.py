"""The oracle protocol: whether a step is a crash."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.trial import Category, Collision, Outcome
    from crashhunt.world import Event, Lane, Scene

__all__ = ["BringsOutcomes", "Finding", "Oracle", "SeesMap", "merge_findings"]


@dataclass(frozen=True, slots=True)
class Finding:
    """A traffic crash or a traffic event that an oracle saw.

    Args:
        outcome: ``collision``, ``off_road``, the kind of an event, or an outcome of the oracle's own.
        collision: the evidence of a crash.
        event: the evidence of anything else; its ``what`` says in words what happened.
    """

    outcome: Outcome
    collision: Collision | None = None
    event: Event | None = None


class Oracle(Protocol):
    """Looks at scenes and says when one is a crash. It draws no random numbers and keeps no clock.

    Contract: a new oracle is made for every trial, with the arguments of ``--oracle NAME:key=value``. Its state
    therefore belongs to this trial only. `check` is called once a step, in order, also with the
    scene before the first step. ``scene.previous`` is the scene one step before, None at the start. A finding ends the
    trial if ``--crash-on`` has its outcome, and is discarded otherwise. An exception counts as a fault of the oracle.
    """

    name: str
    """As it appears in ``seen_by``."""

    def check(self, scene: Scene, agents: Sequence[str]) -> list[Finding]:
        """Return the crashes of these controlled vehicles in this scene; usually none."""


@runtime_checkable
class SeesMap(Protocol):
    """Offered by an oracle that wants to know the roads."""

    def see_map(self, lanes: Sequence[Lane]) -> None:
        """Take the map of the trial, before the first `Oracle.check`; empty where the simulator has none."""


@runtime_checkable
class BringsOutcomes(Protocol):
    """Implemented by oracles with outcomes of their own, or with findings that are crashes only on request."""

    outcomes: Mapping[str, Category]
    """Name to ``traffic crash`` or ``traffic event``. A hunt that chooses the oracle stops on them, unless
    ``--crash-on`` says otherwise."""


def merge_findings(findings: Sequence[Finding]) -> Finding | None:
    """Return the first finding, credited to every oracle that saw the same; None where there is none."""
    if not findings:
        return None
    first = findings[0]
    if first.collision is None:
        return first
    parties = {first.collision.collider, first.collision.victim}
    hits = [other.collision for other in findings if other.collision is not None]
    same = [hit for hit in hits if {hit.collider, hit.victim} == parties]
    seen_by = tuple(sorted({name for hit in same for name in hit.seen_by}))
    return Finding(first.outcome, replace(first.collision, seen_by=seen_by))
