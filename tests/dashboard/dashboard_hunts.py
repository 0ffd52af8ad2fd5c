"""Real hunts for the tests of the dashboard."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path


def hunted(shell) -> None:
    """Five trials of the scenario `loop` that drive too fast, in ``runs/one``: three crashes and a near miss."""
    (shell.folder / "runs").mkdir()
    words = ("--scenario", "loop", "--arg", "speed=18:25", "--seed", "1", "--keep-going", "--near-misses", "1")
    shell.crashhunt("run", "runs/one", "2", "5", "300", *words)


def written(path: Path) -> str:
    """What a file or a folder is like, to see that nothing has changed it."""
    found = path.lstat()
    content = hashlib.blake2b(path.read_bytes()).hexdigest() if path.is_file() else ""
    return f"{found.st_mtime_ns} {found.st_size if path.is_file() else 0} {content}"
