"""``crashhunt.accelerate()``: highway-env faster in a process of your own, such as one that trains a policy."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from types import TracebackType

__all__ = ["Acceleration", "accelerate"]


class Acceleration:
    """What `accelerate` has done, as it stands at the moment: true where highway-env is faster.

    As a context manager it is undone at the end of the block, unless it was in place before.
    """

    def __init__(self, reason: str, *, before: bool) -> None:
        self._reason = reason
        self._before = before

    @property
    def reason(self) -> str:
        """Why highway-env is as slow as ever, such as that a module of yours has replaced one of its functions."""
        from crashhunt.simulators.accelerator import _switch

        if self._reason:
            return self._reason
        return _switch.why_not() if _switch.is_on() else "it has been undone"

    @property
    def left_alone(self) -> dict[str, tuple[str, ...]]:
        """The classes of vehicles met so far that are not sped up, or in part only, with what is their own."""
        from crashhunt.simulators.accelerator import _switch

        return {name: tuple(own) for name, own in _switch.left_alone.items()}

    def undo(self) -> None:
        """Have highway-env as it was."""
        from crashhunt.simulators.accelerator import _switch

        _switch.switch_off()

    def __bool__(self) -> bool:
        return not self.reason

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._before:
            self.undo()

    def __repr__(self) -> str:
        if self.reason:
            return f"<highway-env is not accelerated: {self.reason}>"
        own = "; ".join(f"{name} has its own {', '.join(names)}" for name, names in self.left_alone.items())
        return f"<highway-env is accelerated{f', but {own}' if own else ''}>"


def accelerate() -> Acceleration:
    """Speed highway-env up in this process: the same results to the bit, in a fraction of the time.

    What it does not know is left to highway-env's own code, and looked at again in every step: another version of it,
    classes of yours that override what is sped up, functions and methods that somebody replaces, on a class, a module
    or one object. A hunt does this by itself.

    Returns:
        What came of it: its truth value says whether, ``reason`` why not, ``left_alone`` which classes are not sped
        up, and ``undo()``, or the end of a ``with`` block, has highway-env as it was.

    Example:
        >>> import crashhunt
        >>> with crashhunt.accelerate() as faster:
        ...     print(faster)
        <highway-env is accelerated>
    """
    from crashhunt.simulators.accelerator import _switch

    before = _switch.is_on()
    return Acceleration(_switch.switch_on(), before=before)
