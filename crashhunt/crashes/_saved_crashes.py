"""Finds the crashes that a hunt has saved, and the crash that the user names."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import BundleError
from crashhunt.base.text import listed, near_path, one_of
from crashhunt.crashes._bundle import Bundle, read_bundle

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


def list_bundles(directory: Path) -> list[Bundle]:
    """Return the crashes of a hunt, in order of their trials."""
    return [read_bundle(folder) for folder in crash_folders(directory)]


def list_near_misses(directory: Path) -> list[Bundle]:
    """Return the near misses of a hunt, the most dangerous first."""
    found = [read_bundle(folder) for folder in crash_folders(directory, layout.NEAR_MISSES)]
    return sorted(found, key=lambda bundle: (-(bundle.result.danger or 0.0), bundle.result.spec.number))


def crash_folders(directory: Path, place: str = layout.CRASHES) -> list[Path]:
    """Return the folders of crashes, also without ``crash.json``, but not the folders of minimized crashes.

    Args:
        directory: directory of the hunt.
        place: subfolder of the hunt's directory that contains the crashes.
    """
    folders = (directory / place).glob(layout.SHOWN)
    found = (path for path in folders if path.is_dir() and not path.name.endswith(layout.SMALL))
    return sorted(path for path in found if re.match(r"\d+-", path.name) or (path / layout.CRASH).exists())


def find_bundle(directory: Path, crash: str = "") -> Bundle:
    """Return one crash or near miss of a hunt: the one that the user names, or else the crash with the fewest steps.

    If the hunt has no crash, its most critical near miss is returned. Without near misses, a crash found by a fork is
    returned, or else a minimized crash, as in an exported file.

    Args:
        directory: directory of the hunt, or of one bundle.
        crash: The id of a crash, of a near miss, or of a crash found by a robustness probe or a branch. The beginning
            of an id or the number of the trial suffices. A minimized crash needs its whole id.

    Raises:
        BundleError: the hunt has no such crash.
    """
    if (directory / layout.CRASH).is_file() and not crash:
        return read_bundle(directory)
    small = directory / layout.CRASHES / crash
    if crash.endswith(layout.SMALL) and small.parent == directory / layout.CRASHES and small.is_dir():
        return read_bundle(small)
    if crash:
        # What copies have found of a trial has its number as well, and may have the name of a crash.
        found = (_readable(directory, crash, places) for places in _FOLDERS_BY_PRIORITY)
        bundles = next((some for some in found if any(_may_be(bundle, crash) for bundle in some)), None)
        bundles = bundles if bundles is not None else _readable(directory, crash, _FOLDERS_BY_PRIORITY[0])
    else:
        bundles = list_bundles(directory) or list_near_misses(directory)[:1] or _of_copies(directory)
        bundles = bundles or _minimized_sources(directory)
    if not bundles:
        if directory.is_file():
            raise BundleError(
                f"{str(directory)!r} is a file, not the directory of a hunt",
                fix="unpack it into a new folder if crashhunt export wrote it, and give that folder",
            )
        if not directory.is_dir():
            fix = f"{near_path(directory, '.zip', with_file=(layout.HUNT, layout.CRASH))}give the directory of a hunt"
            raise BundleError(f"{str(directory)!r} does not exist", fix=fix)
        # The directory of a gate or a suite has those of its hunts.
        hunts = [str(path.parent) for path in sorted(directory.glob(f"*/{layout.HUNT}"))]
        fix = f"give the directory of a hunt that found one{f': {listed(hunts)}' if hunts else ''}"
        raise BundleError("no crash was saved here", fix=fix, where=str(directory))
    if not crash:
        return min(bundles, key=lambda bundle: (bundle.result.steps, bundle.result.spec.number))
    return _named(bundles, crash, directory)


_FOLDERS_BY_PRIORITY = ((layout.CRASHES, layout.NEAR_MISSES), (layout.PROBES,), (layout.BRANCHES,))


def _of_copies(directory: Path) -> list[Bundle]:
    return [
        read_bundle(folder) for place in (layout.PROBES, layout.BRANCHES) for folder in crash_folders(directory, place)
    ]


def _minimized_sources(directory: Path) -> list[Bundle]:
    found = sorted((directory / layout.CRASHES).glob(f"*{layout.SMALL}"))
    return [read_bundle(path) for path in found if (path / layout.CRASH).is_file()]


def _may_be(bundle: Bundle, crash: str) -> bool:
    return bundle.id.startswith(crash) or (crash.isdecimal() and bundle.result.spec.number == int(crash))


def _readable(directory: Path, crash: str, places: Sequence[str]) -> list[Bundle]:
    """Return the crashes of a hunt that can be read; a damaged crash raises an error only if the user names it."""
    found = []
    for path in (folder for place in places for folder in crash_folders(directory, place)):
        try:
            found.append(read_bundle(path))
        except BundleError:
            name = path.name
            if name.startswith(crash) or name.partition("-")[0].lstrip("0") == crash.lstrip("0"):
                raise
    return found


def _named(bundles: Sequence[Bundle], crash: str, directory: Path) -> Bundle:
    """Return the crash that the user names by its id, its trial number or the beginning of its id, in this order."""
    number = int(crash) if crash.isdecimal() else None
    for meant in (
        [bundle for bundle in bundles if bundle.id == crash],
        [bundle for bundle in bundles if bundle.result.spec.number == number],
        [bundle for bundle in bundles if bundle.id.startswith(crash)],
    ):
        if len(meant) == 1:
            return meant[0]
        if meant:
            fix = f"give one of {listed(bundle.id for bundle in meant)}"
            raise BundleError(f"{crash!r} matches several crashes", fix=fix, where=str(directory))
    fix = one_of(crash, (bundle.id for bundle in bundles))
    raise BundleError(f"there is no crash {crash!r}", fix=fix, where=str(directory))
