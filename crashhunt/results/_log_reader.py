"""``crashhunt logs``: finds and reads what hunts and trials have printed, wherever it was kept."""

from __future__ import annotations

import os
import time
from contextlib import closing
from typing import TYPE_CHECKING, Literal

from crashhunt.base import layout
from crashhunt.base.errors import HuntDirectoryError
from crashhunt.base.integrity import FileEntry, changed_file, open_at_once
from crashhunt.crashes import files_of
from crashhunt.ledger import Ledger, has_begun
from crashhunt.results._hunt_state import hunt_state, is_hunt

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


LogKind = Literal["run", "error", "state"]

_MAX_LOG_BYTES = 1_000_000  # bytes of one file, from its end


class LogReader:
    """Reads the new lines of the logs of a hunt and its trials.

    Without ``trial``, the logs of all trials are read.
    """

    def __init__(self, hunt: Path, kinds: tuple[LogKind, ...], *, trial: int | None = None) -> None:
        self._hunt = hunt
        self._kinds = kinds
        self._trial = trial
        self._read: dict[Path, int] = {}
        self._files: dict[Path, dict[str, FileEntry]] = {}
        self._told = 0

    def fresh(self) -> Iterator[tuple[str, str]]:
        """Yield the title and the text of lines that are new since the previous call."""
        if self._trial is None:
            if "state" in self._kinds:
                yield from self._states()
            yield from self._texts(self._hunt, "")
        places = (layout.CRASHES, *layout.BESIDE, layout.TRIALS)
        folders = [folder for place in places for folder in (self._hunt / place).glob(layout.SHOWN)]
        for folder in sorted(folders, key=lambda folder: folder.name):
            number = folder.name.partition("-")[0]
            if number.isdecimal() and self._trial in (None, int(number)):
                yield from self._texts(folder, f"trial {int(number)}, ")

    def _states(self) -> Iterator[tuple[str, str]]:
        if not has_begun(self._hunt / layout.LEDGER):
            if is_hunt(self._hunt) and (state := hunt_state(self._hunt)).damaged:
                raise HuntDirectoryError(state.detail)
            return
        with closing(Ledger(self._hunt / layout.LEDGER)) as ledger:
            events = ledger.events()[self._told :]
        self._told += len(events)
        lines = [
            f"{time.strftime('%Y-%m-%d %H:%M:%S', time.localtime(at))}  {state}{f'  {why}' if why else ''}"
            for at, state, why in events
        ]
        if lines:
            yield "state", "\n".join(lines)

    def _texts(self, folder: Path, title: str) -> Iterator[tuple[str, str]]:
        for kind in ("run", "error"):
            path = folder / f"{kind}.log"
            if kind not in self._kinds:
                continue
            try:
                with open(path, "rb", opener=open_at_once) as file:
                    size = file.seek(0, os.SEEK_END)
                    begin = self._read.get(path, max(0, size - _MAX_LOG_BYTES))
                    if size <= begin:
                        continue
                    file.seek(begin)
                    text = file.read(size - begin).decode("utf-8", "replace")
            except OSError:
                continue
            self._read[path] = size
            if text.strip():
                changed = "" if self._as_written(path) else ", which has changed since it was written"
                yield f"{title}{kind}{changed}", text

    def _as_written(self, path: Path) -> bool:
        """Return whether a file still has the digest that its crash recorded; files of hunts have no digest.

        A crash records the digests of all its files, so another file was added later.
        """
        if path.parent not in self._files:
            self._files[path.parent] = files_of(path.parent)
        files = self._files[path.parent]
        return not changed_file(path, files[path.name]) if path.name in files else not files
