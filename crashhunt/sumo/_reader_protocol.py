"""What the readers of observations on SUMO receive, and what they return."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from libsumo import _libsumo as sumo

from crashhunt.simulators import center_of, nearest_actors
from crashhunt.sumo._drivable_area import obstacle_outlines

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from crashhunt.native import Core, Draft
    from crashhunt.simulators import NearActor, ObstacleOutlines, RequestedPart
    from crashhunt.sumo._conflicts import Conflicts
    from crashhunt.sumo._lane_graph import GraphLane, LaneGraph, RouteGuide
    from crashhunt.sumo._lane_paths import NearLanesOf
    from crashhunt.world import RoadMap, Scene

NEVER_S = 1000.0
"""The time of what does not happen: an actor that stands does not arrive, and a light does not switch."""

NO_VALUE = -1073741824.0
"""The value of SUMO's getters without a value, as in `libsumo.INVALID_DOUBLE_VALUE`."""


@dataclass(frozen=True, slots=True)
class ReaderSetup:
    """What a reader is created with, for one agent and one episode."""

    agent: str  # identifier of the agent, which is also the identifier of its vehicle
    request: RequestedPart  # the part with the values of its settings
    graph: LaneGraph  # The lanes of the network. One object is shared by all readers of the simulator, in all episodes.
    conflicts: Conflicts  # the conflicts at the junctions, shared like the lanes
    places: Places  # Finds the vehicle on the network. One object is shared by all readers of the agent.
    step_length_s: float
    start_m: float  # the vehicle's odometer (`vehicle.getDistance`) at the start of the episode, in m
    start_s: float  # simulation time at the start of the episode, in s
    # Function that returns the steering angle of the vehicle, in rad, positive to the left. None if the vehicle's
    # actions contain no steering angle. The angle then follows from the yaw rate.
    steering: Callable[[], float] | None = None
    core: Core | None = None  # the compiled core; None if it is not used
    reference_share: float = 0.0  # how far the reference point is ahead of the centre, as a share of a vehicle's length
    # the lanes near each square, by sampling and vehicle class, shared like the lanes
    near: NearLanesOf = field(default_factory=dict)
    moving: frozenset[str] = frozenset()  # identifiers of the vehicles that move freely
    seed: int = 0  # seed of the trial
    obstacles: ObstacleOutlines | None = None  # the obstacles of the episode; None if there are none

    @property
    def settings(self) -> Mapping[str, float]:
        """The value of every setting of the part."""
        return self.request.settings

    @property
    def limit(self) -> int:
        """The number of rows of a part with one row per actor."""
        return int(self.request.settings["rows"])

    def offset_of(self, vehicle: str) -> float:
        """Return the distance of a vehicle from the centre line of its lane, in m, positive to the left."""
        offset = float(sumo.vehicle_getLateralLanePosition(vehicle))
        if offset == NO_VALUE:
            return 0.0
        # In left-hand traffic, SUMO mirrors the offsets of all vehicles but those that it has moved to a position.
        return -offset if offset and self.graph.is_left_hand and vehicle not in self.moving else offset

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the part."""
        return self.request.shape


@dataclass(slots=True)
class AgentMoment:
    """The state after a step, as seen by one agent. All readers of the agent receive the same object in a step."""

    scene: Scene
    row: int  # the row of the agent's vehicle in the scene
    lane: str  # the vehicle's lane, such as ``E0_1``; the last lane if the vehicle is off every lane
    hidden: frozenset[str]  # identifiers of the actors that the agent does not see, as in scenes


class NetworkPlace(NamedTuple):
    """Where a vehicle is on the network."""

    lane: GraphLane  # its lane, or its last lane if it is off every lane
    position_m: float  # distance of the front bumper from the start of the lane, in m, as SUMO measures it
    guide: RouteGuide
    number: int  # index of the lane's edge on the route; of the edge before, inside a junction; -1 off the route
    x: float  # x of the centre of the vehicle, in m
    y: float  # y of the centre of the vehicle, in m


class Places:
    """Finds a vehicle on the network, once per step for all readers of an agent."""

    def __init__(self, graph: LaneGraph, agent: str) -> None:
        self._graph, self._agent = graph, agent
        self._class = sumo.vehicle_getVehicleClass(agent)
        self._moment: AgentMoment | None = None
        self._place: NetworkPlace | None = None
        self._route = ""
        self._guide = graph.guide((), self._class)

    @property
    def vehicle_class(self) -> str:
        """The class of the vehicle."""
        return str(self._class)

    def find(self, moment: AgentMoment) -> NetworkPlace | None:
        """Return where the vehicle is; None if its lane is not in the network file."""
        if moment is not self._moment:
            self._moment, self._place = moment, self._found(moment)
        return self._place

    def road_map(self) -> RoadMap:
        """Return the map of the roads with the vehicle's route, from its present lane on."""
        name, number = sumo.vehicle_getLaneID(self._agent), max(0, sumo.vehicle_getRouteIndex(self._agent))
        guide = self._graph.guide(tuple(sumo.vehicle_getRoute(self._agent)), self._class)
        outlines = {one: np.array(shape) for one, shape in obstacle_outlines().items()}
        for outline in outlines.values():
            outline.flags.writeable = False
        return replace(guide.road_map(number, self._graph.lanes.get(name)), obstacles=MappingProxyType(outlines))

    def _found(self, moment: AgentMoment) -> NetworkPlace | None:
        agent, scene, row = self._agent, moment.scene, moment.row
        lane = self._graph.lanes.get(moment.lane)
        if lane is None:
            return None
        route = sumo.vehicle_getRouteID(agent)
        if route != self._route:
            self._route = route
            self._guide = self._graph.guide(tuple(sumo.vehicle_getRoute(agent)), self._class)
        number = sumo.vehicle_getRouteIndex(agent)
        if not self._guide.follows(number, lane):
            number = -1
        position = sumo.vehicle_getLanePosition(agent)
        if position < 0.0:  # off every lane
            position = _position_on(self._graph, lane, *scene.points[row])
        return NetworkPlace(lane, position, self._guide, number, *center_of(scene, row))


def _position_on(graph: LaneGraph, lane: GraphLane, x: float, y: float) -> float:
    """Return the distance along a lane, as SUMO measures it, of the point of its centre line nearest to a point."""
    center = graph.lines(lane).center
    start, step = center[:-1], np.diff(center, axis=0)
    length = np.hypot(step[:, 0], step[:, 1])
    share = np.clip((((x, y) - start) * step).sum(axis=1) / length**2, 0.0, 1.0)
    away = ((start + share[:, None] * step - (x, y)) ** 2).sum(axis=1)
    row = int(np.argmin(away))
    along = float(length[:row].sum() + share[row] * length[row])
    return along / float(length.sum()) * lane.data.length_m


class Reader:
    """Reads one part of an agent's observation. A reader may keep state from step to step of one episode."""

    def __init__(self, setup: ReaderSetup) -> None:
        self._setup = setup

    def observe(self, moment: AgentMoment) -> NDArray[np.generic]:
        """Return the part after the last step, as a new array; crashhunt calls this method once per step, from step 0.

        The array has the shape and the data type of the part. The method changes nothing in the simulation.
        """
        raise NotImplementedError

    def _actors_near(self, moment: AgentMoment) -> list[NearActor]:
        """Return the actors in the rows of a part with one row per actor, the nearest first."""
        setup = self._setup
        radius = setup.settings["radius"]
        return nearest_actors(moment.scene, moment.row, hidden=moment.hidden, radius=radius, limit=setup.limit)

    def write(self, draft: Draft, place: int, moment: AgentMoment) -> None:
        """Write the same values into a draft of the compiled core, which replaces a call of `observe`."""
        draft.put_array(place, self.observe(moment).astype(np.float64, copy=False))


class RowsReader(Reader):
    """Reads a part as rows of numbers; the rows after the last one are 0."""

    def observe(self, moment: AgentMoment) -> NDArray[np.float64]:
        """Return the columns of the part."""
        found = np.zeros(self._setup.shape)
        for number, values in enumerate(self._rows(moment)):
            found[number] = values
        return found

    def write(self, draft: Draft, at: int, moment: AgentMoment) -> None:
        """Write the columns of the part."""
        draft.put(at, tuple([value for row in self._rows(moment) for value in row]))

    def _rows(self, moment: AgentMoment) -> list[tuple[float, ...]]:
        raise NotImplementedError
