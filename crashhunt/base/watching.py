"""How far something is that takes its time."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

__all__ = ["Watch", "watched"]

T = TypeVar("T")
Watch = Callable[[int, int], None]
"""Called with how many are done, and how many there are."""


def watched(items: Iterable[T], total: int, watch: Watch | None) -> Iterator[T]:
    """Yield items, and tell after each how many are done.

    Args:
        items: what is worked on.
        total: how many there are.
        watch: whom to tell; None for nobody.
    """
    for done, item in enumerate(items, 1):
        yield item
        if watch is not None:
            watch(done, total)
