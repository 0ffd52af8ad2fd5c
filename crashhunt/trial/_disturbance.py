"""Disturbances: an actor near the agent misbehaves, or the agent's observations or actions are delayed or wrong."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

from crashhunt.base.codec import OMIT_DEFAULT, Serializable

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

_DURATION_DIGITS = 9  # decimal places of a duration in s, so that three steps of 0.1 s are 0.3 s

_CELL_BY_PLACE = {
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
CELLS = tuple(_CELL_BY_PLACE)
"""The places in the grid around a driving agent: three lanes, with the agent itself in the middle."""


@dataclass(frozen=True, slots=True)
class Kind:
    """Properties of a kind of disturbance.

    Args:
        unit: The unit of `Disturbance.how_strong`; empty for a share.
        words: A sentence that describes the disturbance. ``share`` is the strength in per cent. The part after ``|`` is
            used only if the strength is above 0.
        of_agent: Whether the disturbance affects the agent's own observations or actions, so that every simulator
            supports it.
        most: The largest meaningful strength, such as 1 for a share of a speed.
        less_is_worse: Whether a smaller number is a stronger disturbance.
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
"""The types of disturbances that crashhunt has, by name; other simulators may add types."""

STRENGTH_MARK = "@"
"""In the name of a scenario argument that is the strength of a disturbance over time, such as ``brake@50``."""

HOLD_KINDS: Mapping[str, Kind] = {
    "keep_speed": Kind("", "{vehicle} is held to its speed for {long:g} s"),
    "keep_lane": Kind("", "{vehicle} is held in its lane for {long:g} s"),
    "gone": Kind("", "{vehicle} is taken off the road"),
}
"""The holds of other vehicles for counterfactual runs: hunts never draw them, and each names its vehicle."""

Manoeuvre = Literal[
    "brake", "left", "right", "keep_lane", "keep_speed", "reference_speed", "reference_lanes", "reference"
]
"""What an agent can be overruled with: it brakes, changes lanes to a side and brakes, or keeps its lane or speed.

With the last three, a reference driver corrects its speed, its lane changes, or both, where they are not safe."""

SENSOR_KINDS = frozenset(name for name, kind in KINDS.items() if kind.of_agent)
"""The types that affect the agent itself and need no support by the simulator."""


def steps_of(seconds: float, step_length_s: float) -> int:
    """Return the number of steps in a duration, at least 1."""
    return max(1, round(min(seconds / step_length_s, sys.maxsize)))


def _in_steps(seconds: float, step_length_s: float) -> float:
    """Return a duration in s, rounded to whole steps but at least one step; 0 stays 0."""
    found = steps_of(seconds, step_length_s) * step_length_s if seconds > 0 else 0.0
    return seconds if math.isclose(found, seconds) else round(found, _DURATION_DIGITS)


@dataclass(frozen=True, slots=True)
class Disturbance(Serializable):
    """A disturbance: either planned in a trial's specification, or as it really took place."""

    step: int  # the step in which the disturbance begins, counted from 1
    who: str  # the place of the vehicle around the agent when the disturbance begins, one of `CELLS`
    what: str  # the kind of the disturbance: one of `KINDS` or `HOLD_KINDS`, or a kind that another simulator adds
    # the strength in the unit of the kind: m/s² of braking, s of delay, or a share of a speed or of a value
    how_strong: float
    how_long: float  # the duration in s of simulation time
    agent: str = ""  # the controlled vehicle around which the place is chosen
    # The vehicle that was at the place. The field is empty if the disturbance is only planned, or if no vehicle was at
    # the place. A hold (`HOLD_KINDS`) names its vehicle from the beginning.
    vehicle: str = field(default="", metadata=OMIT_DEFAULT)
    # The strength in each step, if it follows an `InputSignal`; ``how_strong`` is then the greatest. The field is empty
    # if the strength is constant, or if the disturbance is only planned.
    strengths: tuple[float, ...] = field(default=(), metadata=OMIT_DEFAULT)

    @property
    def signal(self) -> str:
        """The name of the scenario argument that holds the strength over time, if the strength is a signal."""
        return f"{self.what}{STRENGTH_MARK}{self.step}"

    def following(self, signal: Callable[[float], float], step_length_s: float) -> Disturbance:
        """Return the disturbance with a strength that follows a signal, at most as strong as planned."""
        steps = range(steps_of(self.how_long, step_length_s))
        strengths = tuple(min(self.how_strong, max(0.0, signal(step * step_length_s))) for step in steps)
        return replace(self, how_strong=max(strengths), strengths=strengths)

    def strength_in(self, step: int) -> float:
        """Return the strength in a step of the disturbance, counted from 0."""
        return self.strengths[min(step, len(self.strengths) - 1)] if self.strengths else self.how_strong

    def took_place(self, vehicle: str, how_strong: float, step_length_s: float = 0.0) -> Disturbance:
        """Return the disturbance as it took place, with durations and delays in whole steps.

        The strength is the one that this vehicle can reach. The step length is 0 if it is unknown.
        """
        if not step_length_s:
            return replace(self, vehicle=vehicle, how_strong=how_strong)
        kind = KINDS.get(self.what)
        strong = _in_steps(how_strong, step_length_s) if kind is not None and kind.unit == "s" else how_strong
        return replace(self, vehicle=vehicle, how_strong=strong, how_long=_in_steps(self.how_long, step_length_s))

    @property
    def words(self) -> str:
        """Return a sentence that describes the disturbance, such as ``main.35 brakes with 4 m/s² for 2 s``."""
        agent = self.agent or "the agent"
        vehicle = self.vehicle or (agent if self.who == "itself" else f"the actor {self.place}")
        kind = KINDS.get(self.what) or HOLD_KINDS.get(self.what)
        if kind is None:
            return f"{vehicle}: {self.what} {self.how_strong:g} for {self.how_long:g} s"
        always, _, where_strong = kind.words.partition("|")
        form = always + where_strong * (self.how_strong > 0)
        return (form.replace(" with ", " with up to ", 1) if self.strengths else form).format(
            vehicle=vehicle, agent=agent, strong=self.how_strong, share=100 * self.how_strong, long=self.how_long
        )

    @property
    def place(self) -> str:
        """A phrase for the place, such as ``ahead of ego to the left``."""
        agent = self.agent or "the agent"
        # A later version may add places.
        return _CELL_BY_PLACE[self.who].format(agent) if self.who in _CELL_BY_PLACE else f"{self.who} of {agent}"

    def is_active(self, step: int, step_length_s: float) -> bool:
        """Return whether the disturbance is active in a step."""
        return self.step <= step < self.step + steps_of(self.how_long, step_length_s)


def why_not(one: Disturbance) -> tuple[str, str] | None:
    """Return the reason why a disturbance is invalid, and the fix; None if it is valid.

    Its step is not checked.
    """
    kind = KINDS.get(one.what)
    if not 0 <= one.how_strong < math.inf:
        return f"the strength is {one.how_strong:g}", "give a number of at least 0"
    if not 0 < one.how_long < math.inf:
        return f"the duration is {one.how_long:g}", "give seconds above 0"
    if kind is None:
        return None
    if one.how_strong > kind.most:
        return f"{one.what} of {one.how_strong:g} is more than all", f"give a share of at most {kind.most:g}"
    if kind.of_agent != (one.who == "itself"):
        whose = "itself" if kind.of_agent else f"one of {', '.join(cell for cell in CELLS if cell != 'itself')}"
        return f"{one.what} is not about {one.who!r}", f"it is about {whose}"
    return None


def in_turn(disturbances: Iterable[Disturbance]) -> tuple[Disturbance, ...]:
    """Return disturbances in the order that a specification requires."""
    return tuple(sorted(disturbances, key=lambda one: (one.step, one.agent, one.what)))
