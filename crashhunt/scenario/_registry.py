"""Which simulators have a descriptor, and where it is."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from typing import TYPE_CHECKING

import crashhunt.scenario.backends
from crashhunt.base.errors import PluginError
from crashhunt.base.names import listed
from crashhunt.base.plugins import load_attribute, registered
from crashhunt.scenario._backend import Backend

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from importlib.metadata import EntryPoint

    from crashhunt.scenario._backend import Configuration

__all__ = ["backend_names", "backend_of", "configurations", "installed_backends", "titles"]


@cache
def _own() -> tuple[str, ...]:
    # Those that come with crashhunt are found beside it and not by entry point: a bundle brings a crashhunt of its own
    # along, and what is installed around it may be of a version in which they are elsewhere.
    return tuple(sorted(module.name for module in pkgutil.iter_modules(crashhunt.scenario.backends.__path__)))


def _others() -> Mapping[str, EntryPoint]:
    return registered("backends")


def backend_names() -> tuple[str, ...]:
    """Return the simulators that have a descriptor, those that come with crashhunt first; nothing is imported."""
    return tuple(dict.fromkeys((*_own(), *_others())))


@cache
def backend_of(name: str) -> Backend | None:
    """Return the descriptor of a simulator; None where it has none.

    Args:
        name: under which the simulator is registered; a ``module:attribute`` has none.

    Raises:
        PluginError: there is one, and it cannot be imported, or is something else.
    """
    if name in _own():
        own: Backend = importlib.import_module(f"crashhunt.scenario.backends.{name}").BACKEND
        return own
    point = _others().get(name)
    if point is None:
        return None
    found = load_attribute(point.value, shown=name)
    if not isinstance(found, Backend):
        message = f"the backend {name!r} is a {type(found).__name__}"
        raise PluginError(message, fix="make it a crashhunt.scenario.Backend", where=point.value)
    return found


def installed_backends() -> Iterator[tuple[str, Backend]]:
    """Yield all descriptors that can be had, by name; one that is broken and that nobody has asked for is left out."""
    for name in backend_names():
        try:
            found = backend_of(name)
        except PluginError:
            continue
        if found is not None:
            yield name, found


def configurations() -> Iterator[Configuration]:
    """Yield the files of simulators' own that are run as they are."""
    for _, backend in installed_backends():
        yield from backend.configurations


def titles(chosen: Callable[[Backend], bool]) -> str:
    """Return in words what simulators something is for."""
    return listed(
        (backend.title or name for name, backend in installed_backends() if chosen(backend)), none="another simulator"
    )
