"""The declaration of an option of hunts: its name, type, default, help and checks."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeAlias, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from crashhunt.base.errors import UsageError
from crashhunt.base.integrity import MAX_INTEGER

T = TypeVar("T")

Form = Literal["flag", "integer", "number", "text", "list", "table"]
Check = Callable[[Any], str]  # what to give instead; empty where the value is fine

Given: TypeAlias = Mapping[str, Any]
"""Options by name, as the user gives them. The list defines their types, and `HuntOption.checked` checks them."""

_METADATA_KEY = "crashhunt"  # the key of a field's metadata


@dataclass(frozen=True, slots=True, kw_only=True)
class About:
    """The declaration of an option, except its name, type and default: its texts, its group in the help and its check.

    Args:
        meaning: description of the option's value.
        help: help text for the command line, if it differs from `meaning`.
        unset: description of the effect if the option is not given; if empty, the help shows the default value.
        flag: option on the command line; empty if the command line has no such option.
        metavar: placeholder for the value in the help.
        group: group in the help of ``crashhunt run``: what is tested, search, faults and probes, what is kept, how it
            runs, output.
        brief: help text in one line, for the short help of ``crashhunt run``; empty for options that the short help
            only names.
        check: function that returns the fix for an invalid value, and an empty text for a valid value.
        separator: separator of a list that is written as one word on the command line; empty if the option may be
            repeated.
        named: for an option of the form ``NAME=VALUE``, whether the name is required.
        anywhere: whether ``suite run`` and ``rerun`` have the option as well, for all their hunts. Such an option
            belongs to a run of a hunt, and not to the hunt itself.
    """

    meaning: str
    help: str = ""
    unset: str = ""
    flag: str = ""
    metavar: str = ""
    group: Literal["what", "search", "faults", "kept", "run", "output"] = "run"
    brief: str = ""
    check: Check | None = None
    separator: str = ""
    named: bool = True
    anywhere: bool = False


def option(default: T, meaning: str, **about: Any) -> T:
    """Declare an option of hunts as a field of a dataclass. `About` describes the keyword arguments."""
    metadata = {_METADATA_KEY: About(meaning=meaning, **about)}
    if isinstance(default, dict):
        return cast(T, field(default_factory=dict, metadata=metadata))
    return field(default=default, metadata=metadata)


def at_least(least: int, *, zero: str = "") -> Check:
    """Return a check that an integer is at least a bound; ``zero`` is the meaning of 0, if 0 is allowed."""
    fix = f"give at least {least}{f' (0: {zero})' if zero else ''}"
    return lambda value: fix if value < least else f"give at most {MAX_INTEGER}" if value > MAX_INTEGER else ""


def within(least: float, most: float, fix: str) -> Check:
    """Return a check that a number is between two bounds, including both."""
    return lambda value: "" if least <= value <= most else fix  # what is not a number is not within, either


def above_zero(fix: str, *, finite: bool = True) -> Check:
    """Return a check that a number is above 0."""
    return lambda value: "" if value > 0 and not (finite and math.isinf(value)) else fix


@dataclass(frozen=True, slots=True)
class HuntOption:
    """An option of `HuntOptions`, with its texts for Python and the command line."""

    name: str  # name in Python and in files
    form: Form  # how values are written: as a flag, a number, a text, a list or a table
    default: object  # value if the user does not give the option
    about: About  # the rest of the option's declaration

    @property
    def shown(self) -> str:
        """The name of the option in errors."""
        return self.about.flag or self.name

    @property
    def line(self) -> str:
        """The line that describes the option in the docstring of a function."""
        return f"{self.name}: {self.about.meaning}{f'; by default {self.about.unset}' if self.about.unset else ''}."

    @property
    def help(self) -> str:
        """The help text of the option on the command line."""
        said = self.about.unset
        if self.form in ("integer", "number", "text") and self.default not in ("", None):
            said = f"{self.default:g}" if self.form == "number" else str(self.default)
        return self.help_with(said)

    def help_with(self, default: str) -> str:
        """Return the help text of the option with another default."""
        return f"{self.about.help or self.about.meaning}{f'; default: {default}' if default else ''}"

    def checked(self, value: object) -> object:
        """Validate a value of this option; return it in plain Python types, such as a NumPy number as a Python number.

        Raises:
            UsageError: the value is invalid.
        """
        if value is None and self.default is None:
            return None
        kinds, fix = _TYPES_BY_FORM[self.form]
        stranger = isinstance(value, bool) != (self.form == "flag") or (self.form == "list" and isinstance(value, str))
        if stranger or not isinstance(value, kinds):
            raise UsageError(f"{self.shown} is {value!r}", fix=fix)
        plain = _converted(value, self.form)
        fix = self.about.check(plain) if self.about.check is not None else ""
        if fix:
            said = f"{plain:g}" if self.form == "number" else str(plain)
            raise UsageError(f"{self.shown} is {said}", fix=fix)
        return plain


def _converted(value: Any, form: Form) -> object:
    if form == "list":
        return tuple(value)
    if form == "integer":
        return int(value)
    return float(value) if form == "number" and type(value) is not int else value


# What a value of a form may be, and what to give instead.
_TYPES_BY_FORM: Mapping[Form, tuple[tuple[type, ...], str]] = {
    "flag": ((bool,), "give True or False"),
    "integer": ((Integral,), "give a whole number"),
    "number": ((Real,), "give a number"),
    "text": ((str, Path), "give a text"),
    "list": ((Iterable,), "give a list"),
    "table": ((Mapping, NoneType), "give a dictionary"),
}


def declared(kind: type) -> frozenset[str]:
    """Return the names of the options that a dataclass declares itself or inherits."""
    return frozenset(item.name for item in fields(kind) if _METADATA_KEY in item.metadata)


def declared_options(kind: type) -> tuple[HuntOption, ...]:
    """Return the options that a dataclass declares, in the order of its fields."""
    hints = get_type_hints(kind)
    return tuple(
        HuntOption(
            name=item.name, form=_form(hints[item.name]), default=_default(item), about=item.metadata[_METADATA_KEY]
        )
        for item in fields(kind)
        if _METADATA_KEY in item.metadata
    )


def _default(item: Field[object]) -> object:
    return {} if item.default is MISSING else item.default


def _form(hint: object) -> Form:
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    forms = {_FORM_BY_TYPE.get(get_origin(kind) or kind, "text") for kind in kinds if kind is not NoneType}
    return forms.pop() if len(forms) == 1 else "text"


_FORM_BY_TYPE: Mapping[object, Form] = {
    bool: "flag", int: "integer", float: "number", Sequence: "list", tuple: "list", Mapping: "table", dict: "table",
}  # fmt: skip
