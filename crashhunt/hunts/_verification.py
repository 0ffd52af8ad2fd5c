"""Which trials of a hunt run again, and when: saved crashes, crashes of forks, and near misses."""

from __future__ import annotations

import itertools
import queue
import threading
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from crashhunt.analysis import find_cause
from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError, UntrustedError
from crashhunt.base.temporary import remove_at_once, remove_scratch
from crashhunt.base.text import command_line
from crashhunt.crashes import changing, is_bundle_made_here, is_snapshot_trusted, list_near_misses, write_bundle
from crashhunt.executors import PoolExecutor
from crashhunt.hunts._hunt_setup import HuntSetup, settings_again
from crashhunt.replays import ReplayOptions, confirm
from crashhunt.results import Judged
from crashhunt.snapshots import Snapshot
from crashhunt.trial_reruns import EndedRun, Reruns, SharedReruns, StoppedError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    from crashhunt.crashes import Bundle
    from crashhunt.disturbances import DisturbanceSampler
    from crashhunt.executors import Executor
    from crashhunt.hunts._progress import PhaseClock, PhaseName, Progress
    from crashhunt.ledger import Ledger
    from crashhunt.trial import TrialResult, TrialSpec


class Confirmation:
    """Confirms crashes one at a time, in its own thread; meanwhile, the hunt runs one trial less at a time.

    With ``--by-cause``, the same thread also judges crashes, before it confirms others. Only one thread does both, so
    that the two results of a bundle cannot overwrite each other. Crashes that are not confirmed or judged at the end of
    the hunt are confirmed and judged then.
    """

    def __init__(self, again: TrialReruns, executor: Executor) -> None:
        self._again = again
        self._executor = executor
        self._asked: queue.PriorityQueue[tuple[int, int, Bundle | None]] = queue.PriorityQueue()
        self._order = itertools.count()
        self._confirmed: queue.SimpleQueue[Bundle] = queue.SimpleQueue()
        self._judged: queue.SimpleQueue[Judged] = queue.SimpleQueue()
        self._over = threading.Event()
        self._thread: threading.Thread | None = None
        self._known: set[str] = set()
        self._to_judge: Bundle | None = None

    def look(self, progress: Progress) -> None:
        """Start the confirmation of new crashes, and collect crashes that have been confirmed or judged."""
        if progress.kinds is None:
            return  # the first crash ends the hunt, and is confirmed then
        for bundle in progress.crashes:
            if bundle.confirmed is None and bundle.id not in self._known:
                self._known.add(bundle.id)
                self._request_run(_CONFIRM, bundle)
        with suppress(queue.Empty):
            while True:
                found = self._confirmed.get_nowait()
                progress.replace([found if found.id == crash.id else crash for crash in progress.crashes])
        with suppress(queue.Empty):
            judged = self._judged.get_nowait()
            self._to_judge = None
            progress.kinds.settle(judged)
        if self._to_judge is None and not self._over.is_set():
            self._to_judge = progress.kinds.next_to_judge()
            if self._to_judge is not None:
                self._request_run(_JUDGE, self._to_judge)

    def close(self, progress: Progress) -> None:
        """Cancel the running confirmation, so that the hunt can stop at once."""
        self._over.set()
        if self._thread is not None:
            self._request_run(_END, None)
            self._thread.join()
        self.look(progress)
        if self._to_judge is not None and progress.kinds is not None:  # the thread has ended before it began
            progress.kinds.settle(Judged(self._to_judge, is_stopped=True))
            self._to_judge = None

    def _request_run(self, what: int, bundle: Bundle | None) -> None:
        self._asked.put((what, next(self._order), bundle))
        if self._thread is None:
            self._thread = threading.Thread(target=self._run_requests, name="crashhunt-confirmation", daemon=True)
            self._thread.start()

    def _run_requests(self) -> None:
        latest: dict[str, Bundle] = {}  # with what this thread has found
        while True:
            what, _, bundle = self._asked.get()
            if bundle is None:
                break
            bundle = latest.get(bundle.id, bundle)
            self._hold_back(1)
            try:
                judged = self._again.judge_one(bundle, self._over.is_set) if what == _JUDGE else None
                found = self._again.confirm_one(bundle, self._over.is_set) if judged is None else judged.bundle
                if found is not bundle:
                    latest[found.id] = found
                    self._confirmed.put(found)
                if judged is not None:
                    self._judged.put(judged)
            except Exception:  # the end of the hunt does the same, and reports it; other crashes need not wait for it
                continue
            finally:
                self._hold_back(0)

    def _hold_back(self, slots: int) -> None:
        if isinstance(self._executor, PoolExecutor):
            self._executor.held_back = slots


_END, _JUDGE, _CONFIRM = range(3)  # what the thread does first


# Trials of a hunt that are run again in fresh processes, by the code that they ran with, for their recordings.


@dataclass(frozen=True, slots=True)
class TrialReruns:
    """Runs trials of a hunt again."""

    setup: HuntSetup  # the parts of the hunt that do not change
    ledger: Ledger  # ledger of the hunt, which records the snapshot of each trial
    # progress of the hunt: a line is added to its notes for each problem, and to its failed runs those that should have
    # confirmed a crash, but ended differently
    progress: Progress
    executors: SharedReruns  # the executors that run crashes again
    phases: PhaseClock  # object to which the progress of these runs is reported

    @property
    def is_stopped(self) -> bool:
        """Whether a stop is requested."""
        return bool(self.setup.stops)

    def run(self, specs: Iterable[TrialSpec], folder: str) -> Iterator[RepeatedTrial]:
        """Yield each trial as it ends, until a stop is requested.

        Fields of the specifications other than the number may have been changed. Bundles are written into ``folder``, a
        subfolder of the hunt's directory.

        Raises:
            CrashhuntError: the trials cannot be run.
        """
        by_snapshot: dict[str, list[TrialSpec]] = {}
        for spec in specs:
            by_snapshot.setdefault(self.ledger.snapshot_of(spec.number), []).append(spec)
        scratch = self.setup.place.scratch / folder
        for digest, group in by_snapshot.items():
            snapshot = Snapshot(self.setup.place.path / layout.SNAPSHOTS / digest)
            if digest != self.setup.snapshot.digest and not is_snapshot_trusted(snapshot):
                trust = command_line("crashhunt", "trust", self.setup.place.path)
                self.progress.notes.append(
                    f"{len(group)} trials for {folder} did not run again: nothing proves that you took the snapshot "
                    f"{digest} on this machine; if you trust its code, run {trust}, and then the same command again"
                )
                continue
            scratch.mkdir(exist_ok=True)
            try:
                again = settings_again(self.setup.settings, snapshot, scratch)
                runs = Reruns(again, "snapshot", parallel=self.setup.parallel_here, stopped=self._show_progress)
                with closing(runs), suppress(StoppedError):
                    for ended in runs.run(group, recorded=False):
                        yield RepeatedTrial(ended=ended, runs=self, snapshot=digest, folder=folder)
            finally:
                remove_scratch(scratch)

    def confirm(self, crashes: Sequence[Bundle]) -> list[Bundle]:
        """Run every crash again that is not fully confirmed; return all crashes in their original order."""
        left = [bundle for bundle in crashes if not is_settled(bundle)]
        if not left:
            return list(crashes)
        self.phases.begin("confirming", len(crashes), len(crashes) - len(left))
        found = {bundle.id: bundle for bundle in self.phases.run(self.confirm_one, left, counts=is_settled)}
        return [found.get(bundle.id, bundle) for bundle in crashes]

    def _show_progress(self) -> bool:
        """Show the progress; return whether a stop is requested."""
        self.phases.tick()
        return self.is_stopped

    def confirm_one(self, bundle: Bundle, stopped: Callable[[], bool] = lambda: False) -> Bundle:
        """Run a crash again that is not fully confirmed; return the updated crash."""
        if is_settled(bundle) or self.is_stopped or stopped():
            return bundle
        try:
            found = confirm(
                bundle,
                lambda: self.is_stopped or stopped(),
                failed=self.progress.failed,
                executors=self.executors,
                trusted=self._is_made_now(bundle),
            )
        except UntrustedError as refusal:
            note = f"{bundle.id} was not confirmed: {refusal.message}; {refusal.fix}"
            if note not in self.progress.notes:  # the end of the hunt asks again
                self.progress.notes.append(note)
            return bundle
        return bundle if found is None or not _write_if_kept(found, bundle.path) else found

    def judge_one(self, bundle: Bundle, stopped: Callable[[], bool] = lambda: False) -> Judged:
        """Find the cause of a crash by runs, and write the result into its bundle."""

        def is_stopped() -> bool:
            return self.is_stopped or stopped()

        options = ReplayOptions(force=True, trusted=self._is_made_now(bundle))
        try:
            cause, found = find_cause(bundle, options, stopped=is_stopped)
        except CrashhuntError as error:
            note = f"{bundle.id} was not judged: {error.message}"
            if note not in self.progress.notes:
                self.progress.notes.append(note)
            return Judged(bundle)
        if is_stopped():
            return Judged(bundle, is_stopped=True)
        if found is not bundle:
            _write_if_kept(found, bundle.path)
        return Judged(found, cause)

    def judge(self) -> None:
        """Find the causes of the crashes that are still to be judged, one after another."""
        progress = self.progress
        if progress.kinds is None or (total := progress.kinds.count_to_judge()) == 0:
            return
        self.phases.begin("causes", total)
        while not self.is_stopped and (bundle := progress.kinds.next_to_judge()) is not None:
            (judged,) = self.phases.run(self.judge_one, [bundle], counts=lambda one: not one.is_stopped)
            progress.kinds.settle(judged)
            progress.replace([judged.bundle if judged.bundle.id == one.id else one for one in progress.crashes])

    def _is_made_now(self, bundle: Bundle) -> bool | None:
        """Return whether a bundle has the snapshot that this process has just taken, whose files need no check."""
        return True if bundle.snapshot == self.setup.snapshot.digest and is_bundle_made_here(bundle) else None


def _write_if_kept(found: Bundle, folder: Path) -> bool:
    """Write a bundle into its folder; return whether it is there: a hunt with ``--keep`` may delete it meanwhile."""
    if not folder.is_dir():
        return False
    with changing(found) as stored:
        if stored is not found:  # a command may have judged it in the meantime
            found = replace(found, added={**stored.added, **found.added})
        try:
            found.write()
        except CrashhuntError:
            if folder.is_dir():
                raise
            return False
    return True


def is_settled(bundle: Bundle) -> bool:
    """Return whether a crash is fully confirmed, so that it is not run again."""
    return bundle.confirmed is not None and not bundle.result.why_no_escape


@dataclass(frozen=True, slots=True)
class RepeatedTrial:
    """A trial that has been run again."""

    ended: EndedRun  # the second run
    runs: TrialReruns  # the object that ran the trial
    snapshot: str  # digest of the snapshot that was run
    folder: str  # subfolder of the hunt's directory for the bundle

    @property
    def result(self) -> TrialResult:
        """The result of the second run."""
        return self.ended.result

    def write(self, result: TrialResult, *, confirmed: bool | None = None) -> Bundle:
        """Write the bundle of the trial with a result; return the bundle."""
        setup = self.runs.setup
        return write_bundle(
            setup.place.path, result, self.ended.folder, hunt_seed=setup.settings.seed, snapshot=self.snapshot,
            lanes=self.ended.lanes, place=self.folder, confirmed=confirmed,
        )  # fmt: skip


# What copies of trials have found, run from the start in fresh processes: only what crashes there again is a crash.


@dataclass(frozen=True, slots=True)
class ForkCrash:
    """A crash of a fork of a trial."""

    spec: TrialSpec
    outcome: str
    step: int


@dataclass(frozen=True, slots=True)
class VerificationRuns:
    """Runs crashes of forks from the start, to verify them."""

    again: TrialReruns  # object that runs trials of the hunt again
    # object that computes the likelihood of disturbances; None if the hunt has no disturbance models
    disturber: DisturbanceSampler | None
    # the crashes that have already been run, by folder and trial; they are not run again
    kept: dict[str, dict[int, Bundle]] = field(default_factory=dict)

    @property
    def is_stopped(self) -> bool:
        """Whether a stop is requested; some crashes of forks may then not have been run from the start."""
        return self.again.is_stopped

    def crashes(self, found: Sequence[ForkCrash], folder: str, name: PhaseName) -> tuple[tuple[Bundle, ...], int]:
        """Return the crashes that reproduce at the same step, and are then confirmed bit-identically, in their order.

        The second value is the number of runs that did not finish.

        Args:
            found: crashes of forks of different trials.
            folder: subfolder of the hunt's directory for the bundles. The former contents of the folder are deleted,
                except bundles that are kept. If a stop is requested, nothing is deleted.
            name: name of the phase.
        """
        if self.is_stopped:
            return (), 0
        place, kept = self.again.setup.place.path / folder, self.kept.get(folder, {})
        stay = {bundle.path.name for bundle in kept.values()}
        for path in [one for one in place.iterdir() if one.name not in stay] if kept else [place]:
            remove_at_once(path)
        asked = [one for one in found if one.spec.number not in kept]
        if asked:  # each is run from the start, and what crashes once more
            self.again.phases.begin(name, 2 * len(asked))
        crashed, unanswered = self._run(asked, folder)
        crashed = kept | crashed
        return tuple(crashed[one.spec.number] for one in found if one.spec.number in crashed), len(unanswered)

    def crash(self, found: ForkCrash, folder: str) -> Bundle | None:
        """Run the crash of a fork from the start; return its bundle if two runs reproduce the crash.

        The first run must crash at the same step as the fork, and the second run must be bit-identical to the first.
        The bundle is kept.
        """
        if self.is_stopped:
            return None
        crashed, _ = self._run([found], folder)  # one that was killed is run once more at the end of the hunt
        self.kept.setdefault(folder, {}).update(crashed)
        return crashed.get(found.spec.number)

    def _run(self, found: Sequence[ForkCrash], folder: str) -> tuple[dict[int, Bundle], set[int]]:
        """Return the bundles of runs that crashed like their forks, and the numbers of trials without an answer."""
        wanted = {one.spec.number: one for one in found}
        unanswered = set(wanted)
        bundles: dict[int, Bundle] = {}
        try:
            for one in self.again.run([one.spec for one in found], folder):
                self.again.phases.advance()
                result, copy = one.result, wanted[one.result.spec.number]
                if result.is_no_answer_to(copy.outcome):
                    continue
                unanswered.discard(result.spec.number)
                if (str(result.outcome), result.steps) != (copy.outcome, copy.step):
                    self.again.progress.failed.append(result)
                    continue
                if self.disturber is not None:
                    result = replace(result, log_likelihood=self.disturber.log_likelihood_of(result))
                bundles[result.spec.number] = one.write(result)
        except CrashhuntError as error:
            self.again.progress.notes.append(f"what copies have found could not be run from the start: {error}")
        confirmed = self.again.phases.run(lambda bundle: self._confirmed(bundle, unanswered), list(bundles.values()))
        return {bundle.result.spec.number: bundle for bundle in confirmed if bundle is not None}, unanswered

    def _confirmed(self, bundle: Bundle, unanswered: set[int]) -> Bundle | None:
        # It has just run here, so its code is trusted.
        found = confirm(bundle, lambda: self.is_stopped, failed=self.again.progress.failed, trusted=True)
        if found is None or found.confirmed is None:
            unanswered.add(bundle.result.spec.number)
        if found is None or not found.confirmed:
            self.again.progress.failed.append(bundle.result)  # nothing has come of this run either
            remove_at_once(bundle.path)
            return None
        found.write()
        return found


# The most dangerous trials without a crash, kept as bundles of their own.
#
# They are run once more for that, each in a fresh process, after the last trial: so a hunt is no slower by them until
# then, a hunt of before can be asked for them, and what is kept is known to happen again.


def keep_near_misses(again: TrialReruns) -> tuple[Bundle, ...]:
    """Save bundles of the most critical trials of a hunt, and delete other bundles; return them in this order.

    If the hunt keeps none, existing bundles are not changed. For each trial that could not be kept, a line with the
    reason is added to the notes of the hunt.
    """
    directory, ledger, keep = again.setup.place.path, again.ledger, again.setup.settings.run.near_misses
    if not keep or again.is_stopped:
        return ()
    numbers = ledger.most_dangerous(keep, again.setup.code.newest)
    if not numbers and ledger.numbers_of(("survived", "finished")):
        again.progress.notes.append(
            "no near miss is kept, because no trial without a crash has a criticality above 0, or because the scenario "
            "defines no criticality"
        )
    wanted = {number: result for number in numbers if (result := ledger.result(number)) is not None}
    for bundle in list_near_misses(directory):
        result = wanted.get(bundle.result.spec.number)
        if result is not None and result.digest == bundle.result.digest:
            del wanted[bundle.result.spec.number]
        else:
            remove_at_once(bundle.path)
    if wanted:
        again.phases.begin("near misses", len(wanted))
    try:
        for one in again.run([result.spec for result in wanted.values()], layout.NEAR_MISSES):
            again.phases.advance()
            now, was = one.result, wanted[one.result.spec.number]
            if now.is_no_answer_to(was.outcome):
                what = f"trial {now.spec.number}, a near miss, was {now.summary}"
                again.progress.notes.append(f"{what}: it has no bundle until the same command is run again")
            elif was.is_identical_run(now):
                one.write(was, confirmed=True)
            else:
                again.progress.failed.append(now)
                what = f"trial {now.spec.number}, a near miss, differs when replayed in a new process"
                again.progress.notes.append(f"{what}: it has no bundle")
    except CrashhuntError as error:
        again.progress.notes.append(f"near misses could not be run again: {error}")
    return tuple(list_near_misses(directory))
