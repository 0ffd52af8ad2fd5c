"""Progress reports of slow loops."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")
Watch = Callable[[int, int], None]
"""Called with the number of finished items and the total."""


def watched(items: Iterable[T], total: int, watch: Watch | None) -> Iterator[T]:
    """Yield items, and report the number of finished items after each."""
    for done, item in enumerate(items, 1):
        yield item
        if watch is not None:
            watch(done, total)
