"""The hunt of a directory: locks it, compares its code, takes the snapshot, and records why the hunt ends."""

from __future__ import annotations

import logging
import os
import time
from contextlib import closing, suppress
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import CallError, CrashhuntError, HostError, HuntDirectoryError, remedy
from crashhunt.base.exceptions import in_words
from crashhunt.base.signals import stop_requests
from crashhunt.base.temporary import remove_at_once, remove_scratch
from crashhunt.base.text import encodable
from crashhunt.crashes import trust_repositories
from crashhunt.episode import internal_error
from crashhunt.executors import HostConditions
from crashhunt.hunts._hunt_setup import HuntSetup, settings_of_workers
from crashhunt.hunts._next_trials import Pace
from crashhunt.hunts._preflight import require_known_signals
from crashhunt.hunts._running_hunt import QUIET_WAIT_S, RunningHunt, refuse_long_wait
from crashhunt.ledger import Ledger, has_begun
from crashhunt.results import CodeVersions, HuntDirectory, resumed_versions
from crashhunt.snapshots import Snapshot, SnapshotOptions, take_snapshot

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from crashhunt.base.plugins import ImportedModules
    from crashhunt.hunts._progress import HuntStatus
    from crashhunt.hunts._reports import HuntReport
    from crashhunt.ledger import Noted
    from crashhunt.plans import HuntSettings
    from crashhunt.scenario import Scenario

_MAX_ADDED_SHOWN = 4  # new files


class Hunt:
    """One hunt, which belongs to one directory.

    A hunt with the same settings in the same directory resumes. Settings that would result in other trials are refused.

    Args:
        directory: directory of the hunt, created if it does not exist.
        scenario: scenario of the trials.
        settings: settings of the hunt.
        command: the command line, which is written to ``hunt.toml`` as a comment.
        overwrite: whether a new hunt replaces an existing one.
        seed_given: whether the user chose the seed; if not, a resumed hunt keeps its own seed.
        snapshot: options of the snapshot of the code.
        imported: the modules that trials import, in the form for `take_snapshot`.
        partner: directory of a hunt that runs at the same time and is compared with this hunt, trial by trial. A hunt
            that is far ahead waits for its partner.
    """

    def __init__(
        self,
        directory: Path,
        scenario: Scenario,
        settings: HuntSettings,
        *,
        command: list[str] | None = None,
        overwrite: bool = False,
        seed_given: bool = True,
        snapshot: SnapshotOptions | None = None,
        imported: ImportedModules | None = None,
        partner: Path | None = None,
    ) -> None:
        self.directory = directory
        self.scenario = scenario
        self._place = HuntDirectory(directory)
        self.settings = settings
        self._command = command or ["crashhunt", "run", str(directory)]
        self._overwrite = overwrite
        self._seed_given = seed_given
        self._snapshot_options = snapshot
        self._imported = imported
        self._pace = Pace(partner) if partner is not None else None
        self._stops: Sequence[int] = ()
        self._snapshot: Snapshot | None = None
        self._new_snapshot: Path | None = None  # that this run has added
        self._conditions: HostConditions | None = None  # once there is a snapshot
        self._code, self._is_new_code = CodeVersions(), False
        self._has_waited = False  # for the ledger, and reported it
        self._notes: list[str] = []
        self._running: RunningHunt | None = None

    def run(self, watch: Callable[[HuntStatus], None] | None = None) -> HuntReport:
        """Run the hunt until a crash, the last trial or an interrupt.

        Args:
            watch: function called with the progress about ten times a second.

        Raises:
            HuntDirectoryError: the directory is in use, belongs to another hunt, or cannot be written, or the disk is
                full.
            FormulaError: a requirement names an unknown signal.
            CrashhuntError: a process or a file failed; `InternalError` if crashhunt has a defect.
        """
        if watch is not None and not callable(watch):
            raise CallError(f"run(): watch is {watch!r}", fix="give a function that receives the progress")
        require_known_signals(self.scenario, self.settings)
        with self._place.locked(), stop_requests() as self._stops:
            self.settings = self._place.claim(
                self.settings, self._command, overwrite=self._overwrite, seed_given=self._seed_given
            )
            self._compare_code()
            ledger = Ledger(self.directory / layout.LEDGER, writable=True, wait=self._wait_to_begin)
            try:
                return self._run(ledger, watch or (lambda _: None))
            except Exception as error:
                problem = self._problem_behind(error)
                self._fail(ledger, str(problem) if isinstance(problem, CrashhuntError) else in_words(problem))
                raise problem from (None if problem is error else error)
            finally:
                if self._place.has_begun:
                    with suppress(CrashhuntError):
                        ledger.note(owner=None, heartbeat=time.time())
                ledger.close()
                remove_scratch(self._place.scratch)  # while requests to stop are only collected

    def _problem_behind(self, error: Exception) -> Exception:
        """Return the error to report: if trials can no longer run on this machine, this explains every error."""
        try:
            if self._conditions is not None:
                self._conditions.check()
        except HostError as found:
            return found
        if not isinstance(error, OSError):
            return error
        if not (fix := remedy(error)):
            return internal_error(error)
        return HuntDirectoryError(f"{error.strerror or error}", fix=fix, where=str(error.filename or self.directory))

    def _compare_code(self) -> None:
        """Compare the code with that of the hunt's trials, before anything is written into the ledger.

        Raises:
            HuntDirectoryError: the code has changed, and the hunt must not or cannot continue.
        """
        path = self.directory / layout.LEDGER
        if not has_begun(path):
            return
        taken = self._take_snapshot()
        new_code = self._snapshot_options is not None and self._snapshot_options.new_code
        try:
            with closing(Ledger(path)) as ledger:
                before = CodeVersions.of(ledger.facts())
                self._code, added = resumed_versions(
                    self.directory, ledger, taken, self.settings, self._place.settings_before or self.settings,
                    new_code=None if self._pace is not None else new_code,
                )  # fmt: skip
        except CrashhuntError:
            if self._new_snapshot is not None:
                remove_at_once(self._new_snapshot)
            raise
        self._is_new_code = self._code.place != before.place
        if added:
            shown = ", ".join(added[:_MAX_ADDED_SHOWN]) + (", …" if len(added) > _MAX_ADDED_SHOWN else "")
            self._notes.append(f"new since the earlier trials, and not counted as a change of the code: {shown}")
        if self._code.are_several:
            os.utime(taken.path)  # `latest_snapshot` finds it, also if the code is an earlier version again

    def _take_snapshot(self) -> Snapshot:
        """Return the snapshot of this run, which is taken once."""
        if self._snapshot is None:
            snapshots = self.directory / layout.SNAPSHOTS
            known = {path.name for path in snapshots.glob(layout.SHOWN)}
            taken = take_snapshot(
                snapshots, self.scenario, self.settings, self._snapshot_options, imported=self._imported
            )
            self._new_snapshot = taken.path if taken.path.name not in known else None
            self._snapshot = taken
        return self._snapshot

    def _wait_to_begin(self, waited_s: float) -> None:
        """Report that another program locks the ledger before the hunt can begin, as `RunningHunt` does later.

        Raises:
            HuntDirectoryError: the hunt waits no longer.
        """
        refuse_long_wait(waited_s, self._stops, self.directory)
        if waited_s >= QUIET_WAIT_S and not self._has_waited:
            self._has_waited = True
            logging.getLogger("crashhunt").warning("waiting for another program that has locked ledger.sqlite")

    def _fail(self, ledger: Ledger, why: str) -> None:
        """Record why the hunt ends, if the ledger can still be written.

        If this run has not begun, the state of an earlier run stays, because `rerun` would repeat a failed hunt.
        """
        remove_scratch(self._place.scratch)  # on a disk that is full, this makes room for a line
        with suppress(CrashhuntError):
            if not self._place.has_begun and "state" in ledger.facts():
                ledger.remark(encodable(why))
                if self._new_snapshot is not None:  # no trial ran from it, and its training record would count
                    remove_at_once(self._new_snapshot)
                return
            running = self._running if self._running is not None and self._running.has_begun else None
            last: Noted = running.progress.noted(now=True) if running is not None else {}
            ledger.enter("error", encodable(why), **last)

    def _run(self, ledger: Ledger, watch: Callable[[HuntStatus], None]) -> HuntReport:
        snapshot = self._take_snapshot()
        roots = self._snapshot_options.roots if self._snapshot_options is not None else ()
        trust_repositories(snapshot.environment().get("git", {}).keys() - {str(root.resolve()) for root in roots})
        workers = settings_of_workers(self.settings, snapshot, self._place.scratch)
        self._conditions = HostConditions(workers)
        setup = HuntSetup(
            place=self._place,
            scenario=self.scenario,
            settings=self.settings,
            workers=workers,
            snapshot=snapshot,
            code=self._code,
            is_new_code=self._is_new_code,
            imported=self._imported,
            pace=self._pace,
            stops=self._stops,
            conditions=self._conditions,
            notes=self._notes,
        )
        self._running = RunningHunt(setup, ledger, watch)
        return self._running.run()
