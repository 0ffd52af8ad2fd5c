"""The oracle protocol: whether a step is a crash; and the choice of oracles by name."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from crashhunt.base.errors import ArgumentError, CrashhuntError, UsageError
from crashhunt.base.exceptions import blamed
from crashhunt.base.plugins import locate
from crashhunt.trial import Constant, Outcome, parse_spec, signature_of

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

    from crashhunt.trial import Category, Collision, Value
    from crashhunt.world import Event, Lane, Scene


__all__ = [
    "DEFAULT_ORACLES",
    "BringsOutcomes",
    "Finding",
    "Oracle",
    "OracleChoice",
    "SeesMap",
    "chosen_oracles",
    "described_oracle",
    "merge_findings",
    "modules_of",
    "oracle_name",
    "outcomes_brought",
    "parse_oracle",
]


@dataclass(frozen=True, slots=True)
class Finding:
    """A traffic crash or a traffic event that an oracle has detected.

    Args:
        outcome: ``collision``, ``off_road``, the kind of an event, or an outcome of the oracle's own.
        collision: the evidence of a crash.
        event: the evidence of a traffic event; its ``what`` describes the event in words.
    """

    outcome: Outcome
    collision: Collision | None = None
    event: Event | None = None


class Oracle(Protocol):
    """Examines scenes and detects crashes. It uses no random numbers and no clock.

    Contract: a new oracle is made for every trial, with the arguments of ``--oracle NAME:key=value``. Its state
    therefore belongs to this trial only. `check` is called once a step, in order, also with the
    scene before the first step. ``scene.previous`` is the scene one step before, None at the start. A finding ends the
    trial if ``--crash-on`` has its outcome, and is discarded otherwise. An exception counts as a fault of the oracle.
    """

    name: str
    """As it appears in ``seen_by``."""

    def check(self, scene: Scene, agents: Sequence[str]) -> list[Finding]:
        """Return the crashes of these controlled vehicles in this scene; usually none."""


@runtime_checkable
class SeesMap(Protocol):
    """An oracle that receives the map of the trial."""

    def see_map(self, lanes: Sequence[Lane]) -> None:
        """Receive the lanes of the map, before the first `Oracle.check`; empty if the simulator has no map."""


@runtime_checkable
class BringsOutcomes(Protocol):
    """Implemented by oracles with their own outcomes, or with findings that are crashes only on request."""

    outcomes: Mapping[str, Category]
    """Name to ``traffic crash`` or ``traffic event``. A hunt that chooses the oracle stops on them, unless
    ``--crash-on`` says otherwise."""


def merge_findings(findings: Sequence[Finding]) -> Finding | None:
    """Return the first finding, with the names of all oracles that detected the same; None if there is none."""
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

_NONE = "none"
# A colon may belong to module:attribute; one that is followed by key= begins the arguments.
_CHOICE = re.compile(r"(?P<name>.+?)(?::(?P<arguments>[A-Za-z_]\w*=.*))?")


@dataclass(frozen=True, slots=True)
class OracleChoice:
    """An oracle with its arguments.

    Args:
        name: name of a registered object, or ``module:attribute``.
        arguments: arguments by name.
        factory: the object of that name, kept because each trial makes an oracle and a lookup takes milliseconds.
    """

    name: str
    arguments: dict[str, Value]
    factory: Callable[..., Oracle]

    def make(self) -> Oracle:
        """Return a new oracle.

        Raises:
            CrashhuntError: it cannot be made.
        """
        try:
            made = self.factory(**self.arguments)
            if isinstance(made, BringsOutcomes):
                for name, category in made.outcomes.items():
                    Outcome.own(name, category)
        except CrashhuntError:
            raise
        except Exception as error:  # of user code
            fix = "correct it, or its arguments"
            raise blamed(f"the oracle {self.name!r} cannot be created", error, fix=fix) from error
        return made

    def outcomes(self) -> dict[str, Category]:
        """The outcomes that it brings, and their categories.

        Raises:
            CrashhuntError: as of `make`.
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
    """Read a choice.

    Raises:
        CrashhuntError: the oracle does not exist, has no such argument, or a value has the wrong type.
    """
    match = _CHOICE.fullmatch(text)
    if match is None:
        raise UsageError(f"--oracle {text!r} names no oracle", fix="give NAME or NAME:key=value")
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
            fix = "give one value; what is searched are the arguments of agents and of the scenario"
            raise ArgumentError(f"{value!r} is not a single value", fix=fix, where=f"--oracle {name}:{key}")
        arguments[key] = distribution.value
    return OracleChoice(name, arguments, factory)


def described_oracle(text: str) -> dict[str, Category]:
    """Make a chosen oracle, and return the outcomes that it brings, with their categories.

    Raises:
        CrashhuntError: it cannot be had.
    """
    return parse_oracle(text).outcomes()


def chosen_oracles(asked: Sequence[str], described: Collection[str] = ()) -> tuple[str, ...]:
    """Return the oracles of a hunt in the order of their checks: the default ones, then the chosen ones.

    Args:
        asked: the values of all ``--oracle`` options; ``none`` removes the default oracles.
        described: those that another process has made, so that they are not made here.

    Raises:
        CrashhuntError: an oracle cannot be made, or none is chosen.
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
    """Return the outcomes that oracles bring, beyond those that every hunt stops on.

    Args:
        oracles: the chosen oracles.
        described: the outcomes of those that another process has made, with their categories.

    Raises:
        CrashhuntError: an oracle cannot be created.
    """
    brought: dict[Outcome, None] = {}
    for text in oracles:
        outcomes = described[text] if text in described else described_oracle(text)
        brought |= {Outcome.own(name, category): None for name, category in outcomes.items()}
    return tuple(brought)
