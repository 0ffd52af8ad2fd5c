"""The contract suite for disturbance models."""

from __future__ import annotations

import math
import random
from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest

from crashhunt.disturbances import DisturbanceModel, Drawn
from crashhunt.trial import CELLS

Make = Callable[[], DisturbanceModel]

_DRAWS = 2000
_DEVIATIONS = 6.0  # of a share that is drawn from its probability: once in a billion by chance


class DisturbanceContract:
    """Checks a model against `crashhunt.disturbances.DisturbanceModel`.

    The fixture ``make`` returns a function that creates a model.
    """

    @pytest.fixture
    def make(self) -> Make:
        """Return a function that creates a disturbance model."""
        raise NotImplementedError("the test class must define the fixture 'make'")

    def test_what_is_drawn_is_a_disturbance(self, make: Make) -> None:
        """A draw has a place around the agent, a finite strength, and a duration above 0 s."""
        model = make()
        assert isinstance(model.what, str)
        assert model.what
        for drawn in _draws(model, seed=1):
            assert drawn.who in CELLS
            assert math.isfinite(drawn.how_strong)
            assert 0 < drawn.how_long < math.inf

    def test_the_generator_alone_decides(self, make: Make) -> None:
        """The model uses no other random generator, and keeps no state."""
        model = make()
        found = []
        for seed in (1, 2):
            random.seed(seed)
            np.random.seed(seed)  # noqa: NPY002 - detects draws from a global generator
            found.append(_draws(model, seed=3))
        # One by one: of two long lists that differ, pytest would print all differences in CI, which takes minutes.
        for number, drawn in enumerate(zip(*found, _draws(make(), seed=3), strict=True)):
            assert len({*drawn}) == 1, f"draw {number}"

    def test_the_likelihood_is_that_of_the_draws(self, make: Make) -> None:
        """Each draw has a positive probability and occurs with it, and the probabilities add up to at most 1."""
        model = make()
        counts = Counter(_draws(model, seed=5))
        total = 0.0
        for drawn, count in counts.items():
            chance = math.exp(model.log_likelihood(drawn))
            assert 0 < chance <= 1 + 1e-9
            total += chance
            deviation = math.sqrt(chance * (1 - min(chance, 1.0)) / _DRAWS)
            assert abs(count / _DRAWS - chance) <= _DEVIATIONS * deviation + 1e-9, drawn
        assert total <= 1 + 1e-9


def _draws(model: DisturbanceModel, *, seed: int) -> list[Drawn]:
    rng = np.random.default_rng(seed)
    return [model.draw(rng) for _ in range(_DRAWS)]
