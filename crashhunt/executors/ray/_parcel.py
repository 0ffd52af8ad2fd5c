"""What travels to a node before it can run trials: the scenario, the code and the files of a hunt, by digest."""

from __future__ import annotations

import io
import os
import stat
import zipfile
import zlib
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import BundleError, UsageError
from crashhunt.base.integrity import digest_of_data, digest_of_file

if TYPE_CHECKING:
    from collections.abc import Iterator

    from crashhunt.episode import WorkerSettings

__all__ = ["LIMIT_MB", "Parcel", "settings_in", "unpack"]

LIMIT_MB = 200
"""What travels well: it is in the memory of the hunt's machine once, and on the disk of every node."""
_MEGABYTE = 10**6
_SCENARIO, _CODE, _FILES = "scenario", "code", "files"


@dataclass(frozen=True, slots=True)
class Parcel:
    """The files that trials need, and the folders here that stand for them.

    Args:
        files: place in the parcel to file.
        folders: folder or file here to the place that stands for it, for `settings_in`.
        home: the place that stands for the current folder; empty where none does.
    """

    files: dict[str, Path]
    folders: dict[str, str]
    home: str = ""

    @classmethod
    def of(cls, settings: WorkerSettings) -> Parcel:
        """Return what a hunt's trials need.

        Raises:
            UsageError: it is more than travels well.
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
                f"scenario and code have {total:.0f} MB, above the {LIMIT_MB} MB that travel well to other machines; "
                f"the largest file is {largest} ({sizes[largest] / _MEGABYTE:.0f} MB)",
                fix="make it smaller, or have git ignore what the agent does not need",
            )
        return cls(files, folders, next((folders[folder] for folder in settings.code if _is_here(Path(folder))), ""))

    def digest(self) -> str:
        """Return the digest of all that is in it.

        Raises:
            OSError: a file cannot be read.
        """
        return digest_of_data({_as_sent(place): _described(path) for place, path in self.files.items()})

    def packed(self) -> bytes:
        """Return it as it travels.

        Raises:
            OSError: a file cannot be read.
        """
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1, strict_timestamps=False) as archive:
            for place, path in self.files.items():
                archive.write(path, _as_sent(place))
        return buffer.getvalue()


def settings_in(settings: WorkerSettings, folders: dict[str, str], root: Path, scratch: Path) -> WorkerSettings:
    """Return the settings of a hunt as they are where a parcel has been unpacked.

    Args:
        settings: of the hunt, on the machine where it was begun.
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
    """Write what a parcel holds into a new folder.

    Args:
        packed: the parcel.
        digest: what it must have.
        root: the folder, which is not there yet.

    Raises:
        BundleError: it is not what was sent.
        OSError: it cannot be written.
    """
    (root / _SCENARIO).mkdir(parents=True)
    found = {}
    try:
        with zipfile.ZipFile(io.BytesIO(packed)) as archive:
            for entry in archive.infolist():
                place = PurePosixPath(os.fsdecode(entry.filename.encode("latin-1")))
                if place.is_absolute() or ".." in place.parts:
                    raise ValueError(f"the name {entry.filename!r} leads out of it")
                path = root / place
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(archive.read(entry))
                if entry.external_attr >> 16 & stat.S_IXUSR:
                    path.chmod(0o755)
                found[entry.filename] = _described(path)
        if digest_of_data(found) != digest:
            raise ValueError("its digest is another one")
    except (ValueError, zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as error:
        raise BundleError(f"the parcel {digest} is damaged: {error}", fix="have it sent again") from None


def _is_here(folder: Path) -> bool:
    """Whether a folder of a snapshot is what the current one was: of the same name, and all of it is here as well."""
    here = Path.cwd()
    _, tree, place = folder.as_posix().rpartition(f"/{layout.CODE}/@")
    if not tree or not here.as_posix().endswith(f"/{place}"):
        return False
    return all((here / path.name).exists() for path in folder.iterdir())


def _as_sent(place: str) -> str:
    """A name as it is in an archive, which takes none that is not Unicode: a character for each of its bytes."""
    return os.fsencode(place).decode("latin-1")


def _described(path: Path) -> str:
    """What is in a file, and whether it can be run, as an agent may do with a program that lies beside it."""
    return digest_of_file(path) + ("*" if path.stat().st_mode & stat.S_IXUSR else "")


def _modules(folder: Path) -> Iterator[tuple[str, Path]]:
    """The files below a folder of code, but for what Python has compiled of it."""
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.suffix != ".pyc":
            yield path.relative_to(folder).as_posix(), path
