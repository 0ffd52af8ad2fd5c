"""The hunt: draws trials, runs them in parallel, stops at the first crash, and saves the crash."""

from __future__ import annotations

import math
import os
import sys
import time
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, TypeVar

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError, HostError, HuntDirectoryError, ScenarioError, remedy
from crashhunt.base.exceptions import in_words
from crashhunt.base.signals import stop_requests
from crashhunt.base.temporary import release_shared_memory, remove_at_once, remove_scratch
from crashhunt.base.text import encodable
from crashhunt.crashes import list_bundles, trust_repositories, write_bundle, write_trial
from crashhunt.episode import internal_error, scratch_of
from crashhunt.executors import HostConditions, make_executor, read_map
from crashhunt.hunts._fork_results import ForkCrashes, keep_near_misses, verify_fork_results, verify_rare
from crashhunt.hunts._next_trials import GREATEST_LAG, Pace, Trials, Unanswered, settings_of_workers
from crashhunt.hunts._preflight import Preflight, WorkerNotices, is_hopeless, unusable_value, why_invalid
from crashhunt.hunts._progress import HuntStatus as HuntStatus, PhaseClock, PhaseStatus, Progress, RemainingTime
from crashhunt.hunts._reports import HuntReport as HuntReport, StoppedBecause as StoppedBecause
from crashhunt.hunts._verification import Audit, Confirmation, PendingAudits, TrialReruns, VerificationRuns, is_settled
from crashhunt.ledger import Ledger, has_begun
from crashhunt.plans import core_of, disturber_apart, parallel_here, sampler_of
from crashhunt.reruns import SharedReruns
from crashhunt.results import (
    HEARTBEAT_S,
    CodeVersions,
    HuntDirectory,
    copies_to_come,
    count_versions,
    draws_independently,
    ledger_owner,
    prune_bundles,
    resumed_versions,
    sums_of_branches,
    sums_of_probes,
    tally_crashes,
)
from crashhunt.snapshots import (
    Snapshot,
    SnapshotOptions,
    describe_missing,
    describe_unsaved,
    take_snapshot,
    with_original_paths,
)
from crashhunt.statistics import (
    WHY_NOT_UNTIL_RATE,
    bar_watch,
    forcings_of,
    make_rate,
    rare_watch,
    rate_watch,
    refuse_training_traffic,
)
from crashhunt.training import held_out_traffics
from crashhunt.trial import Outcome, TrialResult

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from crashhunt.base.plugins import ImportedModules
    from crashhunt.executors import Executor
    from crashhunt.ledger import Facts, Noted
    from crashhunt.plans import HuntSettings
    from crashhunt.recording import BlackBoxHeader
    from crashhunt.scenario import Scenario
    from crashhunt.statistics import BarWatch, CrashRate

T = TypeVar("T")

_TICK_S = 0.1  # how late a stop, a heartbeat or the screen may be
# Trials, or seconds of work, that a hunt is ahead of its partner. Results that `Preflight` holds back are not in
# the ledger, so the lead must be longer: otherwise, two hunts could wait for each other.
_MAX_LEAD_PER_WORKER, _MAX_LEAD_S = 8, 5.0
_QUIET_WAIT_S, _MAX_WAIT_S = 3.0, 600.0  # for another program that locks the ledger
_MAX_ADDED_SHOWN = 4  # new files
_QUEUED_PER_WORKER = 1  # trials handed over ahead of time, so that no worker waits for the hunt


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
        self._notes: list[str] = []
        self._progress: Progress | None = None  # once the ledger says that the hunt runs

    def run(self, watch: Callable[[HuntStatus], None] | None = None) -> HuntReport:
        """Run the hunt until a crash, the last trial or an interrupt.

        Args:
            watch: function called with the progress about ten times a second.

        Raises:
            HuntDirectoryError: the directory is in use, belongs to another hunt, or cannot be written, or the disk is
                full.
            CrashhuntError: a process or a file failed; `InternalError` if crashhunt has a defect.
        """
        with self._place.locked(), stop_requests() as self._stops:
            self.settings = self._place.claim(
                self.settings, self._command, overwrite=self._overwrite, seed_given=self._seed_given
            )
            self._compare_code()
            ledger = Ledger(self.directory / layout.LEDGER, writable=True)
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
            last: Noted = self._progress.noted(now=True) if self._progress is not None else {}
            ledger.enter("error", encodable(why), **last)

    def _run(self, ledger: Ledger, watch: Callable[[HuntStatus], None]) -> HuntReport:
        settings, code = self.settings, self._code
        snapshot = self._take_snapshot()
        roots = self._snapshot_options.roots if self._snapshot_options is not None else ()
        trust_repositories(snapshot.environment().get("git", {}).keys() - {str(root.resolve()) for root in roots})
        sampler = sampler_of(settings)
        self._disturber = disturber_apart(self.scenario, settings)
        progress = Progress(notes=self._notes)
        finished = ledger.finished()
        # It was killed between saving the one and the other. Where the trial is from, only its proposal says.
        unrecorded = [bundle for bundle in list_bundles(self.directory) if bundle.result.spec.number not in finished]
        proposed = {turn.spec.number: turn.spec for turn in ledger.turns()} if unrecorded else {}
        for bundle in unrecorded:
            spec = proposed.get(bundle.result.spec.number, bundle.result.spec)
            ledger.record(replace(bundle.result, spec=spec), snapshot=bundle.snapshot)
            finished.add(spec.number)
        self._unanswered = Unanswered(ledger)
        progress.outcomes.update(ledger.outcomes())
        progress.nearest = ledger.nearest_miss()
        before = ledger.facts()
        apart = ledger.numbers_from(code.earlier)
        bundles = list_bundles(self.directory)
        progress.earlier = [bundle for bundle in bundles if bundle.snapshot in code.earlier]
        progress.resume([one for one in bundles if one not in progress.earlier], settings.run, before, apart)
        progress.tally = tally_crashes(
            ledger, settings.crash_on, disturbed=self._disturber is not None, snapshots=code.newest
        )
        self._resume_counts(ledger, progress, before, settings)
        held_out = held_out_traffics(settings, [self.directory])
        refuse_training_traffic(settings, held_out)
        progress.rate = bar_watch(settings, ledger, held_out, code.first)
        (lag, lag_grows), alike = self._result_lag(before), not finished or draws_independently(before, settings)
        worker_settings = settings_of_workers(settings, snapshot, self._place.scratch)
        self._conditions = HostConditions(worker_settings)
        self._audits_left = PendingAudits(ledger, before, worker_settings)
        again = self._unanswered.specs
        trials = Trials(
            settings,
            sampler,
            ledger,
            finished,
            lag=lag,
            lag_grows=lag_grows,
            begun_with=(before.get("sampler_version") or 1) if finished else None,
            disturber=self._disturber,
            unanswered=again,
            forcings=forcings_of(settings, ledger, self._disturber),
            apart=apart,
        )
        if not progress.is_done:
            trials.require_same_version()
        ledger.enter(
            "running",
            owner=ledger_owner(),
            began=time.time(),
            done_before=len(finished),
            heartbeat=time.time(),
            elapsed_s=0.0,
            planned=settings.trials,
            replanned=self._is_replanned(before, finished) or None,
            code_versions=code.noted(),
            until=time.time() + settings.run.duration_s if settings.run.duration else None,
            hunt_seed=settings.seed,
            crash_on=list(settings.crash_on),
            independent=sampler.independent and not settings.seeds and alike,
            plain_origin=sampler.plain_origin or None,
            core=core_of(self.scenario, settings.run),
            notices=list(dict.fromkeys((*self.scenario.warnings, *(before.get("notices") or ())))) or None,
            disturb=list(settings.disturb) or None,
            copies=copies_to_come(settings),
            audits_left=self._audits_left.numbers or before.get("audits_left"),
            lag=lag if sampler.learns and settings.run.deterministic else None,
            lag_grows=lag_grows if sampler.learns and settings.run.deterministic else None,
            sampler_version=(before.get("sampler_version") or (1 if finished else sampler.version))
            if sampler.learns
            else None,
            until_rate=None if progress.rate is None else progress.rate.noted(),
            phase=None,
            ends_at=None,
        )
        self._place.has_begun = True
        progress.counted = progress.rate or rate_watch(settings, ledger, held_out)
        progress.rare = rare_watch(settings, ledger, self._disturber)
        if progress.rare is not None:
            progress.rare.read(trials.upcoming)
        if self._imported is not None and snapshot.has_code:
            own = {file for file, _ in self._imported.places.values()}
            read = [file for file in self._imported.read if file not in own]
            progress.notes += describe_unsaved(read, snapshot, since=math.inf)
        self._progress = progress
        ledger.note(**progress.noted())  # so that a hunt that fails before the first heartbeat has the same facts
        ledger.wait_while_locked(partial(self._wait_for_ledger, progress, watch))
        runs_again = TrialReruns(
            place=self._place,
            ledger=ledger,
            settings=settings,
            parallel=self._parallel_here,
            notes=progress.notes,
            failed=progress.failed,
            stops=self._stops,
            executors=SharedReruns(self._place.scratch / "confirmations", parallel=self._parallel_here),
            phases=PhaseClock(self._show_phase(ledger, progress, watch), self._parallel_here),
            taken=snapshot.digest,
            newest=code.newest,
        )
        try:
            return self._run_with(runs_again, ledger, trials, snapshot, progress, finished, watch)
        finally:
            runs_again.executors.close()
            if self._disturber is not None:
                self._disturber.close()

    def _run_with(
        self,
        runs_again: TrialReruns,
        ledger: Ledger,
        trials: Trials,
        snapshot: Snapshot,
        progress: Progress,
        finished: set[int],
        watch: Callable[[HuntStatus], None],
    ) -> HuntReport:
        settings = self.settings
        copies = VerificationRuns(runs_again, self._disturber)
        self._copied = ForkCrashes(copies, progress, trials)
        self._copied.resume()
        stopped: StoppedBecause = progress.why_stopped(keep_going=settings.run.keep_going)
        if not progress.is_done:
            stopped = self._hunt(runs_again, ledger, trials, snapshot, progress, finished, watch)
        runs_again.judge(progress)
        if stopped in ("all_trials", "time") and progress.last_wanted is not None:
            stopped = progress.why_stopped(keep_going=settings.run.keep_going)
        progress.crashes = prune_bundles(
            ledger, progress.kinds, progress.crashes, settings.run.keep, final=not self._stops
        )
        progress.replace(runs_again.confirm(progress.crashes))
        runs_again.confirm(progress.earlier)
        if self._audits_left.numbers:
            self._audits_left.finish(runs_again, progress)
        near, (probes, branches) = keep_near_misses(runs_again), verify_fork_results(copies)
        rare = verify_rare(copies, differences=len(progress.audit.differences) if progress.audit else 0)
        progress.phase = progress.ends_at = None
        watch(self._status(progress, "done"))
        self._restore_ledger(ledger, progress)
        last: Noted = progress.noted(now=True)
        if rare is not None:
            last["running_rate"] = rare.estimate.running()
        invalid = progress.last_invalid if stopped == "no_valid_trial" else None
        reason = why_invalid(invalid, self.scenario) if invalid is not None else ""
        # A suite and a rerun resume what was interrupted; otherwise crashes would stay unconfirmed for good.
        ledger.enter("interrupted" if self._stops else stopped, reason, **last)
        crashes = sorted(progress.crashes, key=lambda bundle: (bundle.result.steps, bundle.result.spec.number))
        unanswered = 0 if stopped in ("crash", "distinct", "rate") else len(self._unanswered)
        return HuntReport(
            directory=self.directory,
            settings=settings,
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
            unanswered=unanswered,
            unconfirmed=sum(not is_settled(bundle) for bundle in crashes) if self._stops else 0,
            rare=rare,
            tally=progress.tally,
            rate=_rate_of(self.directory, progress.rate),
            code_versions=count_versions(ledger, ledger.facts(), settings.crash_on),
        )

    def _wait_for_ledger(self, progress: Progress, watch: Callable[[HuntStatus], None], waited_s: float) -> None:
        """Report that another program locks the ledger; stop waiting at a request to stop or after minutes.

        Raises:
            HuntDirectoryError: the hunt waits no longer.
        """
        if waited_s < _QUIET_WAIT_S:
            return
        if self._stops or waited_s > _MAX_WAIT_S:
            raise HuntDirectoryError(
                f"another program has locked the ledger for {waited_s:.0f} s",
                fix="close the program that has it open, and run the same command again",
                where=str(self.directory / layout.LEDGER),
            )
        note = "the hunt waited for another program that had locked ledger.sqlite; no trial was lost"
        if note not in progress.notes:
            progress.notes.append(note)
        watch(self._status(progress, "waiting"))

    def _is_replanned(self, before: Facts, finished: set[int]) -> bool:
        """Return whether TRIALS was changed after results of the present code were known."""
        if self._is_new_code:
            return False
        has_results = any(number >= self._code.first for number in finished)
        return bool(before.get("replanned")) or (has_results and before.get("planned") != self.settings.trials)

    def _show_phase(
        self, ledger: Ledger, progress: Progress, watch: Callable[[HuntStatus], None]
    ) -> Callable[[PhaseStatus], None]:
        """Return a function that shows the progress after the last trial, and records it in the ledger."""
        noted = -math.inf

        def show(phase: PhaseStatus) -> None:
            nonlocal noted
            began = progress.phase is None or progress.phase.name != phase.name
            progress.phase, progress.ends_at = phase, None
            watch(self._status(progress, phase.name))
            if began or time.monotonic() - noted > HEARTBEAT_S:
                noted = time.monotonic()
                self._restore_ledger(ledger, progress)
                ledger.note(**progress.noted())

        return show

    def _resume_counts(self, ledger: Ledger, progress: Progress, before: Facts, settings: HuntSettings) -> None:
        """Add the trials of earlier runs of the hunt to the counts on the screen."""
        if before.get("origins"):
            progress.searching.resume(sum(progress.outcomes.values()), ledger.tried_by_origin(settings.crash_on))
        branches, probes = sums_of_branches(ledger, before), sums_of_probes(ledger, before)
        progress.branched = branches["crashed"] if branches is not None else 0
        progress.not_fully_asked = sum(sums["not_fully_asked"] for sums in (branches, probes) if sums is not None)
        if probes is not None and probes["crashed_trials"] and probes["trial"] is not None:
            progress.stressed = ledger.result(probes["trial"])

    def _hunt(
        self,
        runs_again: TrialReruns,
        ledger: Ledger,
        trials: Trials,
        snapshot: Snapshot,
        progress: Progress,
        finished: set[int],
        watch: Callable[[HuntStatus], None],
    ) -> StoppedBecause:
        settings, run = self.settings, self.settings.run
        worker_settings = settings_of_workers(settings, snapshot, self._place.scratch)
        planned = settings.most_trials - len(finished) + len(self._unanswered)
        parallel = min(run.parallel, max(1, planned))
        executor = make_executor(run.executor, worker_settings, parallel=parallel)
        audit, self._heard = Audit(worker_settings, progress.failed), WorkerNotices(settings, progress.outcomes)
        preflight = Preflight(
            settings, planned, files=snapshot.argument_files, code=snapshot.code,
            listen=lambda: self._heard.hear(executor),
        )  # fmt: skip
        in_flight: set[int] = set()
        confirmation = Confirmation(runs_again, executor)
        heartbeat = 0.0
        unusable: ScenarioError | None = None
        progress.until = time.monotonic() + run.duration_s
        progress.remaining = RemainingTime(time.monotonic())
        try:
            while True:
                if progress.rare is not None:
                    progress.rare.read(min(in_flight, default=trials.upcoming))
                precise = progress.rare is not None and progress.rare.is_met
                stopping = progress.last_wanted is not None or progress.time_left_s <= 0 or precise
                room = self._room(trials, progress, executor.capacity)
                for spec in [] if stopping else trials.take(min(room, _under_way(executor.capacity) - len(in_flight))):
                    executor.submit(spec)
                    in_flight.add(spec.number)
                progress.under_way = max(progress.under_way, len(in_flight))
                if (not in_flight and (room > 0 or stopping)) or precise:
                    break
                with ledger.together():
                    for result in executor.completed(_TICK_S):
                        in_flight.discard(result.spec.number)
                        for known in preflight.filter_setup_failures(audit.add(result)):
                            self._record_trial(known, ledger, snapshot, trials, progress)
                            unusable = unusable or unusable_value(known)
                        if progress.last_wanted is not None:
                            in_flight = self._cancelled(executor, in_flight, progress.last_wanted)
                            if not run.deterministic:
                                break
                if self._copied.look(lambda: watch(self._status(progress, "confirming"))):
                    in_flight = self._cancelled(executor, in_flight, min(progress.copied))
                if self._stops or unusable is not None:
                    break
                if not finished and is_hopeless(settings, progress.outcomes):
                    return "no_valid_trial"
                self._receive_results(executor, audit, ledger, progress)
                confirmation.look(progress)
                self._expect_end(progress, executor.capacity)
                if time.monotonic() - heartbeat > HEARTBEAT_S:
                    heartbeat = time.monotonic()
                    self._restore_ledger(ledger, progress)
                    release_shared_memory(self._place.scratch, of_ended=True)
                    progress.crashes = prune_bundles(ledger, progress.kinds, progress.crashes, run.keep)
                    ledger.note(**progress.noted())
                watch(self._status(progress, "hunting", executor.where()))
            executor.cancel()
            self._receive_results(executor, audit, ledger, progress, at_end=True)
            if (crash := progress.unsaved) is not None:
                watch(self._status(progress, "saving"))
                self._save(crash, ledger, snapshot, progress)
            executor.close()
            if unusable is not None:  # the trial is recorded as a failure of the environment
                raise unusable
            self._finish_audit(runs_again.phases, executor, audit, ledger, progress)
            if progress.last_wanted is not None:
                return progress.why_stopped(keep_going=run.keep_going)
        except CrashhuntError as error:  # name the file that the user can correct
            error.explain(describe_missing(error.message, snapshot), partial(with_original_paths, snapshot=snapshot))
            mine, theirs = worker_settings.scenario.origin, self.scenario.origin
            if mine not in error.where:
                raise
            raise ScenarioError(error.message, fix=error.fix, where=error.where.replace(mine, theirs)) from error
        finally:
            if run.audit > 0:
                self._audits_left.note(audit, progress)
            executor.close()
            audit.close()
            confirmation.close(progress)
        if self._stops:
            return "interrupted"
        if progress.rare is not None and progress.rare.is_met:
            return "precise"
        if sum(progress.outcomes.values()) == progress.outcomes[Outcome.INVALID] > 0:
            return "no_valid_trial"
        return "all_trials" if trials.exhausted else "time"

    def _room(self, trials: Trials, progress: Progress, capacity: int) -> int:
        """Return how many trials may start, so that a hunt is not far ahead of its partner."""
        if self._pace is None:
            return sys.maxsize
        per_s = progress.ended_here / max(time.monotonic() - progress.began, _TICK_S)
        return self._pace.room(trials.upcoming, max(_MAX_LEAD_PER_WORKER * capacity, int(_MAX_LEAD_S * per_s)))

    def _expect_end(self, progress: Progress, parallel: int) -> None:
        """Estimate the time at which the last trial ends."""
        left = self.settings.trials - sum(progress.outcomes.values())
        found = progress.remaining.seconds_left(time.monotonic(), left, parallel) if left > 0 else 0.0
        found = min(found, progress.time_left_s)
        progress.parallel = parallel
        progress.ends_at = time.time() + found if self.settings.trials and math.isfinite(found) else None

    def _cancelled(self, executor: Executor, in_flight: set[int], wanted: int) -> set[int]:
        """Cancel trials that are no longer needed after a wanted crash; return the running trials still needed."""
        above = wanted if self.settings.run.deterministic else -1
        executor.cancel(above=above)
        return {number for number in in_flight if number <= above}

    def _result_lag(self, before: Facts) -> tuple[int, bool]:
        """Return the number of trials by which results reach the sampler late, and whether it is smaller at first."""
        under_way = _under_way(self.settings.run.parallel or self._parallel_here)
        if not self.settings.run.deterministic:
            return under_way, False
        if lag := before.get("lag"):  # a hunt of before has one lag for all trials
            return lag, bool(before.get("lag_grows"))
        return max(GREATEST_LAG, under_way), True

    def _receive_results(
        self,
        executor: Executor,
        audit: Audit,
        ledger: Ledger,
        progress: Progress,
        *,
        wait_s: float = 0.0,
        at_end: bool = False,
    ) -> None:
        """Record notices about the execution of trials, and the results of the audit."""
        for note in (*self._heard.take(executor), *self._heard.absent(at_end=at_end)):
            ledger.remark(note)
            progress.notes.append(note)
            if note not in (known := ledger.facts().get("notices") or []):
                ledger.note(notices=[*known, note])
        if occurred := self._heard.newly_occurred():
            progress.notes[:] = [note for note in progress.notes if not note.startswith(occurred)]
            known = ledger.facts().get("notices") or []
            ledger.note(notices=[note for note in known if not note.startswith(occurred)] or None)
        progress.look_at(executor)
        for difference in audit.look(wait_s):
            ledger.remark(f"audit: {difference}")
        if self.settings.run.audit > 0:
            self._audits_left.note(audit, progress)

    def _finish_audit(
        self, phases: PhaseClock, executor: Executor, audit: Audit, ledger: Ledger, progress: Progress
    ) -> None:
        """Run the remaining trials of the audit after the last trial."""
        audit.parallel = self._parallel_here
        if (total := audit.waiting) and not self._stops:
            phases.begin("auditing", total)
        while (waiting := audit.waiting) and not bool(self._stops):
            self._receive_results(executor, audit, ledger, progress, wait_s=_TICK_S)
            for _ in range(waiting - audit.waiting):
                phases.advance()
            phases.tick()

    def _restore_ledger(self, ledger: Ledger, progress: Progress) -> None:
        """Write the ledger again if its file was removed while the hunt ran.

        Raises:
            HuntDirectoryError: another file has replaced the ledger, or the directory was removed.
            HostError: the directory or the snapshot of the hunt was deleted.
        """
        if self._conditions is not None:
            self._conditions.check_hunt()
        if ledger.restore():
            note = "ledger.sqlite was removed while the hunt ran, and was written anew with everything that was in it"
            ledger.remark(note)
            progress.notes.append(note)

    def _record_trial(
        self, result: TrialResult, ledger: Ledger, snapshot: Snapshot, trials: Trials, progress: Progress
    ) -> None:
        """Write the files of a finished trial, then its row in the ledger; then count the trial."""
        settings = self.settings
        if self._disturber is not None:
            result = replace(result, log_likelihood=self._disturber.log_likelihood_of(result))
        if self._unanswered.account(result, progress):
            crashed = result.outcome in settings.crash_on
            if crashed and progress.kinds is not None:
                self._save(result, ledger, snapshot, progress)
            elif not crashed:
                if result.kept:
                    write_trial(self.directory, result, scratch_of(self._place.scratch, result.spec.number))
                ledger.record(result, snapshot=snapshot.digest)
            progress.count(result, crashed=crashed, planned=settings.trials)
            if not crashed and result.outcome is not Outcome.INVALID:
                self._copied.add(result)
        trials.ended(result)

    def _save(self, result: TrialResult, ledger: Ledger, snapshot: Snapshot, progress: Progress) -> None:
        """Save a crash: first the bundle, then the row, so that every crash in the ledger has a bundle."""
        trial = scratch_of(self._place.scratch, result.spec.number)
        bundle = write_bundle(
            self.directory,
            result,
            trial,
            hunt_seed=self.settings.seed,
            snapshot=snapshot.digest,
            lanes=read_map(self._place.scratch, trial),
        )
        progress.save(bundle)
        ledger.record(result, snapshot=snapshot.digest)

    @property
    def _parallel_here(self) -> int:
        """Return how many trials this machine can run again at a time, independently of the executor."""
        return parallel_here(self.settings.run.executor, self.settings.run.parallel)

    def _status(
        self, progress: Progress, phase: str, workers: Mapping[int, BlackBoxHeader] | None = None
    ) -> HuntStatus:
        elapsed = time.monotonic() - progress.began
        kinds, newest_s, newest_trials = progress.about_kinds(running=phase != "done")
        return HuntStatus(
            phase=phase,
            planned=self.settings.trials,
            done=sum(progress.outcomes.values()),
            outcomes=dict(progress.outcomes),
            rate_per_s=progress.ended_here / elapsed if elapsed > 0 else 0.0,
            elapsed_s=elapsed,
            nearest=progress.nearest,
            workers=dict(workers or {}),
            crashes=progress.crash_count,
            nodes=progress.nodes,
            kinds=kinds,
            newest_kind_s=newest_s,
            newest_kind_trials=newest_trials,
            types_by_cause=progress.kinds.types_by_cause if progress.kinds is not None else None,
            time_left_s=progress.time_left_s,
            disturbed=progress.disturbed if self._disturber is not None else None,
            stressed=progress.stressed,
            branched=progress.branched,
            not_fully_asked=progress.not_fully_asked,
            search=progress.searching.status(),
            rate=progress.running_rate(),
            trials_left_s=None if progress.ends_at is None else max(0.0, progress.ends_at - time.time()),
            progress=progress.phase,
        )


def _rate_of(directory: Path, watch: BarWatch | None) -> CrashRate | None:
    """Return the final crash rate of a hunt that compares its rate with a threshold."""
    if watch is None:
        return None
    found = make_rate(
        str(directory), watch.per, watch.counter, watch.sequence, confidence=100 * (1 - watch.alpha),
        why_no_estimate=WHY_NOT_UNTIL_RATE, bar=watch.bar,
    )  # fmt: skip
    excluded = found.excluded
    if watch.decided_at is not None:  # which later trials have ended depends on the workers
        excluded = {reason: count for reason, count in excluded.items() if reason != "after_unfinished"}
    return replace(found, excluded=excluded, verdict=watch.verdict, why_undecided=watch.why_undecided)


def _under_way(parallel: int) -> int:
    """Return the number of trials to submit so that ``parallel`` trials run and each worker has its next trial."""
    return parallel * (1 + _QUEUED_PER_WORKER)
