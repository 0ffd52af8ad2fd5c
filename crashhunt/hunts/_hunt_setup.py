"""What does not change while a hunt runs: its code, its parts, and the settings of its workers."""

from __future__ import annotations

import os
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError
from crashhunt.base.temporary import remove_at_once
from crashhunt.episode import WorkerSettings
from crashhunt.ledger import Ledger, has_begun
from crashhunt.plans import parallel_here, reused_agents, with_settings
from crashhunt.results import CodeVersions, resumed_versions
from crashhunt.snapshots import take_snapshot

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from crashhunt.base.plugins import ImportedModules
    from crashhunt.executors import HostConditions
    from crashhunt.hunts._next_trials import Pace
    from crashhunt.plans import HuntSettings
    from crashhunt.results import HuntDirectory
    from crashhunt.scenario import Scenario
    from crashhunt.snapshots import Snapshot, SnapshotOptions

_MAX_ADDED_SHOWN = 4  # new files


@dataclass(frozen=True, slots=True, kw_only=True)
class HuntSetup:
    """The parts of a hunt that do not change while it runs."""

    place: HuntDirectory  # directory of the hunt, which is locked
    scenario: Scenario  # scenario of the trials
    settings: HuntSettings
    workers: WorkerSettings  # settings of the processes that run its trials
    snapshot: Snapshot  # snapshot of the code that runs
    code: CodeVersions  # the versions of the code of all its trials
    is_new_code: bool  # whether the code differs from that of the latest trials
    imported: ImportedModules | None  # the modules that trials import; None if they are unknown
    pace: Pace | None  # limit on how far the hunt is ahead of its partner; None without a partner
    stops: Sequence[int]  # the signals that request the hunt to stop, as they arrive
    conditions: HostConditions  # the conditions under which trials can run on this machine
    notes: list[str] = field(default_factory=list)  # notices for the user

    @property
    def parallel_here(self) -> int:
        """The number of trials that this machine can run again at a time, independently of the executor."""
        return parallel_here(self.settings.run.executor, self.settings.run.parallel)


class CodeOfRun:
    """The code of one run of a hunt: its snapshot, and how it differs from the code of earlier trials.

    Args:
        directory: directory of the hunt.
        scenario: scenario of the trials.
        options: options of the snapshot.
        imported: the modules that trials import, in the form for `take_snapshot`.

    Attributes:
        versions: the versions of the code of all trials of the hunt.
        is_new: whether the code differs from that of the latest trials.
        notes: notices for the user.
    """

    def __init__(
        self,
        directory: Path,
        scenario: Scenario,
        options: SnapshotOptions | None,
        imported: ImportedModules | None,
    ) -> None:
        self._directory, self._scenario, self._options, self._imported = directory, scenario, options, imported
        self.versions, self.is_new = CodeVersions(), False
        self.notes: list[str] = []
        self._snapshot: Snapshot | None = None
        self._added: Path | None = None  # the snapshot, if this run has added it

    def compare(self, settings: HuntSettings, settings_before: HuntSettings, *, may_have_new: bool) -> None:
        """Compare the code with that of the hunt's trials, before anything is written into the ledger.

        Raises:
            HuntDirectoryError: the code has changed, and the hunt must not or cannot continue.
        """
        path = self._directory / layout.LEDGER
        if not has_begun(path):
            return
        taken = self.take_snapshot(settings)
        new_code = self._options is not None and self._options.new_code if may_have_new else None
        try:
            with closing(Ledger(path)) as ledger:
                before = CodeVersions.of(ledger.facts())
                self.versions, added = resumed_versions(
                    self._directory, ledger, taken, settings, settings_before, new_code=new_code
                )
        except CrashhuntError:
            self.discard()
            raise
        self.is_new = self.versions.place != before.place
        if added:
            shown = ", ".join(added[:_MAX_ADDED_SHOWN]) + (", …" if len(added) > _MAX_ADDED_SHOWN else "")
            self.notes.append(f"new since the earlier trials, and not counted as a change of the code: {shown}")
        if self.versions.are_several:
            os.utime(taken.path)  # `latest_snapshot` finds it, also if the code is an earlier version again

    def take_snapshot(self, settings: HuntSettings) -> Snapshot:
        """Return the snapshot of this run, which is taken once."""
        if self._snapshot is None:
            snapshots = self._directory / layout.SNAPSHOTS
            known = {path.name for path in snapshots.glob(layout.SHOWN)}
            self._snapshot = taken = take_snapshot(
                snapshots, self._scenario, settings, self._options, imported=self._imported
            )
            self._added = taken.path if taken.path.name not in known else None
        return self._snapshot

    def discard(self) -> None:
        """Remove the snapshot if this run has added it."""
        if self._added is not None:
            remove_at_once(self._added)


def settings_of_workers(settings: HuntSettings, snapshot: Snapshot, scratch: Path) -> WorkerSettings:
    """Return the settings for the workers of a hunt.

    Trials run from the snapshot, so the saved code is the code that ran, even if the user edits the original files.
    """
    run = settings.run
    return replace(
        _settings(settings, snapshot, scratch),
        keep_trials=run.keep_trials,
        warm_copies=run.warm_copies if settings.seeds else 0,
        audit=run.audit,
        hunt_seed=settings.seed,
        probe_s=settings.probe_s,
        branch=tuple(settings.disturb) if settings.branch else (),
        force=tuple(settings.disturb) if settings.rare else (),
        reuses=reused_agents(settings) if run.reuse else (),
    )


def settings_again(settings: HuntSettings, snapshot: Snapshot, scratch: Path) -> WorkerSettings:
    """Return the settings for processes that run single trials of a hunt again to record them."""
    return replace(_settings(settings, snapshot, scratch), keep_trials=True)


def _settings(settings: HuntSettings, snapshot: Snapshot, scratch: Path) -> WorkerSettings:
    """Return the settings that are common to `settings_of_workers` and `settings_again`."""
    return WorkerSettings(
        scenario=with_settings(snapshot.scenario, settings),
        oracles=settings.oracles,
        crash_on=settings.crash_on,
        scratch=scratch,
        code=snapshot.code,
        argument_files=snapshot.argument_files,
        timeout_s=settings.run.timeout_s,
        step_timeout_s=settings.run.step_timeout_s,
    )
