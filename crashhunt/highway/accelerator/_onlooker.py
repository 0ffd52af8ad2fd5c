"""A wrapper of a road's `step` that declares whether it changes the road; it fits every version of highway-env."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable


class Onlooker:
    """Replaces the ``step`` of a road object by a function that calls observers before and after each sub-step.

    The kept state of the road stays valid as long as the observers do not change the road.

    Args:
        advance: The original ``step`` of the road.
        before: Function called before each sub-step with the length of the sub-step, in s.
        after: Function called after each sub-step.
        interferes: Function that returns whether the two observers may change the road; called before and after each
            sub-step. By default, the observers never change the road.
        waits: Function that returns whether the observers act only in sub-steps in which a vehicle crashes. If so,
            ``after`` is called only after these sub-steps, and ``before`` is never called. By default, both observers
            are always called.
    """

    def __init__(
        self,
        advance: Callable[[float], None],
        *,
        before: Callable[[float], None] | None = None,
        after: Callable[[], None] | None = None,
        interferes: Callable[[], bool] = bool,
        waits: Callable[[], bool] = bool,
    ) -> None:
        self._advance = advance
        self._before = before
        self._after = after
        self.interferes = interferes
        self.waits = waits

    def look(self) -> None:
        """Call the observer that follows a sub-step."""
        if self._after is not None:
            self._after()

    def __deepcopy__(self, memo: dict[int, object]) -> Onlooker:
        """Return the same object for a copy of the road, as for a function."""
        return self

    def __call__(self, dt: float) -> None:
        """Run a sub-step of the road with its observers."""
        if self._before is not None:
            self._before(dt)
        self._advance(dt)
        self.look()
