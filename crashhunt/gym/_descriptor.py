"""Descriptor of Gymnasium environments: the table of a scenario, and its consequences.

The descriptor does not import Gymnasium.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

from crashhunt.base.errors import ScenarioError
from crashhunt.scenario import Backend

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from crashhunt.scenario import Scenario
    from crashhunt.trial import Value


@dataclass(frozen=True, kw_only=True)
class CrashRule:
    """The table ``[gym.crash]``: the rules by which a step of a Gymnasium environment is a crash; one match suffices.

    Args:
        info: a key of ``info`` whose true value means a crash.
        termination: whether the termination of the environment is a crash; truncation is no crash.
        reward_below: a step whose reward is below this value is a crash.
        function: your function, as ``module:function``, called with observation, reward, terminated, truncated, info. A
            true result means a crash; a text as the result describes the crash.
        kind: your function, as ``module:function``, called with the same values for the step of a crash; it returns the
            crash type as text. Without this function, ``info["crash_kind"]`` is the crash type if the value is a text.
    """

    info: str = ""
    termination: bool = False
    reward_below: float | None = None
    function: str = ""
    kind: str = ""


@dataclass(frozen=True, kw_only=True)
class GymSetup:
    """The table ``[gym]``: any Gymnasium environment.

    Args:
        id: id for `gymnasium.make`, or ``module:factory``, which is called with ``kwargs``.
        kwargs: keyword arguments of the environment.
        reset_options: the table ``options`` that the environment's ``reset`` receives in each trial. An argument with
            ``option = "reset_options.NAME"`` sets its entry NAME. Without this key, ``reset`` receives no options.
        crash: rules that define a crash.
        time_limit: ``registered`` keeps the ``max_episode_steps`` with which the id is registered, or that ``kwargs``
            sets; ``none`` lifts the limit, so that only MAX_STEPS limits an episode.
        learner: name of the tested agent in a parallel environment of PettingZoo; empty for the first agent.
        others: for a parallel environment, ``module:function``, which is called with name, observation, action space
            and random generator of each other agent and returns its action. If the text is empty, the other agents act
            at random.
        danger: the criticality of a step without a scene. ``info.KEY`` is a number of the info from 0 to 1.
            ``-info.KEY`` is a number x that falls with criticality, such as a distance, and gives 1 / (1 + x). A trial
            has the greatest value of its steps. The key is empty if the criticality is unknown.
    """

    id: str
    kwargs: dict[str, object] = field(default_factory=dict)
    reset_options: dict[str, object] | None = None
    crash: CrashRule = field(default_factory=CrashRule)
    danger: str = ""
    time_limit: Literal["registered", "none"] = "registered"
    learner: str = ""
    others: str = ""


def _check(scenario: Scenario, where: str) -> None:
    if len(scenario.agents) != 1:
        message = f"agents = {sorted(scenario.agents)!r} are several agents, but a Gymnasium environment has one"
        raise ScenarioError(message, fix="keep one agent", where=where)
    if scenario.observation is not None:
        message = "the table [observation] cannot be used with a Gymnasium environment, which defines its observations"
        raise ScenarioError(message, fix="remove the table", where=where)

    danger = scenario.table(GymSetup).danger
    if danger and not re.fullmatch(r"-?info\..+", danger):
        fix = "write info.KEY for a number that grows with the danger, or -info.KEY for a number that falls with it"
        raise ScenarioError(f"gym.danger = {danger!r} is not of the form info.KEY or -info.KEY", fix=fix, where=where)


def _notes(scenario: Scenario) -> Iterator[str]:
    setup = scenario.table(GymSetup)
    if setup.time_limit == "none" or setup.kwargs.get("max_episode_steps") == -1:
        yield f"the time limit with which {setup.id!r} is registered is lifted, so only MAX_STEPS limits an episode"
    if replace(setup.crash, kind="") == CrashRule() and not scenario.requirement:
        yield "gym.crash has no rule, so only failures of the agent and of the environment are crashes"


def _modules(scenario: Scenario) -> Iterable[str]:
    setup = scenario.table(GymSetup)
    return setup.id, setup.crash.function, setup.crash.kind, setup.others


def _side_effect(scenario: Scenario, values: Mapping[str, Value], _specifications: Iterable[str]) -> str:
    # What an environment does with its keywords, only its own code can tell.
    setup = scenario.table(GymSetup)
    given = setup.kwargs or setup.reset_options or scenario.arguments or values
    return "it gives its environment arguments" if given else ""


BACKEND: Backend = Backend(
    title="Gymnasium",
    table=GymSetup,
    example="the id of the environment",
    keys=frozenset(),
    shows_itself=True,
    check=_check,
    modules=_modules,
    notes=_notes,
    versions=("gymnasium",),
    reported_events=(),
    disturbances=(),
    signal_arguments=lambda scenario: scenario.arguments,
    side_effect=_side_effect,
    shows_actors=False,
)
