"""A reference driver that takes one faculty of an agent over: its speed, its lane changes, or both.

The agent still runs and sees everything. Its action stands wherever it is safe. Where it is not, the reference driver
answers as Responsibility-Sensitive Safety (RSS) asks: it does not exceed the speed for which the gap is safe, and it
refuses a lane change into a gap that is not safe. Source: Shalev-Shwartz, Shammah, Shashua, 2017, arXiv:1708.06374.

A reference driver without a faculty changes nothing, and reports where it would have answered.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.base.foreign_code import supports
from crashhunt.episode._action_override import ACCELERATION, WITH_LANE_CHANGE, Overruling, steering_of
from crashhunt.simulators import MAX_ACCELERATION, NamesMetaActions, ReportsSurroundings
from crashhunt.world import Neighbor, safe_distance, safe_speed, time_to_drive

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from crashhunt.agents import Agent
    from crashhunt.base.codec import JsonObject
    from crashhunt.simulators import Simulator, TranslatesMotion
    from crashhunt.trial import Overruled
    from crashhunt.world import Crossing, Side, Surroundings

RESPONSE_S = 0.5  # RSS leaves the response time to the user; half a second is what it assumes of an automated vehicle
MAX_PLANNED_BRAKING_MPS2 = 4.5  # a careful driver does not plan with emergency braking; SUMO's usual decel
_TOLERANCE_MPS = 0.1  # by which a speed may exceed the safe one, so that rounding is no response
_PAUSE_S = 0.5  # a shorter interruption does not end a response
_STOP_MARGIN_M = 1.0  # from the area that another actor crosses
_STANDS_MPS = 0.1
_LANE_OFFSETS = {"LANE_LEFT": 1, "LANE_RIGHT": -1}


@dataclass(slots=True)
class _Response:
    """A period in which the reference driver reacts in the same way to the same actor."""

    faculty: str
    kind: str
    actor: str
    first: int
    last: int
    values: dict[str, float]

    def to_json(self) -> JsonObject:
        return {
            "faculty": self.faculty, "kind": self.kind, "actor": self.actor, "first": self.first, "last": self.last,
            **self.values,
        }  # fmt: skip


class ReferenceCorrection(Overruling):
    """Lets an agent drive, and after a step corrects its unsafe speeds, lane changes, or both.

    Raises:
        InvalidEpisodeError: the simulator does not know the surroundings, or the actions have no known speeds.
    """

    def __init__(self, driver: Agent, simulator: Simulator, overruled: Overruled) -> None:
        if not supports(simulator, ReportsSurroundings):
            raise InvalidEpisodeError(
                f"a reference driver cannot drive {overruled.agent}: the simulator reports no surroundings of the "
                "vehicle"
            )
        form = simulator.actions[overruled.agent]
        self._meanings = tuple(form.space.meanings) if supports(form.space, NamesMetaActions) else ()
        has_speeds = tuple(form.names) in WITH_LANE_CHANGE or {"IDLE", "SLOWER"} <= {*self._meanings}
        self._steers = steering_of(simulator, overruled.agent)
        if not has_speeds and self._steers is None:
            raise InvalidEpisodeError(
                f"a reference driver cannot drive {overruled.agent}: the lanes and speeds that its actions mean are "
                "unknown"
            )
        self._driver, self._form, self._agent = driver, form, overruled.agent
        self._see = simulator.surroundings
        self._step_s = simulator.step_length_s
        self._response_s = max(RESPONSE_S, self._step_s)
        self._after = overruled.after
        self._speed = overruled.reference in ("longitudinal", "both")
        self._lane = overruled.reference in ("lateral", "both")
        self._step = 0
        self._responses: list[_Response] = []

    @property
    def responses(self) -> list[JsonObject]:
        """The periods in which the reference driver corrected the agent or would have corrected it, as JSON data."""
        return [one.to_json() for one in self._responses]

    def reset(self, seed: int) -> None:
        """Begin an episode."""
        self._responses.clear()
        super().reset(seed)

    def act(self, observation: object) -> object:
        """Return the agent's action if it is safe, and otherwise the corrected action."""
        step, action = self.drive(observation)
        if step < self._after:
            return action
        encoded = self._form.encode(action)
        around = self._see(self._agent)
        if self._meanings:
            return self._meta(step, action, self._meanings[int(encoded[0])], around)
        if self._steers is not None:
            return self._steered(step, action, encoded, self._steers, around)
        value, change = encoded.tolist()
        accelerates = tuple(self._form.names) == ACCELERATION
        target = max(0.0, around.speed_mps + value * self._step_s) if accelerates else float(value)
        allowed = self._allowed_change(step, int(change), around)
        limit = self._limit(step, target, self._reached(target, around), around)
        if self._lane and not allowed:
            change = 0
        if self._speed and limit is not None:
            value = target = max(0.0, limit, around.speed_mps - around.braking_mps2 * self._step_s)
            if accelerates:
                wanted = (target - around.speed_mps) / self._step_s
                value = max(-MAX_ACCELERATION, min(MAX_ACCELERATION, wanted))
        if (value, change) == tuple(encoded.tolist()):
            return action
        return float(value), int(change)

    def _meta(self, step: int, action: object, word: str, around: Surroundings) -> object:
        speed = around.speed_mps
        reached = speed + (around.acceleration_mps2 * self._step_s if word == "FASTER" else 0.0)
        reached -= around.braking_mps2 * self._step_s if word == "SLOWER" else 0.0
        allowed = self._allowed_change(step, _LANE_OFFSETS.get(word, 0), around)
        limit = self._limit(step, reached, reached, around)
        if self._speed and limit is not None:
            return self._meanings.index("SLOWER" if speed > limit else "IDLE")
        if self._lane and not allowed:
            return self._meanings.index("IDLE")
        return action

    def _steered(
        self, step: int, action: object, encoded: NDArray[np.generic], steers: TranslatesMotion, around: Surroundings
    ) -> object:
        motion = steers.motion_of(self._agent, encoded)
        allowed = self._allowed_change(step, motion.lane_change, around)
        limit = self._limit(step, motion.speed_mps, motion.speed_mps, around)
        speed = limit if self._speed else None
        keeps_lane = self._lane and not allowed
        if speed is None and not keeps_lane:
            return action
        return steers.action_with(self._agent, encoded, speed_mps=speed, keeps_lane=keeps_lane)

    def _reached(self, target: float, around: Surroundings) -> float:
        """Return the speed that the vehicle has one step after an action with this target speed, in m/s."""
        speed = around.speed_mps
        highest = speed + around.acceleration_mps2 * self._step_s
        return max(min(target, highest), speed - around.braking_mps2 * self._step_s)

    def _limit(self, step: int, target: float, reached: float, around: Surroundings) -> float | None:
        """Return the safe speed if the vehicle would be faster after the step, in m/s; None if its speed is safe."""
        neighbors = [*around.ahead]
        neighbors += [stop for one in around.crossing if (stop := self._stop_before(one, target, around)) is not None]
        limit, why = min(((self._safe_speed(one, around), one) for one in neighbors), key=_first, default=(None, None))
        if limit is None or why is None or reached <= limit + _TOLERANCE_MPS:
            return None
        values = {"gap_m": why.gap_m, "speed_mps": around.speed_mps, "actor_speed_mps": why.speed_mps, "safe": limit}
        self._note(step, "longitudinal", why.kind, why.actor, values)
        return limit

    def _safe_speed(self, neighbor: Neighbor, around: Surroundings) -> float:
        return safe_speed(
            neighbor.gap_m,
            neighbor.speed_mps,
            response_s=self._response_s,
            acceleration_mps2=around.acceleration_mps2,
            **_brakings(around.braking_mps2, neighbor.braking_mps2),
        )

    def _stop_before(self, crossing: Crossing, target: float, around: Surroundings) -> Neighbor | None:
        """Return the position at which the agent must stop for a crossing actor; None if both can pass.

        Agent and actor each have a time window in the conflict area: the agent accelerates to its target speed, and the
        actor keeps its speed. According to RSS, right of way is given and not taken, so the agent also stops for an
        actor that can no longer yield.
        """
        if crossing.distance_m <= 0 or (crossing.speed_mps < _STANDS_MPS and crossing.actor_distance_m > 0):
            return None  # it is in the area already and clears it, or the actor waits
        speed, acceleration = around.speed_mps, around.acceleration_mps2
        enters_s = time_to_drive(crossing.distance_m, speed, acceleration, target)
        leaves_s = time_to_drive(crossing.exit_m, speed, acceleration, target)
        actor_enters_s = time_to_drive(crossing.actor_distance_m, crossing.speed_mps, 0.0, 0.0)
        actor_leaves_s = time_to_drive(crossing.actor_exit_m, crossing.speed_mps, 0.0, 0.0)
        margin_s = self._response_s
        if not crossing.has_right_of_way:
            stops_m = crossing.speed_mps**2 / (2 * crossing.braking_mps2)
            if stops_m <= crossing.actor_distance_m:
                return None
        if enters_s >= actor_leaves_s + margin_s or leaves_s + margin_s <= actor_enters_s:
            return None
        return Neighbor(
            actor=crossing.actor,
            gap_m=crossing.distance_m - _STOP_MARGIN_M,
            speed_mps=0.0,
            braking_mps2=crossing.braking_mps2,
            kind="crossing",
        )

    def _allowed_change(self, step: int, change: int, around: Surroundings) -> bool:
        """Return whether a lane change is safe, that is, whether both gaps in the target lane are safe."""
        side = around.sides.get(change) if change else None
        if side is None:
            return True
        found = self._unsafe_neighbors(side, around)
        for kind, neighbor, needed in found:
            values = {"speed_mps": around.speed_mps}
            if neighbor is not None:
                values |= {"gap_m": neighbor.gap_m, "actor_speed_mps": neighbor.speed_mps, "safe": needed}
            word = "left" if change > 0 else "right"
            self._note(step, "lateral", f"{kind} {word}", neighbor.actor if neighbor is not None else "", values)
        return not found

    def _unsafe_neighbors(self, side: Side, around: Surroundings) -> list[tuple[str, Neighbor | None, float]]:
        """Return each reason why a lane change is unsafe: the reason's name, the vehicle, and the required gap in m.

        All reasons are returned, because the collision partner need not be the vehicle with the least safe gap.
        """
        if not side.exists:
            return [("no lane", None, 0.0)]
        found: list[tuple[str, Neighbor | None, float]] = []
        for word, neighbor, is_ahead in (("ahead", side.ahead, True), ("behind", side.behind, False)):
            if neighbor is None:
                continue
            needed = self._needed_m(neighbor, around, is_ahead=is_ahead)
            if neighbor.gap_m < needed:
                found.append(("alongside" if neighbor.gap_m < 0 else word, neighbor, needed))
        return found

    def _needed_m(self, neighbor: Neighbor, around: Surroundings, *, is_ahead: bool) -> float:
        """Return the safe gap between the vehicle and a neighbour in the target lane, in m."""
        rear, front = (around, neighbor) if is_ahead else (neighbor, around)
        return safe_distance(
            rear.speed_mps,
            front.speed_mps,
            response_s=self._response_s,
            acceleration_mps2=rear.acceleration_mps2,
            **_brakings(rear.braking_mps2, front.braking_mps2),
        )

    def _note(self, step: int, faculty: str, kind: str, actor: str, values: dict[str, float]) -> None:
        pause = max(1, round(_PAUSE_S / self._step_s))
        for one in reversed(self._responses):
            if one.last < step - pause:
                break
            if (one.faculty, one.kind, one.actor) == (faculty, kind, actor):
                one.last = step
                return
        self._responses.append(_Response(faculty=faculty, kind=kind, actor=actor, first=step, last=step, values=values))


def _brakings(rear_mps2: float, front_mps2: float) -> dict[str, float]:
    """Return the decelerations from which a safe distance is computed.

    RSS compares only the stopping distances, so its formula is valid if the front vehicle brakes at least as hard as
    the rear vehicle. If the rear vehicle braked harder, the formula would allow it to drive through a slower front
    vehicle.
    """
    planned = min(rear_mps2, MAX_PLANNED_BRAKING_MPS2)
    return {"braking_mps2": planned, "front_braking_mps2": max(front_mps2, planned)}


def _first(pair: tuple[float, Any]) -> float:
    return pair[0]
