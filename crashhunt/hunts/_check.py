"""Whether what lies on disk is what was written: hunts, suites, single crashes and exported ones."""

from __future__ import annotations

import json
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, TypedDict

from crashhunt.base import layout
from crashhunt.base.errors import BundleError, CrashhuntError, HuntDirectoryError
from crashhunt.base.owners import has_ended, owner_in
from crashhunt.crashes import Bundle, read_bundle, read_params
from crashhunt.hunts._ledger import Ledger, has_begun
from crashhunt.hunts._state import find_hunts, hunt_state, is_hunt
from crashhunt.plans import read_settings
from crashhunt.snapshots import Snapshot
from crashhunt.trial import TrialResult

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from crashhunt.plans import HuntSettings

__all__ = ["Checked", "CheckedData", "Finding", "FindingData", "check", "intact_snapshots"]

_SHOWN = 5
_SCRATCH = ".scratch"  # of a hunt, which does not run where its leftovers are looked for


class FindingData(TypedDict):
    """The plain data of a `Finding`."""

    where: str
    what: str
    lost: str
    fix: str
    damaged: bool


class CheckedData(TypedDict):
    """What ``check --json`` prints of a hunt, a crash or an exported crash."""

    dir: str
    kind: str
    fine: bool
    protected: bool
    trials: int
    damaged_trials: list[int]
    crashes: list[str]
    damaged_crashes: list[str]
    findings: list[FindingData]


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that is not as it should be.

    Args:
        where: the file or folder.
        what: is wrong with it.
        lost: what cannot be had from it any more; empty where nothing is lost.
        fix: what gets the rest.
        damaged: whether it is damage; else it is worth knowing, and harmless.
    """

    where: str
    what: str
    lost: str = ""
    fix: str = ""
    damaged: bool = True

    def to_json(self) -> FindingData:
        """Return plain strings."""
        return {
            "where": self.where,
            "what": self.what,
            "lost": self.lost,
            "fix": self.fix,
            "damaged": self.damaged,
        }


@dataclass(slots=True)
class Checked:
    """A hunt, a crash or an exported crash that has been looked at.

    Args:
        dir: where it is.
        kind: ``hunt``, ``crash`` or ``file``.
        protected: whether every trial has a digest; the ledgers of early versions have none.
        trials: the numbers of the trials whose rows are as they were written.
        damaged_trials: of those that are not.
        crashes: the names of the bundles that are as they were written.
        damaged_crashes: of those that are not.
        findings: what is wrong.
        dropped: the trials of which the bundles were given up, as shorter crashes of their kind were kept.
    """

    dir: Path
    kind: str = "hunt"
    protected: bool = True
    trials: set[int] = field(default_factory=set)
    damaged_trials: set[int] = field(default_factory=set)
    crashes: list[str] = field(default_factory=list)
    damaged_crashes: list[str] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    dropped: set[int] = field(default_factory=set)

    @property
    def fine(self) -> bool:
        """Whether nothing is damaged."""
        return not any(finding.damaged for finding in self.findings)

    def to_json(self) -> CheckedData:
        """Return the shape of one hunt in ``check --json``."""
        return {
            "dir": str(self.dir),
            "kind": self.kind,
            "fine": self.fine,
            "protected": self.protected,
            "trials": len(self.trials),
            "damaged_trials": sorted(self.damaged_trials),
            "crashes": self.crashes,
            "damaged_crashes": self.damaged_crashes,
            "findings": [finding.to_json() for finding in self.findings],
        }


def check(directory: Path) -> list[Checked]:
    """Look at everything that a directory has: a hunt, the hunts of a suite, one crash, or an exported file.

    Raises:
        HuntDirectoryError: it is none of these.
    """
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
    """Yield the snapshots of a hunt that are as they were written."""
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
                found.findings.append(Finding(str(path), "there is no crash in it", "the crash", "export it again"))
    except BundleError as error:
        found.findings.append(Finding(str(path), error.message, "the crash", error.fix))
    return found


def _check_hunt(hunt: Path) -> Checked:
    found = Checked(hunt)
    settings = _check_settings(found, hunt) if (hunt / layout.HUNT).exists() or has_begun(_ledger(hunt)) else None
    rows = _check_ledger(found, hunt, settings)
    bundles = _check_parts(found, hunt)
    if rows is not None:
        _compare(found, rows, bundles, settings)
    _find_leftovers(found, hunt)
    return found


def _check_settings(found: Checked, hunt: Path) -> HuntSettings | None:
    try:
        return read_settings(hunt / layout.HUNT)
    except HuntDirectoryError as error:
        lost = "what the hunt was asked"
        fix = "copy the hunt.toml of a snapshot there"
        found.findings.append(Finding(str(hunt / layout.HUNT), error.message, lost, fix))
    for snapshot in intact_snapshots(hunt):
        with suppress(CrashhuntError):
            return snapshot.settings()
    return None


def _ledger(hunt: Path) -> Path:
    return hunt / layout.LEDGER


def _check_ledger(found: Checked, hunt: Path, settings: HuntSettings | None) -> dict[int, TrialResult] | None:
    """The crashes in the ledger, where it can be read at all."""
    path = _ledger(hunt)
    if not has_begun(path):
        if (hunt / layout.CRASHES).is_dir() and not (hunt / layout.CASE).is_file():
            found.findings.append(Finding(str(path), "is missing", "all trials but the crashes", _GO_ON))
        return None
    try:
        with closing(Ledger(path)) as ledger:
            found.protected = ledger.protected
            if not ledger.protected:
                note = "an earlier crashhunt wrote it, and its rows have no digests: not every change would be seen"
                found.findings.append(Finding(str(path), note, damaged=False))
            elif not ledger.sealed and hunt_state(hunt).state != "running":
                note = "whoever wrote it was killed; a trial that is missing would not be seen"
                found.findings.append(Finding(str(path), note, damaged=False))
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
        found.findings.append(Finding(str(path), error.message, "all trials but the crashes", _GO_ON))
        return None


_GO_ON = "crashhunt check --salvage TO copies what is whole, and the same hunt goes on there"


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
    shown = ", ".join(str(number) for number in sorted(found.damaged_trials)[:_SHOWN])
    more = len(found.damaged_trials) - _SHOWN
    lost = f"trials {shown}{f' and {more} more' if more > 0 else ''}" if shown else ""
    found.findings.append(Finding(error.where, error.message.removeprefix("the ledger is damaged: "), lost, _GO_ON))


def _check_parts(found: Checked, hunt: Path) -> dict[str, Bundle]:
    """Bundles, snapshots and kept trials; returns the bundles that are whole."""
    bundles = {}
    for folder in sorted((hunt / layout.CRASHES).glob(layout.SHOWN)):
        bundle = _check_bundle(found, folder)
        if bundle is not None:
            bundles[folder.name] = bundle
    beside = _check_beside(found, hunt)
    needed = {bundle.snapshot: bundle.id for bundle in (*beside, *reversed(bundles.values()))}
    there = {path.name for path in (hunt / layout.SNAPSHOTS).glob(layout.SHOWN)}
    for name in sorted(there | needed.keys()):
        _check_snapshot(found, hunt / layout.SNAPSHOTS / name, needed.get(name, ""))
    for folder in sorted((hunt / layout.TRIALS).glob(layout.SHOWN)):
        for fault in read_params(folder):
            found.findings.append(Finding(str(folder), fault, "what the trial printed"))
    return bundles


def _check_bundle(found: Checked, folder: Path) -> Bundle | None:
    try:
        bundle = read_bundle(folder)
        faults = bundle.faults()
        bundle.recording()
    except CrashhuntError as error:
        found.findings.append(Finding(error.where or str(folder), error.message, f"the crash {folder.name}", _AGAIN))
        found.damaged_crashes.append(folder.name)
        return None
    if not bundle.files:
        note = "an earlier crashhunt wrote it, without digests: not every change would be seen"
        found.findings.append(Finding(str(folder / layout.CRASH), note, damaged=False))
    for fault in faults:
        added = fault.endswith("was not there")
        found.findings.append(Finding(str(folder), fault, "" if added else "that file", damaged=not added))
    if any(not fault.endswith("was not there") for fault in faults):
        found.damaged_crashes.append(folder.name)
    else:
        found.crashes.append(folder.name)
    return bundle


def _check_beside(found: Checked, hunt: Path) -> list[Bundle]:
    """Near misses, and what probes and branches have found, where they are whole; the ledger has what makes them."""
    whole = []
    options = {layout.NEAR_MISSES: "--near-misses", layout.PROBES: "--probe", layout.BRANCHES: "--branch"}
    for place, option in options.items():
        for folder in sorted((hunt / place).glob(layout.SHOWN)):
            one = Checked(folder, "crash")
            bundle = _check_bundle(one, folder)
            if bundle is not None:
                whole.append(bundle)
            fix = f"remove it: the same hunt with {option} makes it again"
            lost = f"the near miss {folder.name}" if place == layout.NEAR_MISSES else f"{place}/{folder.name}"
            for finding in one.findings:
                found.findings.append(replace(finding, lost=lost, fix=fix) if finding.damaged else finding)
    return whole


_AGAIN = "crashhunt check --salvage TO leaves it out, and the same hunt runs its trial again there"


def _snapshot_faults(snapshot: Snapshot) -> list[str]:
    faults = snapshot.faults()
    if not faults:
        snapshot.environment()
        snapshot.settings()
        snapshot.scenario()
    return faults


def _check_snapshot(found: Checked, path: Path, crash: str) -> None:
    lost = f"replays of {crash} and others by the code that ran" if crash else "the code that ran"
    fix = "get a copy of it from elsewhere; replay --from-log and --code current may do without"
    if not path.is_dir():
        found.findings.append(Finding(str(path), "is missing", lost, "get a copy of it from elsewhere"))
        return
    snapshot = Snapshot(path)
    try:
        faults = _snapshot_faults(snapshot)
        for name in snapshot.additions():
            note = f"{name} was not there; no module, so that it is run by nobody"
            found.findings.append(Finding(str(path), note, damaged=False))
    except CrashhuntError as error:
        faults = [error.message]
    for fault in faults[:_SHOWN]:
        found.findings.append(Finding(str(path), fault, lost, fix))
    if len(faults) > _SHOWN:
        found.findings.append(Finding(str(path), f"and {len(faults) - _SHOWN} more of its files", lost, fix))


def _compare(
    found: Checked, rows: dict[int, TrialResult], bundles: dict[str, Bundle], settings: HuntSettings | None
) -> None:
    """What the ledger and the bundles say about each other."""
    # One that was made smaller is another trial, of which the ledger knows nothing.
    own = (bundle for name, bundle in bundles.items() if not name.endswith(layout.SMALL))
    by_trial = {bundle.result.spec.number: bundle for bundle in own}
    damaged = {int(name.partition("-")[0]) for name in found.damaged_crashes if name.partition("-")[0].isdecimal()}
    for number, bundle in by_trial.items():
        where = str(bundle.path)
        if settings is not None and bundle.hunt_seed != settings.seed:
            what = f"it is of a hunt with seed {bundle.hunt_seed}, and this one has {settings.seed}"
            found.findings.append(Finding(where, what, "", "put it back to where it is from"))
        elif number not in rows:
            if number not in found.damaged_trials:
                what = "the ledger has no crash of its trial"
                found.findings.append(Finding(where, what, "", "run the same command again: the hunt goes on with it"))
        elif rows[number].digest != bundle.result.digest or rows[number].outcome is not bundle.result.outcome:
            found.findings.append(Finding(where, "the ledger says something else about its trial", "", _AGAIN))
    for number in sorted(rows.keys() - by_trial.keys() - damaged - found.dropped):
        if hunt_state(found.dir).state != "running":
            what = f"trial {number} crashed, and its bundle is missing"
            found.findings.append(Finding(str(found.dir / layout.CRASHES), what, "its log and evidence", _AGAIN))


def _find_leftovers(found: Checked, hunt: Path) -> None:
    if not is_hunt(hunt) or hunt_state(hunt).state == "running":
        return
    places = (
        hunt.glob(".*.*"),
        (hunt / layout.CRASHES).glob(".*"),
        *((hunt / place).glob(".*") for place in layout.BESIDE),
        (hunt / layout.SNAPSHOTS).glob(".*"),
        hunt.glob(f"{_SCRATCH}*"),
    )
    for path in sorted({path for place in places for path in place}):
        owner = owner_in(path.name)
        if owner is not None and not has_ended(owner) and not path.name.startswith(_SCRATCH):
            continue  # shrink may be writing it, here or on another host
        remembers = path.name.endswith(f"{layout.SMALL}.jsonl")
        why = "shrink goes on from it" if remembers else "somebody was killed while writing it"
        what = f"{why}; it may be removed"
        found.findings.append(Finding(str(path), what, damaged=False))
