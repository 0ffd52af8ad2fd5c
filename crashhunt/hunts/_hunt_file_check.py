"""Checks that the files of hunts, suites, crashes and exported crashes are complete and unchanged."""

from __future__ import annotations

import json
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from crashhunt.base import layout
from crashhunt.base.codec import Serializable
from crashhunt.base.errors import BundleError, CrashhuntError, HuntDirectoryError, remedy
from crashhunt.base.files import FREE_SPACE
from crashhunt.base.older_versions import HOW_TO_READ
from crashhunt.base.process_owners import has_ended, owner_in
from crashhunt.base.resources import error_of_next_files, limit_behind
from crashhunt.crashes import Bundle, read_bundle, read_params, unreadable_notes
from crashhunt.ledger import Ledger, has_begun
from crashhunt.plans import HuntSettings, read_settings
from crashhunt.results import find_hunts, hunt_state, is_hunt
from crashhunt.snapshots import Snapshot
from crashhunt.trial import TrialResult

if TYPE_CHECKING:
    from collections.abc import Iterator


_MAX_SHOWN = 5
_MAX_OPEN_FILES = 4  # at a time: a folder, and the ledger with its write-ahead log and shared memory


@dataclass(frozen=True, slots=True)
class CheckFinding(Serializable):
    """A problem that the check has found."""

    where: str  # path of the file or folder
    what: str  # description of the problem
    lost: str = ""  # the data that are lost, as text; empty if nothing is lost
    fix: str = ""  # how to recover the remaining data
    damaged: bool = True  # whether the problem is damage; otherwise it is harmless


@dataclass(slots=True)
class Checked(Serializable):
    """The result of the check of a hunt, a crash or an exported crash."""

    dir: Path  # path of the hunt or crash
    kind: Literal["hunt", "crash", "file"] = "hunt"  # either ``hunt``, ``crash`` or ``file``
    # the numbers of the trials whose rows are unchanged since they were written
    trials: set[int] = field(default_factory=set)
    damaged_trials: set[int] = field(default_factory=set)  # reason for each damaged trial
    # the names of the bundles that are unchanged since they were written
    crashes: list[str] = field(default_factory=list)
    # the names of the bundles of near misses among them, and of a hunt
    near_misses: list[str] = field(default_factory=list)
    damaged_crashes: list[str] = field(default_factory=list)  # reason for each damaged crash
    findings: list[CheckFinding] = field(default_factory=list)  # the problems that were found
    # the trials whose bundles were deleted, because shorter crashes of their type were kept
    dropped: set[int] = field(default_factory=set)

    json_keys = (
        "dir", "kind", "fine", "protected", "trials=trial_count", "damaged_trials", "crashes", "damaged_crashes",
        "findings",
    )  # fmt: skip

    def report(self, where: Path | str, what: str, *, lost: str = "", fix: str = "", damaged: bool = True) -> None:
        """Add a problem; the arguments are those of `CheckFinding`."""
        self.findings.append(CheckFinding(where=str(where), what=what, lost=lost, fix=fix, damaged=damaged))

    @property
    def minimized(self) -> int:
        """The number of minimized crashes, which lie next to their original crashes."""
        return sum(name.endswith(layout.SMALL) for name in self.crashes) if self.kind == "hunt" else 0

    @property
    def crash_count(self) -> int:
        """The number of unchanged crashes, without minimized crashes and near misses."""
        return len(set(self.crashes) - set(self.near_misses)) - self.minimized

    @property
    def fine(self) -> bool:
        """Whether no data are damaged."""
        return not any(finding.damaged for finding in self.findings)

    @property
    def trial_count(self) -> int:
        """The number of trials whose rows are unchanged."""
        return len(self.trials)

    @property
    def protected(self) -> bool:
        """Whether digests protect the trials: those of every ledger of format version 1 do."""
        return True


def check(directory: Path) -> list[Checked]:
    """Check a hunt, the hunts of a suite, a crash, or an exported file.

    Raises:
        HuntDirectoryError: the directory or file is none of these.
        CrashhuntError: the limit on open files is too low. A file that cannot be opened would count as damaged.
    """
    if no_file := error_of_next_files(_MAX_OPEN_FILES):
        fix = limit_behind(no_file) or remedy(no_file)
        raise CrashhuntError(f"the check cannot open files: {no_file.strerror}", fix=fix, where=str(directory))
    if directory.is_file():
        return [_check_file(directory)]
    if (directory / layout.CRASH).exists():
        found = Checked(directory, "crash")
        bundle = _check_bundle(found, directory)
        if bundle is not None:
            _check_snapshot(found, bundle.hunt / layout.SNAPSHOTS / bundle.snapshot, bundle.id)
        return [found]
    return [_check_hunt(hunt) for hunt in find_hunts(directory)]


def intact_snapshots(hunt: Path) -> Iterator[Snapshot]:
    """Yield the snapshots of a hunt that are unchanged since they were written."""
    for path in sorted((hunt / layout.SNAPSHOTS).glob(layout.SHOWN)):
        with suppress(CrashhuntError):
            snapshot = Snapshot(path)
            if not _snapshot_faults(snapshot):
                yield snapshot


def _check_file(path: Path) -> Checked:
    from crashhunt.crashes import open_archive

    found = Checked(path, "file")
    try:
        with open_archive(path) as archive:
            inside = Checked(archive.directory)
            _check_settings(inside, archive.directory)
            _check_parts(inside, archive.directory)
            found.crashes, found.damaged_crashes = inside.crashes, inside.damaged_crashes
            found.findings += inside.findings
            if not inside.crashes and not inside.damaged_crashes:
                found.report(path, "there is no crash in it", lost="the crash", fix="export it again")
    except BundleError as error:
        if error.fix == HOW_TO_READ:
            raise
        found.report(path, error.message, lost="the crash", fix=error.fix)
    return found


def _check_hunt(hunt: Path) -> Checked:
    found = Checked(hunt)
    settings = _check_settings(found, hunt) if (hunt / layout.HUNT).exists() or has_begun(_ledger(hunt)) else None
    rows = _check_ledger(found, hunt, settings)
    bundles = _check_parts(found, hunt)
    if rows is not None:
        _compare(found, rows, bundles, settings)
    _find_leftovers(found, hunt)
    if lines := unreadable_notes(hunt):
        shown = f"lines {', '.join(map(str, lines[:_MAX_SHOWN]))}" if lines[0] else "the file"
        fix = "add the notes again with crashhunt note, and remove these lines"
        found.report(hunt / layout.NOTES, f"{shown} cannot be read as notes", lost="those notes", fix=fix)
    return found


def _check_settings(found: Checked, hunt: Path) -> HuntSettings | None:
    try:
        return read_settings(hunt / layout.HUNT)
    except HuntDirectoryError as error:
        fix = "copy the hunt.toml of a snapshot there"
        found.report(hunt / layout.HUNT, error.message, lost="what the hunt was asked", fix=fix)
    for snapshot in intact_snapshots(hunt):
        with suppress(CrashhuntError):
            return snapshot.settings
    return None


def _ledger(hunt: Path) -> Path:
    return hunt / layout.LEDGER


def _check_ledger(found: Checked, hunt: Path, settings: HuntSettings | None) -> dict[int, TrialResult] | None:
    """Check the rows of the ledger; return its crashes, or an empty result if the ledger cannot be read."""
    path = _ledger(hunt)
    if not has_begun(path):
        if (hunt / layout.CRASHES).is_dir() and not (hunt / layout.CASE).is_file():
            found.report(path, "is missing", lost="all trials but the crashes", fix=_RESUME_FIX)
        return None
    try:
        with closing(Ledger(path)) as ledger:
            if not ledger.sealed and hunt_state(hunt).state != "running":
                found.report(path, "its writer was killed; a missing trial would not be detected", damaged=False)
            try:
                _read_everything(ledger)
                found.trials = ledger.finished()
                dropped = ledger.facts().get("dropped") or {}
                found.dropped = {number for numbers in dropped.values() for number in numbers}
            except HuntDirectoryError as error:
                _count_rows(found, ledger, settings, error)
            crashes = {}
            for number, row in ledger.intact_rows(sorted(found.trials)):
                if row is not None and settings is not None and row[2] in settings.crash_on:
                    crashes[number] = row[10]
            return {number: TrialResult.from_json(json.loads(text)) for number, text in crashes.items()}
    except HuntDirectoryError as error:
        if error.fix in (HOW_TO_READ, FREE_SPACE):
            raise  # nothing is damaged
        found.report(path, error.message, lost="all trials but the crashes", fix=_RESUME_FIX)
        return None


_RESUME_FIX = "crashhunt check --salvage TO copies the intact part, and the same hunt resumes there"


def _read_everything(ledger: Ledger) -> None:
    for rows in (ledger.results(), ledger.table(), ledger.turns()):
        for _ in rows:
            pass
    for read in (ledger.facts, ledger.events, ledger.replaced, ledger.outcomes, ledger.steps_total):
        read()
    ledger.check_pages()


def _count_rows(found: Checked, ledger: Ledger, settings: HuntSettings | None, error: HuntDirectoryError) -> None:
    most = settings.trials if settings is not None else 0
    with suppress(HuntDirectoryError):
        most = max(most, 1 + max(ledger.finished(), default=-1))
    for number, row in ledger.intact_rows(range(most)):
        (found.trials if row is not None else found.damaged_trials).add(number)
    shown = ", ".join(str(number) for number in sorted(found.damaged_trials)[:_MAX_SHOWN])
    more = len(found.damaged_trials) - _MAX_SHOWN
    lost = f"trials {shown}{f' and {more} more' if more > 0 else ''}" if shown else ""
    found.report(error.where, error.message.removeprefix("the ledger is damaged: "), lost=lost, fix=_RESUME_FIX)


def _check_parts(found: Checked, hunt: Path) -> dict[str, Bundle]:
    """Check bundles, snapshots and kept trials; return the intact bundles."""
    bundles = {}
    for folder in sorted((hunt / layout.CRASHES).glob(layout.SHOWN)):
        bundle = _check_bundle(found, folder)
        if bundle is not None:
            bundles[folder.name] = bundle
    other = _check_other_bundles(found, hunt)
    needed = {bundle.snapshot: bundle.id for bundle in (*other, *reversed(bundles.values()))}
    there = {path.name for path in (hunt / layout.SNAPSHOTS).glob(layout.SHOWN)}
    for name in sorted(there | needed.keys()):
        _check_snapshot(found, hunt / layout.SNAPSHOTS / name, needed.get(name, ""))
    for folder in sorted((hunt / layout.TRIALS).glob(layout.SHOWN)):
        for fault in read_params(folder):
            found.report(folder, fault, lost="what the trial printed")
    return bundles


def _check_bundle(found: Checked, folder: Path) -> Bundle | None:
    try:
        bundle = read_bundle(folder)
        faults = bundle.faults()
        bundle.recording()
    except CrashhuntError as error:
        if error.fix == HOW_TO_READ:
            raise
        found.report(error.where or folder, error.message, lost=f"the crash {folder.name}", fix=_RERUN_FIX)
        found.damaged_crashes.append(folder.name)
        return None
    for fault in faults:
        added = fault.endswith("was not there")
        found.report(folder, fault, lost="" if added else "that file", damaged=not added)
    if any(not fault.endswith("was not there") for fault in faults):
        found.damaged_crashes.append(folder.name)
    else:
        found.crashes.append(folder.name)
        found.near_misses += [folder.name] if bundle.is_near_miss else []
    return bundle


def _check_other_bundles(found: Checked, hunt: Path) -> list[Bundle]:
    """Return the intact bundles of near misses, probes and branches; damaged ones can be made again from the ledger."""
    whole = []
    options = {layout.NEAR_MISSES: "--near-misses", layout.PROBES: "--probe", layout.BRANCHES: "--branch"}
    for place, option in options.items():
        for folder in sorted((hunt / place).glob(layout.SHOWN)):
            one = Checked(folder, "crash")
            bundle = _check_bundle(one, folder)
            if bundle is not None:
                whole.append(bundle)
                found.near_misses += one.near_misses
            fix = f"remove it: the same hunt with {option} makes it again"
            lost = f"the near miss {folder.name}" if place == layout.NEAR_MISSES else f"{place}/{folder.name}"
            for finding in one.findings:
                found.findings.append(replace(finding, lost=lost, fix=fix) if finding.damaged else finding)
    return whole


_RERUN_FIX = "crashhunt check --salvage TO leaves it out, and the same hunt runs its trial again there"


def _snapshot_faults(snapshot: Snapshot) -> list[str]:
    faults = snapshot.faults()
    if not faults:
        _ = snapshot.environment, snapshot.settings, snapshot.scenario  # each is read here, and raises what is wrong
    return faults


def _check_snapshot(found: Checked, path: Path, crash: str) -> None:
    lost = f"replays of {crash} and others by the code that ran" if crash else "the code that ran"
    fix = "get a copy of it from elsewhere; replay --from-log and --code current may do without"
    if not path.is_dir():
        found.report(path, "is missing", lost=lost, fix="get a copy of it from elsewhere")
        return
    snapshot = Snapshot(path)
    try:
        faults = _snapshot_faults(snapshot)
        for name in snapshot.additions():
            found.report(path, f"{name} was added; it is no module, so it never runs", damaged=False)
    except CrashhuntError as error:
        faults = [error.message]
    for fault in faults[:_MAX_SHOWN]:
        found.report(path, fault, lost=lost, fix=fix)
    if len(faults) > _MAX_SHOWN:
        found.report(path, f"and {len(faults) - _MAX_SHOWN} more of its files", lost=lost, fix=fix)


def _compare(
    found: Checked, rows: dict[int, TrialResult], bundles: dict[str, Bundle], settings: HuntSettings | None
) -> None:
    """Compare the crashes in the ledger with the bundles."""
    # One that was made smaller is another trial, of which the ledger knows nothing.
    own = (bundle for name, bundle in bundles.items() if not name.endswith(layout.SMALL))
    by_trial = {bundle.result.spec.number: bundle for bundle in own}
    damaged = {int(name.partition("-")[0]) for name in found.damaged_crashes if name.partition("-")[0].isdecimal()}
    for number, bundle in by_trial.items():
        if settings is not None and bundle.hunt_seed != settings.seed:
            what = f"it is of a hunt with seed {bundle.hunt_seed}, and this one has {settings.seed}"
            found.report(bundle.path, what, fix="put it back to where it is from")
        elif number not in rows:
            if number not in found.damaged_trials:
                fix = "run the same command again: the hunt resumes with it"
                found.report(bundle.path, "the ledger has no crash of its trial", fix=fix)
        elif rows[number].digest != bundle.result.digest or rows[number].outcome is not bundle.result.outcome:
            found.report(bundle.path, "the ledger says something else about its trial", fix=_RERUN_FIX)
    for number in sorted(rows.keys() - by_trial.keys() - damaged - found.dropped):
        if hunt_state(found.dir).state != "running":
            what = f"trial {number} crashed, and its bundle is missing"
            found.report(found.dir / layout.CRASHES, what, lost="its log and evidence", fix=_RERUN_FIX)


def _find_leftovers(found: Checked, hunt: Path) -> None:
    if not is_hunt(hunt) or hunt_state(hunt).state == "running":
        return
    places = (
        hunt.glob(".*.*"),
        (hunt / layout.CRASHES).glob(".*"),
        *((hunt / place).glob(".*") for place in layout.BESIDE),
        (hunt / layout.SNAPSHOTS).glob(".*"),
        hunt.glob(f"{layout.SCRATCH}*"),
    )
    for path in sorted({path for place in places for path in place}):
        owner = owner_in(path.name)
        if owner is not None and not has_ended(owner) and not path.name.startswith(layout.SCRATCH):
            continue  # shrink may be writing it, here or on another host
        remembers = path.name.endswith(f"{layout.SMALL}.jsonl")
        why = "shrink resumes from it" if remembers else "its writer was killed"
        found.report(path, f"{why}; it may be removed", damaged=False)
