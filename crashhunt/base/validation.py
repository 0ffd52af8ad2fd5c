"""Validates dataclasses with pydantic, and reports the first error as one line in crashhunt's form.

Data that match exactly are built without pydantic, because importing pydantic and its schemas takes a third of a
worker's start.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from enum import EnumType
from functools import cache
from pathlib import Path
from types import UnionType
from typing import TYPE_CHECKING, Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from crashhunt.base.older_versions import removed_fix
from crashhunt.base.text import any_of, did_you_mean

if TYPE_CHECKING:
    from pydantic import ConfigDict, TypeAdapter
    from pydantic_core import ErrorDetails

    from crashhunt.base.errors import CrashhuntError

T = TypeVar("T")

_UNKNOWN_KEY_ERRORS = ("unexpected_keyword_argument", "extra_forbidden")
_MISSING_KEY_ERRORS = ("missing", "missing_argument")
_WANTED = "Input should be "  # of pydantic
_A_STRING = f"{_WANTED}a valid string"


def validate(
    kind: type[T],
    data: object,
    *,
    where: str,
    error: type[CrashhuntError],
    under: str = "",
    keys: Callable[[], Iterable[str]] | None = None,
) -> T:
    """Build a dataclass from plain data; unknown keys and wrong types are errors.

    Args:
        kind: the dataclass.
        data: the data that were read from TOML or JSON.
        where: path of the file, for the error message.
        error: class of the error to raise; its message contains key and value, and its fix lists the valid values.
        under: key of the table in the file; empty for the whole file.
        keys: function that returns the keys that are allowed at the top of the file, if these differ from the
            dataclass's fields.
    """
    try:
        return cast(T, _built(kind, data))
    except _NotToTheLetterError:
        return _validated(kind, data, _Place(where=where, error=error, under=under, keys=keys))


@dataclass(frozen=True, slots=True)
class _Place:
    """The origin of validated data, for the error."""

    where: str
    error: type[CrashhuntError]
    under: str
    keys: Callable[[], Iterable[str]] | None


class _NotToTheLetterError(Exception):
    """The data do not match the dataclass exactly: they may be wrong, or pydantic may convert them."""


def _built(kind: Any, data: Any) -> Any:
    """Build the object that pydantic would build; raise an error for types or values that only pydantic handles."""
    if is_dataclass(kind):
        return _dataclass_built(cast(type, kind), data)
    if kind in (Any, object) or type(data) is kind:
        return data
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return _member_built(inner, data)
    if origin is Literal and any(type(data) is type(choice) and data == choice for choice in inner):
        return data
    if ((origin is tuple and inner[1:] == (...,)) or origin is Sequence) and type(data) in (list, tuple):
        return tuple(_built(inner[0], item) for item in data)
    if origin in (dict, Mapping) and type(data) is dict:
        return {_built(inner[0], key): _built(inner[1], value) for key, value in data.items()}
    if kind is float and type(data) is int and abs(data) < 2**53:
        return float(data)
    if kind is Path and type(data) is str:
        return Path(data)
    if isinstance(kind, EnumType) and type(data) is str and data in kind._value2member_map_:
        return kind(data)
    raise _NotToTheLetterError


def _dataclass_built(kind: type, data: object) -> Any:
    hints, needed = _hints_of(kind)
    if type(data) is not dict or not needed <= data.keys() <= hints.keys():
        raise _NotToTheLetterError
    return kind(**{name: _built(hints[name], value) for name, value in data.items()})


def _member_built(kinds: tuple[object, ...], data: object) -> Any:
    """Build the member of a union that has the type of the data; for an optional type, build this type."""
    if type(data) in kinds:
        return _built(type(data), data)
    others = [kind for kind in kinds if kind is not type(None)]
    if len(others) == 1:
        return _built(others[0], data)
    raise _NotToTheLetterError


@cache
def _hints_of(kind: type) -> tuple[dict[str, object], frozenset[str]]:
    """Return the types of a dataclass's fields, and the names of the fields without a default."""
    items = fields(kind)
    hints = get_type_hints(kind)
    needed = (item.name for item in items if item.default is MISSING and item.default_factory is MISSING)
    return {item.name: hints[item.name] for item in items}, frozenset(needed)


def _validated(kind: type[T], data: object, place: _Place) -> T:
    from pydantic import ValidationError

    error, where = place.error, place.where
    try:
        return cast(T, _adapter(cast(Any, kind)).validate_python(data))
    except ValidationError as problem:
        errors = problem.errors(include_url=False)
        first = _telling(errors)
        path = _keys_to(first, data)
        key = ".".join((place.under, *path) if place.under else path)
        if first["type"] in _UNKNOWN_KEY_ERRORS:
            known = list(place.keys()) if place.keys and len(path) == 1 else _known_keys(kind, path[:-1])
            fix = removed_fix(path[-1]) or did_you_mean(path[-1], known) or f"the keys here are {', '.join(known)}"
            raise error(f"unknown key {key!r}", fix=fix, where=where) from None
        if first["type"] in _MISSING_KEY_ERRORS:
            raise error(f"the key {key!r} is missing", fix="add it", where=where) from None
        of_members = [found for found in errors if _keys_to(found, data) == path]
        message, fix = _in_terms_of_toml(first, key, of_members)
        raise error(f"{key} = {first['input']!r}: {message}", fix=fix, where=where) from None


def _keys_to(found: ErrorDetails, data: object) -> tuple[str, ...]:
    """Return the keys that lead to an error, without the names that pydantic gives to the members of a union."""
    path: list[str] = []
    here: Any = data
    part: Any
    for part in found["loc"]:
        if (isinstance(here, Mapping) and part in here) or (isinstance(here, list | tuple) and isinstance(part, int)):
            here = here[part]
            path.append(str(part))
    return (*path, str(found["loc"][-1])) if found["type"] in _MISSING_KEY_ERRORS else tuple(path)


def _in_terms_of_toml(found: ErrorDetails, key: str, of_members: Sequence[ErrorDetails]) -> tuple[str, str]:
    """Return the message and the fix of an error without Python's names of types."""
    if found["type"] == "tuple_type" and isinstance(found["input"], dict):
        return "a table where a list of tables is needed", f"write [[{key}]] above each table"
    if found["type"] == "tuple_type":
        return "not a list", f"write {key} = […]"
    if found["type"] in ("dataclass_type", "dict_type", "mapping_type"):
        return "not a table", f"write [{key}], with the keys below it"
    messages = [_A_STRING if other["type"] == "path_type" else other["msg"] for other in (found, *of_members)]
    wanted = dict.fromkeys(message.removeprefix(_WANTED) for message in messages)
    if all(message.startswith(_WANTED) for message in messages):
        return f"input should be {any_of(wanted)}", "change the value"
    return messages[0][0].lower() + messages[0][1:], "change the value"


def _telling(errors: Sequence[ErrorDetails]) -> ErrorDetails:
    """Return the error to report: a misspelt key is more informative than the missing key that it causes."""
    first = errors[0]
    if first["type"] in _MISSING_KEY_ERRORS:
        for other in errors[1:]:
            is_sibling = other["type"] in _UNKNOWN_KEY_ERRORS and other["loc"][:-1] == first["loc"][:-1]
            if is_sibling and did_you_mean(str(other["loc"][-1]), [str(first["loc"][-1])]):
                return other
    return first


@cache
def _adapter(kind: type) -> TypeAdapter[object]:
    from pydantic import ConfigDict, TypeAdapter

    _forbid_unknown(kind, ConfigDict(extra="forbid"), set())
    return TypeAdapter(kind)


def _forbid_unknown(kind: Any, config: ConfigDict, seen: set[object]) -> None:
    if kind in seen:
        return
    seen.add(kind)
    if is_dataclass(kind):
        if "__pydantic_config__" not in vars(kind):
            kind.__pydantic_config__ = config  # type: ignore[union-attr]
        for hint in get_type_hints(kind).values():
            _forbid_unknown(hint, config, seen)
    for inner in get_args(kind):
        _forbid_unknown(inner, config, seen)


def _known_keys(kind: Any, path: tuple[str, ...]) -> list[str]:
    """Return the keys that a table at ``path`` may have."""
    for part in path:
        if is_dataclass(kind):
            kind = get_type_hints(kind).get(part)
        else:  # a list of tables, or a table of named tables
            kind = next(filter(is_dataclass, get_args(kind)), None)
        if get_origin(kind) in (Union, UnionType):
            kind = next(filter(is_dataclass, get_args(kind)), None)
    return [item.name for item in fields(kind)] if is_dataclass(kind) else []
