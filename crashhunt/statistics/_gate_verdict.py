"""The verdict of a gate about two agents: better, worse, no difference above a margin, or undecided."""

from __future__ import annotations

from typing import Literal

from crashhunt.statistics._paired_test import PairTest

PairVerdict = Literal["better", "worse", "no_difference", "undecided"]
"""The verdict of pairs on the second agent, compared with the first."""


class PairWatch:
    """Watches two agents until one agent certainly fails more often, or both certainly fail about equally often.

    The pairs are evaluated in order, one after another. After a decision, later pairs do not count, so the verdict does
    not depend on the number of workers. The probability of each wrong verdict is at most `alpha`: *better* or *worse*
    if both agents fail equally often, and *no difference* if the difference is above the margin.

    Args:
        margin: the greatest difference in failures per trial that counts as no difference; 0 to disable this verdict.
        alpha: maximum probability of a wrong verdict.
    """

    def __init__(self, margin: float, alpha: float = 0.05) -> None:
        self.margin, self.alpha = margin, alpha
        self.test = PairTest()
        self.verdict: PairVerdict = "undecided"

    def decide(self, *, may_end: bool = True) -> PairVerdict:
        """Return the verdict on the pairs that were added to the test; the first verdict is final.

        Unless it ``may_end``, the verdicts *better* and *no difference* are not allowed yet; *worse* is always allowed.
        """
        if self.verdict == "undecided":
            worse = self.test.verdict(self.alpha)
            if worse == "second" or (worse and may_end):
                self.verdict = "worse" if worse == "second" else "better"
            elif not worse and may_end and self.margin and self.test.is_within(self.margin, self.alpha):
                self.verdict = "no_difference"
        return self.verdict
