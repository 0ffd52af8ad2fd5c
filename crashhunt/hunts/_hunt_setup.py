"""What does not change while a hunt runs: its parts, and the settings of its workers."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from crashhunt.episode import WorkerSettings
from crashhunt.plans import parallel_here, reused_agents, with_settings

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from crashhunt.base.plugins import ImportedModules
    from crashhunt.executors import HostConditions
    from crashhunt.hunts._next_trials import Pace
    from crashhunt.plans import HuntSettings
    from crashhunt.results import CodeVersions, HuntDirectory
    from crashhunt.scenario import Scenario
    from crashhunt.snapshots import Snapshot


@dataclass(frozen=True, slots=True, kw_only=True)
class HuntSetup:
    """The parts of a hunt that do not change while it runs.

    Args:
        place: directory of the hunt, which is locked.
        scenario: scenario of the trials.
        settings: settings of the hunt.
        workers: settings of the processes that run its trials.
        snapshot: snapshot of the code that runs.
        code: the versions of the code of all its trials.
        is_new_code: whether the code differs from that of the latest trials.
        imported: the modules that trials import; None if they are unknown.
        pace: limit on how far the hunt is ahead of its partner; None without a partner.
        stops: the signals that request the hunt to stop, as they arrive.
        conditions: the conditions under which trials can run on this machine.
        notes: notices for the user.
    """

    place: HuntDirectory
    scenario: Scenario
    settings: HuntSettings
    workers: WorkerSettings
    snapshot: Snapshot
    code: CodeVersions
    is_new_code: bool
    imported: ImportedModules | None
    pace: Pace | None
    stops: Sequence[int]
    conditions: HostConditions
    notes: list[str] = field(default_factory=list)

    @property
    def parallel_here(self) -> int:
        """The number of trials that this machine can run again at a time, independently of the executor."""
        return parallel_here(self.settings.run.executor, self.settings.run.parallel)


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
        scenario=with_settings(snapshot.scenario(), settings),
        oracles=settings.oracles,
        crash_on=settings.crash_on,
        scratch=scratch,
        code=snapshot.code,
        argument_files=snapshot.argument_files,
        timeout_s=settings.run.timeout_s,
        step_timeout_s=settings.run.step_timeout_s,
    )
