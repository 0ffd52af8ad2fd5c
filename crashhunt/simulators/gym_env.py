"""SUMO as a Gymnasium environment: one controlled vehicle, for whoever trains or tries an agent."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium

from crashhunt._names import one_of
from crashhunt.agents import KeepLaneWithSpeed
from crashhunt.errors import UsageError
from crashhunt.oracles import OffRoad, Overlap, ReportedCollision, merge_findings
from crashhunt.scenario import argument_values, load_scenario, with_action
from crashhunt.simulators.sumo import SumoSimulator

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.agents import Agent

__all__ = ["SumoEnv"]


class SumoEnv(gymnasium.Env[Any, Any]):
    """``gymnasium.make("crashhunt:crashhunt/SUMO-v0")``.

    The observation has the layout of highway-env's Kinematics: float32, shape (vehicles, features). The reward is the
    distance driven in a step, in m. An episode is terminated by arrival and by a crash, and ``info["outcome"]`` says
    which; it is truncated after ``max_steps``. libsumo is one simulation per process: of several environments, only
    the one that was reset last can step.

    Args:
        scenario: a shipped name, or a path.
        agent: the controlled vehicle; the scenario's first by default. The others keep their lane.
        action: ``continuous`` is (target speed in m/s, lane change), ``meta`` highway-env's DiscreteMetaAction; the
            scenario's own choice by default.
        max_steps: None for no bound.
        render_mode: None; a recording is looked at elsewhere.

    Raises:
        CrashhuntError: the scenario or the agent does not exist.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 - Gymnasium's base class declares it so

    def __init__(
        self,
        scenario: str | Path = "loop",
        *,
        agent: str = "",
        action: str = "",
        max_steps: int | None = None,
        render_mode: str | None = None,
    ) -> None:
        chosen = load_scenario(scenario)
        if agent and agent not in chosen.agents:
            raise UsageError(f"there is no controlled vehicle {agent!r}", fix=one_of(agent, chosen.agents))
        self.agent = agent or next(iter(chosen.agents))
        if action:
            chosen = with_action(chosen, self.agent, action)
        self._arguments = argument_values(chosen)
        self._max_steps = max_steps
        self._stage = tempfile.TemporaryDirectory(prefix="crashhunt-")
        self._simulator = SumoSimulator(chosen, Path(self._stage.name))
        self._form = self._simulator.actions[self.agent]
        self._oracles = (ReportedCollision(), Overlap(), OffRoad())
        self._others: dict[str, Agent] = {
            other: KeepLaneWithSpeed(10.0, self._simulator.actions[other].space)
            for other in chosen.agents
            if other != self.agent
        }
        self.observation_space = self._simulator.observation_spaces[self.agent]
        self.action_space = self._form.space
        self.render_mode = render_mode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: of this episode and, through the environment's generator, of those that follow.
            options: ``{"arguments": {name: value}}``, scenario arguments that differ from their defaults.
        """
        super().reset(seed=seed)
        arguments = {**self._arguments, **(options or {}).get("arguments", {})}
        drawn = int(self.np_random.integers(2**31))
        self._observations, _ = self._simulator.reset(seed=drawn, options={"arguments": arguments})
        self._steps = 0
        return self._observations[self.agent], {"sim_time_s": self._simulator.scene().time_s}

    def step(self, action: Any) -> tuple[NDArray[Any], float, bool, bool, dict[str, Any]]:
        """Advance one control step.

        Raises:
            ActionError: the action is not in the space.
            SimulatorError: SUMO gave up, or another environment of this process was reset meanwhile.
        """
        actions = {self.agent: self._form.encode(action)}
        for other, driver in self._others.items():
            if other in self._simulator.agents:
                actions[other] = self._simulator.actions[other].encode(driver.act(self._observations[other]))
        before = self._simulator.scene()
        self._observations, rewards, terminations, _, _ = self._simulator.step(actions)
        scene = self._simulator.scene()
        scene.follow(before)
        self._steps += 1
        finding = merge_findings([found for oracle in self._oracles for found in oracle.check(scene, (self.agent,))])
        terminated = terminations[self.agent] or finding is not None
        truncated = not terminated and self._max_steps is not None and self._steps >= self._max_steps
        info: dict[str, Any] = {"sim_time_s": scene.time_s}
        if terminated:
            info["outcome"] = str(finding.outcome) if finding is not None else "finished"
        return self._observations[self.agent], rewards[self.agent], terminated, truncated, info

    def close(self) -> None:
        """End the simulation and remove its files."""
        self._simulator.close()
        self._stage.cleanup()
