"""A disturbance: somebody around the agent errs, or what the agent sees or does comes late."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from crashhunt.base.codec import OMIT_DEFAULT, Serializable

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

__all__ = ["CELLS", "HELD", "KINDS", "OF_AGENT", "Disturbance", "Kind", "in_turn", "steps_of", "why_not"]

_DIGITS = 9  # of so many s: three steps of 0.1 s are 0.3 s

_PLACES = {
    "left ahead": "ahead of {} to the left",
    "ahead": "ahead of {}",
    "right ahead": "ahead of {} to the right",
    "left": "to the left of {}",
    "itself": "{}",
    "right": "to the right of {}",
    "left behind": "behind {} to the left",
    "behind": "behind {}",
    "right behind": "behind {} to the right",
}
CELLS = tuple(_PLACES)
"""The grid around an agent, as it drives: three lanes, and itself in the middle."""


@dataclass(frozen=True, slots=True)
class Kind:
    """What crashhunt knows of a kind of disturbance.

    Args:
        unit: of `Disturbance.how_strong`; empty for a share.
        words: what happens, a sentence; ``share`` stands for the strength in per cent. What is behind a ``|`` is only
            said where there is any strength.
        of_agent: whether it is the agent's own eyes or hands that err: then every simulator can do it.
        most: the strongest that means anything, such as the whole of a speed.
        less_is_worse: whether a lower number is the stronger disturbance.
    """

    unit: str
    words: str
    of_agent: bool = False
    most: float = math.inf
    less_is_worse: bool = False


KINDS: Mapping[str, Kind] = {
    "brake": Kind("m/s²", "{vehicle} brakes with {strong:.3g} m/s² for {long:g} s"),
    "stop": Kind("m/s²", "{vehicle} stops with {strong:.3g} m/s² and stands, for {long:g} s in all"),
    "dawdle": Kind("", "{vehicle} drives {share:.0f} % slower than it did for {long:g} s", most=1.0),
    "speed": Kind("", "{vehicle} wants to drive {share:.0f} % faster for {long:g} s"),
    "cut_in": Kind("m/s²", "{vehicle} cuts in on {agent} within {long:g} s| and brakes with {strong:.3g} m/s²"),
    "late_merge": Kind(
        "m", "{vehicle} merges only in the last {strong:.3g} m of its lane, for {long:g} s", less_is_worse=True
    ),
    "step_out": Kind("m/s", "{vehicle} steps out onto the road with {strong:.3g} m/s, and is back after {long:g} s"),
    "ignore_priority": Kind("", "{vehicle} heeds neither red lights nor priority for {long:g} s"),
    "late_observation": Kind("s", "{agent} sees everything {strong:g} s late for {long:g} s", of_agent=True),
    "noisy_observation": Kind("", "what {agent} sees is up to {share:.0f} % off for {long:g} s", True, most=1.0),
    "unseen": Kind("", "{agent} does not see {vehicle} for {long:g} s"),
    "late_action": Kind("s", "what {agent} does takes effect {strong:g} s late for {long:g} s", of_agent=True),
}  # fmt: skip
"""The kinds that come with crashhunt, by name; a simulator of somebody's own may know more."""

HELD: Mapping[str, Kind] = {
    "keep_speed": Kind("", "{vehicle} is held to its speed for {long:g} s"),
    "keep_lane": Kind("", "{vehicle} is held in its lane for {long:g} s"),
    "gone": Kind("", "{vehicle} is taken off the road"),
}
"""What another vehicle is kept from, to see what hangs on it: no hunt draws these, and the vehicle is named."""

OF_AGENT = frozenset(name for name, kind in KINDS.items() if kind.of_agent)
"""Those of them that need nothing of the simulator."""


def steps_of(seconds: float, step_length_s: float) -> int:
    """Return in how many steps something of so many s goes on: in one at least."""
    return max(1, round(min(seconds / step_length_s, sys.maxsize)))


def _in_steps(seconds: float, step_length_s: float) -> float:
    """How long something of so many s is, in whole steps; nothing at all is none."""
    found = steps_of(seconds, step_length_s) * step_length_s if seconds > 0 else 0.0
    return seconds if math.isclose(found, seconds) else round(found, _DIGITS)


@dataclass(frozen=True, slots=True)
class Disturbance(Serializable):
    """One disturbance: planned, as part of a trial's specification, or as it took place.

    Args:
        step: in which it begins, from 1.
        who: the place in the grid around the agent, one of `CELLS`, in which the vehicle is when it begins.
        what: the kind; of those that come with crashhunt, one of `KINDS` or `HELD`.
        how_strong: in the unit of its kind: m/s² of a braking, s of a delay, a share of a speed or of what is seen.
        how_long: in s of simulation time.
        agent: around which of the controlled vehicles.
        vehicle: who turned out to be meant; empty of what is planned, and where nobody was there. Of what a vehicle
            is kept from (`HELD`), who is meant, from the beginning.
    """

    step: int
    who: str
    what: str
    how_strong: float
    how_long: float
    agent: str = ""
    vehicle: str = field(default="", metadata=OMIT_DEFAULT)

    def took_place(self, vehicle: str, how_strong: float, step_length_s: float = 0.0) -> Disturbance:
        """Return it as it took place: in whole steps, so that with steps of 1 s nothing is 0.2 s late.

        Args:
            vehicle: who was there.
            how_strong: what that vehicle can do of it.
            step_length_s: of the simulation; 0 where nobody knows.
        """
        if not step_length_s:
            return replace(self, vehicle=vehicle, how_strong=how_strong)
        kind = KINDS.get(self.what)
        strong = _in_steps(how_strong, step_length_s) if kind is not None and kind.unit == "s" else how_strong
        return replace(self, vehicle=vehicle, how_strong=strong, how_long=_in_steps(self.how_long, step_length_s))

    @property
    def words(self) -> str:
        """What happens, for people; such as ``main.35 brakes with 4 m/s² for 2 s``."""
        agent = self.agent or "the agent"
        vehicle = self.vehicle or (agent if self.who == "itself" else f"whoever is {self.place}")
        kind = KINDS.get(self.what) or HELD.get(self.what)
        if kind is None:
            return f"{vehicle}: {self.what} {self.how_strong:g} for {self.how_long:g} s"
        always, _, where_strong = kind.words.partition("|")
        return (always + where_strong * (self.how_strong > 0)).format(
            vehicle=vehicle, agent=agent, strong=self.how_strong, share=100 * self.how_strong, long=self.how_long
        )

    @property
    def place(self) -> str:
        """Where it is, for people; such as ``ahead of ego to the left``."""
        agent = self.agent or "the agent"
        # A later version may know more places.
        return _PLACES[self.who].format(agent) if self.who in _PLACES else f"{self.who} of {agent}"

    def goes_on(self, step: int, step_length_s: float) -> bool:
        """Whether it goes on in a step, of a simulation with such steps."""
        return self.step <= step < self.step + steps_of(self.how_long, step_length_s)


def why_not(one: Disturbance) -> tuple[str, str] | None:
    """Return why nobody can mean such a disturbance, and the fix; None where somebody can.

    Args:
        one: planned, of whatever kind; the step is not looked at.
    """
    kind = KINDS.get(one.what)
    if not 0 <= one.how_strong < math.inf:
        return f"{one.how_strong:g} is no strength", "give a number from 0 on"
    if not 0 < one.how_long < math.inf:
        return f"{one.how_long:g} is no length", "give seconds above 0"
    if kind is None:
        return None
    if one.how_strong > kind.most:
        return f"{one.what} of {one.how_strong:g} is more than all", f"give a share of at most {kind.most:g}"
    if kind.of_agent != (one.who == "itself"):
        whose = "itself" if kind.of_agent else f"one of {', '.join(cell for cell in CELLS if cell != 'itself')}"
        return f"{one.what} is not about {one.who!r}", f"it is about {whose}"
    return None


def in_turn(disturbances: Iterable[Disturbance]) -> tuple[Disturbance, ...]:
    """Return disturbances in the order that a specification has them in."""
    return tuple(sorted(disturbances, key=lambda one: (one.step, one.agent, one.what)))
