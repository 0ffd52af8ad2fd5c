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
            plausible; 1 where none did, 0 where it crashed without any.
        probes: how many copies were asked.
        steps: how many steps they took.
        left_out: how many questions were left out, because copies had taken enough steps.
        disturbance: the mildest that made it crash; None where none did.
        outcome: of that copy.
        step: at which it ended.
    """

    margin: float
    probes: int = 0
    steps: int = 0
    left_out: int = 0
    disturbance: Disturbance | None = None
    outcome: str = ""
    step: int = 0

    def to_json(self) -> StressData:
        """Return plain text and numbers."""
        return {
            "margin": self.margin,
            "probes": self.probes,
            "steps": self.steps,
            "left_out": self.left_out,
            "disturbance": self.disturbance.to_json() if self.disturbance is not None else None,
            "outcome": self.outcome,
            "step": self.step,
        }

    @classmethod
    def from_json(cls, data: StressData) -> Stress:
        """Rebuild it from plain data."""
        found = data.get("disturbance")
        return cls(**known_values(cls, data) | {"disturbance": Disturbance.from_json(found) if found else None})
