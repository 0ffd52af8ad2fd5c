"""Oracles of traffic events, which ask for nothing but what the simulator has told."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.oracles._protocol import Finding
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.trial import Category
    from crashhunt.world import Scene

__all__ = ["OffRoute", "RedLight", "Teleport", "TrafficEvents", "WrongWay"]


class TrafficEvents:
    """Believes the simulator when it tells of red lights, standstills, teleports and their kind.

    An episode asks it last, and only where ``--crash-on`` names one of them: a collision in the same step comes first.
    """

    name = "traffic-events"

    def check(self, scene: Scene, agents: Sequence[str]) -> list[Finding]:
        """Return the events that the agents have part in."""
        return [Finding(Outcome(event.kind), event=event) for event in scene.events if event.agent in agents]


class _Told:
    """Has a hunt stop on one kind of event: ``--oracle red-light`` is short for adding it to ``--crash-on``."""

    name: str
    outcomes: Mapping[str, Category]

    def check(self, scene: Scene, agents: Sequence[str]) -> list[Finding]:
        """Return the events of this kind that the agents have part in."""
        events = [event for event in scene.events if event.kind in self.outcomes and event.agent in agents]
        return [Finding(Outcome(event.kind), event=event) for event in events]


class RedLight(_Told):
    """Sees an agent run a red light, where the simulator tells of it."""

    name = "red-light"
    outcomes: Mapping[str, Category] = {"red_light": "traffic event"}


class WrongWay(_Told):
    """Sees an agent drive against the traffic, where the simulator tells of it."""

    name = "wrong-way"
    outcomes: Mapping[str, Category] = {"wrong_way": "traffic event"}


class OffRoute(_Told):
    """Sees an agent miss its route, where the simulator tells of it."""

    name = "off-route"
    outcomes: Mapping[str, Category] = {"off_route": "traffic event"}


class Teleport(_Told):
    """Sees the simulator move an agent that was stuck, where it tells of it."""

    name = "teleport"
    outcomes: Mapping[str, Category] = {"teleport": "traffic event"}
