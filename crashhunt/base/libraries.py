"""Locators of agents that are shared libraries: ``lib:FILE.so``, and what such a file contains and needs."""

from __future__ import annotations

import json
import platform
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

from crashhunt.base import library_probe
from crashhunt.base.binaries import is_of_system, machine_of
from crashhunt.base.errors import PluginError
from crashhunt.base.signals import describe_death
from crashhunt.base.text import one_line

if TYPE_CHECKING:
    from collections.abc import Mapping

PREFIX: Final = "lib:"
_LIBRARY_FIX = "give the path of a shared library, such as lib:./libplanner.so"
_INTERFACE_FIX = "include crashhunt_agent.h, which crashhunt agent-header prints, and export all four functions"
_PROBE_S: Final = 60.0  # as long as a module may take to import


@dataclass(frozen=True, slots=True)
class Library:
    """The contents of a shared library with the C interface of agents.

    Args:
        declaration: the text of its ``CRASHHUNT_AGENT(...)``, which is JSON.
        dependencies: the libraries that it needs and that do not belong to the operating system. Each one follows those
            that it needs itself.
    """

    declaration: str
    dependencies: tuple[Path, ...]


def path_of(locator: str) -> Path:
    """Return the absolute path of the library that an agent's locator names.

    Raises:
        PluginError: the file does not exist, or is no library for this machine.
    """
    word = locator.removeprefix(PREFIX)
    if not word:
        raise PluginError(f"{locator!r} names no library", fix=_LIBRARY_FIX)
    path = Path(word).absolute()
    if not path.is_file():
        raise PluginError(f"{locator!r}: {word!r} is not a file", fix=_LIBRARY_FIX)
    return path


def files_of(locator: str) -> dict[str, Path]:
    """Return the files that must travel with a library, by the text that names them, in the order to load them.

    The text for a library that the agent's library needs is ``lib:`` and its path.

    Raises:
        PluginError: the library cannot be used.
    """
    path = path_of(locator)
    found = {f"{PREFIX}{one}": one for one in describe_library(locator, path).dependencies}
    return {**found, locator.removeprefix(PREFIX): path}


def describe_library(locator: str, path: Path) -> Library:
    """Return the contents of a library; another process loads it for this.

    Args:
        locator: locator of the agent, for errors.
        path: path of the library.

    Raises:
        PluginError: the library cannot be used.
    """
    try:
        status = path.stat()
    except OSError as error:
        raise PluginError(f"{locator!r}: it cannot be read: {error.strerror}", fix=_LIBRARY_FIX) from None
    machine, own = machine_of(path), platform.machine()
    if machine != own:
        what = f"is built for {machine} (allowed: {own})" if machine else "is not a shared library (an ELF file)"
        raise PluginError(f"{locator!r}: it {what}", fix="build the library on this machine, with -shared")
    try:
        return _probed(path, status.st_mtime_ns, status.st_size, status.st_ino)
    except PluginError as error:
        raise PluginError(f"{locator!r}: {error.message}", fix=error.fix) from None


def load_order(locator: str, files: Mapping[str, str]) -> list[Path]:
    """Return the libraries to load for an agent, the agent's own last.

    Args:
        locator: locator of the agent.
        files: file of the snapshot by the text that names the original file; empty if there is no snapshot.

    Raises:
        PluginError: the library does not exist.
    """
    word = locator.removeprefix(PREFIX)
    if word not in files:
        return [path_of(locator)]
    return [Path(copy) for name, copy in files.items() if name.startswith(PREFIX)] + [Path(files[word])]


@cache
def _probed(path: Path, *_version: int) -> Library:
    """Return the contents of a library.

    Args:
        path: path of the library.
        _version: numbers that change with the file.

    Raises:
        PluginError: the library cannot be used.
    """
    import subprocess

    command = [sys.executable, "-P", "-I", "-S", library_probe.__file__, str(path)]
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=_PROBE_S, check=False)
    except subprocess.TimeoutExpired:
        raise PluginError(f"it is still loading after {_PROBE_S:g} s", fix="see what its constructors do") from None
    if not done.stdout:
        lines = done.stderr.decode("utf-8", "replace").strip().splitlines()
        last = f" (its last output: {one_line(lines[-1])[:300]})" if lines else ""
        raise PluginError(
            f"the process that loaded it {describe_death(done.returncode)}{last}", fix="see what its constructors do"
        )
    found = json.loads(done.stdout)
    if "error" in found:
        raise PluginError(
            f"it cannot be loaded: {one_line(found['error'])}", fix="install what is missing, or link with -Wl,-rpath"
        )
    if "missing" in found:
        raise PluginError(f"it does not export {', '.join(found['missing'])}", fix=_INTERFACE_FIX)
    dependencies = tuple(Path(one).absolute() for one in found["libraries"] if not is_of_system(Path(one)))
    return Library(found["declaration"], dependencies)
