"""A fixed order of SUMO's links at load, through a library that replaces two functions of libsumo.

libsumo processes conflicting links in the order of their memory addresses, on which the behaviour at junctions depends
(see the guide's page on SUMO). With this library, libsumo processes them in the order of their construction. The
library does not belong to the compiled core, because results must not depend on whether the core is used.
"""

from __future__ import annotations

import ctypes
import importlib.util
from functools import cache

# Not part of this package: a snapshot of the code has no compiled part, and uses the one that is installed, if any.
_LIBRARY = "_crashhunt_link_order"
_INTERFACE = 1
"""Raised whenever a function of the library changes; scripts/build_core.py reads it."""
_CHECKED_VERSIONS = ("1.23.0", "1.23.1", "1.24.0", "1.25.0", "1.26.0", "1.27.0", "1.27.1", "1.28.0")
"""The versions of libsumo with which the library was checked."""
_NOT_CALLED = "libsumo does not call the library"
_UNKNOWN_LINKS = "libsumo constructs links in another way"


class LinkOrder:
    """The library for the link order, connected with libsumo.

    Args:
        library: The loaded library; None if it cannot be used.
        reason: Why the order of links is not fixed; empty if it is fixed.
    """

    def __init__(self, library: ctypes.CDLL | None, reason: str) -> None:
        self._library, self.reason = library, reason
        self._loads = self._count_calls()

    def use(self, use: bool) -> None:
        """Give the links of networks that are loaded from now on the fixed order (True), or libsumo's own (False)."""
        if self._library is not None:
            self._library.crashhunt_link_order_use(use)

    def check_load(self) -> str:
        """Return why the links of the last load have no fixed order; empty if they have a fixed order.

        Call this method once after each load.
        """
        ordered, unordered = self._count_calls()
        before, self._loads = self._loads, (ordered, unordered)
        if self.reason or ordered > before[0]:
            return self.reason
        return _UNKNOWN_LINKS if unordered > before[1] else _NOT_CALLED

    def _count_calls(self) -> tuple[int, int]:
        if self._library is None:
            return 0, 0
        return (
            int(self._library.crashhunt_link_order_ordered_loads()),
            int(self._library.crashhunt_link_order_unordered_loads()),
        )


def why_no_link_order(libsumo: str) -> str:
    """Return why the link order cannot be fixed with a version of libsumo; empty if it can."""
    path = _load_library()
    if path is None:
        return "the library is not built"
    if libsumo not in _CHECKED_VERSIONS:
        return f"the library was checked with libsumo {', '.join(_CHECKED_VERSIONS)}, and this is {libsumo}"
    found = _interface()
    if found != _INTERFACE:
        return f"the library is of another version of crashhunt ({found} instead of {_INTERFACE})"
    return ""


@cache
def link_order(libsumo: str, library: str) -> LinkOrder:
    """Load the library that fixes the link order, connect it with libsumo, and return it."""
    if reason := why_no_link_order(libsumo):
        return LinkOrder(None, reason)
    loaded = ctypes.CDLL(str(_load_library()))
    loaded.crashhunt_link_order_bind.restype = ctypes.c_char_p
    for name in ("ordered", "unordered"):
        getattr(loaded, f"crashhunt_link_order_{name}_loads").restype = ctypes.c_longlong
    reason = loaded.crashhunt_link_order_bind(library.encode())
    return LinkOrder(loaded, reason.decode() if reason is not None else "")


@cache
def _load_library() -> str | None:
    """Return the path of the library; None if it is not installed."""
    found = importlib.util.find_spec(_LIBRARY)
    return found.origin if found is not None else None


@cache
def _interface() -> int:
    """Return the interface version of the installed library; 0 if the library has none."""
    try:
        return int(ctypes.CDLL(str(_load_library())).crashhunt_link_order_interface())
    except (OSError, AttributeError):  # a damaged file, or a foreign library
        return 0
