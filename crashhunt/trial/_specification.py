"""What a trial is asked: everything that determines it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

from crashhunt.base.codec import OMIT_DEFAULT, JsonObject, Serializable, from_plain, to_plain
from crashhunt.base.errors import CrashhuntError
from crashhunt.base.tolerance import ESSENTIAL, not_understood, required_of
from crashhunt.base.version import __version__
from crashhunt.trial._disturbance import Disturbance
from crashhunt.trial._space import Value
from crashhunt.world import Paths

__all__ = ["EVERYBODY", "Forcing", "Handover", "Overruled", "Reseeding", "TrialSpec"]

EVERYBODY = "*"
"""In `TrialSpec.only`: nobody is left out, but who enters is written down."""


_ESSENTIAL = {**ESSENTIAL, **OMIT_DEFAULT}


@dataclass(frozen=True, slots=True)
class Overruled(Serializable):
    """A trial in which an agent does not do as its code says: its vehicle brakes as hard as it can, or holds still.

    Args:
        agent: whose.
        after: the step after which it brakes; its first decision that is not its own is the one of the next step.
        manoeuvre: ``brake``; ``left`` or ``right`` also changes lanes to that side, in that first decision.
        keeps: ``lane`` or ``speed``: then the agent is asked on, and only what it says about that is passed over: the
            vehicle stays in its lane, or holds the speed that it has. There is no manoeuvre then.
    """

    agent: str
    after: int
    manoeuvre: str = field(default="brake", metadata=_ESSENTIAL)
    keeps: str = field(default="", metadata=_ESSENTIAL)


@dataclass(frozen=True, slots=True)
class Handover(Serializable):
    """A trial in which a recording drives a vehicle up to a step, and the vehicle's agent from that step on.

    Args:
        agent: the id of the vehicle.
        after: how many recorded actions are played; the agent makes its first decision in the next step.
        log: the path of the ``log.mcap`` with the recorded actions.
    """

    agent: str
    after: int
    log: str


@dataclass(frozen=True, slots=True)
class Reseeding(Serializable):
    """A trial whose simulator gets other seeds for its random generators after a step.

    Args:
        after: the step; the next step is the first that draws from the new seeds.
        seed: of all generators of the simulator; 0 to 2**31 - 1.
    """

    after: int
    seed: int


@dataclass(frozen=True, slots=True)
class Forcing(Serializable):
    """How copies of a root are given their first onset: a root is a trial without disturbances after its first step.

    Args:
        spacing: proposed probability per copy. One copy is made in each interval of this length.
        ratios: by cell, how many times more often than by its own law a first onset is proposed; 1 where it is missing.
            A cell is a model with one strength, such as ``brake=4.0``.
    """

    spacing: float
    ratios: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class TrialSpec(Serializable):
    """Everything that determines one trial.

    Args:
        number: its place in the hunt, from 0.
        seed: for the simulator, the agents and the global generators; 0 to 2**31 - 1.
        arguments: agent id to argument name to value.
        scenario_arguments: name to value.
        max_steps: the bound on its length, in steps.
        overruled: which agent is not asked any more, and from when on; None where all drive to the end.
        parent: the trial that the sampler made it from; None where there is none. It determines nothing.
        origin: the sampler's word on where it came from, such as the name of a strategy. It determines nothing.
        disturbances: who around the agents errs, and when; in the order of their steps.
        only: which of the others take part; None for all. A crash that was made smaller has it.
        script: recorded ways along which the others are moved, whatever anybody does; the agents begin where theirs
            do, and the traffic takes no part. None where the others drive.
        handover: which agent takes over from recorded actions, and when; None where all agents drive from the start.
        reseeding: when the simulator's generators get another seed; None where they keep that of the trial.
        forcing: how copies of it are disturbed; None where there are none. It determines nothing of the trial itself.
    """

    number: int
    seed: int
    arguments: Mapping[str, Mapping[str, Value]]
    scenario_arguments: Mapping[str, Value]
    max_steps: int
    overruled: Overruled | None = field(default=None, metadata=_ESSENTIAL)
    parent: int | None = field(default=None, metadata=OMIT_DEFAULT)
    origin: str = field(default="", metadata=OMIT_DEFAULT)
    disturbances: tuple[Disturbance, ...] = field(default=(), metadata=_ESSENTIAL)
    only: tuple[str, ...] | None = field(default=None, metadata=_ESSENTIAL)
    script: Paths | None = field(default=None, metadata=_ESSENTIAL)
    handover: Handover | None = field(default=None, metadata=_ESSENTIAL)
    reseeding: Reseeding | None = field(default=None, metadata=_ESSENTIAL)
    forcing: Forcing | None = field(default=None, metadata=OMIT_DEFAULT)

    def to_json(self) -> JsonObject:
        """Return plain dicts and numbers; ``requires`` names what another version must know."""
        data = to_plain(self)
        if requires := [*required_of(self), *(required_of(self.overruled) if self.overruled else ())]:
            data["requires"] = requires
        return data

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Rebuild what `to_json` returned, of any version: what it adds is left out, what it lacks is the default.

        Raises:
            CrashhuntError: it needs what this version does not know.
        """
        unknown = not_understood(data.get("requires") or (), cls, Overruled, Handover, Reseeding)
        if unknown:
            raise CrashhuntError(
                f"trial {data['number']} has {', '.join(unknown)}, which crashhunt {__version__} does not know",
                fix="use the version that wrote it",
            )
        return from_plain(cls, {"arguments": {}, "scenario_arguments": {}, **data})
