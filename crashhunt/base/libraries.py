"""Locators of agents that are shared libraries: ``lib:FILE.so``, and what such a file contains and needs."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

from crashhunt.base import library_probe
from crashhunt.base.errors import PluginError
from crashhunt.base.signals import describe_death
from crashhunt.base.text import one_line

if TYPE_CHECKING:
    from collections.abc import Mapping

PREFIX: Final = "lib:"
_LIBRARY_FIX = "give the path of a shared library, such as lib:./libplanner.so"
_INTERFACE_FIX = "include crashhunt_agent.h, which crashhunt agent-header prints, and export all four functions"
_PROBE_S: Final = 60.0  # as long as a module may take to import
_MAGIC: Final = b"\x7fELF"
_MACHINES: Final = {3: "x86", 40: "ARM", 62: "x86-64", 183: "AArch64", 243: "RISC-V"}  # e_machine of ELF
_SYSTEM_FOLDERS = ("/lib", "/lib32", "/lib64", "/usr/lib", "/usr/lib32", "/usr/lib64")


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
        _check_machine(path)
    except OSError as error:
        raise PluginError(f"{locator!r}: it cannot be read: {error.strerror}", fix=_LIBRARY_FIX) from None
    except ValueError as error:
        raise PluginError(f"{locator!r}: {error}", fix="build the library on this machine, with -shared") from None
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


def _check_machine(path: Path) -> None:
    """Refuse a file that is no ELF file for the machine of this process.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is for another machine, or is no library.
    """
    own, found = (_header_of(file) for file in (Path("/proc/self/exe"), path))
    if found[:4] != _MAGIC or len(found) < 20:
        raise ValueError("it is not a shared library (an ELF file)")
    if own[:4] == _MAGIC and _machine_in(own) != _machine_in(found):
        raise ValueError(f"it is built for {_machine_in(found)} (allowed: {_machine_in(own)})")


def _header_of(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(20)


def _machine_in(header: bytes) -> str:
    order = "little" if header[5] == 1 else "big"
    number = int.from_bytes(header[18:20], order)  # type: ignore[arg-type]
    return f"{_MACHINES.get(number, f'machine {number}')}, {32 * header[4]} bits"


@cache
def _probed(path: Path, *_version: int) -> Library:
    """Return the contents of a library.

    Args:
        path: path of the library.
        _version: numbers that change with the file.

    Raises:
        PluginError: the library cannot be used.
    """
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


def is_of_system(library: Path) -> bool:
    """Return whether a library belongs to the operating system or to the environment of Python."""
    homes = (*_SYSTEM_FOLDERS, f"{sys.prefix}/lib", f"{sys.base_prefix}/lib")
    return not library.is_absolute() or any(library.resolve().is_relative_to(home) for home in homes)
