"""Builds the observations of agents that observe parts: one reader per part, created for each agent and episode."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.simulators import (
    REACH_M,
    History,
    ObstacleOutlines,
    RayCaster,
    layouts_of,
    occluded,
    with_reference_point,
)
from crashhunt.sumo._conflicts import Conflicts
from crashhunt.sumo._drivable_area import obstacle_outlines
from crashhunt.sumo._ego_and_actors import ActorsReader, EgoReader
from crashhunt.sumo._lane_graph import USUAL_CLASS, lane_graph
from crashhunt.sumo._reader_protocol import Places, ReaderSetup
from crashhunt.sumo._right_of_way_readers import CrossingsReader, RightOfWayReader, StopLineReader
from crashhunt.sumo._road_readers import LanesReader, RouteReader, RouteStateReader, SpeedLimitReader
from crashhunt.sumo._scene_readers import (
    ActorIdsReader,
    CovarianceReader,
    GridReader,
    ImageReader,
    PredictionsReader,
    RangesReader,
)
from crashhunt.sumo._signal_readers import SignalsReader, SwitchTimesReader

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from crashhunt.native import Core, Draft, Vehicles
    from crashhunt.scenario import Scenario
    from crashhunt.sumo._lane_graph import LaneGraph
    from crashhunt.sumo._lane_paths import NearLanesOf
    from crashhunt.sumo._reader_protocol import AgentMoment, Reader
    from crashhunt.world import Roster

READERS: Mapping[str, type[Reader]] = {
    "actor_ids": ActorIdsReader,
    "actors": ActorsReader,
    "crossings": CrossingsReader,
    "ego": EgoReader,
    "grid": GridReader,
    "image": ImageReader,
    "lanes": LanesReader,
    "lidar2d": RangesReader,
    "prediction_covariance": CovarianceReader,
    "predictions": PredictionsReader,
    "right_of_way": RightOfWayReader,
    "route": RouteReader,
    "route_state": RouteStateReader,
    "signals": SignalsReader,
    "speed_limit": SpeedLimitReader,
    "stop_line": StopLineReader,
    "time_to_switch": SwitchTimesReader,
}
"""The reader of each part, by name of the part; these are the parts that SUMO has."""

_PARTS_WITH_CONFLICTS = frozenset({"right_of_way", "stop_line", "crossings"})
_PARTS_WITH_OBSTACLES = frozenset({"grid", "image", "lidar2d"})


class ObservedParts:
    """Builds the observations of all agents that observe parts."""

    def __init__(self, scenario: Scenario, core: Core | None = None) -> None:
        self.core = core  # the compiled core, which `begin` gives to the readers; None if it is not used
        self.layouts = layouts_of(scenario.agents, READERS)  # the layout of each such agent's observation
        # largest distance at which a part shows actors, in m; 0 if no part shows actors
        self.reach_m = max((layout.reach_m for layout in self.layouts.values()), default=0.0)
        self._step_length_s = scenario.step_length_s
        self._scenario = scenario
        self._places: dict[str, Places] = {}
        self._near: NearLanesOf = {}
        self._readers: dict[str, dict[str, Reader]] = {}
        self._histories: dict[str, History] = {}
        self._casters: dict[str, RayCaster] = {}
        self._drafts: dict[str, tuple[Draft, list[tuple[int, Reader]]]] = {}

    def prepare(self) -> None:
        """Prepare the network, once for all trials in forks of this process."""
        if self.layouts:
            self.graph  # noqa: B018 - reads the network
        requests = [request for layout in self.layouts.values() for request in layout.parts.values()]
        for request in (one for one in requests if one.part.name == "lanes"):
            LanesReader.prepare(self.graph, request, USUAL_CLASS, self._near)
        if any(one.part.name in _PARTS_WITH_CONFLICTS or one.settings.get("relation") for one in requests):
            self.conflicts.prepare()

    @cached_property
    def graph(self) -> LaneGraph:
        """The lanes of the network."""
        return lane_graph(self._scenario)

    @cached_property
    def conflicts(self) -> Conflicts:
        """The conflicts at the junctions."""
        return Conflicts(self.graph)

    def places(self, agent: str) -> Places:
        """Return what finds the vehicle of an agent on the network."""
        found = self._places.get(agent)
        if found is None:
            found = self._places[agent] = Places(self.graph, agent)
        return found

    def begin(
        self,
        starts: Mapping[str, float],
        time_s: float,
        steering: Mapping[str, Callable[[], float]] | None = None,
        *,
        seed: int = 0,
    ) -> None:
        """Begin an episode.

        ``starts`` has the odometer of every agent's vehicle, in m. ``steering`` has functions that return the steering
        angle of vehicles whose actions contain one.
        """
        known = steering or {}
        self._histories = {agent: History(layout) for agent, layout in self.layouts.items()}
        self._places = {}
        obstacles = self._obstacles()
        self._casters = {
            agent: RayCaster(layout.occlusion_rays, REACH_M, obstacles)
            for agent, layout in self.layouts.items()
            if layout.occlusion_rays
        }
        self._readers = {
            agent: {
                name: READERS[name](
                    ReaderSetup(
                        agent=agent,
                        request=request,
                        graph=self.graph,
                        conflicts=self.conflicts,
                        places=self.places(agent),
                        step_length_s=self._step_length_s,
                        start_m=starts[agent],
                        start_s=time_s,
                        steering=known.get(agent),
                        core=self.core,
                        reference_share=layout.reference_share,
                        near=self._near,
                        moving=frozenset(known),
                        seed=seed,
                        obstacles=obstacles,
                    )
                )
                for name, request in layout.parts.items()
            }
            for agent, layout in self.layouts.items()
            if agent in starts
        }
        self._drafts = {}
        for agent, readers in self._readers.items():
            layout = self.layouts[agent]
            is_changed = layout.history or layout.occlusion_rays or layout.reference_share  # by what only Python does
            if self.core is None or is_changed or layout.flat_space.dtype != np.float64:
                continue
            places = [(layout.begins[name], reader) for name, reader in readers.items()]
            self._drafts[agent] = self.core.Draft(agent, math.prod(layout.flat_space.shape)), places

    def _obstacles(self) -> ObstacleOutlines | None:
        """Return the obstacles of the episode; None if there are none, or no agent sees them."""
        layouts = self.layouts.values()
        if not any(layout.occlusion_rays or _PARTS_WITH_OBSTACLES & layout.parts.keys() for layout in layouts):
            return None
        outlines = obstacle_outlines()
        return ObstacleOutlines(outlines.values()) if outlines else None

    def observe(self, agent: str, moment: AgentMoment) -> NDArray[np.generic]:
        """Return the recorded array of an agent's observation."""
        layout = self.layouts[agent]
        if agent in self._casters:
            moment = replace(moment, hidden=moment.hidden | occluded(moment.scene, moment.row, self._casters[agent]))
        drafted = self._drafts.get(agent)
        if drafted is not None:
            draft, places = drafted
            draft.begin(moment.scene.columns, moment.row, moment.lane, moment.scene.time_s)
            for place, reader in places:
                if not draft.has(place):
                    reader.write(draft, place, moment)
            return np.frombuffer(draft.take())
        arrays = self.read(agent, moment)
        if layout.reference_share:
            with_reference_point(arrays, layout.columns, layout.reference_share)
        return layout.flat(self._histories[agent].add(arrays))

    def enter(self, agent: str, vehicles: Vehicles, row: int, roster: Roster) -> None:
        """Set the vehicles in sight of an agent, in whose observation the core writes from now on."""
        reader = self._readers[agent].get("actors")
        if isinstance(reader, ActorsReader):
            reader.enter(roster.actors)
        self._drafts[agent][0].enter(vehicles, row)

    def draft(self, agent: str) -> Draft | None:
        """Return what the core writes an agent's observations into; None if it does not."""
        return self._drafts[agent][0] if agent in self._drafts else None

    def read(self, agent: str, moment: AgentMoment) -> dict[str, NDArray[np.generic]]:
        """Return the parts of an agent's observation, before modifiers."""
        return {name: reader.observe(moment) for name, reader in self._readers[agent].items()}

    def identifiers(self, agent: str) -> tuple[str, ...] | None:
        """Return the identifiers of the actors in the rows of ``actors``; None if the agent does not observe them."""
        reader = self._readers.get(agent, {}).get("actors")
        return reader.ids if isinstance(reader, ActorsReader) else None
