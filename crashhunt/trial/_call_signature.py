"""What the factory of an agent, sampler or oracle takes: read off its signature."""

from __future__ import annotations

import functools
import inspect
import math
import types
import typing
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, Literal, Protocol

from crashhunt.base.errors import ArgumentError
from crashhunt.base.foreign_code import supports
from crashhunt.base.text import one_of
from crashhunt.trial._argument_distributions import Argument, Kind, kind_of, parse_spec

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence


_CONSTRUCTORS = ("__new__", "__init__")
FILLED_BY_NAME: Final = (
    "observation_space", "action_space", "step_length_s", "action_masks", "agent_id", "columns", "map", "vehicle",
)  # fmt: skip
"""Parameters of an agent that crashhunt fills.

These are the spaces of the vehicle, the step length in s, the masks, and the identifier of the agent. `columns` is the
index of each column of the observed parts, by part and name. `map` is the map of the roads with the vehicle's route.
`vehicle` is the size and the limits of the vehicle."""
_KINDS: dict[object, Kind] = {float: "float", int: "int", bool: "bool", str: "str"}


class DeclaresObservation(Protocol):
    """A class or function that creates agents, and that names the parts of the observation that they need."""

    @property
    def observation(self) -> str | Sequence[str]:
        """The parts, such as ``("ego", "actors:rows=8")``; the command line and the scenario may name others."""


@dataclass(frozen=True, slots=True)
class CallSignature:
    """The signature of a factory: the arguments that it accepts.

    Args:
        arguments: arguments by name, in order.
        open: whether the factory accepts any other keyword (``**kwargs``).
        given: those of the parameters in `FILLED_BY_NAME` that the factory has.
        required: names of the arguments without a default.
        action: name of the form of actions that the factory prefers; empty if it names none.
        actions: names of all forms of actions that the factory's agents can return; empty if it names none.
        observation: parts that the factory's agents observe, from its attribute ``observation``.
        revision: version of the sources of a program, as the program reports it.
        unread: type of the attribute ``action`` or ``observation`` that is neither names nor a method, by the name of
            the attribute.
    """

    arguments: dict[str, Argument]
    open: bool
    given: tuple[str, ...]
    required: tuple[str, ...] = ()
    action: str = ""
    actions: tuple[str, ...] = ()
    observation: tuple[str, ...] = ()
    revision: str = ""
    unread: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> CallSignature:
        """Rebuild a signature from the data of `to_json`.

        Raises:
            ArgumentError: the specification of a distribution is invalid.
            KeyError, TypeError: the data do not describe a signature.
        """
        found = [Argument(**{**facts, "distribution": None}) for facts in data["arguments"]]
        texts = [facts["distribution"] for facts in data["arguments"]]
        drawn = [
            replace(one, distribution=None if text is None else parse_spec(text, one.kind, where=one.name))
            for one, text in zip(found, texts, strict=True)
        ]
        names = {argument.name: argument for argument in drawn}
        given, required, actions = (tuple(data[key]) for key in ("given", "required", "actions"))
        return cls(
            names, open=bool(data["open"]), given=given, required=required, action=data["action"], actions=actions,
            observation=tuple(data["observation"]), revision=str(data["revision"]), unread=data["unread"],
        )  # fmt: skip

    def to_json(self) -> dict[str, Any]:
        """Return the signature as JSON-compatible data."""
        arguments = [
            {
                "name": one.name, "kind": one.kind, "default": one.default, "unit": one.unit, "help": one.help,
                "distribution": None if one.distribution is None else str(one.distribution),
            }
            for one in self.arguments.values()
        ]  # fmt: skip
        return {
            "arguments": arguments, "open": self.open, "given": self.given, "required": self.required,
            "action": self.action, "actions": self.actions,
            "observation": self.observation, "revision": self.revision, "unread": dict(self.unread),
        }  # fmt: skip

    def check(self, names: Iterable[str], *, where: str) -> None:
        """Refuse arguments that the factory does not accept.

        Raises:
            ArgumentError: an argument is not accepted; the fix names the accepted arguments.
        """
        for name in names:
            if name not in self.arguments and not self.open:
                fix = one_of(name, self.arguments, give="it takes", none="no arguments")
                raise ArgumentError(f"{where} takes no argument {name!r}", fix=fix)


class PrefersAction(Protocol):
    """A class or function that creates agents, and that names the form of the agents' actions."""

    @property
    def action(self) -> str:
        """The name of the form, as ``crashhunt list actions`` shows it.

        A hunt uses this form if neither the command line nor the scenario names a form.
        """


class ReturnsActions(Protocol):
    """A class or function that creates agents, and that names all forms of actions that the agents can return."""

    @property
    def actions(self) -> Sequence[str]:
        """The names of the forms, as ``crashhunt list actions`` shows them; a hunt refuses all other forms."""


@typing.runtime_checkable
class DeclaresArguments(typing.Protocol):
    """A factory that reports its arguments itself, such as that of a program."""

    def declared_signature(self, agent: str = "", simulator: Any = None, *, limit_s: float = 0.0) -> CallSignature:
        """Return the arguments of the factory.

        Args:
            agent: the vehicle that the agent drives; empty if it is unknown.
            simulator: the `Simulator`; None if there is none.
            limit_s: time in s for a program to answer; at least 60 s.
        """


def signature_of(factory: Callable[..., object]) -> CallSignature:
    """Return the arguments of a factory, read from its signature.

    A parameter may be annotated ``Annotated[float, Argument(...)]`` to define which values a hunt tries. Parameters in
    `FILLED_BY_NAME` are not arguments, because they receive facts about the simulation.
    """
    if isinstance(factory, DeclaresArguments) and not isinstance(factory, type):
        return factory.declared_signature()
    action = factory.action if supports(factory, PrefersAction) and isinstance(factory.action, str) else ""
    actions = _names_in(factory.actions) if supports(factory, ReturnsActions) else ()
    observation = _declared_parts(factory)
    declared = replace(
        CallSignature({}, open=False, given=()), action=action, actions=actions, observation=observation,
        unread={name: kind for name in ("action", "observation") if (kind := _type_of_unread(factory, name))},
    )  # fmt: skip
    if _takes_nothing(factory):
        return declared
    try:
        parameters = inspect.signature(factory).parameters.values()
    except (TypeError, ValueError):
        return replace(declared, open=True)
    names = _names_seen_by(factory)
    arguments: dict[str, Argument] = {}
    given: list[str] = []
    required: list[str] = []
    is_open = False
    for parameter in parameters:
        if parameter.kind is parameter.VAR_KEYWORD:
            is_open = True
        elif parameter.kind in (parameter.VAR_POSITIONAL, parameter.POSITIONAL_ONLY):
            continue
        elif parameter.name in FILLED_BY_NAME:
            given.append(parameter.name)
        else:
            arguments[parameter.name] = _argument(parameter, _annotation(parameter, names))
            if parameter.default is parameter.empty:
                required.append(parameter.name)
    return replace(declared, arguments=arguments, open=is_open, given=tuple(given), required=tuple(required))


def _names_in(value: object) -> tuple[str, ...]:
    """Return the names in an attribute of a user's class; empty if the attribute serves another purpose."""
    is_names = isinstance(value, list | tuple) and all(isinstance(name, str) for name in value)
    return tuple(value) if is_names else ()  # type: ignore[arg-type]


def _type_of_unread(factory: object, name: str) -> str:
    """Return the type of an attribute of a factory that cannot name parts or a form; empty if it is usable or a method.

    Such an attribute may serve another purpose, or its author expects that crashhunt reads a property or a set.
    """
    value = getattr(factory, name, None)
    if value is None and getattr(factory, "__dataclass_fields__", {}).get(name) is not None:
        return "dataclass field with default_factory"
    names = value if isinstance(value, list | tuple) and name == "observation" else [value]
    is_read = all(isinstance(one, str) for one in names)
    return "" if value is None or is_read or callable(value) else type(value).__name__


def _declared_parts(factory: object) -> tuple[str, ...]:
    """Return the parts in the attribute ``observation`` of a factory; an attribute of another type is not meant."""
    if not supports(factory, DeclaresObservation):
        return ()
    parts = factory.observation
    if isinstance(parts, str):
        parts = parts.split(",")
    is_meant = isinstance(parts, list | tuple) and all(isinstance(part, str) for part in parts)
    return tuple([part.strip() for part in parts if part.strip()]) if is_meant else ()


def _names_seen_by(factory: Callable[..., object]) -> dict[str, object]:
    """Return the global names of the function whose parameters `inspect` shows, in which annotations are evaluated."""
    target: Any = factory
    while True:
        if isinstance(target, functools.partial):
            target = target.func
        elif hasattr(target, "__wrapped__"):
            target = target.__wrapped__
        elif isinstance(target, type):
            target = target.__init__  # type: ignore[misc]
        else:
            names: dict[str, object] = getattr(target, "__globals__", {})
            return names


def _takes_nothing(factory: Callable[..., object]) -> bool:
    """Return whether a class has no constructor of its own; `inspect` would need milliseconds to determine this."""
    plain = type(factory) is type and inspect.getattr_static(factory, "__signature__", None) is None
    return plain and all(inspect.getattr_static(factory, name) is vars(object)[name] for name in _CONSTRUCTORS)


def _annotation(parameter: inspect.Parameter, names: dict[str, object]) -> object:
    """Return an annotation as an object; None if it cannot be evaluated, as with imports for type checkers only."""
    if not isinstance(parameter.annotation, str):
        return parameter.annotation
    try:
        return eval(parameter.annotation, names)
    except Exception:
        return None


def _argument(parameter: inspect.Parameter, hint: object) -> Argument:
    declared = _declaration_in(hint)
    own = parameter.default
    kinds = list(_kinds_of(hint)) or ([kind_of(own)] if isinstance(own, bool | int | float | str) else [])
    # Text cannot represent the member of an enumeration or an infinite number, so the factory keeps such a default.
    default = own if type(own) in (bool, int, str) or (type(own) is float and math.isfinite(own)) else None
    argument = Argument(parameter.name, _joint_kind(kinds), default)
    if declared is None:
        return argument
    return replace(argument, distribution=declared.distribution, unit=declared.unit, help=declared.help)


def _declaration_in(hint: object) -> Argument | None:
    """Return the `Argument` in an annotation, also in that of an optional parameter; None if there is none."""
    parts = typing.get_args(hint)
    if typing.get_origin(hint) is typing.Annotated:
        return next((part for part in parts[1:] if isinstance(part, Argument)), None)
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        return next((found for found in map(_declaration_in, parts) if found is not None), None)
    return None


def _kinds_of(hint: object) -> dict[Kind, None]:
    """Return the types of values, in order, that an annotation allows and that can be written as text."""
    if typing.get_origin(hint) is typing.Annotated:
        return _kinds_of(typing.get_args(hint)[0])
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        return {kind: None for part in typing.get_args(hint) for kind in _kinds_of(part)}
    if typing.get_origin(hint) is Literal:
        return {kind_of(value): None for value in typing.get_args(hint) if isinstance(value, bool | int | str)}
    return {kind: None for known, kind in _KINDS.items() if hint is known}


def _joint_kind(kinds: Sequence[Kind]) -> Kind | None:
    """Return the type of an argument that allows several types; None if each text determines its type."""
    if "float" in kinds and {*kinds} <= {"float", "int", "str"}:  # an integer is also a float
        return "float|str" if "str" in kinds else "float"
    return kinds[0] if len(kinds) == 1 else None
