"""Digests that detect corruption and accidental edits of files and rows.

These digests do not detect deliberate tampering, because they have no key.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import re
import secrets
import stat
import tempfile
from contextlib import suppress
from errno import ELOOP, ENXIO
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, NotRequired, TypedDict, TypeVar, cast, get_args, get_origin

from crashhunt.base import layout

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from crashhunt.base.json_types import Plain


T = TypeVar("T")
_SMALL_FILE_BYTES = 1 << 20  # bytes
_READ_BYTES = 1 << 12  # bytes beyond the size of a file, which is 0 for those of /proc


class FileEntry(TypedDict):
    """The recorded size and digest of a file."""

    size: int  # size in bytes
    blake2b: str  # the digest of its content, in hexadecimal
    # 1 if the owner may execute the file, such as a planner that an agent starts; else missing. No other permission is
    # recorded.
    executable: NotRequired[int]


def digest_of_row(values: tuple[object, ...]) -> int:
    """Return the digest of a row of a table: a signed 64-bit number, the most compact form in SQLite."""
    text = "\0".join(map(str, values))  # a trial's cost is counted in microseconds, and JSON would take twice as long
    digest = hashlib.blake2b(text.encode("utf-8", "surrogatepass"), digest_size=8).digest()
    return int.from_bytes(digest, "little", signed=True)


def digest_of_data(data: Plain) -> str:
    """Return the digest of a JSON object, in hexadecimal, independent of layout and order of keys."""
    text = json.dumps(data, sort_keys=True, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def open_at_once(path: str | Path, flags: int) -> int:
    """Open a file for `open`. A pipe in place of the file is empty: O_NONBLOCK does not wait for its writer."""
    return os.open(path, flags | os.O_NONBLOCK)


def digest_of_content(content: bytes) -> str:
    """Return the digest of the content of a file, in hexadecimal."""
    return hashlib.blake2b(content, digest_size=16).hexdigest()


def digest_of_file(path: str | Path) -> str:
    """Return the digest of a file's content, in hexadecimal.

    Raises:
        OSError: the file cannot be read.
    """
    opened = open_at_once(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        return _digest_of_opened(opened, os.fstat(opened).st_size)
    finally:
        os.close(opened)


def _digest_of_opened(opened: int, size: int) -> str:
    if size >= _SMALL_FILE_BYTES:
        with FileIO(opened, closefd=False) as file:
            return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()
    # Hundreds at a time, and a file object takes as long as the rest. One that grows meanwhile is read to its end.
    parts = []
    while part := os.read(opened, size + _READ_BYTES):
        parts.append(part)
    return digest_of_content(b"".join(parts))


def describe_files(folder: Path) -> dict[str, FileEntry]:
    """Return the size and digest of every file in a folder, by file name.

    Raises:
        OSError: a file cannot be read.
    """
    return {
        path.name: {"size": path.stat().st_size, "blake2b": digest_of_file(path)}
        for path in sorted(folder.iterdir())
        if path.is_file()
    }


def changed_file(path: str | Path, entry: FileEntry) -> str:
    """Return how a file differs from its recorded size and digest; empty if it is unchanged."""
    try:
        # Hundreds of files at a time, so open each once.
        opened = open_at_once(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
        try:
            status = os.fstat(opened)
            if not stat.S_ISREG(status.st_mode):
                return "is missing"
            size = status.st_size
            same = size == entry["size"] and _digest_of_opened(opened, size) == entry["blake2b"]
        finally:
            os.close(opened)
    except (FileNotFoundError, NotADirectoryError, ValueError):  # the last where no file can have such a name
        return "is missing"
    except OSError as error:
        # A link and a socket cannot be opened like this.
        return "is missing" if error.errno in (ELOOP, ENXIO) else f"cannot be read ({error.strerror})"
    if same and "executable" in entry and not status.st_mode & stat.S_IXUSR:
        return "is no longer executable"
    return "" if same else "has changed"


# The largest sizes of files of a hunt that are read as a whole: usual ones have some KB, and 1 MB of JSON takes 20 ms
# and 3 MB of memory. A hunt may be a stranger's, so archives, folders and the dashboard have the same limits.
_MAX_BYTES = {
    layout.HUNT: 4 << 20,
    layout.SCENARIO: 4 << 20,
    layout.CRASH: 16 << 20,
    layout.PARAMS: 16 << 20,
    layout.MANIFEST: 32 << 20,  # of 100,000 files
    layout.ARCHIVE_INDEX: 32 << 20,
}
_MAX_BYTES_OF_OTHERS = 64 << 20


def too_large(name: str, size: int) -> str:
    """Return how the size of a file exceeds the limit of files of its name; empty if it does not, or has no limit."""
    most = _MAX_BYTES.get(name)
    return f"{name} has {size:,} bytes (allowed: {most:,})" if most is not None and size > most else ""


def read_bounded(path: Path) -> bytes:
    """Read a file of a hunt as a whole.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is larger than files of its name may be.
    """
    most = _MAX_BYTES.get(path.name, _MAX_BYTES_OF_OTHERS)
    with open(path, "rb", opener=open_at_once) as file:
        content = file.read(most + 1) if (size := os.fstat(file.fileno()).st_size) <= most else b""
    if size > most or len(content) > most:
        raise ValueError(f"the file has {max(size, len(content)):,} bytes (allowed: {most:,})")
    return content


def read_object(path: Path, shape: type[T]) -> T:
    """Read a JSON object from a file.

    The caller checks the keys that it needs with `typed`.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file contains no JSON object, or is too large; the message is one line.
    """
    return parse_object(read_bounded(path), shape)


def parse_object(text: bytes, shape: type[T]) -> T:  # noqa: ARG001 - for the type checker
    """Parse a text as a JSON object.

    Raises:
        ValueError: the text is not a JSON object; the message is one line.
    """
    try:
        found = json.loads(text)
    except RecursionError:
        raise ValueError("the JSON data are nested too deeply") from None
    if not isinstance(found, dict):
        raise ValueError(f"the file contains a JSON value of the type {type(found).__name__}, not a JSON object")
    return cast(T, found)


MAX_INTEGER = 2**63 - 1
"""The greatest integer of a bundle, of SQLite and of TOML."""


FILES = dict[str, dict[str, int | str]]
"""The type of what `describe_files` returns, for `typed`."""


def typed(data: Plain, types: Plain) -> None:
    """Check that a JSON object has all required keys, and that their values have the given types.

    Args:
        data: the JSON object.
        types: type of each required key: a class, a union of classes, ``list[...]`` or ``dict[str, ...]``. An int is
            accepted as a float.

    Raises:
        ValueError: a key is missing or has a value of another type; the message names key, value and type.
    """
    for key, kind in types.items():
        if key not in data:
            raise ValueError(f"{key!r} is missing")
        if not _is(data[key], kind):
            raise ValueError(f"{key} is {_short(data[key])}, not {_words(kind)}")


def _is(value: object, kind: Any) -> bool:
    if type(kind) is not type:  # classes are asked for a thousand times, and have no parts
        origin, inner = get_origin(kind), get_args(kind)
        if origin is list:
            return isinstance(value, list) and all(_is(item, inner[0]) for item in value)
        if origin is dict:
            return isinstance(value, dict) and all(_is(item, inner[1]) for item in value.values())
        if inner:  # a union
            return any(_is(value, choice) for choice in inner)
    if kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    if kind is int:
        return isinstance(value, int) and not isinstance(value, bool) and abs(value) <= MAX_INTEGER
    return isinstance(value, kind)


def _words(kind: object) -> str:
    return re.sub(r"<class '([^']+)'>", r"\1", str(kind))


def _short(value: object) -> str:
    text = repr(value) if not isinstance(value, int) or abs(value) < 2**64 else "a number that is too large"
    return text if len(text) <= 60 else f"{text[:57]}…"


# Message authentication codes with the secret key of this user: they prove that this user wrote something here.
#
# The codes are HMAC-SHA256 (RFC 2104). Each has a purpose, so that a code for one thing is none for another thing.

_KEY_BYTES = 32
_KEY_OF_THIS_PROCESS = secrets.token_bytes(_KEY_BYTES)


def authentication_code(purpose: str, statement: Mapping[str, object]) -> str:
    """Return the authentication code of a statement, in hexadecimal.

    The purpose is a text such as ``crash bundle``. The order of the keys makes no difference.
    """
    text = json.dumps(statement, sort_keys=True, separators=(",", ":"))
    return hmac.new(user_key(), f"crashhunt {purpose}\0{text}".encode(), "sha256").hexdigest()


def is_authentic(purpose: str, statement: Mapping[str, object], code: object) -> bool:
    """Return whether this user has made an authentication code for a statement; False for an empty code."""
    if not isinstance(code, str) or not code.isascii():
        return False
    return hmac.compare_digest(code, authentication_code(purpose, statement))


def user_key() -> bytes:
    """Return the secret key of this user on this machine; the first call creates it.

    If the key cannot be stored in any folder, each process has its own key. Later processes then do not recognize the
    crashes of this process as made here.
    """
    for folder in state_folders():
        key = _kept_key(folder / layout.ARCHIVE_KEY)
        if key is not None:
            return key
    return _KEY_OF_THIS_PROCESS


def state_folders() -> Iterator[Path]:
    """Yield the folders that may store the state of this user, the usual folder first; some may not be writable.

    The usual folder is ``$XDG_STATE_HOME/crashhunt`` or ``~/.local/state/crashhunt``. A container may run a user
    without a writable home, so a private folder among the temporary files comes last.
    """
    home = os.environ.get("XDG_STATE_HOME", "")
    if not Path(home).is_absolute():  # which the XDG specification says to ignore
        try:
            home = str(Path.home() / ".local" / "state")
        except RuntimeError:  # a user without an entry in the system's list
            home = ""
    if home:
        yield Path(home) / "crashhunt"
    private = Path(tempfile.gettempdir()) / f"crashhunt-{os.geteuid()}"
    with suppress(OSError):
        private.mkdir(mode=0o700, exist_ok=True)
        found = private.lstat()
        # Every user can create this name first, so use only a folder that belongs to this user alone.
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid() and not found.st_mode & 0o077:
            yield private


def _kept_key(file: Path) -> bytes | None:
    """Return the key in a file, which is created if missing; None if it can be neither read nor created."""
    with suppress(OSError):
        key = file.read_bytes()
        # Everybody can compute codes with a key that is cut off: replace the file.
        if len(key) >= _KEY_BYTES:
            return key
        file.unlink()
    try:
        file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        temporary = file.with_name(f".{file.name}.{os.getpid()}.{secrets.token_hex(4)}")
        try:
            with os.fdopen(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as opened:
                opened.write(secrets.token_bytes(_KEY_BYTES))
                opened.flush()
                os.fsync(opened.fileno())
            with suppress(FileExistsError):
                os.link(temporary, file)  # of two processes at once, the first one wins
        finally:
            with suppress(OSError):
                temporary.unlink()
        key = file.read_bytes()
    except OSError:
        return None
    return key if len(key) >= _KEY_BYTES else None
