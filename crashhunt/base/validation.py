"""Validated dataclasses: pydantic does the work, and its finding becomes one line of ours."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any, TypeVar, get_args, get_type_hints

from crashhunt.base.names import did_you_mean

if TYPE_CHECKING:
    from crashhunt.base.errors import CrashhuntError

__all__ = ["validate"]

T = TypeVar("T")


def validate(kind: type[T], data: object, *, where: str, error: type[CrashhuntError]) -> T:
    """Build a dataclass from plain data; unknown keys and wrong types are errors.

    Args:
        kind: the dataclass.
        data: as it was read from TOML or JSON.
        where: the file, for the error.
        error: the error to raise; its message has key and value, its fix says what would do.
    """
    from pydantic import ConfigDict, TypeAdapter, ValidationError

    _forbid_unknown(kind, ConfigDict(extra="forbid"), set())
    try:
        return TypeAdapter(kind).validate_python(data)
    except ValidationError as problem:
        first = problem.errors(include_url=False)[0]
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] in ("unexpected_keyword_argument", "extra_forbidden"):
            known = _known_keys(kind, tuple(str(part) for part in first["loc"][:-1]))
            fix = did_you_mean(str(first["loc"][-1]), known) or f"the keys here are {', '.join(known)}"
            raise error(f"unknown key {key!r}", fix=fix, where=where) from None
        if first["type"] in ("missing", "missing_argument"):
            raise error(f"the key {key!r} is missing", fix="add it", where=where) from None
        message = first["msg"][0].lower() + first["msg"][1:]
        raise error(f"{key} = {first['input']!r}: {message}", fix="change the value", where=where) from None


def _forbid_unknown(kind: Any, config: Any, seen: set[Any]) -> None:
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
    """The keys that a table at ``path`` may have."""
    for part in path:
        if is_dataclass(kind):
            kind = get_type_hints(kind).get(part)
        else:  # a table of named tables
            kind = next((inner for inner in get_args(kind) if is_dataclass(inner)), None)
        kind = next((inner for inner in get_args(kind) if is_dataclass(inner)), kind) if not _is_table(kind) else kind
    return [item.name for item in fields(kind)] if is_dataclass(kind) else []


def _is_table(kind: Any) -> bool:
    return is_dataclass(kind) or getattr(kind, "__origin__", None) is dict
