"""Brings the controlled vehicles onto the road: warm-up, insertion of new vehicles, and ego replacement."""

from __future__ import annotations

from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

import libsumo
from libsumo import _libsumo as sumo

from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.trial import ALL_AGENTS
from crashhunt.world import PERSON

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from crashhunt.scenario import AgentSetup, Scenario
    from crashhunt.simulators import CountsSetUp
    from crashhunt.trial import Value


def replaced_by(agents: Mapping[str, AgentSetup], arguments: Mapping[str, Value]) -> dict[str, str]:
    """Return the vehicles of the traffic that agents replace, each with its agent.

    Raises:
        InvalidEpisodeError: Two agents replace the same vehicle.
    """
    found: dict[str, str] = {}
    for agent, setup in agents.items():
        if not setup.replaces:
            continue
        vehicle = str(arguments.get(setup.replaces, ""))
        if vehicle in found:
            raise InvalidEpisodeError(
                f"{found[vehicle]} and {agent} both replace the vehicle {vehicle!r}",
                fix=f"give {found[vehicle]} and {agent} different vehicles to replace",
            )
        found[vehicle] = agent
    return found


@contextmanager
def steps_counted(simulator: CountsSetUp, step_length_s: float) -> Iterator[None]:
    """Return a context that counts the steps simulated inside it, even if an exception ends the context."""
    began = libsumo.simulation.getTime()
    try:
        yield
    finally:
        with suppress(libsumo.TraCIException, libsumo.FatalTraCIError):  # the simulation may have ended
            simulator.setup_steps = round((libsumo.simulation.getTime() - began) / step_length_s)


def enter(
    scenario: Scenario, setups: Mapping[str, AgentSetup], replaced: Mapping[str, str], taking_part: VehicleFilter | None
) -> None:
    """Warm up the traffic, add missing vehicles of agents, and wait until all agents' vehicles are on the road.

    ``replaced`` has the vehicles of the traffic that are replaced, each with its agent. Without a filter, all actors
    take part.

    Raises:
        InvalidEpisodeError: A controlled vehicle did not enter in time, or had already left the simulation.
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
            fix="let all vehicles enter within a shorter time",
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
                raise InvalidEpisodeError(f"there is no route from {setup.edges[0]!r} to {setup.edges[1]!r}")
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
    """Replace a vehicle of the traffic by an agent's vehicle with the same position, speed, type and route."""
    route, kind = f"crashhunt.{agent}", libsumo.vehicle.getTypeID(vehicle)
    lane, place = libsumo.vehicle.getLaneIndex(vehicle), libsumo.vehicle.getLanePosition(vehicle)
    if lane < 0:
        raise InvalidEpisodeError(
            f"the vehicle {vehicle!r} enters parked next to the road, so no vehicle can take its place",
            fix="choose a vehicle that enters on a lane",
        )
    speed = libsumo.vehicle.getSpeed(vehicle)
    # A vehicle with a departEdge begins in the middle of its route, so use the rest of the route.
    libsumo.route.add(route, libsumo.vehicle.getRoute(vehicle)[libsumo.vehicle.getRouteIndex(vehicle) :])
    libsumo.vehicle.remove(vehicle)
    libsumo.vehicle.add(
        agent, route, kind, departLane=str(lane), departPos=repr(place), departSpeed=repr(speed), depart="now"
    )


# Vehicles and persons that are excluded from an episode.


class VehicleFilter:
    """Removes excluded actors at the end of the step in which they enter, before a scene contains them.

    SUMO creates the vehicles of a flow one after another, so their names are known only when they enter. SUMO removes a
    person in the next step, so scenes hide the person until then.

    Args:
        takes_part: Identifiers of the actors that stay, as in scenes.
        leaving: Collection to which the SUMO ids of removed persons are added, because scenes must hide them.
    """

    def __init__(self, takes_part: Iterable[str], leaving: set[str]) -> None:
        self._takes_part = frozenset(takes_part)
        self._all_take_part = ALL_AGENTS in self._takes_part
        self._leaving = leaving
        self.entered: list[str] = []  # identifiers of all actors that have entered, in order

    def remove(self) -> None:
        """Remove the excluded actors that entered in the last step."""
        for vehicle in libsumo.simulation.getDepartedIDList():
            self.entered.append(vehicle)
            if not self._all_take_part and vehicle not in self._takes_part:
                libsumo.vehicle.remove(vehicle)
        for person in libsumo.simulation.getDepartedPersonIDList():
            name = PERSON + person
            self.entered.append(name)
            if not self._all_take_part and name not in self._takes_part:
                libsumo.person.removeStages(person)
                self._leaving.add(person)

    def warm_up(self, until_s: float) -> None:
        """Simulate step by step until a simulation time, in s."""
        while libsumo.simulation.getTime() < until_s:
            libsumo.simulationStep()
            self.remove()
