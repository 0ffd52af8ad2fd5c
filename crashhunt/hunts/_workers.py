"""What the workers of a hunt need to know."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from crashhunt.episode import WorkerSettings
from crashhunt.plans import with_settings

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.plans import HuntSettings
    from crashhunt.snapshots import Snapshot

__all__ = ["settings_again", "settings_of_workers"]


def settings_of_workers(settings: HuntSettings, snapshot: Snapshot, scratch: Path) -> WorkerSettings:
    """Return what workers of a hunt are told.

    The trials run from the snapshot: what is saved is what ran, even if somebody edits the code meanwhile.
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
    )


def settings_again(settings: HuntSettings, snapshot: Snapshot, scratch: Path) -> WorkerSettings:
    """Return what processes are told that run single trials of a hunt again, for their recordings."""
    return replace(_settings(settings, snapshot, scratch), keep_trials=True)


def _settings(settings: HuntSettings, snapshot: Snapshot, scratch: Path) -> WorkerSettings:
    """What both have in common: all that a trial is."""
    return WorkerSettings(
        scenario=with_settings(snapshot.scenario(), settings),
        oracles=settings.oracles,
        crash_on=settings.crash_on,
        scratch=scratch,
        code=snapshot.code,
        argument_files=snapshot.argument_files,
        timeout_s=settings.run.timeout_s,
    )
