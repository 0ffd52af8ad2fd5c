"""What an object can do beyond its protocol: faculties, each a protocol of its own."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

    from typing_extensions import TypeIs

__all__ = ["members", "offers"]

T = TypeVar("T")


def offers(thing: object, faculty: Callable[..., T]) -> TypeIs[T]:
    """Whether an object has everything that a protocol names; what is None counts as not there.

    Unlike `isinstance` with a runtime-checkable protocol, this finds what an object gets through ``__getattr__``, in
    every version of Python: somebody's wrapper around an agent or simulator has the faculties of what it wraps.

    Args:
        thing: the object.
        faculty: the protocol. It is typed as what returns one, since type checkers refuse protocols as ``type[T]``.
    """
    return all(getattr(thing, name, None) is not None for name in members(faculty))


@cache
def members(faculty: Any) -> tuple[str, ...]:
    """Return the names of the attributes and methods that a protocol asks for."""
    found: dict[str, None] = {}
    for base in faculty.__mro__:
        if base not in (Protocol, Generic, object):
            found |= dict.fromkeys(name for name in (*vars(base), *_annotated(base)) if not name.startswith("_"))
    return tuple(found)


def _annotated(base: type) -> tuple[str, ...]:
    return tuple(vars(base).get("__annotations__", {}))
