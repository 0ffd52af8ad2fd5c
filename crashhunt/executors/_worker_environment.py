"""The environment variables of every process that runs trials: fixed hashes, one thread a library, whose code."""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.temporary import TemporaryFolder

if TYPE_CHECKING:
    from crashhunt.episode import WorkerSettings


_MAX_COMPILED_SNAPSHOTS = 16  # of which compiled code is kept; some 3 MB each


def worker_environment() -> dict[str, str]:
    """Return the environment variables with which a worker's results depend only on its trial.

    Hashes of strings are fixed, and libraries use a single thread. A worker runs on every core, so more threads would
    compete for the cores. In addition, parallel sums are not bit-identical from run to run.
    """
    names = (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "NUMEXPR_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
    )
    return {"PYTHONHASHSEED": "0", **dict.fromkeys(names, "1")}


def snapshot_environment(settings: WorkerSettings) -> dict[str, str]:
    """Return the environment of a process that uses the crashhunt of the snapshot.

    Compiled code must not lie in the snapshot, because it would then count as code. Compiled code lies in the cache of
    this user, in a folder named by the snapshot's digest.
    """
    if not settings.code:
        return {**os.environ, **worker_environment()}
    code = (_without_separator(folder) for folder in settings.code)
    paths = os.pathsep.join(filter(None, (*code, os.environ.get("PYTHONPATH"))))
    ours = {"PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1"}
    if settings.sealed is None and (compiled := _compiled(settings)) is not None:
        ours |= {"PYTHONPYCACHEPREFIX": str(compiled), "PYTHONDONTWRITEBYTECODE": ""}
    return {**os.environ, **worker_environment(), **ours}


def _without_separator(folder: str) -> str:
    """Return the path of a folder, through a link if PYTHONPATH cannot contain it, as below ``hunt-12:30``."""
    if os.pathsep not in folder:
        return folder
    parent, name = os.path.split(folder)
    return str(_folder_with_link(parent).path / "link" / name)


@cache
def _folder_with_link(target: str) -> TemporaryFolder:
    """Return a folder with a link, for as long as this process runs."""
    found = TemporaryFolder("code")
    (found.path / "link").symlink_to(target)
    return found


def _compiled(settings: WorkerSettings) -> Path | None:
    """Return the folder for the compiled code of a snapshot; None if no such folder can be used."""
    parts = Path(settings.code[0]).parts
    if layout.SNAPSHOTS not in parts:
        return None
    digest = parts[len(parts) - 1 - parts[::-1].index(layout.SNAPSHOTS) + 1 :][:1]
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "crashhunt" / "compiled"
    try:
        cache.mkdir(parents=True, exist_ok=True, mode=0o700)
        found = cache / (digest[0] if digest else "")
        found.mkdir(exist_ok=True)
        os.utime(found)
        others = sorted(cache.iterdir(), key=lambda path: path.stat().st_mtime, reverse=True)
    except (OSError, RuntimeError, IndexError):  # a user without a home
        return None
    for old in others[_MAX_COMPILED_SNAPSHOTS:]:
        with suppress(OSError):
            shutil.rmtree(old)
    return found
