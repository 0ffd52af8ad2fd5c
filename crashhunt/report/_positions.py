"""How two stood to each other, in words."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from crashhunt.crashes import Encounter, Moment

__all__ = ["STANDS", "about_gap", "about_place"]

STANDS = 0.05  # m/s; what is less is shown as 0
_PLACES = {
    "ahead": "ahead of {agent}",
    "behind": "behind {agent}",
    "left": "to the left of {agent}",
    "right": "to the right of {agent}",
}
_WAYS = {
    "same": "going the same way",
    "other": "going the other way",
    "left": "crossing from right to left",
    "right": "crossing from left to right",
}


def about_gap(encounter: Encounter, moment: Moment) -> str:
    """Return how far apart the two were, and how fast."""
    return (
        f"they were {moment.gap_m:.1f} m apart, {_closing(moment.closing_speed)}; {encounter.agent} at "
        f"{moment.speed:.1f} m/s, {encounter.other} at {moment.other_speed:.1f} m/s"
    )


def about_place(encounter: Encounter, moment: Moment) -> str:
    """Return where the other one was, and where it went."""
    position = encounter.position(moment.step)
    assert position is not None
    going = _WAYS[position.faces] if abs(moment.other_speed) >= STANDS else "standing"
    return f"{encounter.other} was {_PLACES[position.place].format(agent=encounter.agent)}, {going}"


def _closing(speed: float) -> str:
    if abs(speed) < STANDS:
        return "keeping their distance"
    return f"{'closing' if speed > 0 else 'parting'} at {abs(speed):.1f} m/s"
