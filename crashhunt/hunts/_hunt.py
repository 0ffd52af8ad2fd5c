"""The hunt of a directory, from its lock to its report.

`Hunt` locks the directory, compares the code, takes the snapshot, and records why the hunt ends. `RunningHunt` has what
the hunt needs from its first trial to its report. `TrialLoop` submits the trials, and records their results.
"""

from __future__ import annotations

import logging
import math
import sys
import time
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import CallError, CrashhuntError, HostError, HuntDirectoryError, ScenarioError, remedy
from crashhunt.base.exceptions import in_words
from crashhunt.base.shared_memory import release_shared_memory
from crashhunt.base.signals import stop_requests
from crashhunt.base.temporary import remove_scratch
from crashhunt.base.text import encodable
from crashhunt.crashes import list_bundles, trust_repositories, write_bundle, write_trial
from crashhunt.episode import internal_error, scratch_of
from crashhunt.executors import HostConditions, make_executor, read_map
from crashhunt.hunts._audits import Audit, PendingAudits
from crashhunt.hunts._fork_results import ForkCrashes, verify_fork_results, verify_rare
from crashhunt.hunts._hunt_setup import CodeOfRun, HuntSetup, settings_of_workers
from crashhunt.hunts._next_trials import Pace, Trials, Unanswered, result_lag, trials_under_way
from crashhunt.hunts._preflight import (
    Preflight,
    WorkerNotices,
    is_hopeless,
    require_known_signals,
    unusable_value,
    why_invalid,
)
from crashhunt.hunts._progress import HuntStatus, PhaseClock, PhaseStatus, Progress, RemainingTime
from crashhunt.hunts._reports import HuntReport, StoppedBecause
from crashhunt.hunts._verification import Confirmation, TrialReruns, VerificationRuns, is_settled, keep_near_misses
from crashhunt.ledger import Ledger
from crashhunt.plans import core_of, disturber_apart, sampler_of
from crashhunt.recording import Recording, read_black_box
from crashhunt.results import (
    HEARTBEAT_S,
    HuntDirectory,
    copies_to_come,
    count_versions,
    draws_independently,
    ledger_owner,
    prune_bundles,
    tally_crashes,
)
from crashhunt.snapshots import (
    SnapshotOptions,
    describe_missing,
    describe_unsaved,
    with_original_paths,
)
from crashhunt.statistics import (
    bar_watch,
    forcings_of,
    rare_watch,
    rate_of_bar,
    rate_watch,
    refuse_training_traffic,
)
from crashhunt.training import held_out_traffics
from crashhunt.trial import Outcome
from crashhunt.trial_reruns import SharedReruns

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from crashhunt.base.plugins import ImportedModules
    from crashhunt.ledger import Noted
    from crashhunt.plans import HuntSettings
    from crashhunt.recording import BlackBoxHeader
    from crashhunt.scenario import Scenario
    from crashhunt.trial import TrialResult

_QUIET_WAIT_S, _MAX_WAIT_S = 3.0, 600.0  # for another program that locks the ledger
_TICK_S = 0.1  # how late a stop, a heartbeat or the screen may be
# Trials, or seconds of work, that a hunt is ahead of its partner. Results that `Preflight` holds back are not in
# the ledger, so the lead must be longer: otherwise, two hunts could wait for each other.
_MAX_LEAD_PER_WORKER, _MAX_LEAD_S = 8, 5.0


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
        self._code = CodeOfRun(directory, scenario, snapshot, imported)
        self._conditions: HostConditions | None = None  # once there is a snapshot
        self._has_waited = False  # for the ledger, and reported it
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
            self._code.compare(
                self.settings, self._place.settings_before or self.settings, may_have_new=self._pace is None
            )
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

    def _wait_to_begin(self, waited_s: float) -> None:
        """Report that another program locks the ledger before the hunt can begin, as `RunningHunt` does later.

        Raises:
            HuntDirectoryError: the hunt waits no longer.
        """
        _refuse_long_wait(waited_s, self._stops, self.directory)
        if waited_s >= _QUIET_WAIT_S and not self._has_waited:
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
                self._code.discard()  # no trial ran from it, and its training record would count
                return
            running = self._running if self._running is not None and self._running.has_begun else None
            last: Noted = running.progress.noted(now=True) if running is not None else {}
            ledger.enter("error", encodable(why), **last)

    def _run(self, ledger: Ledger, watch: Callable[[HuntStatus], None]) -> HuntReport:
        snapshot = self._code.take_snapshot(self.settings)
        roots = self._snapshot_options.roots if self._snapshot_options is not None else ()
        trust_repositories(snapshot.environment.get("git", {}).keys() - {str(root.resolve()) for root in roots})
        workers = settings_of_workers(self.settings, snapshot, self._place.scratch)
        self._conditions = HostConditions(workers)
        setup = HuntSetup(
            place=self._place,
            scenario=self.scenario,
            settings=self.settings,
            workers=workers,
            snapshot=snapshot,
            code=self._code.versions,
            is_new_code=self._code.is_new,
            imported=self._imported,
            pace=self._pace,
            stops=self._stops,
            conditions=self._conditions,
            notes=self._code.notes,
        )
        self._running = RunningHunt(setup, ledger, watch)
        return self._running.run()


class RunningHunt:
    """Runs the trials of a hunt, and the work after its last trial.

    Args:
        setup: the parts of the hunt that do not change.
        ledger: ledger of the hunt, open for writing.
        watch: function called with the progress about ten times a second.

    Raises:
        CrashhuntError: the hunt cannot resume.
    """

    def __init__(self, setup: HuntSetup, ledger: Ledger, watch: Callable[[HuntStatus], None]) -> None:
        settings, code = setup.settings, setup.code
        self.setup, self.ledger, self._watch = setup, ledger, watch
        self.has_begun = False  # whether the ledger says that the hunt runs, with all facts of `progress`
        self._sampler = sampler_of(settings)
        self.disturber = disturber_apart(setup.scenario, settings)
        self.progress = Progress(notes=[*setup.notes])
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
            digest_of_changes=any(agent.observes_parts for agent in setup.scenario.agents.values()),
        )
        if not self.progress.is_done:
            self.trials.require_same_version()

    def run(self) -> HuntReport:
        """Run the hunt until a crash, the last trial or a request to stop."""
        setup, progress = self.setup, self.progress
        self._begin()
        self.ledger.wait_while_locked(self._wait_for_ledger)
        self.reruns = TrialReruns(
            setup=setup,
            ledger=self.ledger,
            progress=progress,
            executors=SharedReruns(setup.place.scratch / "confirmations", parallel=setup.parallel_here),
            phases=PhaseClock(self._phase_display(), setup.parallel_here),
        )
        try:
            copies = VerificationRuns(self.reruns, self.disturber)
            self.fork_crashes = ForkCrashes(copies, self.trials)
            self.fork_crashes.resume()
            stopped: StoppedBecause = progress.why_stopped(keep_going=setup.settings.run.keep_going)
            if not progress.is_done:
                with closing(TrialLoop(self)) as loop:
                    stopped = loop.run()
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
        """Add the trials and crashes of earlier runs of the hunt."""
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
        if waited_s < _QUIET_WAIT_S:
            return
        _refuse_long_wait(waited_s, self.setup.stops, self.setup.place.path)
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
        reruns.judge()
        if stopped in ("all_trials", "time") and progress.last_wanted is not None:
            stopped = progress.why_stopped(keep_going=run.keep_going)
        progress.crashes = prune_bundles(ledger, progress.kinds, progress.crashes, run.keep, final=not setup.stops)
        progress.replace(reruns.confirm(progress.crashes))
        reruns.confirm(progress.earlier)
        if self.audits_left.numbers:
            self.audits_left.finish(reruns)
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


class TrialLoop:
    """Submits the trials of a hunt to the executor, and records their results, until no further trial is needed.

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
        recording = Recording(read_black_box(trial / layout.BLACK_BOX))  # a log would take much longer to read
        bundle = write_bundle(
            setup.place.path,
            result,
            trial,
            hunt_seed=setup.settings.seed,
            snapshot=setup.snapshot.digest,
            lanes=read_map(setup.place.scratch, trial),
            recording=recording,
        )
        self._hunt.progress.save(bundle, recording)
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
            for note in [note for note in progress.notes if note.startswith(occurred)]:
                progress.notes.remove(note)  # each by itself: the thread of the confirmation may add one meanwhile
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


def _refuse_long_wait(waited_s: float, stops: Sequence[int], directory: Path) -> None:
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
