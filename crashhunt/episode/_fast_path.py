"""Episodes on SUMO whose uneventful steps run in the compiled core, each in one call.

`FastEpisode` is an `Episode` with the same results, bit by bit. `FastEpisode` is the only class that knows the core:
`Episode` runs each part of each step in Python. After a step of the core, the simulator and the attributes of the
episode hold an older state. Reading a public attribute first updates them to the state of the core.

The core does not complete a step if an event needs Python code: an agent appears, a vehicle has an unknown property, a
signal changes the action. `FastPath` then completes the step, or passes the rest of the step to `Episode`. An observer,
oracle or simulator that needs each part of each step gets an episode without the core (`make_fast_path`).

Reason: on the scenario ``loop``, trials of 600 steps take 1.20 times the CPU time if the core runs no steps (median of
7 alternating pairs). A subclass takes 1.02 times the CPU time of ``if`` statements in `Episode`, a difference within
the noise.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.base.foreign_code import supports
from crashhunt.episode._episode import ASK_ALL, Episode
from crashhunt.episode._observers import Nearness, Recorder, overrides_hook
from crashhunt.native import ANSWERED, ASK, DONE, REFUSED, SIMULATED
from crashhunt.oracles import (
    MAX_BRAKING_MPS2,
    OffRoad,
    OffRoute,
    Overlap,
    RedLight,
    ReportedCollision,
    RequirementOracle,
    Teleport,
    TrafficEvents,
    WrongWay,
)
from crashhunt.simulators import SupportsFastSteps
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from crashhunt.agents import Agent
    from crashhunt.episode._observers import Observer
    from crashhunt.oracles import Oracle
    from crashhunt.simulators import FastStepper, Observations, Simulator
    from crashhunt.trial import TrialResult
    from crashhunt.world import Scene


_EVENT_ORACLES = (ReportedCollision, OffRoad, TrafficEvents, RedLight, WrongWay, OffRoute, Teleport)
"""Oracles that find nothing in steps without a simulator event; subclasses of these do not count."""


class FastPath:
    """Completes in Python the steps that the compiled core could not complete, so that the core can run the next steps.

    Args:
        at_once: the simulator's object that runs uneventful steps.
        recorder: recorder of the episode.
        agent: the only agent of the episode.
        encode: function that encodes the agent's actions.

    Attributes:
        cannot_record: whether a failure occurred in the recording.
        is_resuming: whether a failure occurred while the core read the simulator's state.
        is_encoding: whether a failure occurred while the agent's action was encoded.
    """

    def __init__(
        self, at_once: FastStepper, recorder: Recorder, agent: str, encode: Callable[[object], NDArray[np.generic]]
    ) -> None:
        self.at_once = at_once
        self._recorder, self._agent, self._encode = recorder, agent, encode
        self.cannot_record = self.is_resuming = self.is_encoding = False
        at_once.core.listen(at_once.enter, self._record_roster)

    def resume_after(self, come: int, agents: dict[str, Agent]) -> tuple[int, dict[str, NDArray[np.generic]] | None]:
        """Return the final status of a step and the agent's action; None if the agent has not acted.

        If the status is `ANSWERED`, observers have not been called for the action yet.

        Args:
            come: The status that the core has returned.
            agents: The agents by name.
        """
        core = self.at_once.core
        if come == REFUSED:
            self.is_resuming = True
            resumed = self._resume()
            self.is_resuming = False
            if resumed:
                come = core.take(agents)
        if come in (DONE, ASK, REFUSED):
            return come, None
        self.is_encoding = True
        action = self._encode(core.answer)
        self.is_encoding = False
        if come == ANSWERED and core.note(action):
            come = core.go_on(self.at_once.apply(self._agent, action))
        return come, {self._agent: action}

    def _resume(self) -> bool:
        """Let the core continue from the simulator's state; return False if that is not possible yet."""
        if self.at_once.resume() is None:
            return False
        self._record_roster()
        return True

    def _record_roster(self) -> None:
        """Make the core record the steps of the actors in sight."""
        self.cannot_record = True
        self._recorder.lend(self.at_once.core, self.at_once.roster)
        self.cannot_record = False


def make_fast_path(
    simulator: Simulator,
    observers: Sequence[Observer],
    oracles: Sequence[Oracle],
    max_steps: int,
    encoders: Sequence[Callable[[object], NDArray[np.generic]]],
) -> FastPath | None:
    """Return the fast path; None if an observer, an oracle or the simulator needs each part of each step.

    Args:
        simulator: the simulator, after its reset.
        observers: observers of the episode.
        oracles: oracles of the episode.
        max_steps: maximum number of steps of the episode.
        encoders: function that encodes the actions of each agent, by agent id.
    """
    first = observers[0] if observers else None
    if not isinstance(first, Recorder) or type(first) is not Recorder or not supports(simulator, SupportsFastSteps):
        return None
    if simulator.at_once is None or not simulator.at_once.is_unpatched(simulator):
        return None
    rest = [one for one in observers[1:] if type(one) is not Nearness]
    if any(overrides_hook(one, "observation") or overrides_hook(one, "action") for one in rest):
        return None
    always = any(overrides_hook(one, "scene") for one in rest)
    by_themselves = (Overlap, RequirementOracle, *_EVENT_ORACLES)
    always = always or any(type(one) not in by_themselves for one in oracles)
    overlaps = any(type(one) is Overlap for one in oracles)
    simulator.at_once.core.judge(overlaps, MAX_BRAKING_MPS2, always, max_steps, Nearness.EVERY)
    return FastPath(simulator.at_once, first, simulator.agents[0], encoders[0])


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
