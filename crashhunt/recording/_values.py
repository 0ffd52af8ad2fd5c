"""Values of any class as text, for observations and actions whose space has no fixed size.

The text is JSON in ASCII. Numbers, texts, None and lists are JSON values. Any other value is a JSON object with one key
that names its class, such as ``tuple``, ``dict``, ``bytes``, ``array``, ``scalar``, ``graph`` and so on. A value of an
unknown class is written as ``opaque``, with the name of its class and a digest of its content. Equal values have equal
texts, in every process. Pickle is not used.
"""

from __future__ import annotations

import base64
import copyreg
import hashlib
import json
from types import BuiltinFunctionType, FunctionType
from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from numpy.typing import NDArray

OPAQUE_SHAPE: Final = (-1,)
"""The shape, in the prologue of a recording, of arrays that hold the text of a value; each has its own length."""

_PLAIN_DTYPES: Final = frozenset("biufcSUMm")
_DIGEST_BYTES: Final = 16
_MAX_DEPTH: Final = 200  # of values inside values; deeper ones are written as their class only
_MAX_SHOWN_ARRAY: Final = 12  # elements


_COLLECTIONS: Final[Mapping[str, Callable[[Iterable[object]], object]]] = {
    "list": list, "tuple": tuple, "set": set, "frozenset": frozenset,
}  # fmt: skip
_BYTES: Final[Mapping[str, Callable[[bytes], object]]] = {"bytes": bytes, "bytearray": bytearray}


class OpaqueValue:
    """A placeholder for a value whose class a recording cannot contain.

    Args:
        kind: Module and name of the class.
        digest: BLAKE2b digest of the content, in hexadecimal; empty if the content cannot be read.
        content: The content, if the class is derived from a class that recordings can store; otherwise None.
    """

    def __init__(self, kind: str, digest: str, content: object = None) -> None:
        self.kind = kind
        self.digest = digest
        self.content = content

    def __eq__(self, other: object) -> bool:
        return isinstance(other, OpaqueValue) and encode_value(self).tobytes() == encode_value(other).tobytes()

    def __hash__(self) -> int:
        return hash((self.kind, self.digest))

    def __repr__(self) -> str:
        return f"<{self.kind} {self.digest or 'of unknown content'}>"


def is_opaque(shape: Sequence[int]) -> bool:
    """Return whether the arrays of an agent's channel contain values as text."""
    return tuple(shape) == OPAQUE_SHAPE


def encode_value(value: object) -> NDArray[np.uint8]:
    """Return the text of a value of any class as an array of bytes, shape (length,).

    If reading the content of a value fails, the value is written without a digest.
    """
    return np.frombuffer(json.dumps(_Encoder().plain(value), separators=(",", ":")).encode(), np.uint8)


def decode_value(array: NDArray[np.generic]) -> tuple[Any, bool]:
    """Decode a text of `encode_value`; return the value, and whether it equals the original in value and class.

    A value whose class cannot be restored is returned as an `OpaqueValue`.

    Raises:
        ValueError: The array does not contain a text of `encode_value`.
    """
    decoder = _Decoder()
    try:
        value = decoder.value(json.loads(array.tobytes()))
    except (KeyError, TypeError, IndexError, AttributeError, RecursionError) as error:
        raise ValueError(f"not a recorded value: {type(error).__name__}: {error}") from error
    return value, decoder.is_whole


def describe_value(array: NDArray[np.generic], limit: int = 400) -> str:
    """Return a recorded value as one line of at most ``limit`` characters; of large arrays, only type and shape."""
    try:
        value, _ = decode_value(array)
    except ValueError:
        return "(damaged)"
    text = " ".join(repr(_displayed(value)).split())
    return text if len(text) <= limit else f"{text[: limit - 1]}…"


class _Shown(str):
    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


def _displayed(value: Any) -> object:
    if isinstance(value, np.ndarray):
        if value.size <= _MAX_SHOWN_ARRAY:
            return value.tolist()
        return _Shown(f"{value.dtype} array of shape {value.shape}")
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, dict):
        return {_displayed(key): _displayed(item) for key, item in value.items()}
    if type(value) in (list, tuple):
        return type(value)(map(_displayed, value))
    if _is_graph(value):
        return _Shown(f"GraphInstance{tuple(map(_displayed, value))!r}")
    return value


def _name_of(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"


def _text(data: bytes | memoryview) -> str:
    return base64.b64encode(data).decode()


def _is_graph(value: object) -> bool:
    return _name_of(type(value)) == "gymnasium.spaces.graph.GraphInstance"


class _Encoder:
    def __init__(self) -> None:
        self._open: list[object] = []  # the values that are being written, the outermost first

    def plain(self, value: Any) -> object:
        """Convert a value of any class to a JSON value."""
        kind = type(value)
        if value is None or kind in (bool, int, str, float):
            return value
        if any(value is one for one in self._open) or len(self._open) > _MAX_DEPTH:
            return {"opaque": [_name_of(kind), ""]}
        self._open.append(value)
        try:
            return self._known(value, kind) or self._derived(value, kind) or self._opaque(value, kind)
        finally:
            self._open.pop()

    def _known(self, value: Any, kind: type) -> object:
        """Convert a value of a class that can be restored to a JSON value; return None for other classes."""
        if kind is list:
            return {"list": list(map(self.plain, value))}
        if kind is tuple or _is_graph(value):
            return {"tuple" if kind is tuple else "graph": list(map(self.plain, value))}
        if kind is dict:
            return {"dict": [[self.plain(key), self.plain(item)] for key, item in value.items()]}
        if kind in (set, frozenset):
            items = sorted((self.plain(item) for item in value), key=json.dumps)
            return {kind.__name__: items}
        if kind in (bytes, bytearray):
            return {kind.__name__: _text(bytes(value))}
        if kind is complex:
            return {"complex": [value.real, value.imag]}
        if kind is np.ndarray:
            return self._array(value)
        if isinstance(value, np.generic) and kind.__module__ == "numpy" and value.dtype.kind in _PLAIN_DTYPES:
            return {"scalar": [value.dtype.str, _text(value.tobytes())]}
        if kind is OpaqueValue:
            content = [] if value.content is None else [self.plain(value.content)]
            return {"opaque": [value.kind, value.digest, *content]}
        return None

    def _array(self, value: Any) -> object:
        if value.dtype.kind in _PLAIN_DTYPES:
            return {"array": [value.dtype.str, list(value.shape), _text(np.ascontiguousarray(value).tobytes())]}
        if value.dtype.kind == "O":
            return {"objects": [list(value.shape), [self.plain(item) for item in value.reshape(-1)]]}
        return None

    def _derived(self, value: Any, kind: type) -> object:
        """Convert a value of a class derived from a known class to a JSON value; return None for other classes."""
        content: object = None
        if isinstance(value, np.ndarray):
            content = self._array(np.asarray(value)) if value.__class__ is kind else None
        elif isinstance(value, dict):
            content = {"dict": [[self.plain(key), self.plain(item)] for key, item in dict.items(value)]}
        elif isinstance(value, tuple | list):
            base: Any = tuple if isinstance(value, tuple) else list
            content = {base.__name__: [self.plain(item) for item in base.__iter__(value)]}
        if content is None:
            return None
        return {"opaque": [_name_of(kind), self._digest(value), content]}

    def _opaque(self, value: Any, kind: type) -> object:
        if isinstance(value, type | FunctionType | BuiltinFunctionType):
            return {"opaque": [f"{value.__module__}.{value.__qualname__}", ""]}
        return {"opaque": [_name_of(kind), self._digest(value)]}

    def _digest(self, value: Any) -> str:
        """Return the digest of the content of a value of any class; empty if the content cannot be read."""
        reduce: Callable[[Any], Any] | None = copyreg.dispatch_table.get(type(value))
        try:  # this is code of the class, which may raise anything, such as that of a lock or a connection
            parts = reduce(value) if reduce is not None else value.__reduce_ex__(4)
            if isinstance(parts, str):
                content: list[object] = [parts]
            else:
                made, given, state, items, pairs = (*parts, None, None, None)[:5]
                content = [made, given, state, list(items or ()), list(pairs or ())]
        except Exception:
            return ""
        text = json.dumps([self.plain(part) for part in content])
        return hashlib.blake2b(text.encode(), digest_size=_DIGEST_BYTES).hexdigest()


class _Decoder:
    def __init__(self) -> None:
        self.is_whole = True

    def value(self, plain: Any) -> Any:
        """Convert a JSON value back to the value that it represents."""
        if not isinstance(plain, dict):
            if isinstance(plain, list):
                raise ValueError("a list without a type is not a recorded value")
            return plain
        ((kind, content),) = plain.items()
        if kind == "opaque":
            self.is_whole = False
            name, digest, *rest = content
            return OpaqueValue(str(name), str(digest), self.value(rest[0]) if rest else None)
        if kind in _COLLECTIONS:
            return _COLLECTIONS[kind](map(self.value, content))
        if kind in _BYTES:
            return _BYTES[kind](base64.b64decode(content))
        made: object = getattr(self, f"_{kind}")(content)
        return made

    def _dict(self, content: Any) -> dict[object, object]:
        return {self.value(key): self.value(item) for key, item in content}

    def _complex(self, content: Any) -> complex:
        return complex(*content)

    def _array(self, content: Any) -> NDArray[np.generic]:
        dtype, shape, data = content
        if np.dtype(dtype).itemsize == 0:  # of empty texts
            return np.zeros(shape, dtype)
        found: NDArray[np.generic] = np.frombuffer(base64.b64decode(data), dtype).reshape(shape).copy()
        return found

    def _scalar(self, content: Any) -> np.generic:
        dtype, data = content
        scalar: np.generic = self._array([dtype, [1], data])[0]
        return scalar

    def _objects(self, content: Any) -> NDArray[np.object_]:
        shape, items = content
        found = np.empty(len(items), object)
        for place, item in enumerate(items):
            found[place] = self.value(item)
        return found.reshape(shape)

    def _graph(self, content: Any) -> object:
        from gymnasium.spaces import GraphInstance

        nodes, edges, edge_links = (self.value(item) for item in content)
        return GraphInstance(nodes, edges, edge_links)
