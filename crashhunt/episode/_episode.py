"""One episode: the only place where agent, simulator and oracle meet."""

from __future__ import annotations

import random
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from crashhunt.agents import Closes
from crashhunt.base.errors import RecorderError
from crashhunt.base.faculties import offers
from crashhunt.episode._disturbed import Disturbed
from crashhunt.episode._failures import failure_of, is_emptied
from crashhunt.episode._nearness import Nearness
from crashhunt.episode._observer import Observer
from crashhunt.episode._recorder import Recorder
from crashhunt.oracles import Finding, Oracle, SeesMap, TrafficEvents, merge_findings
from crashhunt.simulators import FlattensObservations, HasMap
from crashhunt.trial import CRASHES, Failure, Outcome, TrialResult, TrialSpec

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from types import TracebackType

    from gymnasium import Space
    from numpy.typing import NDArray

    from crashhunt.agents import Agent
    from crashhunt.recording import BlackBox
    from crashhunt.simulators import Observations, Options, Simulator, StepResult
    from crashhunt.trial import Disturbance, Value
    from crashhunt.world import Scene

__all__ = ["Episode", "MakeAgent", "run_episode", "seed_everything"]

MakeAgent = Callable[[str, "Simulator", "Mapping[str, Value]"], "Agent"]
"""Called with agent id, simulator and arguments; returns the agent at the wheel."""

_ASK_ALL: Mapping[str, NDArray[np.generic]] = {}  # nobody writes to it


class Episode:
    """One trial, a step at a time; between two steps, everything about it can be looked at.

    Whatever agent, simulator, oracles or observers raise ends the episode, and is in its result. Of a simulator that
    is one for the process, only one episode runs at a time. The random generators of the process are left alone.

    Args:
        spec: which trial.
        simulator: where.
        make_agent: called with agent id, simulator and arguments; returns the agent at the wheel.
        oracles: what decides whether a step is a crash.
        crash_on: what ends the episode; a traffic crash or event of another kind is passed over, and it goes on.
        observers: told of everything that happens, in this order.

    Attributes:
        spec: which trial.
        simulator: where.
        names: everybody who takes part, in the order of their numbers; empty before the start.
        agents: by name; one that is replaced between two steps is asked from the next one on.
        observations: what the agents will be shown in the next step, by name.
        rewards: of those that acted in the last step, by name.
        terminations: whether these have arrived or crashed.
        acting: the numbers of those that act in the next step.
        scene: after the last step; None before the start.
        steps: how many are complete.
        result: None while it goes on.
        error: the exception that ended it, where one did; until it is closed.
        setup_s: wall time that `start` took, in s.
    """

    def __init__(
        self,
        spec: TrialSpec,
        *,
        simulator: Simulator,
        make_agent: MakeAgent,
        oracles: Sequence[Oracle] = (),
        crash_on: Sequence[Outcome] = CRASHES,
        observers: Sequence[Observer] = (),
    ) -> None:
        self.spec = spec
        self.simulator = simulator
        self.names: tuple[str, ...] = ()
        self.agents: dict[str, Agent] = {}
        self.observations: Observations = {}
        self.rewards: Mapping[str, float] = {}
        self.terminations: Mapping[str, bool] = {}
        self.acting: tuple[int, ...] = ()
        self.scene: Scene | None = None
        self.steps = 0
        self.result: TrialResult | None = None
        self.error: BaseException | None = None
        self.setup_s = 0.0
        self._make_agent = make_agent
        self._crash_on = frozenset(crash_on)
        self._oracles = tuple(oracles)
        if any(outcome.is_traffic_event for outcome in crash_on):
            self._oracles += (TrafficEvents(),)
        self._checks: list[Callable[[Scene, Sequence[str]], Sequence[Finding]]] = []
        self._max_steps = spec.max_steps
        self._advance: Callable[[Mapping[str, NDArray[np.generic]]], StepResult] = simulator.step
        self._nothing: tuple[float, ...] = ()
        self._encoders: list[Callable[[object], NDArray[np.generic]]] = []
        self._unflatten: dict[str, Callable[[NDArray[np.generic]], object]] = {}
        # Only those that want to be told are called: this is done several times a step.
        self._on_begin = [one.begin for one in observers if type(one).begin is not Observer.begin]
        self._on_observation = [
            one.observation for one in observers if type(one).observation is not Observer.observation
        ]
        self._on_action = [one.action for one in observers if type(one).action is not Observer.action]
        self._on_scene = [one.scene for one in observers if type(one).scene is not Observer.scene]
        self._on_disturbance: list[Callable[[Disturbance], None]] = [
            one.disturbance for one in observers if type(one).disturbance is not Observer.disturbance
        ]
        self._on_end = [one.end for one in reversed(observers) if type(one).end is not Observer.end]

    def start(self) -> TrialResult | None:
        """Reset the simulator and make the agents.

        Returns:
            None where the first step can be taken, the result where not.

        Raises:
            RecorderError: the disk is full.
        """
        began = time.monotonic()
        try:
            self._set_up()
        except RecorderError:
            raise
        except BaseException as error:
            self._break(error)
        self.setup_s = time.monotonic() - began
        return self.result

    def step(self, given: Mapping[str, NDArray[np.generic]] = _ASK_ALL) -> TrialResult | None:
        """Ask the agents, advance the simulator by one step, and judge what has come of it.

        Args:
            given: by name, the encoded actions of agents that are not asked in this step.

        Returns:
            None where the next step can be taken, the result where not.

        Raises:
            RecorderError: the disk is full.
            RuntimeError: it is over, or has not been started.
        """
        if self.result is not None or self.scene is None:
            raise RuntimeError("the episode is over" if self.result is not None else "the episode has not been started")
        # This runs a million times a hunt: it is one function, looks up little, and does nothing twice.
        try:
            names, agents, observations, unflatten = self.names, self.agents, self.observations, self._unflatten
            actions: dict[str, NDArray[np.generic]] = {}
            for number in self.acting:
                name = names[number]
                observation: Any = observations[name]
                for show in self._on_observation:
                    show(number, observation)
                if name in given:
                    action = given[name]
                else:
                    try:
                        if name in unflatten:
                            observation = unflatten[name](observation)
                        action = self._encoders[number](agents[name].act(observation))
                    except BaseException as error:
                        return self._fail(Outcome.AGENT_ERROR, error, name)
                for tell in self._on_action:
                    tell(number, action)
                actions[name] = action
            simulator = self.simulator
            try:
                self.observations, rewards, self.terminations, truncations, _ = self._advance(actions)
                scene = simulator.scene()
                scene.follow(self.scene)
                self.scene = scene
            except RecorderError:
                raise
            except BaseException as error:  # an environment of a user's may exit as well as an agent
                return self._fail(Outcome.AGENT_ERROR if is_emptied() else Outcome.SIMULATOR_ERROR, error)
            self.rewards = rewards
            step, each = self.steps + 1, tuple(map(rewards.get, names, self._nothing))
            for show_scene in self._on_scene:
                show_scene(step, scene, each)
                self.steps = step  # whatever fails from here on, the step is recorded
            self.steps = step
            finding = self._find(scene)
            if (
                finding is None
                and step < self._max_steps
                and len(simulator.agents) == len(self.acting)
                and True not in truncations.values()
            ):
                return None
            return self._judge(finding, actions, truncations)
        except RecorderError:
            raise
        except BaseException as error:
            return self._break(error)

    def close(self) -> None:
        """Close the agents; may be called twice. What `result` says stays."""
        # An exception holds the frames that it came through, and with them this episode and all that agents had open.
        self.error = None
        agents, self.agents = self.agents, {}
        for agent in agents.values():
            _quietly(agent)
        tells = (self._on_begin, self._on_observation, self._on_action, self._on_scene, self._on_disturbance)
        for told in (*tells, self._on_end):
            told.clear()  # observers may hold the episode

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _set_up(self) -> TrialResult | None:
        spec, simulator = self.spec, self.simulator
        agent = ""
        try:
            options: Options = {"arguments": spec.scenario_arguments}
            self.observations, _ = simulator.reset(seed=spec.seed, options=options)
            self.names = tuple(simulator.agents)
            self._nothing = (0.0,) * len(self.names)
            for tell in self._on_begin:
                tell(self)
            if spec.disturbances:
                disturbed = Disturbed(spec, simulator, self._on_disturbance)
                self._advance, self.observations = disturbed.step, disturbed.first(self.observations)
                self._on_end.insert(0, disturbed.end)
            for number, agent in enumerate(self.names):
                self.agents[agent] = self._make_agent(agent, simulator, spec.arguments.get(agent, {}))
                self.agents[agent].reset(_agent_seed(spec.seed, number))
            agent = ""
            self.scene = scene = simulator.scene()
            for show in self._on_scene:
                show(0, scene, self._nothing)
        except RecorderError:
            raise
        except BaseException as error:
            return self._fail(Outcome.INVALID, error, agent)
        for oracle in self._oracles:
            if isinstance(oracle, SeesMap):
                oracle.see_map(simulator.lanes() if offers(simulator, HasMap) else ())
        self._checks = [oracle.check for oracle in self._oracles]
        finding = self._find(scene)
        if finding is not None:
            hit = finding.collision
            what = f"{hit.collider} and {hit.victim} overlap" if hit else finding.event.what if finding.event else ""
            failure = Failure("invalid", f"{what} before the first step")
            return self._end(Outcome.INVALID, collision=hit, failure=failure)
        self.acting = tuple(range(len(self.names)))
        self._encoders = [simulator.actions[name].encode for name in self.names]
        if offers(simulator, FlattensObservations):
            self._unflatten = {name: _unflattener(space) for name, space in simulator.shown_spaces.items()}
        return self._end(Outcome.SURVIVED) if spec.max_steps < 1 else None

    def _judge(
        self, finding: Finding | None, actions: Mapping[str, object], truncations: Mapping[str, bool]
    ) -> TrialResult | None:
        """Say whether a step was the last one, and note who goes on."""
        if finding is not None:
            return self._end(finding.outcome, collision=finding.collision, event=finding.event)
        if len(self.simulator.agents) != len(self.acting) or True in truncations.values():
            present, over = set(self.simulator.agents), self.terminations
            self.acting = tuple([number for number, name in enumerate(self.names) if name in present])
            if not self.acting or all(over.get(name) or truncations.get(name) for name in actions):
                return self._end(Outcome.FINISHED)
        return self._end(Outcome.SURVIVED) if self.steps >= self._max_steps else None

    def _find(self, scene: Scene) -> Finding | None:
        """What the oracles find in a scene, of what ends the episode."""
        findings: list[Finding] = []
        for check in self._checks:
            if found := check(scene, self.names):
                findings += found
        if not findings:
            return None
        return merge_findings([finding for finding in findings if finding.outcome in self._crash_on])

    def _fail(self, outcome: Outcome, error: BaseException, agent: str = "") -> TrialResult:
        """End with an exception of an agent's, or of the simulator's."""
        self.error = error
        return self._end(outcome, failure=failure_of(error, agent))

    def _end(self, outcome: Outcome, **evidence: Any) -> TrialResult:
        """End, and let everybody who has looked on add what they have found out."""
        time_s = self.simulator.scene().time_s if self.scene is not None else 0.0
        return self._add(TrialResult(self.spec, outcome, steps=self.steps, sim_time_s=time_s, **evidence))

    def _add(self, result: TrialResult) -> TrialResult:
        for tell in self._on_end:
            result = tell(result)
        self.result = result
        return result

    def _break(self, error: BaseException) -> TrialResult:
        """End where it cannot go on, and neither agent nor simulator has said why.

        An oracle has failed, an observer, or something that the agent has damaged, such as our own files.
        """
        self.error = error
        agents = isinstance(error, OSError | MemoryError) or is_emptied()
        outcome = Outcome.AGENT_ERROR if agents else Outcome.SIMULATOR_ERROR
        self.result = TrialResult(self.spec, outcome, steps=self.steps, failure=failure_of(error, ""))
        with suppress(BaseException):
            self._add(self.result)
        return self.result


def run_episode(
    spec: TrialSpec,
    *,
    simulator: Simulator,
    make_agent: MakeAgent,
    box: BlackBox,
    oracles: Sequence[Oracle],
    crash_on: Sequence[Outcome] = CRASHES,
    observers: Sequence[Observer] = (),
) -> TrialResult:
    """Run one trial from its specification, recorded and measured, with the generators of the process seeded.

    Args:
        spec: which trial.
        simulator: where.
        make_agent: called with agent id, simulator and arguments; returns the agent at the wheel.
        box: what records it; `BlackBox.begin` has been called.
        oracles: what decides whether a step is a crash.
        crash_on: what ends the episode; a traffic crash or event of another kind is recorded, and the episode goes on.
        observers: who else is told; after the recorder.

    Returns:
        The result. Whatever agent or simulator raise is in it.

    Raises:
        RecorderError: the disk is full.
    """
    began = time.monotonic()
    seed_everything(spec.seed)
    everybody = (Recorder(box, simulator), Nearness(box.take_frames), *observers)
    with Episode(
        spec, simulator=simulator, make_agent=make_agent, oracles=oracles, crash_on=crash_on, observers=everybody
    ) as episode:
        result = episode.start()
        while result is None:
            result = episode.step()
    return replace(result, setup_s=episode.setup_s, wall_s=time.monotonic() - began)


def seed_everything(seed: int) -> None:
    """Seed the generators of the process: `random`, `numpy.random`, and torch where it has been imported."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - agents may use the global generator
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.manual_seed(seed)


def _agent_seed(seed: int, number: int) -> int:
    """A seed of each agent's own, which differs from the simulator's."""
    return int(np.random.SeedSequence(seed, spawn_key=(number,)).generate_state(1)[0]) >> 1


def _unflattener(space: Space[object]) -> Callable[[NDArray[np.generic]], object]:
    """What makes a Dict or Tuple observation again of the flattened array, which is recorded."""
    from gymnasium.spaces import unflatten

    return partial(unflatten, space)


def _quietly(agent: Agent) -> None:
    """Close an agent; whatever comes of that, the episode is over."""
    try:
        if offers(agent, Closes):
            agent.close()
    except BaseException:
        with suppress(BaseException):
            traceback.print_exc()
