"""What this user trusts although it was not made here: a file for each origin in the folder of the user's state."""

from __future__ import annotations

import json
import time
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.authentication import state_folders
from crashhunt.base.errors import HuntDirectoryError, UsageError
from crashhunt.base.files import whole_file
from crashhunt.base.integrity import parse_object

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["TrustedOrigin", "add_trusted", "is_fingerprint_trusted", "list_trusted", "remove_trusted"]

_FOLDER = "trusted"
_SHOWN = 12  # characters of a fingerprint
_SHORTEST = 6  # characters of a fingerprint that name an origin


@dataclass(frozen=True, slots=True)
class TrustedOrigin:
    """Code that this user trusts.

    Args:
        fingerprint: SHA-256 of everything that says what would run, in hexadecimal.
        path: where it was when the user trusted it.
        runs: what would run, in words.
        trusted_at: when, as UTC.
    """

    fingerprint: str
    path: str
    runs: str
    trusted_at: str

    @property
    def id(self) -> str:
        """The beginning of the fingerprint, which names the origin."""
        return self.fingerprint[:_SHOWN]


def add_trusted(fingerprint: str, *, path: str, runs: str) -> TrustedOrigin:
    """Trust code from now on, and return the entry.

    Args:
        fingerprint: of the code.
        path: where it is now.
        runs: what would run, in words.

    Raises:
        HuntDirectoryError: no folder can keep the entry.
    """
    now = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime())
    origin = TrustedOrigin(fingerprint, path, runs, now)
    error: Exception | None = None
    for folder in _folders():
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            with whole_file(folder / f"{fingerprint}.json") as temporary:
                temporary.write_text(json.dumps({"schema": 1, **asdict(origin)}, indent=1), encoding="utf-8")
        except (OSError, HuntDirectoryError) as failed:
            error = failed
            continue
        return origin
    raise HuntDirectoryError(
        f"no folder can keep what is trusted: {error}", fix="set XDG_STATE_HOME to a folder that can be written"
    )


def list_trusted() -> list[TrustedOrigin]:
    """Return everything that this user trusts, the oldest first."""
    names = {field.name for field in fields(TrustedOrigin)}
    found: dict[str, TrustedOrigin] = {}
    for folder in _folders():
        for file in folder.glob("*.json"):
            with suppress(OSError, ValueError, TypeError):  # a file that is damaged trusts nothing
                data = parse_object(file.read_bytes(), dict)
                origin = TrustedOrigin(**{name: str(value) for name, value in data.items() if name in names})
                if file.stem == origin.fingerprint:
                    found.setdefault(origin.fingerprint, origin)
    return sorted(found.values(), key=lambda origin: (origin.trusted_at, origin.fingerprint))


def is_fingerprint_trusted(fingerprint: str) -> bool:
    """Return whether this user trusts the code with a fingerprint."""
    return any((folder / f"{fingerprint}.json").is_file() for folder in _folders())


def remove_trusted(names: Sequence[str]) -> list[TrustedOrigin]:
    """Trust some origins no longer, and return them.

    Args:
        names: of each the beginning of its fingerprint, or the path that it was trusted at.

    Raises:
        UsageError: a name is none of a trusted origin, or may be several; then nothing is removed.
        HuntDirectoryError: an entry cannot be removed.
    """
    known = list_trusted()
    chosen: dict[str, TrustedOrigin] = {}
    for name in names:
        place = str(Path(name).resolve())
        found = [origin for origin in known if place == origin.path]
        if not found and len(name) >= _SHORTEST:
            found = [origin for origin in known if origin.fingerprint.startswith(name.lower())]
            if len(found) > 1:
                raise UsageError(f"--remove {name!r} may be {len(found)} origins", fix="give more of the fingerprint")
        if not found:
            raise UsageError(f"--remove {name!r}: no such origin is trusted", fix="crashhunt trust lists them")
        chosen |= {origin.fingerprint: origin for origin in found}
    for fingerprint in chosen:
        for folder in _folders():
            try:
                (folder / f"{fingerprint}.json").unlink(missing_ok=True)
            except OSError as error:
                raise HuntDirectoryError(
                    f"cannot be removed: {error.strerror or error}", fix="make the folder writable", where=str(folder)
                ) from error
    return list(chosen.values())


def _folders() -> list[Path]:
    return [folder / _FOLDER for folder in state_folders()]
