"""Foreign code: the capabilities of its objects, the boundaries around its calls, and the checks of its values.

Each call of foreign code in an episode is inside a boundary of its own, which belongs to the owner of the called code.
An exception that leaves the call is wrapped, and the wrapper names the owner. An exception without a wrapper is
therefore crashhunt's own.

Python gives every object a truth value: that of ``(False, False)`` and ``"False"`` is true. Therefore, no value of a
user's code is passed to `bool` or `float` unchecked.
"""

from __future__ import annotations

import math
import sys
from decimal import Decimal
from enum import StrEnum
from functools import cache
from numbers import Real
from typing import TYPE_CHECKING, Any, Final, Generic, NoReturn, ParamSpec, Protocol, TypeGuard, TypeVar

from crashhunt.base.errors import SimulatorError, UnusableValueError

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

    from typing_extensions import TypeIs

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")

# Optional capabilities of an object in addition to its protocol; each capability is a protocol of its own.


def supports(thing: object, faculty: Callable[..., T]) -> TypeIs[T]:
    """Return whether an object has every member of a protocol; a member that is None counts as missing.

    Unlike `isinstance` with a runtime-checkable protocol, this function finds members that an object gets through
    ``__getattr__``, in every version of Python. A user's wrapper around an agent or simulator therefore has the
    capabilities of the object inside it.

    Args:
        thing: the object to check.
        faculty: the protocol; its type is a callable, because type checkers refuse protocols as ``type[T]``.
    """
    return all(getattr(thing, name, None) is not None for name in members(faculty))


@cache
def members(faculty: Any) -> tuple[str, ...]:
    """Return the names of the attributes and methods that a protocol requires."""
    found: dict[str, None] = {}
    for base in faculty.__mro__:
        if base not in (Protocol, Generic, object):
            names = *vars(base), *vars(base).get("__annotations__", {})
            found |= dict.fromkeys(name for name in names if not name.startswith("_"))
    return tuple(found)


# Boundaries around calls.


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
    """Surrounds calls of one owner's code for one purpose: ``with boundary: call()``."""

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


# Values that crashhunt compares or uses as truth values: only bools and numbers are accepted.

_ALLOWED: Final = "a bool, a number, an array with one element"
_MAX_CHARACTERS: Final = 200  # of a value in an error message
_MAX_NESTING: Final = 4  # an array with one element may contain another such array


class _Array(Protocol):
    """What the arrays of NumPy, torch, jax and pandas have in common."""

    shape: tuple[int, ...]

    def item(self) -> Any:
        """Return the only element."""


def number_of(value: object, what: str, fix: str) -> float:
    """Return a number of a user's code: a bool, a number, or the only element of an array; NaN is returned as it is.

    Raises:
        UnusableValueError: The value is anything else.
    """
    try:
        return float(value if type(value) in (float, bool, int) else _only_element(value))  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        shape = _shape_of(value)
        size = f" with {math.prod(shape)} elements" if shape is not None and math.prod(shape) != 1 else ""
        kind: str = type.__dict__["__name__"].__get__(type(value))  # a metaclass may define its own ``__name__``
        message = f"{what} is of type {kind}{size}: {describe_value(value)} (allowed: {_ALLOWED})"
        raise UnusableValueError(message, fix=fix) from None


def truth_of(value: object, what: str, fix: str) -> bool:
    """Return whether a bool or number of a user's code is true.

    Raises:
        UnusableValueError: The value is neither a bool nor a number, as for `number_of`, or it is NaN.
    """
    number = number_of(value, what, fix)
    if math.isnan(number):
        raise UnusableValueError(f"{what} is NaN (allowed: {_ALLOWED})", fix=fix)
    return number != 0


def _only_element(value: Any) -> Any:
    """Return the number that a value contains.

    Raises:
        TypeError: The value is no number, and no array with a number as its only element.
    """
    for _ in range(_MAX_NESTING):
        if isinstance(value, Real | Decimal):
            return value
        shape = _shape_of(value)
        if shape is None or math.prod(shape) != 1 or is_masked(value):
            break
        value = value.item()  # of NumPy, torch, jax and pandas
    raise TypeError


def _shape_of(value: object) -> tuple[int, ...] | None:
    """Return the shape of an array of any library; None if the value is no array."""
    if isinstance(value, type) or not supports(value, _Array):
        return None
    return value.shape if isinstance(value.shape, tuple) else None


def is_masked(value: object) -> bool:
    """Return whether the value is an array with a masked element."""
    ma = sys.modules.get("numpy.ma")  # NumPy imports this module on first use, so without it no masked array exists
    return ma is not None and isinstance(value, ma.MaskedArray) and bool(ma.is_masked(value))


def describe_value(value: object) -> str:
    """Return the text of a value for an error message: one line of at most 200 characters."""
    try:
        text = " ".join(repr(value).split())
    except Exception as error:
        text = f"of class {type(value).__name__}, whose repr raises {type(error).__name__},"
    return text if len(text) <= _MAX_CHARACTERS else f"{text[: _MAX_CHARACTERS - 1]}…"
