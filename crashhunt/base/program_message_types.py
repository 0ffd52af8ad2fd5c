"""Messages of protocol 1, which crashhunt and the program of an agent exchange, and the road map."""

from __future__ import annotations

from typing import Any, Literal, NotRequired, TypedDict


class SpaceDescription(TypedDict):
    """The form of one part of an observation, or of an action.

    ``bounds`` has the least and the greatest value of each number; null if there is no bound. ``meanings`` has the name
    of each number of a discrete action.
    """

    shape: list[int]
    columns: list[str]
    units: list[str]
    bounds: NotRequired[list[list[float | None] | None]]
    meanings: NotRequired[list[str]]


class Hello(TypedDict):
    """The first message to a program."""

    type: Literal["hello"]
    protocol: Literal[1]
    agent: str
    arguments: dict[str, bool | int | float | str]
    observation: dict[str, SpaceDescription]
    action: SpaceDescription
    step_length_s: float


class Reset(TypedDict):
    """The beginning of an episode.

    ``map`` is the path of the road map if ``ready`` asks for it; null if the simulator has none.
    """

    type: Literal["reset"]
    seed: int
    map: NotRequired[str | None]


class Observe(TypedDict):
    """An observation as nested lists, or as an object of these; ``step`` counts from 0 in each episode."""

    type: Literal["observe"]
    step: int
    time_s: float
    observation: Any


class Close(TypedDict):
    """The last message to a program, which then ends."""

    type: Literal["close"]


class DeclaredArgument(TypedDict, total=False):
    """An argument that a program declares; ``range`` is written as in ``--arg NAME=SPEC``."""

    range: str
    unit: str
    default: bool | int | float | str


class Ready(TypedDict):
    """The answer to ``hello``.

    ``observation`` lists the parts that the program observes, and ``action`` is the form of its actions, if neither the
    command line nor the scenario names others. With ``map``, each ``reset`` has the path of the road map.
    """

    type: Literal["ready"]
    protocol: NotRequired[Literal[1]]
    format: NotRequired[Literal["json", "msgpack"]]
    arguments: NotRequired[dict[str, DeclaredArgument]]
    observation: NotRequired[list[str]]
    action: NotRequired[str]
    map: NotRequired[bool]
    revision: NotRequired[str]


class Ok(TypedDict):
    """The answer to ``reset``."""

    type: Literal["ok"]


class Act(TypedDict):
    """The answer to ``observe``."""

    type: Literal["act"]
    action: Any
    panels: NotRequired[Any]


class MapLaneData(TypedDict):
    """A lane of the road map; lines are lists of points, and a point is a list of x and y."""

    id: str
    road: str
    index: int
    center: list[list[float]]
    left_line: list[list[float]]
    right_line: list[list[float]]
    width: float
    speed_limit: float
    length: float
    successors: list[str]
    predecessors: list[str]
    left: str
    right: str
    can_change_left: bool
    can_change_right: bool
    allowed: list[str]
    is_open: bool
    is_internal: bool


class StopLineData(TypedDict):
    """The end of a lane at which a vehicle may have to stop."""

    lane: str
    junction: str
    ends: list[list[float]]
    kind: str
    signal: str


class RoadMapData(TypedDict):
    """The road map, in the file that ``reset`` names: x to the east, y to the north, in m.

    ``vehicle`` has the size and the limits of the vehicle.
    """

    lanes: dict[str, MapLaneData]
    stop_lines: list[StopLineData]
    route: list[str]
    reference_path: list[list[float]]
    is_left_hand: bool
    obstacles: dict[str, list[list[float]]]
    vehicle: dict[str, float | str]


ProgramRequest = Hello | Reset | Observe | Close
"""A message to a program."""

ProgramAnswer = Ready | Ok | Act
"""A message from a program."""
