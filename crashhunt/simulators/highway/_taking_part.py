"""Vehicles and obstacles that do not take part in an episode, though the environment has them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.trial import EVERYBODY

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from highway_env.road.road import Road
    from highway_env.vehicle.objects import RoadObject

    from crashhunt.world import Actor

__all__ = ["TakingPart"]


class TakingPart:
    """Takes them off the road before the step after the one in which they have come.

    They are named in the order in which they come, whether they stay or not. Where an environment lets others in by
    and by, it may let other ones in where some are missing.

    Args:
        road: of the environment.
        takes_part: the names of those that stay, as in scenes.
        agents: those of the controlled vehicles, which stay as well.
        things: returns all that there are.
        actor_of: returns what does not change about one, such as its name.

    Attributes:
        entered: the names of all that have come, in their order; the agents are not among them.
    """

    def __init__(
        self,
        road: Road,
        takes_part: Iterable[str],
        agents: Iterable[str],
        things: Callable[[], Iterable[RoadObject]],
        actor_of: Callable[[RoadObject], Actor],
    ) -> None:
        self._road, self._things, self._actor_of = road, things, actor_of
        self._agents = frozenset(agents)
        self._takes_part = frozenset(takes_part) | self._agents
        self.entered: list[str] = []
        self._seen: set[str] = set()

    def remove(self) -> bool:
        """Remove those that have come; returns whether there were any."""
        gone = set()
        for thing in self._things():
            name = self._actor_of(thing).id
            if name not in self._seen and name not in self._agents:
                self._seen.add(name)
                self.entered.append(name)
            if name not in self._takes_part and EVERYBODY not in self._takes_part:
                gone.add(id(thing))
        if gone:
            self._road.vehicles = [thing for thing in self._road.vehicles if id(thing) not in gone]
            self._road.objects = [thing for thing in self._road.objects if id(thing) not in gone]
        return bool(gone)
