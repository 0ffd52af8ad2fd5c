"""The protocol of models: which disturbances of a kind there are, and how likely each is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from collections.abc import Iterable

    import numpy as np

__all__ = ["Closes", "DisturbanceModel", "Drawn", "Enumerates"]


@dataclass(frozen=True, slots=True)
class Drawn:
    """A disturbance that a model has drawn.

    Args:
        who: the place in the grid around the agent, one of `crashhunt.trial.CELLS`.
        how_strong: strength in the unit of the kind.
        how_long: duration in s.
    """

    who: str
    how_strong: float
    how_long: float


class DisturbanceModel(Protocol):
    """Draws the actor, strength and duration of disturbances of one kind; the hunt sets their rate.

    To give one a name, register what makes it, called without arguments::

        [project.entry-points."crashhunt.disturbances"]
        truck_cut_in = "mypackage.disturbances:TruckCutIn"

    Contract: `draw` draws from its argument alone, and two models that were made alike draw alike. The model draws one
        of countably many possibilities; `log_likelihood` returns the probability of each. A model keeps no state.
    """

    @property
    def what(self) -> str:
        """The kind of disturbance, such as ``brake``."""

    def draw(self, rng: np.random.Generator) -> Drawn:
        """Draw a disturbance with the given generator."""

    def log_likelihood(self, drawn: Drawn) -> float:
        """Return the natural logarithm of the probability of a draw; -inf if the model never draws it."""


@runtime_checkable
class Enumerates(Protocol):
    """A model that can list all its draws, so that draws without a target vehicle can be skipped in closed form."""

    def possibilities(self) -> Iterable[tuple[Drawn, float]]:
        """Return everything that `DisturbanceModel.draw` can return, each with its probability; the sum is 1."""


@runtime_checkable
class Closes(Protocol):
    """A model that has something to end."""

    def close(self) -> None:
        """End it; may be called twice."""
