"""Calls from Python with wrong arguments raise the same clear message as the command line, not a plain TypeError."""

from __future__ import annotations

import functools
import inspect
import os
import re
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import MISSING, fields
from typing import Any, Final, ParamSpec, Protocol, TypeVar

from crashhunt.base.errors import CallError
from crashhunt.base.foreign_code import describe_value
from crashhunt.base.older_versions import removed_fix
from crashhunt.base.text import one_of

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")


def clear_calls() -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator for public functions: an unknown keyword raises a `CallError` with the likely keyword."""

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(function)

        @functools.wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            _refuse(function.__name__, signature, args, kwargs)
            return function(*args, **kwargs)

        return call

    return decorate


def clear_constructor(kind: type[T]) -> type[T]:
    """Return a public class whose constructor raises a `CallError` for unknown keywords, as with `clear_calls`."""
    made: Any = kind
    constructor = made.__init__
    known = inspect.signature(kind)

    @functools.wraps(constructor)
    def construct(self: T, *args: object, **kwargs: object) -> None:
        _refuse(kind.__name__, known, args, kwargs)
        constructor(self, *args, **kwargs)

    made.__init__ = construct
    return kind


class Documented(Protocol):
    """An argument that provides its own description."""

    @property
    def line(self) -> str:
        """The description of the argument, as ``name: meaning``."""


def called_with(
    shape: Callable[P, T], *, documents: Iterable[Documented] = ()
) -> Callable[[Callable[[T], R]], Callable[P, R]]:
    """Return a decorator for a function with one dataclass as its argument; its caller passes the fields as keywords.

    Type checkers and editors see the fields as the arguments of the function. Unknown keywords are
    refused as by `clear_calls`.

    Args:
        shape: the dataclass; its ``Args`` section becomes that of the function.
        documents: descriptions of further arguments that the ``Args`` section of the dataclass lacks.
    """
    known = _signature_of(shape)

    def decorate(function: Callable[[T], R]) -> Callable[P, R]:
        returned = inspect.signature(function).return_annotation

        @functools.wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            _refuse(function.__name__, known, args, kwargs)
            return function(shape(*args, **kwargs))

        call.__doc__ = _with_arguments(function.__doc__ or "", shape.__doc__ or "", documents)
        call.__signature__ = known.replace(return_annotation=returned)  # type: ignore[attr-defined]
        return call

    return decorate


def _signature_of(shape: Any) -> inspect.Signature:
    """Return the signature of a dataclass's constructor, with default values instead of ``<factory>``."""
    known = inspect.signature(shape)
    made = {item.name: item.default_factory() for item in fields(shape) if item.default_factory is not MISSING}
    return known.replace(
        parameters=[
            parameter.replace(default=made[name]) if name in made else parameter
            for name, parameter in known.parameters.items()
        ]
    )


def _with_arguments(doc: str, of_shape: str, documents: Iterable[Documented]) -> str:
    """Return a docstring with the arguments of a dataclass added, in the form that `help` shows."""
    _, _, arguments = inspect.cleandoc(of_shape).partition("Args:\n")
    lines = [*arguments.rstrip().splitlines(), *(f"    {known.line}" for known in documents)]
    purpose, parts, rest = inspect.cleandoc(doc).partition("\n\nRaises:")
    return "\n".join([purpose, "", "Args:", *lines]) + parts + rest


def _refuse(name: str, signature: inspect.Signature, args: tuple[object, ...], kwargs: Mapping[str, object]) -> None:
    parameters = signature.parameters
    for keyword in kwargs:
        if keyword not in parameters or parameters[keyword].kind not in _BY_KEYWORD:
            known = dict.fromkeys(one for one, parameter in parameters.items() if parameter.kind in _BY_KEYWORD)
            fix = removed_fix(keyword) or one_of(keyword, known, give="it takes", none="no keywords")
            raise CallError(f"{name}() has no argument {keyword!r}", fix=fix)
    try:
        given = signature.bind(*args, **kwargs).arguments
    except TypeError as problem:
        raise CallError(f"{name}(): {problem}", fix=f"call {name}{_shown(signature)}") from None
    for argument, value in given.items():
        parameter = parameters[argument]
        annotation = str(parameter.annotation)
        if not (heads := _checked_heads(annotation)):
            continue
        for one in value if parameter.kind is parameter.VAR_POSITIONAL else (value,):
            if fix := _fix_of(heads, one, of_texts="[str]" in annotation):
                raise CallError(f"{name}(): {argument} is {describe_value(one)}", fix=fix)


@functools.cache  # hunts make thousands of objects, of the same few annotations
def _checked_heads(annotation: str) -> tuple[str, ...]:
    """Return the types that an annotation names; none if the functions check the values themselves.

    They do so for numbers and texts.
    """
    heads = tuple(re.sub(r"\[.*?\]", "", annotation).split(" | "))
    return heads if set(heads) <= _FIXES.keys() and heads not in _UNCHECKED else ()


def _fix_of(heads: tuple[str, ...], value: object, *, of_texts: bool) -> str:
    """Return what to give instead of a value that is no path, table, list or object; empty if the value is fine."""
    if heads[0] == "Sequence":
        is_fine = (
            isinstance(value, Collection)
            and not isinstance(value, str | bytes)
            and (not of_texts or all(isinstance(one, str) for one in value))
        )
    else:
        is_fine = isinstance(value, tuple(_KINDS[head] for head in heads if head in _KINDS))
    is_fine = is_fine or not {kind.__name__ for kind in type(value).__mro__}.isdisjoint(heads)
    if is_fine or (value is None and "None" in heads):
        return ""
    return _FIXES["str" if heads[0] == "Path" and "str" in heads else heads[0]]


_BY_KEYWORD: Final = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
_UNCHECKED: Final = (("str",), ("str", "None"), ("Bundle",))
_KINDS: Final[Mapping[str, Any]] = {"Mapping": Mapping, "Path": os.PathLike, "str": str}
_FIXES: Final = {
    "Bundle": "give the path of a hunt or a crash, or a crash of a hunt that crashhunt.load returned",
    "Mapping": "give a dictionary",
    "None": "",
    "Path": "give a pathlib.Path",
    "Sequence": "give a list",
    "SnapshotOptions": "give crashhunt.snapshots.SnapshotOptions(…)",
    "str": "give a path",
}


def _shown(signature: inspect.Signature) -> str:
    """Return the required arguments of a signature as text, such as ``(directory, parallel, trials, max_steps, …)``."""
    needed = [
        f"*{name}" if parameter.kind is parameter.VAR_POSITIONAL else name
        for name, parameter in signature.parameters.items()
        if parameter.default is parameter.empty and parameter.kind is not parameter.VAR_KEYWORD
    ]
    more = ", …" if len(needed) < len(signature.parameters) else ""
    return f"({', '.join(needed)}{more})"
