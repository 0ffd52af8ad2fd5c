"""The episodes of the Gymnasium environment on SUMO: observation, reward, termination and rendered picture."""

from __future__ import annotations

import math
import sys
from collections import deque
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from crashhunt.agents import KeepLaneWithSpeed
from crashhunt.base.errors import ArgumentError, SimulatorError, UsageError
from crashhunt.base.temporary import TemporaryFolder
from crashhunt.base.text import one_of
from crashhunt.episode import Episode, Observer
from crashhunt.oracles import OffRoad, Overlap, ReportedCollision, merge_findings
from crashhunt.plans import disturber
from crashhunt.scenario import (
    argument_values,
    load_scenario,
    with_action,
    with_observations,
    with_whole_vehicles_visible,
)
from crashhunt.simulators import parse_parts
from crashhunt.sumo import SumoSimulator
from crashhunt.trial import TrialSpec

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from gymnasium import Space
    from numpy.typing import NDArray

    from crashhunt.disturbances import DisturbanceSampler
    from crashhunt.episode import ObservedEpisode
    from crashhunt.scenario import Scenario
    from crashhunt.simulators import Simulator
    from crashhunt.trial import Disturbance, Kind, Value
    from crashhunt.world import Scene

_PICTURE_PIXELS = (960, 540)  # width and height of the picture, in pixels
_TRAIL_S = 4.0  # how long the picture shows the agent's past path, in s
_ASSUMED_SPEED_MPS = 10.0  # m/s
_ALLOWED: Final[dict[Kind | None, tuple[tuple[type, ...], str]]] = {
    "bool": ((bool,), "True or False"),
    "int": ((int,), "a whole number"),
    "float": ((int, float), "a finite number"),
    "str": ((str,), "text"),
    None: ((bool, int, float, str), "a finite number or text"),
}
"""The types that the values of an argument may have, and their description, for each kind of argument."""


class Episodes:
    """Episodes of one controlled vehicle. The scenario's other agents keep lane and speed.

    Args:
        scenario: Name of a shipped scenario, or a path.
        agent: The controlled vehicle; if empty, the first agent of the scenario.
        action: The form of the actions, as ``crashhunt list actions`` names it; empty for the scenario's own choice.
        disturb: Rates of disturbances, such as ``brake=0.02``.
        max_steps: Maximum number of steps of an episode; 0 for no limit. Disturbances need a limit.
        observation: The parts that the vehicle observes; empty for the scenario's own choice.

    Attributes:
        observation_space: The observation space of the vehicle.
        action_space: The action space of the vehicle.
        step_length_s: Simulation time of a step, in s.
        agent: The controlled vehicle.

    Raises:
        CrashhuntError: The scenario, the agent or a disturbance does not exist, or disturbances lack a limit.
    """

    def __init__(
        self,
        scenario: str | Path,
        agent: str,
        action: str,
        disturb: Sequence[str] = (),
        max_steps: int = 0,
        observation: Sequence[str] = (),
    ) -> None:
        chosen = load_scenario(scenario)
        if agent and agent not in chosen.agents:
            raise UsageError(f"there is no controlled vehicle {agent!r}", fix=one_of(agent, chosen.agents))
        self.agent = agent or next(iter(chosen.agents))
        if action:
            chosen = with_action(chosen, self.agent, action)
        chosen = with_whole_vehicles_visible(chosen)
        if observation:
            parse_parts(observation, chosen.backend.observations, where="observation")
            chosen = with_observations(chosen, {self.agent: tuple(observation)})
        self._arguments, self._known = argument_values(chosen), chosen.scenario_arguments()
        self._disturber = _disturber(chosen, self.agent, disturb, max_steps)
        self._stage = TemporaryFolder("environment")
        self._simulator = SumoSimulator(chosen, self._stage.path)
        self._form = self._simulator.actions[self.agent]
        self._max_steps = max_steps
        self._oracles = (ReportedCollision(), Overlap(), OffRoad())
        self._episode: Episode | None = None
        self._is_closed = False
        layout = self._simulator.observation_layouts.get(self.agent)
        self._restore: Callable[[NDArray[np.generic]], Any] = layout.restore if layout else lambda array: array
        self.observation_space: Space[object] = (
            layout.space if layout else self._simulator.observation_spaces[self.agent]
        )
        self.action_space: Space[object] = self._form.space
        self.step_length_s = self._simulator.step_length_s
        self._trail = _Trail(round(_TRAIL_S / self.step_length_s) + 1)
        self._crash_step = -1
        self._borders: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]] | None = None

    def reset(self, seed: int, arguments: Mapping[str, Value]) -> tuple[Any, dict[str, object]]:
        """Begin an episode; return the observation and the info.

        Raises:
            ArgumentError: the scenario has no argument of that name, or the argument cannot have that value.
            SimulatorError: the environment has been closed, or SUMO could not set up the episode.
        """
        self._require_open()
        checked = {name: self._checked(name, value) for name, value in arguments.items()}
        if self._episode is not None:
            self._episode.close()
        given: dict[str, Value] = {**self._arguments, **checked}
        disturbances = self._disturber.draw(seed, self._max_steps) if self._disturber is not None else ()
        # The caller of the environment decides when an episode ends.
        spec = TrialSpec(
            number=0,
            seed=seed,
            arguments={},
            scenario_arguments=given,
            max_steps=sys.maxsize,
            disturbances=disturbances,
        )
        self._episode = Episode(spec, simulator=self._simulator, make_agent=self._make_agent, observers=(self._trail,))
        self._episode.start()
        _raise_error(self._episode)
        self._crash_step, self._borders = -1, None
        info: dict[str, object] = {"sim_time_s": self._trail.scenes[-1].time_s}
        if self._trail.disturbances:
            info["disturbances"] = [disturbance.words for disturbance in self._trail.disturbances]
        return self._restore(self._episode.observations[self.agent]), info | self._identifiers()

    def step(self, action: object) -> tuple[Any, float, bool, dict[str, object]]:
        """Advance one control step; return observation, reward, whether the episode has ended, and the info."""
        self._require_open()
        encoded = self._form.encode(action)  # a wrong action is an error of the caller, so it does not end the episode
        episode = self._episode
        if episode is None:
            raise SimulatorError("no episode has begun", fix="call reset")
        _raise_error(episode)
        if episode.result is not None or self.agent not in self._simulator.agents:
            raise SimulatorError("the episode has ended", fix="call reset")
        before = len(self._trail.disturbances)
        episode.step({self.agent: encoded})
        _raise_error(episode)
        scene = self._trail.scenes[-1]
        finding = merge_findings([found for oracle in self._oracles for found in oracle.check(scene, (self.agent,))])
        if finding is not None:
            self._crash_step = episode.steps
        terminated = episode.terminations[self.agent] or finding is not None
        info: dict[str, object] = {"sim_time_s": scene.time_s}
        if scene.events:
            info["events"] = [f"{event.kind}: {event.what}" for event in scene.events]
        if len(self._trail.disturbances) > before:
            info["disturbances"] = [disturbance.words for disturbance in self._trail.disturbances[before:]]
        if terminated:
            info["outcome"] = str(finding.outcome) if finding is not None else "finished"
        info |= self._identifiers()
        return self._restore(episode.observations[self.agent]), episode.rewards[self.agent], terminated, info

    def _identifiers(self) -> dict[str, object]:
        """Return the entry of the info with the identifiers of the actors in the rows of ``actors``."""
        found = self._simulator.identifiers(self.agent) if self._simulator.observation_layouts else None
        return {} if found is None else {"actors": found}

    def require_branch(self, *, reseeded: bool) -> None:
        """Check that copies of the running episode are possible.

        Raises:
            SimulatorError: no episode is running.
            UsageError: the copies are to be re-seeded, but the simulator does not support re-seeding.
        """
        if self._episode is None or self._episode.result is not None or self.agent not in self._simulator.agents:
            raise SimulatorError("no episode is running, so there is nothing to branch", fix="call reset")
        _raise_error(self._episode)
        if reseeded and self._simulator.why_no_reseeding:
            raise UsageError(f"branch cannot re-seed: {self._simulator.why_no_reseeding}", fix="omit seed")

    def reseed(self, seed: int) -> None:
        """Give SUMO's random generators another seed from the next step on."""
        assert self._episode is not None
        self._episode.reseed(seed)

    def picture(self) -> NDArray[np.generic]:
        """Return the scene from above, uint8, shape (540, 960, 3)."""
        self._require_open()
        from crashhunt.recording import lane_borders
        from crashhunt.render import SceneView

        if self._borders is None:
            self._borders = lane_borders(self._simulator.lanes())
        scenes, steps = self._trail.scenes, self._episode.steps if self._episode is not None else 0
        first = steps - len(scenes) + 1
        seen = SimpleNamespace(
            agents=(self.agent, *(other for other in self._simulator.actions if other != self.agent)),
            actors=scenes[-1].roster.actors,
            prologue=SimpleNamespace(step_length_s=self.step_length_s),
            disturbances=tuple(self._trail.disturbances),
            # Steps before the first remembered scene show that scene.
            scene=lambda step: scenes[max(0, step - first)],
        )
        view: Any = SceneView
        width, height = _PICTURE_PIXELS
        drawn: NDArray[np.generic] = view(
            seen, self._borders, agent=self.agent, width=width, height=height, crash_step=self._crash_step
        ).draw(steps)
        return drawn

    def close(self) -> None:
        """End the simulation and remove its files."""
        if self._episode is not None:
            self._episode.close()
        self._simulator.close()
        self._stage.remove()
        self._is_closed = True

    def _make_agent(self, agent: str, simulator: Simulator, _arguments: Mapping[str, Value]) -> KeepLaneWithSpeed:
        """Return the agent of a vehicle; the caller chooses the actions of the environment's own vehicle."""
        return KeepLaneWithSpeed(_ASSUMED_SPEED_MPS, None if agent == self.agent else simulator.actions[agent].space)

    def _require_open(self) -> None:
        if self._is_closed:
            raise SimulatorError("the environment has been closed", fix="make a new environment")

    def _checked(self, name: str, value: object) -> Value:
        """Return the value of a scenario argument, after its name and type have been checked."""
        if name not in self._known:
            raise ArgumentError(
                f"options: the scenario has no argument {name!r}", fix=one_of(str(name), self._known, give="it has")
            )
        types, form = _ALLOWED[self._known[name].kind]
        found = value.item() if isinstance(value, np.generic) else value
        # For Python, a bool is a number, too.
        fits = isinstance(found, types) and not (isinstance(found, bool) and bool not in types)
        if not fits or not isinstance(found, bool | int | float | str) or not _is_finite(found):
            raise ArgumentError(f"options: {name} is {value!r}", fix=f"give {form}")
        return found


class _Trail(Observer):
    """Stores the last scenes for the picture, and the disturbances of the episode."""

    def __init__(self, length: int) -> None:
        self.scenes: deque[Scene] = deque(maxlen=length)
        self.disturbances: list[Disturbance] = []

    def begin(self, episode: ObservedEpisode) -> None:
        self.disturbances.clear()

    def disturbance(self, disturbance: Disturbance) -> None:
        if disturbance.vehicle:  # empty if no vehicle was at the place
            self.disturbances.append(disturbance)

    def scene(self, step: int, scene: Scene, rewards: tuple[float, ...]) -> None:
        if step == 0:
            self.scenes.clear()
        self.scenes.append(scene)


def _disturber(scenario: Scenario, agent: str, disturb: Sequence[str], max_steps: int) -> DisturbanceSampler | None:
    made = disturber(scenario, disturb, (agent,))
    if made is not None and max_steps < 1:
        raise UsageError("disturb needs a limit on the length of an episode", fix="give max_steps")
    return made


def _is_finite(value: Value) -> bool:
    return not isinstance(value, float) or math.isfinite(value)


def _raise_error(episode: Episode) -> None:
    if episode.error is not None:
        raise episode.error
