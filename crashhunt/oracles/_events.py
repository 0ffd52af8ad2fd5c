"""The oracle of traffic events, which asks for nothing but what the simulator has told."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.oracles._protocol import Finding
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.world import Scene

__all__ = ["TrafficEvents"]


class TrafficEvents:
    """Believes the simulator when it tells of red lights, standstills, teleports and their kind.

    An episode asks it last, and only where ``--crash-on`` names one of them: a collision in the same step comes first.
    """

    name = "traffic-events"

    def check(self, scene: Scene, agents: Sequence[str]) -> list[Finding]:
        """Return the events that the agents have part in."""
        return [Finding(Outcome(event.kind), event=event) for event in scene.events if event.agent in agents]
