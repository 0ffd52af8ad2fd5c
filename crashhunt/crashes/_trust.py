"""Whose a bundle is: an archive that this user made on this machine is signed, and every other one is a stranger's."""

from __future__ import annotations

import hmac
import json
import os
import secrets
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.temporary import temporary_beside

if TYPE_CHECKING:
    from crashhunt.crashes._data import ArchiveIndex

__all__ = ["is_made_here", "signature"]


def is_made_here(index: ArchiveIndex) -> bool:
    """Whether the signature of an archive is this user's."""
    return hmac.compare_digest(str(index.get("signature", "")), signature(index))


def signature(index: ArchiveIndex) -> str:
    """What only this user on this machine can know of an archive."""
    content = {name: value for name, value in index.items() if name != "signature"}
    text = json.dumps(content, sort_keys=True, default=str).encode()
    return hmac.new(_key(), text, "sha256").hexdigest()


def _key() -> bytes:
    """The secret of this user on this machine, made when it is first needed."""
    key = secrets.token_bytes(32)
    try:
        state = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    except RuntimeError:
        return key  # a user without a home, as in a container; see below
    file = Path(state) / "crashhunt" / layout.ARCHIVE_KEY
    try:
        return file.read_bytes()
    except OSError:
        pass  # none yet, or it may not be read
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with temporary_beside(file) as temporary:
            with os.fdopen(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as opened:
                opened.write(key)
                opened.flush()
                os.fsync(opened.fileno())
            with suppress(FileExistsError):  # the first of two wins
                os.link(temporary, file)
        return file.read_bytes()
    except OSError:
        return key  # nowhere to keep it: every archive is a stranger's
