"""What a collision hangs on, as runs have shown in which one thing each was left out."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypedDict

if TYPE_CHECKING:
    from crashhunt.trial import Value

__all__ = ["Factor", "FactorData", "LeftOut", "LeftOutData", "Why", "WhyData", "Without", "why_from", "wilson"]

Without = Literal["same", "other", "none", "unclear"]
"""What became of the collision: the same two again, another crash, none, or something that does not say it."""

_Z = 1.959963984540054  # of 95 % confidence


class LeftOutData(TypedDict):
    """A `LeftOut` as JSON."""

    given: Value
    ending: Without
    into: str


class FactorData(TypedDict):
    """A `Factor` as JSON."""

    kind: str
    name: str
    what: str
    step: int | None
    was: Value | None
    runs: list[LeftOutData]
    clear: int
    crashed: int
    same: int
    interval: tuple[float, float] | None
    needed: bool | None


class WhyData(TypedDict):
    """A `Why` as JSON."""

    factors: list[FactorData]
    runs: int
    steps: int
    left: int
    why_not: str


@dataclass(frozen=True, slots=True)
class LeftOut:
    """One run.

    Args:
        given: of an argument or a seed its other value, of everything else the step after which it was left out.
        ending: what became of the collision.
        into: whom a vehicle that was held to its speed drove into itself; empty for nobody.
    """

    given: Value
    ending: Without
    into: str = ""


@dataclass(frozen=True, slots=True)
class Factor:
    """Something that may be why, and the runs without it.

    Args:
        kind: ``argument``, ``seed``, ``disturbance``, ``other`` (something that somebody else did) or ``agent``.
        name: of the argument, or who.
        what: of an argument ``default`` or ``drawn``; of a disturbance its kind; of the others ``braked``, ``sped up``,
            ``changed lanes``, and ``there`` for that it was there at all.
        step: after which it did that, or at which the disturbance began; None of arguments and seeds.
        was: the value of an argument or a seed; the speed in m/s to which a vehicle was held; None for nothing.
        runs: without it.
    """

    kind: str
    name: str
    what: str
    step: int | None = None
    was: Value | None = None
    runs: tuple[LeftOut, ...] = ()

    @property
    def clear(self) -> int:
        """How many runs say something."""
        return sum(run.ending != "unclear" for run in self.runs)

    @property
    def crashed(self) -> int:
        """How many of these crashed all the same, in whatever way."""
        return sum(run.ending in ("same", "other") for run in self.runs)

    @property
    def same(self) -> int:
        """In how many the same two collided."""
        return sum(run.ending == "same" for run in self.runs)

    @property
    def needed(self) -> bool | None:
        """True where no run crashed without it, False where all did; None where that differs, or none says it."""
        if not self.clear:
            return None
        return True if self.crashed == 0 else False if self.crashed == self.clear else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """Between which shares of such runs crash, with 95 % confidence (Wilson's)."""
        return wilson(self.crashed, self.clear) if self.clear else None

    def to_json(self) -> FactorData:
        """Return plain data."""
        return {
            "kind": self.kind,
            "name": self.name,
            "what": self.what,
            "step": self.step,
            "was": self.was,
            "runs": [{"given": run.given, "ending": run.ending, "into": run.into} for run in self.runs],
            "clear": self.clear,
            "crashed": self.crashed,
            "same": self.same,
            "interval": self.interval,
            "needed": self.needed,
        }


@dataclass(frozen=True, slots=True)
class Why:
    """What has been found out.

    Args:
        factors: in the order in which they were looked at.
        steps: after how many a run ended that did not crash; of those with other arguments or seeds.
        left: how many runs more there would have been.
        why_not: why there is no answer, or not a whole one; empty where there is.
    """

    factors: tuple[Factor, ...] = ()
    steps: int = 0
    left: int = 0
    why_not: str = ""

    @property
    def runs(self) -> int:
        """How many trials were run for it, besides the one that must be as it was."""
        return sum(len(factor.runs) for factor in self.factors)

    def to_json(self) -> WhyData:
        """Return plain data."""
        return {
            "factors": [factor.to_json() for factor in self.factors],
            "runs": self.runs,
            "steps": self.steps,
            "left": self.left,
            "why_not": self.why_not,
        }


def why_from(data: Any) -> Why | None:
    """Rebuild what `Why.to_json` returned; None of what is none.

    Raises:
        ValueError, KeyError, TypeError: it is damaged.
    """
    if data is None:
        return None
    factors = [
        Factor(
            str(each["kind"]), str(each["name"]), str(each["what"]), each["step"], each["was"],
            tuple(LeftOut(run["given"], run["ending"], str(run["into"])) for run in each["runs"]),
        )
        for each in data["factors"]
    ]  # fmt: skip
    return Why(tuple(factors), int(data["steps"]), int(data["left"]), str(data["why_not"]))


def wilson(found: int, of: int) -> tuple[float, float]:
    """Return the interval of a share, with 95 % confidence.

    E. B. Wilson, *Probable inference, the law of succession, and statistical inference*, 1927.

    Args:
        found: how many.
        of: of how many; at least 1.
    """
    share, spread = found / of, _Z * _Z / of
    center, half = share + spread / 2, math.sqrt(spread * share * (1 - share) + spread * spread / 4)
    return max(0.0, (center - half) / (1 + spread)), min(1.0, (center + half) / (1 + spread))
