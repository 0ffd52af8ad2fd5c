"""Git queries about a folder, independent of the repository whose hook may run this process."""

from __future__ import annotations

import os
import subprocess
from functools import lru_cache
from pathlib import Path

__all__ = ["environment_of_git", "tracked_files", "work_tree"]

_TIMEOUT_S = 60

# Git sets these variables for its hooks and for `rebase --exec`, and they take precedence over `-C FOLDER`. They are
# the ones of `git rev-parse --local-env-vars` that name a repository or parts of it.
_OF_A_REPOSITORY = frozenset({
    "GIT_ALTERNATE_OBJECT_DIRECTORIES", "GIT_COMMON_DIR", "GIT_DIR", "GIT_GRAFT_FILE", "GIT_IMPLICIT_WORK_TREE",
    "GIT_INDEX_FILE", "GIT_OBJECT_DIRECTORY", "GIT_PREFIX", "GIT_SHALLOW_FILE", "GIT_WORK_TREE",
})  # fmt: skip


def environment_of_git() -> dict[str, str]:
    """Return the environment variables of this process without those that name a repository."""
    return {name: value for name, value in os.environ.items() if name not in _OF_A_REPOSITORY}


def work_tree(folder: Path) -> Path | None:
    """Return the top of the git work tree of a folder, without symbolic links; None where there is none.

    Git refuses a work tree that belongs to another user; the result is None for it too.
    """
    found = _run_git(folder, "rev-parse", "--show-toplevel")
    return Path(os.path.realpath(os.fsdecode(found.rstrip(b"\n")))) if found else None


def tracked_files(top: Path) -> frozenset[str]:
    """Return the names of all files that git tracks in a work tree, relative to its top, with ``/``."""
    found = _run_git(top, "rev-parse", "--absolute-git-dir")
    if not found:
        return frozenset()
    try:
        status = os.stat(os.path.join(found.rstrip(b"\n"), b"index"))  # noqa: PTH116, PTH118 - bytes of any encoding
    except OSError:
        return frozenset()
    return _tracked_files(top, (status.st_ino, status.st_size, status.st_mtime_ns))


@lru_cache(maxsize=4)
def _tracked_files(top: Path, _index: tuple[int, int, int]) -> frozenset[str]:
    """List the files; a corpus has hundreds of cases, so list them again only when the index has changed."""
    found = _run_git(top, "ls-files", "-z") or b""
    return frozenset(map(os.fsdecode, found.split(b"\0")))


def _run_git(folder: Path, *words: str) -> bytes | None:
    # The configuration of a repository may name a program that watches its files: do not run it.
    command = ["git", "--no-optional-locks", "-c", "core.fsmonitor=false", "-C", str(folder), *words]
    try:
        done = subprocess.run(
            command, capture_output=True, stdin=subprocess.DEVNULL, check=False, timeout=_TIMEOUT_S,
            env=environment_of_git(),
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None
