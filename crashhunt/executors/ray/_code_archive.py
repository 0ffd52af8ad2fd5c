"""The archive that a node needs before it can run trials: scenario, code and files of a hunt, by digest."""

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
from typing import IO, TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import BundleError, UsageError
from crashhunt.base.integrity import digest_of_data, digest_of_file

if TYPE_CHECKING:
    from collections.abc import Iterator

    from crashhunt.episode import WorkerSettings


__all__ = ["LIMIT_MB", "CodeArchive", "Folder", "Place", "Store", "owned", "remove_if_left", "settings_in", "unpack"]


LIMIT_MB = 200
"""What travels well: it is in the memory of the hunt's machine once, and on the disk of every node."""
_MEGABYTE = 10**6
_SCENARIO, _CODE, _FILES = "scenario", "code", "files"


@dataclass(frozen=True, slots=True)
class CodeArchive:
    """The files that trials need, and the folders here that they replace.

    Args:
        files: place in the parcel to file.
        folders: folder or file here to its place in the parcel, for `settings_in`.
        home: the place of the current folder; empty if none does.
    """

    files: dict[str, Path]
    folders: dict[str, str]
    home: str = ""

    @classmethod
    def of(cls, settings: WorkerSettings) -> CodeArchive:
        """Return the parcel of a hunt.

        Raises:
            UsageError: the files are too large to send.
            ScenarioError: the scenario names a file that is not there.
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
                fix="make it smaller, or list unneeded files in .gitignore",
            )
        return cls(
            files, folders, next((folders[folder] for folder in settings.code if _is_same_snapshot(Path(folder))), "")
        )

    def digest(self) -> str:
        """Return the digest of the whole content.

        Raises:
            OSError: a file cannot be read.
        """
        return digest_of_data({_archive_bytes(place): _described(path) for place, path in self.files.items()})

    def packed(self) -> bytes:
        """Return the parcel as compressed bytes.

        Raises:
            OSError: a file cannot be read.
        """
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1, strict_timestamps=False) as archive:
            for place, path in self.files.items():
                archive.write(path, _archive_bytes(place))
        return buffer.getvalue()


def settings_in(settings: WorkerSettings, folders: dict[str, str], root: Path, scratch: Path) -> WorkerSettings:
    """Return the settings of a hunt with the paths of an unpacked parcel.

    Args:
        settings: settings of the hunt, on the machine where it was begun.
        folders: those of the parcel.
        root: where it lies here.
        scratch: the folder in which workers write here.
    """
    here = {there: str(root / place) for there, place in folders.items()}
    scenario = replace(settings.scenario, folder=Path(here[str(settings.scenario.folder)]))
    files = {value: here[file] for value, file in settings.argument_files.items()}
    code = tuple(here[folder] for folder in settings.code)
    return replace(settings, scenario=scenario, code=code, argument_files=files, scratch=scratch)


def unpack(packed: bytes, digest: str, root: Path) -> None:
    """Unpack a parcel into a new folder.

    Args:
        packed: the parcel.
        digest: the expected digest.
        root: the folder, which is not there yet.

    Raises:
        BundleError: the content differs from the sent parcel.
        OSError: it cannot be written.
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
            raise ValueError("the digest of its content does not match")
    except (ValueError, zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as error:
        raise BundleError(f"the code archive {digest} is damaged: {error}", fix="run the hunt again") from None


def _is_same_snapshot(folder: Path) -> bool:
    """Return whether a folder of a snapshot is a copy of the current folder: same name and same files."""
    here = Path.cwd()
    _, tree, place = folder.as_posix().rpartition(f"/{layout.CODE}/@")
    if not tree or not here.as_posix().endswith(f"/{place}"):
        return False
    return all((here / path.name).exists() for path in folder.iterdir())


def _archive_bytes(place: str) -> str:
    """A name as it is in an archive, which takes none that is not Unicode: a character for each of its bytes."""
    return os.fsencode(place).decode("latin-1")


def _described(path: Path) -> str:
    """Return the content of a file and whether it is executable, because an agent may run a program next to it."""
    return digest_of_file(path) + ("*" if path.stat().st_mode & stat.S_IXUSR else "")


def _modules(folder: Path) -> Iterator[tuple[str, Path]]:
    """Return the files below a folder of code, without Python's compiled files."""
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.suffix != ".pyc":
            yield path.relative_to(folder).as_posix(), path


# The folder of a cluster of the hunt's own, which goes with it, or with the next one where the hunt was killed.

_PREFIX, _FOLDER_LOCK = "chr-", "crashhunt.lock"
_MAX_FOLDER_CHARACTERS = 40  # characters of a folder in which Ray can make its sockets


class Folder:
    """A new folder with a short name, of letters that Ray knows; those whose owners are gone are removed first.

    Args:
        parent: parent of it; the folder for temporary files by default, where its name is such.
    """

    def __init__(self, parent: Path | None = None) -> None:
        usual = tempfile.gettempdir()
        parent = parent or Path(usual if len(usual) <= _MAX_FOLDER_CHARACTERS and usual.isascii() else "/tmp")
        for old in parent.glob(f"{_PREFIX}*"):
            remove_if_left(old / _FOLDER_LOCK)
        self.path = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=parent))
        self._lock = owned(self.path / _FOLDER_LOCK)

    def fileno(self) -> int:
        """Return the descriptor of its lock: a process that inherits it owns the folder as well."""
        return self._lock.fileno()

    def remove(self) -> None:
        """Remove everything."""
        shutil.rmtree(self.path, ignore_errors=True)
        self._lock.close()


def owned(lock: Path) -> IO[str]:
    """Make the lock of a folder, which is invisible before it is held, and hold it for as long as it is open."""
    part = lock.with_name(f".{lock.name}")
    file = part.open("w")
    fcntl.flock(file, fcntl.LOCK_EX)
    part.rename(lock)
    return file


def remove_if_left(lock: Path) -> None:
    """Remove the folder of a free lock; a folder without a lock is foreign, or a moment old."""
    with suppress(OSError):
        found = lock.parent.lstat()
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid():
            with lock.open("r+") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(lock.parent, ignore_errors=True)


# What a node keeps on its disk: parcels that it was sent, for hunts to come, and a folder for each hunt that runs.

_KEPT_BYTES = 10**9  # of parcels
_MAX_KEPT_ARCHIVES = 32
_LOCK_NAME = "lock"


class Store:
    """The folder of this user on this machine, which all its nodes share.

    Args:
        folder: folder of the store; one below the folder for temporary files by default.
        kept_bytes: size of the parcels to keep, those that were used last.
    """

    def __init__(self, folder: Path | None = None, *, kept_bytes: int = _KEPT_BYTES) -> None:
        self._kept_bytes = kept_bytes
        self._folder = folder or Path(tempfile.gettempdir()) / f"crashhunt-{os.getuid()}"
        try:
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            found = self._folder.lstat()
            mine = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022
        except OSError:
            mine = False
        if not mine:  # foreign; its content would be run
            self._folder = Path(tempfile.mkdtemp(prefix="crashhunt-"))

    def find(self, digest: str) -> bytes | None:
        """Return a parcel, or None if it is not there; the unpacking detects damage."""
        file = self._file(digest)
        try:
            packed = file.read_bytes()
            os.utime(file)
        except OSError:
            return None
        return packed

    def keep(self, digest: str, packed: bytes) -> None:
        """Store a parcel, and delete those that were not used for longest."""
        file = self._file(digest)
        part = file.with_name(f".{digest}.{os.getpid()}")
        with suppress(OSError):  # it is sent again, then
            part.write_bytes(packed)
            part.replace(file)
        with suppress(OSError):
            part.unlink()
        self._forget()

    def drop(self, digest: str) -> None:
        """Remove a parcel that is damaged."""
        with suppress(OSError):
            self._file(digest).unlink()

    def place(self) -> Place:
        """Make a folder for one hunt, and remove those whose process is gone.

        Raises:
            OSError: the disk is full.
        """
        for old in self._folder.glob("hunt-*"):
            remove_if_left(old / _LOCK_NAME)
        return Place(Path(tempfile.mkdtemp(prefix="hunt-", dir=self._folder)))

    def _file(self, digest: str) -> Path:
        return self._folder / f"{digest}.zip"

    def _forget(self) -> None:
        found = []
        for file in self._folder.glob("*.zip"):
            with suppress(OSError):
                found.append((file.stat().st_mtime, file.stat().st_size, file))
        total = 0
        for count, (_, size, file) in enumerate(sorted(found, reverse=True)):
            total += size
            if count and (total > self._kept_bytes or count >= _MAX_KEPT_ARCHIVES):
                with suppress(OSError):
                    file.unlink()


class Place:
    """The folder of one hunt on a node, which is its own as long as this process lives.

    Args:
        path: path of it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.code = path / "parcel"
        self.scratch = path / "scratch"
        self._lock = owned(path / _LOCK_NAME)
        self.scratch.mkdir()

    def unpack(self, packed: bytes, digest: str) -> bool:
        """Unpack an archive of code; return whether its content matches its digest."""
        try:
            unpack(packed, digest, self.code)
        except BundleError:
            shutil.rmtree(self.code, ignore_errors=True)
            return False
        return True

    def remove(self) -> None:
        """Remove everything."""
        shutil.rmtree(self.path, ignore_errors=True)
        self._lock.close()
