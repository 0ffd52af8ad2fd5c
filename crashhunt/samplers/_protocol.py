"""The sampler protocol: which arguments the next trial gets."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

from crashhunt.trial import Distribution, Value

if TYPE_CHECKING:
    import numpy as np

    from crashhunt.trial import TrialResult

__all__ = ["Key", "Sampler", "Space"]

Key = tuple[str, str]
"""(agent id, argument name); the agent id is empty for an argument of the scenario."""

Space = Mapping[Key, Distribution]


class Sampler(Protocol):
    """Proposes arguments, and may learn from results.

    Contract: a proposal depends on the trial's number, its generator and the results told so far, never on time or
    on anything else. Results are told in the order of their numbers. A sampler that does not learn ignores them, so
    that the proposals for a number are the same however many trials run at once.

    A sampler is called with the space and, as a keyword, ``points``: how many values to try of a range that has no
    step of its own. One whose ``only_asked`` is true varies only what somebody asks for by name; everything else is
    a constant in its space.
    """

    learns: bool
    only_asked: bool

    def ask(self, number: int, rng: np.random.Generator) -> dict[Key, Value]:
        """Return a value for every key of the space.

        Args:
            number: of the trial, from 0.
            rng: the trial's own generator, the same for the same hunt seed and number.
        """

    def tell(self, result: TrialResult) -> None:
        """Learn how a trial ended."""
