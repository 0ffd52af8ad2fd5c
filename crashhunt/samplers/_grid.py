"""Every combination in turn, and one argument in steps."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from crashhunt.base.errors import UsageError
from crashhunt.samplers._protocol import Proposal

if TYPE_CHECKING:
    import numpy as np

    from crashhunt.samplers._protocol import Key, Space
    from crashhunt.trial import TrialResult, Value

__all__ = ["GridSampler", "SweepSampler"]


class GridSampler:
    """Tries every combination of values in turn; after the last one it begins again, with other seeds.

    Args:
        space: the axes; the last one in order of its name varies fastest.
        points: how many values to try of a range that has no step of its own.

    Raises:
        UsageError: ``points`` is below 1.
    """

    learns = False
    independent = False  # in a hunt that ends in the middle, some values come more often than others
    only_asked = True

    def __init__(self, space: Space, *, points: int = 10) -> None:
        if points < 1:
            raise UsageError(f"points is {points}", fix="give at least 1")
        self._axes = [(key, distribution.grid(points)) for key, distribution in sorted(space.items())]

    @property
    def size(self) -> int:
        """How many combinations there are."""
        return math.prod(len(values) for _, values in self._axes)

    def ask(self, number: int, rng: np.random.Generator) -> Proposal:
        """Return the combination whose turn it is."""
        chosen: dict[Key, Value] = {}
        for key, values in reversed(self._axes):
            number, index = divmod(number, len(values))
            chosen[key] = values[index]
        return Proposal(chosen)

    def tell(self, result: TrialResult) -> None:
        """Nothing to learn."""


class SweepSampler(GridSampler):
    """Steps through one argument from its start to its end.

    Args:
        space: exactly one argument that varies; the others are constants.
        points: in how many steps, where the range has no step of its own.

    Raises:
        UsageError: none or several arguments vary.
    """

    def __init__(self, space: Space, *, points: int = 10) -> None:
        super().__init__(space, points=points)
        varying = [".".join(filter(None, key)) for key, values in self._axes if len(values) > 1]
        if len(varying) != 1:
            raise UsageError(
                f"a sweep is over one argument, and what varies is: {', '.join(varying) or 'nothing'}",
                fix="name one, such as --arg speed=5:30:5",
            )
