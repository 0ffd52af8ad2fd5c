"""Message authentication codes with the secret key of this user: they prove that this user wrote something here.

The codes are HMAC-SHA256 (RFC 2104). Each has a purpose, so that a code for one thing is none for another thing.
"""

from __future__ import annotations

import hmac
import json
import os
import secrets
import stat
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

__all__ = ["authentication_code", "is_authentic", "state_folders", "user_key"]

_KEY_BYTES = 32
_KEY_OF_THIS_PROCESS = secrets.token_bytes(_KEY_BYTES)


def authentication_code(purpose: str, statement: Mapping[str, object]) -> str:
    """Return the code of a statement, in hexadecimal.

    Args:
        purpose: what the code is for, such as ``crash bundle``.
        statement: plain data; their order makes no difference.
    """
    text = json.dumps(statement, sort_keys=True, separators=(",", ":"))
    return hmac.new(user_key(), f"crashhunt {purpose}\0{text}".encode(), "sha256").hexdigest()


def is_authentic(purpose: str, statement: Mapping[str, object], code: object) -> bool:
    """Return whether a code is that of this user for a statement; without a code, it is not."""
    if not isinstance(code, str) or not code.isascii():
        return False
    return hmac.compare_digest(code, authentication_code(purpose, statement))


def user_key() -> bytes:
    """Return the secret key of this user on this machine; the first call creates it.

    Where no folder can keep it, each process has a key of its own, so that nothing counts as made here later.
    """
    for folder in state_folders():
        key = _kept_key(folder / layout.ARCHIVE_KEY)
        if key is not None:
            return key
    return _KEY_OF_THIS_PROCESS


def state_folders() -> Iterator[Path]:
    """Yield the folders in which the state of this user may be kept, the usual one first; not all can be written.

    ``$XDG_STATE_HOME/crashhunt`` or ``~/.local/state/crashhunt``. A container may run a user without a writable home,
    so a private folder among the temporary files comes last.
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
    """Return the key of a file, which is created where it is missing; None where neither is possible."""
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
