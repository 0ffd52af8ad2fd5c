"""Whether most steps of an episode can be taken in one call, by the compiled core."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.base.capabilities import supports
from crashhunt.episode._observers import Nearness, Recorder, overrides_hook
from crashhunt.native import ANSWERED, ASK, DONE, REFUSED
from crashhunt.oracles import (
    HARDEST,
    OffRoad,
    OffRoute,
    Overlap,
    RedLight,
    ReportedCollision,
    Teleport,
    TrafficEvents,
    WrongWay,
)
from crashhunt.simulators import FlattensObservations, StepsAtOnce

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from crashhunt.agents import Agent
    from crashhunt.episode._observers import Observer
    from crashhunt.oracles import Oracle
    from crashhunt.simulators import AtOnce, Simulator


__all__ = ["FastPath", "make_fast_path"]


_FIND_NOTHING = (ReportedCollision, OffRoad, TrafficEvents, RedLight, WrongWay, OffRoute, Teleport)
"""Oracles that find nothing in steps without a simulator event; subclasses of these do not count."""


class FastPath:
    """Completes steps that the core has left, as long as no event needs Python code.

    Args:
        at_once: the simulator's.
        recorder: of the episode.
        agent: the only one of the episode.
        encode: encodes its actions.

    Attributes:
        cannot_record: whether recording is what has failed, where something has.
        is_resuming: whether the core was reading the simulator's state when something failed.
        is_encoding: whether the agent's action was being encoded when something failed.
    """

    def __init__(
        self, at_once: AtOnce, recorder: Recorder, agent: str, encode: Callable[[object], NDArray[np.generic]]
    ) -> None:
        self.at_once = at_once
        self._recorder, self._agent, self._encode = recorder, agent, encode
        self.cannot_record = self.is_resuming = self.is_encoding = False
        at_once.core.listen(at_once.enter, self._record_roster)

    def resume_after(self, come: int, agents: dict[str, Agent]) -> tuple[int, dict[str, NDArray[np.generic]] | None]:
        """Return the final status of a step, and the agent's action; None if the agent has not acted.

        With the status `ANSWERED`, observers have not been called for the action yet.

        Args:
            come: The status that the core has returned.
            agents: The agents by name.
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

    def _record_roster(self) -> None:
        """Have the core record steps of those who are in sight."""
        self.cannot_record = True
        self._recorder.lend(self.at_once.core, self.at_once.roster)
        self.cannot_record = False


def make_fast_path(
    simulator: Simulator,
    observers: Sequence[Observer],
    oracles: Sequence[Oracle],
    max_steps: int,
    encoders: Sequence[Callable[[object], NDArray[np.generic]]],
) -> FastPath | None:
    """Return the fast path; None if an observer needs each part of each step.

    Args:
        simulator: which has been reset.
        observers: of the episode.
        oracles: of the episode.
        max_steps: of the episode.
        encoders: of the actions of each agent.
    """
    first = observers[0] if observers else None
    if not isinstance(first, Recorder) or type(first) is not Recorder or not supports(simulator, StepsAtOnce):
        return None
    if simulator.at_once is None or not simulator.at_once.is_unpatched(simulator):
        return None
    if supports(simulator, FlattensObservations):
        return None
    rest = [one for one in observers[1:] if type(one) is not Nearness]
    if any(overrides_hook(one, "observation") or overrides_hook(one, "action") for one in rest):
        return None
    always = any(overrides_hook(one, "scene") for one in rest)
    always = always or any(type(one) is not Overlap and type(one) not in _FIND_NOTHING for one in oracles)
    overlaps = any(type(one) is Overlap for one in oracles)
    simulator.at_once.core.judge(overlaps, HARDEST, always, max_steps, Nearness.EVERY)
    return FastPath(simulator.at_once, first, simulator.agents[0], encoders[0])
