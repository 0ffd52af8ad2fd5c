"""The protocol of disturbance models: which disturbances of a kind are possible, and how likely each is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from collections.abc import Iterable

    import numpy as np


@dataclass(frozen=True, slots=True)
class Drawn:
    """A disturbance that a model has drawn."""

    who: str  # the place around the agent, one of `crashhunt.trial.CELLS`
    how_strong: float  # strength of the disturbance, in the unit of the kind
    how_long: float  # duration of the disturbance, in s


class DisturbanceModel(Protocol):
    """Draws the actor, strength and duration of disturbances of one kind; the hunt sets their rate.

    To give a model a name, register a factory that creates it, which is called without arguments::

        [project.entry-points."crashhunt.disturbances"]
        truck_cut_in = "mypackage.disturbances:TruckCutIn"

    Contract: `draw` uses only the random generator that it receives, and two models that were created in the same way
    draw the same values. The model draws one of countably many possibilities, and `log_likelihood` returns the
    probability of each. A model keeps no state.
    """

    @property
    def what(self) -> str:
        """The kind of disturbance, such as ``brake``."""

    def draw(self, rng: np.random.Generator) -> Drawn:
        """Draw a disturbance with the given random generator."""

    def log_likelihood(self, drawn: Drawn) -> float:
        """Return the natural logarithm of the probability of a draw; -inf if the model never draws it."""


@runtime_checkable
class Enumerates(Protocol):
    """A model that can list all its possible draws with their probabilities.

    With this list, crashhunt calculates the probability that a draw finds a target vehicle, without drawing.
    """

    def possibilities(self) -> Iterable[tuple[Drawn, float]]:
        """Return everything that `DisturbanceModel.draw` can return, each with its probability; the sum is 1."""


@runtime_checkable
class HoldsResources(Protocol):
    """A model that holds resources, which it releases when it is closed."""

    def close(self) -> None:
        """Release the resources; a second call does nothing."""
