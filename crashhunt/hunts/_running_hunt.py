"""A hunt that runs, from what its ledger contains at the beginning to its report."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import HuntDirectoryError
from crashhunt.crashes import list_bundles
from crashhunt.hunts._fork_results import ForkCrashes, keep_near_misses, verify_fork_results, verify_rare
from crashhunt.hunts._next_trials import Pace, Trials, Unanswered, result_lag
from crashhunt.hunts._preflight import why_invalid
from crashhunt.hunts._progress import PhaseClock, Progress
from crashhunt.hunts._reports import HuntReport
from crashhunt.hunts._verification import PendingAudits, TrialReruns, VerificationRuns, is_settled
from crashhunt.plans import core_of, disturber_apart, parallel_here, sampler_of
from crashhunt.reruns import SharedReruns
from crashhunt.results import (
    HEARTBEAT_S,
    copies_to_come,
    count_versions,
    draws_independently,
    ledger_owner,
    prune_bundles,
    tally_crashes,
)
from crashhunt.snapshots import describe_unsaved
from crashhunt.statistics import (
    bar_watch,
    forcings_of,
    rare_watch,
    rate_of_bar,
    rate_watch,
    refuse_training_traffic,
)
from crashhunt.training import held_out_traffics

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from crashhunt.base.plugins import ImportedModules
    from crashhunt.episode import WorkerSettings
    from crashhunt.executors import HostConditions
    from crashhunt.hunts._progress import HuntStatus, PhaseStatus
    from crashhunt.hunts._reports import StoppedBecause
    from crashhunt.ledger import Ledger, Noted
    from crashhunt.plans import HuntSettings
    from crashhunt.recording import BlackBoxHeader
    from crashhunt.results import CodeVersions, HuntDirectory
    from crashhunt.scenario import Scenario
    from crashhunt.snapshots import Snapshot

QUIET_WAIT_S, _MAX_WAIT_S = 3.0, 600.0  # for another program that locks the ledger


def refuse_long_wait(waited_s: float, stops: Sequence[int], directory: Path) -> None:
    """Stop waiting for another program that locks the ledger, at a request to stop or after minutes.

    Raises:
        HuntDirectoryError: the hunt waits no longer.
    """
    if stops or waited_s > _MAX_WAIT_S:
        raise HuntDirectoryError(
            f"another program has locked the ledger for {waited_s:.0f} s",
            fix="close the program that has it open, and run the same command again",
            where=str(directory / layout.LEDGER),
        )


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


class RunningHunt:
    """Runs the trials of a hunt, and the work after its last trial.

    Args:
        setup: the parts of the hunt that do not change.
        ledger: ledger of the hunt, open for writing.
        watch: function called with the progress about ten times a second.

    Attributes:
        has_begun: whether the ledger says that the hunt runs, with all facts of `progress`.

    Raises:
        CrashhuntError: the hunt cannot resume.
    """

    def __init__(self, setup: HuntSetup, ledger: Ledger, watch: Callable[[HuntStatus], None]) -> None:
        settings, code = setup.settings, setup.code
        self.setup, self.ledger, self._watch = setup, ledger, watch
        self.has_begun = False
        self._sampler = sampler_of(settings)
        self.disturber = disturber_apart(setup.scenario, settings)
        self.progress = Progress(notes=setup.notes)
        self.finished = ledger.finished()
        self._record_saved_crashes()
        self.unanswered = Unanswered(ledger)
        self._before = before = ledger.facts()
        apart = ledger.numbers_from(code.earlier)
        self._resume_progress(apart)
        self._held_out = held_out_traffics(settings, [setup.place.path])
        refuse_training_traffic(settings, self._held_out)
        self.progress.rate = bar_watch(settings, ledger, self._held_out, code.first)
        self._lag = result_lag(before, settings.run, settings.run.parallel or setup.parallel_here)
        self._draws_independently = not self.finished or draws_independently(before, settings)
        self.audits_left = PendingAudits(ledger, before, setup.workers)
        self.trials = Trials(
            settings,
            self._sampler,
            ledger,
            self.finished,
            lag=self._lag,
            begun_with=before.get("sampler_version") if self.finished else None,
            disturber=self.disturber,
            unanswered=self.unanswered.specs,
            forcings=forcings_of(settings, ledger, self.disturber),
            apart=apart,
        )
        if not self.progress.is_done:
            self.trials.require_same_version()

    def run(self, run_trials: Callable[[RunningHunt], StoppedBecause]) -> HuntReport:
        """Run the hunt until a crash, the last trial or a request to stop.

        Args:
            run_trials: function that runs the trials and returns why they stopped.
        """
        setup, progress = self.setup, self.progress
        self._begin()
        self.ledger.wait_while_locked(self._wait_for_ledger)
        self.reruns = TrialReruns(
            place=setup.place,
            ledger=self.ledger,
            settings=setup.settings,
            parallel=setup.parallel_here,
            notes=progress.notes,
            failed=progress.failed,
            stops=setup.stops,
            executors=SharedReruns(setup.place.scratch / "confirmations", parallel=setup.parallel_here),
            phases=PhaseClock(self._phase_display(), setup.parallel_here),
            taken=setup.snapshot.digest,
            newest=setup.code.newest,
        )
        try:
            copies = VerificationRuns(self.reruns, self.disturber)
            self.fork_crashes = ForkCrashes(copies, progress, self.trials)
            self.fork_crashes.resume()
            stopped: StoppedBecause = progress.why_stopped(keep_going=setup.settings.run.keep_going)
            if not progress.is_done:
                stopped = run_trials(self)
            return self._finish(stopped, copies)
        finally:
            self.reruns.executors.close()
            if self.disturber is not None:
                self.disturber.close()

    def show(self, phase: str, workers: Mapping[int, BlackBoxHeader] | None = None) -> None:
        """Report the present progress to the caller."""
        self._watch(
            self.progress.status(
                phase, self.setup.settings.trials, workers, has_disturbances=self.disturber is not None
            )
        )

    def restore_ledger(self) -> None:
        """Write the ledger again if its file was removed while the hunt ran.

        Raises:
            HuntDirectoryError: another file has replaced the ledger, or the directory was removed.
            HostError: the directory or the snapshot of the hunt was deleted.
        """
        self.setup.conditions.check_hunt()
        if self.ledger.restore():
            note = "ledger.sqlite was removed while the hunt ran, and was written again with all its trials"
            self.ledger.remark(note)
            self.progress.notes.append(note)

    # The beginning.

    def _record_saved_crashes(self) -> None:
        """Record the crashes of a run that was killed between saving a bundle and writing its row."""
        ledger = self.ledger
        saved = list_bundles(self.setup.place.path)
        unrecorded = [bundle for bundle in saved if bundle.result.spec.number not in self.finished]
        # Where the trial is from, only its proposal says.
        proposed = {turn.spec.number: turn.spec for turn in ledger.turns()} if unrecorded else {}
        for bundle in unrecorded:
            spec = proposed.get(bundle.result.spec.number, bundle.result.spec)
            ledger.record(replace(bundle.result, spec=spec), snapshot=bundle.snapshot)
            self.finished.add(spec.number)

    def _resume_progress(self, apart: set[int]) -> None:
        """Add the trials and crashes of earlier runs of the hunt.

        Args:
            apart: the numbers of the trials of other versions of the code.
        """
        settings, code, ledger, progress = self.setup.settings, self.setup.code, self.ledger, self.progress
        bundles = list_bundles(self.setup.place.path)
        progress.earlier = [bundle for bundle in bundles if bundle.snapshot in code.earlier]
        present = [one for one in bundles if one not in progress.earlier]
        progress.resume(present, settings.run, self._before, apart)
        progress.tally = tally_crashes(
            ledger, settings.crash_on, disturbed=self.disturber is not None, snapshots=code.newest
        )
        progress.resume_counts(ledger, self._before, settings.crash_on)

    def _begin(self) -> None:
        """Record in the ledger that the hunt runs, and with what."""
        setup, settings, before, sampler = self.setup, self.setup.settings, self._before, self._sampler
        progress, has_lag = self.progress, sampler.learns and settings.run.deterministic
        self.ledger.enter(
            "running",
            owner=ledger_owner(),
            began=time.time(),
            done_before=len(self.finished),
            heartbeat=time.time(),
            elapsed_s=0.0,
            planned=settings.trials,
            replanned=self._is_replanned() or None,
            code_versions=setup.code.noted(),
            until=time.time() + settings.run.duration_s if settings.run.duration else None,
            hunt_seed=settings.seed,
            crash_on=list(settings.crash_on),
            independent=sampler.independent and not settings.seeds and self._draws_independently,
            plain_origin=sampler.plain_origin or None,
            core=core_of(setup.scenario, settings.run),
            notices=list(dict.fromkeys((*setup.scenario.warnings, *(before.get("notices") or ())))) or None,
            disturb=list(settings.disturb) or None,
            copies=copies_to_come(settings),
            audits_left=self.audits_left.numbers or before.get("audits_left"),
            lag=self._lag if has_lag else None,
            sampler_version=(before.get("sampler_version") or sampler.version) if sampler.learns else None,
            until_rate=None if progress.rate is None else progress.rate.noted(),
            phase=None,
            ends_at=None,
        )
        setup.place.has_begun = True
        progress.counted = progress.rate or rate_watch(settings, self.ledger, self._held_out)
        progress.rare = rare_watch(settings, self.ledger, self.disturber)
        if progress.rare is not None:
            progress.rare.read(self.trials.upcoming)
        if setup.imported is not None and setup.snapshot.has_code:
            own = {file for file, _ in setup.imported.places.values()}
            read = [file for file in setup.imported.read if file not in own]
            progress.notes += describe_unsaved(read, setup.snapshot, since=math.inf)
        self.has_begun = True
        self.ledger.note(**progress.noted())  # so that a hunt that fails before the first heartbeat has the same facts

    def _is_replanned(self) -> bool:
        """Return whether TRIALS was changed after results of the present code were known."""
        setup = self.setup
        if setup.is_new_code:
            return False
        has_results = any(number >= setup.code.first for number in self.finished)
        return bool(self._before.get("replanned")) or (
            has_results and self._before.get("planned") != setup.settings.trials
        )

    def _wait_for_ledger(self, waited_s: float) -> None:
        """Report that another program locks the ledger; stop waiting at a request to stop or after minutes.

        Raises:
            HuntDirectoryError: the hunt waits no longer.
        """
        if waited_s < QUIET_WAIT_S:
            return
        refuse_long_wait(waited_s, self.setup.stops, self.setup.place.path)
        note = "the hunt waited for another program that had locked ledger.sqlite; no trial was lost"
        if note not in self.progress.notes:
            self.progress.notes.append(note)
        self.show("waiting")

    # The end.

    def _phase_display(self) -> Callable[[PhaseStatus], None]:
        """Return a function that shows the progress after the last trial, and records it in the ledger."""
        noted, progress = -math.inf, self.progress

        def show(phase: PhaseStatus) -> None:
            nonlocal noted
            began = progress.phase is None or progress.phase.name != phase.name
            progress.phase, progress.ends_at = phase, None
            self.show(phase.name)
            if began or time.monotonic() - noted > HEARTBEAT_S:
                noted = time.monotonic()
                self.restore_ledger()
                self.ledger.note(**progress.noted())

        return show

    def _finish(self, stopped: StoppedBecause, copies: VerificationRuns) -> HuntReport:
        """Verify the results of the trials, and return the report of the hunt."""
        setup, ledger, progress, reruns = self.setup, self.ledger, self.progress, self.reruns
        run = setup.settings.run
        reruns.judge(progress)
        if stopped in ("all_trials", "time") and progress.last_wanted is not None:
            stopped = progress.why_stopped(keep_going=run.keep_going)
        progress.crashes = prune_bundles(ledger, progress.kinds, progress.crashes, run.keep, final=not setup.stops)
        progress.replace(reruns.confirm(progress.crashes))
        reruns.confirm(progress.earlier)
        if self.audits_left.numbers:
            self.audits_left.finish(reruns, progress)
        near, (probes, branches) = keep_near_misses(reruns), verify_fork_results(copies)
        rare = verify_rare(copies, differences=len(progress.audit.differences) if progress.audit else 0)
        progress.phase = progress.ends_at = None
        self.show("done")
        self.restore_ledger()
        last: Noted = progress.noted(now=True)
        if rare is not None:
            last["running_rate"] = rare.estimate.running()
        invalid = progress.last_invalid if stopped == "no_valid_trial" else None
        reason = why_invalid(invalid, setup.scenario) if invalid is not None else ""
        # A suite and a rerun resume what was interrupted; otherwise crashes would stay unconfirmed for good.
        ledger.enter("interrupted" if setup.stops else stopped, reason, **last)
        crashes = sorted(progress.crashes, key=lambda bundle: (bundle.result.steps, bundle.result.spec.number))
        return HuntReport(
            directory=setup.place.path,
            settings=setup.settings,
            stopped_because=stopped,
            outcomes=ledger.outcomes(),
            trial_steps=ledger.trial_steps(),
            steps_total=ledger.steps_total(),
            wall_s=time.monotonic() - progress.began,
            crashes=tuple(crashes),
            reason=reason,
            notes=tuple(progress.notes),
            events=ledger.traffic_events(),
            audit=progress.audit,
            kinds=progress.about_kinds()[0],
            types_by_cause=progress.kinds.types_by_cause if progress.kinds is not None else None,
            near_misses=near,
            probes=probes,
            at_fault=progress.kinds.at_fault if progress.kinds is not None else None,
            branches=branches,
            copied=progress.ended_by_copy,
            unanswered=0 if stopped in ("crash", "distinct", "rate") else len(self.unanswered),
            unconfirmed=sum(not is_settled(bundle) for bundle in crashes) if setup.stops else 0,
            rare=rare,
            tally=progress.tally,
            rate=rate_of_bar(setup.place.path, progress.rate),
            code_versions=count_versions(ledger, ledger.facts(), setup.settings.crash_on),
        )
