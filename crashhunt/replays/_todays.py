"""Whether it is the crashhunt of today that runs a crash again: then workers may be kept warm for many runs."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from crashhunt.base import layout

if TYPE_CHECKING:
    from crashhunt.replays._prepare import Rerun

__all__ = ["is_todays"]


def is_todays(rerun: Rerun) -> bool:
    """Whether the crashhunt that runs is this one, so that it is told of trials as this one tells its own."""
    if not rerun.worker.code:
        return True
    files = rerun.snapshot.manifest["files"]
    ours = {name: entry for name, entry in files.items() if f"/{layout.PACKAGE.name}/executors/" in name}
    return bool(ours) and all(_is_ours(name, entry["size"]) for name, entry in ours.items())


def _is_ours(name: str, size: int) -> bool:
    path = layout.PACKAGE / name.partition(f"/{layout.PACKAGE.name}/")[2]
    try:
        return os.stat(path).st_size == size  # noqa: PTH116
    except OSError:
        return False
