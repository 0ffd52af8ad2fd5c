"""What every sampler must do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from crashhunt.samplers import Sampler, Space

__all__ = ["SamplerContract"]

Make = Callable[[Space], Sampler]


class SamplerContract:
    """Checks `crashhunt.samplers.Sampler`.

    The fixture ``make`` returns a function that makes a sampler of a space, and ``space`` one that it can sample.
    """

    @pytest.fixture
    def make(self) -> Make:
        """Return what makes a sampler."""
        raise NotImplementedError("give the suite a fixture named make")

    @pytest.fixture
    def space(self) -> Space:
        """Return a space."""
        raise NotImplementedError("give the suite a fixture named space")

    def _ask(self, sampler: Sampler, number: int) -> dict[Any, Any]:
        return sampler.ask(number, np.random.default_rng(np.random.SeedSequence(1, spawn_key=(number,))))

    def test_every_proposal_is_complete_and_inside_the_space(self, make: Make, space: Space) -> None:
        """A value for every key, and no other."""
        sampler = make(space)
        for number in range(50):
            proposal = self._ask(sampler, number)
            assert set(proposal) == set(space)
            assert all(space[key].contains(value) for key, value in proposal.items())

    def test_a_proposal_depends_on_number_and_generator_alone(self, make: Make, space: Space) -> None:
        """Before it has learnt anything, the order of asking does not matter."""
        forward, backward = make(space), make(space)
        asked = {number: self._ask(forward, number) for number in range(20)}
        assert {number: self._ask(backward, number) for number in reversed(range(20))} == asked

    def test_it_says_whether_it_learns(self, make: Make, space: Space) -> None:
        """The hunt asks before it tells."""
        sampler = make(space)
        assert isinstance(sampler.learns, bool)
        assert isinstance(sampler.only_asked, bool)
