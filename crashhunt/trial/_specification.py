"""The specification of a trial, which determines the trial completely."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

from crashhunt.base.codec import (
    ESSENTIAL,
    OMIT_DEFAULT,
    JsonObject,
    Serializable,
    from_plain,
    not_understood,
    required_of,
    to_plain,
)
from crashhunt.base.errors import CrashhuntError
from crashhunt.base.version import __version__
from crashhunt.trial._argument_distributions import Value
from crashhunt.trial._disturbance import Disturbance
from crashhunt.world import Paths

ALL_AGENTS = "*"
"""In `TrialSpec.only`: no actor is excluded, but the trial records which actors enter."""


_ESSENTIAL_METADATA = {**ESSENTIAL, **OMIT_DEFAULT}


@dataclass(frozen=True, slots=True)
class Overruled(Serializable):
    """An override of an agent's actions: its vehicle brakes fully, or keeps its lane or its speed.

    Args:
        agent: Identifier of the agent.
        after: The last step without the override; in the next step, an action is overridden for the first time.
        manoeuvre: either ``brake``, or ``left`` or ``right``, which also changes to the lane on that side in the first
            step.
        keeps: either ``lane`` or ``speed``: the agent still acts, but the vehicle keeps its lane or its current speed.
            In this case, the manoeuvre has no effect.
        reference: either ``longitudinal``, ``lateral`` or ``both``: the agent still acts, and a reference driver
            corrects its speeds, its lane changes, or both, where they are not safe. ``none``: the reference driver only
            reports where it would correct the agent. In these cases, the manoeuvre and ``keeps`` have no effect.
            The name of a model of a competent driver, such as ``cc_human``: the agent drives until the model perceives
            a risk, and the model controls the speed from then on.
        other: Identifier of the actor to which a model of a competent driver reacts.
    """

    agent: str
    after: int
    manoeuvre: str = field(default="brake", metadata=_ESSENTIAL_METADATA)
    keeps: str = field(default="", metadata=_ESSENTIAL_METADATA)
    reference: str = field(default="", metadata=_ESSENTIAL_METADATA)
    other: str = field(default="", metadata=_ESSENTIAL_METADATA)


@dataclass(frozen=True, slots=True)
class Handover(Serializable):
    """A hand-over: a vehicle repeats recorded actions up to a step, and its agent acts after that."""

    agent: str  # id of the controlled vehicle
    after: int  # number of recorded actions to repeat; the agent makes its first decision in the next step
    log: str  # path of the ``log.mcap`` that contains the recorded actions


@dataclass(frozen=True, slots=True)
class Reseeding(Serializable):
    """A re-seeding: the simulator's random generators get other seeds after a step."""

    after: int  # the step after which the seeds change; the next step is the first that uses the new seeds
    seed: int  # seed of all random generators of the simulator, from 0 to 2**31 - 1

    def seed_after(self, step: int) -> int | None:
        """Return the seed that the random generators get after a step; None if they are not re-seeded then."""
        return self.seed if step == self.after else None


@dataclass(frozen=True, slots=True)
class Forcing(Serializable):
    """How first disturbances are forced on copies of a root, a trial without disturbances after its first step.

    Args:
        spacing: proposed probability per copy: one copy is made for each interval of this length.
        ratios: factor by which a first disturbance is proposed more often than it occurs naturally, by cell; 1 if the
            cell is missing. A cell is a model with one strength, such as ``brake=4.0``.
        second: cells of first disturbances whose copies also get forced second disturbances.
        second_spacing: probability per forced second disturbance; 0 for none.
    """

    spacing: float
    ratios: Mapping[str, float] = field(default_factory=dict)
    second: tuple[str, ...] = field(default=(), metadata=OMIT_DEFAULT)
    second_spacing: float = field(default=0.0, metadata=OMIT_DEFAULT)


@dataclass(frozen=True, slots=True)
class TrialSpec(Serializable):
    """The specification of one trial, which determines the trial completely.

    Args:
        number: number of the trial in the hunt, counted from 0.
        seed: seed of the simulator, of the agents and of the process's random generators, from 0 to 2**31 - 1.
        arguments: values of the agents' arguments, by agent id and argument name.
        scenario_arguments: values of the scenario's arguments, by name.
        max_steps: maximum number of steps of the trial.
        overruled: The override of an agent's actions; None if all agents act to the end.
        parent: The trial from which the sampler derived this trial, or None. It does not affect the trial.
        origin: The sampler's label, such as the name of a strategy. It does not affect the trial.
        disturbances: The planned disturbances, sorted by step.
        only: The other actors that take part; None for all actors. Minimized crashes use this field.
        script: Recorded paths along which all other actors are moved. The agents begin at the start of their paths, and
            the scenario's traffic is excluded. ``script`` is None if the other actors drive themselves.
        handover: The agent that takes control after recorded actions, and the step; None if all agents act from the
            start.
        reseeding: The steps after which the simulator's random generators are re-seeded, and the seeds; None if they
            keep the trial's seed.
        forcing: How disturbances are forced on forks of the trial; None for no such forks. It does not affect the trial
            itself.
        digest_of_changes: Whether the digest covers the first observation of an agent and the changes since, instead of
            all observations.
    """

    number: int
    seed: int
    arguments: Mapping[str, Mapping[str, Value]]
    scenario_arguments: Mapping[str, Value]
    max_steps: int
    overruled: Overruled | None = field(default=None, metadata=_ESSENTIAL_METADATA)
    parent: int | None = field(default=None, metadata=OMIT_DEFAULT)
    origin: str = field(default="", metadata=OMIT_DEFAULT)
    disturbances: tuple[Disturbance, ...] = field(default=(), metadata=_ESSENTIAL_METADATA)
    only: tuple[str, ...] | None = field(default=None, metadata=_ESSENTIAL_METADATA)
    script: Paths | None = field(default=None, metadata=_ESSENTIAL_METADATA)
    handover: Handover | None = field(default=None, metadata=_ESSENTIAL_METADATA)
    reseeding: Reseeding | None = field(default=None, metadata=_ESSENTIAL_METADATA)
    forcing: Forcing | None = field(default=None, metadata=OMIT_DEFAULT)
    digest_of_changes: bool = field(default=False, metadata=_ESSENTIAL_METADATA)

    def to_json(self) -> JsonObject:
        """Return the specification as plain data; ``requires`` lists features that another version must know."""
        data = to_plain(self)
        inner = [one for one in (self.overruled, self.reseeding) if one is not None]
        if requires := [name for one in (self, *inner) for name in required_of(one)]:
            data["requires"] = requires
        return data

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Return the specification from the data of `to_json` of any version; unknown keys are ignored.

        Raises:
            CrashhuntError: the trial needs a feature that this version does not have.
        """
        unknown = not_understood(data.get("requires") or (), cls, Overruled, Handover, Reseeding)
        if unknown:
            raise CrashhuntError(
                f"trial {data['number']} has {', '.join(unknown)}, which crashhunt {__version__} does not support",
                fix="use the version of crashhunt that wrote the trial",
            )
        return from_plain(cls, {"arguments": {}, "scenario_arguments": {}, **data})
