"""How an episode ends, whoever is to blame."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any

from crashhunt.base.errors import RecorderError
from crashhunt.episode._failures import failure_of, is_emptied
from crashhunt.trial import Outcome, TrialResult

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from crashhunt.agents import Agent
    from crashhunt.episode._ahead import Ahead
    from crashhunt.simulators import Simulator
    from crashhunt.trial import TrialSpec
    from crashhunt.world import Scene

__all__ = ["Ending"]


class Ending:
    """The part of an `Episode` that ends it."""

    spec: TrialSpec
    simulator: Simulator
    names: tuple[str, ...]
    steps: int
    result: TrialResult | None
    error: BaseException | None
    _on_end: list[Callable[[TrialResult], TrialResult]]
    _ahead: Ahead | None
    _take: Callable[[Mapping[str, Agent]], int] | None
    _scene: Scene | None

    def _fail(self, outcome: Outcome, error: BaseException, agent: str = "") -> TrialResult:
        """End with an exception of an agent's, or of the simulator's."""
        self.error = error
        return self._end(outcome, failure=failure_of(error, agent))

    def _end(self, outcome: Outcome, **evidence: Any) -> TrialResult:
        """End, and let everybody who has looked on add what they have found out."""
        time_s = self.simulator.scene().time_s if self._scene is not None else 0.0
        return self._add(TrialResult(self.spec, outcome, steps=self.steps, sim_time_s=time_s, **evidence))

    def _add(self, result: TrialResult) -> TrialResult:
        self._take = None
        for tell in self._on_end:
            result = tell(result)
        self.result = result
        return result

    def _break(self, error: BaseException) -> TrialResult:
        """End where it cannot go on, and neither agent nor simulator has said why.

        An oracle has failed, an observer, or something that the agent has damaged, such as our own files.
        """
        self.error = error
        agents = isinstance(error, OSError | MemoryError) or is_emptied()
        outcome = Outcome.AGENT_ERROR if agents else Outcome.SIMULATOR_ERROR
        self.result = TrialResult(self.spec, outcome, steps=self.steps, failure=failure_of(error, ""))
        with suppress(BaseException):
            self._add(self.result)
        return self.result

    def _fail_at_once(self, error: BaseException) -> TrialResult:
        """End with an exception that has come through the core."""
        assert self._ahead is not None
        if self._ahead.cannot_record and isinstance(error, RecorderError):
            raise error
        if self._ahead.cannot_record:
            return self._break(error)
        if not self._ahead.at_once.core.simulating:
            return self._fail(Outcome.AGENT_ERROR, error, self.names[0])
        return self._fail(Outcome.AGENT_ERROR if is_emptied() else Outcome.SIMULATOR_ERROR, error)
