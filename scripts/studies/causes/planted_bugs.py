"""A lane-changing agent with planted bugs; it prints each step in which a bug changed its action.

Without a bug it follows by the Intelligent Driver Model, and changes lanes every few seconds into generous gaps.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from crashhunt.agents import CarFollowing
from crashhunt.agents._protocol import meta_actions, wanted_meta_action

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    Row = list[float]
    Rows = list[Row]
    Action = tuple[float, int]

_SUMO_LANE_M, _HIGHWAY_LANE_M = 3.2, 4.0
_LOOKS_M = 45.0
_LATE_M = 12.0  # of centres: the bumpers are 7 m apart
_EVERY_S = 2.5


class Planted(CarFollowing):
    """Drives with some bugs of `BUGS`.

    Args:
        bugs: their names, joined by ``+``.
        desired_speed: on a free road, in m/s.
        observation_space: observation space of the vehicle.
        action_space: action space of the vehicle: (target speed, lane change), or highway-env's meta-actions.
        step_length_s: step length of the simulation, in s.
    """

    def __init__(
        self,
        bugs: str = "",
        desired_speed: float = 22.0,
        observation_space: Any = None,
        action_space: Any = None,
        step_length_s: float = 0.1,
    ) -> None:
        super().__init__(
            desired_speed=desired_speed, delay_s=0.0, headway_s=1.8, observation_space=observation_space,
            step_length_s=step_length_s,
        )  # fmt: skip
        self._bugs, self._step_s = [name for name in bugs.split("+") if name], step_length_s
        self._actions = meta_actions(action_space)
        self.lane_m = _SUMO_LANE_M if self._actions is None else _HIGHWAY_LANE_M

    def reset(self, seed: int) -> None:
        """Begin an episode."""
        super().reset(seed)
        self.step = 0

    def act(self, observation: NDArray[np.float32]) -> tuple[float, int] | int:
        """Return speed and lane change, after the first bug that changes them, or the meta-action for them."""
        speed, change = self._decide(observation)
        if self._actions is None:
            return speed, change
        return self._actions[wanted_meta_action((speed - float(observation[0, 3])) / self._step_s, change)]

    def _decide(self, observation: NDArray[np.float32]) -> Action:
        self.step += 1
        own, rows = observation[0].tolist(), [row for row in observation[1:].tolist() if row[0] > 0.5]
        action = super().act(observation)
        assert isinstance(action, tuple)  # the base class has no action space
        wanted = (float(action[0]), self._wish(own, rows))
        for name in self._bugs:
            found = BUGS[name](self, own, rows, wanted)
            if found != wanted:
                print(f"PLANTED {name} {self.step}", flush=True)
                return found
        return wanted

    def is_due(self) -> bool:
        """Whether this is a step in which it may change lanes."""
        return self.step % round(_EVERY_S / self._step_s) == 0

    def has_lane(self, own: Row, rows: Rows, side: int) -> bool:
        """Left lanes are known from the own offset to the leftmost one, right ones from vehicles on them."""
        return own[2] > self.lane_m / 2 if side > 0 else any(2.0 < row[2] < 4.5 and row[5] > 0.9 for row in rows)

    def is_free(self, rows: Rows, side: int, *, ahead: bool = True, behind: bool = True) -> bool:
        """Whether no vehicle is near on the neighbouring lane."""
        lane = [row[1] for row in rows if abs(row[2] + side * self.lane_m) < 1.8 and row[5] > 0.5]
        return not any((ahead and 0 <= x < _LOOKS_M) or (behind and -_LOOKS_M < x < 0) for x in lane)

    def _wish(self, own: Row, rows: Rows) -> int:
        """Change to the left and right in turns, where there is a lane, and no vehicle near on it."""
        if not self.is_due():
            return 0
        side = 1 if (self.step // round(_EVERY_S / self._step_s)) % 2 else -1
        return side if self.has_lane(own, rows, side) and self.is_free(rows, side) else 0


def _leader(rows: Rows) -> Row | None:
    near = [row for row in rows if row[1] > 0 and abs(row[2]) < 1.5 and row[5] > 0.5]
    return min(near, key=lambda row: row[1], default=None)


def _sign(_: Planted, own: Row, rows: Rows, wanted: Action) -> Action:
    """The sign of the closing speed is wrong: it speeds up behind a slower vehicle."""
    leader = _leader(rows)
    return (own[3] + 2.0, wanted[1]) if leader and leader[1] < 35 and leader[3] < -0.5 else wanted


def _frozen(agent: Planted, own: Row, rows: Rows, wanted: Action) -> Action:
    """It holds its speed for twelve of every twenty seconds, and does not change lanes."""
    return (own[3], 0) if rows and 60 <= agent.step % 200 < 180 else wanted


def _wrong_side(agent: Planted, own: Row, rows: Rows, wanted: Action) -> Action:
    """Before a change to the left it looks at the lane on the right."""
    unsafe = agent.is_due() and agent.has_lane(own, rows, 1) and not agent.is_free(rows, 1)
    return (wanted[0], 1) if unsafe and agent.is_free(rows, -1) else wanted


def _blind_behind(agent: Planted, own: Row, rows: Rows, wanted: Action) -> Action:
    """It does not look behind before a change to the right."""
    unsafe = agent.is_due() and agent.has_lane(own, rows, -1) and not agent.is_free(rows, -1)
    return (wanted[0], -1) if unsafe and agent.is_free(rows, -1, behind=False) else wanted


def _blind_ahead(agent: Planted, own: Row, rows: Rows, wanted: Action) -> Action:
    """It does not look ahead before a change to the left."""
    unsafe = agent.is_due() and agent.has_lane(own, rows, 1) and not agent.is_free(rows, 1)
    return (wanted[0], 1) if unsafe and agent.is_free(rows, 1, ahead=False) else wanted


def _late(_: Planted, own: Row, rows: Rows, wanted: Action) -> Action:
    """It does not brake for the vehicle ahead before that is near."""
    leader = _leader(rows)
    return (own[3], wanted[1]) if leader and leader[1] > _LATE_M and wanted[0] < own[3] else wanted


def _off_edge(agent: Planted, own: Row, rows: Rows, wanted: Action) -> Action:
    """It counts one lane too many on the left."""
    return (wanted[0], 1) if rows and agent.is_due() and agent.step > 150 and own[2] < agent.lane_m / 2 else wanted


def _index(agent: Planted, own: Row, rows: Rows, wanted: Action) -> Action:
    """It reads a row that is not there when a vehicle is close ahead."""
    leader = _leader(rows)
    if own and leader and leader[1] < 14:
        print(f"PLANTED index {agent.step}", flush=True)
        return rows[99][0], 0
    return wanted


BUGS: dict[str, Callable[[Planted, Row, Rows, Action], Action]] = {
    "sign": _sign, "frozen": _frozen, "wrong_side": _wrong_side, "blind_behind": _blind_behind, "off_edge": _off_edge,
    "index": _index, "blind_ahead": _blind_ahead, "late": _late,
}  # fmt: skip
