"""Salvage: copies the intact part of a damaged hunt to a new directory, in which the hunt can resume."""

from __future__ import annotations

import shutil
from contextlib import closing, suppress
from typing import TYPE_CHECKING, cast

from crashhunt.base import layout
from crashhunt.base.errors import HuntDirectoryError
from crashhunt.base.files import cannot_write, is_empty_folder, sync_folder, sync_tree
from crashhunt.base.temporary import new_folder
from crashhunt.hunts._hunt_file_check import intact_snapshots
from crashhunt.ledger import Ledger, has_begun
from crashhunt.plans import read_settings, write_settings

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from crashhunt.hunts._hunt_file_check import Checked
    from crashhunt.ledger import Noted, Row
    from crashhunt.plans import HuntSettings

# How the copied trials were drawn, and which of them wait for their audit, which their rows do not show. Without its
# sampler's version, a hunt cannot resume.
_KEPT_FACTS = frozenset((
    "audits_left", "code_versions", "crash_on", "disturb", "independent", "lag", "origins", "plain_origin", "replanned",
    "sampler_version", "under_way",
))  # fmt: skip
_DROPPED_FACTS = frozenset(("dropped", "dropped_at_fault", "dropped_judged"))  # about crashes without a bundle


def salvage(found: Checked, to: Path) -> dict[str, int]:
    """Copy the intact part of a hunt, so that the copy can resume; return the number of trials and of crashes.

    A crash with a damaged bundle is skipped together with its row, so its trial runs again.

    Args:
        found: result of the check of the hunt.
        to: path of a new or empty directory. The copy is moved to this path when it is complete. If the directory
            already contains exactly the copied data, because an earlier call was killed at its end, the call does
            nothing.

    Raises:
        HuntDirectoryError: the directory has other contents or cannot be written, or the settings of the hunt are lost.
    """
    if found.kind != "hunt":
        raise HuntDirectoryError(
            f"{str(found.dir)!r} has no part of a hunt that can be recovered", fix="give the directory of a hunt"
        )
    settings = _settings(found.dir)
    try:
        if to.exists() and not is_empty_folder(to):
            if not _is_same(found, settings, to):
                raise HuntDirectoryError("the directory exists already", fix="give a new directory", where=str(to))
            return {"trials": len(_copied_trials(found, settings)), "crashes": found.crash_count}
        with new_folder(to) as building:
            trials = _copy(found, settings, building, to)
        sync_folder(to.absolute().parent, to)
    except (OSError, shutil.Error) as error:
        wrong = error if not isinstance(error, shutil.Error) else OSError(0, str(error.args[0][0][2]))
        raise cannot_write(to, wrong) from error
    return {"trials": trials, "crashes": found.crash_count}


def _copy(found: Checked, settings: HuntSettings, building: Path, to: Path) -> int:
    """Copy all files into a temporary folder, which is moved later; return the number of trials in it."""
    for snapshot in intact_snapshots(found.dir):
        shutil.copytree(snapshot.path, building / layout.SNAPSHOTS / snapshot.digest)
    for name in found.crashes:
        shutil.copytree(found.dir / layout.CRASHES / name, building / layout.CRASHES / name)
    for name in (layout.TRIALS, layout.REQUEST, layout.NOTES):
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
    """Return whether a directory already contains the data to copy, and no hunt has resumed in it."""
    with suppress(HuntDirectoryError), closing(Ledger(to / layout.LEDGER)) as ledger:
        facts = ledger.facts()
        return (
            (to / layout.HUNT).is_file()
            and (facts.get("state"), facts.get("detail")) == ("interrupted", _detail(found))
            and ledger.finished() == _copied_trials(found, settings)
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
            return snapshot.settings
        raise


def _copy_rows(found: Checked, settings: HuntSettings, to: Path) -> int:
    """Copy the intact rows of trials, except those of crashes whose bundle is missing or damaged."""
    with closing(Ledger(to / layout.LEDGER, writable=True)) as ledger:
        count = 0
        source = found.dir / layout.LEDGER
        kept: Noted = {}
        if found.trials and has_begun(source):
            with closing(Ledger(source)) as old:
                try:
                    names = _KEPT_FACTS | _DROPPED_FACTS if found.dropped else _KEPT_FACTS
                    kept = cast("Noted", {name: fact for name, fact in old.facts().items() if name in names})
                except HuntDirectoryError:
                    kept = {"replanned": True}  # it is not known, and True forbids a p-value
                ledger.propose(old.intact_turns())
                for _, row in _copied_rows(found, settings, old):
                    ledger.copy(row)
                    count += 1
        ledger.note(**kept)
        ledger.enter("interrupted", _detail(found), planned=settings.trials, hunt_seed=settings.seed)
    return count


def _copied_rows(found: Checked, settings: HuntSettings, ledger: Ledger) -> Iterator[tuple[int, Row]]:
    """Yield the number and the row of each trial that is copied."""
    bundles = {int(name.partition("-")[0]) for name in found.crashes if name.partition("-")[0].isdecimal()}
    for number, row in ledger.intact_rows(sorted(found.trials)):
        if row is not None and (row[2] not in settings.crash_on or number in bundles or number in found.dropped):
            yield number, row


def _copied_trials(found: Checked, settings: HuntSettings) -> set[int]:
    """Return the numbers of the trials that are copied."""
    source = found.dir / layout.LEDGER
    if not found.trials or not has_begun(source):
        return set()
    with closing(Ledger(source)) as ledger:
        return {number for number, _ in _copied_rows(found, settings, ledger)}
