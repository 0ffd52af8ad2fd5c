"""The contract suite for simulators."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np
import pytest
from gymnasium import spaces

from crashhunt.base.errors import ActionError
from crashhunt.base.foreign_code import members, supports
from crashhunt.simulators import (
    FACULTIES,
    CountsSetUp,
    FlattensObservations,
    FullBraking,
    HasMap,
    HasObstacles,
    NamesObservations,
    ObservesParts,
    ReportsEvents,
    ReportsNotices,
    RestoresObservations,
    RestoresState,
    Simulator,
    SupportsDisturbances,
    SupportsFullBraking,
    SupportsReseeding,
)
from crashhunt.trial import CELLS, Disturbance, Outcome

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.simulators import Observations
    from crashhunt.world import Event

Make = Callable[[], Simulator]


_Shown = tuple[float, bytes, list[str], list[tuple[str, bytes]], list[tuple[str, float]]]


class SimulatorContract:
    """Checks a simulator against `crashhunt.simulators.Simulator`, and its optional capabilities.

    The fixture ``make`` returns a function that creates a simulator. ``steps`` is the number of steps that an episode
    must reach with the first sample from each agent's action space.
    """

    steps = 20

    @pytest.fixture
    def make(self) -> Make:
        """Return a function that creates a simulator."""
        raise NotImplementedError("the test class must define the fixture 'make'")

    @pytest.fixture
    def simulator(self, make: Make) -> Iterator[Simulator]:
        """Yield a simulator, and close it at the end of the test."""
        simulator = make()
        yield simulator
        simulator.close()

    def _held(self, simulator: Simulator, seed: int = 3) -> dict[str, NDArray[np.generic]]:
        """Return the first encoded sample from the action space of each agent."""
        forms = {agent: simulator.actions[agent] for agent in simulator.agents}
        for form in forms.values():
            form.space.seed(seed)
        return {agent: form.encode(form.space.sample()) for agent, form in forms.items()}

    def _drive(self, simulator: Simulator, seed: int, reseeded: tuple[int, int] | None = None) -> list[_Shown]:
        """Return all outputs of an episode, as bytes and numbers."""
        observations, _ = simulator.reset(seed=seed)
        trace: list[_Shown] = [self._shown(simulator, observations, {})]
        held = self._held(simulator)
        for step in range(self.steps):
            if reseeded is not None and step == reseeded[0]:
                assert supports(simulator, SupportsReseeding)
                simulator.reseed(reseeded[1])
            acting = tuple(simulator.agents)
            if not acting:
                break
            observations, rewards, terminations, truncations, infos = simulator.step({a: held[a] for a in acting})
            assert set(acting) == set(rewards) == set(terminations) == set(truncations) == set(infos)
            assert set(simulator.agents) == {agent for agent in acting if not terminations[agent]}
            assert not any(truncations.values())
            trace.append(self._shown(simulator, observations, rewards))
        return trace

    def _shown(self, simulator: Simulator, observations: Observations, rewards: Mapping[str, float]) -> _Shown:
        scene = simulator.scene()
        for agent, observation in observations.items():
            assert simulator.observation_spaces[agent].contains(observation)
        assert len(scene.roster) == len(scene.points) == len(scene.headings) == len(scene.speeds)
        assert not scene.lanes or len(scene.lanes) == len(scene.roster)
        seen = sorted((agent, observation.tobytes()) for agent, observation in observations.items())
        return (
            scene.time_s,
            scene.data.tobytes(),
            [actor.id for actor in scene.roster.actors],
            seen,
            sorted(rewards.items()),
        )

    def _events(self, simulator: Simulator) -> list[Event]:
        """Return the events of an episode, except crashes."""
        simulator.reset(seed=1)
        found = list(simulator.scene().events)
        for agent in simulator.agents:
            simulator.actions[agent].space.seed(3)
        for _ in range(self.steps):
            if not simulator.agents:
                break
            forms = {agent: simulator.actions[agent] for agent in simulator.agents}
            simulator.step({agent: form.encode(form.space.sample()) for agent, form in forms.items()})
            found += simulator.scene().events
        return found

    def test_an_episode_depends_on_its_seed_alone(self, simulator: Simulator) -> None:
        """Equal seeds give equal episodes after any other episodes, and another seed gives another episode."""
        first = self._drive(simulator, 1)
        other = self._drive(simulator, 2)
        assert self._drive(simulator, 1) == first
        assert other != first

    def test_another_seed_within_an_episode_changes_only_what_follows(self, simulator: Simulator) -> None:
        """After another seed is set at a step, the earlier steps stay equal, and equal seeds give equal episodes."""
        if supports(simulator, SupportsReseeding) and not simulator.why_no_reseeding:
            first = self._drive(simulator, 1)
            after = max(0, len(first) // 2 - 1)
            again = [self._drive(simulator, 1, (after, seed)) for seed in (7, 7, 8)]
            assert again[0] == again[1]
            assert all(trace[: after + 1] == first[: after + 1] for trace in again)
            assert self._drive(simulator, 1) == first

    def test_a_second_instance_does_the_same(self, make: Make) -> None:
        """The results do not depend on the instance of the simulator."""
        one = make()
        first = self._drive(one, 5)
        one.close()
        two = make()
        assert self._drive(two, 5) == first
        two.close()

    def test_what_is_handed_out_stays_as_it_is(self, simulator: Simulator) -> None:
        """Neither observations nor scenes that were returned change when the episode continues."""
        observations, _ = simulator.reset(seed=1)
        scene = simulator.scene()
        kept = {agent: observation.copy() for agent, observation in observations.items()}
        data = scene.data
        simulator.step(self._held(simulator, seed=1))
        assert all(np.array_equal(observations[agent], kept[agent]) for agent in kept)
        assert np.array_equal(scene.data, data)

    def test_time_grows_by_the_step_length(self, simulator: Simulator) -> None:
        """The simulation time of the scene increases by one step length in each step."""
        times = [entry[0] for entry in self._drive(simulator, 1)]
        assert np.allclose(np.diff(times), simulator.step_length_s)

    def test_actions_are_checked_and_encoded_once_and_for_all(self, simulator: Simulator) -> None:
        """Encoding an encoded action changes nothing, and actions outside of the space are refused."""
        simulator.reset(seed=1)
        for agent in simulator.agents:
            form = simulator.actions[agent]
            form.space.seed(1)
            for _ in range(20):
                encoded = form.encode(form.space.sample())
                again = form.encode(encoded)
                assert again.tobytes() == encoded.tobytes()
                assert (again.dtype, again.shape) == (encoded.dtype, encoded.shape)
            for nonsense in (None, "fast", (np.nan, np.nan), object(), (1e300, 7), -1, 0.5, [[]]):
                with pytest.raises(ActionError):
                    form.encode(nonsense)

    def test_it_offers_faculties_as_a_whole(self, simulator: Simulator) -> None:
        """A simulator with one method of an optional protocol has all its methods, or the protocol is ignored."""
        simulator.reset(seed=1)
        for faculty in FACULTIES:
            there = [name for name in members(faculty) if getattr(simulator, name, None) is not None]
            assert there in ([], [*members(faculty)]), f"{faculty.__name__} is offered in part: {there}"

    def test_braking_as_hard_as_it_can_is_an_action_that_does_not_speed_up(self, simulator: Simulator) -> None:
        """The action of `SupportsFullBraking` is inside the action space, and slows the vehicle down."""
        simulator.reset(seed=1)
        names = tuple(simulator.agents)
        brakes: dict[str, FullBraking] = {}
        if supports(simulator, SupportsFullBraking):
            for name in names:
                braking = simulator.full_braking(name)
                if braking is not None:
                    assert braking.how
                    assert braking.deceleration is None or braking.deceleration > 0
                    brakes[name] = braking
        actions = {name: simulator.actions[name].encode(braking.action) for name, braking in brakes.items()}
        for agent in names if len(brakes) == len(names) else ():
            simulator.reset(seed=1)
            before = simulator.scene().speeds[simulator.scene().roster.index[agent]]
            for _ in range(3):
                if agent in simulator.agents:
                    simulator.step({other: actions[other] for other in simulator.agents})
            scene = simulator.scene()
            row = scene.roster.index.get(agent)
            assert row is None or scene.speeds[row] <= before + 1e-6

    def test_the_map_has_every_lane_once(self, simulator: Simulator) -> None:
        """`HasMap`: every lane has a unique name, a width and at least two points, and the lanes do not change."""
        simulator.reset(seed=1)
        if supports(simulator, HasMap):
            lanes = list(simulator.lanes())
            assert len({lane.id for lane in lanes}) == len(lanes)
            for lane in lanes:
                assert lane.width > 0
                assert np.shape(lane.shape)[1:] == (2,)
                assert len(lane.shape) > 1
                assert np.isfinite(lane.shape).all()
            assert list(simulator.lanes()) == lanes

    def test_obstacles_are_closed_lines(self, simulator: Simulator) -> None:
        """`HasObstacles`: every obstacle has a unique name and a closed outline; the simulator has a map as well."""
        simulator.reset(seed=1)
        if supports(simulator, HasObstacles):
            assert supports(simulator, HasMap)
            obstacles = list(simulator.obstacles())
            assert len({one.id for one in obstacles}) == len(obstacles)
            for one in obstacles:
                assert one.width == 0
                assert np.shape(one.shape)[1:] == (2,)
                assert len(one.shape) > 3
                assert one.shape[0] == one.shape[-1]
                assert np.isfinite(one.shape).all()

    def test_structured_observations_can_be_had_back(self, simulator: Simulator) -> None:
        """`FlattensObservations`: the agent's observation is unflattened from the recorded one, and vice versa."""
        observations, _ = simulator.reset(seed=1)
        shown = simulator.shown_spaces if supports(simulator, FlattensObservations) else {}
        assert set(shown) <= set(observations)
        for agent, space in shown.items():
            if supports(simulator, RestoresObservations):
                assert simulator.restore_observation(agent, observations[agent]) is not None
                continue
            seen: object = spaces.unflatten(space, observations[agent])
            again = np.asarray(spaces.flatten(space, seen))
            assert np.array_equal(again, observations[agent], equal_nan=True)

    def test_columns_have_a_name_each(self, simulator: Simulator) -> None:
        """`NamesObservations`: each entry of an observation's last axis has a name, or no entry has one.

        The names are not those of agents that observe parts (`ObservesParts`).
        """
        observations, _ = simulator.reset(seed=1)
        layouts = simulator.observation_layouts if supports(simulator, ObservesParts) else {}
        observations = {agent: shown for agent, shown in observations.items() if agent not in layouts}
        names = tuple(simulator.observation_names) if supports(simulator, NamesObservations) else ()
        assert all(isinstance(name, str) for name in names)
        assert len(set(names)) == len(names)
        assert not names or all(observation.shape[-1] == len(names) for observation in observations.values())

    def test_parts_are_those_of_the_layout(self, simulator: Simulator) -> None:
        """`ObservesParts`: an agent that observes parts sees arrays in the spaces of its layout."""
        observations, _ = simulator.reset(seed=1)
        for agent, layout in (simulator.observation_layouts if supports(simulator, ObservesParts) else {}).items():
            assert simulator.observation_spaces[agent] == layout.flat_space
            seen = layout.restore(observations[agent])
            assert layout.space.contains(seen)
            assert layout.flat(seen).tobytes() == observations[agent].tobytes()

    def test_only_events_that_it_looks_for_happen(self, simulator: Simulator) -> None:
        """`ReportsEvents`: scenes have only events of the reported types; without the protocol, they have none."""
        kinds = tuple(simulator.reported_events) if supports(simulator, ReportsEvents) else ()
        assert {Outcome(kind).is_traffic_event for kind in kinds} <= {True}
        assert {event.kind for event in self._events(simulator)} <= set(kinds)

    def test_others_err_and_the_next_episode_knows_nothing_of_it(self, simulator: Simulator) -> None:
        """`SupportsDisturbances`: a target is in the scene and is not an agent; `reset` ends every disturbance."""
        if not supports(simulator, SupportsDisturbances):
            return
        assert all(isinstance(kind, str) for kind in simulator.disturbing_kinds)
        before = self._drive(simulator, 1)
        for number, kind in enumerate(simulator.disturbing_kinds):
            simulator.reset(seed=1)
            agents, held = tuple(simulator.agents), self._held(simulator)
            found = {}
            for cell in CELLS:
                planned = Disturbance(step=1, who=cell, what=kind, how_strong=0.5, how_long=1.0, agent=agents[0])
                vehicle = simulator.resolve_target(planned)
                assert vehicle == "" or vehicle in simulator.scene().roster.index
                assert vehicle not in agents
                if vehicle and vehicle not in found:
                    found[vehicle] = simulator.disturb(vehicle, planned)
            simulator.step(held)
            active = [disturbed for disturbed in found.values() if disturbed is not None]
            for disturbed in active:
                assert np.isfinite(disturbed.how_strong)
                disturbed.keep()
            for disturbed in active[number % 2 :: 2]:  # the others continue to the end
                disturbed.end()
        assert self._drive(simulator, 1) == before

    def test_notices_are_lines(self, simulator: Simulator) -> None:
        """`ReportsNotices`: each notice is one line of text."""
        if supports(simulator, ReportsNotices):
            self._drive(simulator, 1)
            for notice in simulator.notices:
                assert isinstance(notice, str)
                assert len(notice.splitlines()) == 1

    def test_what_is_simulated_before_the_first_step_is_the_same_again(self, simulator: Simulator) -> None:
        """`CountsSetUp`: the simulator counts the same number of steps after each reset."""
        simulator.reset(seed=1)
        if supports(simulator, CountsSetUp):
            steps = simulator.setup_steps
            assert type(steps) is int
            assert steps >= 0
            self._drive(simulator, 1)
            assert simulator.setup_steps == steps

    def test_tidying_changes_no_episode(self, make: Make) -> None:
        """`RestoresState`: restoring the state before the first episode and between two episodes changes no result."""
        simulator = make()
        if not supports(simulator, RestoresState):
            simulator.close()
            return
        first = self._drive(simulator, 1)
        simulator.tidy()
        assert self._drive(simulator, 1) == first
        simulator.close()
        fresh = make()
        assert supports(fresh, RestoresState)
        fresh.tidy()
        assert self._drive(fresh, 1) == first
        fresh.close()

    def test_closing_twice_is_fine(self, make: Make) -> None:
        """Closing releases all resources, and a second call does nothing."""
        simulator = make()
        simulator.reset(seed=1)
        simulator.close()
        simulator.close()
