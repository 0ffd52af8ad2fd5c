"""The oracle protocol, which decides whether a step is a crash, and the choice of oracles by name."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from crashhunt.base.errors import ArgumentError, CrashhuntError, UsageError
from crashhunt.base.exceptions import blamed
from crashhunt.base.foreign_code import supports
from crashhunt.base.plugins import locate
from crashhunt.trial import Constant, Outcome, parse_spec, signature_of

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

    from crashhunt.trial import Category, Collision, TrialResult, Value
    from crashhunt.world import Event, Lane, Scene


@dataclass(frozen=True, slots=True)
class Finding:
    """A traffic crash or a traffic event that an oracle has detected.

    Args:
        outcome: the outcome that was detected: ``collision``, ``off_road``, the type of an event, or an outcome that
            the oracle adds.
        collision: the evidence of a crash.
        event: the evidence of a traffic event; its field ``what`` describes the event.
    """

    outcome: Outcome
    collision: Collision | None = None
    event: Event | None = None


class Oracle(Protocol):
    """The protocol of an oracle, which examines scenes and detects crashes, without random numbers and without a clock.

    Contract: a new oracle is created for every trial, with the arguments of ``--oracle NAME:key=value``. The state of
    an oracle therefore belongs to one trial only. `check` is called once per step, in order, and also for the scene
    before the first step. ``scene.previous`` is the scene one step before, and None at the start. A finding ends the
    trial if ``--crash-on`` contains its outcome, and is discarded otherwise. An exception counts as a fault of the
    oracle.
    """

    name: str
    """As it appears in ``seen_by``."""

    def check(self, scene: Scene, agents: Sequence[str]) -> list[Finding]:
        """Return the crashes of the given controlled vehicles in a scene; usually none."""


@runtime_checkable
class SeesMap(Protocol):
    """An oracle that receives the map of the trial."""

    def see_map(self, lanes: Sequence[Lane]) -> None:
        """Receive the lanes of the map, before the first `Oracle.check`; empty if the simulator has no map."""


@runtime_checkable
class BringsOutcomes(Protocol):
    """An oracle that adds outcomes, or whose findings are crashes only if the user requests it."""

    outcomes: Mapping[str, Category]
    """Name to ``traffic crash`` or ``traffic event``. A hunt that chooses the oracle stops on them, unless
    ``--crash-on`` says otherwise."""


class SignalSource(Protocol):
    """The signals of a running episode: what formulas of requirements may name."""

    step_length_s: float
    """Time between two samples, in s."""

    def reader(self, names: Sequence[str], agent: str) -> Callable[[], Sequence[float] | None]:
        """Return a function that returns the values of signals in the last scene, in the given order.

        The function returns None in scenes without the agent, and before the first step if a signal has no value there.

        Args:
            names: names of the signals.
            agent: the agent to which names without an agent refer.

        Raises:
            UnusableValueError: a signal is unknown.
        """


@runtime_checkable
class ReadsSignals(Protocol):
    """An oracle that reads the signals of an episode."""

    def read_signals(self, source: SignalSource, agents: Sequence[str]) -> None:
        """Receive the signals, and the controlled vehicles, before the first `Oracle.check`."""


@runtime_checkable
class ChecksEnd(Protocol):
    """An oracle that also decides at the end of a trial, and adds to the trial's result."""

    def check_end(self, scene: Scene, agents: Sequence[str]) -> list[Finding]:
        """Return the crashes that are certain only because the trial ends with this scene."""

    def complete(self, result: TrialResult) -> TrialResult:
        """Return the result of the trial, with the data of this oracle added."""


def merge_findings(findings: Sequence[Finding]) -> Finding | None:
    """Return the first finding, with the names of all oracles that detected its collision; None without a finding."""
    if not findings:
        return None
    first = findings[0]
    if first.collision is None:
        return first
    parties = {first.collision.collider, first.collision.victim}
    hits = [other.collision for other in findings if other.collision is not None]
    same = [hit for hit in hits if {hit.collider, hit.victim} == parties]
    seen_by = tuple(sorted({name for hit in same for name in hit.seen_by}))
    return Finding(first.outcome, replace(first.collision, seen_by=seen_by))


# Oracles as they are chosen: ``NAME`` or ``NAME:key=value,key=value``; NAME is registered or ``module:attribute``.

DEFAULT_ORACLES = ("reported-collision", "overlap", "off-road")
"""Who looks at every hunt, unless ``none`` is among those that are chosen."""

ORACLES_OF_ACTORS = ("overlap", "off-road", "too-close")
"""Oracles of crashhunt that detect nothing if scenes contain no actors."""

REQUIREMENT = "requirement"
"""The oracle of requirements, which is written ``requirement:TITLE=FORMULA``."""

_NONE = "none"
# A colon may belong to module:attribute; one that is followed by key= begins the arguments.
_CHOICE = re.compile(r"(?P<name>.+?)(?::(?P<arguments>[A-Za-z_]\w*=.*))?")


@dataclass(frozen=True, slots=True)
class OracleChoice:
    """An oracle with its arguments."""

    name: str  # name of a registered object, or ``module:attribute``
    arguments: dict[str, Value]  # arguments by name
    # the object with this name, stored because each trial creates an oracle and a lookup takes milliseconds
    factory: Callable[..., Oracle]

    def make(self) -> Oracle:
        """Create the oracle, and return it.

        Raises:
            CrashhuntError: the oracle cannot be created.
        """
        try:
            made = self.factory(**self.arguments)
            if supports(made, BringsOutcomes):
                for name, category in made.outcomes.items():
                    Outcome.own(name, category)
        except CrashhuntError:
            raise
        except Exception as error:  # of user code
            fix = "correct it, or its arguments"
            raise blamed(f"the oracle {self.name!r} cannot be created", error, fix=fix) from error
        return made

    def outcomes(self) -> dict[str, Category]:
        """Return the outcomes that the oracle adds, and their categories.

        Raises:
            CrashhuntError: the oracle cannot be created; `make` lists the reasons.
        """
        made = self.make()
        return (
            {str(name): category for name, category in made.outcomes.items()}
            if isinstance(made, BringsOutcomes)
            else {}
        )


def oracle_name(text: str) -> str:
    """Return the name of the oracle in an ``--oracle`` value, without importing the oracle."""
    match = _CHOICE.fullmatch(text)
    return match["name"] if match else text


def modules_of(oracles: Iterable[str]) -> list[str]:
    """Return the modules of the oracles that are given as ``module:attribute``, without importing them."""
    return [name.partition(":")[0] for text in oracles if ":" in (name := oracle_name(text))]


def parse_oracle(text: str) -> OracleChoice:
    """Parse the choice of an oracle.

    Raises:
        CrashhuntError: the oracle does not exist, has no such argument, or a value has the wrong type.
    """
    match = _CHOICE.fullmatch(text)
    if match is None:
        raise UsageError(f"--oracle {text!r} names no oracle", fix="give NAME or NAME:key=value")
    if match["name"] == REQUIREMENT:
        title, _, formula = (match["arguments"] or "").partition("=")
        return OracleChoice(REQUIREMENT, {"title": title, "formula": formula}, locate("oracles", REQUIREMENT))
    name, pairs = match["name"], match["arguments"]
    factory: Callable[..., Oracle] = locate("oracles", name)
    signature = signature_of(factory)
    arguments: dict[str, Value] = {}
    for pair in pairs.split(",") if pairs else ():
        key, equals, value = pair.partition("=")
        if not equals:
            raise UsageError(f"--oracle {text!r}: {pair!r} is not an argument", fix="write key=value")
        if key in arguments:
            raise UsageError(f"--oracle {text!r} gives {key!r} twice", fix="give it once")
        signature.check([key], where=f"--oracle {name}")
        kind = signature.arguments[key].kind if key in signature.arguments else None
        distribution = parse_spec(value, kind, where=f"--oracle {name}:{key}")
        if not isinstance(distribution, Constant):
            fix = "give one value; a hunt varies only the arguments of agents and of the scenario"
            raise ArgumentError(f"{value!r} is not a single value", fix=fix, where=f"--oracle {name}:{key}")
        arguments[key] = distribution.value
    return OracleChoice(name, arguments, factory)


def described_oracle(text: str) -> dict[str, Category]:
    """Create a chosen oracle, and return the outcomes that it adds, with their categories.

    Raises:
        CrashhuntError: the oracle cannot be created.
    """
    return parse_oracle(text).outcomes()


def chosen_oracles(asked: Sequence[str], described: Collection[str] = ()) -> tuple[str, ...]:
    """Return the oracles of a hunt in the order of their checks: the default oracles, then the chosen oracles.

    ``asked`` has the values of all ``--oracle`` options, of which ``none`` removes the default oracles. Oracles that
    another process has ``described`` are not created here.

    Raises:
        CrashhuntError: an oracle cannot be created, or no oracle is chosen.
    """
    added = [text for text in asked if text != _NONE]
    found = tuple(dict.fromkeys([*(() if _NONE in asked else DEFAULT_ORACLES), *added]))
    if not found:
        raise UsageError("--oracle none leaves no oracle to detect crashes", fix="add another --oracle")
    for text in added:
        if text not in described:
            parse_oracle(text).make()
    return found


def outcomes_brought(
    oracles: Iterable[str], described: Mapping[str, Mapping[str, Category]] = MappingProxyType({})
) -> tuple[Outcome, ...]:
    """Return the outcomes that oracles add to those on which every hunt stops.

    ``described`` has the outcomes of oracles that another process has created.

    Raises:
        CrashhuntError: an oracle cannot be created.
    """
    brought: dict[Outcome, None] = {}
    for text in oracles:
        outcomes = described[text] if text in described else described_oracle(text)
        brought |= {Outcome.own(name, category): None for name, category in outcomes.items()}
    return tuple(brought)
