"""Names to objects: entry points of installed packages, and ``module:attribute`` everywhere."""

from __future__ import annotations

import importlib
import inspect
import os
import pkgutil
import sys
import types
import typing
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Any, Literal

from crashhunt._blame import place_of
from crashhunt._names import did_you_mean, one_of
from crashhunt.errors import ArgumentError, PluginError
from crashhunt.space import Argument, Kind, kind_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

__all__ = ["Group", "Signature", "import_module", "load_object", "locate", "registered", "signature_of"]

Group = Literal["agents", "executors", "oracles", "samplers", "simulators"]

_KINDS: dict[object, Kind] = {float: "float", int: "int", bool: "bool", str: "str"}


def registered(group: Group) -> dict[str, EntryPoint]:
    """Return the entry points of a group, by name; nothing is imported."""
    return {point.name: point for point in sorted(entry_points(group=f"crashhunt.{group}"), key=lambda p: p.name)}


def locate(group: Group, name: str) -> Any:
    """Return what a registered name or a ``module:attribute`` stands for.

    Modules are looked for in the current directory as well, as with ``python -m``.

    Raises:
        PluginError: there is no such thing, or importing it failed.
    """
    points = registered(group)
    target = points[name].value if name in points else name
    module_name, colon, attribute = target.partition(":")
    if not colon or not module_name or not attribute:
        fix = f"{one_of(name, points, none='(none)')}, or module:attribute"
        raise PluginError(f"{name!r} is not a registered name of {group}", fix=fix)
    return load_object(target, shown=name)


def load_object(target: str, *, shown: str = "") -> Any:
    """Import what a ``module:attribute`` stands for.

    Args:
        target: the module and what in it can be called.
        shown: how errors name it.

    Raises:
        PluginError: there is no such thing, or importing it failed.
    """
    name = shown or target
    module_name, _, attribute = target.partition(":")
    module = import_module(module_name, shown=name)
    found: Any = module
    for part in attribute.split("."):
        if not hasattr(found, part):
            public = [name for name in vars(found) if not name.startswith("_")] if hasattr(found, "__dict__") else []
            raise PluginError(
                f"{name!r}: {module_name} has no attribute {attribute!r}",
                fix=did_you_mean(part, public) or "mend the name",
            )
        found = getattr(found, part)
    if not callable(found):
        raise PluginError(
            f"{name!r} is a {type(found).__name__}, which cannot be called", fix="name a class or function"
        )
    return found


def import_module(name: str, *, shown: str = "") -> types.ModuleType:
    """Import a module, which may lie in the current directory.

    Args:
        name: of the module.
        shown: how errors name what is asked for.

    Raises:
        PluginError: importing it failed.
    """
    if os.getcwd() not in sys.path and "" not in sys.path:  # noqa: PTH109 - sys.path holds strings
        sys.path.insert(0, os.getcwd())  # noqa: PTH109
    try:
        return importlib.import_module(name)
    except (Exception, SystemExit) as error:
        raise _not_imported(name, shown or name, error) from error


def _not_imported(name: str, shown: str, error: BaseException) -> PluginError:
    """Tell a module that is not there from one that is and fails."""
    what = error.msg if isinstance(error, SyntaxError) else str(error)
    said = " ".join(f"{type(error).__name__}: {what}".split())
    missing = error.name or "" if isinstance(error, ModuleNotFoundError) else ""
    if missing and f"{name}.".startswith(f"{missing}."):  # the module itself, or a package that it is said to be in
        hint = did_you_mean(missing.rpartition(".")[2], _modules_beside(missing))
        fix = f"{hint} run from the folder that holds the module, install it, or mend the name".lstrip()
        return PluginError(f"{shown!r} cannot be imported: No module named {missing!r}", fix=fix)
    fix = f"install {missing.partition('.')[0]!r}, or mend the import" if missing else "mend it"
    return PluginError(f"{said}, which keeps {shown!r} from being imported", fix=fix, where=place_of(error))


def _modules_beside(name: str) -> list[str]:
    """The modules of the same package, or of the current directory."""
    package, _, _ = name.rpartition(".")
    places = getattr(sys.modules.get(package), "__path__", None) if package else [os.getcwd()]  # noqa: PTH109
    return [module.name for module in pkgutil.iter_modules(places)] if places else []


@dataclass(frozen=True, slots=True)
class Signature:
    """What a factory takes.

    Args:
        arguments: by name, in order.
        open: whether it takes any other keyword as well (``**kwargs``).
        given: which of ``observation_space``, ``action_space`` and ``step_length_s`` it asks for.
    """

    arguments: dict[str, Argument]
    open: bool
    given: tuple[str, ...]

    def check(self, names: Iterable[str], *, where: str) -> None:
        """Refuse arguments that it does not take.

        Raises:
            ArgumentError: with the accepted ones.
        """
        for name in names:
            if name not in self.arguments and not self.open:
                fix = one_of(name, self.arguments, give="it takes", none="no arguments")
                raise ArgumentError(f"{where} takes no argument {name!r}", fix=fix)


def signature_of(factory: Callable[..., Any]) -> Signature:
    """Read the arguments of a factory off its signature.

    A parameter may be annotated ``Annotated[float, Argument(...)]`` to say what a hunt should try. Parameters named
    ``observation_space`` and ``action_space`` are not arguments: they receive the spaces of the vehicle. Nor is
    ``step_length_s``, which receives that of the simulation.
    """
    try:
        parameters = inspect.signature(factory).parameters.values()
    except (TypeError, ValueError):
        return Signature({}, open=True, given=())
    target = factory.__init__ if isinstance(factory, type) else factory  # type: ignore[misc]
    names = getattr(target, "__globals__", {})
    arguments: dict[str, Argument] = {}
    given: list[str] = []
    is_open = False
    for parameter in parameters:
        if parameter.kind is parameter.VAR_KEYWORD:
            is_open = True
        elif parameter.kind in (parameter.VAR_POSITIONAL, parameter.POSITIONAL_ONLY):
            continue
        elif parameter.name in ("observation_space", "action_space", "step_length_s"):
            given.append(parameter.name)
        else:
            arguments[parameter.name] = _argument(parameter, _annotation(parameter, names))
    return Signature(arguments, is_open, tuple(given))


def _annotation(parameter: inspect.Parameter, names: dict[str, Any]) -> Any:
    """The annotation as an object; None where it cannot be had, such as a name imported for type checkers only."""
    if not isinstance(parameter.annotation, str):
        return parameter.annotation
    try:
        return eval(parameter.annotation, names)
    except Exception:
        return None


def _argument(parameter: inspect.Parameter, hint: Any) -> Argument:
    default = parameter.default if isinstance(parameter.default, bool | int | float | str) else None
    declared = None
    if typing.get_origin(hint) is typing.Annotated:
        hint, *extras = typing.get_args(hint)
        declared = next((extra for extra in extras if isinstance(extra, Argument)), None)
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        hint = next((part for part in typing.get_args(hint) if part in _KINDS), None)
    kind = _KINDS.get(hint) or (kind_of(default) if default is not None else None)
    if declared is None:
        return Argument(parameter.name, kind, default)
    return Argument(parameter.name, kind, default, declared.distribution, declared.unit, declared.help)
