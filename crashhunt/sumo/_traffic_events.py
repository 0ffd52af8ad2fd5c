"""Detects traffic events around the controlled vehicles on SUMO.

A step costs a few microseconds. Expensive checks run only after a cheap check has found a change, such as a new lane of
a controlled vehicle or a strong deceleration of any vehicle.
"""

from __future__ import annotations

import math
from operator import sub
from types import MappingProxyType
from typing import TYPE_CHECKING

from libsumo import _libsumo as sumo

from crashhunt.simulators import Standstill
from crashhunt.world import Event, is_person, outline_gap, outlines

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence

    from crashhunt.world import Actor, Scene


# Vehicles that brake hard because of a controlled vehicle ahead.

_MIN_CHECKED_DECELERATION_MPS2 = 2.0  # weaker braking is never an event, whatever the limit
_TOLERANCE_MPS2 = 0.01
_MAX_LEADER_GAP_M = 100.0


class HardBraking:
    """Detects vehicles that brake hard because of a controlled vehicle in their path.

    SUMO computes a step from the state at its beginning, so the controlled vehicle must have been ahead then. Either
    the braking vehicle was its follower, or it braked hard because of the same controlled vehicle in the step before.

    Args:
        step_length_s: Step length of the simulation, in s.
        limit: The deceleration that counts as hard, in m/s²; None for the ``decel`` of the braking vehicle's type.
    """

    def __init__(self, step_length_s: float, limit: float | None) -> None:
        self._dt = step_length_s
        self._limit = limit

    def begin(self, agents: Sequence[str], controlled: Mapping[str, object]) -> None:
        """Reset the state of the last episode."""
        self._controlled = controlled
        self._limits: dict[str, float] = {}
        self._followers = {agent: sumo.vehicle_getFollower(agent)[0] for agent in agents}
        self._wary: dict[str, str] = {}  # vehicles that braked hard in the last step: the controlled vehicle ahead
        self._reported: set[str] = set()  # vehicles whose current braking is already an event
        self.lately: dict[str, tuple[str, float]] = {}  # vehicles that braked hard: the agent ahead, last time in s

    @property
    def followers(self) -> dict[str, str]:
        """The vehicle behind each controlled vehicle after the last step; empty if there is none."""
        return self._followers

    @property
    def counted(self) -> tuple[dict[str, float], float]:
        """The limits in m/s²: by vehicle, and for all vehicles (0 if there is none); used by the compiled core."""
        return self._limits, self._limit or 0.0

    @property
    def is_quiet(self) -> bool:
        """Whether no vehicle braked hard in the last step."""
        return not self._wary

    def resume(self, followers: dict[str, str]) -> None:
        """Resume after uneventful steps, in which no vehicle braked hard."""
        self._followers = followers

    def look(
        self, last: Scene, scene: Scene, agents: Sequence[str], lanes: Mapping[str, str]
    ) -> list[tuple[str, str, str]]:
        """Return each agent for which a vehicle began to brake hard between two scenes, that vehicle, and a text."""
        hard = self._braking_hard(last, scene)
        found = self._because_of_agents(hard, scene, lanes) if hard or self._wary else []
        index = scene.roster.index
        self._followers = {agent: sumo.vehicle_getFollower(agent)[0] for agent in agents if agent in index}
        return found

    def _because_of_agents(
        self, hard: list[tuple[str, float]], scene: Scene, lanes: Mapping[str, str]
    ) -> list[tuple[str, str, str]]:
        found = []
        braking: set[str] = set()
        wary: dict[str, str] = {}
        for vehicle, deceleration in hard:
            agent, where = self._ahead_of(vehicle, lanes)
            if not agent:
                continue
            wary[vehicle] = agent
            if self._followers[agent] != vehicle and self._wary.get(vehicle) != agent:
                continue
            braking.add(vehicle)
            self.lately[vehicle] = (agent, scene.time_s)
            if vehicle not in self._reported:
                what = f"{vehicle} braked at {deceleration:.1f} m/s² with {agent} {where}"
                found.append((agent, vehicle, what))
        self._wary, self._reported = wary, braking
        return found

    def _ahead_of(self, vehicle: str, lanes: Mapping[str, str]) -> tuple[str, str]:
        """Return the agent's vehicle to which a vehicle must react, and its place; empty for any other vehicle."""
        leader = sumo.vehicle_getLeader(vehicle, _MAX_LEADER_GAP_M)
        if leader is not None and leader[0]:
            return (leader[0], "ahead of it") if leader[0] in self._followers else ("", "")
        crossing = sumo.vehicle_getLaneID(vehicle)
        if not crossing.startswith(":"):
            links = sumo.vehicle_getNextLinks(vehicle)
            crossing = links[0][4] if links else ""
        foes = sumo.lane_getInternalFoes(crossing) if crossing else ()
        for agent in self._followers:
            if lanes.get(agent) in foes:
                return agent, "across its way"
        return "", ""

    def _braking_hard(self, last: Scene, scene: Scene) -> list[tuple[str, float]]:
        """Return the vehicles that braked harder than their limit in the last step, and their decelerations in m/s²."""
        rows: Iterable[tuple[Actor, float, float]]
        if scene.roster is last.roster:
            least = None
            if scene.core is not None and scene.columns is not None and last.columns is not None:
                least = scene.core.least_change(last.columns, scene.columns)
            if least is None:
                least = min(map(sub, scene.speeds, last.speeds), default=0.0)
            if least > -_MIN_CHECKED_DECELERATION_MPS2 * self._dt:
                return []
            rows = zip(scene.roster.actors, last.speeds, scene.speeds, strict=True)
        else:
            index = last.roster.index
            rows = [
                (actor, last.speeds[index[actor.id]], speed)
                for actor, speed in zip(scene.roster.actors, scene.speeds, strict=True)
                if actor.id in index
            ]
        found = []
        for actor, was, now in rows:
            deceleration = (was - now) / self._dt
            if deceleration < _MIN_CHECKED_DECELERATION_MPS2 or actor.id in self._controlled or is_person(actor.id):
                continue
            limit = self._limits.get(actor.id)
            if limit is None:
                limit = self._limits[actor.id] = self._limit or sumo.vehicle_getDecel(actor.id)
            if deceleration > limit + _TOLERANCE_MPS2:
                found.append((actor.id, deceleration))
        return found


_RED_STATES = ("r", "u")  # red, and red with yellow; vehicles may pass "s" after a stop
_STOP_STATES = ("s", "w")  # of links behind a stop sign: of one road, or of all roads of the junction
_STOP_M = 5.0  # a vehicle that stands within this distance before the line has stopped there
_MAX_LINKS_PER_STEP = 6  # most links that a vehicle can cross in one long step
_DIRECTION_INTERVAL_STEPS = 10  # steps between two checks of the driving direction on the same lane
_WRONG_WAY_COSINE = -0.5  # cosine of the angle between course and lane below which a vehicle drives the wrong way
_NEAR_M = 150.0  # events further from every agent are not reported
_LINE_TOLERANCE_M = 1.0  # of the place where a vehicle that moves freely has crossed a stop line
_CONSEQUENCE_S = 5.0  # a collision within this time after hard braking may be its consequence


class SumoEvents:
    """Detects the traffic events of one episode after another.

    Args:
        step_length_s: Step length of the simulation, in s.
        limits: Limits that differ from the default: of a standstill (in s) and of hard braking (in m/s²).
    """

    def __init__(self, step_length_s: float, limits: Mapping[str, float]) -> None:
        self._dt = step_length_s
        self._braking = HardBraking(step_length_s, limits.get("hard_braking"))
        self._standstill = Standstill(step_length_s, limits)

    def begin(
        self,
        scene: Scene,
        agents: Sequence[str],
        controlled: Mapping[str, object],
        routes: Mapping[str, Collection[str]] = MappingProxyType({}),
    ) -> None:
        """Reset the state of the last episode.

        ``routes`` has the edges of the route of each vehicle that can leave it, because it moves freely.
        """
        self._controlled, self._routes = controlled, routes
        self._astray: set[str] = set()
        self._last = scene
        self._lanes = dict(scene.agent_lanes)
        self._steps = 0
        self._braking.begin(agents, controlled)
        self._wrong: set[str] = set()
        self._stuck: set[tuple[str, str]] = set()
        self._stops: dict[str, bool] = {}  # agents before a stop sign, and whether they have stopped there
        for agent, lane in self._lanes.items():
            self._watch_stop(agent, "", lane)
        self._standstill.begin()

    @property
    def controlled(self) -> dict[str, object]:
        """All controlled vehicles, by identifier."""
        return dict(self._controlled)

    @property
    def followers(self) -> dict[str, str]:
        """The vehicle behind each agent; empty if there is none."""
        return self._braking.followers

    @property
    def counted(self) -> tuple[dict[str, float], float, dict[str, int], int]:
        """The counters of `HardBraking` and `Standstill`, used by the compiled core."""
        return *self._braking.counted, *self._standstill.counted

    def is_quiet(self, agent: str) -> bool:
        """Whether no event of the agent is in progress, so that the core may run the next step."""
        return self._braking.is_quiet and agent not in self._wrong and agent not in self._stops

    def resume(self, scene: Scene, steps: int, followers: dict[str, str]) -> None:
        """Resume after uneventful steps: set the scene, the number of steps, and the agents' followers."""
        self._last, self._steps = scene, steps
        self._braking.resume(followers)

    def look(self, scene: Scene, agents: Sequence[str]) -> tuple[Event, ...]:
        """Return the events of the step that led to this scene."""
        self._steps += 1
        last, found = self._last, list[Event]()
        for agent in agents:
            lane = scene.agent_lanes.get(agent)
            if lane is None:
                continue
            before = self._lanes.get(agent, lane)
            if lane != before:
                self._lanes[agent] = lane
                self._entered(agent, before, lane, scene, found)
                self._watch_stop(agent, before, lane)
            if lane != before or self._steps % _DIRECTION_INTERVAL_STEPS == 0:
                self._ask_direction(agent, lane, last, scene, found)
            row = scene.roster.index[agent]
            speed = scene.speed(row)
            if speed < Standstill.SPEED and self._stops.get(agent) is False:
                self._stops[agent] = sumo.lane_getLength(lane) - sumo.vehicle_getLanePosition(agent) <= _STOP_M
            if speed < Standstill.SPEED and sumo.vehicle_getStopState(agent) & 1:
                self._standstill.move(agent)  # at a planned stop
            elif stood := self._standstill.look(agent, speed):
                found.append(self._of(scene, agent, "not_moving", f"{agent} had stood still for {stood:g} s"))
        if sumo.simulation_getEmergencyStoppingVehiclesNumber():
            self._at_dead_ends(scene, agents, found)
        if scene.contacts:
            self._others_collided(scene, agents, found)
        if sumo.simulation_getStartingTeleportNumber():
            self._teleports(last, scene, agents, found)
        for agent, vehicle, what in self._braking.look(last, scene, agents, self._lanes):
            found.append(self._of(scene, agent, "hard_braking", what, (vehicle,)))
        self._last = scene
        return tuple(found)

    def of_agent(self, scene: Scene, agent: str, kind: str, what: str) -> Event:
        """Return an event of an agent that moves freely, such as ``drove into the building 'b'``."""
        return self._of(scene, agent, kind, f"{agent} {what}")

    def _of(self, scene: Scene, agent: str, kind: str, what: str, others: tuple[str, ...] = ()) -> Event:
        row = scene.roster.index.get(agent)
        if row is None:
            return Event(kind=kind, agent=agent, what=what, others=others)
        x, y = scene.points[row]
        return Event(
            kind=kind,
            agent=agent,
            what=what,
            others=others,
            lane=scene.agent_lanes.get(agent) or self._lanes.get(agent, ""),
            x=x,
            y=y,
            speed=scene.speeds[row],
        )

    def _entered(self, agent: str, before: str, lane: str, scene: Scene, found: list[Event]) -> None:
        """Add an event if a controlled vehicle that entered a new lane ran a red light or a stop sign."""
        left, edge = before.rpartition("_")[0], lane.rpartition("_")[0]
        if left == edge:
            return  # the vehicle has changed lanes
        if agent in sumo.simulation_getStartingTeleportIDList() or agent in sumo.simulation_getEndingTeleportIDList():
            return
        if agent in self._routes and not self._is_behind_line(agent, before, scene):
            return  # it has crossed over to a lane that a turnaround connects with its last lane
        ways = _ways_between(before, edge)
        if ways and all(any(state in _RED_STATES for state in states) for states in ways):
            speed = scene.speeds[scene.roster.index[agent]]
            what = f"{agent} ran a red light at {speed:.1f} m/s, coming from lane {before}"
            found.append(self._of(scene, agent, "red_light", what))
        elif self._stops.get(agent) is False and ways and all(states[0] in _STOP_STATES for states in ways):
            speed = scene.speeds[scene.roster.index[agent]]
            what = f"{agent} ran a stop sign at {speed:.1f} m/s, coming from lane {before}"
            found.append(self._of(scene, agent, "stop_sign", what))

    def _is_behind_line(self, agent: str, before: str, scene: Scene) -> bool:
        """Return whether an agent is as near to the end of its last lane as after a step across the stop line."""
        row = scene.roster.index[agent]
        away = math.dist(scene.points[row], sumo.lane_getShape(before)[-1][:2])
        most = scene.speeds[row] * self._dt + float(sumo.lane_getWidth(before)) / 2 + _LINE_TOLERANCE_M
        return away <= most

    def _watch_stop(self, agent: str, before: str, lane: str) -> None:
        """Note whether a stop sign stands at the end of an agent's new lane."""
        stopped = self._stops.pop(agent, False) and before.rpartition("_")[0] == lane.rpartition("_")[0]
        if not lane.startswith(":") and any(link[5] in _STOP_STATES for link in sumo.lane_getLinks(lane)):
            self._stops[agent] = stopped

    def _ask_direction(self, agent: str, lane: str, last: Scene, scene: Scene, found: list[Event]) -> None:
        """Add an event if the agent drives against the direction of its lane."""
        row, earlier = scene.roster.index[agent], last.roster.index.get(agent)
        if earlier is None or lane.startswith(":") or sumo.vehicle_getLaneIndex(agent) < 0:
            return
        (x, y), (was_x, was_y) = scene.points[row], last.points[earlier]
        driven = math.hypot(x - was_x, y - was_y)
        if driven < Standstill.SPEED * self._dt:
            return
        # Use the course, because the heading of a long vehicle turns late. SUMO's angles are clockwise from north.
        angle = math.radians(sumo.lane_getAngle(lane, sumo.vehicle_getLanePosition(agent)))
        along = ((x - was_x) * math.sin(angle) + (y - was_y) * math.cos(angle)) / driven
        if along >= _WRONG_WAY_COSINE:
            self._wrong.discard(agent)
            self._ask_route(agent, lane, scene, found)
        elif agent not in self._wrong:
            self._wrong.add(agent)
            found.append(self._of(scene, agent, "wrong_way", f"{agent} drove the wrong way on lane {lane}"))

    def _ask_route(self, agent: str, lane: str, scene: Scene, found: list[Event]) -> None:
        """Add an event if the agent drives along a lane of a road that its route does not contain."""
        if lane.rpartition("_")[0] in self._routes.get(agent, (lane.rpartition("_")[0],)):
            self._astray.discard(agent)
        elif agent not in self._astray:
            self._astray.add(agent)
            found.append(self._of(scene, agent, "off_route", f"{agent} left its route: it drives on lane {lane}"))

    def _at_dead_ends(self, scene: Scene, agents: Sequence[str], found: list[Event]) -> None:
        """Add an event for agents that SUMO stops at the end of a lane.

        Either the lane does not lead along their route, or they have passed a scheduled stop, or are in another lane.
        """
        for agent in set(sumo.simulation_getEmergencyStoppingVehiclesIDList()).intersection(agents):
            lane = scene.agent_lanes.get(agent, "")
            if not lane or lane.startswith(":") or (agent, lane) in self._stuck:
                continue
            route, place = sumo.vehicle_getRoute(agent), sumo.vehicle_getRouteIndex(agent)
            ahead = {link[0].rpartition("_")[0] for link in sumo.lane_getLinks(lane)}
            if 0 <= place < len(route) - 1 and route[place + 1] not in ahead:
                self._stuck.add((agent, lane))
                what = f"{agent} missed its route: it is at the end of lane {lane}, which does not lead there"
                found.append(self._of(scene, agent, "off_route", what))
            elif missed := _missed_stop(agent, lane):
                self._stuck.add((agent, lane))
                what = f"{agent} missed its scheduled stop {missed}: SUMO stopped it at the end of lane {lane}"
                found.append(self._of(scene, agent, "stop_missed", what))

    def _others_collided(self, scene: Scene, agents: Sequence[str], found: list[Event]) -> None:
        index = scene.roster.index
        for contact in scene.contacts:
            pair = (contact.collider, contact.victim)
            if not contact.victim or not self._controlled.keys().isdisjoint(pair) or not index.keys() >= set(pair):
                continue
            near = min(
                ((_gap(scene, agent, other), agent) for agent in agents if agent in index for other in pair),
                default=None,
            )
            if near is None or near[0] > _NEAR_M:
                continue
            distance, agent = near
            what = f"{pair[0]} drove into {pair[1]}, {distance:.0f} m from {agent}"
            for other in pair:
                follower_of, when = self._braking.lately.get(other, ("", -math.inf))
                if scene.time_s - when <= _CONSEQUENCE_S:
                    what += f"; {other} had braked hard {scene.time_s - when:.1f} s before, with {follower_of} ahead"
            found.append(self._of(scene, agent, "others_collided", what, pair))

    def _teleports(self, last: Scene, scene: Scene, agents: Sequence[str], found: list[Event]) -> None:
        """Add events for vehicles that SUMO began to teleport, which the new scene no longer contains."""
        for vehicle in sumo.simulation_getStartingTeleportIDList():
            if vehicle in agents:
                found.append(self._of(last, vehicle, "teleport", f"SUMO teleported {vehicle}"))
                continue
            near = min(
                (
                    (_gap(last, agent, vehicle), agent)
                    for agent in agents
                    if agent in last.roster.index and vehicle in last.roster.index
                ),
                default=None,
            )
            if near is not None and near[0] <= _NEAR_M:
                what = f"SUMO teleported {vehicle}, {near[0]:.0f} m from {near[1]}"
                found.append(self._of(scene, near[1], "teleport", what, (vehicle,)))


def _missed_stop(agent: str, lane: str) -> str:
    """Return the place of the scheduled stop that a vehicle at the end of a lane has missed; empty if there is none."""
    for stop in sumo.vehicle_getStops(agent, 1):
        edge = lane.rpartition("_")[0]
        is_here = stop.lane.rpartition("_")[0] == edge and stop.speed <= 0
        if is_here and (stop.lane != lane or sumo.vehicle_getLanePosition(agent) > stop.endPos):
            name = f"at {stop.stoppingPlaceID}, " if stop.stoppingPlaceID else "on "
            return f"{name}lane {stop.lane}, {stop.startPos:.0f}-{stop.endPos:.0f} m"
    return ""


def _ways_between(lane: str, edge: str) -> list[tuple[str, ...]]:
    """Return the signal states of the links on each shortest way by which a vehicle can get from a lane to an edge.

    In a long step a vehicle passes several links, and each of them may have a signal. Links inside a junction are not
    returned, because the signal stands where a vehicle enters the junction.
    """
    ways: list[tuple[str, tuple[str, ...]]] = [(lane, ())]
    for _ in range(_MAX_LINKS_PER_STEP):  # shortest way first, because a vehicle cannot drive a detour in one step
        further = []
        for place, states in ways:
            for link in sumo.lane_getLinks(place):
                following = link[4] or link[0]
                further.append((following, states if place.startswith(":") else (*states, link[5])))
        found = [states for following, states in further if following.rpartition("_")[0] == edge]
        if found:
            return found
        ways = further
    return []


def _gap(scene: Scene, one: str, two: str) -> float:
    """Return the distance between the outlines of two actors, seen from above, in m."""
    mine, theirs = (outlines(scene, scene.roster.index[name]) for name in (one, two))
    return min(outline_gap(own, other) for own in mine for other in theirs)
