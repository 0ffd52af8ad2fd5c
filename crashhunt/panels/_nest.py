"""Names of panels: nested scopes, and the places in a nest."""

from __future__ import annotations

from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from crashhunt.panels._panels import Panel

__all__ = ["current_scope", "labelled", "scope"]

_scopes: ContextVar[tuple[str, ...]] = ContextVar("crashhunt_render_scopes", default=())


@contextmanager
def scope(name: str) -> Iterator[None]:
    """Name the panels that are made inside; scopes nest.

    Args:
        name: comes before the names of scopes and panels inside.
    """
    token = _scopes.set((*_scopes.get(), name))
    try:
        yield
    finally:
        _scopes.reset(token)


def current_scope() -> tuple[str, ...]:
    """Return the names of the scopes around, outermost first."""
    return _scopes.get()


def labelled(nest: object) -> list[tuple[str, Panel]]:
    """Return every panel in a nest of mappings and sequences, with its label; whatever is no panel is passed over.

    A label is made of the scopes in which the panel was made, its keys in the nest, and its title. Of two panels with
    the same label, the second gets a number.
    """
    from crashhunt.panels._panels import Panel

    found: list[tuple[str, Panel]] = []
    labels: dict[str, int] = {}

    def visit(value: object, path: tuple[str, ...]) -> None:
        if isinstance(value, Panel):
            label = "/".join(filter(None, (*value.scopes, *path, value.title)))
            labels[label] = labels.get(label, 0) + 1
            found.append((label if labels[label] == 1 else f"{label} {labels[label]}".strip(), value))
        elif isinstance(value, dict):
            for key, item in value.items():
                visit(item, (*path, str(key)))
        elif isinstance(value, list | tuple):
            for item in value:
                visit(item, path)

    visit(nest, ())
    return found
