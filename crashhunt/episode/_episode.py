"""One episode: the only place where agent, simulator and oracle interact; and a trial, which is one episode.

`Episode` runs each part of each step in Python. `FastEpisode` is an `Episode` with the same results, bit by bit, whose
uneventful steps on SUMO run in the compiled core, each in one call. `FastEpisode` is the only class that knows the
core. After a step of the core, the simulator and the attributes of the episode hold an older state. Reading a public
attribute first updates them to the state of the core.

`run_episode` runs a trial from its specification: an episode that is recorded and measured, with seeded random
generators.

Reason: on the scenario ``loop``, trials of 600 steps take 1.20 times the CPU time if the core runs no steps (median of
7 alternating pairs). A subclass takes 1.02 times the CPU time of ``if`` statements in `Episode`, a difference within
the noise.
"""

from __future__ import annotations

import inspect
import random
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np

from crashhunt.agents import Closes
from crashhunt.base.errors import InternalError, InvalidEpisodeError, UsageError
from crashhunt.base.foreign_code import Boundary, ForeignError, Party, is_at_boundary, is_ours, supports
from crashhunt.base.forks import held, shared_memory
from crashhunt.episode._blame import guarded_check, guarded_reset, guarded_scene, guarded_step
from crashhunt.episode._disturbance_injection import DisturbanceInjector
from crashhunt.episode._failures import Ending, close_agent
from crashhunt.episode._fast_path import FastPath, make_fast_path
from crashhunt.episode._forks import Forkable
from crashhunt.episode._observers import (
    Nearness,
    Observer,
    Recorder,
    agent_seed,
    callbacks_for,
    observation_restorers,
    options_of,
)
from crashhunt.episode._trial_signals import TrialSignals
from crashhunt.native import ANSWERED, ASK, DONE, SIMULATED
from crashhunt.oracles import (
    ChecksEnd,
    Finding,
    Oracle,
    ReadsSignals,
    RequirementOracle,
    SeesMap,
    TrafficEvents,
    merge_findings,
)
from crashhunt.simulators import CountsSetUp, HasMap, SupportsReseeding
from crashhunt.trial import CRASHES, Failure, Outcome, TrialResult, TrialSpec, in_turn

if TYPE_CHECKING:
    from types import TracebackType

    from numpy.typing import NDArray

    from crashhunt.agents import Agent
    from crashhunt.recording import BlackBox
    from crashhunt.simulators import Info, Observations, Simulator, StepResult
    from crashhunt.trial import Disturbance, Value
    from crashhunt.world import Scene

MakeAgent = Callable[[str, "Simulator", "Mapping[str, Value]"], "Agent"]
"""Called with agent id, simulator and arguments; returns the agent at the wheel."""
Reset = Callable[..., "tuple[Observations, Info]"]
"""What `Simulator.reset` is: called with ``seed`` and ``options``."""

_ACTION_BOUNDARY = Boundary(Party.SIMULATOR, "action conversion")
_MAP_BOUNDARY = Boundary(Party.ORACLE, "see_map")
ASK_ALL: Mapping[str, NDArray[np.generic]] = {}  # never written to


class Episode(Forkable, Ending):
    """One trial that runs step by step. Between two steps, its whole state can be examined.

    An exception of agent, simulator, oracle or observer ends the episode, and its result describes the exception. If a
    process can have only one simulator of a kind, only one episode may run at a time. The episode does not seed the
    random generators of the process.

    Args:
        spec: specification of the trial.
        simulator: the simulator in which the trial runs.
        make_agent: function called with agent id, simulator and arguments; it returns the agent that drives.
        oracles: the oracles, which decide whether a step is a crash.
        crash_on: The outcomes that end the episode. After other traffic crashes and events, the episode continues.
        observers: Observers of the episode, called in this order.
        forks: Whether the episode may be forked; it then records the open files before the agents are created.
        reset: function that resets the simulator; None for the simulator's own `reset`.
    """

    # x, y, heading and speed of the only agent while the requirements read a step whose scene is not made; otherwise
    # None
    live: tuple[float, float, float, float] | None = None

    def __init__(
        self,
        spec: TrialSpec,
        *,
        simulator: Simulator,
        make_agent: MakeAgent,
        oracles: Sequence[Oracle] = (),
        crash_on: Sequence[Outcome] = CRASHES,
        observers: Sequence[Observer] = (),
        forks: bool = False,
        reset: Reset | None = None,
    ) -> None:
        super().__init__()
        self.spec = spec  # specification of the trial
        self.simulator = simulator  # the simulator in which the trial runs
        self.names: tuple[str, ...] = ()  # names of all actors, in the order of their numbers; empty before the start
        # agents by name. An agent that is replaced between two steps acts from the next step on.
        self.agents: dict[str, Agent] = {}
        self.acting: tuple[int, ...] = ()  # the numbers of the agents that act in the next step
        self.steps = 0  # number of completed steps
        self.result: TrialResult | None = None  # the result; None while the episode runs
        # the exception that ended the episode, until `close`; None if there was none
        self.error: BaseException | None = None
        self.setup_s = 0.0  # wall time that `start` took, in s
        # number of simulated steps before the first step of the trial; None if the simulator does not report it
        self.setup_steps: int | None = None
        self._observations: Observations = {}
        self._rewards: Mapping[str, float] = {}
        self._terminations: Mapping[str, bool] = {}
        self._infos: Info = {}
        self._scene: Scene | None = None
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
        self._restore: dict[str, Callable[[NDArray[np.generic]], object]] = {}
        # Call only observers that override a hook, because hooks run several times per step.
        self._on_begin: list[Callable[[Episode], None]] = callbacks_for(observers, "begin")
        self._on_making: list[Callable[[int], None]] = callbacks_for(observers, "making")
        self._on_observation: list[Callable[[int, NDArray[np.generic]], None]] = callbacks_for(observers, "observation")
        self._on_action: list[Callable[[int, NDArray[np.generic]], None]] = callbacks_for(observers, "action")
        self._on_scene: list[Callable[[int, Scene, tuple[float, ...]], None]] = callbacks_for(observers, "scene")
        self._on_disturbance: list[Callable[[Disturbance], None]] = callbacks_for(observers, "disturbance")
        self._on_copied = callbacks_for(observers, "copied")
        self._on_end: list[Callable[[TrialResult], TrialResult]] = callbacks_for(observers[::-1], "end")
        self._disturbed: DisturbanceInjector | None = None
        self._forks = forks
        self._reset = reset or simulator.reset
        self._look: Callable[[], Scene] | None = None  # None where the simulator is asked directly
        if not is_ours(simulator):
            self._advance, self._reset = guarded_step(simulator.step), guarded_reset(self._reset)
            self._look = guarded_scene(simulator.scene)
        self._observers = tuple(observers)

    @property
    def observations(self) -> Observations:
        """The observations of the next step, by agent."""
        return self._observations

    @property
    def rewards(self) -> Mapping[str, float]:
        """The rewards of the agents that acted in the last step."""
        return self._rewards

    @property
    def infos(self) -> Info:
        """The infos of the last step or the reset, by agent."""
        return self._infos

    @property
    def terminations(self) -> Mapping[str, bool]:
        """Whether the agents that acted in the last step have arrived or crashed."""
        return self._terminations

    @property
    def scene(self) -> Scene | None:
        """The scene after the last step; None before the start."""
        return self._scene

    def start(self) -> TrialResult | None:
        """Reset the simulator and create the agents.

        Returns:
            None if the first step can be run, otherwise the result.

        Raises:
            RecorderError: the disk is full.
        """
        began = time.monotonic()
        try:
            self._set_up()
        except BaseException as error:
            self._break(error)
        self.setup_s = time.monotonic() - began
        return self.result

    def step(self, given: Mapping[str, NDArray[np.generic]] = ASK_ALL) -> TrialResult | None:
        """Get the actions of the agents, advance the simulator by one step, and let the oracles check the new scene.

        Args:
            given: encoded actions, by agent id, of agents that do not act themselves in this step.

        Returns:
            None if the next step can be run, otherwise the result.

        Raises:
            RecorderError: the disk is full.
            RuntimeError: the episode has ended or has not been started.
        """
        if self.result is not None or self._scene is None:
            raise RuntimeError("the episode is over" if self.result is not None else "the episode has not been started")
        try:
            actions = self._act(given)
        except BaseException as error:
            return self._break(error)
        return self.result if actions is None else self._complete(actions, self._advance)

    # The next two run a million times a hunt: each is one function, looks up little, and does nothing twice.

    def _act(self, given: Mapping[str, NDArray[np.generic]]) -> dict[str, NDArray[np.generic]] | None:
        """Return the encoded actions of the agents; None if an agent has ended the episode."""
        agents, observations, restore = self.agents, self._observations, self._restore
        actions: dict[str, NDArray[np.generic]] = {}
        for number in self.acting:
            name = self.names[number]
            observation: Any = observations[name]
            for show in self._on_observation:
                show(number, observation)
            if name in given:
                action = given[name]
            else:
                if name in restore:
                    observation = restore[name](observation)
                try:
                    answer = agents[name].act(observation)
                except BaseException as error:
                    if is_at_boundary(error):  # the agent has asked for its action mask
                        self._fail_in_simulator(error)
                    else:
                        self._fail(Outcome.AGENT_ERROR, error, name, place="act")
                    return None
                try:
                    action = self._encoders[number](answer)
                except BaseException as error:
                    self._fail_in_conversion(error, name)
                    return None
            for tell in self._on_action:
                tell(number, action)
            actions[name] = action
        return actions

    def _complete(
        self,
        actions: dict[str, NDArray[np.generic]],
        advance: Callable[[Mapping[str, NDArray[np.generic]]], StepResult],
    ) -> TrialResult | None:
        """Advance the simulator with the actions of a step; return the result if this was the last step."""
        try:
            simulator = self.simulator
            try:
                self._observations, rewards, self._terminations, truncations, self._infos = advance(actions)
                scene = simulator.scene() if self._look is None else self._look()
            except BaseException as error:  # an environment of a user's may exit as well as an agent
                return self._fail_in_simulator(error)
            scene.follow(self._scene)
            self._scene = scene
            self._rewards = rewards
            step, each = self.steps + 1, tuple(map(rewards.get, self.names, self._nothing))
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
        except BaseException as error:
            return self._break(error)

    def look_ahead(self) -> tuple[str, float, float] | None:
        """Return name, gap and speed of the vehicle ahead if `live` is not None; None if they cannot be read."""
        return None

    def close(self) -> None:
        """Close the agents; a second call does nothing. The result of the episode does not change."""
        # An exception holds the frames that it came through, and with them this episode and all that agents had open.
        self.error = None
        agents, self.agents = self.agents, {}
        for agent in agents.values():
            close_agent(agent)
        self._disturbed = None
        self._detach_observers()  # observers may hold the episode

    def disturb(self, disturbance: Disturbance) -> None:
        """Add an unplanned disturbance, which begins no earlier than in the step after the next.

        Raises:
            RuntimeError: the episode was not created with ``forks``.
        """
        if self._disturbed is None:
            raise RuntimeError("disturbances can be added to a running episode only if it was made with forks")
        self._disturbed.add(disturbance)

    def replan(self, disturbances: Sequence[Disturbance]) -> None:
        """Replace the planned disturbances that begin after the next step, in the episode and in its specification."""
        if self._disturbed is not None:
            self._disturbed.replan(disturbances)
        begun = [one for one in self.spec.disturbances if one.step <= self.steps + 1]
        self.spec = replace(self.spec, disturbances=in_turn([*begun, *disturbances]))

    def reseed(self, seed: int) -> TrialResult | None:
        """Give the simulator's random generators another seed from the next step on.

        Returns:
            None if the next step can be run, otherwise the result.
        """
        try:
            assert supports(self.simulator, SupportsReseeding)  # looked at when it was set up
            self.simulator.reseed(seed)
        except BaseException as error:
            return self._fail_in_simulator(error)
        return None

    def takes_place(self, disturbance: Disturbance) -> bool:
        """Return whether a disturbance that has begun had a target vehicle."""
        return self._disturbed is not None and self._disturbed.took_place(disturbance)

    def _is_running(self) -> bool:
        return self._scene is not None and self.result is None

    def _detach_observers(self) -> None:
        """Stop calling observers."""
        callbacks = (self._on_begin, self._on_observation, self._on_action, self._on_scene, self._on_disturbance)
        for listening in (*callbacks, self._on_copied, self._on_end):
            listening.clear()
        if self._disturbed is not None:
            self._on_end.append(self._disturbed.end)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _set_up(self) -> TrialResult | None:
        spec, simulator = self.spec, self.simulator
        try:
            if spec.reseeding is not None:
                _require_reseeding(simulator)
            try:
                self._observations, self._infos = self._reset(seed=spec.seed, options=options_of(spec, simulator))
            finally:
                self.setup_steps = simulator.setup_steps if supports(simulator, CountsSetUp) else None
            self.names = tuple(simulator.agents)
            self._nothing = (0.0,) * len(self.names)
            for tell in self._on_begin:
                tell(self)
            if self._forks:
                self._held = held(shared_memory())
            if spec.disturbances or self._forks:  # a copy may be disturbed, and then is as it would have been from here
                self._disturb(DisturbanceInjector(spec, simulator, self._on_disturbance, self._advance))
            for number, agent in enumerate(self.names):
                for tell_making in self._on_making:
                    tell_making(number)
                if self._make(number, agent) is not None:
                    return self.result
            for tell_making in self._on_making:
                tell_making(-1)
            self._scene = scene = simulator.scene() if self._look is None else self._look()
            for show in self._on_scene:
                show(0, scene, self._nothing)
        except BaseException as error:
            return self._fail_in_simulator(error, "reset", is_set_up=True)
        for oracle in self._oracles:
            if supports(oracle, SeesMap):
                lanes = simulator.lanes() if supports(simulator, HasMap) else ()
                (oracle.see_map if is_ours(oracle) else _MAP_BOUNDARY.around(oracle.see_map))(lanes)
            if supports(oracle, ReadsSignals):
                oracle.read_signals(TrialSignals(self), self.names)
            if supports(oracle, ChecksEnd):
                self._on_end.append(oracle.complete)  # last, because it replaces values of other observers
        # Oracles of a user's are asked inside a boundary; crashhunt's own fail only by a fault of crashhunt.
        self._checks = [oracle.check if is_ours(oracle) else guarded_check(oracle.check) for oracle in self._oracles]
        finding = self._find(scene)
        if finding is not None:
            hit = finding.collision
            what = f"{hit.collider} and {hit.victim} overlap" if hit else finding.event.what if finding.event else ""
            failure = Failure("invalid", f"{what} before the first step")
            return self._end(Outcome.INVALID, collision=hit, failure=failure)
        self.acting = tuple(range(len(self.names)))
        forms = [simulator.actions[name] for name in self.names]
        self._encoders = [form.encode if is_ours(form) else _ACTION_BOUNDARY.around(form.encode) for form in forms]
        self._restore = observation_restorers(simulator)
        return self._end(Outcome.SURVIVED) if spec.max_steps < 1 else None

    def _make(self, number: int, agent: str) -> TrialResult | None:
        """Create and reset an agent; return the result of the episode if this fails."""
        place = "constructor"
        try:
            made = self.agents[agent] = self._make_agent(agent, self.simulator, self.spec.arguments.get(agent, {}))
            place = "reset"
            _refuse_without(made, "reset", "seed")
            made.reset(agent_seed(self.spec.seed, number))
            _refuse_without(made, "act", "observation")
        except BaseException as error:
            if type(error) is InternalError and place == "constructor":  # an agent's constructor has a boundary
                raise
            if is_at_boundary(error) and error.party is not Party.AGENT:  # the agent has asked for its mask
                return self._fail_in_simulator(error, "reset", is_set_up=True)
            error = error.error if type(error) is ForeignError else error
            return self._fail(Outcome.INVALID, error, agent, place=place)
        return None

    def _disturb(self, disturbed: DisturbanceInjector) -> None:
        self._disturbed = disturbed
        self._advance, self._observations = disturbed.step, disturbed.first(self._observations)
        self._on_end.insert(0, disturbed.end)

    def _judge(
        self, finding: Finding | None, actions: Mapping[str, object], truncations: Mapping[str, bool]
    ) -> TrialResult | None:
        """Return the result if a step was the last one; otherwise update the agents that still act."""
        if finding is not None:
            return self._end(finding.outcome, collision=finding.collision, event=finding.event)
        if len(self.simulator.agents) != len(self.acting) or True in truncations.values():
            present, over = set(self.simulator.agents), self.terminations
            self.acting = tuple([number for number, name in enumerate(self.names) if name in present])
            if not self.acting or all(over.get(name) or truncations.get(name) for name in actions):
                return self._end_whole(Outcome.FINISHED)
        return self._end_whole(Outcome.SURVIVED) if self.steps >= self._max_steps else None

    def _end_whole(self, outcome: Outcome) -> TrialResult:
        """End the episode without a crash, unless an oracle finds one at the end."""
        assert self._scene is not None
        ending = [oracle for oracle in self._oracles if supports(oracle, ChecksEnd)]
        findings = [finding for oracle in ending for finding in oracle.check_end(self._scene, self.names)]
        finding = merge_findings([finding for finding in findings if finding.outcome in self._crash_on])
        if finding is not None:
            return self._end(finding.outcome, collision=finding.collision, event=finding.event)
        return self._end(outcome)

    def _find(self, scene: Scene) -> Finding | None:
        """Return the findings of the oracles in a scene that end the episode."""
        findings: list[Finding] = []
        for check in self._checks:
            if found := check(scene, self.names):
                findings += found
        if not findings:
            return None
        return merge_findings([finding for finding in findings if finding.outcome in self._crash_on])


def _refuse_without(agent: Agent, method: str, argument: str) -> None:
    """Check that an agent has a method with one parameter, and that a call runs it.

    Raises:
        UsageError: the agent has no such method, or a call of it fails or only returns a coroutine or a generator.
    """
    found, what, fix = getattr(agent, method, None), "", f"def {method}(self, {argument})"
    if not callable(found):
        raise UsageError(f"it has no method {method}({argument})", fix=f"define {fix}")
    if inspect.isgeneratorfunction(found):
        what, fix = "yields, so a call does not run it", f"{fix}, without yield"
    elif inspect.iscoroutinefunction(found) or inspect.isasyncgenfunction(found):
        what = "is async, so a call does not run it"
    else:
        with suppress(TypeError, ValueError):  # a function in C may have no signature
            signature = inspect.signature(found, follow_wrapped=False)  # a decorator may add arguments
            try:
                signature.bind(None)
            except TypeError as error:
                what = f"cannot be called with one argument: {error}"
    if what:
        raise UsageError(f"its method {method}({argument}) {what}", fix=f"define it as {fix}")


def _require_reseeding(simulator: Simulator) -> None:
    """Check that a simulator's random generators can get another seed.

    Raises:
        InvalidEpisodeError: the random generators cannot get another seed.
    """
    if not supports(simulator, SupportsReseeding):
        raise InvalidEpisodeError("the simulator cannot re-seed its random generators")
    if simulator.why_no_reseeding:
        raise InvalidEpisodeError(simulator.why_no_reseeding)


class FastEpisode(Episode):
    """An `Episode` whose uneventful steps run in the compiled core, with bit-identical results."""

    _fast: FastPath | None = None
    _take: Callable[[Mapping[str, Agent]], int] | None = None
    """Runs a step in the core; None where steps run in Python."""
    _is_behind = False
    """Whether the core has run steps whose state is not read yet."""
    _requirements: Sequence[RequirementOracle] = ()
    """The requirements, which read their signals after each step of the core."""

    @property
    def observations(self) -> Observations:
        self._catch_up()
        return self._observations

    @property
    def rewards(self) -> Mapping[str, float]:
        self._catch_up()
        return self._rewards

    @property
    def terminations(self) -> Mapping[str, bool]:
        self._catch_up()
        return self._terminations

    @property
    def scene(self) -> Scene | None:
        self._catch_up()
        return self._scene

    def step(self, given: Mapping[str, NDArray[np.generic]] = ASK_ALL) -> TrialResult | None:
        """Run a step like `Episode.step`, in the core if possible."""
        if self._take is None or given:
            self._catch_up()
            return super().step(given)
        try:
            come = self._take(self.agents)
        except BaseException as error:
            return self._fail_in_core(error)
        if come:
            return self._finish_step(come)
        self._is_behind = True
        self.steps += 1
        return self._watch_requirements()

    def look_ahead(self) -> tuple[str, float, float] | None:
        """Return name, gap and speed of the vehicle ahead, in a step of the core."""
        assert self._fast is not None
        return self._fast.at_once.core.ahead()

    def _watch_requirements(self) -> TrialResult | None:
        """Let the requirements read a step of the core, mostly without its scene."""
        if not self._requirements:
            return None
        assert self._fast is not None
        try:
            self.live = self._fast.at_once.core.state()
            violated = [one.watch() for one in self._requirements]
        except BaseException as error:
            return self._break(error)
        finally:
            self.live = None
        if True not in violated:
            return None
        for one in self._requirements:
            one.hold()
        return self._show_step()

    def _catch_up(self) -> None:
        """Update the episode to the state of the core."""
        if self._is_behind and self._fast is not None:
            self._is_behind = False
            self._observations, self._rewards, self._terminations, *_ = self._fast.at_once.catch_up()
            self._scene = self.simulator.scene()

    def _finish_step(self, come: int) -> TrialResult | None:
        """Complete a step that the core has passed to Python because of an event."""
        fast = self._fast
        assert fast is not None
        try:
            come, actions = fast.resume_after(come, self.agents)
        except BaseException as error:
            return self._fail_in_core(error)
        if come in (DONE, ASK):
            self._is_behind = True
            self.steps += 1
            return self._show_step() if come == ASK else self._watch_requirements()
        self._catch_up()
        if actions is None:
            return super().step()
        try:
            for tell in self._on_action if come == ANSWERED else ():
                tell(0, actions[self.names[0]])
        except BaseException as error:
            return self._break(error)
        return self._complete(actions, fast.at_once.finish if come == SIMULATED else self._advance)

    def _show_step(self) -> TrialResult | None:
        """Call observers and oracles for a step that the core has recorded."""
        try:
            scene = self.scene
            assert scene is not None
            for show in self._on_scene[1:]:
                show(self.steps, scene, tuple(self._rewards.values()))
            finding = self._find(scene)
            if finding is None and self.steps < self._max_steps:
                return None
            return self._judge(finding, self._rewards, {})
        except BaseException as error:
            return self._break(error)

    def _fail_in_core(self, error: BaseException) -> TrialResult:
        """End the episode with an exception that has passed through the core.

        Raises:
            RecorderError: the disk is full.
        """
        fast = self._fast
        assert fast is not None
        if fast.cannot_record:
            return self._break(error)
        if fast.is_resuming:
            return self._fail_in_simulator(error)
        if fast.is_encoding:
            return self._fail_in_conversion(error, self.names[0])
        if not fast.at_once.core.simulating:
            return self._fail(Outcome.AGENT_ERROR, error, self.names[0], place="act")
        return self._fail_in_simulator(error)

    def _set_up(self) -> TrialResult | None:
        result = super()._set_up()
        if result is None and self._disturbed is None:
            self._fast = make_fast_path(self.simulator, self._observers, self._oracles, self._max_steps, self._encoders)
            self._take = None if self._fast is None else self._fast.at_once.core.take
            self._requirements = [one for one in self._oracles if type(one) is RequirementOracle]
        return result

    def _add(self, result: TrialResult) -> TrialResult:
        self._take = None
        return super()._add(result)

    def _detach_observers(self) -> None:
        self._take = None
        super()._detach_observers()


class AsksForks(Protocol):
    """Makes forks of a running episode, and adds what it has found to the result of the trial."""

    def is_due(self, episode: Episode) -> bool:
        """Return whether to make forks now: before the first step, or after a step."""

    def ask(self, episode: Episode) -> None:
        """Make forks of the episode."""

    def result(self, result: TrialResult) -> TrialResult:
        """Return the result of the trial, with that of its forks."""


def run_episode(
    spec: TrialSpec,
    *,
    simulator: Simulator,
    make_agent: MakeAgent,
    box: BlackBox,
    oracles: Sequence[Oracle],
    crash_on: Sequence[Outcome] = CRASHES,
    observers: Sequence[Observer] = (),
    reset: Reset | None = None,
    asking: Sequence[AsksForks] = (),
) -> TrialResult:
    """Seed the process's random generators, run one trial from its specification, and record and measure the trial.

    Args:
        spec: specification of the trial.
        simulator: the simulator in which the trial runs.
        make_agent: function called with agent id, simulator and arguments; it returns the agent that drives.
        box: the black box that records the trial; `BlackBox.begin` has been called.
        oracles: the oracles, which decide whether a step is a crash.
        crash_on: The outcomes that end the episode. Other traffic crashes and events are only recorded.
        observers: Further observers, called after the recorder.
        reset: function that resets the simulator; None for the simulator's own `reset`.
        asking: what makes forks of the episode after its steps. Those that are observers observe the episode as well.

    Returns:
        The result of the trial, including exceptions of agent and simulator.

    Raises:
        RecorderError: the disk is full.
    """
    began = time.monotonic()
    seed_everything(spec.seed)
    watching = [one for one in asking if isinstance(one, Observer)]
    try:
        with FastEpisode(
            spec,
            simulator=simulator,
            make_agent=make_agent,
            oracles=oracles,
            crash_on=crash_on,
            observers=(Recorder(box, simulator), Nearness(box.take_frames), *observers, *watching),
            forks=bool(asking),
            reset=reset,
        ) as episode:
            result = episode.start()
            try:
                while result is None:
                    for one in asking:  # before the first step, too: what begins in step 2 is noticed before step 1
                        if one.is_due(episode):
                            one.ask(episode)
                    seed = spec.reseeding.seed_after(episode.steps) if spec.reseeding is not None else None
                    if seed is not None and (result := episode.reseed(seed)) is not None:
                        break
                    result = episode.step()
            except BaseException as error:
                result = episode.end_by_agent(error)
                if result is None:
                    raise
    finally:
        for one in asking:
            if supports(one, Closes):
                one.close()
    for one in asking:
        result = one.result(result)
    wall_s = time.monotonic() - began
    return replace(result, setup_s=episode.setup_s, setup_steps=episode.setup_steps, wall_s=wall_s)


def seed_everything(seed: int) -> None:
    """Seed the random generators of the process: `random`, `numpy.random`, and torch if it has been imported."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - agents may use the global generator
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.manual_seed(seed)
