"""Runs the cases of a corpus with the current code, several at a time, and compares them with their expectations."""

from __future__ import annotations

import os
import threading
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from crashhunt.base import layout
from crashhunt.base.codec import Serializable
from crashhunt.base.errors import BundleError, CrashhuntError
from crashhunt.base.text import command_line, in_lines, one_line
from crashhunt.corpus._cases import Case, Expectation, cases_of_type, read_case, signature_today
from crashhunt.crashes import Bundle, is_bundle_trusted, refuse_untrusted, signature_of, snapshot_of, write_bundle
from crashhunt.episode import WorkerSettings
from crashhunt.plans import read_settings, with_settings, write_settings
from crashhunt.scenario import load_order_change, with_recorded_load_order
from crashhunt.snapshots import Snapshot, environment_changes, take_snapshot
from crashhunt.trial import Outcome
from crashhunt.trial_reruns import EndedRun, StoppedError, call_in_threads, run_alone

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from crashhunt.base.progress import Watch
    from crashhunt.crashes import Signature
    from crashhunt.plans import HuntSettings
    from crashhunt.scenario import Scenario

Got = Literal["still", "fixed", "changed", "cannot_run"]
_HARMLESS_OUTCOMES = (Outcome.SURVIVED, Outcome.FINISHED)


@dataclass(frozen=True, slots=True)
class CaseReport(Serializable):
    """The result of running a case."""

    path: Path  # the folder of the case
    expected: Expectation  # the expected status
    # the actual status: ``still`` (reproduces with the same crash type), ``fixed``, ``changed`` (another crash type) or
    # ``cannot_run``
    got: Got
    was: str = ""  # a description of the recorded crash
    now: str = ""  # a description of the current result, or the reason why the case cannot run
    note: str = ""  # the user's note
    warnings: tuple[str, ...] = ()  # differences other than the code that may change the result
    kept: Path | None = None  # the bundle of the current crash, if it was kept

    json_keys = ("path", "expected", "got", "ok", "may_be_tightened", "was", "now", "warnings", "kept?")

    @property
    def ok(self) -> bool:
        """Whether the actual status is the expected status, or better."""
        return self.got == self.expected or self.got == "fixed"

    @property
    def may_be_tightened(self) -> bool:
        """Whether the case is fixed although ``still`` is expected; false with warnings, which cast doubt on it."""
        return self.expected == "still" and self.got == "fixed" and not self.warnings

    @property
    def line(self) -> str:
        """The current result and the note, as one line."""
        return one_line(f"{self.now} ({self.note})" if self.note else self.now)

    def describe(self) -> str:
        """Return a text of several lines with the result and the command that shows the crash."""
        lines = [
            f"{self.path.name}: {_RESULT_WORDS[self.got]}" + ("" if self.ok else f", and {self.expected} was expected")
        ]
        if self.was:
            lines.append(f"  it was: {self.was}")
        if self.now:
            lines.append(f"  now:    {self.now}")
        if self.note:
            lines.append(f"  note: {self.note}")
        lines += [f"  warning: {warning}" for warning in self.warnings]
        if self.kept is not None:
            lines.append(f"  look at it: {command_line('crashhunt', 'show', self.kept)}")
        return in_lines(lines)


_RESULT_WORDS = {
    "still": "still crashes",
    "fixed": "fixed",
    "changed": "crashes in another way",
    "cannot_run": "cannot run",
}


def run_cases(
    cases: Sequence[Path],
    *,
    parallel: int = 0,
    keep: Path | None = None,
    watch: Watch | None = None,
    stopped: Callable[[], bool] = lambda: False,
    trusted: bool = False,
) -> list[CaseReport]:
    """Run cases with the current code, each in a new process.

    Args:
        cases: The folders of the cases.
        parallel: Number of cases at a time; 0 for one per core.
        keep: A folder for the crashes. For each crash, a hunt's directory with the name of the case is created. If
            several cases have this name, the others get a number: ``NAME-2``.
        watch: Function called with the number of completed cases and the number of all cases.
        stopped: Function that returns whether to stop; called repeatedly.
        trusted: Whether to run the cases without a check of trust; otherwise all cases must be trusted before the first
            case runs.

    Returns:
        The reports of the completed cases, in the order of the cases.

    Raises:
        UntrustedError: A case is neither made by this user nor trusted.
        CrashhuntError: The scratch folder or the folder for crashes cannot be written.
    """
    if not trusted:
        _refuse_untrusted_cases(cases)
    kept = {} if keep is None else _folders_of_kept(cases, keep)
    reports: list[CaseReport] = []
    over = threading.Event()

    def tick() -> None:
        if stopped():
            over.set()
        if watch is not None:
            watch(len(reports), len(cases))

    def run(path: Path) -> CaseReport | None:
        with suppress(StoppedError):
            return None if over.is_set() else _run_case(path, kept.get(path), over.is_set)
        return None

    def ended(report: CaseReport | None) -> None:
        reports.extend([] if report is None else [report])

    found = call_in_threads(run, cases, parallel or os.cpu_count() or 1, ended=ended, tick=tick, over=over)
    return [report for report in found if report is not None]


def _folders_of_kept(cases: Sequence[Path], keep: Path) -> dict[Path, Path]:
    """Return for each case a folder of its own: cases of two corpora may have the same name."""
    folders: dict[Path, Path] = {}  # case by folder
    for path in cases:
        folder, number = keep / path.name, 1
        while folder in folders:
            number += 1
            folder = keep / f"{path.name}-{number}"
        folders[folder] = path
    return {path: folder for folder, path in folders.items()}


def _refuse_untrusted_cases(cases: Sequence[Path]) -> None:
    """Refuse cases that are neither made by this user nor trusted; unreadable cases cannot run anyway.

    Raises:
        UntrustedError: A case is not trusted; the message names the first such case.
    """
    for path in cases:
        bundle = untrusted_case(path)
        if bundle is not None:
            raise refuse_untrusted(bundle, where=str(path))


def untrusted_case(path: Path) -> Bundle | None:
    """Return the crash of a case that is not trusted; None if it is trusted, or is damaged and thus cannot run."""
    try:
        bundle = read_case(path).bundle()
        snapshot_of(bundle).verify()
    except CrashhuntError:
        return None
    return None if is_bundle_trusted(bundle, faults=()) else bundle


_lock = threading.Lock()  # of all work but the trials: a snapshot lists the modules that are imported


def _run_case(path: Path, keep: Path | None, stopped: Callable[[], bool]) -> CaseReport:
    """Run a case; return its report.

    Without ``keep``, no crash is kept.

    Raises:
        StoppedError: A stop was requested before the end of the case.
    """
    report = CaseReport(path=path, expected="fixed", got="cannot_run")  # an unreadable case never meets its expectation
    try:
        with _lock:
            case = read_case(path)
            report = replace(report, expected=case.expect, was=case.crash, note=case.note)
            bundle = case.bundle()
            snapshot = _verified_snapshot(Snapshot(path / layout.SNAPSHOTS / bundle.snapshot))
            settings = read_settings(path / layout.HUNT)
            report, scenario = replace(report, warnings=_warnings(snapshot)), _scenario(snapshot, settings)
    except CrashhuntError as error:
        return replace(report, now=str(error))
    worker = WorkerSettings(
        scenario=scenario,
        oracles=settings.oracles,
        crash_on=settings.crash_on,
        scratch=Path(),
        timeout_s=settings.run.timeout_s,
        step_timeout_s=settings.run.step_timeout_s,
        keep_trials=True,
    )
    try:
        for ended in run_alone(worker, bundle.result.spec, stopped):
            report = replace(report, now=ended.result.summary)
            if ended.result.outcome in _HARMLESS_OUTCOMES:
                return replace(report, got="fixed")
            if ended.result.outcome is not Outcome.INVALID:
                with _lock:
                    directory = keep or ended.folder.parent / "kept"
                    kept = _write_crash(directory, bundle, ended, settings if keep else None, scenario, path)
                    report = replace(report, got=_status(case, signature_of(kept)))
                    return replace(report, kept=kept.path if keep else None)
    except BundleError as error:  # the process died before it recorded anything
        return replace(report, now=str(error))
    except CrashhuntError as error:
        return replace(report, now=f"{error.message} ({error.fix})" if error.fix else error.message)
    return report


def _status(case: Case, now: Signature) -> Got:
    """Return whether a crash has the type of a case, also if earlier rules determined the stored signature."""
    is_same = bool(cases_of_type(now, [replace(case, expect="still")])) or not case.signature
    return "still" if is_same or now == signature_today(case.path) else "changed"


def _write_crash(
    directory: Path, was: Bundle, ended: EndedRun, settings: HuntSettings | None, scenario: Scenario, case: Path
) -> Bundle:
    """Write a bundle of the present crash; with settings, also the other files of a hunt's directory."""
    digest = was.snapshot
    if settings is not None:
        directory.mkdir(parents=True, exist_ok=True)
        write_settings(directory / layout.HUNT, settings, ["crashhunt", "corpus", "run", str(case)])
        digest = take_snapshot(directory / layout.SNAPSHOTS, scenario, settings).digest
    return write_bundle(
        directory, ended.result, ended.folder, hunt_seed=was.hunt_seed, snapshot=digest, lanes=ended.lanes
    )


def _scenario(snapshot: Snapshot, settings: HuntSettings) -> Scenario:
    order = snapshot.environment.get("load_order")
    return with_recorded_load_order(with_settings(snapshot.scenario, settings), order)


def _verified_snapshot(snapshot: Snapshot) -> Snapshot:
    """Return the snapshot of a case after checking it.

    Raises:
        BundleError: The snapshot is damaged; the fix names the repository, because a case has no other copy.
    """
    try:
        snapshot.verify()
    except BundleError as error:
        fix = "restore the case from the repository, or add the crash again"
        raise BundleError(error.message, fix=fix, where=error.where) from None
    return snapshot


def _warnings(snapshot: Snapshot) -> tuple[str, ...]:
    """Return the differences in the environment because of which the same seed may result in other traffic."""
    environment, scenario = snapshot.environment, snapshot.scenario
    changed = environment_changes(environment)
    names = (name for name in scenario.backend.versions if name in changed)
    found = [f"{name} was {changed[name][0]} and is {changed[name][1]}" for name in names]
    found += filter(None, [load_order_change(scenario, environment.get("load_order"))])
    return tuple(f"{difference}, which may be why" for difference in found)
