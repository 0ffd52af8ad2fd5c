"""Files that are there as a whole or not at all."""

from __future__ import annotations

import os
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from crashhunt.errors import HuntDirectoryError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

__all__ = ["cannot_write", "whole_file"]


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a name beside a file to write to, which becomes the file in the end, and is gone after an error.

    Raises:
        HuntDirectoryError: it cannot be written.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise cannot_write(path, error) from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def cannot_write(path: Path, error: OSError) -> HuntDirectoryError:
    """Return the error for a file or folder that cannot be written."""
    return HuntDirectoryError(
        f"cannot be written: {error.strerror or error}", fix="choose another place", where=str(path)
    )
