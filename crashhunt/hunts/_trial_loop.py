"""The loop of a hunt: submits trials to the executor, and records their results, until no further trial is needed."""

from __future__ import annotations

import sys
import time
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from crashhunt.base.errors import CrashhuntError, ScenarioError
from crashhunt.base.temporary import release_shared_memory
from crashhunt.crashes import write_bundle, write_trial
from crashhunt.episode import scratch_of
from crashhunt.executors import make_executor, read_map
from crashhunt.hunts._next_trials import trials_under_way
from crashhunt.hunts._preflight import Preflight, WorkerNotices, is_hopeless, unusable_value
from crashhunt.hunts._progress import RemainingTime
from crashhunt.hunts._verification import Audit, Confirmation
from crashhunt.results import HEARTBEAT_S, prune_bundles
from crashhunt.snapshots import describe_missing, with_original_paths
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from crashhunt.hunts._reports import StoppedBecause
    from crashhunt.hunts._running_hunt import RunningHunt
    from crashhunt.trial import TrialResult

_TICK_S = 0.1  # how late a stop, a heartbeat or the screen may be
# Trials, or seconds of work, that a hunt is ahead of its partner. Results that `Preflight` holds back are not in
# the ledger, so the lead must be longer: otherwise, two hunts could wait for each other.
_MAX_LEAD_PER_WORKER, _MAX_LEAD_S = 8, 5.0


def run_trials(hunt: RunningHunt) -> StoppedBecause:
    """Run the trials of a hunt; return why the hunt stopped."""
    with closing(TrialLoop(hunt)) as loop:
        return loop.run()


class TrialLoop:
    """Runs the trials of a hunt.

    Args:
        hunt: the hunt.

    Raises:
        CrashhuntError: the executor cannot be created.
    """

    def __init__(self, hunt: RunningHunt) -> None:
        self._hunt, setup, progress = hunt, hunt.setup, hunt.progress
        self._run_settings, self._ledger = setup.settings.run, hunt.ledger
        planned = setup.settings.most_trials - len(hunt.finished) + len(hunt.unanswered)
        self._executor = make_executor(
            self._run_settings.executor,
            setup.workers,
            parallel=min(self._run_settings.parallel, max(1, planned)),
        )
        self._audit = Audit(setup.workers, progress.failed)
        self._notices = WorkerNotices(setup.settings, progress.outcomes)
        self._preflight = Preflight(
            setup.settings,
            planned,
            files=setup.snapshot.argument_files,
            code=setup.snapshot.code,
            listen=lambda: self._notices.hear(self._executor),
        )
        self._confirmation = Confirmation(hunt.reruns, self._executor)
        self._in_flight: set[int] = set()
        self._unusable: ScenarioError | None = None
        self._beat_at = 0.0
        progress.until = time.monotonic() + self._run_settings.duration_s
        progress.remaining = RemainingTime(time.monotonic())

    def run(self) -> StoppedBecause:
        """Run trials, then the rest of the audit; return why the hunt stopped.

        Raises:
            ScenarioError: a value of the scenario is unusable, or its file is wrong.
            CrashhuntError: no trial can be run, for a reason outside of the trials.
        """
        hunt, progress = self._hunt, self._hunt.progress
        try:
            if not self._run_trials():
                return "no_valid_trial"
            self._executor.cancel()
            self._receive_notices(at_end=True)
            if (crash := progress.unsaved) is not None:
                hunt.show("saving")
                self._save(crash)
            self._executor.close()
            if self._unusable is not None:  # the trial is recorded as a failure of the environment
                raise self._unusable
            self._finish_audit()
        except CrashhuntError as error:
            self._name_original_files(error)
            raise
        return self._why_stopped()

    def close(self) -> None:
        """End all processes and threads."""
        if self._run_settings.audit > 0:
            self._hunt.audits_left.note(self._audit, self._hunt.progress)
        self._executor.close()
        self._audit.close()
        self._confirmation.close(self._hunt.progress)

    def _run_trials(self) -> bool:
        """Run trials until no further trial is needed; return whether the hunt may find valid trials."""
        hunt, progress, executor = self._hunt, self._hunt.progress, self._executor
        while True:
            is_precise = self._is_precise()
            stopping = progress.last_wanted is not None or progress.time_left_s <= 0 or is_precise
            room = self._room()
            if not stopping:
                self._submit(min(room, trials_under_way(executor.capacity) - len(self._in_flight)))
            progress.under_way = max(progress.under_way, len(self._in_flight))
            if (not self._in_flight and (room > 0 or stopping)) or is_precise:
                return True
            self._record_results()
            if hunt.fork_crashes.look(lambda: hunt.show("confirming")):
                self._cancel_above(min(progress.copied))
            if hunt.setup.stops or self._unusable is not None:
                return True
            if not hunt.finished and is_hopeless(hunt.setup.settings, progress.outcomes):
                return False
            self._receive_notices()
            self._confirmation.look(progress)
            progress.expect_end(hunt.setup.settings.trials, executor.capacity)
            self._beat()
            hunt.show("hunting", executor.where())

    def _is_precise(self) -> bool:
        """Return whether the estimate of a rare crash rate needs no further trial."""
        rare = self._hunt.progress.rare
        if rare is None:
            return False
        rare.read(min(self._in_flight, default=self._hunt.trials.upcoming))
        return rare.is_met

    def _room(self) -> int:
        """Return how many trials may start, so that a hunt is not far ahead of its partner."""
        pace, progress = self._hunt.setup.pace, self._hunt.progress
        if pace is None:
            return sys.maxsize
        per_s = progress.ended_here / max(time.monotonic() - progress.began, _TICK_S)
        lead = max(_MAX_LEAD_PER_WORKER * self._executor.capacity, int(_MAX_LEAD_S * per_s))
        return pace.room(self._hunt.trials.upcoming, lead)

    def _submit(self, room: int) -> None:
        for spec in self._hunt.trials.take(room):
            self._executor.submit(spec)
            self._in_flight.add(spec.number)

    def _record_results(self) -> None:
        """Wait for results, and record them in one transaction of the ledger."""
        progress = self._hunt.progress
        with self._ledger.together():
            for result in self._executor.completed(_TICK_S):
                self._in_flight.discard(result.spec.number)
                for known in self._preflight.filter_setup_failures(self._audit.add(result)):
                    self._record_trial(known)
                    self._unusable = self._unusable or unusable_value(known)
                if progress.last_wanted is not None:
                    self._cancel_above(progress.last_wanted)
                    if not self._run_settings.deterministic:
                        break

    def _record_trial(self, result: TrialResult) -> None:
        """Write the files of a finished trial, then its row in the ledger; then count the trial."""
        hunt, setup, progress = self._hunt, self._hunt.setup, self._hunt.progress
        if hunt.disturber is not None:
            result = replace(result, log_likelihood=hunt.disturber.log_likelihood_of(result))
        if hunt.unanswered.account(result, progress):
            crashed = result.outcome in setup.settings.crash_on
            if crashed and progress.kinds is not None:
                self._save(result)
            elif not crashed:
                if result.kept:
                    write_trial(setup.place.path, result, scratch_of(setup.place.scratch, result.spec.number))
                self._ledger.record(result, snapshot=setup.snapshot.digest)
            progress.count(result, crashed=crashed, planned=setup.settings.trials)
            if not crashed and result.outcome is not Outcome.INVALID:
                hunt.fork_crashes.add(result)
        hunt.trials.ended(result)

    def _save(self, result: TrialResult) -> None:
        """Save a crash: first the bundle, then the row, so that every crash in the ledger has a bundle."""
        setup = self._hunt.setup
        trial = scratch_of(setup.place.scratch, result.spec.number)
        bundle = write_bundle(
            setup.place.path,
            result,
            trial,
            hunt_seed=setup.settings.seed,
            snapshot=setup.snapshot.digest,
            lanes=read_map(setup.place.scratch, trial),
        )
        self._hunt.progress.save(bundle)
        self._ledger.record(result, snapshot=setup.snapshot.digest)

    def _cancel_above(self, wanted: int) -> None:
        """Cancel trials that are no longer needed after a wanted crash."""
        above = wanted if self._run_settings.deterministic else -1
        self._executor.cancel(above=above)
        self._in_flight = {number for number in self._in_flight if number <= above}

    def _receive_notices(self, *, wait_s: float = 0.0, at_end: bool = False) -> None:
        """Record notices about the execution of trials, and the results of the audit."""
        ledger, progress = self._ledger, self._hunt.progress
        for note in (*self._notices.take(self._executor), *self._notices.absent(at_end=at_end)):
            ledger.remark(note)
            progress.notes.append(note)
            if note not in (known := ledger.facts().get("notices") or []):
                ledger.note(notices=[*known, note])
        if occurred := self._notices.newly_occurred():
            progress.notes[:] = [note for note in progress.notes if not note.startswith(occurred)]
            known = ledger.facts().get("notices") or []
            ledger.note(notices=[note for note in known if not note.startswith(occurred)] or None)
        progress.look_at(self._executor)
        for difference in self._audit.look(wait_s):
            ledger.remark(f"audit: {difference}")
        if self._run_settings.audit > 0:
            self._hunt.audits_left.note(self._audit, progress)

    def _beat(self) -> None:
        """Note the progress in the ledger about once a second, and remove files that are no longer needed."""
        if time.monotonic() - self._beat_at <= HEARTBEAT_S:
            return
        hunt, progress = self._hunt, self._hunt.progress
        self._beat_at = time.monotonic()
        hunt.restore_ledger()
        release_shared_memory(hunt.setup.place.scratch, of_ended=True)
        progress.crashes = prune_bundles(self._ledger, progress.kinds, progress.crashes, self._run_settings.keep)
        self._ledger.note(**progress.noted())

    def _finish_audit(self) -> None:
        """Run the remaining trials of the audit after the last trial."""
        setup, audit, phases = self._hunt.setup, self._audit, self._hunt.reruns.phases
        audit.parallel = setup.parallel_here
        if (total := audit.waiting) and not setup.stops:
            phases.begin("auditing", total)
        while (waiting := audit.waiting) and not bool(setup.stops):
            self._receive_notices(wait_s=_TICK_S)
            for _ in range(waiting - audit.waiting):
                phases.advance()
            phases.tick()

    def _name_original_files(self, error: CrashhuntError) -> None:
        """Make an error name the files that the user can correct, and not their copies in the snapshot.

        Raises:
            ScenarioError: the error is in the scenario; the new error names the user's file.
        """
        setup = self._hunt.setup
        snapshot = setup.snapshot
        error.explain(describe_missing(error.message, snapshot), partial(with_original_paths, snapshot=snapshot))
        mine, theirs = setup.workers.scenario.origin, setup.scenario.origin
        if mine in error.where:
            raise ScenarioError(error.message, fix=error.fix, where=error.where.replace(mine, theirs)) from error

    def _why_stopped(self) -> StoppedBecause:
        hunt, progress = self._hunt, self._hunt.progress
        if progress.last_wanted is not None:
            return progress.why_stopped(keep_going=self._run_settings.keep_going)
        if hunt.setup.stops:
            return "interrupted"
        if progress.rare is not None and progress.rare.is_met:
            return "precise"
        if sum(progress.outcomes.values()) == progress.outcomes[Outcome.INVALID] > 0:
            return "no_valid_trial"
        return "all_trials" if hunt.trials.exhausted else "time"
