"""Optional capabilities of an object in addition to its protocol; each capability is a protocol of its own."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

    from typing_extensions import TypeIs


T = TypeVar("T")


def supports(thing: object, faculty: Callable[..., T]) -> TypeIs[T]:
    """Return whether an object has every member of a protocol; a member that is None counts as missing.

    Unlike `isinstance` with a runtime-checkable protocol, this function finds members that an object gets through
    ``__getattr__``, in every version of Python. A user's wrapper around an agent or simulator therefore has the
    capabilities of the object inside it.

    Args:
        thing: the object to check.
        faculty: the protocol; its type is a callable, because type checkers refuse protocols as ``type[T]``.
    """
    return all(getattr(thing, name, None) is not None for name in members(faculty))


@cache
def members(faculty: Any) -> tuple[str, ...]:
    """Return the names of the attributes and methods that a protocol requires."""
    found: dict[str, None] = {}
    for base in faculty.__mro__:
        if base not in (Protocol, Generic, object):
            found |= dict.fromkeys(name for name in (*vars(base), *_annotated(base)) if not name.startswith("_"))
    return tuple(found)


def _annotated(base: type) -> tuple[str, ...]:
    return tuple(vars(base).get("__annotations__", {}))
