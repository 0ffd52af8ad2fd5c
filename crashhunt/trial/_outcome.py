"""The outcomes of a trial, and the outcomes that count as a crash."""

from __future__ import annotations

import re
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Literal, Self, get_args

from crashhunt.world import EVENT_WORDS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

Category = Literal["traffic crash", "traffic event", "software fault", "no crash"]
"""The category of an outcome in reports."""

_NAME = re.compile(r"[a-z][a-z0-9_]{0,39}")


class Outcome(StrEnum):
    """How a trial ended, as an enumeration.

    Oracles may add outcomes (`Outcome.own`). Iterating over the class yields only the built-in outcomes.
    """

    SURVIVED = "survived"
    FINISHED = "finished"
    COLLISION = "collision"
    OFF_ROAD = "off_road"
    RED_LIGHT = "red_light"
    WRONG_WAY = "wrong_way"
    OFF_ROUTE = "off_route"
    STOP_MISSED = "stop_missed"
    NOT_MOVING = "not_moving"
    OTHERS_COLLIDED = "others_collided"
    HARD_BRAKING = "hard_braking"
    TELEPORT = "teleport"
    STOP_SIGN = "stop_sign"
    KERB = "kerb"
    AGENT_ERROR = "agent_error"
    SIMULATOR_ERROR = "simulator_error"
    PROCESS_DIED = "process_died"
    HANG = "hang"
    INVALID = "invalid"

    @classmethod
    def own(cls, name: str, category: Category) -> Self:
        """Return the outcome that an oracle adds, or an existing outcome with this name.

        Args:
            name: Lower-case letters, digits and underscores, such as ``too_close``.
            category: The category in reports, ``traffic crash`` or ``traffic event``.

        Raises:
            ValueError: The name is invalid, or an outcome with this name has another category.
        """
        if category not in get_args(Category):
            raise ValueError(f"{category!r} is not a category of outcomes")
        outcome = cls(name)
        if outcome.is_own:
            _CATEGORIES[name] = category
        elif outcome.category != category:
            raise ValueError(f"the outcome {name!r} is a {outcome.category}, not a {category}")
        return outcome

    @classmethod
    def _missing_(cls, value: object) -> Self | None:
        # An enum cannot be extended, but it may return members that it does not list, as `enum.Flag` does. Callers that
        # read names from users must check which outcomes the oracles add. This method refuses only invalid names.
        if not isinstance(value, str) or _NAME.fullmatch(value) is None:
            return None
        member = str.__new__(cls, value)
        member._name_ = value.upper()
        member._value_ = value
        return cls._value2member_map_.setdefault(value, member)  # type: ignore[return-value]

    def __reduce_ex__(self, protocol: object) -> tuple[object, ...]:
        """Keep the category of an oracle's own outcome when the outcome is sent to another process."""
        return (Outcome.own, (self.value, self.category)) if self.is_own else (Outcome, (self.value,))

    @property
    def is_own(self) -> bool:
        """Whether the outcome was added by an oracle."""
        return self.name not in Outcome.__members__

    @property
    def is_traffic_crash(self) -> bool:
        """Whether the outcome is a traffic crash, in which the vehicle did harm on the road."""
        return self.category == "traffic crash"

    @property
    def is_traffic_event(self) -> bool:
        """Whether the outcome is a traffic event, which ends a trial only if ``--crash-on`` names it."""
        return self.category == "traffic event"

    @property
    def is_software_fault(self) -> bool:
        """Whether the outcome is a software fault, in which a program failed and not the driving."""
        return self.category == "software fault"

    @property
    def category(self) -> Category:
        """The category in reports; ``traffic event`` for an oracle's outcome that is not declared in this process."""
        return _CATEGORIES.get(self.value, "traffic event")


_CATEGORIES: dict[str, Category] = {
    **dict.fromkeys(("survived", "finished", "invalid"), "no crash"),
    **dict.fromkeys(("collision", "off_road"), "traffic crash"),
    **dict.fromkeys(EVENT_WORDS, "traffic event"),
    **dict.fromkeys(("agent_error", "simulator_error", "process_died", "hang"), "software fault"),
}
"""The category of each outcome, with those that oracles declare. Categories only affect reports, not trials."""


def outcome_of(data: Mapping[str, Any]) -> Outcome:
    """Return the outcome that JSON data name; an outcome that an oracle adds has the category in the data.

    Raises:
        ValueError: The data contain no valid outcome.
    """
    outcome = Outcome(data["outcome"])
    if outcome.is_own and "category" in data:
        return Outcome.own(outcome.value, data["category"])
    return outcome


def in_order(outcomes: Iterable[str]) -> list[Outcome]:
    """Return outcomes without duplicates: built-in outcomes in their order, then those of oracles by name."""
    found = {Outcome(name) for name in outcomes}
    return [*(outcome for outcome in Outcome if outcome in found), *sorted(found - set(Outcome))]


CRASHES = tuple(outcome for outcome in Outcome if outcome.is_traffic_crash or outcome.is_software_fault)
"""The outcomes that count as a crash unless ``--crash-on`` says otherwise."""


EVENTS = tuple(outcome for outcome in Outcome if outcome.is_traffic_event)
"""The outcomes that count as a crash only if ``--crash-on`` names them; all are recorded."""
