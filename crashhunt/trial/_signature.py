"""What the factory of an agent, sampler or oracle takes: read off its signature."""

from __future__ import annotations

import inspect
import types
import typing
from dataclasses import dataclass
from typing import TYPE_CHECKING

from crashhunt.base.errors import ArgumentError
from crashhunt.base.names import one_of
from crashhunt.trial._space import Argument, Kind, kind_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

__all__ = ["Signature", "signature_of"]


_CONSTRUCTORS = ("__new__", "__init__")
_KINDS: dict[object, Kind] = {float: "float", int: "int", bool: "bool", str: "str"}


@dataclass(frozen=True, slots=True)
class Signature:
    """What a factory takes.

    Args:
        arguments: by name, in order.
        open: whether it takes any other keyword as well (``**kwargs``).
        given: which of ``observation_space``, ``action_space`` and ``step_length_s`` it asks for.
    """

    arguments: dict[str, Argument]
    open: bool
    given: tuple[str, ...]

    def check(self, names: Iterable[str], *, where: str) -> None:
        """Refuse arguments that it does not take.

        Raises:
            ArgumentError: with the accepted ones.
        """
        for name in names:
            if name not in self.arguments and not self.open:
                fix = one_of(name, self.arguments, give="it takes", none="no arguments")
                raise ArgumentError(f"{where} takes no argument {name!r}", fix=fix)


def signature_of(factory: Callable[..., object]) -> Signature:
    """Read the arguments of a factory off its signature.

    A parameter may be annotated ``Annotated[float, Argument(...)]`` to say what a hunt should try. Parameters named
    ``observation_space`` and ``action_space`` are not arguments: they receive the spaces of the vehicle. Nor is
    ``step_length_s``, which receives that of the simulation.
    """
    if _takes_nothing(factory):
        return Signature({}, open=False, given=())
    try:
        parameters = inspect.signature(factory).parameters.values()
    except (TypeError, ValueError):
        return Signature({}, open=True, given=())
    target = factory.__init__ if isinstance(factory, type) else factory  # type: ignore[misc]
    names = getattr(target, "__globals__", {})
    arguments: dict[str, Argument] = {}
    given: list[str] = []
    is_open = False
    for parameter in parameters:
        if parameter.kind is parameter.VAR_KEYWORD:
            is_open = True
        elif parameter.kind in (parameter.VAR_POSITIONAL, parameter.POSITIONAL_ONLY):
            continue
        elif parameter.name in ("observation_space", "action_space", "step_length_s"):
            given.append(parameter.name)
        else:
            arguments[parameter.name] = _argument(parameter, _annotation(parameter, names))
    return Signature(arguments, is_open, tuple(given))


def _takes_nothing(factory: Callable[..., object]) -> bool:
    """Whether it is a plain class without a constructor, of which `inspect` needs milliseconds to say so."""
    plain = type(factory) is type and inspect.getattr_static(factory, "__signature__", None) is None
    return plain and all(inspect.getattr_static(factory, name) is vars(object)[name] for name in _CONSTRUCTORS)


def _annotation(parameter: inspect.Parameter, names: dict[str, object]) -> object:
    """The annotation as an object; None where it cannot be had, such as a name imported for type checkers only."""
    if not isinstance(parameter.annotation, str):
        return parameter.annotation
    try:
        return eval(parameter.annotation, names)
    except Exception:
        return None


def _argument(parameter: inspect.Parameter, hint: object) -> Argument:
    default = parameter.default if isinstance(parameter.default, bool | int | float | str) else None
    declared = None
    if typing.get_origin(hint) is typing.Annotated:
        hint, *extras = typing.get_args(hint)
        declared = next((extra for extra in extras if isinstance(extra, Argument)), None)
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        hint = next((part for part in typing.get_args(hint) if part in _KINDS), None)
    kind = _KINDS.get(hint) or (kind_of(default) if default is not None else None)
    if declared is None:
        return Argument(parameter.name, kind, default)
    return Argument(parameter.name, kind, default, declared.distribution, declared.unit, declared.help)
