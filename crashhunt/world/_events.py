"""Traffic events: what a traffic engineer wants to be told even where nobody crashed."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["EVENT_WORDS", "LIMITS", "Event", "event_counts"]

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

    def to_json(self) -> dict[str, Any]:
        """Return plain strings and numbers; what is not a finite number is null."""
        data = {**asdict(self), "others": list(self.others)}
        return {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in data.items()
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Event:
        """Rebuild what `to_json` returned; what a later version has added is left out."""
        known: dict[str, Any] = {
            name: math.nan if value is None else value for name, value in data.items() if name in cls.__slots__
        }
        return cls(**{**known, "others": tuple(known.get("others", ()))})


def event_counts(counts: Mapping[str, int]) -> str:
    """Return in words how many of which kinds there were, such as ``2 red lights run, 1 teleport``."""
    return ", ".join(
        f"{count} {EVENT_WORDS.get(kind, (kind, kind))[count != 1]}" for kind, count in counts.items() if count
    )
