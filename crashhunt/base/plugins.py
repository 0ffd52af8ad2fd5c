"""Lookup of an object by name: an entry point of an installed package, or ``module:attribute``."""

from __future__ import annotations

import importlib
import os
import pkgutil
import re
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import metadata
from importlib.machinery import PathFinder
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from crashhunt.base.agent_locators import factory_of, is_program
from crashhunt.base.codec import Serializable
from crashhunt.base.errors import HuntWhileImportingError, PluginError
from crashhunt.base.exceptions import INSTALLED_FOLDERS, in_words, place_of
from crashhunt.base.extras import install_command
from crashhunt.base.text import did_you_mean, one_of

if TYPE_CHECKING:
    import types
    from collections.abc import Iterable, Iterator
    from importlib.machinery import ModuleSpec
    from importlib.metadata import Distribution, EntryPoint

_MAX_LINE_CHARACTERS = 1_000
Group = Literal["agents", "backends", "disturbances", "executors", "oracles", "samplers", "simulators"]


def registered(group: Group) -> dict[str, EntryPoint]:
    """Return the entry points of a group, by name, without imports."""
    return {**_registered_in(tuple((place, _changed_at(place)) for place in sys.path), group)}


@lru_cache(maxsize=64)
def _registered_in(places: tuple[tuple[str, int], ...], group: Group) -> dict[str, EntryPoint]:
    """Return the entry points of a group in folders, of which each was changed last at the given time."""
    found: dict[str, EntryPoint] = {}
    seen: set[str] = set()
    for place, changed_at in places:
        for distribution in _distributions_in(place, changed_at):
            name, points = _entry_points_of(distribution)
            if name not in seen:  # of two versions, the first is the one that is imported
                seen.add(name)
                found |= points.get(group, {})
    return dict(sorted(found.items()))


def distributions() -> Iterator[Distribution]:
    """Yield the installed distributions like `importlib.metadata`, but cached until a distribution changes."""
    # To look through all that is installed takes milliseconds, and a hunt asks some twenty times.
    for place in sys.path:
        yield from _distributions_in(place, _changed_at(place))


@lru_cache(maxsize=64)
def _distributions_in(place: str, changed_at: int) -> list[Distribution]:  # noqa: ARG001 - as of when
    return list(metadata.distributions(path=[place]))


@lru_cache(maxsize=1024)
def _entry_points_of(distribution: Distribution) -> tuple[str, dict[str, dict[str, EntryPoint]]]:
    """Return the name of a distribution, and its entry points by group and name, for crashhunt's groups."""
    found: dict[str, dict[str, EntryPoint]] = {}
    for point in distribution.entry_points:
        package, _, group = point.group.partition(".")
        if package == "crashhunt":
            found.setdefault(group, {})[point.name] = point
    return (re.sub(r"[-_.]+", "-", distribution.name).lower() if found else ""), found


def _changed_at(place: str) -> int:
    """Return the time of the last installation or removal of a package in a folder, in ns."""
    try:  # an empty place is the current folder
        return os.stat(place or ".").st_mtime_ns  # noqa: PTH116 - a Path takes twice as long to make as to ask
    except OSError:
        return 0


def locate(group: Group, name: str) -> Any:
    """Return the object with a registered name or a ``module:attribute``.

    The module of a ``module:attribute`` may lie in the current folder. An agent may also be a program
    (``exec:…``), a library (``lib:…``) or an FMU (``fmu:…``).

    Raises:
        PluginError: the object does not exist, or its import failed.
    """
    if group == "agents" and is_program(name):
        return load_object(factory_of(name), installed=True)(name)
    points = registered(group)
    target = points[name].value if name in points else name
    module_name, colon, attribute = target.partition(":")
    if not colon or not module_name or not attribute:
        more = (
            "module:attribute, exec:PROGRAM, lib:FILE.so, or fmu:FILE.fmu"
            if group == "agents"
            else "or module:attribute"
        )
        fix = f"{one_of(name, points, none='(none)')}, {more}"
        raise PluginError(f"{name!r} is not a registered name of {group}", fix=fix)
    return load_object(target, shown=name, installed=name in points)


def is_foreign(group: Group, name: str) -> bool:
    """Return whether `locate` would run code that is not crashhunt's and has not yet run in this process."""
    points = registered(group)
    target = points[name].value if name in points else name
    return ":" in target and is_foreign_module(target.partition(":")[0])


def is_foreign_module(name: str) -> bool:
    """Return whether importing a module would run code that is not crashhunt's and has not yet run in this process."""
    return name.partition(".")[0] != "crashhunt" and name not in sys.modules


@dataclass(frozen=True, slots=True)
class ImportedModules(Serializable):
    """The modules that a process has imported, whose files a snapshot contains."""

    # file of each top-level module, and its folders if it is a package
    places: Mapping[str, tuple[str | None, Sequence[str]]]
    path: tuple[str, ...] = ()  # the folders from which modules are imported
    named: frozenset[str] = frozenset()  # the top-level modules that were imported explicitly by name
    agents: tuple[str, ...] = ()  # the files of the modules that contain agents
    # the environment variables, which modules may have changed
    variables: Mapping[str, str] = field(default_factory=dict)
    read: tuple[str, ...] = ()  # the files that the modules have read when they were imported, including their own
    # version of the sources of agents that are programs, by locator, as they report it
    revisions: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def here(cls, locators: Iterable[str] = (), modules: Iterable[str] = ()) -> ImportedModules:
        """Import agents and modules in this process, and return all modules that the process has then imported.

        Raises:
            PluginError: an agent or a module cannot be imported.
        """
        driving = list(locators)
        named = {locate("agents", locator).__module__ for locator in driving}
        for name in modules:
            import_module(name)
            named.add(name)
        agents = (getattr(sys.modules.get(locator.partition(":")[0]), "__file__", None) for locator in driving)
        places = {}
        for name, found in list(sys.modules.items()):
            if "." not in name:
                # A package without __init__.py names a folder once for each entry of sys.path that leads there.
                folders = tuple(dict.fromkeys(map(str, getattr(found, "__path__", None) or ())))
                places[name] = getattr(found, "__file__", None), folders
        return cls(
            places=places, path=tuple(sys.path), named=frozenset(name.partition(".")[0] for name in named),
            agents=tuple(file for file in agents if file), variables=dict(os.environ),
        )  # fmt: skip


def load_object(target: str, *, shown: str = "", installed: bool = False) -> Any:
    """Import the class or function that a ``module:attribute`` names, and return it.

    ``shown`` names the value in error messages. With ``installed``, an installed package names the module, so that the
    current folder is not searched.

    Raises:
        PluginError: the object does not exist, or its import failed.
    """
    found = load_attribute(target, shown=shown, installed=installed)
    if not callable(found):
        raise PluginError(
            f"{shown or target!r} is a {type(found).__name__}, which cannot be called", fix="name a class or function"
        )
    return found


def load_attribute(target: str, *, shown: str = "", installed: bool = False) -> Any:
    """Import the object of any kind that a ``module:attribute`` names, and return it.

    The arguments are those of `load_object`.

    Raises:
        PluginError: the object does not exist, or its import failed.
    """
    name = shown or target
    module_name, _, attribute = target.partition(":")
    module = import_module(module_name, shown=name, installed=installed)
    found: object = module
    for part in attribute.split("."):
        try:
            found = getattr(found, part)
        except AttributeError:
            public = [name for name in vars(found) if not name.startswith("_")] if hasattr(found, "__dict__") else []
            message = f"{name!r}: {module_name} has no attribute {attribute!r}"
            fix = _hidden(module_name) or did_you_mean(part, public) or "correct the name"
            raise PluginError(message, fix=fix) from None
        except Exception as error:  # of a lazy module, which imports what is asked of it
            raise _not_imported(module_name, name, error) from error
    return found


def import_module(name: str, *, shown: str = "", installed: bool = False) -> types.ModuleType:
    """Import a module, which may lie in the current folder, and return it.

    The current folder may be a stranger's: no command imports a module from it that the user has not named. Once the
    user has named a module of this folder, the folder comes first, as with ``python -m``, for the modules that the
    named module imports. The arguments are those of `load_object`.

    Raises:
        PluginError: the import of the module failed.
    """
    if name.endswith(".py") or "/" in name:  # which importlib would import, and then search for a module 'py' in it
        given, stem = shown or name, Path(name).stem
        raise PluginError(
            f"{given!r} has a file name where a module name belongs",
            fix=f"give {given.replace(name, stem)!r}, from the folder that holds {stem}.py",
        )
    if not installed:
        add_current_folder().prefer(name)
    outer = _importing.name
    _importing.name = name
    try:
        return importlib.import_module(name)
    except (KeyboardInterrupt, HuntWhileImportingError):
        raise
    except BaseException as error:  # such as SystemExit, and whatever a module derives from BaseException
        raise _not_imported(name, shown or name, error) from error
    finally:
        _importing.name = outer


class _Importing(threading.local):
    name = ""  # of the module that `import_module` imports in this thread


_importing = _Importing()


def refuse_while_importing() -> None:
    """Refuse to start a hunt or a replay while `import_module` imports a module in this thread.

    Raises:
        HuntWhileImportingError: a module is being imported.
    """
    if name := _importing.name:
        raise HuntWhileImportingError(
            f"the module {name!r} runs trials when it is imported",
            fix='put the call below: if __name__ == "__main__":',
        )


_EXTRAS = {"crashhunt.agents.planners": "planners"}  # of our modules for the packages of others
_DESKTOP_LIBRARIES = ("libGL.so.1", "libX11.so.6", "libXext.so.6", "libXrender.so.1", "libatomic.so.1")
"""System libraries that simulators with a window link to, and that servers and containers often lack."""


def add_current_folder(*, always_last: bool | None = None) -> CurrentFolder:
    """From now on, import from the current folder the modules that are found nowhere else.

    Args:
        always_last: whether other places also come first for the modules that the user names; None for no change.
    """
    made = next((finder for finder in sys.meta_path if isinstance(finder, CurrentFolder)), None)
    if made is None:
        sys.meta_path.append(made := CurrentFolder())
    if always_last is not None:
        made.always_last = always_last
    made.folder = os.getcwd()  # noqa: PTH109 - sys.path holds strings
    return made


class CurrentFolder:
    """Finds modules in the current folder that neither Python nor crashhunt's dependencies have, installed or not."""

    def __init__(self) -> None:
        self.always_last = False  # then `prefer` has no effect
        self.folder = ""

    def find_spec(self, name: str, path: Sequence[str] | None = None, _target: object = None) -> ModuleSpec | None:
        """Return where a module is found; None if it is not a module of the folder."""
        is_reserved = path is not None or name in sys.stdlib_module_names or name in _dependencies()
        return None if is_reserved else PathFinder.find_spec(name, [self.folder])

    def prefer(self, name: str) -> None:
        """Make the folder the first place for all modules if it has this one, which is not yet imported.

        A folder without code counts as a module only if no other place has a module of this name.
        """
        top = name.partition(".")[0]
        if self.always_last or top in sys.modules or "" in sys.path or self.folder in sys.path:
            return
        found = PathFinder.find_spec(top, [self.folder])
        if found is not None and (found.origin is not None or PathFinder.find_spec(top) is None):
            sys.path.insert(0, self.folder)


@lru_cache(maxsize=1)
def _dependencies() -> frozenset[str]:
    """Return the names of the modules that crashhunt's dependencies have, also those that are not installed."""
    try:
        needed = metadata.requires("crashhunt") or ()
    except metadata.PackageNotFoundError:
        needed = ()
    names = {re.split(r"[^\w.-]", requirement, maxsplit=1)[0].lower() for requirement in needed}
    known = {"eclipse-sumo": "sumo", "pillow": "PIL", "protobuf": "google", "mcap-protobuf-support": "mcap_protobuf"}
    return frozenset(known.get(name, name.replace("-", "_")) for name in names)


def describe_unused_clone(module: types.ModuleType) -> str:
    """Return that a package of the current folder is not used, because the installed one is; empty if there is none."""
    name, used = module.__name__, Path(module.__file__ or "")
    clone = Path.cwd() / name / "__init__.py"
    if INSTALLED_FOLDERS.isdisjoint(used.parts) or not clone.is_file() or clone.resolve() == used.resolve():
        return ""
    fix = "install your clone with pip install -e, or rename its folder"
    return f"the package ./{name} in the current folder is not used: {name} is imported from {used.parent}. Fix: {fix}"


def _hidden(name: str) -> str:
    """Return the fix if the current folder has a module of the same name as an imported one; empty if it has none."""
    here = os.getcwd()  # noqa: PTH109
    top = name.partition(".")[0]
    found, imported = PathFinder.find_spec(top, [here]), sys.modules.get(top)
    if found is None or found.origin is None or found.origin == getattr(imported, "__file__", None):
        return ""
    place = os.path.relpath(found.origin, here)
    return f"rename {place}, because Python already has a module {top!r}"


def _not_imported(name: str, shown: str, error: BaseException) -> PluginError:
    """Return the error for a failed import: either the module does not exist, or its code raised an exception."""
    said = in_words(error)
    if isinstance(error, SyntaxError):  # whose message repeats the place
        said = " ".join(f"{type(error).__name__}: {error.msg}"[:_MAX_LINE_CHARACTERS].split())
    missing = error.name or "" if isinstance(error, ModuleNotFoundError) else ""
    if missing and f"{name}.".startswith(f"{missing}."):  # the module itself, or a package that it is said to be in
        hint = did_you_mean(missing.rpartition(".")[2], _sibling_modules(missing))
        fix = f"{hint} run from the folder that holds the module, install it, or correct the name".lstrip()
        return PluginError(f"{shown!r} cannot be imported: No module named {missing!r}", fix=fix)
    fix = f"install {missing.partition('.')[0]!r}, or correct the import" if missing else "correct the module"
    if missing and (extra := _EXTRAS.get(name.rpartition(".")[0])):
        fix = install_command(extra)
    if library := re.search(r"(\S+\.so[.\d]*): cannot open shared object file", said):
        on_debian = " (apt install libgl1 libxext6 libxrender1 libatomic1)" if library[1] in _DESKTOP_LIBRARIES else ""
        fix = f"install the system library {library[1]}{on_debian}"
    return PluginError(f"{said}, which keeps {shown!r} from being imported", fix=fix, where=place_of(error))


def _sibling_modules(name: str) -> list[str]:
    """Return the names of the modules in the same package, or in the current directory."""
    package, _, _ = name.rpartition(".")
    places = getattr(sys.modules.get(package), "__path__", None) if package else [os.getcwd()]  # noqa: PTH109
    return [module.name for module in pkgutil.iter_modules(places)] if places else []
