"""Locators of agents that are not Python: programs (``exec:PROGRAM [WORD…]``), libraries (``lib:FILE.so``), FMUs.

The command line of a program is split as a shell would, without a shell. An FMU may have a table of its variables next
to it, in ``FILE.toml``.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import shlex
import shutil
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

from crashhunt.base import library_probe
from crashhunt.base.binaries import is_of_system, length_by_headers, machine_of, own_libraries
from crashhunt.base.errors import PluginError
from crashhunt.base.signals import describe_death
from crashhunt.base.text import one_line

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

_PROGRAM_PREFIX: Final = "exec:"
_LIBRARY_PREFIX: Final = "lib:"
_FMU_PREFIX: Final = "fmu:"
_FACTORIES: Final = {
    _PROGRAM_PREFIX: "crashhunt.agents:ProgramFactory",
    _LIBRARY_PREFIX: "crashhunt.agents:LibraryFactory",
    _FMU_PREFIX: "crashhunt.agents:FmuFactory",
}
"""The class that creates the agents of each kind of locator."""
_INTERPRETERS = re.compile(r"(python|pypy|perl|ruby|node|java|julia|lua|env|sh|bash|dash|zsh)[\d.]*")
_SYSTEM_FOLDERS = ("/bin", "/sbin", "/usr/bin", "/usr/sbin", "/usr/lib", "/usr/libexec")
_PROGRAM_FIX = "give the path of an executable file, such as exec:./planner"


def is_program(locator: str) -> bool:
    """Return whether the locator of an agent names a program, a library or an FMU, and not Python code."""
    return locator.startswith(tuple(_FACTORIES))


def can_fork(locator: str) -> bool:
    """Return whether an agent lives in the process of the trial, so that a fork of the trial contains the agent."""
    return not locator.startswith(_PROGRAM_PREFIX)


def is_native(locator: str) -> bool:
    """Return whether an agent consists of native code that runs in the process of the trial."""
    return is_program(locator) and can_fork(locator)


def factory_of(locator: str) -> str:
    """Return the place of the class that creates the agents of a program or library, as ``module:class``."""
    return next(place for prefix, place in _FACTORIES.items() if locator.startswith(prefix))


def words_of(locator: str) -> tuple[str, ...]:
    """Return the words of the command line that an agent's locator contains.

    Raises:
        PluginError: the command line is empty, or a quotation has no end.
    """
    try:
        words = tuple(shlex.split(locator.removeprefix(_PROGRAM_PREFIX)))
    except ValueError as error:
        fix = "close the quotation, or write \\ before the character"
        raise PluginError(f"{locator!r} is not a command line: {error}", fix=fix) from None
    if not words or not words[0]:
        raise PluginError(f"{locator!r} names no program", fix=_PROGRAM_FIX)
    return words


def command_of(locator: str, files: Mapping[str, str] | None = None) -> tuple[str, ...]:
    """Return the command to run, in which the files of the current folder have absolute paths.

    A word for which ``files`` has the file of a snapshot becomes the path of the copy.

    Raises:
        PluginError: the program does not exist or cannot be executed.
    """
    first, *rest = words_of(locator)
    copies = files or {}
    return (copies.get(first) or str(_program(first, locator)), *(_absolute(word, copies) for word in rest))


def anchored(locator: str, folder: Path) -> str:
    """Return the locator of a program or library whose relative paths begin in a folder.

    Raises:
        PluginError: the locator is not a command line.
    """
    for prefix in (_LIBRARY_PREFIX, _FMU_PREFIX):
        if locator.startswith(prefix):
            path = locator.removeprefix(prefix)
            return f"{prefix}{folder / path}" if path else locator
    return relative_to(folder, words_of(locator))


def relative_to(folder: Path, words: Sequence[str]) -> str:
    """Return the locator of a command line whose relative paths begin in a folder.

    The program is a path if it contains a slash. Another word is a path if the folder contains this file.
    """
    first, *rest = words
    found = [str(folder / first) if os.sep in first else first]
    for word in rest:
        name = _value_in(word)
        is_there = is_path(name) and os.path.exists(folder / name)  # noqa: PTH110
        found.append(f"{word[: len(word) - len(name)]}{folder / name}" if is_there else word)
    return f"{_PROGRAM_PREFIX}{shlex.join(found)}"


def files_of(locator: str) -> dict[str, Path]:
    """Return the files that must travel with an agent's program or library, by the text that names them.

    Programs of the operating system and interpreters are not among them, because a copy would not find its own files.

    Raises:
        PluginError: the program or library cannot be used.
    """
    if locator.startswith(_LIBRARY_PREFIX):
        return _files_of_library(locator)
    if locator.startswith(_FMU_PREFIX):
        return _files_of_fmu(locator)
    first, *rest = words_of(locator)
    program = _program(first, locator)
    found = {} if _is_of_system(program) else {first: program}
    for word in rest:
        name = _value_in(word)
        if is_path(name) and os.path.isfile(name):  # noqa: PTH113
            found[name] = Path(name).absolute()
    return found


def libraries_of(locator: str) -> tuple[dict[str, Path], list[str]]:
    """Return the libraries that must travel with an agent's program, in addition to `files_of`; see `own_libraries`.

    Raises:
        PluginError: the program does not exist or cannot be executed.
    """
    program = _program(words_of(locator)[0], locator)
    return ({}, []) if _is_of_system(program) else own_libraries(program)


def libraries_folder(locator: str) -> str:
    """Return the name of the folder with the copies of the libraries of an agent's program."""
    return f"libraries-{hashlib.blake2b(words_of(locator)[0].encode(), digest_size=4).hexdigest()}"


def library_path(locator: str, files: Mapping[str, str]) -> str:
    """Return the folder in which a snapshot has the libraries of an agent's program; empty if it has none.

    ``files`` has the file of the snapshot for each text that names an original file.
    """
    name = libraries_folder(locator)
    return next((folder for folder in map(os.path.dirname, files.values()) if os.path.basename(folder) == name), "")  # noqa: PTH119


def neighbouring_modules(file: Path) -> dict[str, Path]:
    """Return the modules and packages next to a program in Python, by their names relative to its folder.

    A program that is not in Python has none.
    """
    if file.suffix != ".py" and b"python" not in _first_line(file):
        return {}
    packages = [entry.parent for entry in sorted(file.parent.glob("*/__init__.py"))]
    found = [
        *sorted(file.parent.glob("*.py")),
        *(path for package in packages for path in sorted(package.rglob("*.py"))),
    ]
    return {path.relative_to(file.parent).as_posix(): path for path in found if path != file}


def _first_line(file: Path) -> bytes:
    try:
        with file.open("rb") as opened:
            line = opened.readline(256)
    except OSError:
        return b""
    return line if line.startswith(b"#!") else b""


def _program(word: str, locator: str) -> Path:
    """Return the executable file that the first word names: a path, or a program that ``PATH`` contains."""
    if os.sep not in word:
        found = shutil.which(word)
        if found is None:
            is_here = os.path.isfile(word)  # noqa: PTH113
            fix = f"write exec:./{word}, because PATH does not contain the current folder" if is_here else _PROGRAM_FIX
            raise PluginError(f"{locator!r}: the program {word!r} is not in PATH", fix=fix)
        return Path(found).absolute()
    path = Path(word).absolute()
    if not path.is_file():
        raise PluginError(f"{locator!r}: the program {word!r} is not a file", fix=_PROGRAM_FIX)
    if not os.access(path, os.X_OK):
        raise PluginError(f"{locator!r}: the program {word!r} is not executable", fix=f"chmod +x {word}")
    return path


def _absolute(word: str, copies: Mapping[str, str]) -> str:
    name = _value_in(word)
    if name in copies:
        return f"{word[: len(word) - len(name)]}{copies[name]}"
    # The program runs in a folder of its own, so a path relative to the current folder would lead nowhere.
    is_there = is_path(name) and os.path.exists(name)  # noqa: PTH110
    return f"{word[: len(word) - len(name)]}{Path(name).absolute()}" if is_there else word


def _value_in(word: str) -> str:
    """Return the value in ``--option=VALUE``; any other word is returned as it is."""
    return word.partition("=")[2] if word.startswith("-") and "=" in word else word


def is_path(word: str) -> bool:
    """Return whether a word may name a file; a plain word such as ``test`` is a value, even if a file has this name."""
    return os.sep in word or "." in word


def _is_of_system(program: Path) -> bool:
    homes = {Path(sys.prefix, "bin"), Path(sys.base_prefix, "bin")}
    return (
        _INTERPRETERS.fullmatch(program.name) is not None
        or program.parent in homes
        or any(program.resolve().is_relative_to(folder) for folder in _SYSTEM_FOLDERS)
    )


# Shared libraries: what such a file contains and needs.

_LIBRARY_FIX = "give the path of a shared library, such as lib:./libplanner.so"
_INTERFACE_FIX = "include crashhunt_agent.h, which crashhunt agent-header prints, and export all four functions"
_PROBE_S: Final = 60.0  # as long as a module may take to import


@dataclass(frozen=True, slots=True)
class Library:
    """The contents of a shared library with the C interface of agents."""

    declaration: str  # the text of its ``CRASHHUNT_AGENT(...)``, which is JSON
    # the libraries that it needs and that do not belong to the operating system. Each one follows those that it needs
    # itself.
    dependencies: tuple[Path, ...]


def library_file(locator: str) -> Path:
    """Return the absolute path of the library that an agent's locator names.

    Raises:
        PluginError: the file does not exist, or is no library for this machine.
    """
    word = locator.removeprefix(_LIBRARY_PREFIX)
    if not word:
        raise PluginError(f"{locator!r} names no library", fix=_LIBRARY_FIX)
    path = Path(word).absolute()
    if not path.is_file():
        raise PluginError(f"{locator!r}: {word!r} is not a file", fix=_LIBRARY_FIX)
    return path


def _files_of_library(locator: str) -> dict[str, Path]:
    """Return the files that must travel with a library, by the text that names them, in the order to load them.

    The text for a library that the agent's library needs is ``lib:`` and its path.

    Raises:
        PluginError: the library cannot be used.
    """
    path = library_file(locator)
    found = {f"{_LIBRARY_PREFIX}{one}": one for one in describe_library(locator, path).dependencies}
    return {**found, locator.removeprefix(_LIBRARY_PREFIX): path}


def describe_library(locator: str, path: Path) -> Library:
    """Return the contents of a library; another process loads it for this.

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
    if status.st_size < (length := length_by_headers(path)):
        what = f"it is cut: it has {status.st_size} bytes, and its headers say {length} or more"
        raise PluginError(f"{locator!r}: {what}", fix="copy or build the library again")
    try:
        return _probed(path, status.st_mtime_ns, status.st_size, status.st_ino)
    except PluginError as error:
        raise PluginError(f"{locator!r}: {error.message}", fix=error.fix) from None


def load_order(locator: str, files: Mapping[str, str]) -> list[Path]:
    """Return the libraries to load for an agent, the agent's own last.

    ``files`` has the file of the snapshot for each text that names an original file.

    Raises:
        PluginError: the library does not exist.
    """
    word = locator.removeprefix(_LIBRARY_PREFIX)
    if word not in files:
        return [library_file(locator)]
    return [Path(copy) for name, copy in files.items() if name.startswith(_LIBRARY_PREFIX)] + [Path(files[word])]


@cache
def _probed(path: Path, *_version: int) -> Library:
    """Return the contents of a library.

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


# FMUs, each with a table of its variables.

_FMU_FIX = "give the path of an FMU, such as fmu:./planner.fmu"


def _files_of_fmu(locator: str) -> dict[str, Path]:
    """Return the FMU and its table of variables, by the text that names them.

    Raises:
        PluginError: the FMU does not exist.
    """
    word = locator.removeprefix(_FMU_PREFIX)
    path = Path(word).absolute()
    if not word or not path.is_file():
        raise PluginError(f"{locator!r}: {word!r} is not a file", fix=_FMU_FIX)
    table = path.with_suffix(".toml")
    return {word: path, **({_table_word(word): table} if table.is_file() else {})}


def fmu_files(locator: str, files: Mapping[str, str]) -> tuple[Path, Path | None]:
    """Return the FMU to run, and its table of variables; None if it has none.

    ``files`` has the file of the snapshot for each text that names an original file.

    Raises:
        PluginError: the FMU does not exist.
    """
    word = locator.removeprefix(_FMU_PREFIX)
    found = files if word in files else {name: str(path) for name, path in _files_of_fmu(locator).items()}
    table = found.get(_table_word(word))
    return Path(found[word]), None if table is None else Path(table)


def _table_word(word: str) -> str:
    return str(Path(word).with_suffix(".toml"))
