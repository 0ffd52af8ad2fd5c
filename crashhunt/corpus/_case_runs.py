"""Runs the cases of a corpus with the current code, several at a time, and compares them with their expectations."""

from __future__ import annotations

import os
from collections import deque
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from crashhunt.base import layout
from crashhunt.base.codec import Serializable
from crashhunt.base.errors import BundleError, CrashhuntError
from crashhunt.base.temporary import TemporaryFolder
from crashhunt.base.text import command_line, in_lines, one_line
from crashhunt.corpus._cases import Case, Expectation, cases_of_type, read_case, signature_today
from crashhunt.crashes import Bundle, is_bundle_trusted, refuse_untrusted, signature_of, snapshot_of, write_bundle
from crashhunt.episode import WorkerSettings, scratch_of
from crashhunt.executors import FreshProcessExecutor, read_map
from crashhunt.plans import (
    load_order_change,
    read_settings,
    with_recorded_load_order,
    with_settings,
    write_settings,
)
from crashhunt.snapshots import Snapshot, environment_changes, take_snapshot
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from crashhunt.base.progress import Watch
    from crashhunt.plans import HuntSettings
    from crashhunt.trial import TrialResult

__all__ = ["CaseReport", "Got", "run_cases", "untrusted_case"]

Got = Literal["still", "fixed", "changed", "cannot_run"]
_LOOK_EVERY_S = 0.01  # wait for a result of each running case
_HARMLESS_OUTCOMES = (Outcome.SURVIVED, Outcome.FINISHED)


@dataclass(frozen=True, slots=True)
class CaseReport(Serializable):
    """The result of running a case.

    Args:
        path: The folder of the case.
        expected: The expected status.
        got: The actual status: ``still`` (reproduces with the same crash type), ``fixed``, ``changed`` (another crash
            type) or ``cannot_run``.
        was: A description of the recorded crash.
        now: A description of the current result, or the reason why the case cannot run.
        note: The user's note.
        warnings: Differences other than the code that may change the result.
        kept: The bundle of the current crash, if it was kept.
    """

    path: Path
    expected: Expectation
    got: Got
    was: str = ""
    now: str = ""
    note: str = ""
    warnings: tuple[str, ...] = ()
    kept: Path | None = None

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
    "still": "crashes still",
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
    reports: dict[Path, CaseReport] = {}
    kept = {} if keep is None else _folders_of_kept(cases, keep)
    waiting, running = deque(cases), dict[Path, _Running]()
    with ExitStack() as stack:
        while (waiting or running) and not stopped():
            while waiting and len(running) < (parallel or os.cpu_count() or 1):
                path = waiting.popleft()
                began = _begin(path, stack)
                if isinstance(began, CaseReport):
                    reports[path] = began
                else:
                    running[path] = began
            for path, run in list(running.items()):
                report = run.look(kept.get(path))
                if report is not None:
                    reports[path] = report
                    del running[path]
                    run.close()
            if watch is not None:
                watch(len(reports), len(cases))
    return [reports[path] for path in cases if path in reports]


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


class _Running:
    """A case that is running."""

    def __init__(self, case: Case, bundle: Bundle, settings: HuntSettings, snapshot: Snapshot) -> None:
        self._case, self._bundle, self._settings = case, bundle, settings
        self._warnings = _warnings(snapshot)
        self._folder = TemporaryFolder("corpus")
        self._scratch = self._folder.path
        order = snapshot.environment().get("load_order")
        self._scenario = with_recorded_load_order(with_settings(snapshot.scenario(), settings), order)
        self._executor = FreshProcessExecutor(
            WorkerSettings(
                scenario=self._scenario,
                oracles=settings.oracles,
                crash_on=settings.crash_on,
                scratch=self._scratch,
                timeout_s=settings.run.timeout_s,
                keep_trials=True,
            )
        )
        self._executor.submit(bundle.result.spec)

    def look(self, keep: Path | None) -> CaseReport | None:
        """Return the report of the case; None while the case is running."""
        case = self._case
        try:
            result = next(iter(self._executor.completed(_LOOK_EVERY_S)), None)
            return None if result is None else self._report(result, keep)
        except BundleError as error:  # the process died before it recorded anything
            return CaseReport(
                path=case.path,
                expected=case.expect,
                got="cannot_run",
                was=case.crash,
                now=str(error),
                note=case.note,
                warnings=self._warnings,
            )
        except CrashhuntError as error:
            why = f"{error.message} ({error.fix})" if error.fix else error.message
            return CaseReport(
                path=case.path,
                expected=case.expect,
                got="cannot_run",
                was=case.crash,
                now=why,
                note=case.note,
                warnings=self._warnings,
            )

    def close(self) -> None:
        """End the process and remove its files; a second call does nothing."""
        self._executor.close()
        self._folder.remove()

    def _report(self, result: TrialResult, keep: Path | None) -> CaseReport:
        case = self._case
        got: Got = "fixed" if result.outcome in _HARMLESS_OUTCOMES else "cannot_run"
        kept = None
        if result.outcome not in (*_HARMLESS_OUTCOMES, Outcome.INVALID):
            kept = self._keep(result, keep or self._scratch / "kept", whole=keep is not None)
            now = signature_of(kept)
            is_same = bool(cases_of_type(now, [replace(case, expect="still")])) or not case.signature
            got = "still" if is_same or now == signature_today(case.path) else "changed"
        found = CaseReport(
            path=case.path,
            expected=case.expect,
            got=got,
            was=case.crash,
            now=result.summary,
            note=case.note,
            warnings=self._warnings,
        )
        return replace(found, kept=kept.path if kept is not None and keep is not None else None)

    def _keep(self, result: TrialResult, directory: Path, *, whole: bool) -> Bundle:
        """Write a bundle of the present crash; if ``whole``, also the other files of a hunt's directory."""
        digest = self._bundle.snapshot
        if whole:
            directory.mkdir(parents=True, exist_ok=True)
            write_settings(
                directory / layout.HUNT, self._settings, ["crashhunt", "corpus", "run", str(self._case.path)]
            )
            digest = take_snapshot(directory / layout.SNAPSHOTS, self._scenario, self._settings).digest
        trial = scratch_of(self._scratch, result.spec.number)
        return write_bundle(
            directory, result, trial, hunt_seed=self._bundle.hunt_seed, snapshot=digest,
            lanes=read_map(self._scratch, trial),
        )  # fmt: skip


def _begin(path: Path, stack: ExitStack) -> _Running | CaseReport:
    expected: Expectation = "fixed"  # an unreadable case never meets its expectation
    was = note = ""
    try:
        case = read_case(path)
        expected, was, note = case.expect, case.crash, case.note
        bundle = case.bundle()
        snapshot = _verified_snapshot(Snapshot(path / layout.SNAPSHOTS / bundle.snapshot))
        running = _Running(case, bundle, read_settings(path / layout.HUNT), snapshot)
    except CrashhuntError as error:
        return CaseReport(path=path, expected=expected, got="cannot_run", was=was, now=str(error), note=note)
    stack.callback(running.close)
    return running


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
    environment, scenario = snapshot.environment(), snapshot.scenario()
    changed = environment_changes(environment)
    names = (name for name in scenario.backend.versions if name in changed)
    found = [f"{name} was {changed[name][0]} and is {changed[name][1]}" for name in names]
    found += filter(None, [load_order_change(scenario, environment.get("load_order"))])
    return tuple(f"{difference}, which may be why" for difference in found)
