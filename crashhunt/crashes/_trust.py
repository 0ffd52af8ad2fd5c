"""Whose a bundle is: an archive that this user made on this machine is signed, and every other one is a stranger's."""

from __future__ import annotations

import hmac
import json
from typing import TYPE_CHECKING

from crashhunt.base.authentication import user_key

if TYPE_CHECKING:
    from crashhunt.crashes._data import ArchiveIndex

__all__ = ["is_made_here", "signature"]


def is_made_here(index: ArchiveIndex) -> bool:
    """Whether the signature of an archive is this user's."""
    said = index.get("signature")
    return isinstance(said, str) and said.isascii() and hmac.compare_digest(said, signature(index))


def signature(index: ArchiveIndex) -> str:
    """What only this user on this machine can know of an archive."""
    content = {name: value for name, value in index.items() if name != "signature"}
    text = json.dumps(content, sort_keys=True, default=str).encode()
    return hmac.new(user_key(), text, "sha256").hexdigest()
