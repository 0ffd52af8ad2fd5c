"""Imports highway-env without matplotlib and pandas, which take most of that time; whoever uses them has them then.

Of matplotlib it needs nothing in an episode, of pandas what the accelerator does not do in its place.
"""

from __future__ import annotations

import importlib
import os
import sys
from types import ModuleType

__all__ = ["highway_env"]

_LATER = ("matplotlib", "matplotlib.pyplot", "pandas")


class _Later(ModuleType):
    """Stands in highway-env's modules for one that is imported when something of it is first asked for."""

    def __getattr__(self, name: str) -> object:
        _take_back()  # else it would find itself
        return getattr(importlib.import_module(self.__name__), name)


def _take_back() -> None:
    """Have everybody else import the real ones."""
    for name in _LATER:
        if isinstance(sys.modules.get(name), _Later):
            del sys.modules[name]


def _imported() -> ModuleType:
    absent = [name for name in _LATER if name.partition(".")[0] not in sys.modules]
    for name in absent:
        sys.modules[name] = later = _Later(name)
        package, _, module = name.rpartition(".")
        if package:  # as `import matplotlib.pyplot as plt` asks for it
            setattr(sys.modules[package], module, later)
    try:
        return importlib.import_module("highway_env")
    finally:
        _take_back()


os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # an observation may be a picture; nobody wants a window
os.environ.setdefault("SDL_AUDIODRIVER", "dummy")
highway_env = sys.modules.get("highway_env") or _imported()
