"""The best trials so far, at most so many of them, in order."""

from __future__ import annotations

from bisect import insort
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from crashhunt.samplers._told import Told

__all__ = ["Elites"]


class Elites:
    """The trials with the greatest scores; of equal ones, those that were told first.

    Args:
        most: how many are kept.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._kept: list[tuple[float, int, Told]] = []
        self._count = 0

    def __len__(self) -> int:
        return len(self._kept)

    def __iter__(self) -> Iterator[Told]:
        return (told for _, _, told in self._kept)

    def __getitem__(self, place: int) -> Told:
        return self._kept[place][2]

    def add(self, told: Told) -> Told | None:
        """Take one in; return the one that has to leave for it, which is itself where it is not good enough."""
        self._count += 1
        insort(self._kept, (-told.score, self._count, told))
        return self._kept.pop()[2] if len(self._kept) > self._most else None

    def best(self, many: int) -> list[Told]:
        """Return the best of them, at most so many."""
        return [told for _, _, told in self._kept[:many]]
