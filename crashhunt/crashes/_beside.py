"""The files beside ``crash.json``, and beside ``params.json`` of a trial that is kept for another reason."""

from __future__ import annotations

import shutil
from contextlib import suppress
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.integrity import FILES, changed_file, describe_files, digest_of_data, read_object, typed
from crashhunt.crashes._data import Protected

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.base.integrity import FileEntry
    from crashhunt.trial import TrialResult

__all__ = ["collect_output", "files_beside", "files_of", "read_params", "see_that_it_is_whole"]


def see_that_it_is_whole(data: Protected) -> None:
    """See that what says what it was is what was written.

    Raises:
        ValueError: it is not.
    """
    typed(data, {"integrity": str, "files": FILES})
    said = data.pop("integrity")
    if digest_of_data(data) != said:
        raise ValueError("it has changed since it was written")
    for name, entry in data["files"].items():
        typed(entry, {"size": int, "blake2b": str})
        if "/" in name or name in ("", ".", ".."):
            raise ValueError(f"the file {name!r} is not beside it")


def files_of(folder: Path) -> dict[str, FileEntry]:
    """Return size and digest of what a crash or a kept trial came with, where that was written down and can be read."""
    for name in (layout.CRASH, layout.PARAMS):
        with suppress(OSError, ValueError):
            data = read_object(folder / name, Protected)
            if "integrity" in data:
                see_that_it_is_whole(data)
                return dict(data["files"])
    return {}


def files_beside(folder: Path) -> dict[str, FileEntry]:
    """Return size and digest of every file of a folder but the one that says so."""
    found = describe_files(folder)
    return {
        name: entry for name, entry in found.items() if name not in (layout.CRASH, layout.PARAMS) and name[0] != "."
    }


def read_params(folder: Path) -> list[str]:
    """Return what of a trial that was kept is not as it was written."""
    try:
        data = read_object(folder / layout.PARAMS, Protected)
        if "integrity" in data:  # which earlier versions did not write
            see_that_it_is_whole(data)
        files = data.get("files", {}).items()
        return [f"{name} {wrong}" for name, entry in files if (wrong := changed_file(folder / name, entry))]
    except (OSError, ValueError) as error:
        return [f"params.json: {error.strerror if isinstance(error, OSError) else error}"]


def collect_output(result: TrialResult, scratch: Path, target: Path) -> None:
    """Copy what a trial has printed, and write down how it failed."""
    run_log = scratch / layout.RUN_LOG
    if run_log.is_file():
        shutil.copyfile(run_log, target / layout.RUN_LOG)
    failure = result.failure
    if failure is not None:
        parts = (f"{failure.kind}: {failure.message}", failure.traceback, failure.last_output)
        text = "\n\n".join(part.rstrip() for part in parts if part.strip())
        (target / layout.ERROR_LOG).write_text(text + "\n", encoding="utf-8", errors="replace")
