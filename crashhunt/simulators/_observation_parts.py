"""The parts of observations: the only table of their names, columns, units, ranges and settings.

An agent observes a `Dict` of arrays if the command line (``--observe``), the scenario (``observation``) or the agent's
class (``observation``) names parts. The Gymnasium space, the agent's parameter ``columns``, ``crashhunt list
observations`` and the reference page follow from this table.

All parts use one frame: x to the east, y to the north, headings counter-clockwise from the x axis in rad. The reference
point of ego and of actors is the centre of their rectangle, unless the word `REFERENCE_POINT` names another point. Rows
without content are 0, including ``present``.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

from crashhunt.base.errors import UsageError
from crashhunt.base.text import one_of
from crashhunt.simulators._bicycle_model import WHEELBASE_SHARE

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    import numpy as np
    from gymnasium import spaces
    from numpy.typing import NDArray

    from crashhunt.base.program_messages import SpaceDescription
    from crashhunt.scenario import AgentSetup


class Column(NamedTuple):
    """A column of a part, which is an entry of the last axis.

    Args:
        name: Name of the column.
        unit: Unit of the values; empty for numbers without a unit.
        low: Lower bound of the values.
        high: Upper bound of the values.
        meaning: Description of the values.
    """

    name: str
    unit: str
    low: float
    high: float
    meaning: str

    @property
    def range(self) -> str:
        """The range as text; empty if its bounds are only those that no simulation reaches."""
        return f"{self.low:.3g}:{self.high:.3g}" if self.high <= _LARGEST_SHOWN else ""


class Setting(NamedTuple):
    """A setting of a part, such as its number of rows.

    Args:
        name: Name of the setting, as in ``actors:rows=8``.
        default: The default value.
        low: The smallest value.
        high: The largest value.
        unit: Unit of the value; empty for whole numbers.
        meaning: Description of the setting.
        choices: The words that the setting takes instead of numbers; its value is then the index of the word.
    """

    name: str
    default: float
    low: float
    high: float
    unit: str
    meaning: str
    choices: tuple[str, ...] = ()

    @property
    def is_whole(self) -> bool:
        """Whether only whole numbers are allowed."""
        return not self.unit

    @property
    def allowed(self) -> str:
        """The allowed values as text."""
        if self.choices:
            return f"one of {', '.join(self.choices)}"
        kind = "a whole number" if self.is_whole else f"a number in {self.unit}"
        return f"{kind} within {self.low:g} and {self.high:g}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A part of an observation.

    Args:
        name: Name of the part.
        meaning: Description of the part.
        axes: The axes before the columns, each a length or the name of the setting that contains it.
        columns: The columns, which are the last axis; empty if the values of all axes have the same meaning.
        values: Description of the values of a part without columns.
        settings: The settings of the part.
        measured: Columns that the disturbance ``noisy_observation`` changes; ``x`` and ``y`` relative to the position
            of the controlled vehicle.
        dtype: Data type of the values.
    """

    name: str
    meaning: str
    axes: tuple[str | int, ...] = ()
    columns: tuple[Column, ...] = ()
    values: Column | None = None
    settings: tuple[Setting, ...] = ()
    measured: tuple[str, ...] = ()
    dtype: str = "<f8"

    @property
    def values_of_last_axis(self) -> tuple[Column, ...]:
        """The columns, or the description of all values if the part has no columns."""
        return self.columns or ((self.values,) if self.values is not None else ())


_LARGEST_SHOWN = 360.0

# Bounds that no simulation reaches: a Box needs finite bounds, because noise is clipped to them.
_POSITION_M, _DISTANCE_M, _SPEED_MPS, _ACCELERATION_MPS2, _TIME_S = 1e8, 1e7, 1e3, 1e4, 1e9
_PI = math.pi


def _flag(name: str, meaning: str) -> Column:
    return Column(name, "", 0.0, 1.0, meaning)


def _position(name: str, meaning: str) -> Column:
    return Column(name, "m", -_POSITION_M, _POSITION_M, meaning)


def _distance(name: str, meaning: str) -> Column:
    return Column(name, "m", -_DISTANCE_M, _DISTANCE_M, meaning)


def _size(name: str, meaning: str) -> Column:
    return Column(name, "m", 0.0, 1e3, meaning)


def _heading(meaning: str) -> Column:
    return Column("heading", "rad", -_PI, _PI, f"{meaning}, counter-clockwise from the x axis")


def _speed(name: str, meaning: str) -> Column:
    return Column(name, "m/s", -_SPEED_MPS, _SPEED_MPS, meaning)


def _acceleration(meaning: str) -> Column:
    return Column("acceleration", "m/s²", -_ACCELERATION_MPS2, _ACCELERATION_MPS2, meaning)


def _time(name: str, meaning: str) -> Column:
    return Column(name, "s", 0.0, _TIME_S, meaning)


REACH_M = 120.0
"""Largest distance at which a part shows actors, because scenes contain the actors within 150 m at least."""

KINEMATICS = "kinematics"
"""The word for the default observation, which is no `Dict` of parts."""

_PRESENT = _flag("present", "1 if the row has content; otherwise, all values of the row are 0")
_LANE_INDEX = Column("lane_index", "", 0.0, 1e3, "index of the lane on its road, from 0 for the outer lane")
_LANE_OFFSET = _distance(
    "lane_offset", "distance of the front bumper's centre from the centre line of its lane, positive to the left"
)

HISTORY = Part(
    name="history",
    meaning="stacks the last observations: the arrays of all parts get a first axis, whose last entry is the present "
    "observation; before the second step, the first observation is repeated",
    settings=(Setting("steps", 4, 1, 100, "", "number of observations"),),
)
"""A word that names no array of its own."""

CENTER, REAR_AXLE, FRONT_BUMPER = "center", "rear_axle", "front_bumper"
REFERENCE_SHARES = {CENTER: 0.0, REAR_AXLE: -WHEELBASE_SHARE / 2, FRONT_BUMPER: 0.5}
"""How far each reference point is ahead of the centre, as a share of the length."""

REFERENCE_POINT = Part(
    name="reference_point",
    meaning="the point of vehicles whose ``x`` and ``y`` the parts ``ego``, ``actors`` and ``predictions`` contain; "
    "all other values are those of the centre",
    settings=(
        Setting(
            "at", 1, 0, 2, "", "the centre of the rectangle, the middle of the rear axle or of the front bumper",
            (CENTER, REAR_AXLE, FRONT_BUMPER),
        ),
    ),
)  # fmt: skip

OCCLUSION = Part(
    name="occlusion",
    meaning="hides actors behind others in all parts: an actor is seen if one of the rays from the centre of the "
    "controlled vehicle hits its outline first",
    settings=(Setting("rays", 3600, 360, 36_000, "", "number of rays, evenly distributed over the full circle"),),
)

MODIFIERS: Mapping[str, Part] = {one.name: one for one in (HISTORY, OCCLUSION, REFERENCE_POINT)}
"""The words that name no array of their own and change the arrays of all parts, by name."""

PARTS: Mapping[str, Part] = {
    part.name: part
    for part in (
        Part(
            name="ego",
            meaning="the controlled vehicle",
            columns=(
                _position("x", "x of the centre of the rectangle"),
                _position("y", "y of the centre of the rectangle"),
                _heading("direction of the vehicle"),
                _speed("speed", "speed along the heading"),
                _acceleration("change of the speed in the last step, divided by the step length"),
                Column(
                    "yaw_rate", "rad/s", -1e3, 1e3, "change of the heading in the last step, divided by the step length"
                ),
                Column(
                    "steering", "rad", -_PI / 2, _PI / 2,
                    "steering angle of the front wheel of a kinematic bicycle model, positive to the left",
                ),
                _size("length", "length of the vehicle"),
                _size("width", "width of the vehicle"),
                _LANE_INDEX,
                _LANE_OFFSET,
                Column("distance", "m", 0.0, _DISTANCE_M, "distance driven since the start of the episode"),
                _time("time", "simulation time since the start of the episode"),
            ),
            measured=("speed", "acceleration", "yaw_rate", "steering", "lane_offset", "distance"),
        ),
        Part(
            name="actors",
            meaning="the actors within a radius around the controlled vehicle, the nearest first",
            axes=("rows",),
            columns=(
                _PRESENT,
                _position("x", "x of the centre of the rectangle"),
                _position("y", "y of the centre of the rectangle"),
                _heading("direction of the actor"),
                _speed("vx", "velocity along the x axis"),
                _speed("vy", "velocity along the y axis"),
                _acceleration("change of the actor's speed in the last step, divided by the step length"),
                _size("length", "length of the actor"),
                _size("width", "width of the actor"),
                Column(
                    "kind", "", 0.0, 5.0,
                    "1 motor vehicle, 2 bicycle or motorcycle, 3 person on foot, 4 rail vehicle, 5 obstacle",
                ),
                _flag("same_lane", "1 if the actor is on the lane of the controlled vehicle, or on a lane that its "
                      "route continues to or that leads into its lane"),
                _distance("ahead", "distance of the centres along the heading of the controlled vehicle, negative if "
                          "the actor is behind"),
                _LANE_OFFSET,
                _flag("brake_light", "1 if the brake light is on"),
                Column("indicator", "", -1.0, 2.0, "1 left, -1 right, 2 hazard lights, 0 off"),
            ),
            settings=(
                Setting("rows", 32, 1, 1000, "", "number of rows"),
                Setting("radius", 100.0, 1.0, REACH_M, "m", "largest distance of the centres"),
            ),
            measured=("x", "y", "vx", "vy", "acceleration", "length", "width", "ahead", "lane_offset"),
        ),
        Part(
            name="lanes",
            meaning="points on centre lines: the own lane along the route, its left and right neighbour, then the "
            "nearest others within 50 m that the vehicle may use",
            axes=("lanes", "points"),
            columns=(
                _PRESENT,
                _position("x", "x of the point"),
                _position("y", "y of the point"),
                _heading("direction of the lane"),
                _size("width", "width of the lane"),
                Column("speed_limit", "m/s", 0.0, _SPEED_MPS, "speed limit of the lane"),
            ),
            settings=(
                Setting("lanes", 8, 1, 200, "", "number of lanes"),
                Setting("points", 40, 2, 1000, "", "number of points of each lane"),
                Setting("spacing", 2.0, 0.1, 50.0, "m", "distance between two points"),
                Setting(
                    "behind", 10.0, 0.0, 200.0, "m",
                    "distance of the first point behind the point that is nearest to the vehicle",
                ),
            ),
        ),
        Part(
            name="route",
            meaning="points along the route ahead, on the best lane",
            axes=("points",),
            columns=(
                _PRESENT,
                _position("x", "x of the point"),
                _position("y", "y of the point"),
                _heading("direction of the lane"),
                Column("speed_limit", "m/s", 0.0, _SPEED_MPS, "speed limit of the lane"),
                _LANE_INDEX,
            ),
            settings=(
                Setting("points", 50, 2, 1000, "", "number of points"),
                Setting("spacing", 2.0, 0.1, 50.0, "m", "distance between two points"),
                Setting(
                    "behind", 0.0, 0.0, 200.0, "m",
                    "distance of the first point behind the point that is nearest to the vehicle, less where no lane "
                    "leads there",
                ),
            ),
        ),
        Part(
            name="route_state",
            meaning="state of the controlled vehicle on its route",
            columns=(
                Column("distance_left", "m", 0.0, _DISTANCE_M, "distance to the end of the route along the route"),
                Column(
                    "lane_changes_needed", "", -1e3, 1e3,
                    "number of lane changes to the best lane, positive to the left",
                ),
                Column(
                    "distance_to_lane_change", "m", 0.0, _DISTANCE_M,
                    "distance to where the own lane leaves the route; if it does not, to the end of the route",
                ),
                _position("goal_x", "x of the end of the route"),
                _position("goal_y", "y of the end of the route"),
            ),
        ),
        Part(
            name="signals",
            meaning="the traffic lights ahead on the route, the next first",
            axes=("rows",),
            columns=(
                _PRESENT,
                Column("state", "", 0.0, 3.0, "0 green, 1 yellow, 2 red, 3 off or blinking"),
                _distance("distance", "distance of the front bumper to the stop line"),
                _time("time_in_state", "time since the light has this state; a lower bound if its program adapts"),
            ),
            settings=(Setting("rows", 3, 1, 50, "", "number of traffic lights"),),
        ),
        Part(
            name="time_to_switch",
            meaning="privileged, because no sensor measures it: time until each traffic light in the rows of "
            "``signals`` changes its state; a lower bound if its program adapts, 1000 if it never changes",
            axes=("rows",),
            values=_time("time", "time until the state changes; 0 in rows without a traffic light"),
            settings=(Setting("rows", 3, 1, 50, "", "number of traffic lights"),),
        ),
        Part(
            name="right_of_way",
            meaning="actors on the streams that conflict with the route at the next junction, the earliest arrival "
            "first",
            axes=("rows",),
            columns=(
                _PRESENT,
                _flag(
                    "must_yield",
                    "1 if the rules of the junction make the controlled vehicle yield to the actor, which has no red "
                    "light; at an allway stop, to an actor that has waited longer",
                ),
                _distance("stop_line_distance", "distance of the front bumper to the stop line of the junction"),
                _distance(
                    "conflict_distance",
                    "distance of the front bumper to the area where the paths are closer than 0.8 lane widths",
                ),
                _distance("other_distance", "distance of the actor's front bumper to the conflict area"),
                _speed("other_speed", "speed of the actor"),
                _time("other_arrival", "time until the actor reaches this area at its speed; 1000 if it stands"),
                _flag("stop_sign", "1 if the controlled vehicle must stop at the stop line"),
            ),
            settings=(Setting("rows", 8, 1, 100, "", "number of rows"),),
            measured=("other_distance", "other_speed", "other_arrival"),
        ),
        Part(
            name="stop_line",
            meaning="the stop line of the next junction on the route",
            columns=(
                _PRESENT,
                _distance("distance", "distance of the front bumper to the stop line, negative inside the junction"),
                _flag("must_yield", "1 if the rules of the junction name a stream to yield to"),
                _flag("stop_sign", "1 if the controlled vehicle must stop at the stop line"),
                _flag("signal", "1 if a traffic light controls the lane"),
            ),
        ),
        Part(
            name="speed_limit",
            meaning="speed limit of the controlled vehicle's lane",
            columns=(Column("speed_limit", "m/s", 0.0, _SPEED_MPS, "speed limit of the lane at this time"),),
        ),
        Part(
            name="predictions",
            meaning="predicted positions of the actors in the rows of ``actors``, at constant speed: straight on, or, "
            "where the simulator can, along the actor's lane and the lanes that follow it with the smallest turns",
            axes=("rows", "steps"),
            columns=(
                _position("x", "x of the centre of the rectangle"),
                _position("y", "y of the centre of the rectangle"),
                Column("yaw", "rad", -_PI, _PI, "direction of the actor, counter-clockwise from the x axis"),
                _speed("speed", "speed along the heading"),
            ),
            settings=(
                Setting("rows", 32, 1, 1000, "", "number of rows"),
                Setting("steps", 30, 1, 1000, "", "number of times, the first one interval from now"),
                Setting("radius", 100.0, 1.0, REACH_M, "m", "largest distance of the centres"),
                Setting("interval", 0.1, 0.01, 10.0, "s", "time between two positions"),
                Setting("along", 0, 0, 1, "", "what the actor drives along", ("heading", "lanes")),
            ),
            measured=("x", "y", "speed"),
        ),
        Part(
            name="prediction_covariance",
            meaning="covariance of the positions in ``predictions``, if the acceleration of an actor is unknown and "
            "constant: the standard deviation along and across the heading is that of the acceleration times t² / 2",
            axes=("rows", "steps"),
            columns=(
                Column("var_x", "m²", 0.0, _DISTANCE_M**2, "variance of x"),
                Column("var_y", "m²", 0.0, _DISTANCE_M**2, "variance of y"),
                Column("cov_xy", "m²", -(_DISTANCE_M**2), _DISTANCE_M**2, "covariance of x and y"),
            ),
            settings=(
                Setting("rows", 32, 1, 1000, "", "number of rows"),
                Setting("steps", 30, 1, 1000, "", "number of times, the first one interval from now"),
                Setting("radius", 100.0, 1.0, REACH_M, "m", "largest distance of the centres"),
                Setting("interval", 0.1, 0.01, 10.0, "s", "time between two positions"),
                Setting("along", 1.5, 0.0, 20.0, "m/s²", "standard deviation of the acceleration along the heading"),
                Setting("across", 0.5, 0.0, 20.0, "m/s²", "standard deviation of the acceleration across the heading"),
            ),
        ),
        Part(
            name="actor_ids",
            meaning="numbers of the actors in the rows of ``actors``, which an actor keeps during the episode; 0 in "
            "rows without an actor",
            axes=("rows",),
            values=Column("id", "", 0.0, 1e9, "number of the actor, from 1 in the order in which the agent saw them"),
            settings=(
                Setting("rows", 32, 1, 1000, "", "number of rows"),
                Setting("radius", 100.0, 1.0, REACH_M, "m", "largest distance of the centres"),
            ),
            dtype="<i8",
        ),
        Part(
            name="crossings",
            meaning="pedestrian crossings on the route within the next junction, the next first",
            axes=("rows",),
            columns=(
                _PRESENT,
                _distance("distance", "distance of the front bumper to the crossing, negative if it is behind"),
                _flag("must_yield", "1 if the controlled vehicle must yield to persons on the crossing"),
                Column("persons", "", 0.0, 1e6, "number of persons within ``near`` of the crossing's centre line"),
                _distance("nearest", "distance of the nearest person to where the paths cross; 1000 without a person"),
            ),
            settings=(
                Setting("rows", 4, 1, 50, "", "number of rows"),
                Setting("near", 5.0, 0.1, 50.0, "m", "largest distance of a person that counts"),
            ),
            measured=("nearest",),
        ),
        Part(
            name="lidar2d",
            meaning="distances from the centre of the controlled vehicle to the nearest outline, for directions "
            "counter-clockwise from its heading; ``range`` if no outline is nearer",
            axes=("rays",),
            values=Column("distance", "m", 0.0, REACH_M, "distance along the ray"),
            settings=(
                Setting("rays", 360, 1, 10_000, "", "number of rays, evenly distributed over the full circle"),
                Setting("range", 100.0, 1.0, REACH_M, "m", "largest distance"),
            ),
            measured=("distance",),
        ),
        Part(
            name="grid",
            meaning="cells around the controlled vehicle: layer 0 is 1 where an actor is, layer 1 is 1 where a lane "
            "is. The vehicle is in the middle. Its heading points to smaller row numbers, and its left side to smaller "
            "column numbers",
            axes=(2, "rows", "columns"),
            values=Column("cell", "", 0.0, 1.0, "1 if the centre of the cell is inside"),
            settings=(
                Setting("rows", 64, 2, 1000, "", "number of cells along the heading"),
                Setting("columns", 64, 2, 1000, "", "number of cells across the heading"),
                Setting("resolution", 1.0, 0.05, 20.0, "m", "edge length of a cell"),
            ),
            dtype="|u1",
        ),
        Part(
            name="image",
            meaning="picture of the surroundings from above, as ``grid``: red, green and blue. The vehicle is "
            "(224, 138, 0), actors are (125, 139, 156), lanes (228, 232, 237), all else (246, 247, 249)",
            axes=("rows", "columns", 3),
            values=Column("value", "", 0.0, 255.0, "brightness"),
            settings=(
                Setting("rows", 96, 2, 1000, "", "number of pixels along the heading"),
                Setting("columns", 96, 2, 1000, "", "number of pixels across the heading"),
                Setting("resolution", 0.5, 0.05, 20.0, "m", "edge length of a pixel"),
            ),
            dtype="|u1",
        ),
    )
}  # fmt: skip
"""All parts by name."""

SCENE_PARTS = ("ego", "actors", "actor_ids", "predictions", "prediction_covariance", "lidar2d")
"""The parts that follow from scenes and from `LanePlace`, for every simulator with scenes."""


@dataclass(frozen=True, slots=True)
class RequestedPart:
    """A part with the values of its settings.

    Args:
        part: The part.
        settings: The value of every setting, by name.
    """

    part: Part
    settings: Mapping[str, float]

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the array."""
        axes = [axis if isinstance(axis, int) else int(self.settings[axis]) for axis in self.part.axes]
        return (*axes, len(self.part.columns)) if self.part.columns else tuple(axes)

    @property
    def space(self) -> spaces.Box:
        """The Gymnasium space of the array."""
        import numpy as np
        from gymnasium import spaces

        part = self.part
        columns = part.values_of_last_axis
        low, high = (np.array([column[side] for column in columns]) for side in (2, 3))
        dtype = np.dtype(part.dtype)
        return spaces.Box(
            np.broadcast_to(low, self.shape).astype(dtype), np.broadcast_to(high, self.shape).astype(dtype), dtype=dtype
        )


def parse_parts(words: Iterable[str], available: Iterable[str] = PARTS, *, where: str) -> tuple[RequestedPart, ...]:
    """Return the parts that an agent observes; none for the default observation.

    Args:
        words: One word per part: its name, and its settings as ``:NAME=VALUE``, such as ``actors:rows=8:radius=50``;
            or only `KINEMATICS`. The words of `MODIFIERS`, such as ``history=4``, are checked, but not returned.
        available: Names of the parts that the simulator has.
        where: The option or key that contains the words, for messages.

    Raises:
        UsageError: A part or a setting does not exist, or a value is out of range.
    """
    known, found, given_words = tuple(available), dict[str, RequestedPart](), [str(word) for word in words]
    modifiers = tuple(MODIFIERS) if known else ()
    if KINEMATICS in given_words and known:
        if len(given_words) > 1:
            fix = f"name {KINEMATICS} alone, or only parts"
            raise UsageError(f"{where} names {KINEMATICS} and parts: {','.join(given_words)}", fix=fix)
        return ()
    for word in given_words:
        name, given = _split(word)
        if name not in known and name not in modifiers:
            fix = (
                one_of(name, (*known, *modifiers, KINEMATICS))
                if known
                else "omit it, because agents observe what it returns"
            )
            message = f"{where}: {name!r} is not a part of observations"
            if name in PARTS or not known:
                message = f"{where}: the simulator of this scenario has no part {name!r}"
            raise UsageError(message, fix=fix)
        if name in found:
            raise UsageError(f"{where} names the part {name!r} twice", fix="name each part once")
        part = PARTS[name] if name in PARTS else MODIFIERS[name]
        settings = {setting.name: setting.default for setting in part.settings}
        for text in given:
            setting, value = _parse_setting(part, text, where)
            settings[setting] = value
        found[name] = RequestedPart(part, settings)
    parts = tuple(one for one in found.values() if one.part.name not in MODIFIERS)
    if found and not parts:
        raise UsageError(f"{where} names {next(iter(found))} and no part", fix="name at least one part as well")
    return parts


def _split(word: str) -> tuple[str, list[str]]:
    """Return the name of a word and its settings; ``history=4`` is short for ``history:steps=4``."""
    name, *given = word.split(":")
    short, has_value, value = name.partition("=")
    if has_value and short in MODIFIERS:
        return short, [f"{MODIFIERS[short].settings[0].name}={value}", *given]
    return name, given


def modifiers_of(words: Iterable[str]) -> dict[str, float]:
    """Return the value of each word of `MODIFIERS` that checked words contain, by name."""
    found = {}
    for word in words:
        name, given = _split(word)
        if name in MODIFIERS:
            part = MODIFIERS[name]
            found[name] = _parse_setting(part, given[-1], "")[1] if given else part.settings[0].default
    return found


def _parse_setting(part: Part, text: str, where: str) -> tuple[str, float]:
    """Return the name and the value of a setting.

    Raises:
        UsageError: The setting does not exist, or its value is out of range.
    """
    name, _, digits = text.partition("=")
    known = {setting.name: setting for setting in part.settings}
    if name not in known:
        fix = one_of(name, known, give="it has", none="no settings")
        raise UsageError(f"{where}: {part.name} has no setting {name!r}", fix=fix)
    setting = known[name]
    try:
        if setting.choices:
            value = float(setting.choices.index(digits))
        else:
            value = float(int(digits) if setting.is_whole else float(digits))
    except ValueError:
        value = math.nan
    if not setting.low <= value <= setting.high:
        raise UsageError(f"{where}: {part.name}:{name} is {digits!r}", fix=f"give {setting.allowed}")
    return name, value


class ObservationLayout:
    """The layout of an agent's observation: its parts, and their places in the recorded array.

    The recorded array is one-dimensional: the parts in the order of their names, each row by row.

    Args:
        parts: The parts that the agent observes.
        modifiers: The values of words of `MODIFIERS`, by name.

    Attributes:
        history: Number of observations that are stacked; 0 if none are.
        occlusion_rays: Number of rays that decide which actors are seen; 0 if no actor hides others.
        reference_share: How far the reference point is ahead of the centre, as a share of a vehicle's length.
        parts: The parts by name, in the order of the recorded array.
        reach_m: Largest distance at which a part shows actors.
        columns: The index of every column, by part and name of the column.
        shapes: The shape of every part, including the axis of the history.
        space: The space of the agent's observation.
        flat_space: The space of the recorded array.
    """

    def __init__(self, parts: Sequence[RequestedPart], modifiers: Mapping[str, float] = MappingProxyType({})) -> None:
        import numpy as np
        from gymnasium import spaces

        history = int(modifiers.get(HISTORY.name, 0))
        self.occlusion_rays = int(modifiers.get(OCCLUSION.name, 0))
        point = REFERENCE_POINT.settings[0].choices[int(modifiers.get(REFERENCE_POINT.name, 0))]
        self.reference_share = REFERENCE_SHARES[point]

        self.reach_m = max((one.settings.get(name, 0.0) for one in parts for name in ("radius", "range")), default=0.0)
        self.parts = {one.part.name: one for one in sorted(parts, key=lambda one: one.part.name)}
        self.columns: dict[str, dict[str, int]] = {
            name: {column.name: index for index, column in enumerate(one.part.columns)}
            for name, one in self.parts.items()
        }
        self.history = history
        self._boxes = {name: _stacked(one.space, history) for name, one in self.parts.items()}
        self.shapes = {name: box.shape for name, box in self._boxes.items()}
        self.space = spaces.Dict(dict(self._boxes))
        flat = spaces.flatten_space(self.space)
        assert isinstance(flat, spaces.Box)
        self.flat_space = flat
        self._dtype = flat.dtype
        self._places: list[tuple[str, slice, tuple[int, ...], np.dtype[np.generic]]] = []
        begin = 0
        for name, one in self.parts.items():
            shape = self._boxes[name].shape
            end = begin + math.prod(shape)
            self._places.append((name, slice(begin, end), shape, np.dtype(one.part.dtype)))
            begin = end

    @property
    def begins(self) -> dict[str, int]:
        """The index of the first value of every part in the recorded array."""
        return {name: place.start for name, place, *_ in self._places}

    def flat(self, arrays: Mapping[str, NDArray[np.generic]]) -> NDArray[np.generic]:
        """Return the recorded array of an observation."""
        import numpy as np

        found = np.concatenate([arrays[name].ravel() for name in self.parts]).astype(self._dtype, copy=False)
        found.flags.writeable = False
        return found

    def blank(self) -> NDArray[np.generic]:
        """Return the recorded array of an agent that has left the simulation, which contains only zeros."""
        import numpy as np

        return np.zeros(self.flat_space.shape, self._dtype)

    def restore(self, array: NDArray[np.generic]) -> dict[str, NDArray[np.generic]]:
        """Return the observation that the agent receives, from its recorded array."""
        return {
            name: array[place].reshape(shape) if dtype is array.dtype else array[place].reshape(shape).astype(dtype)
            for name, place, shape, dtype in self._places
        }

    def with_errors(
        self, array: NDArray[Any], factors: NDArray[np.float64], center: tuple[float, float]
    ) -> NDArray[Any]:
        """Return a recorded array whose measured values have errors.

        Args:
            array: The recorded array.
            factors: The factor of each value.
            center: The centre of the controlled vehicle, from which factors of positions are counted, in m.
        """
        import numpy as np

        found = array.copy()
        for name, place, shape, _ in self._places:
            part, values = self.parts[name].part, found[place].reshape(shape)
            wrong = factors[place].reshape(shape)
            box = self._boxes[name]
            if part.columns:
                is_empty = ~values.any(axis=-1)
                for column in part.measured:
                    index = self.columns[name][column]
                    origin = {"x": center[0], "y": center[1]}.get(column, 0.0)
                    changed = origin + (values[..., index] - origin) * wrong[..., index]
                    values[..., index] = np.where(is_empty, 0.0, changed)
            elif part.measured:
                values *= wrong
            np.clip(values, box.low, box.high, out=values)
        found.flags.writeable = False
        return found

    def with_earlier(self, array: NDArray[Any], other: NDArray[Any] | None, *, steps_before: int) -> NDArray[Any]:
        """Return a recorded array of a layout with a history, with the earlier observations of another array.

        Args:
            array: The recorded array.
            other: The other recorded array; None to repeat the last observation, as at the start of an episode.
            steps_before: How many steps the other array is before this one, 0 or 1.
        """
        found = array.copy()
        for _, place, shape, _ in self._places:
            stack, begin = found[place].reshape(shape), steps_before
            earlier = stack[-1:] if other is None else other[place].reshape(shape)[begin : len(stack) - 1 + begin]
            stack[:-1] = earlier
        found.flags.writeable = False
        return found

    def describe(self) -> dict[str, SpaceDescription]:
        """Return the shape, the columns and their units of every part as JSON-compatible data."""
        return {
            name: {
                "shape": list(self._boxes[name].shape),
                "columns": [column.name for column in one.part.columns],
                "units": [column.unit for column in one.part.values_of_last_axis],
            }
            for name, one in self.parts.items()
        }


def _stacked(box: spaces.Box, history: int) -> spaces.Box:
    """Return the space of several arrays of a space, stacked along a new first axis."""
    import numpy as np
    from gymnasium import spaces

    if not history:
        return box
    low, high = (np.repeat(bound[None], history, axis=0) for bound in (box.low, box.high))
    return spaces.Box(low, high, dtype=box.dtype.type)


class History:
    """The last observations of an agent in an episode, if its layout stacks them.

    Args:
        layout: The layout of the observation.
    """

    def __init__(self, layout: ObservationLayout) -> None:
        self._last: dict[str, deque[NDArray[Any]]] = {name: deque(maxlen=layout.history) for name in layout.parts}
        self._length = layout.history

    def add(self, arrays: Mapping[str, NDArray[Any]]) -> Mapping[str, NDArray[Any]]:
        """Add the present observation; return the observation that the agent receives."""
        if not self._length:
            return arrays
        import numpy as np

        for name, array in arrays.items():
            last = self._last[name]
            last.extend([array] * (1 if last else self._length))
        return {name: np.stack(last) for name, last in self._last.items()}


def layouts_of(setups: Mapping[str, AgentSetup], available: Iterable[str]) -> dict[str, ObservationLayout]:
    """Return the layout of the observation of each agent that observes parts.

    Args:
        setups: The setups of all agents of a scenario, by agent.
        available: Names of the parts that the simulator has.

    Raises:
        UsageError: A part or a setting does not exist, or a value is out of range.
    """
    known = tuple(available)
    parts = {
        agent: parse_parts(setup.observation or (), known, where=f"agents.{agent}.observation")
        for agent, setup in setups.items()
    }
    return {
        agent: ObservationLayout(found, modifiers_of(setups[agent].observation or ()))
        for agent, found in parts.items()
        if found
    }
