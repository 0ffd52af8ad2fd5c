"""Boundaries around calls of foreign code in an episode; each belongs to the owner of the called code.

Each call of foreign code is inside a boundary of its own. An exception that leaves the call is wrapped, and the wrapper
names the owner of the code that raised it. An exception without a wrapper is therefore crashhunt's own.
"""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Any, NoReturn, ParamSpec, TypeGuard, TypeVar

from crashhunt.base.errors import SimulatorError

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

P = ParamSpec("P")
R = TypeVar("R")


class Party(StrEnum):
    """The owners of code that runs in an episode."""

    AGENT = "agent"
    ENVIRONMENT = "environment"
    SIMULATOR = "simulator"
    ORACLE = "oracle"
    CRASHHUNT = "crashhunt"


class ForeignError(SimulatorError):
    """An exception of foreign code; its cause is the original exception.

    Args:
        party: The owner of the code that raised the exception.
        place: The purpose of the call, such as ``step``.
        error: The original exception.
    """

    def __init__(self, party: Party, place: str, error: BaseException) -> None:
        super().__init__(f"the {party} failed ({place})")
        self.party = party
        self.place = place
        self.error = error
        self.is_at_boundary = False
        """Whether a boundary has raised this exception, and not code that knows the class."""


class Boundary:
    """Surrounds calls of one owner's code for one purpose: ``with boundary: call()``.

    Args:
        party: The owner of the called code.
        place: The purpose of the call, such as ``step``.
    """

    __slots__ = ("_party", "_place")

    def __init__(self, party: Party, place: str) -> None:
        self._party = party
        self._place = place

    def __enter__(self) -> None:
        pass

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None:
            self.wrap(error)

    def wrap(self, error: BaseException) -> NoReturn:
        """Raise a `ForeignError` that wraps an exception of a call inside this boundary.

        The exception of a boundary inside this one already names its owner, for example if an agent calls a function of
        the simulator.
        """
        if is_at_boundary(error):
            raise error
        wrapper = ForeignError(self._party, self._place, error)
        wrapper.is_at_boundary = True
        raise wrapper from error

    def around(self, function: Callable[P, R]) -> Callable[P, R]:
        """Return a function whose calls run inside this boundary."""

        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            try:
                return function(*args, **kwargs)
            except BaseException as error:
                self.wrap(error)

        return call


def is_at_boundary(error: BaseException) -> TypeGuard[ForeignError]:
    """Return whether a boundary has raised an exception, which then names the owner of the code that failed."""
    return type(error) is ForeignError and error.is_at_boundary


def is_ours(thing: Any) -> bool:
    """Return whether an object's class, or a function, is defined in crashhunt itself."""
    kind = thing if isinstance(thing, type) else type(thing)
    return str(type.__dict__["__module__"].__get__(kind)).startswith("crashhunt.")
