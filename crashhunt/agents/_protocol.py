"""The protocol of agents; a base class is not needed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from crashhunt.base.foreign_code import supports
from crashhunt.simulators import FlattensObservations, NamesMetaActions, NamesObservations

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from gymnasium import Space

    from crashhunt.simulators import Simulator
    from crashhunt.trial import CallSignature, Value


@runtime_checkable
class Agent(Protocol):
    """The protocol of an agent, which drives one vehicle.

    The user names the factory of an agent as ``package.module:attribute``. The factory is called with the agent's
    arguments as keywords, once per trial and vehicle. A parameter named ``observation_space`` or ``action_space``
    receives the Gymnasium space. A parameter named ``step_length_s`` receives the time from one step to the next, in s.
    A parameter named ``agent_id`` receives the identifier of the vehicle.
    A parameter named ``action_masks`` receives a function that returns which discrete actions are possible in the next
    step, or None if the environment has no masks. If the simulator knows no masks, the parameter receives None.

    Optional capabilities are separate protocols: `DrawsPanels` and `Closes`; `NeedsLibraries`, `PrefersAction` and
    `ReturnsActions` for the factory of an agent. An object has a capability if it has the methods or attributes of the
    protocol.
    """

    def reset(self, seed: int) -> None:
        """Begin an episode: delete all state, and draw random numbers only from ``seed``."""

    def act(self, observation: Any) -> Any:
        """Return an action inside the vehicle's action space.

        Args:
            observation: the observation, inside the observation space. No other code changes it afterwards.
        """


class ForeignFactory(Protocol):
    """Creates the agents of one locator that names no Python code, such as ``exec:./planner``."""

    def declared_signature(
        self, agent: str = "", simulator: Simulator | None = None, *, limit_s: float = 0.0
    ) -> CallSignature:
        """Return the arguments that the program, library or FMU declares.

        Args:
            agent: the vehicle that it drives.
            simulator: the simulator, which need not have been reset.
            limit_s: time in s for a program to answer; at least 60 s.

        Raises:
            PluginError: it cannot be used.
            ProgramError: it does not answer according to the protocol.
        """

    def agent(
        self, name: str, simulator: Simulator, arguments: Mapping[str, Value], *, folder: Path,
        files: Mapping[str, str], limit_s: float | None = None, is_forked: bool = False,
    ) -> Agent:  # fmt: skip
        """Return the agent of a vehicle, which begins in the first step.

        Args:
            name: identifier of the vehicle.
            simulator: the simulator, with the spaces of the vehicle.
            arguments: arguments of the agent.
            folder: scratch folder of the trial.
            files: file of the snapshot by the text that names the original file; empty if there is no snapshot.
            limit_s: time limit for the answer to each observation, in s; None if only that of the trial applies.
            is_forked: whether the trial is forked while it runs.

        Raises:
            PluginError: it cannot be used, or does not fit the spaces of the vehicle.
        """


def shown_space(simulator: Simulator, agent: str) -> tuple[Space[object], Sequence[str]]:
    """Return the space of a vehicle's observations as its agent receives them, and the names of their columns."""
    shown = simulator.shown_spaces if supports(simulator, FlattensObservations) else {}
    names = simulator.observation_names if supports(simulator, NamesObservations) else ()
    return shown.get(agent) or simulator.observation_spaces[agent], names


class DrawsPanels(Protocol):
    """An agent that shows its internal state."""

    def panels(self) -> object:
        """Return panels in nested mappings and sequences, whose keys are the labels of the panels.

        This method is called after `Agent.act`, only during rendering. Drawing panels must not change the agent's later
        actions.
        """


class Closes(Protocol):
    """An agent that holds resources."""

    def close(self) -> None:
        """Release all resources. This method is called once, at the end of the trial, for any outcome."""


class NeedsLibraries(Protocol):
    """A class or function that creates agents, and that needs libraries with a long import time."""

    @property
    def libraries(self) -> Sequence[str]:
        """Return the names of modules to import before the first trial. The agent reports a missing module."""


# How agents that think in speeds and lanes say so in discrete meta-actions.

SPEED_OR_META = ("speed_and_lane", "meta")
"""The forms of actions that `meta_actions` serves, for the attribute ``actions`` of an agent's class."""

_META_ACTIONS = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")
_FASTER, _SLOWER = 0.5, -0.75  # m/s²


def meta_actions(space: Space[object] | None) -> Mapping[str, int] | None:
    """Return the number of each meta-action by name; None if actions are (target speed, lane change).

    A meta-action that the space lacks, such as a lane change if only the speed is controlled, is replaced by IDLE.

    Args:
        space: action space of the vehicle. The names of its numbers are in its attribute ``meanings``, or those of
            highway-env if there are five.

    Raises:
        ValueError: the actions are neither meta-actions nor (target speed, lane change).
    """
    if space is None:
        return None
    from gymnasium.spaces import Box, Dict, Discrete, Tuple

    if isinstance(space, Dict):
        return None
    if isinstance(space, Tuple):
        first, *others = space.spaces
        if not (isinstance(first, Box) and (first.low < 0).any()) and not any(isinstance(one, Box) for one in others):
            return None  # an acceleration may be negative, and a lateral speed is not a choice
    meanings: Sequence[str] = ()
    if isinstance(space, Discrete):
        meanings = (
            space.meanings
            if supports(space, NamesMetaActions)
            else _META_ACTIONS
            if space.n == len(_META_ACTIONS)
            else ()
        )
    numbers = {name: number for number, name in enumerate(meanings)}
    if "IDLE" not in numbers:
        raise ValueError(
            "the agent can only choose actions (target speed, lane change) or meta-actions, not actions of the space "
            f"{space}"
        )
    return {name: numbers.get(name, numbers["IDLE"]) for name in _META_ACTIONS}


def wanted_meta_action(acceleration: float, change: int = 0) -> str:
    """Return the name of the meta-action for an acceleration, in m/s², and a lane change (1 is to the left)."""
    if change:
        return "LANE_LEFT" if change > 0 else "LANE_RIGHT"
    return "FASTER" if acceleration > _FASTER else "SLOWER" if acceleration < _SLOWER else "IDLE"
