"""The names that a package offers, imported when they are used for the first time.

The ``__init__`` of a package states each name once, below ``if TYPE_CHECKING``. Type checkers and editors expect the
form ``from ._module import Name as Name``. The last line of the ``__init__`` is ``offer_lazily(__name__)``.

Reason: ``crashhunt --help`` imports no NumPy, and the process of a hunt imports no SUMO. lazy_loader does the same, but
needs a stub for each ``__init__``. It parses the stubs of all packages in 8 ms; this module needs 1 ms.
"""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

_BLOCK = re.compile(r"^if TYPE_CHECKING:\n((?: {4}.*\n|\n)*)", re.MULTILINE)
_IMPORT = re.compile(r"^ {4}from (\S+) import (?:\(([^)]*)\)|(.*))$", re.MULTILINE)


def offer_lazily(package: str) -> None:
    """Have a package import the names below its ``if TYPE_CHECKING`` when they are used for the first time."""
    namespace = vars(sys.modules[package])
    block = _BLOCK.search(Path(namespace["__file__"]).read_text(encoding="utf-8"))
    homes = {
        entry.split(" as ")[0].strip(): module
        for module, several, one in _IMPORT.findall(block[1] if block else "")
        for entry in (several or one).split(",")
        if entry.strip()
    }

    def import_name(name: str) -> object:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        namespace[name] = getattr(importlib.import_module(homes[name], package), name)
        return namespace[name]

    offered = sorted(homes)
    namespace.update(__all__=offered, __getattr__=import_name, __dir__=offered.copy)


def import_at_call(place: str) -> Callable[..., Any]:
    """Return a function that imports another function at each call, and calls it.

    Args:
        place: the module and the name of the other function, such as ``crashhunt.sumo._scenario_check:check_names``.
    """

    def call(*given: object, **named: object) -> Any:
        module, _, name = place.partition(":")
        return getattr(importlib.import_module(module), name)(*given, **named)

    return call
