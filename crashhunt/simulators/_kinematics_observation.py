"""The Kinematics observation: the controlled vehicle and its nearest actors, in highway-env's layout."""

from __future__ import annotations

import struct
from math import atan2, cos, sin
from operator import itemgetter
from typing import TYPE_CHECKING, Protocol

import numpy as np

from crashhunt.world import OBSTACLE_KINDS, on_one_level

if TYPE_CHECKING:
    from collections.abc import Callable

    from gymnasium import Space
    from numpy.typing import NDArray

    from crashhunt.scenario import ObservationSetup
    from crashhunt.world import Scene


_FLOAT32 = np.dtype("<f4")
_ALL_COLUMNS = ("presence", "x", "y", "vx", "vy", "heading", "cos_h", "sin_h", "kind")
_DEFAULT_COLUMNS = ("presence", "x", "y", "vx", "vy", "cos_h", "sin_h")
# As in highway-env: 5 times and 2 times its top speed of 40 m/s, and its lane width of 4 m.
_RANGE_X, _RANGE_V, _LANE_WIDTH = 200.0, 80.0, 4.0

# The value of `kind` by the simulator's name of the actor's class. An empty row has 0. An unlisted class is a motor
# vehicle.
_MOTOR, _TWO_WHEELS, _PERSON, _RAIL, _OBSTACLE = 1.0, 2.0, 3.0, 4.0, 5.0
_KIND_NUMBERS = {
    **dict.fromkeys(("bicycle", "motorcycle", "moped", "scooter"), _TWO_WHEELS),
    **dict.fromkeys(("pedestrian", "wheelchair"), _PERSON),
    **dict.fromkeys(("rail", "rail_urban", "rail_electric", "rail_fast", "tram", "subway", "cable_car"), _RAIL),
    **dict.fromkeys(OBSTACLE_KINDS, _OBSTACLE),
}


def kind_number(kind: str) -> float:
    """Return the value of the column ``kind`` for the simulator's name of an actor's class."""
    return _KIND_NUMBERS.get(kind, _MOTOR)


class Kinematics:
    """Builds observations: float32, shape (vehicles, features).

    Row 0 is the controlled vehicle. In row 0, x is the distance driven (m), and y is the distance to the right of the
    leftmost lane's centre (m). In row 0, vx and vy are the speeds along and across the lane (m/s). The heading in row 0
    is relative to the map.

    The other rows are the nearest actors, the nearest first, relative to the controlled vehicle: x ahead (m), y to the
    right (m), velocity (m/s) and heading. Headings grow clockwise, because y points to the right. Rows without an actor
    are 0. On a straight road along the x axis, highway-env shows the same values.

    Actors on another level, such as a bridge above, are not shown. In two dimensions they would look like obstacles.

    The optional column `kind` gives the class of the actor: 1 motor vehicle, 2 bicycle or motorcycle, 3 person on foot,
    4 rail vehicle, 5 obstacle. Normalised observations have a fifth of these values.

    Sine and cosine come from the C library, because NumPy's results differ between processors in the last bit.

    Args:
        setup: Settings of the observation: the number of rows, the columns, and whether values are normalised.

    Attributes:
        hidden: Pairs of identifiers: an agent, and an actor that this agent does not see.
    """

    def __init__(self, setup: ObservationSetup) -> None:
        self.features: tuple[str, ...] = tuple(setup.features)
        self.shape = (setup.vehicles, len(self.features))
        self._others = setup.vehicles - 1
        self._normalize = setup.normalize
        indices = [_ALL_COLUMNS.index(feature) for feature in self.features]
        getter = itemgetter(*indices)
        self._select: Callable[[tuple[float, ...]], tuple[float, ...]] = (
            getter if len(indices) > 1 else lambda values: (getter(values),)
        )
        self._pack = struct.Struct(f"<{setup.vehicles * len(self.features)}f").pack
        # With the usual columns, `observe` need not select columns in every row.
        self._usual = self.features == _DEFAULT_COLUMNS and not setup.normalize
        self.hidden: set[tuple[str, str]] = set()
        self._blank = (0.0,) * len(self.features)

    @property
    def usual(self) -> bool:
        """Whether the observation is not normalised and has exactly the columns that the compiled core writes."""
        return self._usual

    @property
    def space(self) -> Space[object]:
        """The Gymnasium space: as in highway-env, but with finite bounds that no simulation reaches."""
        from gymnasium import spaces

        limits = dict.fromkeys(_ALL_COLUMNS, 1.0) | {"heading": float(np.float32(np.pi))}
        if not self._normalize:
            limits |= {"x": 1e6, "y": 1e6, "vx": 1e3, "vy": 1e3, "kind": _OBSTACLE}
        high = np.tile([limits[feature] for feature in self.features], (self.shape[0], 1)).astype(np.float32)
        low = np.where([feature in ("presence", "kind") for feature in self.features], 0.0, -high).astype(np.float32)
        return spaces.Box(low, high, self.shape, np.float32)

    def hidden_from(self, agent: str) -> frozenset[str]:
        """Return the identifiers of the actors that an agent does not see."""
        return frozenset(other for who, other in self.hidden if who == agent)

    def blank(self) -> NDArray[np.float32]:
        """Return the observation of an agent that has left the simulation, which contains only zeros."""
        return np.zeros(self.shape, np.float32)

    def observe(
        self, scene: Scene, row: int, *, distance: float, from_left: float, lateral_speed: float, lanes: int
    ) -> NDArray[np.float32]:
        """Return the observation of the actor in ``row``.

        Args:
            scene: The scene after the last step.
            row: The actor's row in the scene.
            distance: The distance that the actor has driven, in m.
            from_left: The distance of the actor to the right of the leftmost lane's centre, in m.
            lateral_speed: The actor's speed to the right, in m/s.
            lanes: Number of lanes of the actor's edge, which is the range of y when normalising.
        """
        columns = scene.columns
        if scene.core is not None and columns is not None and self._usual and not scene.heights and not self.hidden:
            found = scene.core.observe(columns, row, self._others, distance, from_left, lateral_speed)
            if found is not None:
                return np.ndarray(self.shape, _FLOAT32, found)
        points, headings, speeds, actors = scene.points, scene.headings, scene.speeds, scene.roster.actors
        heading, speed = headings[row], speeds[row]
        own_cos, own_sin, half = cos(heading), sin(heading), actors[row].length / 2
        x, y = points[row]
        center_x, center_y = x - half * own_cos, y - half * own_sin
        own_vx, own_vy = speed * own_cos, speed * own_sin
        select = self._select if not self._normalize else self._normalized(lanes)
        kind = kind_number(actors[row].kind)
        own = (1.0, distance, from_left, speed, lateral_speed, atan2(-own_sin, own_cos), own_cos, -own_sin, kind)
        values = [*select(own)]
        usual = self._usual
        nearest = scene.neighbors(row)
        if scene.heights:
            nearest = [(squared, other) for squared, other in nearest if on_one_level(scene, row, other)]
        if self.hidden:
            own_id = actors[row].id
            nearest = [found for found in nearest if (own_id, actors[found[1]].id) not in self.hidden]
        nearest = nearest[: self._others]
        for _, other in nearest:
            heading = headings[other]
            c, s = cos(heading), sin(heading)
            x, y = points[other]
            half = actors[other].length / 2
            dx, dy = x - half * c - center_x, y - half * s - center_y
            speed = speeds[other]
            vx, vy = speed * c - own_vx, speed * s - own_vy
            ahead, right = dx * own_cos + dy * own_sin, dx * own_sin - dy * own_cos
            faster, drift = vx * own_cos + vy * own_sin, vx * own_sin - vy * own_cos
            turn_cos, turn_sin = c * own_cos + s * own_sin, c * own_sin - s * own_cos
            if usual:
                values += (1.0, ahead, right, faster, drift, turn_cos, turn_sin)
            else:
                turn = atan2(turn_sin, turn_cos)
                kind = kind_number(actors[other].kind)
                values += select((1.0, ahead, right, faster, drift, turn, turn_cos, turn_sin, kind))
        values += self._blank * (self._others - len(nearest))
        return np.frombuffer(self._pack(*values), "<f4").reshape(self.shape)

    def _normalized(self, lanes: int) -> Callable[[tuple[float, ...]], tuple[float, ...]]:
        range_y = _LANE_WIDTH * max(lanes, 1)
        ranges = (1.0, _RANGE_X, range_y, _RANGE_V, _RANGE_V, 0.0, 0.0, 0.0, _OBSTACLE)

        def select(values: tuple[float, ...]) -> tuple[float, ...]:
            scaled = [
                max(-1.0, min(1.0, value / limit)) if limit else value
                for value, limit in zip(values, ranges, strict=True)
            ]
            return self._select(tuple(scaled))

        return select


# The disturbance `unseen`: the observation omits a vehicle for a while, and nothing else changes.


class HidesActors(Protocol):
    """An object that makes observations, and that can omit actors."""

    hidden: set[tuple[str, str]]
    """Pairs of identifiers: an agent, and an actor that this agent does not see."""


class Unseen:
    """Hides one vehicle from one agent, from the next observation on."""

    how_strong = 1.0

    def __init__(self, kinematics: HidesActors, agent: str, vehicle: str) -> None:
        self._hidden = kinematics.hidden
        self._pair = agent, vehicle
        self._hidden.add(self._pair)

    def keep(self) -> None:
        """Keep the vehicle hidden; this needs no action."""

    def end(self) -> None:
        """Show the vehicle again."""
        self._hidden.discard(self._pair)
