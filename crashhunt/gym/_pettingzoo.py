"""A parallel environment of PettingZoo, with many agents, as a Gymnasium environment with one learner."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Protocol, TypeGuard

import gymnasium
import numpy as np

from crashhunt.base.errors import ActionError, UnusableValueError
from crashhunt.base.foreign_code import members, supports, truth_of
from crashhunt.simulators import action_form

_STEP_PARTS = ("observations", "rewards", "terminations", "truncations", "infos")
_FIX = "return a bool for each agent"


class TakesTurns(Protocol):
    """The interface of a PettingZoo environment whose agents act one after the other."""

    def agent_iter(self) -> Iterator[Any]:
        """Yield the agents in their order."""


class Parallel(Protocol):
    """The interface of a PettingZoo environment whose agents act at the same time: its ``ParallelEnv``."""

    possible_agents: Sequence[Any]
    """All agents that may take part."""
    agents: Sequence[Any]
    """The agents that act in the next step."""

    def observation_space(self, agent: Any) -> Any:
        """Return the observation space of an agent."""

    def action_space(self, agent: Any) -> Any:
        """Return the action space of an agent."""

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
        """Begin an episode."""

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, Any]:
        """Let all agents act, and return the results of the step."""


def is_parallel(made: Any) -> TypeGuard[Parallel]:
    """Return whether an object has the interface of PettingZoo's ``ParallelEnv``, whose agents do not take turns."""
    # PettingZoo sets `agents` in `reset`. Its wrapper of environments that take turns has no such attribute before.
    needed = (getattr(made, name, None) for name in members(Parallel) if name != "agents")
    return all(found is not None for found in needed) and callable(made.observation_space) and not takes_turns(made)


def generates_agents(made: Any) -> bool:
    """Return whether only ``possible_agents`` is missing of the interface of PettingZoo's ``ParallelEnv``.

    PettingZoo omits this list if an environment generates its agents during an episode.
    """
    needed = (getattr(made, name, None) for name in members(Parallel) if name not in ("agents", "possible_agents"))
    return all(callable(found) for found in needed)


def takes_turns(made: Any) -> bool:
    """Return whether an object is a PettingZoo environment whose agents act one after the other."""
    return supports(made, TakesTurns)


class OneLearner(gymnasium.Env[Any, Any]):
    """Shows the environment as the learner sees it. The other agents act by a policy that the seed determines.

    An episode terminates when the learner terminates, or when the learner is no longer among the agents.

    Args:
        parallel: The environment, with the interface of PettingZoo's ``ParallelEnv``.
        learner: The agent that crashhunt tests, one of ``possible_agents``; empty for the first agent.
        policy: Function that returns the action of another agent, given its name, observation, action space and random
            generator. Without this function, the other agents act at random, within the mask of possible actions if the
            environment provides a mask.
        policy_name: The name of the function, for error messages.
    """

    def __init__(
        self, parallel: Any, learner: str = "", policy: Callable[..., object] | None = None, policy_name: str = ""
    ) -> None:
        agents = {str(name): name for name in parallel.possible_agents}
        self._parallel = parallel
        self._learner = agents[learner or next(iter(agents))]
        self._policy, self._policy_name = policy, policy_name
        self.observation_space = parallel.observation_space(self._learner)
        self.action_space = parallel.action_space(self._learner)
        self._seen: Mapping[Any, Any] = {}
        self._infos: Mapping[Any, Any] = {}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        self._seen, self._infos = self._parallel.reset(seed=seed, options=options)
        if self._learner not in self._seen:
            raise RuntimeError(f"the learner {self._learner!r} is missing in the first step of the environment")
        return self._seen[self._learner], dict(self._infos.get(self._learner, {}))

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Let all agents act, and return the learner's results of the step."""
        learner = self._learner
        actions = {
            name: action if name == learner else self._other_actions(name)
            for name in self._parallel.agents
            if name in self._seen
        }
        before = self._seen[learner]
        returned = self._parallel.step(actions)
        for part, name in zip(returned, _STEP_PARTS, strict=False):
            if not isinstance(part, Mapping):
                raise TypeError(f"step() returned {name} = {part!r:.80}, which is not a dictionary by agent")
        self._seen, rewards, ended, cut, self._infos = returned
        over = truth_of(ended.get(learner, True), f"terminations[{learner!r}]", _FIX)
        is_cut = truth_of(cut.get(learner, False), f"truncations[{learner!r}]", _FIX)
        gone = not over and not is_cut and learner not in self._parallel.agents
        if not (over or is_cut or gone):
            for part, name in ((self._seen, "observation"), (rewards, "reward")):
                if learner not in part:
                    raise TypeError(f"step() returned no {name} of the learner {learner!r}, which is among the agents")
        shown = self._seen.get(learner, before)
        info = dict(self._infos.get(learner, {}))
        return shown, rewards.get(learner, 0.0), over or gone, is_cut, info

    def render(self) -> Any:
        """Return what the environment renders."""
        return self._parallel.render()

    def close(self) -> None:
        """Close the environment."""
        self._parallel.close()

    def _other_actions(self, name: Any) -> object:
        seen, space = self._seen[name], self._parallel.action_space(name)
        mask = self._infos.get(name, {}).get("action_mask")
        if mask is None and isinstance(seen, dict):
            mask = seen.get("action_mask")
        if self._policy is None:
            return _random_action(space, self.np_random, mask)
        action = self._policy(str(name), seen, space, self.np_random)
        if not space.contains(action):
            try:
                action_form(space).encode(action)  # a check only: the environment receives what the function returned
            except ActionError as error:
                what = f"gym.others = {self._policy_name!r} returned for {str(name)!r}"
                raise UnusableValueError(f"{what}: {error.message}", fix=error.fix) from None
        return action


def _random_action(space: Any, rng: np.random.Generator, mask: Any = None) -> object:
    space.seed(int(rng.integers(2**31)))  # the space may be another object, or have been used before
    is_possible = mask is not None and np.any(mask)
    return space.sample(np.asarray(mask, np.int8)) if is_possible else space.sample()
