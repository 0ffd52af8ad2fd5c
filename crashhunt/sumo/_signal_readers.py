"""Readers of the next traffic lights on the route: their states, since when, and when they change."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from libsumo import _libsumo as sumo

from crashhunt.sumo._reader_protocol import NEVER_S, AgentMoment, Reader, ReaderSetup, RowsReader

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from crashhunt.native import Draft
    from crashhunt.sumo._lane_graph import RouteSignal

    Array = NDArray[np.float64]

SIGNAL_STATES = {"G": 0.0, "g": 0.0, "y": 1.0, "Y": 1.0, "r": 2.0, "R": 2.0, "u": 2.0, "s": 2.0, "o": 3.0, "O": 3.0}
_OFF = 3.0
_FIXED_TIMES = 0  # type of a traffic light program


class SignalsReader(RowsReader):
    """Reads the next traffic lights on the route."""

    def __init__(self, setup: ReaderSetup) -> None:
        super().__init__(setup)
        self._ahead: dict[tuple[int, int, str], list[RouteSignal]] = {}
        self._seen: dict[tuple[str, int], list[float]] = {}  # state of the lights ahead, and since when

    def write(self, draft: Draft, at: int, moment: AgentMoment) -> None:
        """Write the columns of ``signals``."""
        if not draft.signals(at, self._lights(moment), self._setup.step_length_s):
            super().write(draft, at, moment)

    def _rows(self, moment: AgentMoment) -> list[tuple[float, ...]]:
        found: list[tuple[float, ...]] = []
        time_s, place = moment.scene.time_s, self._setup.places.find(moment)
        for distance, light, link, last in self._lights(moment):
            state = _state_of(light, link)
            if last[0] != state:  # it changed when the step began
                last[:] = state, time_s - self._setup.step_length_s
            assert place is not None
            found.append((1.0, state, distance - place.position_m, time_s - last[1]))
        return found

    def _lights(self, moment: AgentMoment) -> list[tuple[float, str, int, list[float]]]:
        """Return the lights ahead: distance from the start of the lane, id, link, and the state with its beginning.

        The core may change the states.
        """
        seen, self._seen = self._seen, {}
        place = self._setup.places.find(moment)
        if place is None or place.number < 0:
            return []
        key = id(place.guide), place.number, place.lane.id
        ahead = self._ahead.get(key)
        if ahead is None:
            ahead = self._ahead[key] = place.guide.signals(place.number, place.lane, self._setup.limit)
        for _, light, link in ahead:
            last = seen.get((light, link))
            if last is None:
                state = _state_of(light, link)
                last = [state, moment.scene.time_s - _time_in_state(light, link, state)]
            self._seen[light, link] = last
        return [(distance, light, link, self._seen[light, link]) for distance, light, link in ahead]


def _state_of(light: str, link: int) -> float:
    return SIGNAL_STATES.get(sumo.trafficlight_getRedYellowGreenState(light)[link], _OFF)


def _time_in_state(light: str, link: int, state: float) -> float:
    """Return how long a traffic light shows a state at least, in s: exactly, if its program has fixed times."""
    found, phases, current = float(sumo.trafficlight_getSpentDuration(light)), *_phases(light)
    for back in range(1, len(phases)):
        phase = phases[(current - back) % len(phases)]
        if SIGNAL_STATES.get(phase.state[link], _OFF) != state:
            break
        found += phase.duration
    return found


def _phases(light: str) -> tuple[Sequence[Any], int]:
    """Return the phases of a traffic light and the index of the present one; none if its program adapts."""
    name = sumo.trafficlight_getProgram(light)
    for program in sumo.trafficlight_getAllProgramLogics(light):
        if program.programID == name and program.type == _FIXED_TIMES:
            return program.phases, program.currentPhaseIndex
    return (), 0


class SwitchTimesReader(Reader):
    """Reads when the next traffic lights on the route change their states."""

    def observe(self, moment: AgentMoment) -> Array:
        """Return the values of ``time_to_switch``."""
        found = np.zeros(self._setup.shape)
        place = self._setup.places.find(moment)
        if place is None or place.number < 0:
            return found
        lights = place.guide.signals(place.number, place.lane, self._setup.limit)
        for row, (_, light, link) in enumerate(lights):
            found[row] = _time_to_switch(light, link, moment.scene.time_s)
        return found


def _time_to_switch(light: str, link: int, time_s: float) -> float:
    """Return the least time until a traffic light changes its state, in s: the exact one, if its program is fixed."""
    phases, current = _phases(light)
    left = max(0.0, float(sumo.trafficlight_getNextSwitch(light)) - time_s)
    state = SIGNAL_STATES.get(sumo.trafficlight_getRedYellowGreenState(light)[link], _OFF)
    for ahead in range(1, len(phases)):
        phase = phases[(current + ahead) % len(phases)]
        if SIGNAL_STATES.get(phase.state[link], _OFF) != state:
            return left
        left += phase.duration
    return NEVER_S if phases else left
