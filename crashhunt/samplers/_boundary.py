"""A sampler that maps where an agent crashes: it searches the boundary of the crashes on a grid."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.base.errors import UsageError
from crashhunt.samplers._protocol import HuntFacts, Proposal, Space
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.trial import TrialResult

SAMPLE, BOUNDARY = "sample", "boundary"
"""Origins of the trials: drawn at random from the grid, and chosen next to the boundary."""

_SAMPLE_SHARE, _LEAST_SAMPLE = 0.1, 16
_MOST_CELLS = 1_000_000


def nearest_labels(shape: tuple[int, ...], labels: dict[int, bool]) -> NDArray[np.bool_]:
    """Return a label for each cell of a grid: its own, or that of the nearest cell with a label.

    The distance is the sum of the distances along all axes, in shares of the length of the axis.

    Args:
        shape: number of values along each axis.
        labels: known labels by the index of the cell; at least one.
    """
    from scipy.spatial import cKDTree  # the import is slow, and only this sampler needs it

    known = np.fromiter(labels, dtype=int)
    scale = np.maximum(1, np.array(shape) - 1)
    cells = np.stack(np.unravel_index(np.arange(math.prod(shape)), shape), axis=1) / scale
    nearest = cKDTree(cells[known]).query(cells, p=1)[1]
    found: NDArray[np.bool_] = np.fromiter(labels.values(), dtype=bool)[nearest]
    return found


class BoundarySampler:
    """Maps the region of crashes on a grid of arguments with fewer trials than the whole grid.

    The first trials are a tenth of the grid, at least 16, drawn at random without repetition. Every other cell is then
    assumed to end like the nearest cell that has run. In rounds, the sampler runs the cells whose neighbour along an
    axis is assumed to end differently. The hunt ends if no such cell is left, or after the whole grid. Regions that are
    smaller than the distance between the random cells may be missed.

    Args:
        space: the axes of the grid.
        points: number of values to try for a range without a step.
        hunt: facts about the hunt: its seed, and the outcomes that count as a crash.

    Raises:
        UsageError: ``points`` is below 1, or the grid has more than 1,000,000 cells.
    """

    learns = True
    only_asked = True
    wants_hunt = True

    def __init__(self, space: Space, *, points: int = 10, hunt: HuntFacts = HuntFacts()) -> None:  # noqa: B008
        if points < 1:
            raise UsageError(f"points is {points}", fix="give at least 1")
        self._keys = sorted(space)
        self._axes = [space[key].grid(points) for key in self._keys]
        self._shape = tuple(len(values) for values in self._axes)
        if self.size > _MOST_CELLS:
            raise UsageError(f"the grid has {self.size:,} cells (allowed: {_MOST_CELLS:,})", fix="give larger steps")
        self._crash_on = frozenset(hunt.crash_on)
        order = np.random.default_rng(np.random.SeedSequence(hunt.seed, spawn_key=(0, 1))).permutation(self.size)
        sample = min(self.size, max(_LEAST_SAMPLE, round(self.size * _SAMPLE_SHARE)))
        self._batch = [int(cell) for cell in order[:sample]]
        self._origin = SAMPLE
        self._begin = self._told = 0
        self._done: set[int] = set()
        self._labels: dict[int, bool] = {}
        self._index = [{value: place for place, value in enumerate(values)} for values in self._axes]

    @property
    def size(self) -> int:
        """The number of cells of the grid."""
        return math.prod(self._shape)

    def ask(self, number: int, rng: np.random.Generator) -> Proposal | None:
        """Return the next cell; None until all trials of a round have been reported, and after the last round."""
        place = number - self._begin
        if not 0 <= place < len(self._batch):
            return None
        places = np.unravel_index(self._batch[place], self._shape)
        values = (axis[int(at)] for axis, at in zip(self._axes, places, strict=True))
        return Proposal(dict(zip(self._keys, values, strict=True)), origin=self._origin)

    def tell(self, result: TrialResult) -> None:
        """Learn how a cell ended; after the last cell of a round, choose the cells of the next round."""
        self._told += 1
        cell = self._cell_of(result)
        self._done.add(cell)
        if result.outcome is not Outcome.INVALID:
            self._labels[cell] = result.outcome in self._crash_on
        if self._told == self._begin + len(self._batch):
            is_first = self._origin == SAMPLE
            self._begin, self._origin = self._told, BOUNDARY
            self._batch = (self._corners() if is_first else []) or (self._frontier() if self._labels else [])

    def _cell_of(self, result: TrialResult) -> int:
        spec = result.spec
        values = [spec.arguments[agent][name] if agent else spec.scenario_arguments[name] for agent, name in self._keys]
        places = [values_at[value] for values_at, value in zip(self._index, values, strict=True)]
        return int(np.ravel_multi_index(places, self._shape))

    def _corners(self) -> list[int]:
        """Return the corners of the grid that have not run: the extreme cases, where small regions often are."""
        ends = [sorted({0, length - 1}) for length in self._shape]
        cells = (int(np.ravel_multi_index(places, self._shape)) for places in itertools.product(*ends))
        return [cell for cell in cells if cell not in self._done]

    def _frontier(self) -> list[int]:
        """Return the cells that have not run, and have a neighbour that ends differently, as far as is known.

        Of two neighbours, only the cell with an even sum of indices is returned first. Its result may show that the
        other cell is not at the boundary.
        """
        labels = nearest_labels(self._shape, self._labels).reshape(self._shape)
        at_boundary = np.zeros(self._shape, bool)
        for axis in range(len(self._shape)):
            differs = np.diff(labels, axis=axis)
            ends = [(0, 0)] * len(self._shape)
            for ends[axis] in ((0, 1), (1, 0)):
                at_boundary |= np.pad(differs, ends)
        cells = [int(cell) for cell in np.flatnonzero(at_boundary) if int(cell) not in self._done]
        even = [cell for cell in cells if sum(map(int, np.unravel_index(cell, self._shape))) % 2 == 0]
        return even or cells
