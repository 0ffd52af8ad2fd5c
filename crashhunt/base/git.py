"""The environment in which git is asked about a folder, and not about the repository whose hook this runs in."""

from __future__ import annotations

import os

__all__ = ["environment_of_git"]

# Those of `git rev-parse --local-env-vars` that name a repository, or parts of it. Git sets them for its hooks and for
# `rebase --exec`, and they go before the folder that it is told to be in.
_OF_A_REPOSITORY = frozenset({
    "GIT_ALTERNATE_OBJECT_DIRECTORIES", "GIT_COMMON_DIR", "GIT_DIR", "GIT_GRAFT_FILE", "GIT_IMPLICIT_WORK_TREE",
    "GIT_INDEX_FILE", "GIT_OBJECT_DIRECTORY", "GIT_PREFIX", "GIT_SHALLOW_FILE", "GIT_WORK_TREE",
})  # fmt: skip


def environment_of_git() -> dict[str, str]:
    """Return the variables of this process without those that name a repository."""
    return {name: value for name, value in os.environ.items() if name not in _OF_A_REPOSITORY}
