"""Check of a crash's last avoidable step, by repeating its recorded actions and braking after a step."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from crashhunt.base.foreign_code import supports
from crashhunt.crashes import partner
from crashhunt.recording import read_log
from crashhunt.replays import ReplayOptions, prepare
from crashhunt.simulators import NamesMetaActions
from crashhunt.trial_reruns import run_alone

if TYPE_CHECKING:
    from crashhunt.crashes import Bundle
    from crashhunt.replays import Rerun

_NEVER = 10**9  # a step that no episode reaches
_AFTERWARDS_S = 10.0  # longer than what is checked looks


@dataclass(frozen=True, slots=True)
class EscapeCheck:
    """The result of checking the last avoidable step of a crash.

    Args:
        crash: id of the crash.
        step: the last avoidable step, as recorded in the crash.
        too_late: the step after which braking does not avoid the crash, as recorded in the crash.
        avoided: whether braking after ``step`` avoided the collision; None if the crash has no such step.
        avoided_later: whether braking after ``too_late`` avoided the collision.
    """

    crash: str
    step: int | None = None
    too_late: int | None = None
    avoided: bool | None = None
    avoided_later: bool | None = None

    @property
    def verdict(self) -> Literal["right", "silent", "wrong"]:
        """Return the verdict of the check as text."""
        if self.step is None and self.too_late is None:
            return "silent"
        return "wrong" if self.avoided is False or self.avoided_later else "right"


class RecordedThenBrakes:
    """Agent that repeats recorded actions up to a step, and then brakes: target speed 0, or SLOWER.

    Args:
        log: path of a ``log.mcap``.
        agent: identifier of the agent whose actions are repeated.
        after: the step after which the agent brakes. If the agent is not overruled and the log has no further action,
            the last action is repeated.
        action_space: action space of the vehicle.
    """

    def __init__(self, log: str, agent: str, after: int, action_space: Any) -> None:
        self._actions = read_log(Path(log)).actions(agent)
        self._after = after
        meta = supports(action_space, NamesMetaActions)
        self._brake: object = tuple(action_space.meanings).index("SLOWER") if meta else (0.0, 0)
        self._step = 0

    def reset(self, seed: int) -> None:
        """Start again at the first recorded action."""
        self._step = 0

    def act(self, observation: object) -> object:
        """Return the next recorded action, or the braking action."""
        step, self._step = self._step, self._step + 1
        return self._brake if step >= self._after else self._actions[min(step, len(self._actions) - 1)]


def check_escape(bundle: Bundle) -> EscapeCheck:
    """Check the last avoidable step of a crash by runs, each in a new process.

    The check is independent of the hunt's own search, and runs no code of the agents.
    """
    said = bundle.result.escape
    if said is None:
        return EscapeCheck(bundle.id)
    rerun = prepare(bundle, ReplayOptions(code="log"))
    avoided, later = (
        None if step is None else _avoids(rerun, step, _AFTERWARDS_S) for step in (said.step, said.too_late)
    )
    return EscapeCheck(crash=bundle.id, step=said.step, too_late=said.too_late, avoided=avoided, avoided_later=later)


def _avoids(rerun: Rerun, after: int, afterwards_s: float) -> bool:
    scenario = rerun.worker.scenario
    name = f"{__name__}:{RecordedThenBrakes.__name__}"
    arguments = {
        agent: {**given, "after": after if agent == rerun.bundle.driver else _NEVER}
        for agent, given in rerun.spec.arguments.items()
    }
    steps = rerun.recorded.steps + round(afterwards_s / rerun.recorded.prologue.step_length_s)
    worker = replace(rerun.worker, scenario=scenario.with_agents(dict.fromkeys(scenario.agents, name)))
    (ended,) = run_alone(worker, replace(rerun.spec, arguments=arguments, max_steps=steps))
    result = ended.result
    other = partner(rerun.bundle.result)
    return partner(result) != other or result.collision is None or result.collision.agent != rerun.bundle.driver
