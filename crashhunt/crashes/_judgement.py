"""Results of runs in which the agent of a collision is overruled: until when and how the collision could be avoided."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

from crashhunt.base.codec import Serializable, typed_where_there
from crashhunt.base.integrity import typed
from crashhunt.crashes._last_avoidable_step import Ending, last_avoiding
from crashhunt.trial import Value

if TYPE_CHECKING:
    from crashhunt.crashes._bundle import Bundle


# Results of runs with a reference driver: what the agent failed to do, since when, and for which actor.


Without = Literal["same", "other", "none", "unclear"]
"""What became of the collision: the same two again, another crash, none, or something that does not say it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceRun(Serializable):
    """One run in which a reference driver controls a part of the agent's driving."""

    faculty: str  # the controlled part: ``longitudinal``, ``lateral`` or ``both``
    step: int  # the step after which the reference driver takes control
    ending: Without  # what happened to the crash: ``none``, ``same``, ``other`` or ``unclear``
    changed: tuple[str, ...] = ()  # further differences from the recorded crash, such as ``ego does not change lanes``


@dataclass(frozen=True, slots=True, kw_only=True)
class Omission(Serializable):
    """An omission: something that the agent failed to do. In every run without the omission, there is no crash."""

    # the part of the driving with which a reference driver avoids the crash: ``longitudinal``, ``lateral`` or ``both``
    faculty: str
    # what the agent disregarded. On its path: ``vehicle``, ``red light`` or ``crossing`` (an actor with a crossing
    # path). In a lane change: ``ahead``, ``behind``, ``alongside`` or ``no lane``, followed by the side.
    kind: str
    actor: str  # identifier of the disregarded actor; empty for a red light and for a missing lane
    step: int  # the step after which the omission began
    # what the agent did instead: ``sped up``, ``kept its speed``, ``braked too little`` or ``changed lanes``. Whether
    # it sped up is decided over the last 2 s before the crash.
    instead: str
    speed_mps: float  # speed of the agent after that step, in m/s
    actor_speed_mps: float | None = None  # speed of the disregarded actor, in m/s; None if there is no such actor
    # gap between the agent and the actor or stop line, in m; negative if the vehicles are side by side. The gap is None
    # if there is neither an actor nor a stop line.
    gap_m: float | None = None
    # the safe speed for that gap, in m/s; for a lane change, the safe gap in m; None for a missing lane
    safe: float | None = None
    # the step after which an observation first contained the actor; None if the step is unknown
    visible_step: int | None = None
    # speed of the agent just before the crash, in m/s; None for a lane change, or if it is unknown
    last_speed_mps: float | None = None
    # time until the crash over which the agent's speed stayed within 0.5 m/s of the last speed, in s. It does not
    # exceed the time since the omission began. None for a lane change, or if it is unknown.
    kept_s: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Reference(Serializable):
    """The results of the runs with a reference driver."""

    omission: Omission | None = None  # the omission that caused the crash; None if the runs show none
    runs: tuple[ReferenceRun, ...] = ()  # all runs in which a reference driver acted
    why_not: str = ""  # why the result is missing or incomplete; empty if it is complete

    @property
    def deciding(self) -> tuple[ReferenceRun, ...]:
        """The runs on which the omission rests: of the same part of the driving, from its step or up to 1 s earlier."""
        omission = self.omission
        if omission is None:
            return ()
        return tuple(run for run in self.runs if run.faculty == omission.faculty and run.step <= omission.step)


# Whether models of a competent driver would have prevented a collision, according to runs in which they drive.


COMPETENT_DRIVERS = ("cc_human", "fsm", "rss", "reg157")
"""The models of a competent driver, in the order of their answers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DriverRun(Serializable):
    """The answer of one model of a competent driver."""

    model: str  # name of the model
    # whether the run with this model ends without the collision; None if the model does not apply or the run does not
    # decide it
    prevented: bool | None = None
    why_not: str = ""  # why there is no answer; empty if there is one
    # the step after which the model perceived the risk; None if it never did, or did not run
    perceived_step: int | None = None
    gap_m: float | None = None  # gap between the vehicles when the model perceived the risk, in m
    speed_mps: float | None = None  # speed of the agent then, in m/s
    other_speed_mps: float | None = None  # speed of the other vehicle then, in m/s
    # the smallest gap to the other vehicle in the own path after that, in m; None if there is no answer, or the
    # collision was not prevented
    margin_m: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Preventability(Serializable):
    """The answers of all models of a competent driver for one collision."""

    # the step after which the models watch the other vehicle: the first step at which the agent could see it
    since_step: int = 0
    runs: tuple[DriverRun, ...] = ()  # the answer of each model
    why_not: str = ""  # why no model applies; empty if at least one does

    @property
    def answers(self) -> dict[str, bool | None]:
        """Whether each model would have prevented the collision; None if that is unknown or it does not apply."""
        found = {run.model: run.prevented for run in self.runs}
        return {model: found.get(model) for model in COMPETENT_DRIVERS}

    @property
    def by_any(self) -> bool | None:
        """Whether any model would have prevented the collision; None if no model has an answer."""
        found = [answer for answer in self.answers.values() if answer is not None]
        return any(found) if found else None

    @property
    def perceived(self) -> DriverRun | None:
        """The run of the model that perceived the risk first; None if no model did."""
        seen = [run for run in self.runs if run.perceived_step is not None]
        return min(seen, key=lambda run: run.perceived_step or 0, default=None)


# The causes of a collision, found by runs that each omit one candidate cause.

_Z = 1.959963984540054  # of 95 % confidence


@dataclass(frozen=True, slots=True)
class LeftOut(Serializable):
    """One run without a suspected cause."""

    # the other value of an argument or seed; for every other factor, the step after which the factor was suppressed
    given: Value
    ending: Without  # the outcome of the run
    into: str = ""  # the actor that was hit by a vehicle whose speed was held constant; empty if there was none
    # further differences in the agent's behaviour in the run, such as ``ego does not change lanes``
    changed: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Factor(Serializable):
    """A possible cause of a crash, and the runs without it."""

    # type of the factor: ``argument``, ``seed``, ``disturbance``, ``other`` (a manoeuvre of another actor) or ``agent``
    kind: str
    name: str  # name of the argument or actor
    # for an argument ``default`` or ``drawn``; for a disturbance its type; else ``braked``, ``sped up``, ``changed
    # lanes``, or ``there`` if the presence of the actor is the factor
    what: str
    # the step after which the actor did this, or at which the disturbance began; None for arguments and seeds
    step: int | None = None
    # the value of an argument or a seed, or the speed in m/s at which a vehicle was held; None if neither applies
    was: Value | None = None
    runs: tuple[LeftOut, ...] = ()  # the runs without the factor

    json_keys = ("kind", "name", "what", "step", "was", "runs", "clear", "crashed", "same", "interval", "needed")

    @property
    def clear(self) -> int:
        """The number of runs with a clear outcome."""
        return sum(run.ending != "unclear" for run in self.runs)

    @property
    def crashed(self) -> int:
        """The number of runs with a clear outcome that crashed in any way."""
        return sum(run.ending in ("same", "other") for run in self.runs)

    @property
    def same(self) -> int:
        """The number of runs in which the same two actors collided."""
        return sum(run.ending == "same" for run in self.runs)

    @property
    def needed(self) -> bool | None:
        """Whether the crash needs the factor: True if no run without it crashed, False if all did, else None."""
        if not self.clear:
            return None
        return True if self.crashed == 0 else False if self.crashed == self.clear else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """The 95 % confidence interval (Wilson) for the share of runs without the factor that crash."""
        return wilson(self.crashed, self.clear) if self.clear else None


@dataclass(frozen=True, slots=True)
class Why(Serializable):
    """The results of a counterfactual analysis."""

    factors: tuple[Factor, ...] = ()  # the factors, in the order in which they were examined
    steps: int = 0  # number of steps after which a run with other arguments or seeds ended if it did not crash
    left: int = 0  # number of further runs that were skipped because of the limit
    why_not: str = ""  # why the answer is missing or incomplete; empty if the answer is complete

    json_keys = ("factors", "runs", "steps", "left", "why_not")

    @property
    def runs(self) -> int:
        """Number of trials that were run, not counting the unchanged trial."""
        return sum(len(factor.runs) for factor in self.factors)


def wilson(found: int, of: int) -> tuple[float, float]:
    """Return the 95 % confidence interval of a proportion by Wilson's method.

    Source: Wilson, *Probable inference, the law of succession, and statistical inference*, 1927.

    >>> low, high = wilson(3, 20)
    >>> f"{low:.3f} to {high:.3f}"
    '0.052 to 0.360'

    There is at least 1 run.
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
class Attempt(Serializable):
    """One evasive manoeuvre, tried from several steps on."""

    manoeuvre: str  # name of the manoeuvre, as in `Overruled`
    end: int  # number of the step in which the crash happened
    endings: Mapping[int, Ending]  # what happened to the crash, by the step after which the agent was overruled
    # the greatest deceleration in the runs that avoided the crash, in m/s²; None if the vehicle never slowed down
    deceleration: float | None = None
    # further differences in the agent's behaviour, in the run from the last step that avoids the crash
    changed: tuple[str, ...] = ()

    json_keys = (
        "manoeuvre", "endings=endings_by_step", "last_step", "too_late_step", "all_later_run", "deceleration",
        "changed",
    )  # fmt: skip

    @property
    def last_step(self) -> int | None:
        """The last step from which a run avoided the crash; None if no run avoided it."""
        return last_avoiding(self.endings)

    @property
    def too_late_step(self) -> int | None:
        """The step after the last avoidable step, if its run crashed; otherwise the first step whose run crashed."""
        last = self.last_step
        crashed = [step for step, ending in self.endings.items() if ending in ("hit", "other")]
        if last is None:
            return min(crashed, default=None)
        return last + 1 if last + 1 in crashed else None

    @property
    def all_later_run(self) -> bool:
        """Whether runs from all later steps up to the crash were made and all of them crashed."""
        return self.in_vain_from(0 if self.last_step is None else self.last_step + 1)

    def in_vain_from(self, step: int) -> bool:
        """Return whether the runs from this step and from every later step up to the crash were made and crashed."""
        return all(self.endings.get(each) in ("hit", "other") for each in range(step, self.end))

    @property
    def endings_by_step(self) -> dict[str, Ending]:
        """The endings in the order of the steps, for JSON."""
        return {str(step): self.endings[step] for step in sorted(self.endings)}


@dataclass(frozen=True, slots=True)
class Judgement(Serializable):
    """The results for all evasive manoeuvres of the agent; every result comes from a run."""

    attempts: tuple[Attempt, ...] = ()  # the results, one for each manoeuvre
    why_not: str = ""  # why the answer is missing or incomplete; empty if the answer is complete
    why: Why | None = None  # the causes of the collision; None if they were not examined
    # the step after which an observation of the agent first contained the collision partner; None if that is unknown
    visible_step: int | None = None
    reference: Reference | None = None  # the results of runs with a reference driver; None if there were no such runs
    drivers: Preventability | None = None  # the answers of models of a competent driver; None if they were not asked

    json_keys = (
        "avoidable", "manoeuvre", "last_step=best.last_step", "runs", "why_not", "attempts", "verdict", "visible_step",
        "why?", "reference?", "preventable_by", "drivers?",
    )  # fmt: skip

    @property
    def preventable_by(self) -> dict[str, bool | None]:
        """Whether each model of a competent driver would have prevented the collision; None if that is unknown."""
        return (self.drivers or Preventability()).answers

    @property
    def verdict(self) -> JudgementVerdict:
        """The verdict: whether the agent could have avoided the crash after it first observed the other vehicle."""
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
        """Whether the user interrupted the analysis; running it again may then add results."""
        parts = (self.why, self.reference, self.drivers)
        return INTERRUPTED in (self.why_not, *(part.why_not for part in parts if part is not None))

    @property
    def runs(self) -> int:
        """Number of trials that were run."""
        return sum(len(attempt.endings) for attempt in self.attempts)

    def others_from(self, step: int) -> int:
        """Return the number of runs from this step and from later steps in which another crash happened."""
        return sum(
            ending == "other" for attempt in self.attempts for after, ending in attempt.endings.items() if after >= step
        )

    @property
    def best(self) -> Attempt | None:
        """The manoeuvre that avoids the crash from the latest step; the first of several that are equally good."""
        helping = [attempt for attempt in self.attempts if attempt.last_step is not None]
        return max(helping, key=lambda attempt: attempt.last_step or 0, default=None)

    @property
    def avoidable(self) -> bool | None:
        """Whether the crash was avoidable: True if a run avoided it, False if all runs crashed, else None."""
        if self.best is not None:
            return True
        from_the_first = [attempt.endings.get(0) in ("hit", "other") for attempt in self.attempts]
        settled = all(ending in ("hit", "other") for attempt in self.attempts for ending in attempt.endings.values())
        return False if from_the_first and all(from_the_first) and settled and not self.why_not else None

    @property
    def manoeuvre(self) -> str:
        """The name of the manoeuvre that avoids the crash from the latest step; empty if there is none."""
        return self.best.manoeuvre if self.best else ""


def judgement_of(bundle: Bundle) -> Judgement | None:
    """Return the stored result of `judge` for a bundle; None if it is missing or cannot be read."""
    data: Any = bundle.added.get(_CRASH_JSON_KEY)
    try:
        typed_where_there(
            data,
            {
                "visible_step": int | None,
                "why_not": str,
                "why": dict | None,
                "reference": dict | None,
                "drivers": dict | None,
            },
        )
        attempts = []
        for each in data["attempts"]:
            typed(each, {"manoeuvre": str, "endings": dict[str, str], "deceleration": float | None})
            endings = {int(step): ending for step, ending in each["endings"].items()}
            attempts.append({**each, "end": bundle.result.steps, "endings": endings})
        return Judgement.from_json({**data, "attempts": attempts})
    except (ValueError, KeyError, TypeError, AttributeError):
        return None


def preventable_by(bundle: Bundle) -> dict[str, bool | None] | None:
    """Return whether each model of a competent driver would have prevented a crash; None if that was not asked."""
    judgement = judgement_of(bundle)
    return None if judgement is None or judgement.drivers is None else judgement.preventable_by


def with_judgement(bundle: Bundle, judgement: Judgement) -> Bundle:
    """Return a copy of a bundle that contains a judgement, to be written."""
    return replace(bundle, added={**bundle.added, _CRASH_JSON_KEY: judgement.to_json()})
