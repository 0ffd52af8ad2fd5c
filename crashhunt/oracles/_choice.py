"""Oracles as they are chosen: ``NAME`` or ``NAME:key=value,key=value``; NAME is registered or ``module:attribute``."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from crashhunt.base.errors import ArgumentError, CrashhuntError, UsageError
from crashhunt.base.exceptions import blamed
from crashhunt.base.plugins import locate
from crashhunt.oracles._protocol import BringsOutcomes
from crashhunt.trial import Constant, Outcome, parse_spec, signature_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from crashhunt.oracles._protocol import Oracle
    from crashhunt.trial import Value

__all__ = [
    "DEFAULT_ORACLES",
    "OracleChoice",
    "chosen_oracles",
    "modules_of",
    "oracle_name",
    "outcomes_brought",
    "parse_oracle",
]

DEFAULT_ORACLES = ("reported-collision", "overlap", "off-road")
"""Who looks at every hunt, unless ``none`` is among those that are chosen."""

_NONE = "none"
# A colon may belong to module:attribute; one that is followed by key= begins the arguments.
_CHOICE = re.compile(r"(?P<name>.+?)(?::(?P<arguments>[A-Za-z_]\w*=.*))?")


@dataclass(frozen=True, slots=True)
class OracleChoice:
    """An oracle with its arguments.

    Args:
        name: of a registered one, or ``module:attribute``.
        arguments: by name.
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
            fix = "mend it, or what it is given"
            raise blamed(f"the oracle {self.name!r} cannot be made", error, fix=fix) from error
        return made

    def outcomes(self) -> tuple[Outcome, ...]:
        """The outcomes that it brings.

        Raises:
            CrashhuntError: as of `make`.
        """
        made = self.make()
        return tuple(map(Outcome, made.outcomes)) if isinstance(made, BringsOutcomes) else ()


def oracle_name(text: str) -> str:
    """Return the name in a choice; nothing is imported."""
    match = _CHOICE.fullmatch(text)
    return match["name"] if match else text


def modules_of(oracles: Iterable[str]) -> list[str]:
    """Return the modules of the oracles that are chosen as ``module:attribute``; nothing is imported."""
    return [name.partition(":")[0] for text in oracles if ":" in (name := oracle_name(text))]


def parse_oracle(text: str) -> OracleChoice:
    """Read a choice.

    Raises:
        CrashhuntError: there is no such oracle, it takes no such argument, or a value is none of the right type.
    """
    match = _CHOICE.fullmatch(text)
    if match is None:
        raise UsageError(f"--oracle {text!r} names none", fix="give NAME or NAME:key=value")
    name, pairs = match["name"], match["arguments"]
    factory: Callable[..., Oracle] = locate("oracles", name)
    signature = signature_of(factory)
    arguments: dict[str, Value] = {}
    for pair in pairs.split(",") if pairs else ():
        key, equals, value = pair.partition("=")
        if not equals:
            raise UsageError(f"--oracle {text!r}: {pair!r} is no argument", fix="write key=value")
        if key in arguments:
            raise UsageError(f"--oracle {text!r} gives {key!r} twice", fix="give it once")
        signature.check([key], where=f"--oracle {name}")
        kind = signature.arguments[key].kind if key in signature.arguments else None
        distribution = parse_spec(value, kind, where=f"--oracle {name}:{key}")
        if not isinstance(distribution, Constant):
            fix = "give one value; what is searched are the arguments of agents and of the scenario"
            raise ArgumentError(f"{value!r} is not one value", fix=fix, where=f"--oracle {name}:{key}")
        arguments[key] = distribution.value
    return OracleChoice(name, arguments, factory)


def chosen_oracles(asked: Sequence[str]) -> tuple[str, ...]:
    """Return the oracles of a hunt in the order of their checks: the default ones, then the chosen ones.

    Args:
        asked: what ``--oracle`` was given, as often as it was; ``none`` drops the default ones.

    Raises:
        CrashhuntError: an oracle cannot be made, or none is chosen.
    """
    added = [text for text in asked if text != _NONE]
    found = tuple(dict.fromkeys([*(() if _NONE in asked else DEFAULT_ORACLES), *added]))
    if not found:
        raise UsageError("--oracle none leaves no oracle to detect crashes", fix="add another --oracle")
    for text in added:
        parse_oracle(text).make()
    return found


def outcomes_brought(oracles: Iterable[str]) -> tuple[Outcome, ...]:
    """Return the outcomes that oracles bring, beyond those that every hunt stops on.

    Raises:
        CrashhuntError: one of them cannot be had.
    """
    return tuple(dict.fromkeys(outcome for text in oracles for outcome in parse_oracle(text).outcomes()))
