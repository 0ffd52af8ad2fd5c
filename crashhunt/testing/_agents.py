"""What every agent must do."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from crashhunt.agents import Agent

if TYPE_CHECKING:
    from crashhunt.simulators import ActionForm

__all__ = ["AgentContract"]

Make = Callable[[], Agent]


class AgentContract:
    """Checks `crashhunt.agents.Agent`.

    The fixture ``make`` returns a function that makes an agent, ``form`` how its actions are written, and
    ``observations`` what it is shown, in order.
    """

    @pytest.fixture
    def make(self) -> Make:
        """Return what makes an agent."""
        raise NotImplementedError("give the suite a fixture named make")

    @pytest.fixture
    def form(self) -> ActionForm:
        """Return the form of its actions."""
        raise NotImplementedError("give the suite a fixture named form")

    @pytest.fixture
    def observations(self) -> list[np.ndarray[Any, Any]]:
        """Return what the agent is shown."""
        raise NotImplementedError("give the suite a fixture named observations")

    def test_it_acts_inside_its_space_and_by_its_seed_alone(
        self, make: Make, form: ActionForm, observations: list[np.ndarray[Any, Any]]
    ) -> None:
        """After a reset it does the same again, as does another instance."""

        def drive(agent: Agent, seed: int) -> list[bytes]:
            agent.reset(seed)
            return [form.encode(agent.act(observation)).tobytes() for observation in observations]

        agent = make()
        first = drive(agent, 1)
        drive(agent, 2)
        assert drive(agent, 1) == first
        assert drive(make(), 1) == first

    def test_it_leaves_what_it_is_shown_alone(self, make: Make, observations: list[np.ndarray[Any, Any]]) -> None:
        """Observations are shared with the recorder and other agents."""
        agent = make()
        agent.reset(1)
        for observation in observations:
            before = observation.copy()
            agent.act(observation)
            assert np.array_equal(observation, before)
