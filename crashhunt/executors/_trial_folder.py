"""The scratch folder of a slot: one trial after another gets it, with the files that the supervisor has opened in it.

The process of a trial may delete or replace these files. The supervisor owns their descriptors, and restores them.
"""

from __future__ import annotations

import os
import shutil
import time
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.episode import scratch_of
from crashhunt.recording import BlackBoxFile

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

_MAX_RESTORED_OUTPUT_BYTES = 64 << 20  # bytes of a run.log that are written again where an agent has removed the file


class TrialFolder:
    """The black box, the output and the stack of the trial that a slot runs.

    Args:
        scratch: scratch folder of the hunt.
        check_host: function that raises a `HostError` if trials can no longer run on this machine.
    """

    def __init__(self, scratch: Path, check_host: Callable[[], None]) -> None:
        self._scratch = scratch
        self._check_host = check_host
        self._box: BlackBoxFile | None = None
        self._output = self._stack = -1
        self._folder: Path | None = None
        self._made = 0

    @property
    def has_stack(self) -> bool:
        """Whether the process of the trial has written its stack."""
        return os.fstat(self._stack).st_size > 0

    def prepare(self, number: int) -> tuple[BlackBoxFile, Path]:
        """Provide a scratch folder for the trial: that of the last trial, whose pages are in memory, or a new one."""
        folder = scratch_of(self._scratch, number)
        _remove(folder)  # of an earlier attempt at the same trial
        if self._folder is None or self._box is None or not self._box.is_reusable() or not self.is_whole(self._folder):
            self._make_folder()
        assert self._folder is not None
        assert self._box is not None
        os.ftruncate(self._output, 0)
        os.ftruncate(self._stack, 0)
        self._box.begin(trial=number, started=time.monotonic())
        os.rename(self._folder, folder)  # noqa: PTH104 - Path.rename builds a path for nothing
        self._folder = folder
        return self._box, folder

    def release(self) -> None:
        """Leave the folder of the present trial to the hunt; the next trial gets another folder."""
        self._folder = None

    def _make_folder(self) -> None:
        if self._box is not None:
            self._box.close()
            os.close(self._output)
            os.close(self._stack)
            self._box = None
        if self._folder is not None:
            _remove(self._folder)
        self._made += 1
        folder = self._scratch / f"new-{os.getpid()}-{self._made}"
        _remove(folder)
        self._restore_scratch()
        folder.mkdir()
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        self._output = os.open(folder / layout.RUN_LOG, flags, 0o644)
        self._stack = os.open(folder / layout.STACK, flags, 0o644)
        self._box = BlackBoxFile(folder / layout.BLACK_BOX)
        self._folder = folder

    def is_whole(self, folder: Path) -> bool:
        """Return whether a folder contains the files that this process has opened; an agent may have deleted them."""
        assert self._box is not None
        opened = {
            layout.BLACK_BOX: self._box.identity,
            layout.RUN_LOG: os.fstat(self._output),
            layout.STACK: os.fstat(self._stack),
        }
        try:
            return all(os.path.samestat(os.stat(folder / name), found) for name, found in opened.items())  # noqa: PTH116
        except OSError:
            return False

    def restore(self, number: int) -> None:
        """Restore the scratch folder of a trial: the files of this process, and no other file."""
        folder = scratch_of(self._scratch, number)
        if self.is_whole(folder):
            for entry in os.scandir(folder):
                if entry.name not in (layout.BLACK_BOX, layout.RUN_LOG, layout.STACK):
                    _remove(folder / entry.name)  # the next trial gets this folder
            return
        _remove(folder)
        self._restore_scratch()
        folder.mkdir()
        assert self._box is not None
        self._box.copy_to(folder / layout.BLACK_BOX)
        for name, descriptor in ((layout.RUN_LOG, self._output), (layout.STACK, self._stack)):
            (folder / name).write_bytes(os.pread(descriptor, _MAX_RESTORED_OUTPUT_BYTES, 0))

    def _restore_scratch(self) -> None:
        """Create the scratch folder again if an agent has deleted it, but not the directory of a deleted hunt."""
        if not self._scratch.is_dir():
            self._check_host()
            self._scratch.mkdir(parents=True)


def _remove(path: Path) -> None:
    if path.is_symlink() or path.is_file():
        path.unlink(missing_ok=True)
    elif path.exists():
        shutil.rmtree(path, ignore_errors=True)
