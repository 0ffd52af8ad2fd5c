"""How an episode ends, whoever is to blame."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any

from crashhunt.base.errors import RecorderError
from crashhunt.episode._attribution import Attribution, attribute_error
from crashhunt.episode._failures import failure_of
from crashhunt.trial import Outcome, TrialResult

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from crashhunt.agents import Agent
    from crashhunt.episode._ahead import Ahead
    from crashhunt.episode._observer import Observer
    from crashhunt.oracles import Oracle
    from crashhunt.simulators import Simulator
    from crashhunt.trial import TrialSpec
    from crashhunt.world import Scene

__all__ = ["Ending"]


class Ending:
    """The part of an `Episode` that ends it."""

    spec: TrialSpec
    simulator: Simulator
    agents: dict[str, Agent]
    names: tuple[str, ...]
    steps: int
    result: TrialResult | None
    error: BaseException | None
    _on_end: list[Callable[[TrialResult], TrialResult]]
    _ahead: Ahead | None
    _take: Callable[[Mapping[str, Agent]], int] | None
    _scene: Scene | None
    _oracles: tuple[Oracle, ...]
    _observers: tuple[Observer, ...]

    def _fail(self, outcome: Outcome, error: BaseException, agent: str = "", cause: str = "") -> TrialResult:
        """End with an exception of an agent's, or of the simulator's."""
        self.error = error
        return self._end(outcome, failure=failure_of(error, agent, cause=cause))

    def _fail_in_simulator(self, error: BaseException) -> TrialResult:
        """End with an exception that was raised while the simulator was running, by itself or by code of an agent.

        Raises:
            RecorderError: the disk is full.
        """
        found = self._attribute(error)
        if found is not None:
            return self._fail(Outcome.AGENT_ERROR, error, found.agent, found.cause)
        if isinstance(error, RecorderError):
            raise error
        return self._fail(Outcome.SIMULATOR_ERROR, error)

    def end_by_agent(self, error: BaseException) -> TrialResult | None:
        """End with an exception that an agent's code has raised between two steps, as a signal handler may.

        Returns:
            The result; None where the exception does not come from an agent.
        """
        if self.result is not None:
            return self.result
        found = self._attribute(error)
        return None if found is None else self._fail(Outcome.AGENT_ERROR, error, found.agent, found.cause)

    def _attribute(self, error: BaseException) -> Attribution | None:
        """Return which agent has made something fail; None where none has, as far as is known."""
        return attribute_error(error, self.agents, self.simulator, (*self._oracles, *self._observers))

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

        Raises:
            RecorderError: the disk is full.
        """
        found = self._attribute(error)
        if found is None and isinstance(error, RecorderError):
            raise error
        self.error = error
        is_agents = found is not None or issubclass(type(error), OSError | MemoryError)
        found = found or Attribution("")
        outcome = Outcome.AGENT_ERROR if is_agents else Outcome.SIMULATOR_ERROR
        failure = failure_of(error, found.agent, cause=found.cause)
        self.result = TrialResult(self.spec, outcome, steps=self.steps, failure=failure)
        with suppress(BaseException):
            self._add(self.result)
        return self.result

    def _fail_at_once(self, error: BaseException) -> TrialResult:
        """End with an exception that has come through the core.

        Raises:
            RecorderError: the disk is full.
        """
        assert self._ahead is not None
        if self._ahead.cannot_record:
            return self._break(error)
        if not self._ahead.at_once.core.simulating:
            return self._fail(Outcome.AGENT_ERROR, error, self.names[0])
        return self._fail_in_simulator(error)
