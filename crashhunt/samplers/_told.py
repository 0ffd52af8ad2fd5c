"""What a sampler that learns makes of a result: a point, and a number that says how near to a crash it came."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from crashhunt.samplers._cube import Cube
    from crashhunt.samplers._protocol import HuntFacts
    from crashhunt.trial import TrialResult

__all__ = ["CRASHED", "Told", "told_of"]

CRASHED = 1.0
_NEAREST = 0.999  # of what is no crash
_NUMBER_AT_END = re.compile(r"[\W_]*\d+\W*$")  # of a lane: which of its road's it is


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """A trial that has ended.

    Args:
        number: of the trial.
        point: where it was in the cube.
        seed: of the trial.
        score: 0 to 1, `CRASHED` for a crash.
        origin: from which strategy it was.
        parent: the number of the trial that it was made from; None where there is none.
        kind: of a crash, its manner and its place as far as its result says so; empty where it does not.
    """

    number: int
    point: NDArray[np.float64]
    seed: int
    score: float
    origin: str = ""
    parent: int | None = None
    kind: str = ""

    @property
    def crashed(self) -> bool:
        """Whether it is what the hunt is after."""
        return self.score == CRASHED


def told_of(result: TrialResult, cube: Cube, hunt: HuntFacts) -> Told | None:
    """Return what there is to learn; None where it says nothing, as of a trial that could not be set up."""
    if result.outcome in hunt.crash_on:
        score = CRASHED
    elif result.danger is None or result.outcome.category != "no crash":
        return None  # a crash that nobody hunts for says nothing about those that somebody does
    else:
        score = min(max(result.danger, 0.0), _NEAREST)
    spec = result.spec
    kind = _kind(result) if score == CRASHED else ""
    return Told(spec.number, cube.point(spec), spec.seed, score, spec.origin, spec.parent, kind)


def _kind(result: TrialResult) -> str:
    """Return what tells crashes apart without their recordings: who drove into whom and where, or what was raised."""
    hit, failed, event = result.collision, result.failure, result.event
    words = [str(result.outcome)]
    if hit is not None:
        words += [hit.role, hit.kind, _NUMBER_AT_END.sub("", hit.lane)]
    elif failed is not None:
        words += [failed.kind, failed.agent]
    elif event is not None:
        words += [event.kind, _NUMBER_AT_END.sub("", event.lane)]
    else:
        return ""
    return " ".join(words)
