"""Binary programs and shared libraries (ELF files): their architecture, build id, and the libraries that they load."""

from __future__ import annotations

import os
import re
import shutil
import struct
import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final, NotRequired, TypedDict

if TYPE_CHECKING:
    from collections.abc import Mapping

_MACHINES: Final = {3: "i686", 40: "arm", 62: "x86_64", 183: "aarch64", 243: "riscv64"}
_SYSTEM_FOLDERS = ("/lib", "/lib32", "/lib64", "/usr/lib", "/usr/lib32", "/usr/lib64")
_NOTES_TYPE, _BUILD_ID_TYPE = 4, 3  # of a segment, and of a note
_MAX_NOTES_BYTES: Final = 1 << 16
_LDD_TIMEOUT_S: Final = 10.0
_PACKAGES_TIMEOUT_S: Final = 10.0
_LOADED = re.compile(r"^\s*(\S+) => (/.+) \(0x[\da-f]+\)$", re.MULTILINE)
_MISSING = re.compile(r"^\s*(\S+) => not found$", re.MULTILINE)


class BinaryFacts(TypedDict):
    """What identifies a binary file.

    ``machine`` is the processor architecture, as `platform.machine` names it. ``build_id`` is empty if the linker wrote
    none. ``system`` lists the libraries of the operating system that the binary loads, and ``missing`` those that are
    not found. ``packages`` has the package of the distribution and its version for each library, if a package manager
    knows it. ``revision`` is the version of the sources, if a program reports it.
    """

    machine: str
    build_id: str
    system: list[str]
    missing: list[str]
    packages: NotRequired[dict[str, str]]
    revision: NotRequired[str]


def describe_binary(file: Path) -> BinaryFacts | None:
    """Return what identifies a binary file; None if it is not an ELF file."""
    head = _head_of(file)
    if head is None:
        return None
    loaded, missing = _loaded_by(file, {})
    system = {name: path for name, path in sorted(loaded.items()) if is_of_system(Path(path))}
    found: BinaryFacts = {"machine": head[0], "build_id": head[1], "system": [*system], "missing": missing}
    packages = _packages(tuple(system.values()))
    if named := {name: packages[path] for name, path in system.items() if path in packages}:
        found["packages"] = named
    return found


@cache
def _packages(libraries: tuple[str, ...]) -> dict[str, str]:
    """Return the package and version that contains each library, as dpkg or rpm knows it; empty without both."""
    # The database of dpkg may know a file of /usr/lib only by its path in /lib, which is a link to it.
    paths = {name: path for path in libraries for name in _names_of(path)}
    if shutil.which("dpkg-query"):
        owners = [line.rpartition(": ") for line in _lines("dpkg-query", "--search", *paths)]
        names = {paths[path]: owner.partition(",")[0] for owner, _, path in owners if path in paths}
        shown = _lines(
            "dpkg-query", "--show", "--showformat=${binary:Package}\t${Version}\n", *sorted({*names.values()})
        )
        versions = dict(line.split("\t", 1) for line in shown if "\t" in line)
        versions |= {name.partition(":")[0]: version for name, version in versions.items()}
        return {path: f"{name} {versions[name]}" for path, name in names.items() if name in versions}
    if shutil.which("rpm"):
        found = {
            path: _lines("rpm", "--query", "--file", "--queryformat=%{NAME} %{VERSION}-%{RELEASE}\n", path)
            for path in libraries
        }
        return {path: lines[0] for path, lines in found.items() if lines}
    return {}


def _names_of(path: str) -> set[str]:
    real = os.path.realpath(path)
    return {path, real, *(name.removeprefix("/usr") for name in (path, real) if name.startswith("/usr/lib"))}


def _lines(*command: str) -> list[str]:
    """Return the output of a command as lines; empty if it fails or takes too long."""
    import subprocess

    try:
        done = subprocess.run(
            command, capture_output=True, stdin=subprocess.DEVNULL, check=False, timeout=_PACKAGES_TIMEOUT_S,
            env={**os.environ, "LC_ALL": "C"},
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired):
        return []
    return os.fsdecode(done.stdout).splitlines()


def machine_of(file: Path) -> str:
    """Return the processor architecture of a binary file, as `platform.machine` names it; empty for another file."""
    head = _head_of(file)
    return "" if head is None else head[0]


def length_by_headers(file: Path) -> int:
    """Return where the last segment of a binary file of 64 bits ends; 0 for another file. A cut file is shorter."""
    head = _head_of(file)
    return 0 if head is None else head[2]


def is_of_system(library: Path) -> bool:
    """Return whether a library belongs to the operating system or to the environment of Python."""
    homes = (*_SYSTEM_FOLDERS, f"{sys.prefix}/lib", f"{sys.base_prefix}/lib")
    return not library.is_absolute() or any(library.resolve().is_relative_to(home) for home in homes)


def own_libraries(file: Path) -> tuple[dict[str, Path], list[str]]:
    """Return the libraries that a binary file loads and that do not belong to the operating system.

    Returns:
        The path of each library by name, and the names of the libraries for which the binary ignores
        ``LD_LIBRARY_PATH``, so that it would not load a copy. Both are empty if the file is not an ELF file.
    """
    if _head_of(file) is None:
        return {}, []
    loaded, _ = _loaded_by(file, {})
    own = {name: Path(path) for name, path in loaded.items() if not is_of_system(Path(path))}
    if not own:
        return {}, []
    with tempfile.TemporaryDirectory(prefix="crashhunt-libraries-") as folder:
        for name, path in own.items():
            Path(folder, name).symlink_to(path)
        redirected, _ = _loaded_by(file, {"LD_LIBRARY_PATH": folder})
    return own, sorted(name for name in own if not redirected.get(name, "").startswith(f"{folder}/"))


def _loaded_by(file: Path, variables: Mapping[str, str]) -> tuple[dict[str, str], list[str]]:
    """Return the path of each library that the dynamic linker would load, and the names of the missing libraries."""
    import subprocess

    try:
        done = subprocess.run(
            ["ldd", str(file)], capture_output=True, stdin=subprocess.DEVNULL, check=False, timeout=_LDD_TIMEOUT_S,
            env={**os.environ, "LC_ALL": "C", **variables},
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired):
        return {}, []
    text = os.fsdecode(done.stdout)
    return dict(_LOADED.findall(text)), sorted(_MISSING.findall(text))


def _head_of(file: Path) -> tuple[str, str, int] | None:
    """Return the architecture, the build id and the end of the last segment of an ELF file; None for any other file."""
    try:
        with file.open("rb") as opened:
            head = opened.read(64)
            if head[:4] != b"\x7fELF" or len(head) < 64:
                return None
            order = "<" if head[5] == 1 else ">"
            (machine,) = struct.unpack_from(f"{order}H", head, 18)
            name = _MACHINES.get(machine, f"ELF machine {machine}")
            if head[4] != 2:  # 32 bits
                return name, "", 0
            (table,) = struct.unpack_from(f"{order}Q", head, 32)
            size, count = struct.unpack_from(f"{order}2H", head, 54)
            opened.seek(table)
            segments = opened.read(size * count)
            build_id, end = "", 0
            for start in range(0, len(segments) - 55, max(size, 56)):
                kind, _, offset, _, _, length = struct.unpack_from(f"{order}2I4Q", segments, start)
                end = max(end, offset + length)
                if not build_id and kind == _NOTES_TYPE and length <= _MAX_NOTES_BYTES:
                    opened.seek(offset)
                    build_id = _build_id_in(opened.read(length), order)
            return name, build_id, end
    except (OSError, OverflowError, ValueError, struct.error):  # the file is cut, or its offsets are nonsense
        return None


def _build_id_in(notes: bytes, order: str) -> str:
    at = 0
    while at + 12 <= len(notes):
        name_length, length, kind = struct.unpack_from(f"{order}3I", notes, at)
        name_at = at + 12
        content_at = name_at + (name_length + 3 & ~3)
        if kind == _BUILD_ID_TYPE and notes[name_at : name_at + 4] == b"GNU\0":
            return notes[content_at : content_at + length].hex()
        at = content_at + (length + 3 & ~3)
    return ""
