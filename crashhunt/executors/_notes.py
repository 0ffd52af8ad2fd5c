"""What people should be told of how trials were run: each thing once."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

from crashhunt.base import layout

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["Notes"]


class Notes:
    """The notes of an executor, and those that its workers leave in the scratch folder.

    Args:
        scratch: the folder.
    """

    def __init__(self, scratch: Path) -> None:
        self._file = scratch / layout.NOTICES
        self._all: dict[str, None] = {}  # in order
        self._told = 0

    def add(self, note: str) -> None:
        """Have something told, unless it was before."""
        self._all[note] = None

    def fresh(self) -> list[str]:
        """Return what has not been returned before."""
        with suppress(OSError):
            told = self._file.read_text(encoding="utf-8", errors="replace")
            self._all |= dict.fromkeys(told.splitlines())
        fresh = list(self._all)[self._told :]
        self._told += len(fresh)
        return fresh
