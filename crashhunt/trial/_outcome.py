"""How a trial can end, and which of the ends count as a crash."""

from __future__ import annotations

from enum import StrEnum

from crashhunt.world import EVENT_WORDS

__all__ = ["CRASHES", "EVENTS", "Outcome"]


class Outcome(StrEnum):
    """How a trial ended."""

    SURVIVED = "survived"
    FINISHED = "finished"
    COLLISION = "collision"
    OFF_ROAD = "off_road"
    RED_LIGHT = "red_light"
    WRONG_WAY = "wrong_way"
    OFF_ROUTE = "off_route"
    NOT_MOVING = "not_moving"
    OTHERS_COLLIDED = "others_collided"
    HARD_BRAKING = "hard_braking"
    TELEPORT = "teleport"
    AGENT_ERROR = "agent_error"
    SIMULATOR_ERROR = "simulator_error"
    PROCESS_DIED = "process_died"
    HANG = "hang"
    INVALID = "invalid"

    @property
    def is_traffic_crash(self) -> bool:
        """Whether the vehicle did harm on the road."""
        return self in (Outcome.COLLISION, Outcome.OFF_ROAD)

    @property
    def is_traffic_event(self) -> bool:
        """Whether it is something of the traffic that ends a trial only where somebody asked for it."""
        return str(self) in EVENT_WORDS

    @property
    def is_software_fault(self) -> bool:
        """Whether a program failed, not the driving."""
        return self in (Outcome.AGENT_ERROR, Outcome.SIMULATOR_ERROR, Outcome.PROCESS_DIED, Outcome.HANG)

    @property
    def category(self) -> str:
        """What a report calls it: ``traffic crash``, ``traffic event``, ``software fault`` or ``no crash``."""
        if self.is_traffic_crash:
            return "traffic crash"
        if self.is_traffic_event:
            return "traffic event"
        return "software fault" if self.is_software_fault else "no crash"


CRASHES = tuple(outcome for outcome in Outcome if outcome.is_traffic_crash or outcome.is_software_fault)
"""The outcomes that count as a crash unless ``--crash-on`` says otherwise."""


EVENTS = tuple(outcome for outcome in Outcome if outcome.is_traffic_event)
"""The outcomes that count as a crash only where ``--crash-on`` names them; they are recorded in any case."""
