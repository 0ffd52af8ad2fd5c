"""Reads the collisions that SUMO reports."""

from __future__ import annotations

from libsumo import _libsumo as sumo

from crashhunt.world import PERSON, Contact

_PERSON_LANE_TYPES = frozenset({"sharedLane", "junctionPedestrian", "crossing", "walkingarea"})
"""SUMO's collision types with a person as victim; a person may have the same id as a vehicle."""


class ReportedCollisions:
    """Reads the collisions that begin in a step; SUMO reports a collision in every step while it lasts."""

    def __init__(self) -> None:
        self._known: set[tuple[str, str]] = set()

    def read(self, *, persons: bool) -> tuple[Contact, ...]:
        """Return the collisions that began in this step."""
        found = []
        for collision in sumo.simulation_getCollisions():
            victim = collision.victim
            if collision.type in _PERSON_LANE_TYPES:
                if not persons:
                    continue
                victim = PERSON + victim
            pair = (collision.collider, victim)
            if pair not in self._known:
                self._known.add(pair)
                found.append(
                    Contact(
                        collider=collision.collider,
                        victim=victim,
                        kind=collision.type,
                        lane=collision.lane,
                        collider_speed=collision.colliderSpeed,
                        victim_speed=collision.victimSpeed,
                    )
                )
        return tuple(found)
