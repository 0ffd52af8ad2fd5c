"""The fast path of an episode on SUMO: which episodes run steps in the compiled core, and which steps it passes back.

The core does not complete a step if an event needs Python code: an agent appears, a vehicle has an unknown property, a
signal changes the action. `FastPath` then completes the step, or passes the rest of the step to `FastEpisode`. An
observer, oracle or simulator that needs each part of each step gets an episode without the core (`make_fast_path`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.base.foreign_code import supports
from crashhunt.episode._observers import Nearness, Recorder, overrides_hook
from crashhunt.native import ANSWERED, ASK, DONE, REFUSED
from crashhunt.oracles import (
    MAX_BRAKING_MPS2,
    OffRoad,
    OffRoute,
    Overlap,
    RedLight,
    ReportedCollision,
    RequirementOracle,
    Teleport,
    TrafficEvents,
    WrongWay,
)
from crashhunt.simulators import SupportsFastSteps

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from crashhunt.agents import Agent
    from crashhunt.episode._observers import Observer
    from crashhunt.oracles import Oracle
    from crashhunt.simulators import FastStepper, Simulator


_EVENT_ORACLES = (ReportedCollision, OffRoad, TrafficEvents, RedLight, WrongWay, OffRoute, Teleport)
"""Oracles that find nothing in steps without a simulator event; subclasses of these do not count."""


class FastPath:
    """Completes in Python the steps that the compiled core could not complete, so that the core can run the next steps.

    Attributes:
        cannot_record: whether a failure occurred in the recording.
        is_resuming: whether a failure occurred while the core read the simulator's state.
        is_encoding: whether a failure occurred while the agent's action was encoded.
    """

    def __init__(
        self, at_once: FastStepper, recorder: Recorder, agent: str, encode: Callable[[object], NDArray[np.generic]]
    ) -> None:
        self.at_once = at_once
        self._recorder, self._agent, self._encode = recorder, agent, encode
        self.cannot_record = self.is_resuming = self.is_encoding = False
        at_once.core.listen(recorder.numbers, self._record_roster)

    def resume_after(self, come: int, agents: dict[str, Agent]) -> tuple[int, dict[str, NDArray[np.generic]] | None]:
        """Return the final status of a step and the agent's action; None if the agent has not acted.

        If the status is `ANSWERED`, observers have not been called for the action yet.
        """
        core = self.at_once.core
        if come == REFUSED:
            self.is_resuming = True
            resumed = self._resume()
            self.is_resuming = False
            if resumed:
                come = core.take(agents)
        if come in (DONE, ASK, REFUSED):
            return come, None
        self.is_encoding = True
        action = self._encode(core.answer)
        self.is_encoding = False
        if come == ANSWERED and core.note(action):
            come = core.go_on(self.at_once.apply(self._agent, action))
        return come, {self._agent: action}

    def _resume(self) -> bool:
        """Let the core continue from the simulator's state; return False if that is not possible yet."""
        if self.at_once.resume() is None:
            return False
        self._record_roster()
        return True

    def _record_roster(self, records: tuple[bytes, bytes] | None = None) -> None:
        """Make the core record the steps of the actors in sight, after their records."""
        self.cannot_record = True
        self._recorder.lend(self.at_once.core, self.at_once.roster, records)
        self.cannot_record = False


def make_fast_path(
    simulator: Simulator,
    observers: Sequence[Observer],
    oracles: Sequence[Oracle],
    max_steps: int,
    encoders: Sequence[Callable[[object], NDArray[np.generic]]],
) -> FastPath | None:
    """Return the fast path; None if an observer, an oracle or the simulator needs each part of each step."""
    first = observers[0] if observers else None
    if not isinstance(first, Recorder) or type(first) is not Recorder or not supports(simulator, SupportsFastSteps):
        return None
    if simulator.at_once is None or not simulator.at_once.is_unpatched(simulator):
        return None
    rest = [one for one in observers[1:] if type(one) is not Nearness]
    if any(overrides_hook(one, "observation") or overrides_hook(one, "action") for one in rest):
        return None
    always = any(overrides_hook(one, "scene") for one in rest)
    by_themselves = (Overlap, RequirementOracle, *_EVENT_ORACLES)
    always = always or any(type(one) not in by_themselves for one in oracles)
    overlaps = any(type(one) is Overlap for one in oracles)
    simulator.at_once.core.judge(overlaps, MAX_BRAKING_MPS2, always, max_steps, Nearness.EVERY)
    return FastPath(simulator.at_once, first, simulator.agents[0], encoders[0])
