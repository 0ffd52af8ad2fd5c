"""What can be saved of a hunt that is damaged, in a directory of its own."""

from __future__ import annotations

import shutil
from contextlib import closing, suppress
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import HuntDirectoryError
from crashhunt.base.files import cannot_write, is_empty_folder, sync_folder, sync_tree
from crashhunt.base.temporary import temporary_beside
from crashhunt.hunts._check import intact_snapshots
from crashhunt.hunts._ledger import Ledger, has_begun
from crashhunt.plans import HuntSettings, read_settings, write_settings

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from crashhunt.hunts._check import Checked
    from crashhunt.hunts._data import Row

__all__ = ["salvage"]


def salvage(found: Checked, to: Path) -> dict[str, int]:
    """Copy what is whole of a hunt, so that it goes on there; return how many trials and crashes that were.

    A crash of which the bundle is damaged is left out with its row, and so its trial runs again.

    Args:
        found: the hunt, as it was found.
        to: a new or an empty directory. It gets its name when everything is in it. Where it has exactly what would be
            copied, because an earlier call was killed at its end, nothing is done.

    Raises:
        HuntDirectoryError: it has something else or cannot be written, or nothing says what the hunt was asked.
    """
    if found.kind != "hunt":
        raise HuntDirectoryError(
            f"{str(found.dir)!r} is no hunt, of which parts could be saved", fix="give the directory of a hunt"
        )
    settings = _settings(found.dir)
    try:
        if to.exists() and not is_empty_folder(to):
            if not _is_same(found, settings, to):
                raise HuntDirectoryError("it is there already", fix="give a new directory", where=str(to))
            return {"trials": len(_numbers(found, settings)), "crashes": len(found.crashes)}
        with temporary_beside(to) as building:
            building.mkdir()
            trials = _copy(found, settings, building, to)
            building.rename(to)
            sync_folder(to.absolute().parent)
    except (OSError, shutil.Error) as error:
        wrong = error if not isinstance(error, shutil.Error) else OSError(0, str(error.args[0][0][2]))
        raise cannot_write(to, wrong) from error
    return {"trials": trials, "crashes": len(found.crashes)}


def _copy(found: Checked, settings: HuntSettings, building: Path, to: Path) -> int:
    """Copy everything into a folder that gets the name of the directory later; return how many trials it has."""
    for snapshot in intact_snapshots(found.dir):
        shutil.copytree(snapshot.path, building / layout.SNAPSHOTS / snapshot.digest)
    for name in found.crashes:
        shutil.copytree(found.dir / layout.CRASHES / name, building / layout.CRASHES / name)
    for name in (layout.TRIALS, layout.REQUEST):
        source = found.dir / name
        if source.is_dir():
            shutil.copytree(source, building / name)
        elif source.is_file():
            shutil.copy(source, building / name)
    trials = _copy_rows(found, settings, building)
    sync_tree(building)
    command = ["crashhunt", "check", str(found.dir), "--salvage", str(to)]
    write_settings(building / layout.HUNT, settings, command, like=found.dir / layout.HUNT)
    return trials


def _is_same(found: Checked, settings: HuntSettings, to: Path) -> bool:
    """Return whether a directory has what would be copied, and no hunt has resumed there."""
    with suppress(HuntDirectoryError), closing(Ledger(to / layout.LEDGER)) as ledger:
        facts = ledger.facts()
        return (
            (to / layout.HUNT).is_file()
            and (facts.get("state"), facts.get("detail")) == ("interrupted", _detail(found))
            and ledger.finished() == _numbers(found, settings)
            and {path.name for path in (to / layout.CRASHES).glob(layout.SHOWN)} == set(found.crashes)
        )
    return False


def _detail(found: Checked) -> str:
    return f"what was whole of {found.dir}"


def _settings(hunt: Path) -> HuntSettings:
    try:
        return read_settings(hunt / layout.HUNT)
    except HuntDirectoryError:
        for snapshot in intact_snapshots(hunt):
            return snapshot.settings()
        raise


def _copy_rows(found: Checked, settings: HuntSettings, to: Path) -> int:
    """Copy the rows of trials that are whole, but those of crashes without a bundle."""
    with closing(Ledger(to / layout.LEDGER, writable=True)) as ledger:
        count = 0
        source = found.dir / layout.LEDGER
        if found.trials and has_begun(source):
            with closing(Ledger(source)) as old:
                ledger.propose(old.intact_turns())
                for _, row in _rows(found, settings, old):
                    ledger.copy(row)
                    count += 1
        ledger.enter("interrupted", _detail(found), planned=settings.trials, hunt_seed=settings.seed)
    return count


def _rows(found: Checked, settings: HuntSettings, ledger: Ledger) -> Iterator[tuple[int, Row]]:
    """Yield the numbers and rows of trials that are copied."""
    bundles = {int(name.partition("-")[0]) for name in found.crashes if name.partition("-")[0].isdecimal()}
    for number, row in ledger.intact_rows(sorted(found.trials)):
        if row is not None and (row[2] not in settings.crash_on or number in bundles):
            yield number, row


def _numbers(found: Checked, settings: HuntSettings) -> set[int]:
    """Return the numbers of the trials that are copied."""
    source = found.dir / layout.LEDGER
    if not found.trials or not has_begun(source):
        return set()
    with closing(Ledger(source)) as ledger:
        return {number for number, _ in _rows(found, settings, ledger)}
