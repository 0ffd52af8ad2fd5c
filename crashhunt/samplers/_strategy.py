"""A strategy proposes points near what was dangerous; samplers are made of one or several."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.samplers._told import Told

__all__ = ["Draft", "Strategy", "reflected"]


@dataclass(frozen=True, slots=True, eq=False)
class Draft:
    """A point that is proposed.

    Args:
        point: in the cube.
        seed: of the trial; None for the one that its number has.
        parent: the number of the trial that it was made from; None where there is none.
        origin: which strategy proposes it, where there are several.
    """

    point: NDArray[np.float64]
    seed: int | None = None
    parent: int | None = None
    origin: str = ""


class Strategy(Protocol):
    """Learns from what is told, and proposes on that alone: what it proposed before changes nothing."""

    def propose(self, place: int, rng: np.random.Generator) -> Draft | None:
        """Return a draft, the one at a place from 0 among all; None for as long as there is too little to go by."""

    def tell(self, told: Told) -> None:
        """Learn how a trial ended, whoever proposed it."""


def reflected(point: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a point inside the cube: what is outside by a little is inside by as much."""
    inside: NDArray[np.float64] = np.abs(np.mod(point + 1.0, 2.0) - 1.0)
    return inside
