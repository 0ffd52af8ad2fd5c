"""The contract suite for agents."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import pytest

from crashhunt.agents import Agent, Closes, DrawsPanels, NeedsLibraries
from crashhunt.base.foreign_code import supports
from crashhunt.panels import labelled

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.simulators import ActionForm

Make = Callable[[], Agent]


class AgentContract:
    """Checks an agent against `crashhunt.agents.Agent`, and its optional capabilities.

    The fixture ``make`` returns a function that creates an agent. ``form`` is the form of its actions, and
    ``observations`` are its observations in order.
    """

    @pytest.fixture
    def make(self) -> Make:
        """Return a function that creates an agent."""
        raise NotImplementedError("the test class must define the fixture 'make'")

    @pytest.fixture
    def form(self) -> ActionForm:
        """Return the form of the agent's actions."""
        raise NotImplementedError("the test class must define the fixture 'form'")

    @pytest.fixture
    def observations(self) -> list[NDArray[np.generic]]:
        """Return observations of the agent, in order."""
        raise NotImplementedError("the test class must define the fixture 'observations'")

    def test_it_acts_inside_its_space_and_by_its_seed_alone(
        self, make: Make, form: ActionForm, observations: list[NDArray[np.generic]]
    ) -> None:
        """After a reset, and in another instance, the agent returns the same actions again."""

        def drive(agent: Agent, seed: int) -> list[bytes]:
            agent.reset(seed)
            return [form.encode(agent.act(observation)).tobytes() for observation in observations]

        agent = make()
        first = drive(agent, 1)
        drive(agent, 2)
        assert drive(agent, 1) == first
        assert drive(make(), 1) == first

    def test_it_leaves_what_it_is_shown_alone(self, make: Make, observations: list[NDArray[np.generic]]) -> None:
        """The agent must not change observations, because the recorder and other agents use the same objects."""
        agent = make()
        agent.reset(1)
        for observation in observations:
            before = observation.copy()
            agent.act(observation)
            assert np.array_equal(observation, before)

    def test_panels_are_pictures_and_change_nothing(
        self, make: Make, form: ActionForm, observations: list[NDArray[np.generic]]
    ) -> None:
        """`DrawsPanels`: panels do not change the agent's actions, can be drawn, and have different labels."""

        def drive(*, looked_at: bool) -> list[bytes]:
            agent = make()
            agent.reset(1)
            answers = []
            for observation in observations:
                answers.append(form.encode(agent.act(observation)).tobytes())
                if looked_at and supports(agent, DrawsPanels):
                    panels = labelled(agent.panels())
                    assert len(panels) == len({label for label, _ in panels})
                    for label, panel in panels:
                        assert panel.draw(label=label).dtype == np.uint8
            return answers

        assert drive(looked_at=True) == drive(looked_at=False)

    def test_it_can_be_closed_whenever_a_trial_may_end(
        self, make: Make, observations: list[NDArray[np.generic]]
    ) -> None:
        """`Closes`: an agent can be closed before its reset, after it and after an action; a new agent then drives."""
        for ends_after in (-1, 0, 1):
            agent = make()
            if ends_after >= 0:
                agent.reset(1)
            for observation in observations[: max(0, ends_after)]:
                agent.act(observation)
            if supports(agent, Closes):
                agent.close()
        agent = make()
        agent.reset(1)
        agent.act(observations[0])

    def test_the_libraries_that_it_needs_are_names(self, make: Make) -> None:
        """`NeedsLibraries`: the value is a sequence of module names, and not a single text."""
        kind = type(make())
        libraries: Sequence[str] = kind.libraries if supports(kind, NeedsLibraries) else ()
        assert not isinstance(libraries, str)
        assert all(part.isidentifier() for name in libraries for part in name.split("."))
