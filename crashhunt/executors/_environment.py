"""The environment variables of every process that runs trials: fixed hashes, one thread a library, whose code."""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout

if TYPE_CHECKING:
    from crashhunt.episode import WorkerSettings

__all__ = ["has_fork_server", "snapshot_environment", "worker_environment"]

_KEPT_SNAPSHOTS = 16  # of which compiled code is kept; some 3 MB each


def worker_environment() -> dict[str, str]:
    """Return the environment variables that make a worker's results depend on its trial alone.

    Hashes of strings are fixed, and libraries use a single thread. With a worker on every core, more threads would
    compete for the cores. Parallel sums are also not bit-identical from run to run.
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
    """Return the environment of a process in which crashhunt itself comes from the snapshot too.

    Compiled code does not lie in the snapshot, where it would pass for the code. It lies with the caches of this user,
    by the digest of the snapshot.
    """
    if not settings.code:
        return {**os.environ, **worker_environment()}
    paths = os.pathsep.join(filter(None, (*settings.code, os.environ.get("PYTHONPATH"))))
    ours = {"PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1"}
    if settings.sealed is None and (compiled := _compiled(settings)) is not None:
        ours |= {"PYTHONPYCACHEPREFIX": str(compiled), "PYTHONDONTWRITEBYTECODE": ""}
    return {**os.environ, **worker_environment(), **ours}


def has_fork_server(settings: WorkerSettings) -> bool:
    """Whether the crashhunt of the settings has a fork server and supervisors: later than 0.1.0, or this one."""
    package = [Path(folder) / layout.PACKAGE.name for folder in settings.code]
    return all((found / "executors" / "_fork_server.py").is_file() for found in package if found.is_dir())


def _compiled(settings: WorkerSettings) -> Path | None:
    """The folder for the compiled code of a snapshot; None where there is no place for it."""
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
    for old in others[_KEPT_SNAPSHOTS:]:
        with suppress(OSError):
            shutil.rmtree(old)
    return found
