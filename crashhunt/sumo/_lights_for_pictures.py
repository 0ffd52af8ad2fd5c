"""Reads traffic lights, the lights of vehicles and the routes of agents, for the picture of a crash."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from libsumo import _libsumo as sumo

from crashhunt.simulators import Lights
from crashhunt.sumo._ego_and_actors import lights_of
from crashhunt.sumo._observing import ObservedParts
from crashhunt.sumo._reader_protocol import AgentMoment
from crashhunt.sumo._signal_readers import SIGNAL_STATES

if TYPE_CHECKING:
    from collections.abc import Mapping

    from crashhunt.scenario import Scenario
    from crashhunt.world import Scene

_ROUTE = "route:points=24:spacing=5"  # as far as a picture shows
_PARTS = ("route_state", "signals", "stop_line")
_COLOURS, _OFF = "gyro", 3  # by the state of the part ``signals``


class LightReader:
    """Reads lights and routes in an episode; ``starts`` are the odometers of agents' vehicles at its start, in m."""

    def __init__(self, scenario: Scenario, starts: Mapping[str, float]) -> None:
        agents = {name: replace(setup, observation=(_ROUTE, *_PARTS)) for name, setup in scenario.agents.items()}
        self._parts = ObservedParts(replace(scenario, agents=agents))
        self._parts.begin(starts, sumo.simulation_getTime())
        graph, known = self._parts.graph, set(sumo.trafficlight_getIDList())
        self._signals = [
            (line.lane, line.signal, sorted({link.signal_index for link in graph.lanes[line.lane].links}))
            for line in graph.stop_lines
            if line.signal in known
        ]

    def read(self, scene: Scene, lanes: Mapping[str, str]) -> Lights:
        """Return the lights and routes of a scene."""
        states = {
            light: sumo.trafficlight_getRedYellowGreenState(light) for light in {one for _, one, _ in self._signals}
        }
        present = set(sumo.vehicle_getIDList())
        parts: dict[str, dict[str, list[dict[str, float]]]] = {}
        routes = {}
        for agent, lane in lanes.items():
            row = scene.roster.index.get(agent)
            if row is None or agent not in present:
                continue
            found = self._parts.read(agent, AgentMoment(scene=scene, row=row, lane=lane, hidden=frozenset()))
            columns = self._parts.layouts[agent].columns
            rows = {
                name: [
                    dict(zip(columns[name], line, strict=True))
                    for line in found[name].reshape(-1, len(columns[name])).tolist()
                    if any(line)
                ]
                for name in found
            }
            routes[agent] = [(point["x"], point["y"]) for point in rows.pop("route")]
            parts[agent] = rows
        return Lights(
            signals={
                lane: "".join(
                    dict.fromkeys(_COLOURS[int(SIGNAL_STATES.get(states[light][one], _OFF))] for one in places)
                )
                for lane, light, places in self._signals
            },
            vehicles={actor.id: lights_of(actor.id) for actor in scene.roster.actors if actor.id in present},
            parts=parts,
            routes=routes,
        )
