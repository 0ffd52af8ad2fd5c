"""For the tests of the dashboard: what a file is like, and a simple object in place of the view of a hunt."""

from __future__ import annotations

import hashlib
from pathlib import Path
from types import SimpleNamespace


def written(path: Path) -> str:
    """What a file or a folder is like, to see that nothing has changed it."""
    found = path.lstat()
    content = hashlib.blake2b(path.read_bytes()).hexdigest() if path.is_file() else ""
    return f"{found.st_mtime_ns} {found.st_size if path.is_file() else 0} {content}"


class View:
    """The view of a hunt, with a row of its own."""

    def __init__(self, name="one", **more):
        self.found = SimpleNamespace(id=name)
        self.path = Path("/hunts") / name
        self.settings = self.sample = self.counts = None
        self.events, self.facts, self.refreshed = [], {}, []
        self.said = {"id": name, "name": name, "dir": str(self.path), "state": "finished", "trials_run": 2}
        vars(self).update(more)

    def row(self):
        return dict(self.said)

    def refresh(self, *, points=False):
        self.refreshed.append(points)
        return SimpleNamespace(state=self.said["state"])

    def unreadable(self):
        return vars(self).get("why", "")
