"""The signals of a running trial, which requirements name: of the scene, the observation, the reward and ``info``."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from typing import TYPE_CHECKING, NamedTuple, Protocol, cast

import numpy as np

from crashhunt.base.errors import UnusableValueError
from crashhunt.base.foreign_code import number_of, supports
from crashhunt.base.text import did_you_mean, listed
from crashhunt.simulators import (
    HasMap,
    NamesObservations,
    ObservesParts,
    ReportsEvents,
    ReportsNearestAhead,
    ReportsSpeedLimit,
    ReportsSurroundings,
)
from crashhunt.world import EVENT_WORDS, approaches

if TYPE_CHECKING:
    from crashhunt.simulators import Info, Observations, Simulator
    from crashhunt.world import Lane, Neighbor, Scene

Read = Callable[[], float | None]


class KnownSignal(NamedTuple):
    """The unit of a signal, and its meaning as a clause."""

    unit: str
    meaning: str


SIGNALS: Mapping[str, KnownSignal] = {
    "time_s": KnownSignal("s", "time since the first step"),
    "x": KnownSignal("m", "centre of the front bumper, in the frame of the map"),
    "y": KnownSignal("m", "centre of the front bumper, in the frame of the map"),
    "heading": KnownSignal("rad", "counter-clockwise from the x axis"),
    "speed": KnownSignal("m/s", "speed along the heading"),
    "acceleration": KnownSignal("m/s²", "change of the speed since the last step"),
    "jerk": KnownSignal("m/s³", "change of the acceleration since the last step"),
    "yaw_rate": KnownSignal("rad/s", "change of the heading since the last step"),
    "gap_m": KnownSignal("m", "between the bumpers, to the nearest vehicle ahead on the path; infinite without one"),
    "headway_s": KnownSignal("s", "gap_m at the own speed; infinite without a vehicle ahead, or at a standstill"),
    "ttc_s": KnownSignal("s", "time to collision with the vehicle ahead; infinite if the gap grows"),
    "leader_speed": KnownSignal("m/s", "speed of the nearest vehicle ahead; infinite without one"),
    "leader_acceleration": KnownSignal(
        "m/s²", "change of leader_speed since the last step; 0 if the vehicle ahead has just changed"
    ),
    "leader_changed": KnownSignal("", "whether another vehicle is ahead than before the step; false without one"),
    "priority_m": KnownSignal(
        "m",
        "to the nearest conflict area in a junction that an actor with the right of way approaches; "
        "0 inside, infinite without one",
    ),
    "priority_arrival_s": KnownSignal(
        "s",
        "until an actor with the right of way reaches the conflict area in which the vehicle is; infinite outside",
    ),
    "speed_limit": KnownSignal("m/s", "speed limit of the lane"),
    "red_light_m": KnownSignal("m", "to the stop line of the next red light; infinite without one"),
    "clearance_m": KnownSignal(
        "m", "between the outlines, to the nearest actor in any direction; infinite beyond 50 m"
    ),
    "lane": KnownSignal("", "number at the end of the lane's name"),
    "lane_offset_m": KnownSignal("m", "of the centre from the centre line of the nearest lane; positive to the left"),
}
"""The signals of scenes with actors."""

_OBSERVATION = re.compile(r"observation\[(\d+)\]")
_TRAILING_NUMBER = re.compile(r"\d+$")
_INFO, _REWARD = "info.", "reward"
INFO_KEY = "key of info"


class SignalledEpisode(Protocol):
    """The part of an `Episode` from which signals are read."""

    simulator: Simulator
    names: tuple[str, ...]
    steps: int
    live: tuple[float, float, float, float] | None
    """x, y, heading and speed of the only agent in a step without an event, whose scene is made when it is read."""

    def look_ahead(self) -> tuple[str, float, float] | None:
        """Return name, gap and speed of the vehicle ahead, if `live` is not None; None if they cannot be read."""

    @property
    def scene(self) -> Scene | None:
        """The scene after the last step."""

    @property
    def observations(self) -> Observations:
        """The observations of the next step, by agent."""

    @property
    def rewards(self) -> Mapping[str, float]:
        """The rewards of the last step, by agent."""

    @property
    def infos(self) -> Info:
        """The infos of the last step, by agent."""


class TrialSignals:
    """Reads the signals of a running episode."""

    def __init__(self, episode: SignalledEpisode) -> None:
        self._episode = episode
        self._readers: dict[str, _SceneReader] = {}
        self.step_length_s = episode.simulator.step_length_s

    def reader(self, names: Sequence[str], agent: str) -> Callable[[], Sequence[float] | None]:
        """Return a function that returns the values of signals in the last scene; see `SignalSource`."""
        owners = [self._owner(name, agent) for name in names]
        readers = [self._one(name, whose) for whose, name in owners]
        episode = self._episode
        read_from = {agent, *(whose for whose, _ in owners)}
        actors = read_from.intersection(self._scene().roster.index)

        def read() -> Sequence[float] | None:
            if actors and episode.live is None and not actors <= self._scene().roster.index.keys():
                return None
            row = [one() for one in readers]
            for value in row:
                if value is None or value != value:
                    break
            else:
                return cast("list[float]", row)
            if None in row and (not episode.steps or any(map(self._has_ended, read_from))):
                return None
            return [_known(value, name) for value, name in zip(row, names, strict=True)]

        return read

    def known(self, agent: str) -> dict[str, str]:
        """Return the signals of an agent in the last scene, and their units."""
        found = dict(self._of_scene(agent))
        for kind in self._events():
            found[kind] = ""
        if agent in self._episode.rewards or not found:
            found[_REWARD] = ""
        observation = self._episode.observations.get(agent)
        if observation is not None:
            found |= {f"observation[{number}]": "" for number in range(min(observation.size, _MAX_ELEMENTS))}
        return found | {
            (key if key not in found else f"{_INFO}{key}"): ""
            for key, value in self._info(agent).items()
            if _NAME.fullmatch(str(key)) and _is_number(value)
        }

    def meaning(self, name: str) -> str:
        """Return the meaning of a signal of the first agent."""
        element = _OBSERVATION.fullmatch(name)
        if name in SIGNALS:
            return SIGNALS[name].meaning
        if element is not None:
            return self._column(int(element[1]))
        if name in self._events():
            return f"true in the steps with this event: {EVENT_WORDS[name][0]}"
        return "reward of the step" if name == _REWARD else INFO_KEY

    def _column(self, number: int) -> str:
        """Return the meaning of an element of the observation."""
        simulator = self._episode.simulator
        layouts = simulator.observation_layouts if supports(simulator, ObservesParts) else {}
        if layout := layouts.get(self._episode.names[0]):
            part, begin = max((one for one in layout.begins.items() if one[1] <= number), key=itemgetter(1))
            *rows, last = np.unravel_index(number - begin, layout.shapes[part])
            column = [*layout.columns[part], *map(str, range(last + 1))][last]
            row = f" in row {', '.join(map(str, rows))}" if rows else ""
            return f"{column}{row} of the part {part}"
        columns = tuple(simulator.observation_names) if supports(simulator, NamesObservations) else ()
        if not columns:
            return "element of the observation"
        return f"{columns[number % len(columns)]} in row {number // len(columns)} of the observation"

    def _scene(self) -> Scene:
        scene = self._episode.scene
        assert scene is not None
        return scene

    def _info(self, agent: str) -> Mapping[str, object]:
        found = self._episode.infos.get(agent)
        return found if isinstance(found, Mapping) else {}

    def _events(self) -> Sequence[str]:
        simulator = self._episode.simulator
        return tuple(simulator.reported_events) if supports(simulator, ReportsEvents) else ()

    def _of_scene(self, agent: str) -> dict[str, str]:
        if agent not in self._scene().roster.index:
            return {"time_s": SIGNALS["time_s"].unit}
        simulator = self._episode.simulator
        lacks = set() if supports(simulator, ReportsSurroundings) else set(_SURROUNDINGS)
        lacks |= set() if supports(simulator, ReportsSpeedLimit) else {"speed_limit"}
        lacks |= set() if supports(simulator, HasMap) else {"lane", "lane_offset_m"}
        return {name: known.unit for name, known in SIGNALS.items() if name not in lacks}

    def _owner(self, name: str, agent: str) -> tuple[str, str]:
        """Return the agent whose signal a name means, and the name without this agent."""
        for one in sorted(self._episode.names, key=len, reverse=True):
            if name.startswith(f"{one}."):
                return one, name[len(one) + 1 :]
        return agent, name

    def _has_ended(self, agent: str) -> bool:
        """Whether an agent did not act in the last step, although other agents did."""
        rewards = self._episode.rewards
        return bool(rewards) and agent not in rewards

    def _one(self, name: str, agent: str) -> Read:
        """Return the function that reads one signal of an agent."""
        if name in self._of_scene(agent):
            if agent not in self._readers:
                self._readers[agent] = _SceneReader(self._episode, agent)
            return self._readers[agent].read(name)
        if name in self._events():
            return lambda: (
                self._episode.live is None
                and any(event.kind == name and event.agent == agent for event in self._scene().events)
            )
        if name == _REWARD:
            return lambda: self._episode.rewards.get(agent) if self._episode.steps else None
        element = _OBSERVATION.fullmatch(name)
        if element is not None:
            return self._element(int(element[1]), agent, name)
        return lambda: self._info_value(name.removeprefix(_INFO), agent, name)

    def _element(self, number: int, agent: str, name: str) -> Read:
        size = self._episode.observations[agent].size
        if number >= size:
            fix = f"give an index from 0 to {size - 1}"
            raise UnusableValueError(f"the signal {name!r} is not in the observation of {size} numbers", fix=fix)

        def read() -> float | None:
            observation = self._episode.observations.get(agent)
            return None if observation is None else float(observation.flat[number])

        return read

    def _info_value(self, key: str, agent: str, name: str) -> float | None:
        info = self._info(agent)
        if key in info:
            value = info[key]
            number = number_of(value, f"info[{key!r}]", "name a key of info whose value is a number")
            return bool(number) if isinstance(value, bool | np.bool_) else number
        if not self._episode.steps or self._has_ended(agent):
            return None
        raise self._unknown(name, agent)

    def _unknown(self, name: str, agent: str) -> UnusableValueError:
        known = self.known(agent)
        shown = [one for one in known if not one.startswith("observation[")]
        fix = did_you_mean(name, known) or f"name one of {listed(shown)}"
        return UnusableValueError(f"the signal {name!r} of {agent} is unknown", fix=fix)


_MAX_ELEMENTS = 1000
_NAME = re.compile(r"[^\W\d]\w*")
_SURROUNDINGS = (
    "gap_m", "headway_s", "ttc_s", "leader_speed", "leader_acceleration", "leader_changed", "red_light_m", "priority_m",
    "priority_arrival_s",
)  # fmt: skip


def _known(value: float | None, name: str) -> float:
    if value is None or value != value:
        what = "has no value" if value is None else "is NaN"
        raise UnusableValueError(
            f"the signal {name!r} {what}", fix="give a number in every step, or name another signal"
        )
    return value


def _is_number(value: object) -> bool:
    try:
        number_of(value, "", "")
    except UnusableValueError:
        return False
    return True


class _SceneReader:
    """Reads the signals of one agent from scenes."""

    def __init__(self, episode: SignalledEpisode, agent: str) -> None:
        self._episode, self._agent = episode, agent
        self._step_s = episode.simulator.step_length_s
        self._lanes: Sequence[Lane] | None = None
        self._ahead_at, self._last_ahead, self._leader = -1, (math.inf, math.inf), ""
        self._change_at, self._change, self._before = -1, (0.0, False), ("", math.inf)
        self._priority_at, self._last_priority = -1, (math.inf, math.inf)

    def read(self, name: str) -> Read:
        """Return the function that reads a signal."""
        simple: dict[str, Read] = {
            "time_s": lambda: self._episode.steps * self._step_s,
            "x": lambda: self._place()[0],
            "y": lambda: self._place()[1],
            "heading": self._heading,
            "speed": self._speed,
            "acceleration": _Rate(self._speed, self._step_s),
            "jerk": _Rate(_Rate(self._speed, self._step_s), self._step_s, unknown=1),
            "yaw_rate": _Rate(self._heading, self._step_s, turn=True),
            "gap_m": lambda: self._ahead()[0],
            "headway_s": self._headway,
            "ttc_s": self._time_to_collision,
            "leader_speed": lambda: self._ahead()[1],
            "leader_acceleration": lambda: self._leader_change()[0],
            "leader_changed": lambda: self._leader_change()[1],
            "priority_m": lambda: self._priority()[0],
            "priority_arrival_s": lambda: self._priority()[1],
            "speed_limit": self._speed_limit,
            "red_light_m": self._red_light,
            "clearance_m": lambda: float(approaches([self._scene.frame], self._agent)[1][0]),
            "lane": self._lane_number,
            "lane_offset_m": lambda: self._nearest_lane()[1],
        }
        return simple[name]

    @property
    def _scene(self) -> Scene:
        scene = self._episode.scene
        assert scene is not None
        return scene

    @property
    def _row(self) -> int:
        return self._scene.roster.index[self._agent]

    def _place(self) -> tuple[float, float]:
        state = self._episode.live
        x, y = self._scene.points[self._row] if state is None else state[:2]
        return x, y

    def _heading(self) -> float:
        state = self._episode.live
        return self._scene.headings[self._row] if state is None else state[2]

    def _speed(self) -> float:
        state = self._episode.live
        return self._scene.speeds[self._row] if state is None else state[3]

    def _nearest(self, kind: str) -> Neighbor | None:
        simulator = self._episode.simulator
        if supports(simulator, ReportsNearestAhead):
            return simulator.nearest_ahead(self._agent, kind)
        assert supports(simulator, ReportsSurroundings)
        ahead = (one for one in simulator.surroundings(self._agent).ahead if one.kind == kind)
        return min(ahead, key=lambda one: one.gap_m, default=None)

    def _ahead(self) -> tuple[float, float]:
        """Return the gap to the nearest vehicle ahead, in m, and its speed, in m/s; both infinite without one."""
        if self._ahead_at != self._episode.steps:  # several signals need it in each step
            self._ahead_at = self._episode.steps
            found = self._episode.look_ahead() if self._episode.live is not None else None
            if found is None:
                nearest = self._nearest("vehicle")
                found = (
                    ("", math.inf, math.inf) if nearest is None else (nearest.actor, nearest.gap_m, nearest.speed_mps)
                )
            self._leader, *ahead = found
            self._last_ahead = ahead[0], ahead[1]
        return self._last_ahead

    def _leader_change(self) -> tuple[float, bool]:
        """Return the acceleration of the vehicle ahead, in m/s², and whether it is another one than before."""
        if self._change_at != self._episode.steps:
            (_, speed), (leader, before) = self._ahead(), self._before
            is_first, is_same = self._change_at < 0, leader == self._leader
            change = (speed - before) / self._step_s if is_same and self._leader else 0.0
            self._change = change, not is_same and not is_first and bool(self._leader)
            self._change_at, self._before = self._episode.steps, (self._leader, speed)
        return self._change

    def _priority(self) -> tuple[float, float]:
        """Return the distance to the next conflict area, in m, and the time of arrival of the other actor, in s."""
        if self._priority_at != self._episode.steps:
            simulator = self._episode.simulator
            assert supports(simulator, ReportsSurroundings)
            crossing = [one for one in simulator.surroundings(self._agent).crossing if one.has_right_of_way]
            distance_m = min((max(0.0, one.distance_m) for one in crossing), default=math.inf)
            inside = [one for one in crossing if one.distance_m <= 0 < one.exit_m and one.actor_exit_m > 0]
            arrival_s = min((_arrival_s(one.actor_distance_m, one.speed_mps) for one in inside), default=math.inf)
            self._priority_at, self._last_priority = self._episode.steps, (distance_m, arrival_s)
        return self._last_priority

    def _speed_limit(self) -> float:
        simulator = self._episode.simulator
        assert supports(simulator, ReportsSpeedLimit)
        return simulator.speed_limit(self._agent)

    def _headway(self) -> float:
        speed = self._speed()
        return self._ahead()[0] / speed if speed > 0 else math.inf

    def _time_to_collision(self) -> float:
        gap_m, speed = self._ahead()
        closing = self._speed() - speed
        return max(0.0, gap_m) / closing if closing > 0 else math.inf

    def _red_light(self) -> float:
        nearest = self._nearest("red light")
        return math.inf if nearest is None else nearest.gap_m

    def _lane_number(self) -> float | None:
        lane = self._scene.agent_lanes.get(self._agent) or self._nearest_lane()[0]
        number = _TRAILING_NUMBER.search(lane)
        return float(number[0]) if number else None

    def _nearest_lane(self) -> tuple[str, float]:
        """Return the name of the lane whose centre line is nearest to the agent's centre, and the offset from it."""
        if self._lanes is None:
            simulator = self._episode.simulator
            assert supports(simulator, HasMap)
            self._lanes = simulator.lanes()
            pieces = [
                (number, *first, *last)
                for number, lane in enumerate(self._lanes)
                for first, last in zip(lane.shape, lane.shape[1:], strict=False)
            ]
            self._pieces = np.array(pieces, float).reshape(-1, 5)
        if not len(self._pieces):
            return "", math.nan
        x, y = self._scene.centers[self._row]
        _, x0, y0, x1, y1 = self._pieces.T
        along_x, along_y = x1 - x0, y1 - y0
        length = np.maximum(np.hypot(along_x, along_y), 1e-9)
        share = np.clip(((x - x0) * along_x + (y - y0) * along_y) / length**2, 0.0, 1.0)
        nearest = int(np.argmin(np.hypot(x - x0 - share * along_x, y - y0 - share * along_y)))
        offset = (along_x[nearest] * (y - y0[nearest]) - along_y[nearest] * (x - x0[nearest])) / length[nearest]
        return self._lanes[int(self._pieces[nearest, 0])].id, float(offset)


def _arrival_s(distance_m: float, speed_mps: float) -> float:
    return 0.0 if distance_m <= 0 else distance_m / speed_mps if speed_mps > 0 else math.inf


class _Rate:
    """The change of a signal per second since the last step; 0 before the first step.

    Args:
        signal: function that returns the signal.
        step_s: step length, in s.
        turn: whether the signal is an angle, in rad.
        unknown: number of first values of the signal that are not known, and only stand in for it.
    """

    def __init__(self, signal: Callable[[], float], step_s: float, *, turn: bool = False, unknown: int = 0) -> None:
        self._signal, self._step_s, self._turn, self._unknown = signal, step_s, turn, unknown
        self._last: float | None = None

    def __call__(self) -> float:
        value, last = self._signal(), self._last
        if self._unknown:
            self._unknown -= 1
            return 0.0
        self._last = value
        if last is None:
            return 0.0
        change = math.remainder(value - last, math.tau) if self._turn else value - last
        return change / self._step_s
