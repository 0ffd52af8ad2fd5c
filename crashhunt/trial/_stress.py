"""How little it would have taken: what copies of a trial have found out while it ran."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from crashhunt.base.tolerance import known_values
from crashhunt.trial._disturbance import Disturbance

if TYPE_CHECKING:
    from crashhunt.trial._data import StressData

__all__ = ["Stress"]


@dataclass(frozen=True, slots=True)
class Stress:
    """What came of asking copies of a trial.

    Args:
        margin: the strength of the mildest disturbance that made it crash, as a share of the strongest that is
            plausible; 1 where none did, 0 where it crashed without any. None where not all was asked.
        probes: how many copies were asked.
        steps: how many steps they took.
        left_out: how many questions were left out, because copies had taken enough steps.
        disturbance: the mildest that made it crash; None where none did.
        outcome: of that copy.
        step: at which it ended.
        moments: at how many moments copies were to be asked; 0 where an earlier version wrote it.
        moments_asked: at how many of these every copy that was asked answered.
        margin_upper_bound: where not all was asked, the margin of what was: the whole margin is not greater.
        why_unasked: why not all was asked, in words; empty where all was.
        may_be_asked_again: whether the reason lies outside of the trial, so that another run may get all answers.
    """

    margin: float | None
    probes: int = 0
    steps: int = 0
    left_out: int = 0
    disturbance: Disturbance | None = None
    outcome: str = ""
    step: int = 0
    moments: int = 0
    moments_asked: int = 0
    margin_upper_bound: float | None = None
    why_unasked: str = ""
    may_be_asked_again: bool = False

    @property
    def least(self) -> float:
        """The margin, or what it is at most where not all was asked."""
        found = self.margin_upper_bound if self.margin is None else self.margin
        return 1.0 if found is None else found

    @property
    def extent(self) -> str:
        """How much of it was asked, in words: "asked 1 of 9"."""
        return f"asked {self.moments_asked} of {self.moments}"

    def to_json(self) -> StressData:
        """Return plain text and numbers."""
        data: StressData = {
            "margin": self.margin,
            "probes": self.probes,
            "steps": self.steps,
            "left_out": self.left_out,
            "disturbance": self.disturbance.to_json() if self.disturbance is not None else None,
            "outcome": self.outcome,
            "step": self.step,
            "moments": self.moments,
            "moments_asked": self.moments_asked,
        }
        if self.margin is None:
            data["margin_upper_bound"] = self.margin_upper_bound
            data["why_unasked"] = self.why_unasked
            data["may_be_asked_again"] = self.may_be_asked_again
        return data

    @classmethod
    def from_json(cls, data: StressData) -> Stress:
        """Rebuild it from plain data."""
        found = data.get("disturbance")
        return cls(**known_values(cls, data) | {"disturbance": Disturbance.from_json(found) if found else None})
