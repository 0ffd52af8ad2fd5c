"""Agents that do not start are told once, instead of as so many trials that could not be set up."""

from __future__ import annotations

import re
from types import MappingProxyType
from typing import TYPE_CHECKING

from crashhunt.base.errors import ArgumentError, UsageError
from crashhunt.executors import LEFT_OUT
from crashhunt.trial import Constant, Outcome

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from crashhunt.executors import Executor
    from crashhunt.plans import HuntSettings
    from crashhunt.scenario import Scenario
    from crashhunt.trial import TrialResult

__all__ = ["Heard", "Preflight", "is_hopeless", "why_invalid"]

_INVALID_BEFORE_GIVING_UP = 10  # trials; if none of so many could begin, the setup is wrong, not the seed
_ENOUGH = 4
"""Trials; one that fails by chance would do so as often as this only rarely."""


class Preflight:
    """Holds back the first results of a hunt for as long as each says that the same agent failed to start, and how.

    It costs no time: these are the hunt's own first trials. Where an argument of the agent varies, another value of it
    may well do, and nothing is held back.

    Args:
        settings: of the hunt.
        planned: how many trials there are to be.
        files: of arguments that name files, to where the snapshot has them.
        code: folders of the snapshot from which agents are imported.
        listen: called before the first result is accounted for, as it may be refused why there are none.
    """

    def __init__(
        self, settings: HuntSettings, planned: int, *, files: Mapping[str, str] = MappingProxyType({}),
        code: Sequence[str] = (), listen: Callable[[], None] = lambda: None,
    ) -> None:  # fmt: skip
        self._settings = settings
        self._names = {there: here for here, there in files.items()} | {f"{folder}/": "" for folder in code}
        self._enough = min(_ENOUGH, planned)
        self._held: list[TrialResult] = []
        self._passed = False
        self._listen = listen

    def sift(self, result: TrialResult) -> list[TrialResult]:
        """Return what is to be accounted for now: nothing yet, or this result with those that were held back.

        Raises:
            ArgumentError: the agent does not start, whatever the trial.
        """
        if self._passed or not self._is_of_an_agent(result):
            if not self._passed:
                self._listen()
            self._passed = True
            found, self._held = [*self._held, result], []
            return found
        self._held.append(result)
        if len(self._held) >= self._enough:
            raise self._refusal(result)
        return []

    def _is_of_an_agent(self, result: TrialResult) -> bool:
        failure = result.failure
        if result.outcome is not Outcome.INVALID or failure is None or failure.agent not in self._settings.agents:
            return False
        first = self._held[0].failure if self._held else failure
        same = first is not None and (first.agent, first.kind, first.message) == (
            failure.agent,
            failure.kind,
            failure.message,
        )
        varied = any(
            agent == failure.agent and not isinstance(distribution, Constant)
            for (agent, _), distribution in self._settings.space.items()
        )
        return same and not varied

    def _refusal(self, result: TrialResult) -> ArgumentError:
        failure = result.failure
        assert failure is not None
        message, trace = self._as_asked(failure.message), self._as_asked(failure.traceback)
        kind = "" if failure.kind in ("ValueError", "invalid") else f"{failure.kind}: "
        given = result.spec.arguments.get(failure.agent, {})
        names = ", ".join(f"--arg {name}={value}" for name, value in given.items() if isinstance(value, str))
        places = re.findall(r'^  File "([^"]+)", line (\d+)', trace, re.MULTILINE)
        return ArgumentError(
            f"{self._settings.agents[failure.agent].agent} does not start: {kind}{message}",
            fix=f"mend {names or 'the agent'}",
            where=":".join(places[-1]) if kind and places else f"agent {failure.agent}",
        )

    def _as_asked(self, text: str) -> str:
        """The same with the names of files as they were given, instead of where the snapshot has them."""
        for there, here in self._names.items():
            text = text.replace(there, here)
        return text


class Heard:
    """What workers have to say, until it is written down; it is heard before that, as it may refuse the hunt.

    Args:
        settings: of the hunt.
        outcomes: of the trials that have ended, with how many.
    """

    def __init__(self, settings: HuntSettings, outcomes: Mapping[str, int]) -> None:
        self._settings = settings
        self._outcomes = outcomes
        self._notes: list[str] = []

    def hear(self, executor: Executor) -> None:
        """Ask the workers of an executor.

        Raises:
            UsageError: trials cannot be copied, as the first ones have shown after their first step. Once any has
                ended, the hunt goes on without copies.
        """
        for note in executor.notes():
            what, left_out, why = note.partition(LEFT_OUT)
            if left_out and what in ("probes", "branches") and not sum(self._outcomes.values()):
                raise self._refusal(why)
            self._notes.append(note)

    def take(self, executor: Executor) -> list[str]:
        """Return what has been said and was not taken before.

        Raises:
            UsageError: as of `hear`.
        """
        self.hear(executor)
        notes, self._notes = self._notes, []
        return notes

    def _refusal(self, why: str) -> UsageError:
        asked = (("--probe", self._settings.probe), ("--branch", self._settings.branch))
        flags = " and ".join(flag for flag, value in asked if value)
        agents = ", ".join(dict.fromkeys(chosen.agent for chosen in self._settings.agents.values()))
        fix = f"mend {agents}, or leave {flags} out"
        return UsageError(f"{flags}: trials with {agents} cannot be copied: {why}", fix=fix)


def is_hopeless(settings: HuntSettings, outcomes: Mapping[str, int]) -> bool:
    """Whether so many trials could not be set up, and none could, that no other will be.

    Args:
        settings: of the hunt.
        outcomes: of its trials, with how many.
    """
    enough = min(settings.most_trials, max(_INVALID_BEFORE_GIVING_UP, 2 * settings.run.parallel))
    invalid = outcomes.get(str(Outcome.INVALID), 0)
    return invalid >= enough and invalid == sum(outcomes.values())


def why_invalid(result: TrialResult, scenario: Scenario) -> str:
    """Return why a trial could not be set up, with what the simulator said about it last."""
    explained = scenario.backend.explained
    if explained is not None and result.failure is not None:
        error = explained(result.summary, result.failure.last_output, scenario)
        if error is not None:
            return str(error)
    said = result.failure.last_output.strip().splitlines() if result.failure else []
    last = next((line for line in reversed(said) if line.strip() and not line.startswith("Warning")), "")
    return f"{result.summary}\n  last output: {last}" if last else result.summary
