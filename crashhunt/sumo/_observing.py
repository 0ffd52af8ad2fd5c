"""Builds the observations of agents that observe parts: one reader per part, created for each agent and episode."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.simulators import History, layouts_of
from crashhunt.sumo._ego_and_actors import ActorsReader, EgoReader
from crashhunt.sumo._observed_network import RoadNetwork
from crashhunt.sumo._reader_protocol import ReaderSetup
from crashhunt.sumo._scene_readers import PredictionsReader, RangesReader

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    import numpy as np
    from numpy.typing import NDArray

    from crashhunt.scenario import AgentSetup
    from crashhunt.sumo._reader_protocol import Moment, Reader

READERS: Mapping[str, type[Reader]] = {
    "actors": ActorsReader,
    "ego": EgoReader,
    "lidar2d": RangesReader,
    "predictions": PredictionsReader,
}
"""The reader of each part, by name of the part; these are the parts that SUMO has."""


class ObservedParts:
    """Builds the observations of all agents that observe parts.

    Args:
        setups: The setups of all agents of the scenario, by agent.
        step_length_s: Length of a step, in s.

    Attributes:
        layouts: The layout of each such agent's observation.
        reach_m: Largest distance at which a part shows actors, in m; 0 if no part shows actors.
    """

    def __init__(self, setups: Mapping[str, AgentSetup], step_length_s: float) -> None:
        self.layouts = layouts_of(setups, READERS)
        self.reach_m = max((layout.reach_m for layout in self.layouts.values()), default=0.0)
        self._step_length_s = step_length_s
        self._network = RoadNetwork()
        self._readers: dict[str, dict[str, Reader]] = {}
        self._histories: dict[str, History] = {}

    def begin(
        self, starts: Mapping[str, float], time_s: float, steering: Mapping[str, Callable[[], float]] | None = None
    ) -> None:
        """Begin an episode.

        Args:
            starts: The odometer of every agent's vehicle, in m.
            time_s: The simulation time, in s.
            steering: Functions that return the steering angle of vehicles whose actions contain one.
        """
        known = steering or {}
        self._histories = {agent: History(layout) for agent, layout in self.layouts.items()}
        self._readers = {
            agent: {
                name: READERS[name](
                    ReaderSetup(
                        agent=agent,
                        request=request,
                        network=self._network,
                        step_length_s=self._step_length_s,
                        start_m=starts[agent],
                        start_s=time_s,
                        steering=known.get(agent),
                    )
                )
                for name, request in layout.parts.items()
            }
            for agent, layout in self.layouts.items()
            if agent in starts
        }

    def observe(self, agent: str, moment: Moment) -> NDArray[np.generic]:
        """Return the recorded array of an agent's observation."""
        arrays = {name: reader.observe(moment) for name, reader in self._readers[agent].items()}
        return self.layouts[agent].flat(self._histories[agent].add(arrays))

    def identifiers(self, agent: str) -> tuple[str, ...] | None:
        """Return the identifiers of the actors in the rows of ``actors``; None if the agent does not observe them."""
        reader = self._readers.get(agent, {}).get("actors")
        return reader.ids if isinstance(reader, ActorsReader) else None
