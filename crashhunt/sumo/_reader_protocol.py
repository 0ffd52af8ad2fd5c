"""What the readers of observations on SUMO receive, and what they return."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    import numpy as np
    from numpy.typing import NDArray

    from crashhunt.simulators import RequestedPart
    from crashhunt.sumo._observed_network import RoadNetwork
    from crashhunt.world import Scene


@dataclass(frozen=True, slots=True)
class ReaderSetup:
    """What a reader is created with, for one agent and one episode.

    Args:
        agent: Identifier of the agent, which is also the identifier of its vehicle.
        request: The part with the values of its settings.
        network: Data of the network. One object is shared by all readers of the simulator, in all episodes.
        step_length_s: Length of a step, in s.
        start_m: The vehicle's odometer (`vehicle.getDistance`) at the start of the episode, in m.
        start_s: Simulation time at the start of the episode, in s.
        steering: Function that returns the steering angle of the vehicle, in rad, positive to the left; None if the
            vehicle's actions contain no steering angle, so that the angle follows from the yaw rate.
    """

    agent: str
    request: RequestedPart
    network: RoadNetwork
    step_length_s: float
    start_m: float
    start_s: float
    steering: Callable[[], float] | None = None

    @property
    def settings(self) -> Mapping[str, float]:
        """The value of every setting of the part."""
        return self.request.settings

    @property
    def limit(self) -> int:
        """The number of rows of a part with one row per actor."""
        return int(self.request.settings["rows"])

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the part."""
        return self.request.shape


@dataclass(slots=True)
class Moment:
    """The state after a step, as seen by one agent. All readers of the agent receive the same object in a step.

    Args:
        scene: The scene.
        row: The row of the agent's vehicle in the scene.
        lane: The vehicle's lane, such as ``E0_1``; the last lane if the vehicle is off every lane.
        hidden: Identifiers of the actors that the agent does not see, as in scenes.
    """

    scene: Scene
    row: int
    lane: str
    hidden: frozenset[str]


class Reader(Protocol):
    """Reads one part of an agent's observation. A reader may keep state from step to step of one episode."""

    def __init__(self, setup: ReaderSetup, /) -> None: ...

    def observe(self, moment: Moment, /) -> NDArray[np.generic]:
        """Return the part after the last step, as a new array; crashhunt calls this method once per step, from step 0.

        The array has the shape and the data type of the part. The method changes nothing in the simulation.
        """
