"""The toy simulator: controlled vehicles in a row on one straight lane, behind a leader that brakes at random.

The toy replaces simulators in tests, and is the shortest example of the protocol. The toy is pure Python, needs
microseconds per step, and can fail on purpose in every way in which a simulator can fail.
"""

from __future__ import annotations

import ctypes
import os
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from crashhunt.base.errors import InvalidEpisodeError, SimulatorError
from crashhunt.scenario import ObservationSetup
from crashhunt.simulators._actions import META_ACTIONS, MetaAction, SpeedAndLaneChange
from crashhunt.simulators._kinematics_observation import Kinematics, Unseen
from crashhunt.simulators._protocol import FullBraking
from crashhunt.simulators._scene_observation import LanePlace, SceneObserver
from crashhunt.world import Actor, Contact, Lane, Roster, Scene

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from crashhunt.scenario import Scenario
    from crashhunt.simulators._protocol import ActionForm, ActiveDisturbance, Info, Observations, Options, StepResult
    from crashhunt.trial import Disturbance

_LENGTH_M, _WIDTH_M = 5.0, 1.8
_ACCELERATION, _BRAKING = 3.0, 8.0
_LEADER_ID = "leader"


class ToySimulator:
    """Simulates vehicles that drive along the x axis.

    All scenario arguments are optional:

    - ``leader_speed``: speed of the leader in m/s, 10 by default.
    - ``gap_m``: the gap from bumper to bumper at the start, in m, 30 by default.
    - ``road_m``: the length of the road, in m, 1000 by default.
    - ``step_wall_s``: the minimum wall time of a step, in s.
    - ``fail_reset``: true makes `reset` fail on purpose.
    - ``fail_at_step``, ``exit_at_step``, ``segfault_at_step``, ``hang_at_step``: number of the step that fails on
      purpose.
    """

    def __init__(self, scenario: Scenario, stage: Path) -> None:
        self.step_length_s = scenario.step_length_s
        self._setups = scenario.agents
        self._kinematics = Kinematics(scenario.observation or ObservationSetup())
        self.observation_names = self._kinematics.features
        self.observation_spaces = dict.fromkeys(scenario.agents, self._kinematics.space)
        self._parts = SceneObserver(scenario.agents)
        self.observation_layouts = self._parts.layouts
        self.observation_spaces |= {agent: layout.flat_space for agent, layout in self.observation_layouts.items()}
        if self.observation_layouts:
            self.shown_spaces = {agent: layout.space for agent, layout in self.observation_layouts.items()}
        self.actions: dict[str, ActionForm] = {
            agent: MetaAction() if setup.action_form == "meta" else SpeedAndLaneChange()
            for agent, setup in scenario.agents.items()
        }
        self.agents: list[str] = []

    def reset(self, *, seed: int, options: Options | None = None) -> tuple[Observations, Info]:
        """Put the agents on the road, behind the leader."""
        self._arguments = dict((options or {}).get("arguments", {}))
        if self._argument("fail_reset", default=False):
            raise InvalidEpisodeError("the toy simulator fails as its scenario arguments demand")
        self._rng = np.random.default_rng(seed)
        self._step = 0
        self.agents = list(self._setups)
        spacing = _LENGTH_M + float(self._argument("gap_m", 30.0))
        names = [*self.agents, _LEADER_ID]
        self._x = {name: spacing * place for place, name in enumerate(names)}
        self._v = dict.fromkeys(names, float(self._argument("leader_speed", 10.0)))
        self._start = dict(self._x)
        self._touched: set[str] = set()
        self._kinematics.hidden.clear()
        self._parts.begin(0.0, self.step_length_s, seed)
        self._disturbed: dict[str, float] = {}  # disturbed vehicles: target speed in m/s
        self._roster_of()
        self._look(())
        return {agent: self._observe(agent) for agent in self.agents}, {}

    def ready_process(self) -> None:
        """Do nothing: the toy loads nothing later, and its `reset` does not sample from the action spaces."""

    why_no_reseeding = ""

    def reseed(self, seed: int) -> None:
        """Re-seed the generator that decides when the leader brakes."""
        self._rng = np.random.default_rng(seed)

    def step(self, actions: Mapping[str, NDArray[np.generic]]) -> StepResult:
        """Move all vehicles; the reward is the distance driven, in m."""
        self._step += 1
        self._fail_on_purpose()
        wanted = {agent: self._target(agent, action) for agent, action in actions.items()}
        cruising = float(self._argument("leader_speed", 10.0))
        wanted[_LEADER_ID] = 0.0 if self._rng.random() < 0.05 else cruising
        wanted |= self._disturbed
        for name, target in wanted.items():
            change = min(
                max(target - self._v[name], -_BRAKING * self.step_length_s), _ACCELERATION * self.step_length_s
            )
            self._v[name] = max(0.0, self._v[name] + change)
            self._x[name] += self._v[name] * self.step_length_s
        contacts = self._contacts(list(actions))
        hit = {contact.collider for contact in contacts}
        road = float(self._argument("road_m", 1000.0))
        arrived = {agent for agent in actions if self._x[agent] >= road and agent not in hit}
        rewards = {agent: self._v[agent] * self.step_length_s for agent in actions}
        terminations = {agent: agent in hit or agent in arrived for agent in actions}
        self.agents = [agent for agent in self.agents if not terminations.get(agent, False)]
        if arrived:
            for agent in arrived:
                del self._x[agent]
            self._roster_of()
        self._look(contacts)
        observations = {agent: self._observe(agent) if agent in self._x else self._blank(agent) for agent in actions}
        return observations, rewards, terminations, dict.fromkeys(actions, False), {agent: {} for agent in actions}

    def scene(self) -> Scene:
        """Return the state of all vehicles."""
        return self._scene

    def lanes(self) -> list[Lane]:
        """Return the only lane of the road."""
        return [Lane("road_0", 3.5, ((0.0, 0.0), (float(self._argument("road_m", 1000.0)), 0.0)))]

    def full_braking(self, agent: str) -> FullBraking:
        """Return the action with which a vehicle brakes as hard as it can."""
        if self._setups[agent].action_form == "meta":
            return FullBraking(META_ACTIONS.index("SLOWER"), "by answering SLOWER in every step")
        return FullBraking((0.0, 0), "the maximum of the vehicle", _BRAKING)

    disturbing_kinds = ("brake", "stop", "unseen")

    def resolve_target(self, disturbance: Disturbance) -> str:
        """Return the leader if it is directly ahead of the agent; all other vehicles are agents."""
        ahead = [name for name, x in self._x.items() if x > self._x.get(disturbance.agent, np.inf)]
        return _LEADER_ID if disturbance.who == "ahead" and ahead == [_LEADER_ID] else ""

    def disturb(self, vehicle: str, disturbance: Disturbance) -> ActiveDisturbance:
        """Make a vehicle brake, at most as hard as its maximum deceleration, or hide the vehicle."""
        if disturbance.what == "unseen":
            by_parts = disturbance.agent in self.observation_layouts
            return Unseen(self._parts if by_parts else self._kinematics, disturbance.agent, vehicle)
        return _Braking(self, vehicle, min(disturbance.how_strong, _BRAKING))

    def hold(self, vehicle: str, what: str) -> ActiveDisturbance | None:
        """Keep the speed of the leader. The road has one lane, so a lane needs no hold."""
        return _Steady(self, vehicle) if vehicle == _LEADER_ID and what == "keep_speed" else None

    def keep_speed(self, vehicle: str) -> None:
        """Make a vehicle keep its speed in the next step."""
        self._disturbed[vehicle] = self._v[vehicle]

    def brake(self, vehicle: str, deceleration: float) -> None:
        """Make a vehicle brake in the next step, with a deceleration in m/s²."""
        self._disturbed[vehicle] = max(0.0, self._v[vehicle] - deceleration * self.step_length_s)

    def let_go(self, vehicle: str) -> None:
        """Let a vehicle drive by itself again."""
        self._disturbed.pop(vehicle, None)

    def close(self) -> None:
        """Do nothing, because the toy holds no resources."""

    def _argument(self, name: str, default: Any) -> Any:
        return self._arguments.get(name, default)

    def _fail_on_purpose(self) -> None:
        if pause_s := float(self._argument("step_wall_s", 0.0)):  # a sleep of 0 s leaves the processor at every step
            time.sleep(pause_s)
        if self._step == self._argument("fail_at_step", 0):
            raise SimulatorError("the toy simulator fails as its scenario arguments demand")
        if self._step == self._argument("exit_at_step", 0):
            os._exit(3)
        if self._step == self._argument("segfault_at_step", 0):
            ctypes.string_at(0)
        if self._step == self._argument("hang_at_step", 0):
            ctypes.PyDLL(None).sleep(3600)  # PyDLL holds the GIL, as a simulator's compiled code may

    def _target(self, agent: str, action: NDArray[np.generic]) -> float:
        if self._setups[agent].action_form != "meta":
            return float(action[0])
        shift = {3: 5.0, 4: -5.0}.get(int(action[0]), 0.0)
        return max(0.0, self._v[agent] + shift)

    def _contacts(self, agents: list[str]) -> tuple[Contact, ...]:
        """Return the contacts of agents that drove into the vehicle ahead in this step for the first time."""
        found = []
        for agent in agents:
            ahead = min(
                (name for name in self._x if self._x[name] > self._x[agent]), key=self._x.__getitem__, default=None
            )
            if ahead is not None and agent not in self._touched and self._x[agent] > self._x[ahead] - _LENGTH_M:
                self._touched.add(agent)
                found.append(
                    Contact(
                        collider=agent,
                        victim=ahead,
                        kind="collision",
                        lane="road_0",
                        collider_speed=self._v[agent],
                        victim_speed=self._v[ahead],
                    )
                )
        return tuple(found)

    def _roster_of(self) -> None:
        self._roster = Roster(
            tuple(Actor(id=name, kind="passenger", length=_LENGTH_M, width=_WIDTH_M) for name in sorted(self._x))
        )

    def _look(self, contacts: tuple[Contact, ...]) -> None:
        names = sorted(self._x)
        self._scene = Scene(
            self._step * self.step_length_s,
            self._roster,
            [(self._x[name], 0.0) for name in names],
            [0.0] * len(names),
            [self._v[name] for name in names],
            contacts,
            lanes=("road_0",) * len(names) if self._step % 10 == 0 or contacts else (),
            swept=True,
        )

    def _blank(self, agent: str) -> NDArray[np.generic]:
        return self._parts.blank(agent) if agent in self.observation_layouts else self._kinematics.blank()

    def _observe(self, agent: str) -> NDArray[np.generic]:
        if agent in self.observation_layouts:
            driven = self._x[agent] - self._start[agent]
            return self._parts.observe(agent, self._scene, distance=driven, place=lambda _row: LanePlace())
        return self._kinematics.observe(
            self._scene,
            self._roster.index[agent],
            distance=self._x[agent] - self._start[agent],
            from_left=0.0,
            lateral_speed=0.0,
            lanes=1,
        )


class _Braking:
    """Makes a vehicle brake."""

    def __init__(self, toy: ToySimulator, vehicle: str, how_strong: float) -> None:
        self.how_strong = how_strong
        self._toy = toy
        self._vehicle = vehicle
        self.keep()

    def keep(self) -> None:
        """Brake in the next step as well."""
        self._toy.brake(self._vehicle, self.how_strong)

    def end(self) -> None:
        """Let the vehicle drive by itself again."""
        self._toy.let_go(self._vehicle)


class _Steady:
    """Makes a vehicle keep its speed."""

    how_strong = 1.0

    def __init__(self, toy: ToySimulator, vehicle: str) -> None:
        self._toy = toy
        self._vehicle = vehicle
        self.keep()

    def keep(self) -> None:
        """Keep the speed in the next step as well."""
        self._toy.keep_speed(self._vehicle)

    def end(self) -> None:
        """Let the vehicle drive by itself again."""
        self._toy.let_go(self._vehicle)
