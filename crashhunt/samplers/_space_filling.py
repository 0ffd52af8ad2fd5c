"""Samplers without learning: random draws, grids, sweeps and evenly distributed sequences."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from crashhunt.base.errors import UsageError
from crashhunt.samplers._protocol import HuntFacts, Key, Proposal, Space
from crashhunt.trial import Choice, point_of_signal

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.trial import TrialResult, TrialSpec, Value


class RandomSampler:
    """Draws every argument independently in every trial.

    Args:
        space: the space of the arguments to draw.
        points: ignored; other samplers need this argument.
    """

    learns = False
    only_asked = False

    def __init__(self, space: Space, *, points: int = 10) -> None:
        self._space = sorted(space.items())

    @property
    def independent(self) -> bool:
        """Whether draws are independent; a subclass that draws in another way overrides this property."""
        return type(self).ask is RandomSampler.ask

    def ask(self, number: int, rng: np.random.Generator) -> Proposal:
        """Return a random draw from the space."""
        return Proposal({key: distribution.sample(rng) for key, distribution in self._space})

    def tell(self, result: TrialResult) -> None:
        """Do nothing, because this sampler does not learn."""


# Every combination in turn, and one argument in steps.


class GridSampler:
    """Tries every combination of values in turn; after the last combination it starts again, with other seeds.

    Args:
        space: the axes of the grid; the axis whose name is last in alphabetical order varies fastest.
        points: number of values to try for a range without a step.

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
        """The number of combinations."""
        return math.prod(len(values) for _, values in self._axes)

    def ask(self, number: int, rng: np.random.Generator) -> Proposal:
        """Return the combination of values that belongs to the trial's number."""
        chosen: dict[Key, Value] = {}
        for key, values in reversed(self._axes):
            number, index = divmod(number, len(values))
            chosen[key] = values[index]
        return Proposal(chosen)

    def tell(self, result: TrialResult) -> None:
        """Do nothing, because this sampler does not learn."""


class SweepSampler(GridSampler):
    """Steps through one argument from its start to its end.

    Args:
        space: the space; exactly one argument must vary, the others are constants.
        points: number of values to try if the range has no step.

    Raises:
        UsageError: no argument varies, or several arguments vary.
    """

    def __init__(self, space: Space, *, points: int = 10) -> None:
        super().__init__(space, points=points)
        varying = [".".join(filter(None, key)) for key, values in self._axes if len(values) > 1]
        if len(varying) != 1:
            raise UsageError(
                f"a sweep needs exactly one varying argument, not: {', '.join(varying) or 'nothing'}",
                fix="give one range, such as --arg speed=5:30:5, and constants for the others",
            )


# A space of arguments as a cube: from 0 to 1 along each argument that varies, in shares of what is drawn of it.


class Cube:
    """The unit cube whose points represent arguments.

    Args:
        space: space of the arguments; arguments with only one value have no dimension.
    """

    def __init__(self, space: Space) -> None:
        self._space = dict(sorted(space.items()))
        self._axes = {key: known for key, known in self._space.items() if known.quantile(0.0) != known.quantile(1.0)}
        self._fixed = {key: known.quantile(0.5) for key, known in self._space.items() if key not in self._axes}
        self.categorical = np.array([isinstance(known, Choice) for known in self._axes.values()], dtype=bool)
        """Of which dimensions the values have no order."""
        self.options = tuple(len(known.options) if isinstance(known, Choice) else 0 for known in self._axes.values())
        """Of how many values a dimension is a choice; 0 of those that have an order."""
        self.signals = self._find_signals()
        """For each signal, the dimensions of its points, in the order of time."""

    def _find_signals(self) -> tuple[tuple[int, ...], ...]:
        found: dict[Key, list[tuple[int, int]]] = {}
        for dimension, (agent, name) in enumerate(self._axes):
            part = point_of_signal(name)
            if part is not None and (agent, part[0]) in self._space:
                found.setdefault((agent, part[0]), []).append((part[1], dimension))
        return tuple(tuple(dimension for _, dimension in sorted(points)) for points in found.values())

    @property
    def dimensions(self) -> int:
        """The number of arguments that vary."""
        return len(self._axes)

    def arguments(self, point: NDArray[np.float64]) -> dict[Key, Value]:
        """Return the arguments for a point, with a coordinate from 0 to 1 for each that varies."""
        chosen = {
            key: known.quantile(share) for (key, known), share in zip(self._axes.items(), point.tolist(), strict=True)
        }
        return {key: chosen[key] if key in chosen else self._fixed[key] for key in self._space}

    def values(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points in which the coordinate of each choice is replaced by the index of its value."""
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
    """Draws the sequence of Halton (1960), scrambled by the hunt's seed as in Owen (2017).

    Args:
        space: the space of the arguments.
        points: ignored; other samplers need this argument.
        hunt: facts about the hunt, whose seed scrambles the sequence.
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
        """Return the arguments that belong to the trial's number in the sequence."""
        return Proposal(self._cube.arguments(self.point(number)))

    def tell(self, result: TrialResult) -> None:
        """Do nothing, because this sampler does not learn."""

    def point(self, number: int) -> NDArray[np.float64]:
        """Return the point of the sequence for the given number, in the cube of the varying arguments."""
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
    """Draws the sequence of Sobol' (1967), scrambled by the hunt's seed as in Matoušek (1998).

    The sequence is most evenly distributed after 2, 4, 8 … trials.

    Args:
        space: the space of the arguments; at most 21201 arguments may vary.
        points: ignored; other samplers need this argument.
        hunt: facts about the hunt, whose seed scrambles the sequence.
    """

    sequence = "Sobol"
