"""Somebody who looks on while a road moves on, and says when he does more than that."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["Onlooker"]


class Onlooker:
    """Stands on a road in the place of its ``step``. What has been computed for a road holds while he only looks.

    Meanwhile headings may be Python's floats, which are NumPy's after a step of the environment.

    Args:
        advance: the road's own ``step``.
        before: called before it, with how long the sub-step is (s).
        after: called after it.
        interferes: whether these two may change anything about the road, as it is asked before and after each
            sub-step; never, if that is not said.
    """

    def __init__(
        self,
        advance: Callable[[float], None],
        *,
        before: Callable[[float], None] | None = None,
        after: Callable[[], None] | None = None,
        interferes: Callable[[], bool] = bool,
    ) -> None:
        self._advance = advance
        self._before = before
        self._after = after
        self.interferes = interferes

    def __deepcopy__(self, memo: dict[int, object]) -> Onlooker:
        """Stay the same on a copy of the road, as a function does."""
        return self

    def __call__(self, dt: float) -> None:
        """Move the road on."""
        if self._before is not None:
            self._before(dt)
        self._advance(dt)
        if self._after is not None:
            self._after()
