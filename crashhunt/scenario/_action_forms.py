"""The forms of actions on simulators whose actions a scenario chooses: names, components, units and ranges.

This table is the only description of the forms. ``crashhunt list actions`` and the reference print it, and the action
spaces take their bounds from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from crashhunt.base.errors import UsageError
from crashhunt.base.text import any_of, one_of

if TYPE_CHECKING:
    from collections.abc import Sequence

DEFAULT_ACTION = "speed_and_lane"
FORMER_DEFAULT_ACTION = "continuous"
"""The default in scenarios of format version 1, which state it also for simulators without forms of actions."""
_OLDER_NAMES = {FORMER_DEFAULT_ACTION: DEFAULT_ACTION}


@dataclass(frozen=True, slots=True)
class ActionComponent:
    """One number of an action."""

    name: str  # name of the number
    low: float  # smallest value
    high: float  # largest value
    unit: str = ""  # unit of the number; empty for a choice
    help: str = ""  # meaning of the number in one line
    whole: bool = False  # whether only whole numbers are allowed

    @property
    def range(self) -> str:
        """The allowed values as text: ``0:100`` for numbers, ``-1|0|1`` for a choice."""
        if self.whole:
            return "|".join(str(value) for value in range(int(self.low), int(self.high) + 1))
        return f"{self.low:g}:{self.high:g}"


@dataclass(frozen=True, slots=True)
class ActionSetting:
    """A setting of a form of actions: a number within a range, or one of some words."""

    name: str  # name of the setting
    default: float | str  # value without the setting
    help: str  # meaning of the setting in one line
    high: float = 0.0  # largest value of a number; the smallest value is 0
    unit: str = ""  # unit of a number
    choices: tuple[str, ...] = ()  # the words, if the setting is no number

    @property
    def range(self) -> str:
        """The allowed values as text."""
        return "|".join(self.choices) or f"0:{self.high:g}"

    def parse(self, text: str) -> float | str | None:
        """Return the value that a text states; None if the value is not allowed."""
        if self.choices:
            return text if text in self.choices else None
        try:
            return value if 0.0 <= (value := float(text)) <= self.high else None
        except ValueError:
            return None


@dataclass(frozen=True, slots=True)
class ActionDescription:
    """One form of actions."""

    title: str  # what an agent returns and what the vehicle does, in one line
    components: tuple[ActionComponent, ...]  # the numbers of an action, in order
    shape: str = ""  # shape of an action; empty for a tuple of the components
    second_changes_lane: bool = False  # whether the second number moves the vehicle to another lane, and 0 does not
    moves_freely: bool = False  # whether the vehicle moves in the plane, and not along lanes
    settings: tuple[ActionSetting, ...] = ()  # the settings of the form, as in ``trajectory:frame=ego``

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
_X = ActionComponent(name="x", low=-1e7, high=1e7, unit="m", help="of the reference point, to the east")
_Y = ActionComponent(name="y", low=-1e7, high=1e7, unit="m", help="of the reference point, to the north")
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
_LANE_CHANGE_DURATION = ActionSetting(
    name="lane_change_duration_s",
    default=0.0,
    high=20.0,
    unit="s",
    help="time in which the vehicle drifts to the next lane; 0 for a change in one step",
)
_FRAME = ActionSetting(
    name="frame",
    default="map",
    choices=("map", "ego"),
    help="ego: positions and headings are relative to the vehicle, x ahead and y to the left",
)
_REFERENCE_POINT = ActionSetting(
    name="reference_point",
    default="center",
    choices=("center", "rear_axle", "front_bumper"),
    help="the point of the vehicle that x and y are of: the centre of the rectangle, the middle of the rear axle or of "
    "the front bumper",
)
_TRACKER = ActionSetting(
    name="tracker",
    default="interpolation",
    choices=("interpolation", "pure_pursuit"),
    help="pure_pursuit: a kinematic bicycle model steers to a point ahead on the trajectory",
)

_VISIBLE = ActionSetting(
    name="visible",
    default="front",
    choices=("front", "outline", "whole"),
    help="the part of the vehicle that others react to: whole includes the part in other lanes than its front's. "
    "outline is of earlier trials: vehicles ahead do not react to this part. Hunts set whole, unless the form has this "
    "setting",
)

ACTIONS: dict[str, ActionDescription] = {
    "speed_and_lane": ActionDescription(
        title="Target speed, and a lane change that takes one step. The default.",
        components=(_TARGET_SPEED, _LANE_CHANGE),
        second_changes_lane=True,
        settings=(_LANE_CHANGE_DURATION, _VISIBLE),
    ),
    "speed_and_lateral": ActionDescription(
        title="Target speed, and speed across the lane: the vehicle drifts into the next lane gradually.",
        components=(_TARGET_SPEED, _LATERAL_SPEED),
        second_changes_lane=True,
        settings=(_VISIBLE,),
    ),
    "meta": ActionDescription(title="One of highway-env's five meta-actions.", components=(_META_ACTION,)),
    "acceleration": ActionDescription(
        title="Acceleration, and a lane change that takes one step.",
        components=(_ACCELERATION, _LANE_CHANGE),
        second_changes_lane=True,
        settings=(_LANE_CHANGE_DURATION, _VISIBLE),
    ),
    "acceleration_steering": ActionDescription(
        title="Acceleration and steering angle of a kinematic bicycle model; the vehicle moves freely.",
        components=(_ACCELERATION, _STEERING_ANGLE),
        moves_freely=True,
        settings=(_VISIBLE,),
    ),
    "throttle_brake_steering": ActionDescription(
        title="Pedals and steering of a kinematic bicycle model; the vehicle moves freely.",
        components=(_THROTTLE, _BRAKE, _STEERING),
        moves_freely=True,
        settings=(_VISIBLE,),
    ),
    "trajectory": ActionDescription(
        title="Points with time, pose and speed, followed by interpolation; the vehicle moves freely.",
        components=(_TIME, _X, _Y, _HEADING, _SPEED),
        shape="K rows of time, x, y, heading, speed; K up to 64",
        moves_freely=True,
        settings=(_FRAME, _REFERENCE_POINT, _TRACKER, _VISIBLE),
    ),
    "target_pose": ActionDescription(
        title="A pose to reach at a time, on a smooth curve; the vehicle moves freely.",
        components=(_X, _Y, _HEADING, _TIME),
        moves_freely=True,
        settings=(_FRAME, _REFERENCE_POINT, _VISIBLE),
    ),
    "sumo": ActionDescription(
        title="SUMO's driver model drives. None leaves the whole step to it; a speed or lane change overrides it.",
        components=(_SPEED_OVERRIDE, _LANE_OVERRIDE),
        second_changes_lane=True,
    ),
}
"""All forms by name, in the order in which they are listed."""
OVERRIDES_ONLY: Final = ACTIONS["sumo"].names
"""The components of the form in which the simulator's driver drives, and an action overrides it."""


def canonical_action(name: str | None) -> str:
    """Return the present name of a form of actions, without settings; the default form for None."""
    form = (name or DEFAULT_ACTION).partition(":")[0]
    return _OLDER_NAMES.get(form, form)


def action_settings(name: str | None, where: str = "action") -> dict[str, float | str]:
    """Return the value of every setting of a form of actions, such as ``trajectory:frame=ego``.

    Without a name, the form is the default one. Messages name ``where``, the option or key.

    Raises:
        UsageError: the form or a setting does not exist, or a value is not allowed.
    """
    form, *given = (name or DEFAULT_ACTION).split(":")
    if _OLDER_NAMES.get(form, form) not in ACTIONS:
        raise UsageError(f"{where}: {form!r} is not a form of actions", fix=one_of(form, ACTIONS))
    known = {one.name: one for one in ACTIONS[canonical_action(form)].settings}
    values = {one.name: one.default for one in known.values()}
    refuse_repeated_settings(form, given, where)
    for text in given:
        setting, _, word = text.partition("=")
        if setting not in known:
            fix = one_of(setting, known, give="it has", none="no settings")
            raise UsageError(f"{where}: {form} has no setting {setting!r}", fix=fix)
        value = known[setting].parse(word)
        if value is None:
            one = known[setting]
            fix = (
                f"give {any_of(one.choices)}"
                if one.choices
                else f"give a number in {one.unit} within 0 and {one.high:g}"
            )
            raise UsageError(f"{where}: {form}:{setting} is {word!r}", fix=fix)
        values[setting] = value
    return values


def refuse_repeated_settings(name: str, given: Sequence[str], where: str) -> None:
    """Refuse settings, each as ``NAME=VALUE``, that contain a name twice.

    Raises:
        UsageError: a name occurs twice.
    """
    names = [text.partition("=")[0] for text in given]
    for setting in (one for one in names if names.count(one) > 1):
        raise UsageError(f"{where}: {name} has the setting {setting!r} twice", fix="name each setting once")


def with_whole_vehicle_visible(name: str | None) -> str | None:
    """Return a form of actions whose vehicle other vehicles see as a whole, unless the form names another choice.

    Without the setting, a form means what it meant before the setting existed, so recorded trials keep their meaning.
    New hunts state the setting. They record the choice ``visible=front`` as the form without the setting. Without a
    name, the form is the default one.
    """
    if name is None or not can_be_in_two_lanes(name):
        return name
    front = f":{_VISIBLE.name}={_VISIBLE.default}"
    if f":{_VISIBLE.name}=" in name:
        return name.replace(front, "")
    return f"{name}:{_VISIBLE.name}=whole"


def with_stated_choice(name: str) -> str:
    """Return the form that `with_whole_vehicle_visible` turns into a recorded form of actions."""
    is_stated = not name or not can_be_in_two_lanes(name) or f":{_VISIBLE.name}=" in name
    return name if is_stated else f"{name}:{_VISIBLE.name}={_VISIBLE.default}"


def can_be_in_two_lanes(name: str) -> bool:
    """Return whether a vehicle with a form of actions can stay in two lanes for several steps."""
    form, settings = canonical_action(name), action_settings(name)
    return ACTIONS[form].moves_freely or form == "speed_and_lateral" or bool(settings.get("lane_change_duration_s"))


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
