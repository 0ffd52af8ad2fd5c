"""JSON Schema (draft 2020-12) for types: dataclasses that `crashhunt.base.codec` writes, and typed dictionaries.

Additional keys are allowed everywhere, because later versions may add keys.
"""

from __future__ import annotations

import ast
import inspect
import sys
from collections.abc import Mapping, Sequence, Set as AbstractSet
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache, cached_property
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Any,
    ForwardRef,
    Literal,
    NotRequired,
    Required,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

from crashhunt.base.codec import JsonObject, Serializable, names_of_tuple, written_keys

_JSON_TYPES = {bool: "boolean", int: "integer", float: "number", str: "string", NoneType: "null"}


def json_schema(kind: object, title: str) -> JsonObject:
    """Return the JSON schema of a type, with its title and the schema dialect.

    Args:
        kind: a `Serializable` dataclass, a `TypedDict`, or a type made of these. A dict of types describes an object:
            a key with a question mark is not always there, and the key ``**`` adds the keys of its type. A list of one
            type describes an array, and a tuple a choice of types.
        title: title of the schema.

    Raises:
        NameError: an annotation uses a name that its module lacks.
    """
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": title, **describe_type(kind)}


def describe_type(hint: Any) -> JsonObject:
    """Return the JSON schema of a type; ``{}``, which allows everything, if the type has several forms in JSON."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Required, NotRequired):
        return describe_type(inner[0])
    if origin in (Union, UnionType):
        return _any_of([describe_type(choice) for choice in inner])
    if origin is Literal:
        return {"enum": list(inner)}
    if isinstance(hint, tuple):
        return _any_of([describe_type(choice) for choice in hint])
    if isinstance(hint, list):
        return {"type": "array", "items": describe_type(hint[0])}
    if isinstance(hint, dict):
        return _of_keys(hint)
    if is_typeddict(hint):
        hints = get_type_hints(hint, *_names(hint), include_extras=True)
        # `__required_keys__` has every key where annotations are strings.
        optional = {key for key in hints if get_origin(hints[key]) is NotRequired or not hint.__total__}
        return _of_keys({f"{key}?" if key in optional else key: hints[key] for key in hints})
    kind = hint if origin is None else origin
    if kind is None:
        return {"type": "null"}
    if not isinstance(kind, type):
        return {}
    if kind in _JSON_TYPES:
        return {"type": _JSON_TYPES[kind]}
    if issubclass(kind, Enum):  # one that makes members of unknown values has no list of all
        return {"type": "string"} if "_missing_" in vars(kind) else {"enum": [str(member) for member in kind]}
    if issubclass(kind, Path):
        return {"type": "string"}
    if issubclass(kind, Serializable) and is_dataclass(kind):
        return _of_dataclass(kind)
    if issubclass(kind, Mapping):
        return {"type": "object", "additionalProperties": describe_type(inner[-1])} if inner else {"type": "object"}
    if names := names_of_tuple(kind):
        hints = {name: _type_at(kind, name) for name in names}
        return _of_keys({name: one | None if one is float else one for name, one in hints.items()})
    if issubclass(kind, tuple) and inner and inner[-1] is not Ellipsis:
        items = [describe_type(item) for item in inner]
        return {"type": "array", "prefixItems": items, "minItems": len(items), "maxItems": len(items)}
    if issubclass(kind, Sequence | AbstractSet):
        return {"type": "array", "items": describe_type(inner[0])} if inner else {"type": "array"}
    return {}


def _of_keys(keys: Mapping[str, object]) -> JsonObject:
    """Return the schema of an object from the type of each key; see `json_schema`."""
    properties: JsonObject = {}
    required: list[str] = []
    for key, hint in keys.items():
        described = describe_type(hint)
        if key == "**":
            properties |= described["properties"]
            required += described.get("required", ())
        else:
            properties[key.removesuffix("?")] = described
            required += [key] if not key.endswith("?") else []
    found: JsonObject = {"type": "object", "properties": properties}
    return {**found, "required": sorted({*required})} if required else found


def _of_dataclass(kind: Any) -> JsonObject:
    if kind.to_json is not Serializable.to_json:  # writes other keys than its fields
        return {"type": "object"}
    known, keys = {item.name: item for item in fields(kind)}, {}
    for key, path, is_optional in written_keys(kind):
        metadata = known[key].metadata if key == path and key in known else {}
        hint = _type_at(kind, path)
        if is_optional:
            hint = Union[tuple(choice for choice in get_args(hint) if choice is not NoneType)]  # noqa: UP007
        is_optional = is_optional or bool({"omit_default", "written_if"} & {*metadata})
        keys[f"{key}?" if is_optional else key] = hint
    return _of_keys(keys)


def _type_at(kind: Any, path: str) -> Any:
    """Return the type of an attribute of a class, or of an object inside it such as ``bundle.id``."""
    name, _, rest = path.partition(".")
    owner = next(base for base in kind.__mro__ if name in {**vars(base), **vars(base).get("__annotations__", {})})
    held = vars(owner).get(name)
    getter = held.fget if isinstance(held, property) else held.func if isinstance(held, cached_property) else None
    annotation = vars(owner)["__annotations__"][name] if getter is None else getter.__annotations__.get("return", Any)
    if isinstance(annotation, ForwardRef):  # of a named tuple
        annotation = annotation.__forward_arg__
    hint = eval(annotation, *_names(owner)) if isinstance(annotation, str) else annotation
    if is_dataclass(owner) and any(item.name == name and "null" in item.metadata for item in fields(owner)):
        hint |= None
    if not rest:
        return hint
    if rest.isdigit():
        return get_args(hint)[int(rest)]
    choices = [choice for choice in get_args(hint) or [hint] if choice is not NoneType]
    inner = _type_at(choices[0], rest)
    return inner | None if NoneType in get_args(hint) else inner


def _names(kind: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the names of the module of a class, with those that it imports for the type checker only."""
    return vars(sys.modules[kind.__module__]), _names_for_type_checkers(kind.__module__)


@cache
def _names_for_type_checkers(module: str) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for node in ast.parse(inspect.getsource(sys.modules[module])).body:
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            exec(ast.unparse(ast.Module(node.body, [])), found)
    return found


def _any_of(choices: list[JsonObject]) -> JsonObject:
    if {} in choices:
        return {}
    plain = [choice["type"] for choice in choices if choice.keys() == {"type"} and choice["type"] != "object"]
    others = [choice for choice in choices if choice.keys() != {"type"} or choice["type"] == "object"]
    merged = [{"type": plain[0] if len(plain) == 1 else plain}] if plain else []
    return others[0] if len(others) == 1 and not merged else merged[0] if not others else {"anyOf": [*others, *merged]}
