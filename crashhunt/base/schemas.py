"""JSON Schema (draft 2020-12) for typed dictionaries and for the dataclasses that `crashhunt.base.codec` writes.

Additional keys are allowed everywhere, because later versions may add keys.
"""

from __future__ import annotations

import collections.abc
import sys
from collections.abc import Mapping, Sequence, Set as AbstractSet
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Any,
    ClassVar,
    Literal,
    NotRequired,
    Required,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

from crashhunt.base.codec import JsonObject, Serializable

__all__ = ["describe_type", "json_schema"]

_JSON_TYPES = {bool: "boolean", int: "integer", float: "number", str: "string", NoneType: "null"}
_ABSTRACT_TYPES: Mapping[str, Any] = {
    "ClassVar": ClassVar,
    **{name: getattr(collections.abc, name) for name in ("Mapping", "Sequence", "Callable", "Iterable")},
}
"""What modules usually import for the type checker only."""


def json_schema(kind: Any, title: str, names: Mapping[str, Any] = _ABSTRACT_TYPES) -> JsonObject:
    """Return the JSON schema of a type, with its title and the schema dialect.

    Args:
        kind: a `TypedDict`, a `Serializable` dataclass, or a type made of these.
        title: title of the schema.
        names: objects that annotations use, but that their modules import only for the type checker.

    Raises:
        NameError: an annotation uses a name that neither its module nor ``names`` contains.
    """
    described = describe_type(kind, {**_ABSTRACT_TYPES, **names})
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": title, **described}


def describe_type(hint: Any, names: Mapping[str, Any] = _ABSTRACT_TYPES) -> JsonObject:
    """Return the JSON schema of a type; ``{}``, which allows everything, if the type has several forms in JSON."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Required, NotRequired):
        return describe_type(inner[0], names)
    if origin in (Union, UnionType):
        return _any_of([describe_type(choice, names) for choice in inner])
    if origin is Literal:
        return {"enum": list(inner)}
    if is_typeddict(hint):
        hints = _hints(hint, names)
        # `__required_keys__` has every key where annotations are strings.
        needed = [key for key in hints if get_origin(hints[key]) is not NotRequired and hint.__total__]
        return _object({key: describe_type(hints[key], names) for key in hints}, sorted(needed))
    kind = hint if origin is None else origin
    if not isinstance(kind, type):
        return {}
    if kind in _JSON_TYPES:
        return {"type": _JSON_TYPES[kind]}
    if issubclass(kind, Enum):
        return {"enum": [str(member) for member in kind]}
    if issubclass(kind, Path):
        return {"type": "string"}
    if issubclass(kind, Serializable) and is_dataclass(kind):
        return _of_dataclass(kind, names)
    if issubclass(kind, Mapping):
        return (
            {"type": "object", "additionalProperties": describe_type(inner[-1], names)} if inner else {"type": "object"}
        )
    if issubclass(kind, tuple) and inner and inner[-1] is not Ellipsis:
        items = [describe_type(item, names) for item in inner]
        return {"type": "array", "prefixItems": items, "minItems": len(items), "maxItems": len(items)}
    if issubclass(kind, Sequence | AbstractSet):
        return {"type": "array", "items": describe_type(inner[0], names)} if inner else {"type": "array"}
    return {}


def _of_dataclass(kind: Any, names: Mapping[str, Any]) -> JsonObject:
    if kind.to_json is not Serializable.to_json:  # writes other keys than its fields
        return {"type": "object"}
    known, hints = {item.name: item for item in fields(kind)}, _hints(kind, names)
    properties, required = {}, []
    for name in kind.json_keys or known:
        key = name.removesuffix("?")
        metadata = known[key].metadata if key in known else {}
        hint = hints[key] if key in known else _hints(getattr(kind, key).fget, names).get("return", Any)
        properties[key] = describe_type(hint | None if "null" in metadata else hint, names)
        if key == name and not {"omit_default", "written_if"} & {*metadata}:
            required.append(key)
    return _object(properties, sorted(required))


def _object(properties: JsonObject, required: list[str]) -> JsonObject:
    found: JsonObject = {"type": "object", "properties": properties}
    return {**found, "required": required} if required else found


def _any_of(choices: list[JsonObject]) -> JsonObject:
    if {} in choices:
        return {}
    plain = [choice["type"] for choice in choices if choice.keys() == {"type"} and choice["type"] != "object"]
    others = [choice for choice in choices if choice.keys() != {"type"} or choice["type"] == "object"]
    merged = [{"type": plain[0] if len(plain) == 1 else plain}] if plain else []
    return others[0] if len(others) == 1 and not merged else merged[0] if not others else {"anyOf": [*others, *merged]}


def _hints(kind: Any, names: Mapping[str, Any]) -> dict[str, Any]:
    known = {**names, **vars(sys.modules[kind.__module__])}
    return get_type_hints(kind, globalns=known, localns=known, include_extras=True)
