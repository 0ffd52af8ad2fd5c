"""Tolerant reading of data from other versions of crashhunt: unknown keys are kept aside, known ones are checked."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from functools import cache
from types import UnionType
from typing import TYPE_CHECKING, Any, Union, cast, get_args, get_origin, get_type_hints

from crashhunt.base.integrity import typed
from crashhunt.base.text import did_you_mean

if TYPE_CHECKING:
    from collections.abc import Iterable

    from crashhunt.base.json_types import Plain

__all__ = [
    "ESSENTIAL",
    "essentials",
    "known_part",
    "known_values",
    "merged",
    "not_understood",
    "required_in",
    "required_of",
    "slip",
    "typed_where_there",
]

ESSENTIAL: Plain = {"essential": True}
"""Metadata of a field that another version must know where it is not at its default, or refuse: without it, what
crosses to that version would mean something else."""


def known_values(kind: type, data: Plain) -> dict[str, Any]:
    """Return the values for which a dataclass has fields, without those that a later version has added.

    Args:
        kind: the dataclass.
        data: keys and values as they were read.
    """
    known = {item.name for item in fields(kind)}
    return {name: value for name, value in data.items() if name in known}


def known_part(kind: Any, data: object) -> tuple[Any, Any]:
    """Split plain data into the part for which a dataclass has fields, at any depth, and the rest with the same layout.

    Unknown keys of items of a list are dropped; every other unknown key is in the rest. The rest is an empty dict if
    everything is known.
    """
    if is_dataclass(kind) and isinstance(data, dict):
        hints = _hints_of(cast(Any, kind))
        return _split({name: hints[name] for name in data if name in hints}, data)
    origin, inner = get_origin(kind), get_args(kind)
    if origin is dict and isinstance(data, dict):
        return _split(dict.fromkeys(data, inner[1]), data)
    if origin in (Union, UnionType):
        others = [other for other in inner if other is not type(None)]
        return known_part(others[0], data) if len(others) == 1 else (data, {})
    if origin in (list, tuple) and isinstance(data, list) and inner:
        return [known_part(inner[0], item)[0] for item in data], {}
    return data, {}


@cache
def _hints_of(kind: Any) -> dict[str, object]:
    try:
        return get_type_hints(kind)
    except NameError:  # of a type that is imported for the checker only, and so is no table of a file
        return dict.fromkeys((item.name for item in fields(kind)), Any)


def _split(kinds: Plain, data: Plain) -> tuple[dict[str, object], dict[str, object]]:
    known: dict[str, object] = {}
    rest = {name: value for name, value in data.items() if name not in kinds}
    for name, kind in kinds.items():
        known[name], more = known_part(kind, data[name])
        if more:
            rest[name] = more
    return known, rest


def merged(data: Plain, rest: Plain) -> dict[str, object]:
    """Return plain data with what was left aside of it, where nothing else has taken its place."""
    found = dict(data)
    for name, value in rest.items():
        if name not in found:
            found[name] = value
        elif isinstance(value, dict) and isinstance(there := found[name], dict):
            found[name] = merged(there, value)
    return found


def slip(rest: Plain, known: Plain, kind: type) -> str:
    """Return an unknown key that resembles a missing one (a typing error or damage); otherwise an empty string.

    Args:
        rest: the unknown part, of `known_part`.
        known: the known part.
        kind: the dataclass.
    """
    missing = [item.name for item in fields(kind) if item.name not in known]
    return next((name for name in rest if name not in known and did_you_mean(name, missing)), "")


def typed_where_there(data: Plain, types: Plain) -> None:
    """See of which types the values of some keys are, of those that are there.

    Raises:
        ValueError: with the key, its value and the type.
    """
    typed(data, {key: kind for key, kind in types.items() if key in data})


def essentials(*kinds: Any) -> frozenset[str]:
    """Return the names of all essential fields of some dataclasses, and of those inside them."""
    found: set[str] = set()
    for kind in kinds:
        if is_dataclass(kind):
            found |= {item.name for item in fields(kind) if "essential" in item.metadata}
            found |= essentials(*_hints_of(cast(Any, kind)).values())
        found |= essentials(*get_args(kind))
    return frozenset(found)


def not_understood(needed: Iterable[str], *kinds: object) -> list[str]:
    """Return what plain data says that its reader must know (``requires``), and none of some dataclasses has."""
    return sorted(set(needed) - essentials(*kinds)) if needed else []


def required_of(value: object) -> list[str]:
    """Return the names of the essential fields of an object that are not at their default; not of those inside it."""
    return [name for name, default in _essential(cast(Any, type(value))) if getattr(value, name) != default]


def required_in(value: object) -> list[str]:
    """Return the same of an object and of all those inside it."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list | tuple):
        return sorted({name for inner in value for name in required_in(inner)})
    if not is_dataclass(value):
        return []
    inside = (getattr(value, item.name) for item in fields(value))
    return sorted({*required_of(value), *(name for inner in inside for name in required_in(inner))})


@cache
def _essential(kind: Any) -> list[tuple[str, object]]:
    return [(item.name, item.default) for item in fields(kind) if "essential" in item.metadata]
