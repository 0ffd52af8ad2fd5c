"""The archive that a node needs to run trials: scenario, code and files of a hunt, identified by a digest."""

from __future__ import annotations

import fcntl
import io
import os
import shutil
import stat
import tempfile
import zipfile
import zlib
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import BundleError, UsageError
from crashhunt.base.integrity import digest_of_data, digest_of_file
from crashhunt.base.temporary import TemporaryFolder

if TYPE_CHECKING:
    from collections.abc import Iterator

    from crashhunt.episode import WorkerSettings


LIMIT_MB = 200
"""What travels well: it is in the memory of the hunt's machine once, and in the memory of every node."""
_MEGABYTE = 10**6
_SCENARIO, _CODE, _FILES = "scenario", "code", "files"


@dataclass(frozen=True, slots=True)
class CodeArchive:
    """The files that trials need, and the folders on the hunt's machine that they replace."""

    files: dict[str, Path]  # path of each file, by its place in the archive
    folders: dict[str, str]  # place in the archive of each folder or file of the hunt's machine, for `settings_in`
    home: str = ""  # place in the archive of the current folder; empty if the archive does not contain it

    @classmethod
    def of(cls, settings: WorkerSettings) -> CodeArchive:
        """Return the archive of a hunt.

        Raises:
            UsageError: the files are too large to send.
            ScenarioError: the scenario names a file that does not exist.
        """
        files = {f"{_SCENARIO}/{name}": settings.scenario.folder / name for name in settings.scenario.files()}
        folders = {str(settings.scenario.folder): _SCENARIO}
        for index, folder in enumerate(sorted(settings.code, key=len)):
            outer = next((str(above) for above in Path(folder).parents if str(above) in settings.code), "")
            if outer:  # with which it comes
                folders[folder] = f"{folders[outer]}/{Path(folder).relative_to(outer).as_posix()}"
                continue
            folders[folder] = f"{_CODE}/{index}"
            files |= {f"{_CODE}/{index}/{name}": path for name, path in _modules(Path(folder))}
        for index, file in enumerate(dict.fromkeys(settings.argument_files.values())):
            folders[file] = f"{_FILES}/{index}-{Path(file).name}"
            files[folders[file]] = Path(file)
        sizes = {path: path.stat().st_size for path in files.values()}
        total = sum(sizes.values()) / _MEGABYTE
        if total > LIMIT_MB:
            largest = max(sizes, key=lambda path: sizes[path])
            raise UsageError(
                f"scenario and code have {total:.0f} MB, above the {LIMIT_MB} MB that crashhunt sends to other "
                "machines; "
                f"the largest file is {largest} ({sizes[largest] / _MEGABYTE:.0f} MB)",
                fix="make this file smaller, or list unneeded files in .gitignore",
            )
        return cls(
            files, folders, next((folders[folder] for folder in settings.code if _is_same_snapshot(Path(folder))), "")
        )

    def digest(self) -> str:
        """Return the digest of all contents of the archive.

        Raises:
            OSError: a file cannot be read.
        """
        return digest_of_data({_archive_bytes(place): _described(path) for place, path in self.files.items()})

    def packed(self) -> bytes:
        """Return the archive as compressed bytes.

        Raises:
            OSError: a file cannot be read.
        """
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1, strict_timestamps=False) as archive:
            for place, path in self.files.items():
                archive.write(path, _archive_bytes(place))
        return buffer.getvalue()


def settings_in(settings: WorkerSettings, folders: dict[str, str], root: Path, scratch: Path) -> WorkerSettings:
    """Return the settings of a hunt, with the paths of an unpacked archive."""
    here = {there: str(root / place) for there, place in folders.items()}
    scenario = replace(settings.scenario, folder=Path(here[str(settings.scenario.folder)]))
    files = {value: here[file] for value, file in settings.argument_files.items()}
    code = tuple(here[folder] for folder in settings.code)
    return replace(settings, scenario=scenario, code=code, argument_files=files, scratch=scratch)


def unpack(packed: bytes, digest: str, root: Path) -> None:
    """Unpack an archive into a new folder.

    Raises:
        BundleError: the contents differ from the archive that was sent.
        OSError: the folder cannot be written.
    """
    (root / _SCENARIO).mkdir(parents=True)
    found = {}
    try:
        with zipfile.ZipFile(io.BytesIO(packed)) as archive:
            for entry in archive.infolist():
                place = PurePosixPath(os.fsdecode(entry.filename.encode("latin-1")))
                if place.is_absolute() or ".." in place.parts:
                    raise ValueError(f"the path {entry.filename!r} leads out of the archive")
                path = root / place
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(archive.read(entry))
                if entry.external_attr >> 16 & stat.S_IXUSR:
                    path.chmod(0o755)
                found[entry.filename] = _described(path)
        if digest_of_data(found) != digest:
            raise ValueError("the digest of its content differs from the expected digest")
    except (ValueError, zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as error:
        raise BundleError(f"the code archive {digest} is damaged: {error}", fix="run the hunt again") from None


def _is_same_snapshot(folder: Path) -> bool:
    """Return whether a folder of a snapshot is a copy of the current folder, with the same name and the same files."""
    here = Path.cwd()
    _, tree, place = folder.as_posix().rpartition(f"/{layout.CODE}/@")
    if not tree or not here.as_posix().endswith(f"/{place}"):
        return False
    return all((here / path.name).exists() for path in folder.iterdir())


def _archive_bytes(place: str) -> str:
    """Return a file name in the form for an archive; if it is not valid Unicode, each byte becomes a character."""
    return os.fsencode(place).decode("latin-1")


def _described(path: Path) -> str:
    """Return the contents of a file and whether it is executable, because an agent may run a program next to it."""
    return digest_of_file(path) + ("*" if path.stat().st_mode & stat.S_IXUSR else "")


def _modules(folder: Path) -> Iterator[tuple[str, Path]]:
    """Return the files below a folder of code, except Python's compiled files."""
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.suffix != ".pyc":
            yield path.relative_to(folder).as_posix(), path


# The folder of a cluster of the hunt's own, which goes with it, or with the next one where the hunt was killed.

_PREFIX, _FOLDER_LOCK = "chr-", "crashhunt.lock"
_MAX_FOLDER_CHARACTERS = 40  # characters of a folder in which Ray can make its sockets


class Folder:
    """A new folder with a short name that Ray accepts; such folders whose owners have ended are removed first.

    Args:
        parent: folder in which the new folder is created; by default the folder for temporary files, if its name is
            short enough for Ray.
    """

    def __init__(self, parent: Path | None = None) -> None:
        usual = tempfile.gettempdir()
        parent = parent or Path(usual if len(usual) <= _MAX_FOLDER_CHARACTERS and usual.isascii() else "/tmp")
        for old in parent.glob(f"{_PREFIX}*"):
            _remove_if_left(old)
        self.path = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=parent))
        # Locked when it appears: a folder without a lock is foreign, or was created a moment ago.
        part = self.path / f".{_FOLDER_LOCK}"
        self._lock = part.open("w")
        fcntl.flock(self._lock, fcntl.LOCK_EX)
        part.rename(self.path / _FOLDER_LOCK)

    def fileno(self) -> int:
        """Return the file descriptor of the folder's lock; a process that inherits it owns the folder as well."""
        return self._lock.fileno()

    def remove(self) -> None:
        """Delete the folder and its lock."""
        shutil.rmtree(self.path, ignore_errors=True)
        self._lock.close()


def _remove_if_left(folder: Path) -> None:
    """Delete a folder whose lock is free, because its owners have ended."""
    with suppress(OSError):
        found = folder.lstat()
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid():
            with (folder / _FOLDER_LOCK).open("r+") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)


class NodeFolder(TemporaryFolder):
    """The folder of one hunt on a node.

    Raises:
        OSError: the disk is full.
    """

    def __init__(self) -> None:
        super().__init__("node")
        self.code = self.path / "parcel"
        self.scratch = self.path / "scratch"
        self.scratch.mkdir()

    def unpack(self, packed: bytes, digest: str) -> bool:
        """Unpack an archive of code; return whether its contents match the digest."""
        try:
            unpack(packed, digest, self.code)
        except BundleError:
            shutil.rmtree(self.code, ignore_errors=True)
            return False
        return True
