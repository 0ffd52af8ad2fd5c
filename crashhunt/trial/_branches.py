"""What else might have happened: copies of a trial that went on with other disturbances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from crashhunt.base.plain import finite
from crashhunt.base.tolerance import known_values
from crashhunt.trial._disturbance import Disturbance

if TYPE_CHECKING:
    from crashhunt.trial._data import BranchData, BranchesData

__all__ = ["Branch", "Branches"]


@dataclass(frozen=True, slots=True)
class Branch:
    """A branch that crashed, as a specification from the start.

    Args:
        disturbances: those of the trial up to where it branched, and those of the branch.
        branched: after which step it left the trial.
        outcome: of the branch.
        step: at which it ended.
        log_likelihood: that just what took place begins in these steps: the natural logarithm of the probability; None
            where it is none that the hunt's models would draw.
    """

    disturbances: tuple[Disturbance, ...]
    branched: int
    outcome: str
    step: int
    log_likelihood: float | None = None

    def to_json(self) -> BranchData:
        """Return plain text and numbers."""
        return {
            "disturbances": [one.to_json() for one in self.disturbances],
            "branched": self.branched,
            "outcome": self.outcome,
            "step": self.step,
            "log_likelihood": finite(self.log_likelihood) if self.log_likelihood is not None else None,
        }

    @classmethod
    def from_json(cls, data: BranchData) -> Branch:
        """Rebuild it from plain data."""
        found = tuple(map(Disturbance.from_json, data.get("disturbances") or ()))
        return cls(**known_values(cls, data) | {"disturbances": found})


@dataclass(frozen=True, slots=True)
class Branches:
    """What came of the branches of a trial.

    Args:
        moments: from how many copies went on.
        asked: how many branches there were.
        steps: how many steps they took.
        left_out: how many were left out, because branches had taken enough steps.
        crashes: those that crashed, in the order in which they were found.
        unanswered: how many more there were to be, of which no copy answered.
        why_unanswered: the reason for the first of them, in words; empty where there is none.
        may_be_asked_again: whether a reason lies outside of the trial, so that another run may get all answers.
    """

    moments: int = 0
    asked: int = 0
    steps: int = 0
    left_out: int = 0
    crashes: tuple[Branch, ...] = ()
    unanswered: int = 0
    why_unanswered: str = ""
    may_be_asked_again: bool = False

    @property
    def extent(self) -> str:
        """How much of it was asked, in words: "asked 12 of 13"."""
        return f"asked {self.asked} of {self.asked + self.unanswered}"

    def to_json(self) -> BranchesData:
        """Return plain text and numbers."""
        data: BranchesData = {
            "moments": self.moments,
            "asked": self.asked,
            "steps": self.steps,
            "left_out": self.left_out,
            "crashes": [one.to_json() for one in self.crashes],
        }
        if self.unanswered:
            data["unanswered"] = self.unanswered
            data["why_unanswered"] = self.why_unanswered
            data["may_be_asked_again"] = self.may_be_asked_again
        return data

    @classmethod
    def from_json(cls, data: BranchesData) -> Branches:
        """Rebuild it from plain data."""
        found = tuple(map(Branch.from_json, data.get("crashes") or ()))
        return cls(**known_values(cls, data) | {"crashes": found})
