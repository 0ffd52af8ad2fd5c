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
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

from crashhunt.simulators._bicycle_model import WHEELBASE_SHARE

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping


class Column(NamedTuple):
    """A column of a part, which is an entry of the last axis."""

    name: str  # name of the column
    unit: str  # unit of the values; empty for numbers without a unit
    low: float  # lower bound of the values
    high: float  # upper bound of the values
    meaning: str  # description of the values

    @property
    def range(self) -> str:
        """The range as text; empty if its bounds are only those that no simulation reaches."""
        return f"{self.low:.3g}:{self.high:.3g}" if self.high <= _LARGEST_SHOWN else ""


class Setting(NamedTuple):
    """A setting of a part, such as its number of rows."""

    name: str  # name of the setting, as in ``actors:rows=8``
    default: float  # the default value
    low: float  # the smallest value
    high: float  # the largest value
    unit: str  # unit of the value; empty for whole numbers
    meaning: str  # description of the setting
    # the words that the setting takes instead of numbers; its value is then the index of the word
    choices: tuple[str, ...] = ()
    requires: str = ""  # the part that the simulator must also have for values other than 0; empty if there is none

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
    """A part of an observation."""

    name: str  # name of the part
    meaning: str  # description of the part
    # the axes before the columns, each a length or the name of the setting that contains it
    axes: tuple[str | int, ...] = ()
    # the columns, which are the last axis; empty if the values of all axes have the same meaning
    columns: tuple[Column, ...] = ()
    values: Column | None = None  # description of the values of a part without columns
    settings: tuple[Setting, ...] = ()  # the settings of the part
    # columns that the disturbance ``noisy_observation`` changes; ``x`` and ``y`` relative to the position of the
    # controlled vehicle
    measured: tuple[str, ...] = ()
    dtype: str = "<f8"  # data type of the values
    relation: tuple[Column, ...] = ()  # the columns that the setting ``relation`` adds

    @property
    def values_of_last_axis(self) -> tuple[Column, ...]:
        """The columns, or the description of all values if the part has no columns."""
        return self.columns or ((self.values,) if self.values is not None else ())


_LARGEST_SHOWN = 360.0

# Bounds that no simulation reaches: a Box needs finite bounds, because noise is clipped to them.
_POSITION_M, _DISTANCE_M, _SPEED_MPS, _ACCELERATION_MPS2, _TIME_S = 1e8, 1e7, 1e3, 1e4, 1e9
_PI = math.pi


def _quantity(unit: str, low: float, high: float) -> Callable[[str, str], Column]:
    """Return a function that makes a column of a quantity from its name and meaning."""
    return lambda name, meaning: Column(name, unit, low, high, meaning)


_flag = _quantity("", 0.0, 1.0)
_position = _quantity("m", -_POSITION_M, _POSITION_M)
_distance = _quantity("m", -_DISTANCE_M, _DISTANCE_M)
_size = _quantity("m", 0.0, 1e3)
_speed = _quantity("m/s", -_SPEED_MPS, _SPEED_MPS)
_acceleration = partial(_quantity("m/s²", -_ACCELERATION_MPS2, _ACCELERATION_MPS2), "acceleration")
_time = _quantity("s", 0.0, _TIME_S)


def _heading(meaning: str) -> Column:
    return Column("heading", "rad", -_PI, _PI, f"{meaning}, counter-clockwise from the x axis")


REACH_M = 120.0
"""Largest distance at which a part shows actors, because scenes contain the actors within 150 m at least."""

OFF, ON = "false", "true"
"""The choices of a setting that adds columns."""

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
    meaning="hides actors behind others and behind obstacles in all parts: an actor is seen if one of the rays from "
    "the centre of the controlled vehicle hits its outline first",
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
                Setting(
                    "relation", 0, 0, 1, "", "adds columns about the actors' lanes, followed as far as ``radius``",
                    (OFF, ON), "right_of_way",
                ),
            ),
            measured=("x", "y", "vx", "vy", "acceleration", "length", "width", "ahead", "lane_offset"),
            relation=(
                _flag("left", "1 if ``same_lane`` is 0, and the actor's lane is to the left of the vehicle's lane on "
                      "the same road, or of lanes that the route continues to; also if its lane leads to such lanes "
                      "only, or if only such lanes lead to it"),
                _flag("right", "as ``left``, to the right"),
                _flag("oncoming", "1 if the actor drives towards the vehicle on these roads, or on a road back between "
                      "the same junctions that is at most 5 m away"),
                _flag("crossing", "1 if the actor's lane is inside a junction of the route, or leads into it, on a "
                      "path that crosses or joins the vehicle's path there; or if it is a pedestrian crossing there"),
            ),
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
            meaning="points along the route ahead, on the best lane; a required lane change is a step to the side",
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
                _distance("distance", "distance of the front bumper to the stop line, negative behind it"),
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
                Setting(
                    "along", 0, 0, 1, "", "what the actor drives along", ("heading", "lanes"), "right_of_way"
                ),
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
                _distance(
                    "distance",
                    "distance of the front bumper to the conflict area, as in ``right_of_way``, which begins up to "
                    "1.5 m before the crossing; negative if it is behind",
                ),
                _flag("must_yield", "1 if the controlled vehicle must yield to persons on the crossing"),
                Column("persons", "", 0.0, 1e6, "number of persons within ``near`` of the crossing's centre line"),
                _distance(
                    "nearest",
                    "distance of the nearest person to the middle of this area on the crossing; 1000 without a person",
                ),
            ),
            settings=(
                Setting("rows", 4, 1, 50, "", "number of rows"),
                Setting("near", 5.0, 0.1, 50.0, "m", "largest distance of a person that counts"),
            ),
            measured=("nearest",),
        ),
        Part(
            name="lidar2d",
            meaning="distances from the centre of the controlled vehicle to the nearest outline of an actor or "
            "obstacle, for directions counter-clockwise from its heading; ``range`` if no outline is nearer",
            axes=("rays",),
            values=Column("distance", "m", 0.0, REACH_M, "distance along the ray"),
            settings=(
                Setting("rays", 360, 1, 10_000, "", "number of rays, evenly distributed over the full circle"),
                Setting("range", 100.0, 1.0, REACH_M, "m", "largest distance"),
                Setting(
                    "noise", 0.0, 0.0, 10.0, "m",
                    "standard deviation of a normal error of each distance below ``range``, by the trial's seed",
                ),
            ),
            measured=("distance",),
        ),
        Part(
            name="grid",
            meaning="cells around the controlled vehicle: layer 0 is 1 where an actor or obstacle is, layer 1 is 1 "
            "where a lane is. The vehicle is in the middle. Its heading points to smaller row numbers, and its left "
            "side to smaller column numbers",
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
            "(224, 138, 0), actors are (125, 139, 156), obstacles (196, 186, 176), lanes (228, 232, 237), all else "
            "(246, 247, 249)",
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
