"""Loads a shared library with the C interface of agents, and returns its functions and the libraries that it needs.

This file imports only the standard library, because `crashhunt.base.agent_locators` runs it by its path in a process of
its own. A library may end or stop the process that loads it.
"""

from __future__ import annotations

import ctypes
import json
import os
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

FUNCTIONS = ("crashhunt_create", "crashhunt_reset", "crashhunt_act", "crashhunt_destroy")
DECLARATION = "crashhunt_agent"
_RTLD_DI_LINKMAP = 2
_DT_NEEDED, _DT_STRTAB, _DT_SONAME = 1, 5, 14


class _Entry(ctypes.Structure):
    _fields_ = (("tag", ctypes.c_ssize_t), ("value", ctypes.c_size_t))


class _LinkMap(ctypes.Structure):
    """An entry in the list of the loaded libraries, as in ``link.h``."""


_LinkMap._fields_ = [
    ("address", ctypes.c_size_t),
    ("name", ctypes.c_char_p),
    ("dynamic", ctypes.POINTER(_Entry)),
    ("next", ctypes.POINTER(_LinkMap)),
    ("previous", ctypes.POINTER(_LinkMap)),
]


def missing_symbols(library: ctypes.CDLL) -> list[str]:
    """Return the names of the interface that a library does not export."""
    return [name for name in (*FUNCTIONS, DECLARATION) if not hasattr(library, name)]


def declaration_of(library: ctypes.CDLL) -> str:
    """Return the text of ``CRASHHUNT_AGENT(...)`` in a library."""
    return ctypes.string_at(ctypes.addressof(ctypes.c_char.in_dll(library, DECLARATION))).decode("utf-8", "replace")


def libraries_of(library: ctypes.CDLL) -> list[str]:
    """Return the files of the libraries that a loaded library needs; each one follows those that it needs itself."""
    by_name: dict[str, tuple[str, list[str]]] = {}
    for one in _loaded_with(library):
        path, (own, needed) = os.fsdecode(one.name or b""), _names_in(one)
        for name in (own, path, os.path.basename(path)):  # noqa: PTH119 - this file is quick to start
            by_name.setdefault(name, (path, needed))
    found: dict[str, None] = {}
    _collect(_names_in(_entry_of(library))[1], by_name, found, set())
    return list(found)


def loaded_files() -> list[str]:
    """Return the files of all libraries that this process has loaded."""
    return [os.fsdecode(one.name or b"") for one in _loaded_with(ctypes.CDLL(None))]


def _entry_of(library: ctypes.CDLL) -> _LinkMap:
    """Return the entry of a library in the list of the loaded libraries."""
    place = ctypes.POINTER(_LinkMap)()
    dlinfo = ctypes.CDLL(None).dlinfo
    dlinfo.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p]
    if dlinfo(library._handle, _RTLD_DI_LINKMAP, ctypes.byref(place)) != 0:
        raise OSError("the loader does not list its libraries")
    return place.contents


def _loaded_with(library: ctypes.CDLL) -> Iterator[_LinkMap]:
    """Yield the entries of all loaded libraries, in the order in which they were loaded."""
    first = _entry_of(library)
    while first.previous:
        first = first.previous.contents
    one = ctypes.pointer(first)
    while one:
        yield one.contents
        one = one.contents.next


def _collect(
    names: list[str], by_name: dict[str, tuple[str, list[str]]], found: dict[str, None], seen: set[str]
) -> None:
    for name in names:
        if name in by_name and name not in seen:
            seen.add(name)
            path, needed = by_name[name]
            _collect(needed, by_name, found, seen)
            found.setdefault(path)


def _names_in(loaded: _LinkMap) -> tuple[str, list[str]]:
    """Return the name that a loaded library has for others, and the names of the libraries that it needs."""
    entries: list[tuple[int, int]] = []
    while loaded.dynamic and loaded.dynamic[len(entries)].tag:
        entry = loaded.dynamic[len(entries)]
        entries.append((entry.tag, entry.value))
    texts = dict(entries).get(_DT_STRTAB, 0)
    texts += loaded.address if texts < loaded.address else 0  # on some machines the loader does not add it

    def names(wanted: int) -> list[str]:
        return [os.fsdecode(ctypes.string_at(texts + value)) for tag, value in entries if tag == wanted]

    return (names(_DT_SONAME) or [""])[0], names(_DT_NEEDED)


def _answer(path: str) -> dict[str, object]:
    try:
        library = ctypes.CDLL(path)
    except OSError as error:
        return {"error": str(error)}
    missing = missing_symbols(library)
    if missing:
        return {"missing": missing}
    return {"declaration": declaration_of(library), "libraries": libraries_of(library)}


if __name__ == "__main__":
    with os.fdopen(os.dup(1), "w", encoding="utf-8") as answer:
        os.dup2(2, 1)  # the library may print when it is loaded
        answer.write(json.dumps(_answer(sys.argv[1])))
    os._exit(0)  # without the destructors of the library
