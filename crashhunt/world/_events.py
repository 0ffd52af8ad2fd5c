"""Traffic events: what a traffic engineer wants to be told even where nobody crashed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypedDict

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.base.plain import Plain

# Imports that are not for the words stand inside: --help needs the words alone.
__all__ = ["EVENT_WORDS", "LIMITS", "Event", "EventData", "event_counts"]

EVENT_WORDS = {
    "red_light": ("red light run", "red lights run"),
    "wrong_way": ("wrong-way drive", "wrong-way drives"),
    "off_route": ("route missed", "routes missed"),
    "not_moving": ("long standstill", "long standstills"),
    "others_collided": ("collision of others", "collisions of others"),
    "hard_braking": ("hard braking of another", "hard brakings of others"),
    "teleport": ("teleport", "teleports"),
}
"""Each kind, in words: of one and of several."""

LIMITS: Mapping[str, tuple[float, str]] = {"not_moving": (60.0, "s"), "hard_braking": (math.nan, "m/s²")}
"""The kinds that have a limit, which may be asked for as ``KIND:LIMIT``: what it is by default, and its unit. NaN
stands for the ``decel`` of the braking vehicle's own type."""


class EventData(TypedDict):
    """The plain data of an `Event`."""

    kind: str
    agent: str
    what: str
    others: Sequence[str]
    lane: str
    x: float | None
    y: float | None
    speed: float | None


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened in the traffic around a controlled vehicle.

    Args:
        kind: one of `EVENT_WORDS`.
        agent: the controlled vehicle that did it, or to which it was nearest.
        what: in words, a clause such as ``ego ran the red light 'c'``.
        others: the other vehicles that took part.
        lane: where the controlled vehicle was.
        x: of its front bumper, in m.
        y: likewise.
        speed: its own, in m/s.
    """

    kind: str
    agent: str
    what: str
    others: tuple[str, ...] = ()
    lane: str = ""
    x: float = math.nan
    y: float = math.nan
    speed: float = math.nan

    def to_json(self) -> EventData:
        """Return plain strings and numbers; what is not a finite number is null."""
        from crashhunt.base.plain import finite

        return {
            "kind": self.kind,
            "agent": self.agent,
            "what": self.what,
            "others": list(self.others),
            "lane": self.lane,
            "x": finite(self.x),
            "y": finite(self.y),
            "speed": finite(self.speed),
        }

    @classmethod
    def from_json(cls, data: Plain) -> Event:
        """Rebuild what `to_json` returned; what a later version has added is left out."""
        from crashhunt.base.tolerance import known_values

        known = known_values(cls, data, null=math.nan)
        return cls(**{**known, "others": tuple(known.get("others", ()))})


def event_counts(counts: Mapping[str, int]) -> str:
    """Return in words how many of which kinds there were, such as ``2 red lights run, 1 teleport``."""
    return ", ".join(
        f"{count} {EVENT_WORDS.get(kind, (kind, kind))[count != 1]}" for kind, count in counts.items() if count
    )
