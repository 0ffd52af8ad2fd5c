"""What every simulator must do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from crashhunt.base.errors import ActionError
from crashhunt.simulators import Simulator

__all__ = ["SimulatorContract"]

Make = Callable[[], Simulator]


class SimulatorContract:
    """Checks `crashhunt.simulators.Simulator`.

    The fixture ``make`` returns a function that makes a simulator; ``steps`` is how far an episode must get with the
    action that each agent's space samples first.
    """

    steps = 20

    @pytest.fixture
    def make(self) -> Make:
        """Return what makes a simulator."""
        raise NotImplementedError("give the suite a fixture named make")

    def _drive(self, simulator: Simulator, seed: int) -> list[tuple[Any, ...]]:
        """Everything that an episode shows, as bytes and numbers."""
        observations, _ = simulator.reset(seed=seed)
        trace: list[tuple[Any, ...]] = [self._shown(simulator, observations, {})]
        held = {}
        for agent in simulator.agents:
            simulator.actions[agent].space.seed(3)
            held[agent] = simulator.actions[agent].encode(simulator.actions[agent].space.sample())
        for _ in range(self.steps):
            acting = tuple(simulator.agents)
            if not acting:
                break
            observations, rewards, terminations, truncations, infos = simulator.step({a: held[a] for a in acting})
            assert set(acting) == set(rewards) == set(terminations) == set(truncations) == set(infos)
            assert set(simulator.agents) == {agent for agent in acting if not terminations[agent]}
            assert not any(truncations.values())
            trace.append(self._shown(simulator, observations, rewards))
        return trace

    def _shown(self, simulator: Simulator, observations: Any, rewards: Any) -> tuple[Any, ...]:
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

    def test_an_episode_depends_on_its_seed_alone(self, make: Make) -> None:
        """Equal seeds give equal episodes, whatever ran before, and another seed another one."""
        simulator = make()
        first = self._drive(simulator, 1)
        other = self._drive(simulator, 2)
        assert self._drive(simulator, 1) == first
        assert other != first
        simulator.close()

    def test_a_second_instance_does_the_same(self, make: Make) -> None:
        """Nothing depends on the instance."""
        one = make()
        first = self._drive(one, 5)
        one.close()
        two = make()
        assert self._drive(two, 5) == first
        two.close()

    def test_what_is_handed_out_stays_as_it_is(self, make: Make) -> None:
        """Neither observations nor scenes change when the episode goes on."""
        simulator = make()
        observations, _ = simulator.reset(seed=1)
        scene = simulator.scene()
        kept = {agent: observation.copy() for agent, observation in observations.items()}
        data = scene.data
        for agent in simulator.agents:
            simulator.actions[agent].space.seed(1)
        actions = {a: simulator.actions[a].encode(simulator.actions[a].space.sample()) for a in simulator.agents}
        simulator.step(actions)
        assert all(np.array_equal(observations[agent], kept[agent]) for agent in kept)
        assert np.array_equal(scene.data, data)
        simulator.close()

    def test_time_grows_by_the_step_length(self, make: Make) -> None:
        """Simulation time is the scene's, and each step adds one step length."""
        simulator = make()
        times = [entry[0] for entry in self._drive(simulator, 1)]
        assert np.allclose(np.diff(times), simulator.step_length_s)
        simulator.close()

    def test_actions_are_checked_and_encoded_once_and_for_all(self, make: Make) -> None:
        """An encoded action is encoded to itself, and what is outside the space is refused."""
        simulator = make()
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
        simulator.close()

    def test_braking_as_hard_as_it_can_is_an_action_that_does_not_speed_up(self, make: Make) -> None:
        """Where a simulator offers ``full_braking``, its action is inside the space, and slows the vehicle down."""
        simulator = make()
        simulator.reset(seed=1)
        offered: Callable[[str], Any] = getattr(simulator, "full_braking", lambda _: None)
        for agent in simulator.agents:
            braking = offered(agent)
            if any(offered(other) is None for other in simulator.agents):
                continue
            simulator.reset(seed=1)
            before = simulator.scene().speeds[simulator.scene().roster.index[agent]]
            for _ in range(3):
                if agent in simulator.agents:
                    actions = {a: simulator.actions[a].encode(offered(a).action) for a in simulator.agents}
                    simulator.step(actions)
            scene = simulator.scene()
            row = scene.roster.index.get(agent)
            assert row is None or scene.speeds[row] <= before + 1e-6
            assert braking.deceleration is None or braking.deceleration > 0
        simulator.close()

    def test_closing_twice_is_fine(self, make: Make) -> None:
        """Closing lets go of everything, once."""
        simulator = make()
        simulator.reset(seed=1)
        simulator.close()
        simulator.close()
