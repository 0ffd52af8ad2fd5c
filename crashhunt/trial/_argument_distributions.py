"""Argument spaces: the values of an argument, their notation, and how a value is drawn.

A specification is a short text, such as ``5:40`` in ``--arg speed=5:40``::

    ``20``             always this value
    ``5:40``           uniform between both ends (whole numbers for an integer argument)
    ``5:40:5``         only 5, 10, 15 … 40
    ``log:1e-3:1``     uniform in the logarithm
    ``a|b|c``          one of these
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from crashhunt.base.errors import ArgumentError

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np


_MOST_STEPS = 2**63 - 1  # NumPy's integers have 64 bits
Value = bool | int | float | str
Kind = Literal["float", "int", "bool", "str", "float|str"]
"""The type of an argument. Of ``float|str``, every text that is a number is a float, and all other texts are texts."""


@dataclass(frozen=True, slots=True)
class Constant:
    """A distribution with only one value."""

    value: Value

    def sample(self, rng: np.random.Generator) -> Value:
        """Return the value of the constant."""
        return self.value

    def grid(self, points: int) -> tuple[Value, ...]:
        """Return the only value of the constant."""
        return (self.value,)

    def quantile(self, share: float) -> Value:
        """Return the value of the constant."""
        return self.value

    def share_of(self, value: Value) -> float:
        """Return 0.5, because every share gives the same value."""
        return 0.5

    def contains(self, value: Value) -> bool:
        """Return whether ``value`` equals the constant."""
        return bool(value == self.value)

    def __str__(self) -> str:
        return _format(self.value)


@dataclass(frozen=True, slots=True)
class Choice:
    """A choice between several values, all equally likely."""

    options: tuple[Value, ...]

    def sample(self, rng: np.random.Generator) -> Value:
        """Draw one of the options."""
        return self.options[int(rng.integers(len(self.options)))]

    def grid(self, points: int) -> tuple[Value, ...]:
        """Return all options of the choice."""
        return self.options

    def quantile(self, share: float) -> Value:
        """Return the option at a share, from 0 to 1, of the options in their order."""
        return self.options[min(int(share * len(self.options)), len(self.options) - 1)]

    def share_of(self, value: Value) -> float:
        """Return the middle of the range of shares for which `quantile` returns the given option.

        Raises:
            ValueError: the value is not an option.
        """
        return (self.options.index(value) + 0.5) / len(self.options)

    def contains(self, value: Value) -> bool:
        """Return whether ``value`` is one of the options."""
        return value in self.options

    def __str__(self) -> str:
        return "|".join(_format(option) for option in self.options)


@dataclass(frozen=True, slots=True)
class Range:
    """A number between ``low`` and ``high``, including both.

    Args:
        low: the lower end.
        high: the upper end.
        step: distance between the values ``low``, ``low + step``, …; None for a continuous range.
        log: whether the logarithm is uniformly distributed; this needs ``low > 0``.
        integer: whether only whole numbers are drawn.
    """

    low: float
    high: float
    step: float | None = None
    log: bool = False
    integer: bool = False

    def __post_init__(self) -> None:
        _check_range(str(self), self.low, self.high, self.step, log=self.log, integer=self.integer)

    @property
    def steps(self) -> int:
        """The number of values of a range with a step or with whole numbers."""
        return math.floor(self._steps) + 1

    @property
    def _steps(self) -> float:
        return _steps_between(self.low, self.high, self.step)

    def _at(self, index: int) -> Value:
        value = min(self.low + index * (self.step if self.step is not None else 1.0), self.high)
        return round(value) if self.integer else float(value)

    @property
    def _logarithms(self) -> tuple[float, float]:
        """Return the logarithms of both ends; for whole numbers, the range extends by half a number at each end."""
        room = 0.5 if self.integer else 0.0
        return math.log(self.low - room), math.log(self.high + room)

    def sample(self, rng: np.random.Generator) -> Value:
        """Draw a value from the range."""
        if self.log:
            return self._exp(rng.uniform(*self._logarithms))
        if self.step is not None or self.integer:
            return self._at(int(rng.integers(self.steps)))
        high = self.high + 0.0  # of -0.0 NumPy says that it is below 0.0
        return min(float(rng.uniform(self.low, high)), float(self.high))

    def _exp(self, logarithm: float) -> Value:
        value = min(max(math.exp(logarithm), self.low), self.high)
        return round(value) if self.integer else value

    def quantile(self, share: float) -> Value:
        """Return the value below which the given share of all draws lies, from 0 to 1."""
        if self.log:
            low, high = self._logarithms
            return self._exp(low + (high - low) * share)
        if self.step is not None or self.integer:
            return self._at(min(int(share * self.steps), self.steps - 1))
        return min(float(self.low + (self.high - self.low) * share), float(self.high))

    def share_of(self, value: Value) -> float:
        """Return a share for which `quantile` returns the value; for a stepped range, the middle of these shares.

        Raises:
            ValueError: the value is not a number.
        """
        value = float(value)
        if self.low == self.high:
            return 0.5
        if self.log:
            low, high = self._logarithms
            return min(max((math.log(value) - low) / (high - low), 0.0), 1.0)
        if self.step is not None or self.integer:
            index = round((value - self.low) / (self.step if self.step is not None else 1.0))
            return min(max((index + 0.5) / self.steps, 0.0), 1.0)
        return min(max((value - self.low) / (self.high - self.low), 0.0), 1.0)

    def grid(self, points: int) -> tuple[Value, ...]:
        """Return all values of a stepped range, or at most ``points`` evenly spaced values that include both ends."""
        if self.step is not None or (self.integer and not self.log and self.steps <= points):
            return tuple(self._at(index) for index in range(self.steps))
        if points == 1 or self.low == self.high:
            return (round(self.low) if self.integer else float(self.low),)
        ends = (math.log(self.low), math.log(self.high)) if self.log else (self.low, self.high)
        inner = (ends[0] + (ends[1] - ends[0]) * index / (points - 1) for index in range(1, points - 1))
        values = [self.low, *(math.exp(value) if self.log else value for value in inner), self.high]
        clipped = (min(max(value, self.low), self.high) for value in values)
        return tuple(dict.fromkeys(round(value) if self.integer else float(value) for value in clipped))

    def contains(self, value: Value) -> bool:
        """Return whether ``value`` is a number within the range; steps are not checked."""
        return isinstance(value, int | float) and not isinstance(value, bool) and self.low <= value <= self.high

    def __str__(self) -> str:
        step = "" if self.step is None else f":{_number(self.step)}"
        return f"{'log:' if self.log else ''}{_number(self.low)}:{_number(self.high)}{step}"


def _check_range(text: str, low: float, high: float, step: float | None, *, log: bool, integer: bool) -> None:
    """Refuse an invalid range.

    The message shows ``text``. The other arguments are those of `Range`.

    Raises:
        ArgumentError: the range is invalid.
    """
    if not (_is_finite(low) and _is_finite(high)):
        raise ArgumentError(f"the range {text!r} has an end that is not finite", fix="give two finite numbers")
    if low > high:
        first, second, *rest = text.removeprefix("log:").split(":")
        ordered = ":".join([second, first, *rest])
        raise ArgumentError(
            f"the range {text!r} begins above its end", fix=f"write it as {'log:' if log else ''}{ordered}"
        )
    if not math.isfinite(high - low):
        raise ArgumentError(f"the range {text!r} is wider than a float can represent", fix="give a narrower range")
    if log and low <= 0:
        raise ArgumentError(f"the log range {text!r} must begin above 0", fix="give a positive lower end")
    if step is not None and not (math.isfinite(step) and step > 0):
        raise ArgumentError(f"the range {text!r} has the step {step:g}", fix="give a step above 0")
    steps = _steps_between(low, high, step)
    if not log and (integer or step is not None) and not steps < _MOST_STEPS:
        raise ArgumentError(
            f"the range {text!r} has {steps:.3g} values, more than can be drawn from",
            fix="give a narrower range, or a greater step",
        )


def _steps_between(low: float, high: float, step: float | None) -> float:
    """Return the number of steps from one end of a range to the other, with room for rounding errors."""
    return (high - low) / (step if step is not None else 1.0) * (1 + 1e-12) + 1e-9


Distribution = Constant | Choice | Range


@dataclass(frozen=True, slots=True)
class Argument:
    """An argument of an agent or a scenario, with its type, default, distribution and unit.

    Args:
        name: name of the argument, as in ``--arg NAME=SPEC``.
        kind: type of the values; None if it is unknown.
        default: The default value; None if there is none.
        distribution: The distribution from which a hunt draws by default; None if the argument keeps its default.
        unit: The unit, such as ``m/s``.
        help: A description in one line.
    """

    name: str
    kind: Kind | None = None
    default: Value | None = None
    distribution: Distribution | None = None
    unit: str = ""
    help: str = ""


def without_folder(value: object) -> str:
    """Return a value as text, with the folder of an absolute path replaced by ``…``."""
    text = str(value)
    return f"…/{Path(text).name}" if Path(text).is_absolute() else text


def kind_of(value: Value) -> Kind:
    """Return the type of a value."""
    if isinstance(value, bool):
        return "bool"
    if isinstance(value, int):
        return "int"
    return "float" if isinstance(value, float) else "str"


def parse_spec(text: str, kind: Kind | None = None, *, where: str = "") -> Distribution:
    """Parse the specification of an argument's values, whose notation is described in the docstring of the module.

    >>> parse_spec("log:1:100")
    Range(low=1, high=100, step=None, log=True, integer=True)

    Args:
        text: the specification.
        kind: the type of the argument; None to derive it from the text. Of ``float|str``, numbers are floats.
        where: option or key that an error message names, such as ``--arg speed``.

    Raises:
        ArgumentError: the text is not a specification.
    """
    try:
        return _parse(text, kind)
    except ArgumentError as error:
        raise ArgumentError(error.message, fix=error.fix, where=error.where or where) from None


def _parse(text: str, kind: Kind | None) -> Distribution:
    if "|" in text:
        options = tuple(_scalar(part, kind) for part in text.split("|"))
        if len({(type(option), option) for option in options}) != len(options):
            raise ArgumentError(f"the choice {text!r} names a value twice", fix="name every value once")
        return Choice(options)
    if kind not in ("str", "bool"):
        log, body = text.startswith("log:"), text.removeprefix("log:")
        parts = body.split(":")
        if len(parts) in (2, 3) and (kind not in (None, "float|str") or all(_is_number(part) for part in parts)):
            return _range(parts, kind, log=log, text=text)
        if log:
            raise ArgumentError(f"{text!r} is not a log range", fix="write it as log:LOW:HIGH, such as log:1e-3:1")
    return Constant(_scalar(text, kind))


def _range(parts: list[str], kind: Kind | None, *, log: bool, text: str) -> Range:
    numbers = [_scalar(part, "int" if _is_integer(part) else "float") for part in parts]
    integer = kind not in ("float", "float|str") and all(isinstance(number, int) for number in numbers)
    if kind == "int" and not integer:
        raise ArgumentError(f"{text!r} has ends that are not whole numbers", fix="this argument takes whole numbers")
    if log and len(parts) == 3:
        raise ArgumentError(f"the log range {text!r} has a step", fix="write it as log:LOW:HIGH")
    low, high, *steps = (float(number) if not integer else int(number) for number in numbers)
    step = steps[0] if steps else None
    _check_range(text, low, high, step, log=log, integer=integer)  # the message shows what the user wrote
    return Range(low, high, step=step, log=log, integer=integer)


def _scalar(text: str, kind: Kind | None) -> Value:
    if kind == "str":
        return text
    if kind == "bool" or (kind is None and text in ("true", "false")):
        if text.lower() not in ("true", "false"):
            raise ArgumentError(f"{text!r} is not true or false", fix="write true, false or true|false")
        return text.lower() == "true"
    if kind == "int" or (kind is None and _is_integer(text)):
        try:
            return int(text)
        except ValueError:
            raise ArgumentError(f"{text!r} is not a whole number", fix="write it as 20, 5:40 or 1|2|3") from None
    if kind == "float" or _is_number(text):
        try:
            number = float(text)
        except ValueError:
            raise ArgumentError(f"{text!r} is not a number", fix="write it as 20, 5:40, log:1e-3:1 or 1|2|3") from None
        if not math.isfinite(number):
            raise ArgumentError(f"{text!r} is not a finite number", fix="give a finite number")
        return number
    return text


def _is_integer(text: str) -> bool:
    try:
        int(text)
    except ValueError:
        return False
    return True


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _is_finite(number: float) -> bool:
    try:
        return math.isfinite(number)
    except OverflowError:  # a whole number that is too large for a float
        return False


def _number(value: float) -> str:
    return repr(value)


def _format(value: Value) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return value if isinstance(value, str) else _number(value)


def describe(space: Mapping[str, Distribution]) -> str:
    """Return ``name=spec`` pairs as one line of text for users."""
    return " ".join(f"{name}={distribution}" for name, distribution in sorted(space.items())) or "(nothing)"
