"""The oracle protocol: whether a step is a crash."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.trial import Collision, Outcome
    from crashhunt.world import Event, Scene

__all__ = ["Finding", "Oracle", "merge_findings"]


@dataclass(frozen=True, slots=True)
class Finding:
    """A traffic crash or a traffic event that an oracle saw.

    Args:
        outcome: ``collision``, ``off_road``, or the kind of an event.
        collision: the evidence of a crash.
        event: the evidence of an event.
    """

    outcome: Outcome
    collision: Collision | None = None
    event: Event | None = None


class Oracle(Protocol):
    """Looks at scenes and says when one is a crash. It draws no random numbers and keeps no clock."""

    name: str
    """As it appears in ``seen_by``."""

    def check(self, scene: Scene, agents: Sequence[str]) -> list[Finding]:
        """Return the crashes of these controlled vehicles in this scene; usually none."""


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
