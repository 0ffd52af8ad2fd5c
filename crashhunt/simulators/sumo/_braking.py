"""Others on SUMO that brake hard with a controlled vehicle ahead of them."""

from __future__ import annotations

from operator import sub
from typing import TYPE_CHECKING

from libsumo import _libsumo as sumo

from crashhunt.world import is_person

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from crashhunt.world import Actor, Scene

__all__ = ["HardBraking"]

_LOOKED_INTO = 2.0  # m/s²; a weaker braking is nobody's limit
_TOLERANCE = 0.01  # m/s²
_LEADER_M = 100.0  # nobody brakes hard for who is further ahead


class HardBraking:
    """Looks at one episode after another.

    SUMO decides a step by who was ahead at its beginning. So it must have been the controlled vehicle then: the braking
    one was its follower, or had to heed it when it braked hard in the step before as well.

    Args:
        step_length_s: of the simulation.
        limit: what counts, in m/s²; None for what the braking vehicle's type calls comfortable.
    """

    def __init__(self, step_length_s: float, limit: float | None) -> None:
        self._dt = step_length_s
        self._limit = limit

    def begin(self, agents: Sequence[str], controlled: Mapping[str, object]) -> None:
        """Forget the last episode.

        Args:
            agents: those that act.
            controlled: all vehicles that are driven from outside.
        """
        self._controlled = controlled
        self._limits: dict[str, float] = {}
        self._followers = {agent: sumo.vehicle_getFollower(agent)[0] for agent in agents}
        self._wary: dict[str, str] = {}  # who braked hard in the last step, with which controlled vehicle ahead
        self._told: set[str] = set()  # those of them that have been told
        self.lately: dict[str, tuple[str, float]] = {}  # who has braked hard for whom, and when last, in s

    @property
    def followers(self) -> dict[str, str]:
        """Who is behind each controlled vehicle after the last step; empty where nobody is."""
        return self._followers

    @property
    def counted(self) -> tuple[dict[str, float], float]:
        """For the core: what counts as hard, by vehicle, and for all of them or 0, in m/s²."""
        return self._limits, self._limit or 0.0

    @property
    def is_quiet(self) -> bool:
        """Whether nobody braked hard in the last step."""
        return not self._wary

    def go_on(self, followers: dict[str, str]) -> None:
        """Go on from a step since which nobody has braked hard."""
        self._followers = followers

    def look(
        self, last: Scene, scene: Scene, agents: Sequence[str], lanes: Mapping[str, str]
    ) -> list[tuple[str, str, str]]:
        """Return who began to brake hard between two scenes: the controlled vehicle, the other one, what it did."""
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
            if vehicle not in self._told:
                what = f"{vehicle} braked at {deceleration:.1f} m/s² with {agent} {where}"
                found.append((agent, vehicle, what))
        self._wary, self._told = wary, braking
        return found

    def _ahead_of(self, vehicle: str, lanes: Mapping[str, str]) -> tuple[str, str]:
        """Which controlled vehicle one has to heed, and where that is; empty where there is none or somebody else."""
        leader = sumo.vehicle_getLeader(vehicle, _LEADER_M)
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
        """Who braked harder than its limit in the last step, and how hard in m/s²."""
        rows: Iterable[tuple[Actor, float, float]]
        if scene.roster is last.roster:
            least = None
            if scene.core is not None and scene.columns is not None and last.columns is not None:
                least = scene.core.least_change(last.columns, scene.columns)
            if least is None:
                least = min(map(sub, scene.speeds, last.speeds), default=0.0)
            if least > -_LOOKED_INTO * self._dt:
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
            if deceleration < _LOOKED_INTO or actor.id in self._controlled or is_person(actor.id):
                continue
            limit = self._limits.get(actor.id)
            if limit is None:
                limit = self._limits[actor.id] = self._limit or sumo.vehicle_getDecel(actor.id)
            if deceleration > limit + _TOLERANCE:
                found.append((actor.id, deceleration))
        return found
