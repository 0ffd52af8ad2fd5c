"""Which crash a training episode begins with: the more often the agent has crashed in it, the more likely it is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

# The choice of the crash with which an episode begins: prioritized replay of crashes that the agent does not survive.
#
# The rule comes from Prioritized Level Replay (Jiang, Grefenstette and Rocktäschel, ICML 2021, arXiv:2010.03934):
#
#     P = (1 - rho) P_S + rho P_C,    P_S(i) ~ S(i)^(1/beta),    P_C(i) ~ c - C(i),
#
# with the scores S, the number c of the episode, and the number C(i) of the last episode that began with crash i. The
# second part selects crashes whose score may be out of date, so a crash that the agent survives no longer is selected
# again. In the paper on Prioritized Level Replay, the score is the agent's value loss. An environment does not know
# this loss, so the score here is the share of crashed episodes, as an exponential average that begins at 1. Scores are
# proportional, not ranked, because most of them are equal.


_STALENESS_SHARE = 0.1
"""rho; the value of the paper for Procgen."""
_TEMPERATURE = 1.0
"""beta; 1 draws in proportion to the score. The paper's 0.1 is for ranks."""
_FORGETTING_RATE = 0.2
"""Weight of the newest outcome in a score: about ten episodes change it by nine tenths."""


class CrashReplay:
    """Draws crashes, with probabilities that depend on how earlier episodes ended."""

    def __init__(self, count: int) -> None:
        self._is_usable = np.ones(count, bool)
        self.restart()

    def restart(self) -> None:
        """Delete all outcomes, so that the same seed gives the same draws. Removed crashes stay removed."""
        count = len(self._is_usable)
        self.scores: NDArray[np.float64] = np.ones(count)
        self._last = np.zeros(count)
        self._episodes = 0

    @property
    def is_empty(self) -> bool:
        """Whether all crashes have been removed."""
        return not self._is_usable.any()

    def probabilities(self) -> NDArray[np.float64]:
        """Return the probability of each crash in the next draw, shape (crashes,)."""
        scores = self._is_usable * self.scores ** (1 / _TEMPERATURE)
        if not scores.sum():
            scores = self._is_usable.astype(float)
        staleness = self._is_usable * (self._episodes - self._last)
        found: NDArray[np.float64] = scores / scores.sum()
        if staleness.sum():
            found = (1 - _STALENESS_SHARE) * found + _STALENESS_SHARE * staleness / staleness.sum()
        return found

    def draw(self, rng: np.random.Generator) -> int:
        """Draw a crash, and return its index."""
        index = int(rng.choice(len(self._is_usable), p=self.probabilities()))
        self._episodes += 1
        self._last[index] = self._episodes
        return index

    def record(self, index: int, *, has_crashed: bool) -> None:
        """Record how an episode that began with a crash ended."""
        self.scores[index] += _FORGETTING_RATE * (has_crashed - self.scores[index])

    def remove(self, index: int) -> None:
        """Remove a crash, so that it is never drawn again."""
        self._is_usable[index] = False
