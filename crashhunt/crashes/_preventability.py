"""Whether models of a competent driver would have prevented a collision, according to runs in which they drive."""

from __future__ import annotations

from dataclasses import dataclass

from crashhunt.base.codec import Serializable

COMPETENT_DRIVERS = ("cc_human", "fsm", "rss", "reg157")
"""The models of a competent driver, in the order of their answers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DriverRun(Serializable):
    """The answer of one model of a competent driver.

    Args:
        model: name of the model.
        prevented: whether the run with this model ends without the collision; None if the model does not apply or the
            run does not decide it.
        why_not: why there is no answer; empty if there is one.
        perceived_step: the step after which the model perceived the risk; None if it never did, or did not run.
        gap_m: gap between the vehicles when the model perceived the risk, in m.
        speed_mps: speed of the agent then, in m/s.
        other_speed_mps: speed of the other vehicle then, in m/s.
        margin_m: the smallest gap to the other vehicle in the own path after that, in m; None if there is no answer,
            or the collision was not prevented.
    """

    model: str
    prevented: bool | None = None
    why_not: str = ""
    perceived_step: int | None = None
    gap_m: float | None = None
    speed_mps: float | None = None
    other_speed_mps: float | None = None
    margin_m: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Preventability(Serializable):
    """The answers of all models of a competent driver for one collision.

    Args:
        since_step: the step after which the models watch the other vehicle: the first step at which the agent could
            see it.
        runs: the answer of each model.
        why_not: why no model applies; empty if at least one does.
    """

    since_step: int = 0
    runs: tuple[DriverRun, ...] = ()
    why_not: str = ""

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
