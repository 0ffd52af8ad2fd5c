"""How controlled vehicles get onto the road: after the warm-up, added, taken over, or in the place of another."""

from __future__ import annotations

from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

import libsumo
from libsumo import _libsumo as sumo

from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.trial import EVERYBODY
from crashhunt.world import PERSON

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from crashhunt.scenario import AgentSetup, Scenario
    from crashhunt.simulators import CountsSetUp
    from crashhunt.trial import Value


__all__ = ["TakingPart", "enter", "replaced_by", "steps_counted"]


def replaced_by(agents: Mapping[str, AgentSetup], arguments: Mapping[str, Value]) -> dict[str, str]:
    """Return the vehicles of the traffic whose places are taken, each with the agent that takes it.

    Raises:
        InvalidEpisodeError: two agents would take the same place.
    """
    found: dict[str, str] = {}
    for agent, setup in agents.items():
        if not setup.replaces:
            continue
        vehicle = str(arguments.get(setup.replaces, ""))
        if vehicle in found:
            raise InvalidEpisodeError(
                f"{found[vehicle]} and {agent} both take the place of the vehicle {vehicle!r}",
                fix="let them draw from different vehicles",
            )
        found[vehicle] = agent
    return found


@contextmanager
def steps_counted(simulator: CountsSetUp, step_length_s: float) -> Iterator[None]:
    """Count the steps that are simulated meanwhile, whatever becomes of them."""
    began = libsumo.simulation.getTime()
    try:
        yield
    finally:
        with suppress(libsumo.TraCIException, libsumo.FatalTraCIError):  # of a simulation that has ended
            simulator.setup_steps = round((libsumo.simulation.getTime() - began) / step_length_s)


def enter(
    scenario: Scenario, setups: Mapping[str, AgentSetup], replaced: Mapping[str, str], taking_part: TakingPart | None
) -> None:
    """Warm up, add the vehicles that are not part of the traffic, and wait until all are on the road.

    Args:
        scenario: how long it warms up, and how long is waited.
        setups: of the agents that drive.
        replaced: vehicles of the traffic to the agents that take their places.
        taking_part: who of the traffic takes part; None where all do.

    Raises:
        InvalidEpisodeError: one of them did not enter in time, or had left again.
    """
    begin = libsumo.simulation.getTime()
    if scenario.warmup_s > 0:
        if taking_part is not None:
            taking_part.warm_up(begin + scenario.warmup_s)
        else:
            libsumo.simulationStep(begin + scenario.warmup_s)
        if early := replaced.keys() & set(sumo.vehicle_getIDList()):
            raise InvalidEpisodeError(
                f"the vehicle {min(early)!r} had departed in the warm-up already",
                fix="lower warmup_s, or choose a vehicle that departs later",
            )
    for agent, setup in setups.items():
        if not setup.existing and not setup.replaces:
            _add(agent, setup)
    waiting = set(setups) - set(sumo.vehicle_getIDList())
    latest = max((setup.depart_s or 0.0 for setup in setups.values()), default=0.0)
    deadline = max(libsumo.simulation.getTime(), latest) + scenario.insertion_timeout_s
    while waiting:
        if libsumo.simulation.getTime() >= deadline:
            name = min(waiting)
            name = next((vehicle for vehicle, agent in replaced.items() if agent == name), name)
            raise InvalidEpisodeError(
                f"the vehicle {name!r} was not on the road {scenario.insertion_timeout_s:g} s after "
                "it should have entered",
                fix="raise insertion_timeout_s, lower the demand, or choose another vehicle, lane or position",
            )
        libsumo.simulationStep()
        if taking_part is not None:
            taking_part.remove()
        departed = set(libsumo.simulation.getDepartedIDList())
        waiting -= departed
        for vehicle in sorted(departed & replaced.keys()):
            _replace(vehicle, replaced[vehicle])
    gone = set(setups) - set(sumo.vehicle_getIDList())
    if gone:
        raise InvalidEpisodeError(
            f"the vehicle {min(gone)!r} had left again before all controlled vehicles were on the road",
            fix="let them enter closer together",
        )
    for agent, setup in setups.items():
        sumo.vehicle_setSpeedMode(agent, setup.speed_mode)
        sumo.vehicle_setLaneChangeMode(agent, 0)


def _add(agent: str, setup: AgentSetup) -> None:
    route = setup.route
    if not route:
        edges = list(setup.edges)
        if len(edges) == 2:
            edges = list(libsumo.simulation.findRoute(edges[0], edges[1], setup.type).edges)
            if not edges:
                raise InvalidEpisodeError(f"there is no way from {setup.edges[0]!r} to {setup.edges[1]!r}")
        route = f"crashhunt.{agent}"
        libsumo.route.add(route, edges)
    depart = "now" if setup.depart_s is None else str(max(setup.depart_s, libsumo.simulation.getTime()))
    libsumo.vehicle.add(
        agent,
        route,
        setup.type,
        depart=depart,
        departLane=setup.depart_lane,
        departPos=setup.depart_pos,
        departSpeed=setup.depart_speed,
    )


def _replace(vehicle: str, agent: str) -> None:
    """Let an agent drive on from where a vehicle of the traffic is, from the next step on."""
    route, kind = f"crashhunt.{agent}", libsumo.vehicle.getTypeID(vehicle)
    lane, place = libsumo.vehicle.getLaneIndex(vehicle), libsumo.vehicle.getLanePosition(vehicle)
    speed = libsumo.vehicle.getSpeed(vehicle)
    # One with a departEdge begins somewhere on its route.
    libsumo.route.add(route, libsumo.vehicle.getRoute(vehicle)[libsumo.vehicle.getRouteIndex(vehicle) :])
    libsumo.vehicle.remove(vehicle)
    libsumo.vehicle.add(
        agent, route, kind, departLane=str(lane), departPos=repr(place), departSpeed=repr(speed), depart="now"
    )


# Vehicles and persons that do not take part in an episode, though the scenario has them.


class TakingPart:
    """Takes vehicles off the road at the end of the step in which they enter, before anybody has seen them.

    Only then are they known by name: those of a flow are made one after another as time goes on. A person leaves with
    the next step, and is not to be seen until then.

    Args:
        takes_part: the names of those that stay, as in scenes.
        leaving: the ids of persons who are not to be seen any more are put in here.

    Attributes:
        entered: the names of all that have entered, in their order.
    """

    def __init__(self, takes_part: Iterable[str], leaving: set[str]) -> None:
        self._takes_part = frozenset(takes_part)
        self._everybody = EVERYBODY in self._takes_part
        self._leaving = leaving
        self.entered: list[str] = []

    def remove(self) -> None:
        """Remove those that have entered in the last step."""
        for vehicle in libsumo.simulation.getDepartedIDList():
            self.entered.append(vehicle)
            if not self._everybody and vehicle not in self._takes_part:
                libsumo.vehicle.remove(vehicle)
        for person in libsumo.simulation.getDepartedPersonIDList():
            name = PERSON + person
            self.entered.append(name)
            if not self._everybody and name not in self._takes_part:
                libsumo.person.removeStages(person)
                self._leaving.add(person)

    def warm_up(self, until_s: float) -> None:
        """Simulate up to a time, in s, step by step."""
        while libsumo.simulation.getTime() < until_s:
            libsumo.simulationStep()
            self.remove()
