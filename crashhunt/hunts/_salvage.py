"""What can be saved of a hunt that is damaged, in a directory of its own."""

from __future__ import annotations

import shutil
from contextlib import closing
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import HuntDirectoryError
from crashhunt.base.files import cannot_write, sync_tree
from crashhunt.hunts._check import intact_snapshots
from crashhunt.hunts._ledger import Ledger, has_begun
from crashhunt.plans import HuntSettings, read_settings, write_settings

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.hunts._check import Checked

__all__ = ["salvage"]


def salvage(found: Checked, to: Path) -> dict[str, int]:
    """Copy what is whole of a hunt, so that it goes on there; return how many trials and crashes that were.

    A crash of which the bundle is damaged is left out with its row, and so its trial runs again.

    Args:
        found: the hunt, as it was found.
        to: a new directory.

    Raises:
        HuntDirectoryError: it is there already or cannot be written, or nothing says what the hunt was asked.
    """
    if found.kind != "hunt":
        raise HuntDirectoryError(
            f"{str(found.dir)!r} is no hunt, of which parts could be saved", fix="give the directory of a hunt"
        )
    settings = _settings(found.dir)
    try:
        to.mkdir()
    except FileExistsError:
        raise HuntDirectoryError("it is there already", fix="give a new directory", where=str(to)) from None
    except OSError as error:
        raise cannot_write(to, error) from error
    try:
        for snapshot in intact_snapshots(found.dir):
            shutil.copytree(snapshot.path, to / layout.SNAPSHOTS / snapshot.digest)
        for name in found.crashes:
            shutil.copytree(found.dir / layout.CRASHES / name, to / layout.CRASHES / name)
        for name in (layout.TRIALS, layout.REQUEST):
            source = found.dir / name
            if source.is_dir():
                shutil.copytree(source, to / name)
            elif source.is_file():
                shutil.copy(source, to / name)
        trials = _copy_rows(found, settings, to)
        sync_tree(to)
        command = ["crashhunt", "check", str(found.dir), "--salvage", str(to)]
        write_settings(to / layout.HUNT, settings, command, like=found.dir / layout.HUNT)
    except (OSError, shutil.Error) as error:
        wrong = error if not isinstance(error, shutil.Error) else OSError(0, str(error.args[0][0][2]))
        raise cannot_write(to, wrong) from error
    return {"trials": trials, "crashes": len(found.crashes)}


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
            bundles = {int(name.partition("-")[0]) for name in found.crashes if name.partition("-")[0].isdecimal()}
            with closing(Ledger(source)) as old:
                ledger.propose(old.intact_turns())
                for number, row in old.intact_rows(sorted(found.trials)):
                    if row is not None and (row[2] not in settings.crash_on or number in bundles):
                        ledger.copy(row)
                        count += 1
        detail = f"what was whole of {found.dir}"
        ledger.enter("interrupted", detail, planned=settings.trials, hunt_seed=settings.seed)
    return count
