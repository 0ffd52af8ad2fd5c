"""Archives: one file that contains a crash and everything that a replay on another machine needs."""

from __future__ import annotations

import hashlib
import hmac
import json
import socket
import stat
import time
import zipfile
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, NotRequired, TypedDict

from crashhunt.base import layout
from crashhunt.base.errors import BundleError
from crashhunt.base.files import output_file
from crashhunt.base.integrity import FILES, FileEntry, digest_of_content, parse_object, too_large, typed, user_key
from crashhunt.base.progress import Watch, watched
from crashhunt.base.temporary import temporary_folder
from crashhunt.crashes._bundle import Bundle, snapshot_of
from crashhunt.crashes._bundle_trust import is_bundle_made_here
from crashhunt.crashes._notes import notes_as_text, read_notes, subject_of, user_name

if TYPE_CHECKING:
    from collections.abc import Iterator


SCHEMA = 1
_MAX_BYTES = 4 * 10**9  # unpacked size, because a small zip file can contain terabytes
_MAX_FILES = 100_000  # so many make a file system slow
_PARTS_OF_A_DESCRIPTION = 3  # snapshots/DIGEST/manifest.json; below are files of any name
_CHUNK_BYTES = 1 << 20  # bytes at a time, so that a large file needs little memory


class ArchiveIndex(TypedDict):
    """The index of an archive: its version, its origin and its files."""

    schema: int
    crash: str
    made_by: str
    made_at: str
    files: dict[str, FileEntry]
    notes: NotRequired[str]
    signature: NotRequired[str]


@dataclass(frozen=True, slots=True)
class Archive:
    """An archive that has been unpacked and checked."""

    directory: Path  # directory of the unpacked hunt
    made_by: str  # name of the tool that made the archive, as recorded in the archive
    made_at: str  # time of the export, as recorded in the archive
    made_here: bool  # whether this user made the archive on this machine, which its signature proves


def export_crash(bundle: Bundle, target: Path, *, watch: Watch | None = None) -> int:
    """Write a crash, the settings of its hunt and its snapshot into one zip file. The file is never incomplete.

    An existing file is replaced.

    Returns:
        The size of the zip file in bytes.

    Raises:
        BundleError: a file of the crash is missing or damaged.
        HuntDirectoryError: the file cannot be written.
    """
    hunt = bundle.hunt
    bundle.recording()  # refuses what is damaged
    snapshot = snapshot_of(bundle)
    snapshot.verify(to_run=False)  # the dashboard exports, and writes nothing into a hunt
    files = [hunt / layout.HUNT, *sorted(bundle.path.rglob("*"))]
    # Export only the snapshot's files that its manifest names, because an agent may have written data into its folder.
    files += [snapshot.path / name for name in snapshot.manifest["files"]]
    files += sorted(path for path in snapshot.path.iterdir() if path.is_file())
    entries: dict[str, FileEntry] = {}
    with output_file(target) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in watched(files, len(files), watch):
            if path.is_file() and not path.is_symlink():
                name = path.relative_to(hunt).as_posix()
                data = path.read_bytes()
                entries[name] = {"size": len(data), "blake2b": digest_of_content(data)}
                info = zipfile.ZipInfo(name)
                if path.stat().st_mode & stat.S_IXUSR:
                    entries[name]["executable"] = 1
                    info.external_attr = (stat.S_IFREG | 0o755) << 16  # for users who unpack it themselves
                archive.writestr(info, data, zipfile.ZIP_DEFLATED)
        index: ArchiveIndex = {
            "schema": SCHEMA,
            "crash": bundle.id,
            "made_by": f"{user_name()}@{socket.gethostname()}",
            "made_at": time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime()),
            "files": entries,
        }
        if notes := read_notes(hunt, subject_of(bundle)):  # in the index, because earlier versions refuse further files
            index["notes"] = notes_as_text(notes)
        if is_bundle_made_here(bundle):  # else a stranger's crash would become this user's
            index["signature"] = _signature(index)
        archive.writestr(zipfile.ZipInfo(layout.ARCHIVE_INDEX), json.dumps(index, indent=1), zipfile.ZIP_DEFLATED)
    return target.stat().st_size


@contextmanager
def open_archive(path: Path) -> Iterator[Archive]:
    """Unpack an archive into a temporary folder, which is deleted afterwards.

    The archive is not trusted: names, sizes and hashes are checked, and no code runs.

    Raises:
        BundleError: the file is not an archive, or contains entries that an archive may not contain.
    """
    with temporary_folder("archive") as directory:
        try:
            with zipfile.ZipFile(path) as archive:
                index = _read_index(archive, path)
                for entry in _checked(archive, index, path):
                    _extract(archive, entry, directory, index["files"][entry.filename], path)
                if notes := index.get("notes"):
                    (directory / layout.NOTES).write_text(str(notes), encoding="utf-8", errors="replace")
        except BundleError:
            raise
        except OSError as error:
            raise _refusal(path, f"cannot be unpacked: {error.strerror or error}") from None
        except Exception as error:  # zipfile and what it unpacks with have an error of their own for every damage
            name = "" if isinstance(error, zipfile.BadZipFile) else f"{type(error).__name__}: "
            raise _refusal(path, f"it is damaged, or not a zip file: {name}{' '.join(str(error).split())}") from None
        yield Archive(
            directory=directory,
            made_by=str(index.get("made_by", "?")),
            made_at=str(index.get("made_at", "?")),
            made_here=_is_made_here(index),
        )


def _read_index(archive: zipfile.ZipFile, path: Path) -> ArchiveIndex:
    try:
        info = archive.getinfo(layout.ARCHIVE_INDEX)
        if why := too_large(layout.ARCHIVE_INDEX, info.file_size):
            raise _refusal(path, why)
        index = parse_object(archive.read(info), ArchiveIndex)
        typed(index, {"schema": int})
        if index["schema"] != SCHEMA:
            raise BundleError(
                f"schema version {index['schema']} is not supported (supported: {SCHEMA})",
                fix="use the version of crashhunt that wrote the trial",
                where=str(path),
            )
        typed(index, {"files": FILES})
        for entry in index["files"].values():
            typed(entry, {"size": int, "blake2b": str})
    except (KeyError, ValueError) as error:
        raise _refusal(path, f"not an exported crash: {type(error).__name__}: {error}") from None
    return index


def _checked(archive: zipfile.ZipFile, index: ArchiveIndex, path: Path) -> list[zipfile.ZipInfo]:
    """Return the entries to unpack, or refuse the archive."""
    entries = [entry for entry in archive.infolist() if entry.filename != layout.ARCHIVE_INDEX]
    names = [entry.filename for entry in entries]
    if len(entries) > _MAX_FILES or sum(entry.file_size for entry in entries) > _MAX_BYTES:
        raise _refusal(path, "its files are too many or too large")
    if len(set(names)) != len(names):
        raise _refusal(path, "it contains two files with the same name")
    for entry in entries:
        name = entry.filename
        parts = PurePosixPath(name).parts
        if not parts or name.startswith("/") or ".." in parts or "\\" in name or "\0" in name or ":" in parts[0]:
            raise _refusal(path, f"the path {name!r} leads out of the folder to which it is unpacked")
        if parts[0] not in (layout.HUNT, layout.CRASHES, *layout.BESIDE, layout.SNAPSHOTS):
            raise _refusal(path, f"it contains {name!r}, which does not belong to a crash")
        kind = stat.S_IFMT(entry.external_attr >> 16)
        if kind not in (0, stat.S_IFREG) or name.endswith("/"):
            raise _refusal(path, f"{name!r} is not a file")
        is_of_the_agent = parts[0] == layout.SNAPSHOTS and len(parts) > _PARTS_OF_A_DESCRIPTION
        if not is_of_the_agent and (why := too_large(parts[-1], entry.file_size)):
            raise _refusal(path, why)
        if name not in index["files"]:
            raise _refusal(path, f"{name!r} is not listed in its {layout.ARCHIVE_INDEX}")
    for name in index["files"]:
        if name not in names:
            raise _refusal(path, f"{name!r} is missing")
    return entries


def _extract(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, directory: Path, listed: FileEntry, path: Path) -> None:
    target = directory / entry.filename
    target.parent.mkdir(parents=True, exist_ok=True)
    digest, size = hashlib.blake2b(digest_size=16), 0
    with archive.open(entry) as source, target.open("xb") as copy:
        while chunk := source.read(_CHUNK_BYTES):
            size += len(chunk)
            if size > listed["size"]:  # whatever the zip says of itself
                raise _refusal(path, f"{entry.filename!r} is larger than its index states")
            digest.update(chunk)
            copy.write(chunk)
    if size != listed["size"] or digest.hexdigest() != listed["blake2b"]:
        raise _refusal(path, f"{entry.filename!r} has changed since it was exported")
    if "executable" in listed:
        mode = target.stat().st_mode
        target.chmod(mode | (mode & 0o444) >> 2)  # by all who may read it


def _refusal(path: Path, message: str) -> BundleError:
    return BundleError(message, fix="get an undamaged copy from the person who exported it", where=str(path))


def _is_made_here(index: ArchiveIndex) -> bool:
    """Return whether this user has signed an archive on this machine."""
    said = index.get("signature")
    return isinstance(said, str) and said.isascii() and hmac.compare_digest(said, _signature(index))


def _signature(index: ArchiveIndex) -> str:
    """Return the signature of an archive, which only this user on this machine can compute."""
    content = {name: value for name, value in index.items() if name != "signature"}
    text = json.dumps(content, sort_keys=True, default=str).encode()
    return hmac.new(user_key(), text, "sha256").hexdigest()
