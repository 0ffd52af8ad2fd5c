"""Results of runs of a collision with its agent overridden: until when and how the collision could be avoided."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

from crashhunt.base.codec import JsonObject, Serializable
from crashhunt.base.integrity import typed
from crashhunt.crashes._omission import Reference, Without
from crashhunt.trial import Value

if TYPE_CHECKING:
    from collections.abc import Mapping

    from crashhunt.crashes._bundle import Bundle
    from crashhunt.crashes._escape import Ending


__all__ = [
    "INTERRUPTED",
    "Attempt",
    "Factor",
    "Judgement",
    "JudgementVerdict",
    "LeftOut",
    "Why",
    "Without",
    "judgement_of",
    "why_from",
    "wilson",
    "with_judgement",
]


# The causes of a collision, found by runs that each omit one candidate cause.

_Z = 1.959963984540054  # of 95 % confidence


@dataclass(frozen=True, slots=True)
class LeftOut(Serializable):
    """One run.

    Args:
        given: The other value of an argument or seed; for every other cause, the step after which it was suppressed.
        ending: The result of the run.
        into: The actor into which a vehicle with held speed drove itself; empty if there was none.
        changed: Further differences of the agent in the run, such as ``ego does not change lanes``.
    """

    given: Value
    ending: Without
    into: str = ""
    changed: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Factor(Serializable):
    """Something that may be why, and the runs without it.

    Args:
        kind: ``argument``, ``seed``, ``disturbance``, ``other`` (a manoeuvre of another actor) or ``agent``.
        name: name of the argument or actor.
        what: of an argument ``default`` or ``drawn``; of a disturbance its kind; of the others ``braked``, ``sped up``,
            ``changed lanes``, and ``there`` for that it was there at all.
        step: after which it did that, or at which the disturbance began; None of arguments and seeds.
        was: the value of an argument or a seed; the speed in m/s to which a vehicle was held; None for nothing.
        runs: runs without it.
    """

    kind: str
    name: str
    what: str
    step: int | None = None
    was: Value | None = None
    runs: tuple[LeftOut, ...] = ()

    json_keys = ("kind", "name", "what", "step", "was", "runs", "clear", "crashed", "same", "interval", "needed")

    @property
    def clear(self) -> int:
        """The number of runs with a clear result."""
        return sum(run.ending != "unclear" for run in self.runs)

    @property
    def crashed(self) -> int:
        """Number of these runs that crashed, in any way."""
        return sum(run.ending in ("same", "other") for run in self.runs)

    @property
    def same(self) -> int:
        """In how many the same two collided."""
        return sum(run.ending == "same" for run in self.runs)

    @property
    def needed(self) -> bool | None:
        """True if no run without the factor crashed, False if all crashed; None if runs differ or are unclear."""
        if not self.clear:
            return None
        return True if self.crashed == 0 else False if self.crashed == self.clear else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """The interval of the share of such runs that crash, with 95 % confidence (Wilson's)."""
        return wilson(self.crashed, self.clear) if self.clear else None


@dataclass(frozen=True, slots=True)
class Why(Serializable):
    """The results of an analysis.

    Args:
        factors: factors in the order in which they were looked at.
        steps: number of steps after which a run with other arguments or seeds ended if it did not crash.
        left: number of further runs that the limit prevented.
        why_not: why there is no answer, or not a whole one; empty if there is.
    """

    factors: tuple[Factor, ...] = ()
    steps: int = 0
    left: int = 0
    why_not: str = ""

    json_keys = ("factors", "runs", "steps", "left", "why_not")

    @property
    def runs(self) -> int:
        """Number of trials that were run, without the unchanged one."""
        return sum(len(factor.runs) for factor in self.factors)


def why_from(data: Any) -> Why | None:
    """Return the `Why` of the data of `Why.to_json`; None for no data.

    Raises:
        ValueError, KeyError, TypeError: it is damaged.
    """
    if data is None:
        return None
    factors = [
        Factor(
            kind=str(each["kind"]), name=str(each["name"]), what=str(each["what"]), step=each["step"], was=each["was"],
            runs=tuple(
                LeftOut(
                    given=run["given"],
                    ending=run["ending"],
                    into=str(run["into"]),
                    changed=tuple(map(str, run.get("changed", ()))),
                )
                for run in each["runs"]
            ),
        )
        for each in data["factors"]
    ]  # fmt: skip
    return Why(factors=tuple(factors), steps=int(data["steps"]), left=int(data["left"]), why_not=str(data["why_not"]))


def wilson(found: int, of: int) -> tuple[float, float]:
    """Return the interval of a share, with 95 % confidence.

    E. B. Wilson, *Probable inference, the law of succession, and statistical inference*, 1927.

    >>> low, high = wilson(3, 20)
    >>> f"{low:.3f} to {high:.3f}"
    '0.052 to 0.360'

    Args:
        found: how many.
        of: number of all runs; at least 1.
    """
    share, spread = found / of, _Z * _Z / of
    center, half = share + spread / 2, math.sqrt(spread * share * (1 - share) + spread * spread / 4)
    return max(0.0, (center - half) / (1 + spread)), min(1.0, (center + half) / (1 + spread))


INTERRUPTED = "it was interrupted"
"""The reason for an incomplete answer if the user has stopped the analysis."""

_CRASH_JSON_KEY = "judged"

JudgementVerdict = Literal["avoidable", "too late when visible", "invalid", "unknown"]
"""Whether the crash could be avoided once the agent could see the collision partner.

The verdict ``too late when visible`` means that it was then too late. The verdict ``invalid`` means that it was never
avoidable, so the trial says nothing about the agent. The verdict ``unknown`` means that the runs do not decide it."""


@dataclass(frozen=True, slots=True)
class Attempt:
    """One manoeuvre, tried from several steps on.

    Args:
        manoeuvre: as in `Overruled`.
        end: the step of the crash.
        endings: step to what became of it where the agent was overruled after that step.
        deceleration: the greatest in the runs that avoided the crash, in m/s²; None if it never slowed down.
        changed: What else the agent does otherwise in the run from the last step that avoids the crash.
    """

    manoeuvre: str
    end: int
    endings: Mapping[int, Ending]
    deceleration: float | None = None
    changed: tuple[str, ...] = ()

    @property
    def last_step(self) -> int | None:
        """The last step after which a run avoided it; None if none did."""
        return max((step for step, ending in self.endings.items() if ending == "avoided"), default=None)

    @property
    def too_late_step(self) -> int | None:
        """The step after the last avoidable step, if its run crashed; else the first crashed one."""
        last = self.last_step
        crashed = [step for step, ending in self.endings.items() if ending in ("hit", "other")]
        if last is None:
            return min(crashed, default=None)
        return last + 1 if last + 1 in crashed else None

    @property
    def all_later_run(self) -> bool:
        """Whether a run from every later step up to the crash was made, and crashed."""
        return self.in_vain_from(0 if self.last_step is None else self.last_step + 1)

    def in_vain_from(self, step: int) -> bool:
        """The step from which on every run up to the crash was made, and crashed; None if there is none."""
        return all(self.endings.get(each) in ("hit", "other") for each in range(step, self.end))

    def to_json(self) -> JsonObject:
        """Return plain data."""
        return {
            "manoeuvre": self.manoeuvre,
            "endings": {str(step): self.endings[step] for step in sorted(self.endings)},
            "last_step": self.last_step,
            "too_late_step": self.too_late_step,
            "all_later_run": self.all_later_run,
            "deceleration": self.deceleration,
            "changed": list(self.changed),
        }


@dataclass(frozen=True, slots=True)
class Judgement:
    """The results of all manoeuvres; every result is from a run.

    Args:
        attempts: a manoeuvre each.
        why_not: why there is no answer, or not a whole one; empty if there is.
        why: The causes of the collision; None if they were not examined.
        visible_step: The step after which an observation first had the collision partner; None if it is unknown.
        reference: What runs with a reference driver have shown; None if there were none.
    """

    attempts: tuple[Attempt, ...] = ()
    why_not: str = ""
    why: Why | None = None
    visible_step: int | None = None
    reference: Reference | None = None

    @property
    def verdict(self) -> JudgementVerdict:
        """The verdict: whether the agent could avoid the crash after it could observe the other vehicle."""
        best, visible = self.best, self.visible_step
        if self.avoidable is False and self.attempts[0].endings[0] == "hit":
            return "invalid"
        if visible is not None and best is not None and (best.last_step or 0) >= visible:
            return "avoidable"
        if visible and self.attempts and all(attempt.in_vain_from(visible) for attempt in self.attempts):
            return "too late when visible"
        return "avoidable" if best is not None and visible is None else "unknown"

    @property
    def is_interrupted(self) -> bool:
        """Whether the user interrupted the analysis, so that another run may add results."""
        parts = (self.why, self.reference)
        return INTERRUPTED in (self.why_not, *(part.why_not for part in parts if part is not None))

    @property
    def runs(self) -> int:
        """Number of trials that were run."""
        return sum(len(attempt.endings) for attempt in self.attempts)

    @property
    def best(self) -> Attempt | None:
        """The manoeuvre that helps longest; braking, where another helps no longer."""
        helping = [attempt for attempt in self.attempts if attempt.last_step is not None]
        return max(helping, key=lambda attempt: attempt.last_step or 0, default=None)

    @property
    def avoidable(self) -> bool | None:
        """Whether a run avoided the crash; False if no run did, even from the first step; None if it is unknown."""
        if self.best is not None:
            return True
        from_the_first = [attempt.endings.get(0) in ("hit", "other") for attempt in self.attempts]
        settled = all(ending in ("hit", "other") for attempt in self.attempts for ending in attempt.endings.values())
        return False if from_the_first and all(from_the_first) and settled and not self.why_not else None

    def to_json(self) -> JsonObject:
        """Return plain data."""
        best = self.best
        found: JsonObject = {
            "avoidable": self.avoidable,
            "manoeuvre": best.manoeuvre if best else "",
            "last_step": best.last_step if best else None,
            "runs": self.runs,
            "why_not": self.why_not,
            "attempts": [attempt.to_json() for attempt in self.attempts],
            "verdict": self.verdict,
            "visible_step": self.visible_step,
        }
        if self.why is not None:
            found["why"] = self.why.to_json()
        if self.reference is not None:
            found["reference"] = self.reference.to_json()
        return found


def judgement_of(bundle: Bundle) -> Judgement | None:
    """Return the result of `judge` in a bundle; None if there is none, or if it cannot be read."""
    data: Any = bundle.added.get(_CRASH_JSON_KEY)
    try:
        attempts = []
        for each in data["attempts"]:
            typed(each, {"manoeuvre": str, "endings": dict[str, str], "deceleration": float | None})
            endings: dict[int, Ending] = {int(step): ending for step, ending in each["endings"].items()}
            attempts.append(
                Attempt(
                    manoeuvre=each["manoeuvre"],
                    end=bundle.result.steps,
                    endings=endings,
                    deceleration=each["deceleration"],
                    changed=tuple(map(str, each.get("changed", ()))),
                )
            )
        visible = data.get("visible_step")
        seen = int(visible) if visible is not None else None
        reference = data.get("reference")
        return Judgement(
            attempts=tuple(attempts),
            why_not=str(data.get("why_not", "")),
            why=why_from(data.get("why")),
            visible_step=seen,
            reference=Reference.from_json(reference) if reference is not None else None,
        )
    except (ValueError, KeyError, TypeError, AttributeError):
        return None


def with_judgement(bundle: Bundle, judgement: Judgement) -> Bundle:
    """Return a bundle with a judgement, to be written."""
    return replace(bundle, added={**bundle.added, _CRASH_JSON_KEY: judgement.to_json()})
