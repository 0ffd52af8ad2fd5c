"""Imports highway-env without matplotlib and pandas, which take most of its import time.

Both libraries are imported on first use. An episode does not use matplotlib, and uses pandas only for observations that
the accelerator does not compute.
"""

from __future__ import annotations

import importlib
import os
import sys
from types import ModuleType

_DEFERRED_MODULES = ("matplotlib", "matplotlib.pyplot", "pandas")


class _DeferredModule(ModuleType):
    """Placeholder for a module in highway-env's modules; imports the module on the first access to an attribute."""

    def __getattr__(self, name: str) -> object:
        _remove_placeholders()  # otherwise the import would return this placeholder
        return getattr(importlib.import_module(self.__name__), name)


def _remove_placeholders() -> None:
    """Remove the placeholders from ``sys.modules``, so that other importers get the real modules."""
    for name in _DEFERRED_MODULES:
        if isinstance(sys.modules.get(name), _DeferredModule):
            del sys.modules[name]


def _imported() -> ModuleType:
    absent = [name for name in _DEFERRED_MODULES if name.partition(".")[0] not in sys.modules]
    for name in absent:
        sys.modules[name] = later = _DeferredModule(name)
        package, _, module = name.rpartition(".")
        if package:  # `import matplotlib.pyplot as plt` reads the attribute of the package
            setattr(sys.modules[package], module, later)
    try:
        return importlib.import_module("highway_env")
    finally:
        _remove_placeholders()


os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # pygame renders image observations without a window
os.environ.setdefault("SDL_AUDIODRIVER", "dummy")
highway_env = sys.modules.get("highway_env") or _imported()
