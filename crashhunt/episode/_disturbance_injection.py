"""Injects the disturbances of a trial between its agents and the simulator.

The target vehicle of a disturbance is determined just before the step in which the disturbance begins. Delayed or noisy
observations are recorded in the form in which the agent receives them. Delayed actions are recorded when the agent
returns them.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from crashhunt.base.errors import InvalidEpisodeError
from crashhunt.base.foreign_code import supports
from crashhunt.scenario import ACTIONS
from crashhunt.simulators import NamesMetaActions, NamesObservations, ObservesParts, SupportsDisturbances, SupportsHolds
from crashhunt.trial import HOLD_KINDS, SENSOR_KINDS, Disturbance, InputSignal, fold_signals, in_effect, steps_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from crashhunt.simulators import (
        ActionForm,
        ActiveDisturbance,
        ObservationLayout,
        Observations,
        Simulator,
        StepResult,
    )
    from crashhunt.trial import TrialResult, TrialSpec

    Array = NDArray[Any]


_NOISE_STREAM = 0x6E6F6973  # apart from what else is drawn of a trial's seed
_HELD_WITHOUT_CHANGE = [form.names for form in ACTIONS.values() if form.second_changes_lane]
_NOISELESS_COLUMNS = (
    "presence",
    "kind",
    "heading",
    "cos_h",
    "sin_h",
)  # columns that noise leaves alone: they are no distances


class _Filter(Protocol):
    """The interface of an object that changes an agent's observation or action in each step of a disturbance."""

    def __call__(self, array: Array) -> Array: ...


@dataclass(slots=True)
class _OngoingDisturbance:
    """A disturbance that has begun and has not ended."""

    last: int  # the last step of the disturbance
    vehicle: str  # the disturbed vehicle, or the agent if its observations or actions are disturbed
    what: str  # the kind of the disturbance
    # the simulator's disturbance of a vehicle; None if the agent itself is disturbed
    active: ActiveDisturbance | None = None
    # object that changes the agent's observations or actions; None if a vehicle is disturbed
    filters: _Filter | None = None
    after: int = 0  # number of steps after the last one in which observations still contain disturbed ones


class DisturbanceInjector:
    """Runs a simulator's steps with the disturbances of a trial.

    Args:
        spec: The specification of the trial.
        simulator: The simulator, after its reset.
        callbacks: Functions called with each disturbance that takes place; the caller may extend this list later.
        advance: Function that runs a step of the simulator; by default its method ``step``.

    Raises:
        InvalidEpisodeError: The simulator does not support a kind of disturbance.
    """

    def __init__(
        self,
        spec: TrialSpec,
        simulator: Simulator,
        callbacks: Sequence[Callable[[Disturbance], None]],
        advance: Callable[[Mapping[str, Array]], StepResult] | None = None,
    ) -> None:
        self._advance = advance or simulator.step
        self._seed = spec.seed
        self._signals = fold_signals(spec.scenario_arguments) if spec.disturbances else {}
        self._simulator = simulator
        self._callbacks = callbacks
        self._dt = simulator.step_length_s
        self._traffic = simulator if supports(simulator, SupportsDisturbances) else None
        self._holding = simulator if supports(simulator, SupportsHolds) else None
        known = tuple(self._traffic.disturbing_kinds) if self._traffic is not None else ()
        able = (*known, *SENSOR_KINDS, *(HOLD_KINDS if self._holding is not None else ()))
        odd = next((one.what for one in spec.disturbances if one.what not in able), None)
        if odd is not None:
            raise InvalidEpisodeError(
                f"the simulator does not support the disturbance {odd!r}",
                fix=f"it supports {', '.join((*known, *SENSOR_KINDS))}",
            )
        # Of each sort, those that are still to come, the next one last.
        waiting = sorted(spec.disturbances, key=lambda one: one.step, reverse=True)
        self._traffic_waits = [one for one in waiting if one.what not in SENSOR_KINDS]
        self._agent_waits = [one for one in waiting if one.what in SENSOR_KINDS]
        self._active: list[_OngoingDisturbance] = []
        self._reported: list[Disturbance] = []
        self._step = 0
        self._next = 0  # the next step with a disturbance
        self._before: Mapping[str, Array] = {}

    def add(self, disturbance: Disturbance) -> None:
        """Plan one more disturbance, which begins no earlier than in the step after the next."""
        waits = self._agent_waits if disturbance.what in SENSOR_KINDS else self._traffic_waits
        waits.append(disturbance)
        waits.sort(key=lambda one: (one.agent, one.what))  # as a specification has those of one step
        waits.sort(key=lambda one: one.step, reverse=True)

    def replan(self, disturbances: Sequence[Disturbance]) -> None:
        """Replace the planned disturbances that begin after the next step."""
        for waits in (self._traffic_waits, self._agent_waits):
            waits[:] = [one for one in waits if one.step <= self._step + 1]
        for one in disturbances:
            self.add(one)

    def took_place(self, planned: Disturbance) -> bool:
        """Return whether a disturbance that has begun had a target vehicle."""
        return any(
            one.vehicle and (one.step, one.agent, one.what) == (planned.step, planned.agent, planned.what)
            for one in self._reported
        )

    def first(self, observations: Observations) -> Observations:
        """Return the observations of the agents for the first step."""
        return self._filtered_observations(observations)

    def step(self, actions: Mapping[str, Array]) -> StepResult:
        """Run the simulator's next step with the active disturbances."""
        self._step = step = self._step + 1
        if not self._active and not self._is_due(step):
            self._before = actions
            return self._advance(actions)
        self._end_before(step)
        for going in self._active:
            if going.active is not None:
                going.active.keep()
        while self._traffic_waits and self._traffic_waits[-1].step <= step:
            self._begin(self._traffic_waits.pop())
        given, self._before = self._delayed_actions(actions), actions
        observations, *rest = self._advance(given)
        return self._filtered_observations(observations), *rest  # type: ignore[return-value]

    def end(self, result: TrialResult) -> TrialResult:
        """Return the result with the disturbances that took place."""
        return in_effect(result, self._reported)

    def _is_due(self, step: int) -> bool:
        """Return whether a disturbance begins: for a vehicle in the current step, for an agent in the next step."""
        traffic, agents = self._traffic_waits, self._agent_waits
        return bool((traffic and traffic[-1].step <= step) or (agents and agents[-1].step <= step + 1))

    def _end_before(self, step: int) -> None:
        over = [going for going in self._active if going.last + going.after < step]
        if over:
            self._active = [going for going in self._active if going.last + going.after >= step]
            for going in over:
                if going.active is not None:
                    going.active.end()

    def _steps(self, seconds: float) -> int:
        return steps_of(seconds, self._dt)

    def _begin(self, planned: Disturbance) -> None:
        """Disturb a vehicle from the current step on, if there is a suitable vehicle."""
        last = self._step + self._steps(planned.how_long) - 1
        signal = self._signals.get(planned.signal)
        if isinstance(signal, InputSignal):
            planned = planned.following(signal, self._dt)
        vehicle = self._target(planned)
        active = None
        if vehicle and all(going.vehicle != vehicle for going in self._active):  # one at a time
            active = self._disturb(vehicle, planned)
        if active is None:
            self._notify_observers(replace(planned, vehicle=""))
            return
        self._active.append(_OngoingDisturbance(last=last, vehicle=vehicle, what=planned.what, active=active))
        self._notify_observers(planned.took_place(vehicle, active.how_strong, self._dt))

    def _target(self, planned: Disturbance) -> str:
        if planned.what in HOLD_KINDS:
            return planned.vehicle
        assert self._traffic is not None
        return self._traffic.resolve_target(planned) if planned.agent in self._simulator.agents else ""

    def _disturb(self, vehicle: str, planned: Disturbance) -> ActiveDisturbance | None:
        if planned.what in HOLD_KINDS:
            assert self._holding is not None
            return self._holding.hold(vehicle, planned.what)
        assert self._traffic is not None
        return self._traffic.disturb(vehicle, planned)

    def _notify_observers(self, disturbance: Disturbance) -> None:
        self._reported.append(disturbance)
        for tell in self._callbacks:
            tell(disturbance)

    def _delayed_actions(self, actions: Mapping[str, Array]) -> Mapping[str, Array]:
        found = dict(actions)
        for going in self._active:
            if going.what == "late_action" and going.vehicle in found and going.filters is not None:
                found[going.vehicle] = going.filters(found[going.vehicle])
        return found

    def _filtered_observations(self, observations: Observations) -> Observations:
        """Return the observations that the agents receive for the next step, with their disturbances."""
        step, found = self._step + 1, dict(observations)
        while self._agent_waits and self._agent_waits[-1].step <= step:
            self._begin_of_agent(self._agent_waits.pop(), found)
        for going in self._active:
            if going.filters is None or going.what == "late_action" or going.last + going.after < step:
                continue
            if going.vehicle in found:
                found[going.vehicle] = going.filters(found[going.vehicle])
        return found

    def _begin_of_agent(self, planned: Disturbance, observations: Observations) -> None:
        """Begin a disturbance of an agent's observations or actions in the next step, unless another one is active."""
        agent, kind = planned.agent, planned.what
        going_on = (going for going in self._active if going.last > self._step)  # others are let go in the next step
        already = any(going.vehicle == agent and going.what == kind for going in going_on)
        made = self._filter(planned) if agent in observations and agent in self._simulator.agents else None
        if made is None or already:
            self._notify_observers(planned)
            return
        last = planned.step + self._steps(planned.how_long) - 1
        after = made.after if isinstance(made, _NoisyParts) else 0
        self._active.append(_OngoingDisturbance(last, agent, planned.what, filters=made, after=after))
        self._notify_observers(planned.took_place(agent, planned.how_strong, self._dt))

    def _filter(self, planned: Disturbance) -> _Filter | None:
        agent, simulator = planned.agent, self._simulator
        delay = self._steps(planned.how_strong) if planned.how_strong > 0 else 0
        if planned.what == "late_action":
            return _Late(delay, _Held(simulator.actions[agent], self._before.get(agent)))
        if planned.what == "late_observation":
            return _Late(delay)
        layout = simulator.observation_layouts.get(agent) if supports(simulator, ObservesParts) else None
        names = tuple(simulator.observation_names) if supports(simulator, NamesObservations) else ()
        space: Any = simulator.observation_spaces[agent]
        if np.dtype(space.dtype).kind != "f":
            return None  # such as a picture
        rng = np.random.default_rng(
            np.random.SeedSequence(self._seed, spawn_key=(_NOISE_STREAM, planned.step, *agent.encode()))
        )
        if layout is not None:
            center, steps = partial(_center_of, simulator, agent), self._steps(planned.how_long)
            return _NoisyParts(planned.how_strong, layout, center, rng, steps=steps, is_first=self._step == 0)
        return _Noisy(planned.how_strong, names, space.low, space.high, rng)


class _Late:
    """Delays a value by ``delay`` steps; before that, returns a value derived from the first value."""

    def __init__(self, delay: int, held: Callable[[Array], Array] = lambda first: first) -> None:
        self._delay = delay
        self._held = held
        self._first: Array | None = None
        self._queue: deque[Array] = deque()

    def __call__(self, array: Array) -> Array:
        if self._first is None:
            self._first = self._held(array)
        self._queue.append(array)
        return self._queue.popleft() if len(self._queue) > self._delay else self._first


class _Held:
    """Returns the action of a vehicle that receives no decision: it keeps the speed and the lane."""

    def __init__(self, form: ActionForm, before: Array | None) -> None:
        self._form = form
        self._before = before

    def __call__(self, first: Array) -> Array:
        form, space = self._form, self._form.space
        action = first if self._before is None else self._before
        if tuple(form.names) in _HELD_WITHOUT_CHANGE:
            return form.encode((float(action[0]), 0))
        if supports(space, NamesMetaActions) and "IDLE" in space.meanings:
            return form.encode(tuple(space.meanings).index("IDLE"))
        return action


class _NoisyParts:
    """Adds to every measured number of an observation with parts an error of up to a share of the number.

    If the observation stacks earlier ones, these stay as the agent received them.

    Args:
        share: The largest relative error.
        layout: The layout of the observation.
        center: Function that returns the centre of the agent's vehicle, in m; None if it has left.
        rng: The random generator of the disturbance.
        steps: Number of steps with errors.
        is_first: Whether the first observation is that of the start of the episode.
    """

    def __init__(
        self,
        share: float,
        layout: ObservationLayout,
        center: Callable[[], tuple[float, float] | None],
        rng: np.random.Generator,
        *,
        steps: int,
        is_first: bool,
    ) -> None:
        self._share, self._layout, self._center, self._rng = share, layout, center, rng
        self._left, self._is_first = steps, is_first
        self._received: Array | None = None
        # number of steps after these in which the observation still stacks observations with errors
        self.after = max(0, layout.history - 1)

    def __call__(self, array: Array) -> Array:
        found = self._with_errors(array) if self._left else array
        self._left = max(0, self._left - 1)
        if self.after:
            if self._received is not None:
                found = self._layout.with_earlier(found, self._received, steps_before=1)
            else:
                found = self._layout.with_earlier(found, None if self._is_first else array, steps_before=0)
            self._received = found
        return found

    def _with_errors(self, array: Array) -> Array:
        factors = 1.0 + self._share * self._rng.uniform(-1.0, 1.0, array.shape)
        center = self._center()
        return array if center is None else self._layout.with_errors(array, factors, center)


def _center_of(simulator: Simulator, agent: str) -> tuple[float, float] | None:
    """Return the centre of a vehicle, in m; None if it has left the simulation."""
    scene = simulator.scene()
    row = scene.roster.index.get(agent)
    return None if row is None else (float(scene.centers[row, 0]), float(scene.centers[row, 1]))


class _Noisy:
    """Adds to every number an error of up to a share of the number, within the bounds of the space."""

    def __init__(self, share: float, names: Sequence[str], low: Array, high: Array, rng: np.random.Generator) -> None:
        self._share = share
        self._columns = np.array([name not in _NOISELESS_COLUMNS for name in names], bool) if names else np.True_
        self._bounds = low, high
        self._rng = rng

    def __call__(self, array: Array) -> Array:
        wrong = 1.0 + self._share * self._rng.uniform(-1.0, 1.0, array.shape)
        noisy = np.clip((array * wrong).astype(array.dtype), *self._bounds)
        return np.where(self._columns, noisy, array).astype(array.dtype)
