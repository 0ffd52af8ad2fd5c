"""``crashhunt.accelerate()``, which accelerates highway-env in the user's process, such as a training of a policy."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

from crashhunt.highway.accelerator._known_versions import reason_against_version

if TYPE_CHECKING:
    from types import ModuleType, TracebackType


class Acceleration:
    """The current state of the acceleration: true if highway-env is accelerated.

    As a context manager, it switches the accelerator off at the end of the block, unless it was on before.
    """

    def __init__(self, reason: str, switch: ModuleType | None = None, *, before: bool = False) -> None:
        self._reason = reason
        self._switch = switch  # None if the version of highway-env lacks what this module imports
        self._before = before

    @property
    def reason(self) -> str:
        """Why highway-env is not accelerated, such as a missing kernel; empty if it is accelerated."""
        if self._reason or self._switch is None:
            return self._reason
        return str(self._switch.why_not()) if self._switch.is_on() else "it has been undone"

    @property
    def left_alone(self) -> dict[str, tuple[str, ...]]:
        """Classes of vehicles that are not or only partly accelerated, each with the members that it overrides."""
        return {} if self._switch is None else {name: tuple(own) for name, own in self._switch.left_alone.items()}

    def undo(self) -> None:
        """Switch the accelerator off."""
        if self._switch is not None:
            self._switch.switch_off()

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
    """Accelerate highway-env in this process: bit-identical results in a fraction of the time.

    Hunts call this function automatically. Call it in your own process, for example for training. In every
    step, the accelerator checks for cases that it does not know. highway-env's own code runs in these cases:

    - another version of highway-env
    - an installation of crashhunt without the compiled kernel, which needs a C++ compiler
    - your classes that override an accelerated method
    - functions and methods that other code has replaced, on a class, a module or an object

    Returns:
        The state of the acceleration. The truth value of this object is whether highway-env is accelerated. ``reason``
        is the reason if not. ``left_alone`` lists classes that are not accelerated. ``undo()``, or the end of a
        ``with`` block, switches the accelerator off.

    Example:
        >>> import crashhunt
        >>> with crashhunt.accelerate() as faster:
        ...     print(faster)
        <highway-env is accelerated>
    """
    import highway_env  # a checkout has a version, too, and no metadata or those of another installation

    if reason := reason_against_version(highway_env.__version__):
        return Acceleration(reason)
    from crashhunt.highway.accelerator import _switch

    before = _switch.is_on()
    return Acceleration(_switch.switch_on(), _switch, before=before)
