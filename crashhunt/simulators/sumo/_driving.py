"""What an action does to a vehicle of SUMO's."""

from __future__ import annotations

from typing import TYPE_CHECKING

# As in _simulator.py: the package's own functions cost twice as much.
from libsumo import _libsumo as sumo

from crashhunt.simulators._actions import META_ACTIONS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    import numpy as np
    from numpy.typing import NDArray

    from crashhunt.scenario import AgentSetup

__all__ = ["Driving"]


class Driving:
    """Applies actions to vehicles.

    Args:
        setups: of all agents of a scenario, by name.
        step_length_s: in s.
    """

    def __init__(self, setups: Mapping[str, AgentSetup], step_length_s: float) -> None:
        self._setups, self._step_length_s = setups, step_length_s
        self._edges: dict[str, tuple[int, float]] = {}
        self._closed_lanes: dict[tuple[str, str], bool] = {}
        self._targets: dict[str, int] = {}

    def begin(self, agents: Iterable[str]) -> None:
        """Forget the last episode; the network is the same."""
        self._targets = dict.fromkeys(agents, -1)

    def apply(self, agent: str, action: NDArray[np.generic]) -> bool:
        """Apply an encoded action; return whether the vehicle stays on the road."""
        setup = self._setups[agent]
        if setup.action == "meta":
            self._apply_meta(agent, setup, META_ACTIONS[int(action[0])])
            return True
        speed, change = action.tolist()
        sumo.vehicle_setSpeed(agent, speed)
        return not change or self._change_lane(agent, int(change))

    def _apply_meta(self, agent: str, setup: AgentSetup, action: str) -> None:
        """As highway-env does it: FASTER and SLOWER step from the nearest of the target speeds."""
        targets = setup.target_speeds
        if self._targets[agent] < 0:
            speed = sumo.vehicle_getSpeed(agent)
            self._targets[agent] = min(range(len(targets)), key=lambda index: abs(targets[index] - speed))
        shift = {"FASTER": 1, "SLOWER": -1}.get(action, 0)
        self._targets[agent] = max(0, min(len(targets) - 1, self._targets[agent] + shift))
        sumo.vehicle_setSpeed(agent, targets[self._targets[agent]])
        change = {"LANE_LEFT": 1, "LANE_RIGHT": -1}.get(action, 0)
        if change:
            self._change_lane(agent, change)  # into nothing is ignored, as in highway-env

    def _change_lane(self, agent: str, change: int) -> bool:
        """Change to a neighbouring lane at once; False where there is none that the vehicle may use."""
        edge = sumo.vehicle_getRoadID(agent)
        if edge.startswith(":"):
            return True  # inside a junction there is nothing to change to, and nothing to leave either
        lanes, _ = self.edge(edge)
        target = sumo.vehicle_getLaneIndex(agent) + change
        if not 0 <= target < lanes or self._is_closed(f"{edge}_{target}", sumo.vehicle_getVehicleClass(agent)):
            return False
        sumo.vehicle_changeLane(agent, target, self._step_length_s)
        return True

    def edge(self, edge: str) -> tuple[int, float]:
        """Return the number of lanes of an edge, and the width of its first."""
        found = self._edges.get(edge)
        if found is None:
            found = self._edges[edge] = sumo.edge_getLaneNumber(edge), sumo.lane_getWidth(f"{edge}_0")
        return found

    def _is_closed(self, lane: str, vehicle_class: str) -> bool:
        found = self._closed_lanes.get((lane, vehicle_class))
        if found is None:
            allowed = sumo.lane_getAllowed(lane)
            found = bool(allowed) and vehicle_class not in allowed and vehicle_class != "ignoring"
            self._closed_lanes[lane, vehicle_class] = found
        return found
