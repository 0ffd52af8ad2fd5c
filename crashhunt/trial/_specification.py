"""What a trial is asked: everything that determines it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from crashhunt.base.errors import CrashhuntError
from crashhunt.base.tolerance import ESSENTIAL, known_values, not_understood, required_of
from crashhunt.base.version import __version__
from crashhunt.trial._disturbance import Disturbance
from crashhunt.world import Paths

if TYPE_CHECKING:
    from collections.abc import Mapping

    from crashhunt.trial._data import OverruledData, SpecData, SpecExtras
    from crashhunt.trial._space import Value

__all__ = ["EVERYBODY", "Overruled", "TrialSpec"]

EVERYBODY = "*"
"""In `TrialSpec.only`: nobody is left out, but who enters is written down."""


@dataclass(frozen=True, slots=True)
class Overruled:
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
    manoeuvre: str = field(default="brake", metadata=ESSENTIAL)
    keeps: str = field(default="", metadata=ESSENTIAL)

    def to_json(self) -> OverruledData:
        """Return plain data; what is at its default is left out."""
        plain: OverruledData = {"agent": self.agent, "after": self.after}
        if self.manoeuvre != "brake":
            plain["manoeuvre"] = self.manoeuvre
        if self.keeps:
            plain["keeps"] = self.keeps
        return plain


@dataclass(frozen=True, slots=True)
class TrialSpec:
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
    """

    number: int
    seed: int
    arguments: Mapping[str, Mapping[str, Value]]
    scenario_arguments: Mapping[str, Value]
    max_steps: int
    overruled: Overruled | None = field(default=None, metadata=ESSENTIAL)
    parent: int | None = None
    origin: str = ""
    disturbances: tuple[Disturbance, ...] = field(default=(), metadata=ESSENTIAL)
    only: tuple[str, ...] | None = field(default=None, metadata=ESSENTIAL)
    script: Paths | None = field(default=None, metadata=ESSENTIAL)

    def to_json(self) -> SpecData:
        """Return plain dicts and numbers."""
        more: SpecExtras = {}
        if self.overruled:
            more["overruled"] = self.overruled.to_json()
        if self.parent is not None:
            more["parent"] = self.parent
        if self.origin:
            more["origin"] = self.origin
        if self.disturbances:
            more["disturbances"] = [one.to_json() for one in self.disturbances]
        if self.only is not None:
            more["only"] = list(self.only)
        if self.script is not None:
            more["script"] = self.script.to_json()
        if requires := [*required_of(self), *(required_of(self.overruled) if self.overruled else ())]:
            more["requires"] = requires
        return {
            "number": self.number,
            "seed": self.seed,
            "arguments": {agent: dict(values) for agent, values in self.arguments.items()},
            "scenario_arguments": dict(self.scenario_arguments),
            "max_steps": self.max_steps,
            **more,
        }

    @classmethod
    def from_json(cls, data: SpecData) -> TrialSpec:
        """Rebuild what `to_json` returned, of any version: what it adds is left out, what it lacks is the default.

        Raises:
            CrashhuntError: it needs what this version does not know.
        """
        unknown = not_understood(data.get("requires") or (), cls, Overruled)
        if unknown:
            raise CrashhuntError(
                f"trial {data['number']} has {', '.join(unknown)}, which crashhunt {__version__} does not know",
                fix="use the version that wrote it",
            )
        overruled = data.get("overruled")
        return cls(
            data["number"],
            data["seed"],
            data.get("arguments", {}),
            data.get("scenario_arguments", {}),
            max_steps=data["max_steps"],
            overruled=Overruled(**known_values(Overruled, overruled)) if overruled else None,
            parent=data.get("parent"),
            origin=data.get("origin", ""),
            disturbances=tuple(map(Disturbance.from_json, data.get("disturbances") or ())),
            only=tuple(only) if (only := data.get("only")) is not None else None,
            script=Paths.from_json(script) if (script := data.get("script")) else None,
        )
