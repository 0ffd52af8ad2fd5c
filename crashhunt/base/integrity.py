"""Digests by which whoever reads something sees that it is what was written.

They keep nobody out, for there is no key: they find accidents and edits, whichever program made them.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
from typing import TYPE_CHECKING, Any, TypedDict, TypeVar, cast, get_args, get_origin

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.base.plain import Plain

__all__ = [
    "FILES",
    "FileEntry",
    "changed_file",
    "describe_files",
    "digest_of_content",
    "digest_of_data",
    "digest_of_file",
    "digest_of_row",
    "parse_object",
    "read_object",
    "typed",
]

T = TypeVar("T")
_SMALL = 1 << 20  # bytes


class FileEntry(TypedDict):
    """What is written down of a file.

    Args:
        size: in bytes.
        blake2b: the digest of its content, in hexadecimal.
    """

    size: int
    blake2b: str


def digest_of_row(values: tuple[object, ...]) -> int:
    """Return the digest of a row of a table: 64 bits, with a sign, as SQLite keeps them in the least space."""
    text = "\0".join(map(str, values))  # a trial's cost is counted in microseconds, and JSON would take twice as long
    digest = hashlib.blake2b(text.encode("utf-8", "surrogatepass"), digest_size=8).digest()
    return int.from_bytes(digest, "little", signed=True)


def digest_of_data(data: Plain) -> str:
    """Return the digest of a JSON object, in hexadecimal, however it is laid out and ordered."""
    text = json.dumps(data, sort_keys=True, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def digest_of_content(content: bytes) -> str:
    """Return the digest of what is in a file, in hexadecimal."""
    return hashlib.blake2b(content, digest_size=16).hexdigest()


def digest_of_file(path: Path) -> str:
    """Return the digest of a file's content, in hexadecimal.

    Raises:
        OSError: it cannot be read.
    """
    with open(path, "rb", buffering=0) as file:  # hundreds at a time, and a Path takes twice as long
        if os.fstat(file.fileno()).st_size < _SMALL:
            return digest_of_content(file.readall())
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


def describe_files(folder: Path) -> dict[str, FileEntry]:
    """Return size and digest of every file of a folder, by its name.

    Raises:
        OSError: one cannot be read.
    """
    return {
        path.name: {"size": path.stat().st_size, "blake2b": digest_of_file(path)}
        for path in sorted(folder.iterdir())
        if path.is_file()
    }


def changed_file(path: Path, entry: FileEntry) -> str:
    """Say what has become of a file of which size and digest were written down; empty where it is as it was."""
    try:
        status = path.lstat()
        if not stat.S_ISREG(status.st_mode):
            return "is missing"
        same = status.st_size == entry["size"] and digest_of_file(path) == entry["blake2b"]
    except (FileNotFoundError, NotADirectoryError, ValueError):  # the last where no file can have such a name
        return "is missing"
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    return "" if same else "has changed"


def read_object(path: Path, shape: type[T]) -> T:
    """Read a JSON object.

    Args:
        path: of the file.
        shape: the `TypedDict` that it should be; whoever reads it sees with `typed` to what it takes for granted.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is not one, with the reason in one line.
    """
    return parse_object(path.read_bytes(), shape)


def parse_object(text: bytes, shape: type[T]) -> T:  # noqa: ARG001 - for the type checker
    """Return the JSON object that a text is.

    Args:
        text: in UTF-8.
        shape: as for `read_object`.

    Raises:
        ValueError: it is not one, with the reason in one line.
    """
    try:
        found = json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    if not isinstance(found, dict):
        raise ValueError(f"it holds {type(found).__name__}, not an object")
    return cast(T, found)


FILES = dict[str, dict[str, int | str]]
"""The type of what `describe_files` returns, for `typed`."""


def typed(data: Plain, types: Plain) -> None:
    """See that an object has some keys, and of which types their values are.

    Args:
        data: the object.
        types: key to type: a class, a union of classes, ``list[...]`` or ``dict[str, ...]``. An int is a float too.

    Raises:
        ValueError: with the key, its value and the type.
    """
    for key, kind in types.items():
        if key not in data:
            raise ValueError(f"{key!r} is missing")
        if not _is(data[key], kind):
            raise ValueError(f"{key} is {_short(data[key])}, not {_words(kind)}")


def _is(value: object, kind: Any) -> bool:
    if type(kind) is not type:  # classes are asked for a thousand times, and have no parts
        origin, inner = get_origin(kind), get_args(kind)
        if origin is list:
            return isinstance(value, list) and all(_is(item, inner[0]) for item in value)
        if origin is dict:
            return isinstance(value, dict) and all(_is(item, inner[1]) for item in value.values())
        if inner:  # a union
            return any(_is(value, choice) for choice in inner)
    if kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    if kind is int:
        return isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**63
    return isinstance(value, kind)


def _words(kind: object) -> str:
    return re.sub(r"<class '([^']+)'>", r"\1", str(kind))


def _short(value: object) -> str:
    text = repr(value) if not isinstance(value, int) or abs(value) < 2**64 else "a number that is too large"
    return text if len(text) <= 60 else f"{text[:57]}…"
