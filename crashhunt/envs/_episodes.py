"""What is behind the Gymnasium environment: the simulation of SUMO, the crash rules and the picture."""

from __future__ import annotations

import tempfile
from collections import deque
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from crashhunt.agents import KeepLaneWithSpeed
from crashhunt.base.errors import UsageError
from crashhunt.base.names import one_of
from crashhunt.oracles import OffRoad, Overlap, ReportedCollision, merge_findings
from crashhunt.scenario import argument_values, load_scenario, with_action
from crashhunt.simulators.sumo import SumoSimulator

if TYPE_CHECKING:
    from collections.abc import Mapping

    from gymnasium import Space
    from numpy.typing import NDArray

    from crashhunt.agents import Agent
    from crashhunt.world import Scene

__all__ = ["Episodes"]

_SIZE = (960, 540)  # of the picture, in pixels
_TRAIL_S = 4.0  # of where the agent has been


class Episodes:
    """Episodes of one controlled vehicle; those of others keep their lane.

    Args:
        scenario: a shipped name, or a path.
        agent: the controlled vehicle; the scenario's first where empty.
        action: ``continuous``, ``meta``, or empty for the scenario's own choice.

    Attributes:
        observation_space: of the vehicle.
        action_space: of the vehicle.
        step_length_s: simulation time of a step, in s.
        agent: the controlled vehicle.

    Raises:
        CrashhuntError: the scenario or the agent does not exist.
    """

    def __init__(self, scenario: str | Path, agent: str, action: str) -> None:
        chosen = load_scenario(scenario)
        if agent and agent not in chosen.agents:
            raise UsageError(f"there is no controlled vehicle {agent!r}", fix=one_of(agent, chosen.agents))
        self.agent = agent or next(iter(chosen.agents))
        if action:
            chosen = with_action(chosen, self.agent, action)
        self._arguments = argument_values(chosen)
        self._stage = tempfile.TemporaryDirectory(prefix="crashhunt-")
        self._simulator = SumoSimulator(chosen, Path(self._stage.name))
        self._form = self._simulator.actions[self.agent]
        self._oracles = (ReportedCollision(), Overlap(), OffRoad())
        self._others: dict[str, Agent] = {
            other: KeepLaneWithSpeed(10.0, self._simulator.actions[other].space)
            for other in chosen.agents
            if other != self.agent
        }
        self.observation_space: Space[Any] = self._simulator.observation_spaces[self.agent]
        self.action_space: Space[Any] = self._form.space
        self.step_length_s = self._simulator.step_length_s
        self._scenes: deque[Scene] = deque(maxlen=round(_TRAIL_S / self.step_length_s) + 1)
        self._steps = 0
        self._crash_step = -1
        self._borders: Any = None

    def reset(self, seed: int, arguments: Mapping[str, Any]) -> tuple[NDArray[Any], dict[str, Any]]:
        """Begin an episode; return the observation and the info."""
        given = {**self._arguments, **arguments}
        self._observations, _ = self._simulator.reset(seed=seed, options={"arguments": given})
        self._steps, self._crash_step, self._borders = 0, -1, None
        self._scenes.clear()
        self._scenes.append(self._simulator.scene())
        return self._observations[self.agent], {"sim_time_s": self._simulator.scene().time_s}

    def step(self, action: Any) -> tuple[NDArray[Any], float, bool, dict[str, Any]]:
        """Advance one control step; return observation, reward, whether it has ended, and the info."""
        actions = {self.agent: self._form.encode(action)}
        for other, driver in self._others.items():
            if other in self._simulator.agents:
                actions[other] = self._simulator.actions[other].encode(driver.act(self._observations[other]))
        before = self._simulator.scene()
        self._observations, rewards, terminations, _, _ = self._simulator.step(actions)
        scene = self._simulator.scene()
        scene.follow(before)
        self._scenes.append(scene)
        self._steps += 1
        finding = merge_findings([found for oracle in self._oracles for found in oracle.check(scene, (self.agent,))])
        if finding is not None:
            self._crash_step = self._steps
        terminated = terminations[self.agent] or finding is not None
        info: dict[str, Any] = {"sim_time_s": scene.time_s}
        if scene.events:
            info["events"] = [f"{event.kind}: {event.what}" for event in scene.events]
        if terminated:
            info["outcome"] = str(finding.outcome) if finding is not None else "finished"
        return self._observations[self.agent], rewards[self.agent], terminated, info

    def picture(self) -> NDArray[Any]:
        """Return the scene from above, uint8, shape (540, 960, 3)."""
        from crashhunt.recording import lane_borders
        from crashhunt.render import SceneView

        if self._borders is None:
            self._borders = lane_borders(self._simulator.lanes())
        first = self._steps - len(self._scenes) + 1
        seen = SimpleNamespace(
            agents=(self.agent, *self._others),
            actors=self._scenes[-1].roster.actors,
            prologue=SimpleNamespace(step_length_s=self.step_length_s),
            # A trail that is longer than what is remembered ends there.
            scene=lambda step: self._scenes[max(0, step - first)],
        )
        view: Any = SceneView
        width, height = _SIZE
        drawn: NDArray[Any] = view(
            seen, self._borders, agent=self.agent, width=width, height=height, crash_step=self._crash_step
        ).draw(self._steps)
        return drawn

    def close(self) -> None:
        """End the simulation and remove its files."""
        self._simulator.close()
        self._stage.cleanup()
