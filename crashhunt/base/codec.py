"""Converts dataclasses to the JSON objects of files and messages, and back.

The annotations of a dataclass determine how each field is converted, so each data format is defined only once.
Deviations from the annotations are declared in the metadata of a field, with `OMIT_DEFAULT`, `null_is` and
`written_if`.

Invariants: keys are written in the order of `Serializable.json_keys`, which is part of the file formats. A missing key
means the default of its field. Unknown keys are ignored; `known_part` and `merged` preserve them when a file is written
again.

Reason for not using a library: cattrs and pydantic have all these features, but add 30 and 60 ms to the start of every
command. msgspec adds 15 ms. For a dataclass, msgspec has no option for null as infinity, for omitted keys or for the
order of keys, so many dataclasses would still need their own functions. The conversion of a typical result takes
msgspec 2 us and this module 10 us. `json.loads` takes 15 us before that.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence, Set as AbstractSet
from contextlib import suppress
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from functools import cache
from operator import methodcaller
from pathlib import Path
from types import UnionType
from typing import (
    TYPE_CHECKING,
    Any,
    ClassVar,
    Self,
    TypeAlias,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

from crashhunt.base.integrity import typed
from crashhunt.base.json_types import finite
from crashhunt.base.text import did_you_mean

if TYPE_CHECKING:
    from crashhunt.base.json_types import Plain


JsonObject: TypeAlias = dict[str, Any]
"""The JSON object of a `Serializable`: its keys are the fields."""

_Convert: TypeAlias = Callable[[Any], Any]
_T = TypeVar("_T")

OMIT_DEFAULT: Mapping[str, object] = {"omit_default": True}
"""Metadata of a field that is not written where it has its default."""


def null_is(value: float | None) -> Mapping[str, object]:
    """Return the metadata of a numeric field that is written as null if not finite; null is read as ``value``."""
    return {"null": value}


def written_if(condition: Callable[[Any], object]) -> Mapping[str, object]:
    """Return the metadata of a field that is written only if its object satisfies a condition."""
    return {"written_if": condition}


class Serializable:
    """Base class of the dataclasses that can be converted to JSON."""

    __slots__ = ()

    json_keys: ClassVar[tuple[str, ...]] = ()
    """The fields and properties that are written, in this order; by default all fields.

    ``KEY?`` is not written where it is None. ``KEY=PATH`` writes an attribute of another name, or of an object inside
    this one, such as ``crash=bundle.id`` and ``first=pair.0``; None where an object on the way is None.
    """

    def equals(self, other: object) -> bool:
        """Return whether another object is of the same class and has equal fields, where the same NaN equals itself.

        The ``==`` of dataclasses does so until Python 3.12. From 3.13 on, an event at an unknown place would differ
        from itself.
        """
        if type(other) is not type(self):
            return False
        names = [item.name for item in fields(self)]  # type: ignore[arg-type]  # its subclasses are dataclasses
        return [getattr(self, name) for name in names] == [getattr(other, name) for name in names]

    def to_json(self) -> JsonObject:
        """Return the object as dicts, lists, strings and numbers."""
        return to_plain(self)

    @classmethod
    def from_json(cls, data: Plain) -> Self:
        """Rebuild an object from data of `to_json` of any version: unknown keys are ignored, missing ones get defaults.

        Raises:
            ValueError: a key without a default is missing, or a value cannot be converted; the message names the key.
        """
        return from_plain(cls, data)


def to_plain(value: Serializable) -> JsonObject:
    """Convert a dataclass to a JSON object, according to its annotations."""
    return cast(JsonObject, _write_function(cast(Any, type(value)))(value))


def from_plain(kind: type[_T], data: Plain) -> _T:
    """Convert a JSON object to a dataclass, according to its annotations; see `Serializable.from_json`."""
    if not isinstance(data, dict):
        raise TypeError(f"{str(data)[:60]!r} is not a JSON object")
    values: JsonObject = {}
    for key, convert, needed in _readers(cast(Any, kind)):
        if key in data:
            try:
                values[key] = data[key] if convert is None else convert(data[key])
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                raise ValueError(f"{key}: {error}") from error
        elif needed:
            raise ValueError(f"{key!r} is missing")
    return kind(**values)


def prepare(kind: type[Serializable]) -> None:
    """Create the converters of a class and of all classes inside it; forks of this process inherit the converters."""
    _write_function(cast(Any, kind))
    _readers(cast(Any, kind))
    inside = [tuple(_hints(cast(Any, kind)).values())]
    while inside:
        for hint in inside.pop():
            found = _kind_of(hint)[0]
            if issubclass(found, Serializable) and is_dataclass(found):
                prepare(found)
            inside.append(get_args(hint))
    essentials(kind)


@cache
def plain_types(kind: Any) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """Return two dicts from each key of a class to the type of its JSON value: for required keys, and for all keys."""
    found: dict[str, Any] = {}
    for item in fields(kind):
        plain = _plain_type(_hints(kind)[item.name])
        found[item.name] = plain | None if "null" in item.metadata else plain
    return {key: found[key] for key, _, needed in _readers(kind) if needed}, found


def _plain_type(hint: Any) -> Any:
    kind, inner = _kind_of(hint)
    plain: Any = hint
    if issubclass(kind, Serializable | Mapping):
        plain = dict
    elif issubclass(kind, Enum | Path):
        plain = str
    elif issubclass(kind, tuple | AbstractSet):
        plain = list[_plain_type(inner[0])] if inner else list  # type: ignore[misc]
    return plain | None if plain is not hint and type(None) in get_args(hint) else plain


@cache
def _hints(kind: Any) -> dict[str, Any]:
    # `get_type_hints` takes 3 ms for a result and its parts, which every command would wait for.
    names = vars(sys.modules[kind.__module__])
    return {item.name: eval(str(item.type), names) for item in fields(kind)}


def _resolvable_hints(kind: Any) -> dict[str, Any]:
    """Return the types of the fields, without those that the module imports for the type checker only."""
    found, names = {}, vars(sys.modules[kind.__module__])
    for item in fields(kind):
        with suppress(NameError):
            found[item.name] = eval(str(item.type), names)
    return found


@cache
def _write_function(kind: Any) -> _Convert:
    # Made from source, as `dataclasses` makes __init__: a loop over the keys takes three times as long.
    hints, known = _resolvable_hints(kind), {item.name: item for item in fields(kind)}
    names: dict[str, object] = {}
    lines = ["def write(value):", " data = {}"]
    for key, path, is_optional in written_keys(kind):
        metadata = known[key].metadata if key == path and key in known else {}
        convert = finite if "null" in metadata else _writer(hints[key]) if key == path and key in hints else plain
        condition = ""
        names |= {
            f"to_{key}": convert,
            f"if_{key}": metadata.get("written_if"),
            f"no_{key}": key in known and default_of(known[key]),
        }
        if "written_if" in metadata:
            condition = f"if if_{key}(value): "
        elif "omit_default" in metadata:
            names[f"no_{key}"] = default_of(known[key])
            condition = f"if value.{key} != no_{key}: "
        elif is_optional:
            condition = f"if value.{path} is not None: "
        held = f"value.{path}" if convert is None else f"None if value.{path} is None else to_{key}(value.{path})"
        if "." in path:
            names[f"to_{key}"] = _plain_at(path.split("."))
            held = f"to_{key}(value)"
        lines.append(f" {condition}data[{key!r}] = {held}")
    exec("\n".join([*lines, " return data"]), names)
    return cast(_Convert, names["write"])


def default_of(item: Field[object]) -> object:
    """Return the default value of a dataclass field; ``MISSING`` if it has none."""
    return item.default_factory() if item.default_factory is not MISSING else item.default


def written_keys(kind: Any) -> list[tuple[str, str, bool]]:
    """Return the keys that `to_plain` writes, each with the path of its attribute, and whether None is not written."""
    found = []
    for entry in kind.json_keys or [item.name for item in fields(kind)]:
        key, _, path = entry.partition("=")
        name = key.removesuffix("?")
        found.append((name, path or name, name != key))
    return found


def names_of_tuple(kind: type) -> tuple[str, ...]:
    """Return the names in a class of named tuples; empty for other classes."""
    return vars(kind).get("_fields", ()) if issubclass(kind, tuple) else ()


def _plain_at(path: list[str]) -> _Convert:
    def get(value: object) -> object:
        for name in path:
            if value is not None:
                value = cast(Sequence[object], value)[int(name)] if name.isdigit() else getattr(value, name)
        return plain(value)

    return get


def plain(value: object) -> object:
    """Return a value for JSON by its class, where no annotation of a field determines the conversion.

    A named tuple becomes an object, and null replaces a number that is not finite.
    """
    if isinstance(value, Serializable):
        return value.to_json()
    if isinstance(value, Enum | Path):
        return str(value)
    if isinstance(value, float):
        return finite(value)
    if isinstance(value, tuple) and (names := names_of_tuple(type(value))):
        return plain(dict(zip(names, value, strict=True)))
    if isinstance(value, Mapping):
        return {str(key): plain(held) for key, held in value.items()}
    if isinstance(value, AbstractSet):
        return [plain(held) for held in sorted(value)]
    return [plain(held) for held in value] if isinstance(value, list | tuple) else value


def _writer(hint: object) -> _Convert | None:
    """Return the function that converts values of a type to JSON data; None if they need no conversion."""
    kind, inner = _kind_of(hint)
    if names_of_tuple(kind):
        return plain
    of_item = _writer(inner[-1 if issubclass(kind, Mapping) else 0]) if inner else None
    if issubclass(kind, Mapping):
        return dict if of_item is None else _of_values(of_item)
    if issubclass(kind, list | tuple | AbstractSet | Sequence) and not issubclass(kind, str):
        return (sorted if issubclass(kind, AbstractSet) else list) if of_item is None else _of_items(of_item, list)
    if issubclass(kind, Serializable):
        return methodcaller("to_json")  # of the object, whose class may override it
    return str if issubclass(kind, Enum | Path) else None


def _of_items(convert: _Convert, kind: _Convert) -> _Convert:
    return lambda held: kind(map(convert, held or ()))


def _of_values(convert: _Convert) -> _Convert:
    return lambda held: {key: convert(item) for key, item in (held or {}).items()}


@cache
def _readers(kind: Any) -> list[tuple[str, _Convert | None, bool]]:
    hints = _hints(kind)
    found: list[tuple[str, _Convert | None, bool]] = []
    for item in fields(kind):
        hint, convert = hints[item.name], None
        if (null := item.metadata.get("null")) is not None:
            convert = _null_as(null)
        elif (convert := _reader(hint)) is not None and type(None) in get_args(hint):
            convert = _optional(convert)
        found.append((item.name, convert, item.default is MISSING and item.default_factory is MISSING))
    return found


def _null_as(null: float) -> _Convert:
    return lambda held: null if held is None else held


def _optional(convert: _Convert) -> _Convert:
    return lambda held: None if held is None else convert(held)


def _reader(hint: object) -> _Convert | None:
    """Return the function that converts JSON data to values of a type; None if they need no conversion."""
    kind, inner = _kind_of(hint)
    if issubclass(kind, Serializable):
        return lambda held: kind.from_json(held or {})
    if issubclass(kind, Enum | Path):
        return kind
    of_item = _reader(inner[-1 if issubclass(kind, Mapping) else 0]) if inner else None
    if issubclass(kind, tuple | AbstractSet):
        return _of_items(of_item, kind) if of_item else lambda held: cast(_Convert, kind)(held or ())
    if of_item is None:
        return None
    return _of_values(of_item) if issubclass(kind, Mapping) else _of_items(of_item, list)


def _kind_of(hint: object) -> tuple[type, tuple[object, ...]]:
    """Return the class of a type hint and the types in its brackets; `object` if several classes are possible."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        choices = [choice for choice in inner if choice is not type(None)]
        return _kind_of(choices[0]) if len(choices) == 1 else (object, ())
    kind = hint if origin is None else origin
    return (kind, inner) if isinstance(kind, type) else (object, ())


# Tolerant reading of data from other versions of crashhunt: unknown keys are kept aside, known ones are checked.

ESSENTIAL: Plain = {"essential": True}
"""Metadata of a field that another version must know where it is not at its default, or refuse: without it, what
crosses to that version would mean something else."""


def known_values(kind: type, data: Plain) -> dict[str, Any]:
    """Return the values for which a dataclass has fields, without values that a later version has added."""
    known = {item.name for item in fields(kind)}
    return {name: value for name, value in data.items() if name in known}


def known_part(kind: Any, data: object) -> tuple[Any, Any]:
    """Split JSON data into the part for which a dataclass has fields, at any depth, and the rest in the same layout.

    Unknown keys of items in a list are dropped; every other unknown key is part of the rest. The rest is an empty dict
    if all keys are known.
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
    """Return JSON data with its unknown keys added again, except keys for which the data have a new value."""
    found = dict(data)
    for name, value in rest.items():
        if name not in found:
            found[name] = value
        elif isinstance(value, dict) and isinstance(there := found[name], dict):
            found[name] = merged(there, value)
    return found


def slip(rest: Plain, known: Plain, kind: type) -> str:
    """Return an unknown key that resembles a missing key (a typing error or damage); empty if there is none.

    Both parts are those of `known_part`.
    """
    missing = [item.name for item in fields(kind) if item.name not in known]
    return next((name for name in rest if name not in known and did_you_mean(name, missing)), "")


def typed_where_there(data: Plain, types: Plain) -> None:
    """Check the types of the values of some keys; keys may be missing.

    Raises:
        ValueError: a value has the wrong type; the message names the key, its value and the type.
    """
    typed(data, {key: kind for key, kind in types.items() if key in data})


def essentials(*kinds: Any) -> frozenset[str]:
    """Return the names of all essential fields of some dataclasses, and of the dataclasses inside them."""
    found: set[str] = set()
    for kind in kinds:
        if is_dataclass(kind):
            found |= _essentials_of(cast(Any, kind))
        found |= essentials(*get_args(kind))
    return frozenset(found)


@cache
def _essentials_of(kind: Any) -> frozenset[str]:
    own = {item.name for item in fields(kind) if "essential" in item.metadata}
    return essentials(*_hints_of(kind).values()) | own


def not_understood(needed: Iterable[str], *kinds: object) -> list[str]:
    """Return the names under ``requires`` in JSON data that are not essential fields of the given dataclasses."""
    return sorted(set(needed) - essentials(*kinds)) if needed else []


def required_of(value: object) -> list[str]:
    """Return the names of an object's essential fields that differ from their defaults; nested objects are ignored."""
    return [name for name, default in _essential(cast(Any, type(value))) if getattr(value, name) != default]


def required_in(value: object) -> list[str]:
    """Return the result of `required_of` for an object and all objects inside it."""
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
