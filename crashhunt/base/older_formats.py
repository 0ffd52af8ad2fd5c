"""Files that were written before format version 1.

The formats of crashhunt were numbered again when they became version 1, and every later version reads version 1. Files
from before are read only by `LAST_REVISION`, and `OlderFormatError` says so wherever such a file is refused.
"""

from __future__ import annotations

from crashhunt.base.errors import HuntDirectoryError

LAST_REVISION = "7f85e4ca"
"""Git revision of crashhunt that reads every file from before format version 1."""
_SOURCE = f"git+https://github.com/crashhunt/crashhunt@{LAST_REVISION}"


class OlderFormatError(HuntDirectoryError):
    """A file is from before format version 1, so this version does not read it."""

    @classmethod
    def of(cls, what: str, where: str) -> OlderFormatError:
        """Return the error for a file.

        Args:
            what: the file, such as ``the ledger``.
            where: path of the file.
        """
        fix = f"read it with crashhunt of git revision {LAST_REVISION} (pip install '{_SOURCE}'), or hunt again"
        return cls(f"{what} is older than format version 1", fix=fix, where=where)
