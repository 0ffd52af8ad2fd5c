"""Independent draws."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from crashhunt.base.errors import UsageError
from crashhunt.samplers._protocol import HuntFacts, Proposal
from crashhunt.trial import Choice

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.samplers._protocol import Key, Space
    from crashhunt.trial import TrialResult, TrialSpec, Value


__all__ = ["Cube", "GridSampler", "HaltonSampler", "RandomSampler", "SobolSampler", "SweepSampler"]


class RandomSampler:
    """Draws every argument independently in every trial.

    Args:
        space: what to draw from.
        points: not used.
    """

    learns = False
    only_asked = False

    def __init__(self, space: Space, *, points: int = 10) -> None:
        self._space = sorted(space.items())

    @property
    def independent(self) -> bool:
        """Whether draws are independent; a class made of this one that draws in another way says so for itself."""
        return type(self).ask is RandomSampler.ask

    def ask(self, number: int, rng: np.random.Generator) -> Proposal:
        """Return a draw."""
        return Proposal({key: distribution.sample(rng) for key, distribution in self._space})

    def tell(self, result: TrialResult) -> None:
        """Nothing to learn."""


# Every combination in turn, and one argument in steps.


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
        points: number of steps, where the range has no step of its own.

    Raises:
        UsageError: none or several arguments vary.
    """

    def __init__(self, space: Space, *, points: int = 10) -> None:
        super().__init__(space, points=points)
        varying = [".".join(filter(None, key)) for key, values in self._axes if len(values) > 1]
        if len(varying) != 1:
            raise UsageError(
                f"a sweep needs exactly one varying argument, not: {', '.join(varying) or 'nothing'}",
                fix="name one, such as --arg speed=5:30:5",
            )


# A space of arguments as a cube: from 0 to 1 along each argument that varies, in shares of what is drawn of it.


class Cube:
    """The unit cube whose points represent arguments.

    Args:
        space: space of the arguments; those with one value have no dimension.
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
        """Return the point that represents the arguments of a trial; for whole numbers and choices, the middle."""
        return np.array(
            [
                known.share_of(spec.arguments[agent][name] if agent else spec.scenario_arguments[name])
                for (agent, name), known in self._axes.items()
            ]
        )


# Sequences that fill a space more evenly than independent draws do.
#
# Where a crash follows from a few arguments, they find it sooner; where it is up to the seed, they are as good as
# random.

_LONGEST = 2**30  # points that SciPy's Sobol sequence has; the next one is the first again


class HaltonSampler:
    """The sequence of Halton (1960), scrambled by the hunt's seed as Owen (2017) does.

    Args:
        space: what to fill.
        points: not used.
        hunt: whose seed scrambles it.
    """

    learns = False
    independent = False  # the trials of one hunt depend on each other, so that counts are no binomial draws
    only_asked = False
    wants_hunt = True
    sequence: ClassVar[str] = "Halton"

    def __init__(self, space: Space, *, points: int = 10, hunt: HuntFacts = HuntFacts()) -> None:  # noqa: B008
        self._cube = Cube(space)
        self._seed = hunt.seed
        self._points: Any = None

    def ask(self, number: int, rng: np.random.Generator) -> Proposal:
        """Return the arguments whose turn it is."""
        return Proposal(self._cube.arguments(self.point(number)))

    def tell(self, result: TrialResult) -> None:
        """Nothing to learn."""

    def point(self, number: int) -> NDArray[np.float64]:
        """Return the point whose turn it is, in the cube of the arguments that vary."""
        number %= _LONGEST
        if not self._cube.dimensions:
            return np.empty(0)
        if self._points is None:
            from scipy.stats import qmc  # the import takes most of a second, so only this sampler pays for it

            # Of its own, so that it has nothing to do with the trials' seeds.
            source = np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(0, 0)))
            self._points = getattr(qmc, self.sequence)(self._cube.dimensions, scramble=True, seed=source)
        if number < self._points.num_generated:
            self._points.reset()
        if number > self._points.num_generated:
            self._points.fast_forward(number - self._points.num_generated)
        point: NDArray[np.float64] = self._points.random(1)[0]
        return point


class SobolSampler(HaltonSampler):
    """The sequence of Sobol' (1967), scrambled by the hunt's seed as Matoušek (1998) does.

    The most even after 2, 4, 8 … trials.

    Args:
        space: what to fill; at most 21201 arguments that vary.
        points: not used.
        hunt: whose seed scrambles it.
    """

    sequence = "Sobol"
