"""Trials of a hunt that are run again in fresh processes, by the code that they ran with, for their recordings."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import UntrustedError
from crashhunt.base.temporary import remove_scratch
from crashhunt.crashes import is_bundle_made_here, is_snapshot_trusted, write_bundle
from crashhunt.episode import scratch_of
from crashhunt.executors import SharedExecutors, read_map, snapshot_executor
from crashhunt.hunts._workers import settings_again
from crashhunt.replays import confirm
from crashhunt.snapshots import Snapshot

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
    from pathlib import Path

    from crashhunt.crashes import Bundle
    from crashhunt.hunts._directory import HuntDirectory
    from crashhunt.hunts._ledger import Ledger
    from crashhunt.plans import HuntSettings
    from crashhunt.trial import TrialResult, TrialSpec

__all__ = ["Again", "RunsAgain"]

_LOOK_EVERY_S = 0.1  # how late Ctrl-C may be


@dataclass(frozen=True, slots=True)
class RunsAgain:
    """Runs trials of a hunt again.

    Args:
        place: of the hunt.
        ledger: of the hunt, which knows the code of each trial.
        settings: of the hunt.
        parallel: how many run at a time.
        notes: gets a line for whatever went wrong.
        failed: gets what was to confirm something, and ended otherwise.
        stops: has something in it as soon as somebody wants to stop.
        executors: which run crashes again.
        taken: the digest of the snapshot that this process has taken; without it, each snapshot has to be trusted.
    """

    place: HuntDirectory
    ledger: Ledger
    settings: HuntSettings
    parallel: int
    notes: list[str]
    failed: list[TrialResult]
    stops: Sized
    executors: SharedExecutors
    taken: str = ""

    def run(self, specs: Iterable[TrialSpec], folder: str) -> Iterator[Again]:
        """Yield each trial as it ends, until somebody wants to stop.

        Args:
            specs: of different trials of the hunt; what else they say may have been changed.
            folder: of the hunt, into which bundles of them are written.

        Raises:
            CrashhuntError: they cannot be run.
        """
        by_snapshot: dict[str, list[TrialSpec]] = {}
        for spec in specs:
            by_snapshot.setdefault(self.ledger.snapshot_of(spec.number), []).append(spec)
        scratch = self.place.scratch / folder
        for digest, group in by_snapshot.items():
            snapshot = Snapshot(self.place.path / layout.SNAPSHOTS / digest)
            if digest != self.taken and not is_snapshot_trusted(snapshot):
                self.notes.append(
                    f"{len(group)} trials for {folder} did not run again: nothing proves that you took the snapshot "
                    f"{digest} on this machine; if you trust its code, run crashhunt trust {self.place.path}, and then "
                    "the same command again"
                )
                continue
            scratch.mkdir(exist_ok=True)
            try:
                again = settings_again(self.settings, snapshot, scratch)
                with closing(snapshot_executor(again, parallel=self.parallel)) as executor:
                    waiting = len(group)
                    for spec in group:
                        executor.submit(spec)
                    while waiting and not len(self.stops):
                        for result in executor.completed(_LOOK_EVERY_S):
                            waiting -= 1
                            yield Again(result, self, digest, scratch, folder)
            finally:
                remove_scratch(scratch)

    def confirm(self, crashes: Sequence[Bundle]) -> list[Bundle]:
        """Run every crash that is not fully confirmed yet once more, and return them all, in their order."""
        with ThreadPoolExecutor(self.parallel) as threads:  # which only wait for their process
            return list(threads.map(self.confirm_one, crashes))

    def confirm_one(self, bundle: Bundle, stopped: Callable[[], bool] = lambda: False) -> Bundle:
        """Run a crash that is not fully confirmed yet once more; return it as it is then.

        Args:
            bundle: the crash.
            stopped: asked now and then whether to give up.
        """
        is_settled = bundle.confirmed is not None and not bundle.result.why_no_escape
        if is_settled or len(self.stops) or stopped():
            return bundle
        try:
            found = confirm(
                bundle,
                lambda: bool(len(self.stops)) or stopped(),
                failed=self.failed,
                executors=self.executors,
                trusted=self._is_made_now(bundle),
            )
        except UntrustedError as refusal:
            note = f"{bundle.id} was not confirmed: {refusal.message}; {refusal.fix}"
            if note not in self.notes:  # the end of the hunt asks again
                self.notes.append(note)
            return bundle
        if found is None or not bundle.path.is_dir():  # a hunt with --keep may have given it up meanwhile
            return bundle
        found.write()
        return found

    def _is_made_now(self, bundle: Bundle) -> bool | None:
        """Whether a bundle ran what this process has just taken a snapshot of, whose files need no second look."""
        return True if bundle.snapshot == self.taken and is_bundle_made_here(bundle) else None


@dataclass(frozen=True, slots=True)
class Again:
    """A trial that has been run again.

    Args:
        result: what came of it.
        runs: which ran it.
        snapshot: the digest of its code.
        scratch: the folder of the workers.
        folder: of the hunt, for its bundle.
    """

    result: TrialResult
    runs: RunsAgain
    snapshot: str
    scratch: Path
    folder: str

    def write(self, result: TrialResult, *, confirmed: bool | None = None) -> Bundle:
        """Write the bundle: what it has left behind, with a result; return it."""
        trial = scratch_of(self.scratch, result.spec.number)
        return write_bundle(
            self.runs.place.path, result, trial, hunt_seed=self.runs.settings.seed, snapshot=self.snapshot,
            lanes=read_map(self.scratch, trial), place=self.folder, confirmed=confirmed,
        )  # fmt: skip
