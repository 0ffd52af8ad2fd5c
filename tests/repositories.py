"""Git repositories of tests, which need no settings of the user's git."""

from __future__ import annotations

import subprocess
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

_SETTINGS = ("user.name=T", "user.email=t@example.org", "init.defaultBranch=main", "commit.gpgsign=false")


def git(folder: Path, *words: str) -> str:
    """Run git in a folder; return its output."""
    settings = [word for setting in _SETTINGS for word in ("-c", setting)]
    command = ["git", *settings, *words]
    return subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout


def make_repository(folder: Path) -> None:
    """Make a folder a repository, with one commit of all its files that are not ignored."""
    git(folder, "init", "-q")
    git(folder, "add", ".")
    git(folder, "commit", "-qm", "first")
