"""The forms of actions on simulators whose actions a scenario chooses: names, components, units and ranges.

This table is the only description of the forms. ``crashhunt list actions`` and the reference print it, and the action
spaces take their bounds from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

from crashhunt.base.errors import UsageError
from crashhunt.base.text import any_of

if TYPE_CHECKING:
    from collections.abc import Sequence

ActionName = Literal[
    "speed_and_lane", "speed_and_lateral", "meta", "acceleration", "acceleration_steering", "throttle_brake_steering",
    "trajectory", "target_pose", "sumo", "continuous",
]  # fmt: skip
"""What a scenario, ``--action`` and an agent's class may name; ``continuous`` is an older name of speed_and_lane."""

DEFAULT_ACTION = "speed_and_lane"
FORMER_DEFAULT_ACTION = "continuous"
"""The default in scenarios of format version 1, which state it also for simulators without forms of actions."""
_OLDER_NAMES = {FORMER_DEFAULT_ACTION: DEFAULT_ACTION}


@dataclass(frozen=True, slots=True)
class ActionComponent:
    """One number of an action.

    Args:
        name: name of the number.
        low: smallest value.
        high: largest value.
        unit: unit of the number; empty for a choice.
        help: meaning of the number in one line.
        whole: whether only whole numbers are allowed.
    """

    name: str
    low: float
    high: float
    unit: str = ""
    help: str = ""
    whole: bool = False

    @property
    def range(self) -> str:
        """The allowed values as text: ``0:100`` for numbers, ``-1|0|1`` for a choice."""
        if self.whole:
            return "|".join(str(value) for value in range(int(self.low), int(self.high) + 1))
        return f"{self.low:g}:{self.high:g}"


@dataclass(frozen=True, slots=True)
class ActionDescription:
    """One form of actions.

    Args:
        title: what an agent returns and what the vehicle does, in one line.
        components: the numbers of an action, in order.
        shape: shape of an action; empty for a tuple of the components.
        second_changes_lane: whether the second number moves the vehicle to another lane, and 0 does not.
        moves_freely: whether the vehicle moves in the plane, and not along lanes.
    """

    title: str
    components: tuple[ActionComponent, ...]
    shape: str = ""
    second_changes_lane: bool = False
    moves_freely: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the components."""
        return tuple(component.name for component in self.components)

    @property
    def layout(self) -> str:
        """The layout of an action as text, such as ``(target_speed, lane_change)``."""
        return self.shape or (f"({', '.join(self.names)})" if len(self.components) > 1 else self.names[0])


_TARGET_SPEED = ActionComponent(
    name="target_speed", low=0.0, high=100.0, unit="m/s", help="speed to reach as fast as the vehicle can"
)
_LANE_CHANGE = ActionComponent(
    name="lane_change", low=-1, high=1, help="1 to the left, -1 to the right, 0 stays", whole=True
)
_LATERAL_SPEED = ActionComponent(
    name="lateral_speed", low=-5.0, high=5.0, unit="m/s", help="across the lane, positive to the left"
)
_META_ACTION = ActionComponent(
    name="meta_action", low=0, high=4, help="LANE_LEFT, IDLE, LANE_RIGHT, FASTER, SLOWER", whole=True
)
_ACCELERATION = ActionComponent(
    name="acceleration", low=-10.0, high=10.0, unit="m/s²", help="the limits of the vehicle's type also apply"
)
_MAX_STEERING_RAD = 0.6
_STEERING_ANGLE = ActionComponent(
    name="steering_angle",
    low=-_MAX_STEERING_RAD,
    high=_MAX_STEERING_RAD,
    unit="rad",
    help="angle of the front wheels, positive to the left",
)
_THROTTLE = ActionComponent(name="throttle", low=0.0, high=1.0, help="share of the largest acceleration of the type")
_BRAKE = ActionComponent(name="brake", low=0.0, high=1.0, help="share of the largest deceleration of the type")
_STEERING = ActionComponent(name="steering", low=-1.0, high=1.0, help="share of 0.6 rad, positive to the left")
_TIME = ActionComponent(name="time", low=0.0, high=10.0, unit="s", help="from the step of the answer on")
_X = ActionComponent(name="x", low=-1e7, high=1e7, unit="m", help="centre of the rectangle, to the east")
_Y = ActionComponent(name="y", low=-1e7, high=1e7, unit="m", help="centre of the rectangle, to the north")
_HEADING = ActionComponent(
    name="heading", low=-1e3, high=1e3, unit="rad", help="counter-clockwise from east; turns by 2 pi are equal"
)
_SPEED = ActionComponent(name="speed", low=0.0, high=100.0, unit="m/s", help="of the centre")
_SPEED_OVERRIDE = ActionComponent(
    name="speed_override", low=-1.0, high=100.0, unit="m/s", help="speed to reach; -1 leaves the speed to SUMO"
)
_LANE_OVERRIDE = ActionComponent(
    name="lane_change_override", low=-1, high=1, help="1 to the left, -1 to the right, 0 leaves it to SUMO", whole=True
)

ACTIONS: dict[str, ActionDescription] = {
    "speed_and_lane": ActionDescription(
        title="Target speed, and a lane change that takes one step. The default.",
        components=(_TARGET_SPEED, _LANE_CHANGE),
        second_changes_lane=True,
    ),
    "speed_and_lateral": ActionDescription(
        title="Target speed, and speed across the lane: the vehicle drifts into the next lane gradually.",
        components=(_TARGET_SPEED, _LATERAL_SPEED),
        second_changes_lane=True,
    ),
    "meta": ActionDescription(title="One of highway-env's five meta-actions.", components=(_META_ACTION,)),
    "acceleration": ActionDescription(
        title="Acceleration, and a lane change that takes one step.",
        components=(_ACCELERATION, _LANE_CHANGE),
        second_changes_lane=True,
    ),
    "acceleration_steering": ActionDescription(
        title="Acceleration and steering angle of a kinematic bicycle model; the vehicle moves freely.",
        components=(_ACCELERATION, _STEERING_ANGLE),
        moves_freely=True,
    ),
    "throttle_brake_steering": ActionDescription(
        title="Pedals and steering of a kinematic bicycle model; the vehicle moves freely.",
        components=(_THROTTLE, _BRAKE, _STEERING),
        moves_freely=True,
    ),
    "trajectory": ActionDescription(
        title="Points with time, pose and speed, followed by interpolation; the vehicle moves freely.",
        components=(_TIME, _X, _Y, _HEADING, _SPEED),
        shape="K rows of time, x, y, heading, speed; K up to 64",
        moves_freely=True,
    ),
    "target_pose": ActionDescription(
        title="A pose to reach at a time, on a smooth curve; the vehicle moves freely.",
        components=(_X, _Y, _HEADING, _TIME),
        moves_freely=True,
    ),
    "sumo": ActionDescription(
        title="SUMO's driver model drives. None leaves the whole step to it; a speed or lane change overrides it.",
        components=(_SPEED_OVERRIDE, _LANE_OVERRIDE),
        second_changes_lane=True,
    ),
}
"""All forms by name, in the order in which they are listed."""


def canonical_action(name: str | None) -> str:
    """Return the present name of a form of actions; the default form for None."""
    return DEFAULT_ACTION if not name else _OLDER_NAMES.get(name, name)


def is_action_name(name: str) -> bool:
    """Return whether a form of actions has this name, or an older name of it."""
    return name in get_args(ActionName)


def check_action(name: str | None, returned: Sequence[str], agent: str) -> None:
    """Check that an agent can return actions of the chosen form; an agent that names no forms is not checked.

    Args:
        name: the form that the command line, the scenario or the agent's class has chosen; None for the default form.
        returned: the forms that the agent names in its attribute ``actions``; empty if it names none.
        agent: the agent as the user named it.

    Raises:
        UsageError: the agent cannot return this form.
    """
    if returned and canonical_action(name) not in map(canonical_action, returned):
        message = f"{agent} returns actions of the form {any_of(returned)}, not {canonical_action(name)}"
        raise UsageError(message, fix=f"choose the action {any_of(returned)}, or another agent")
