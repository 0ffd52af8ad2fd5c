"""A space of arguments as a cube: from 0 to 1 along each argument that varies, in shares of what is drawn of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from crashhunt.trial import Choice

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.samplers._protocol import Key, Space
    from crashhunt.trial import TrialSpec, Value

__all__ = ["Cube"]


class Cube:
    """The points that stand for arguments.

    Args:
        space: of the arguments; those with one value have no dimension.
    """

    def __init__(self, space: Space) -> None:
        self._space = dict(sorted(space.items()))
        self._axes = {key: known for key, known in self._space.items() if known.quantile(0.0) != known.quantile(1.0)}
        self._fixed = {key: known.quantile(0.5) for key, known in self._space.items() if key not in self._axes}
        self.categorical = np.array([isinstance(known, Choice) for known in self._axes.values()], dtype=bool)
        """Of which dimensions the values have no order."""
        self.options = tuple(len(known.options) if isinstance(known, Choice) else 0 for known in self._axes.values())
        """Of how many values a dimension is a choice; 0 of those that have an order."""

    @property
    def dimensions(self) -> int:
        """How many arguments vary."""
        return len(self._axes)

    def arguments(self, point: NDArray[np.float64]) -> dict[Key, Value]:
        """Return the arguments for a point, with a coordinate from 0 to 1 for each that varies."""
        chosen = {
            key: known.quantile(share) for (key, known), share in zip(self._axes.items(), point.tolist(), strict=True)
        }
        return {key: chosen[key] if key in chosen else self._fixed[key] for key in self._space}

    def values(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points with the place of the value that is meant, instead of a share, where that is a choice."""
        if not self.categorical.any():
            return points
        options = np.array(self.options)
        places = np.minimum(np.floor(points * options), options - 1)
        return np.where(self.categorical, places, points)

    def point(self, spec: TrialSpec) -> NDArray[np.float64]:
        """Return the point that stands for the arguments of a trial; of whole numbers and choices, the middle."""
        return np.array(
            [
                known.share_of(spec.arguments[agent][name] if agent else spec.scenario_arguments[name])
                for (agent, name), known in self._axes.items()
            ]
        )
