"""The simulator protocol: Gymnasium's vocabulary, keyed by agent as in PettingZoo's parallel API."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy as np
    from gymnasium import Space

    from crashhunt.world import Scene

__all__ = ["ActionForm", "FullBraking", "Observations", "Simulator", "StepResult"]

Observations = dict[str, NDArray[Any]]
StepResult = tuple[Observations, dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]


@dataclass(frozen=True, slots=True)
class FullBraking:
    """How a vehicle brakes as hard as it can without leaving its lane.

    Args:
        action: what the agent answers, in every step.
        how: in words that follow "Braking …".
        deceleration: what that amounts to, in m/s², where the simulator says so.
    """

    action: Any
    how: str
    deceleration: float | None = None


class ActionForm(Protocol):
    """How the actions of one agent are written."""

    @property
    def space(self) -> Space[Any]:
        """The Gymnasium space."""

    @property
    def names(self) -> tuple[str, ...]:
        """What the elements of an encoded action are."""

    def encode(self, action: object) -> NDArray[np.generic]:
        """Return the action as an array of fixed shape and type; an encoded action is encoded to itself.

        Raises:
            ActionError: it is not inside the space.
        """


class Simulator(Protocol):
    """Runs one episode after another.

    Contract: between two calls of `reset` with equal arguments, everything that any method returns is equal to the
    bit, in this process and in another, whatever ran before. All arrays that are handed out stay as they are.
    A simulator that wants people to know something about what it runs offers ``notices``, lines of text; a hunt tells
    each once. One whose observations are structured hands out flattened arrays, and offers ``shown_spaces``: for each
    such agent the Dict or Tuple space into which its observations are unflattened before the agent is shown them.
    One that looks for traffic events offers ``told_events``, their kinds, and puts them into its scenes.
    A simulator that has a map offers ``lanes() -> Sequence[Lane]`` as well, callable after the first `reset`. One that
    has a window of its own offers ``open_window()``, called before the first `reset`, ``follow(agent, other)``, which
    marks the two and keeps the agent in view, and ``window_open``; none of them changes what is simulated. One that
    knows how a vehicle brakes as hard as it can offers ``full_braking(agent) -> FullBraking | None``, callable after
    `reset`: with it, a hunt finds out until when a crash could have been avoided.
    """

    @property
    def agents(self) -> Sequence[str]:
        """The agents that act in the next step; those that have terminated are gone."""

    @property
    def observation_spaces(self) -> Mapping[str, Space[Any]]:
        """For every possible agent."""

    @property
    def actions(self) -> Mapping[str, ActionForm]:
        """For every possible agent."""

    @property
    def step_length_s(self) -> float:
        """Simulation time between two steps, in s."""

    def reset(self, *, seed: int, options: Mapping[str, Any] | None = None) -> tuple[Observations, dict[str, Any]]:
        """Begin an episode; return the first observation of every agent, and infos.

        Args:
            seed: of everything random.
            options: ``{"arguments": {name: value}}``, the scenario arguments.

        Raises:
            InvalidEpisodeError: it cannot be set up.
        """

    def step(self, actions: Mapping[str, NDArray[np.generic]]) -> StepResult:
        """Advance one control step.

        Args:
            actions: of every agent in `agents`, as ``actions[agent].encode`` returned it.

        Returns:
            Observations, rewards, terminations, truncations and infos of the agents that acted. An agent is
            terminated when it has arrived or crashed; a simulator never truncates on its own account of time.

        Raises:
            SimulatorError: the simulator gave up.
        """

    def scene(self) -> Scene:
        """Return the state of all actors after the last `reset` or `step`."""

    def close(self) -> None:
        """Let go of everything. May be called twice."""
