"""The engine of what-if runs: runs the trial of a crash again many times with a change, and counts the outcomes.

Every run starts at step 0, so each counted crash can be repeated from its specification alone. If the change begins at
a later step, the recording of each run up to this step is compared bit by bit with the recording of the crash. A run
that differs does not count, because it would start the change in another situation. The counts contain the reason.

Invariant: which runs count depends only on their numbers. Runs end in the order of their lengths, and crashed runs are
short. If the runs are stopped, only runs before the first unfinished number count.

Cost: a run is a fork of a simulator that has been set up, so only its steps are simulated. On a busy machine, one run
at a time took 72 ms for 148 steps on loop, and 108 ms for 392 steps on merge. The trial itself takes 45 and 91 ms of
this time. A fork 20 steps before the end would cost about 9 ms and save all steps before it. The runs would be about
1.7 and 3.5 times as fast, and 50 futures would take 3.4 s each instead of 4.7 s and 6.8 s, start-up included. Forks at
a later step are not implemented, because the steps before the fork would be verified only once. Without forks, each
counted run is verified separately.
"""

from __future__ import annotations

import itertools
import statistics
from collections import Counter
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.analysis._interventions import Intervention, LeaveOut, Reseed, SetArguments
from crashhunt.base.codec import Serializable
from crashhunt.base.errors import UsageError, WorkerError
from crashhunt.base.text import format_percent
from crashhunt.crashes import wilson
from crashhunt.recording import first_divergence
from crashhunt.replays import ReplayOptions, is_current_code, prepare, reruns_of, up_to
from crashhunt.trial import ALL_AGENTS, Outcome, Reseeding
from crashhunt.trial_reruns import Budget, EndedRun, NotUnderstoodError, Reruns, StoppedError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from crashhunt.base.progress import Watch
    from crashhunt.crashes import Bundle
    from crashhunt.replays import Code, Rerun
    from crashhunt.trial import TrialSpec


FUTURES = 50
"""How many futures are run where the user gives no number: their interval is at most 0.27 wide."""
_MAX_RUNS = 1_000_000  # each keeps its result in memory
_SELF_TEST_RUNS = 4  # futures to begin with, of which one is run twice
_COMPARED_FUTURES = 20  # futures that must not all be equal
_HARMLESS_OUTCOMES = (Outcome.SURVIVED, Outcome.FINISHED)


@dataclass(frozen=True, slots=True, kw_only=True)
class WhatIfOptions:
    """Options of what-if runs."""

    code: Code = "snapshot"  # the code that drives: the code of the ``snapshot``, or the ``current`` code
    times: int = 0  # number of runs; 0 means `FUTURES` runs if futures are requested, and otherwise one run
    parallel: int = 1  # number of runs at a time
    time_s: float | None = None  # wall-time limit of all runs, in s; None for no limit
    trusted: bool | None = None  # whether the code of the crash may run; None to determine it
    force: bool = False  # whether to run even from a damaged snapshot
    watch: Watch | None = None  # function called with the number of finished runs and the number of all runs
    # function that returns whether to stop; called repeatedly
    stopped: Callable[[], bool] = field(default=lambda: False)


def what_if(bundle: Bundle, interventions: Sequence[Intervention], options: WhatIfOptions | None = None) -> Counts:
    """Run the trial of a crash again with changes, and count how the runs end.

    Without any change, the trial runs unchanged.

    Returns:
        The counts. If the runs were stopped, only the runs before the first unfinished run are counted.

    Raises:
        UsageError: an intervention or an option is invalid, or the simulator does not support it.
        UntrustedError: the code of the crash would run, but this user has neither made nor trusted it.
        CrashhuntError: the runs could not be run.
    """
    options = options or WhatIfOptions()
    reseeds = [one for one in interventions if isinstance(one, Reseed)]
    times = options.times or (FUTURES if reseeds else 1)
    _check(bundle, interventions, options)
    changes: dict[str, str] = {}
    for one in interventions:
        changes |= one.changes if isinstance(one, SetArguments) else {}
    asked = ReplayOptions(code=options.code, changes=changes, trusted=options.trusted, force=options.force)
    rerun = prepare(bundle, asked)
    recorded_spec = rerun.spec
    for one in interventions:
        rerun = one.applied(rerun)
    budget = Budget(options.stopped, options.time_s)
    with closing(reruns_of(rerun, parallel=max(1, options.parallel), stopped=budget.require)) as reruns:
        runs = _Runs(rerun, reruns, _from_step(interventions), options, times)
        try:
            if exclusions := [one for one in interventions if isinstance(one, LeaveOut)]:
                runs.leave_out(exclusions, recorded_spec)
            if reseeds:
                runs.run_futures(max(one.from_step for one in reseeds))
            else:
                runs.run_alike()
        except StoppedError:
            pass
        except NotUnderstoodError as error:
            raise _too_old() from error
        except WorkerError as error:
            if rerun.code == "snapshot" and not is_current_code(rerun):
                raise _too_old(error.message) from error
            raise
    return Counts(
        crash=bundle.id,
        interventions=(*rerun.edits, *(str(one) for one in interventions if not isinstance(one, SetArguments))),
        from_step=runs.from_step,
        code=rerun.code,
        recorded_outcome=bundle.result.outcome,
        recorded_steps=bundle.result.steps,
        asked=times,
        each=runs.counted,
        interrupted=budget.why if len(runs.found) < times else "",
        warnings=rerun.warnings,
    )


def future_seed(seed: int, number: int) -> int:
    """Return the seed of a future, which is the same in every call for the same trial."""
    return int(np.random.SeedSequence(seed, spawn_key=(number,)).generate_state(1)[0]) >> 1


def _check(bundle: Bundle, interventions: Sequence[Intervention], options: WhatIfOptions) -> None:
    if options.code == "log":
        raise UsageError("recorded actions cannot react to a change", fix="use --code snapshot or --code current")
    if not 0 <= options.times <= _MAX_RUNS:
        raise UsageError(f"--times is {options.times}", fix=f"give 1 to {_MAX_RUNS}")
    last = bundle.result.steps - 1
    for one in interventions:
        if one.from_step is not None and not 0 <= one.from_step <= max(0, last):
            raise UsageError(
                f"--from-step is {one.from_step}", fix=f"give 0 to {last}: the trial ends at step {last + 1}"
            )


def _from_step(interventions: Iterable[Intervention]) -> int | None:
    """Return the last step that all interventions leave as recorded."""
    steps = [one.from_step for one in interventions]
    return None if None in steps else min((step for step in steps if step is not None), default=None)


def _too_old(reason: str = "") -> UsageError:
    message = "the crashhunt in the snapshot of this crash is too old for this change"
    return UsageError(f"{message}: {reason}" if reason else message, fix="add --code current")


class _Runs:
    """Runs one specification, or its futures, and keeps the results."""

    def __init__(self, rerun: Rerun, reruns: Reruns, from_step: int | None, options: WhatIfOptions, times: int) -> None:
        self.found: dict[int, Run] = {}
        self.from_step = from_step
        self._rerun, self._reruns, self._times, self._watch = rerun, reruns, times, options.watch
        self._spec = rerun.spec
        self._prefix = None if from_step is None else up_to(rerun.recorded, from_step)

    @property
    def counted(self) -> tuple[Run, ...]:
        """Return the runs before the first unfinished run, by number."""
        first = next(number for number in itertools.count() if number not in self.found)
        return tuple(self.found[number] for number in range(first))

    def leave_out(self, interventions: Sequence[LeaveOut], recorded: TrialSpec) -> None:
        """Determine the actors of the recorded trial, and exclude some of them."""
        (ended,) = self._reruns.run([replace(recorded, only=(ALL_AGENTS,))])
        same = ended.result.digest == self._rerun.bundle.result.digest
        entered = ended.entered if same else ()
        for one in interventions:
            entered = one.taking_part(entered, self._rerun.worker.scenario.agents)
        self._spec = replace(self._spec, only=entered)

    def run_alike(self) -> None:
        """Run the unchanged specification as often as requested."""
        self._run(list(range(self._times)), lambda _: self._spec)

    def run_futures(self, after: int) -> None:
        """Run futures of the trial, or refuse if the simulator does not support futures.

        Raises:
            UsageError: the first futures are all equal, or a future differs when it is run again.
        """

        def future(number: int) -> TrialSpec:
            seed = future_seed(self._spec.seed, number)
            return replace(self._spec, reseeding=Reseeding(after, seed))

        title = self._rerun.worker.scenario.backend.title
        again = self._run([*range(_SELF_TEST_RUNS), 0], future)
        one, other = again[0], again[_SELF_TEST_RUNS]
        if not (one.excluded or other.excluded) and one.digest != other.digest:
            raise UsageError(
                f"--futures: {title} ran the same future twice with different results, so futures cannot be counted",
                fix="omit --futures",
            )
        tested = list(again.values())
        begun = _SELF_TEST_RUNS
        if _equal_futures(tested):  # chance may be rare, so that a few say little
            tested += self._run(list(range(begun, _COMPARED_FUTURES)), future).values()
            begun = _COMPARED_FUTURES
            if equal := _equal_futures(tested):
                raise UsageError(
                    f"--futures: {equal} futures with different seeds are bit-identical: {title} draws no random "
                    f"number after step {after} that changes the run",
                    fix="give an earlier step, or omit --futures",
                )
        self._run(list(range(begun, self._times)), future)

    def _run(self, numbers: Sequence[int], spec: Callable[[int], TrialSpec]) -> dict[int, Run]:
        """Run some futures; return all of them by index, and keep the runs with numbers up to the requested number."""
        if not numbers:
            return {}
        places: dict[int, Run] = {}
        for ended in self._reruns.run([spec(number) for number in numbers]):
            number = numbers[ended.place]
            places[ended.place] = run = self._counted(number, ended)
            if number < self._times and number not in self.found:
                self.found[number] = run
                if self._watch is not None:
                    self._watch(len(self.found), self._times)
        return places

    def _counted(self, number: int, ended: EndedRun) -> Run:
        """Return how a run ended, and whether the run counts.

        Raises:
            UsageError: the changed trial cannot be set up; all other runs would fail in the same way.
        """
        result = ended.result
        if result.outcome is Outcome.INVALID and not result.was_killed_from_outside:
            message = result.failure.message if result.failure else "its trial could not be set up"
            raise UsageError(f"the run cannot be set up: {message}", fix="give another change than this one")
        crashed = result.outcome in self._rerun.worker.crash_on
        return Run(
            number=number,
            outcome=result.outcome,
            steps=result.steps,
            digest=result.digest,
            crashed=crashed,
            excluded=self._why_excluded(ended, crashed=crashed),
        )

    def _why_excluded(self, ended: EndedRun, *, crashed: bool) -> str:
        result = ended.result
        if result.was_killed_from_outside:
            return f"its process was killed from outside: {result.failure.message if result.failure else ''}"
        if not crashed and result.outcome not in _HARMLESS_OUTCOMES:
            return f"{result.outcome} is no outcome that this hunt counts"
        if self._prefix is None or self.from_step is None:
            return ""
        if ended.recording is None:
            return "it left no recording"
        if ended.recording.steps < self.from_step:
            return f"it ended at step {ended.recording.steps}, before step {self.from_step}"
        divergence = first_divergence(self._prefix, up_to(ended.recording, self.from_step))
        return "" if divergence is None else f"it differs from the recording: {divergence}"


def _equal_futures(runs: Iterable[Run]) -> int:
    """Return the number of futures if all are equal; 0 if they differ, or if there is only one future."""
    digests = {run.number: run.digest for run in runs if not run.excluded}
    return len(digests) if len(digests) > 1 and len(set(digests.values())) == 1 else 0


# Counts of what-if runs: how many crashed, survived or do not count, in one shape for all callers.


@dataclass(frozen=True, slots=True, kw_only=True)
class Run(Serializable):
    """The result of one run."""

    number: int  # number of the run among the requested runs, counted from 0
    outcome: Outcome  # outcome of the run
    steps: int  # number of completed steps
    digest: str  # digest of the run's recording; runs with equal digests are bit-identical
    crashed: bool  # whether the hunt counts the outcome as a crash
    excluded: str = ""  # reason why the run does not count; empty if it counts


@dataclass(frozen=True, slots=True, kw_only=True)
class Counts(Serializable):
    """The counted runs of one question."""

    crash: str  # the id of the crash
    interventions: tuple[str, ...]  # the changes of the trial, as text
    # the step up to which each counted run was bit-identical to the recording; None if the change holds from the start,
    # so that no step is compared
    from_step: int | None
    code: str  # the code that drove, ``snapshot`` or ``current``
    recorded_outcome: Outcome  # the outcome of the recorded trial
    recorded_steps: int  # number of steps of the recorded trial
    asked: int  # number of requested runs
    each: tuple[Run, ...]  # the runs, by number
    # the reason why `each` has fewer runs than requested; empty if all runs finished. After an interruption, `each`
    # ends before the first unfinished run: short runs finish first, so counting all finished runs would favour early
    # crashes.
    interrupted: str = ""
    warnings: tuple[str, ...] = ()  # warnings about possible causes of different results, as text

    json_keys = (
        "crash", "interventions", "from_step", "code", "recorded_outcome", "recorded_steps", "asked", "runs",
        "crashed", "survived", "excluded", "share", "interval", "outcomes", "earliest_crash_step",
        "median_crash_step", "different", "interrupted", "warnings", "each",
    )  # fmt: skip

    @property
    def counted(self) -> tuple[Run, ...]:
        """The runs that count."""
        return tuple(run for run in self.each if not run.excluded)

    @property
    def runs(self) -> int:
        """The number of runs that count."""
        return len(self.counted)

    @property
    def crashed(self) -> int:
        """The number of counted runs that crashed."""
        return sum(run.crashed for run in self.counted)

    @property
    def survived(self) -> int:
        """The number of counted runs that did not crash."""
        return self.runs - self.crashed

    @property
    def excluded(self) -> dict[str, int]:
        """The number of runs that do not count, by reason."""
        return dict(Counter(run.excluded for run in self.each if run.excluded))

    @property
    def share(self) -> float | None:
        """The share of counted runs that crashed; None if no run counts."""
        return self.crashed / self.runs if self.runs else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """The Wilson interval of the share, with 95 % confidence.

        The interval is None if there are no runs, or if all runs are equal and thus count as one run.
        """
        return wilson(self.crashed, self.runs) if self.different > 1 else None

    @property
    def outcomes(self) -> dict[str, int]:
        """The number of counted runs with each outcome, the most frequent outcome first."""
        return dict(Counter(str(run.outcome) for run in self.counted).most_common())

    @property
    def crash_steps(self) -> list[int]:
        """The numbers of the steps in which counted runs crashed, sorted."""
        return sorted(run.steps for run in self.counted if run.crashed)

    @property
    def earliest_crash_step(self) -> int | None:
        """The number of the step of the earliest crash; None without a crash."""
        return min(self.crash_steps, default=None)

    @property
    def median_crash_step(self) -> float | None:
        """The median of the steps in which counted runs crashed; None without a crash."""
        return statistics.median(self.crash_steps) if self.crash_steps else None

    @property
    def different(self) -> int:
        """The number of different recordings among the counted runs."""
        return len({run.digest for run in self.counted})

    def lines(self) -> list[str]:
        """Return the results as lines of text: the answer first, then the evidence."""
        answer = f"{self.crash}: {self.crashed} of {self.runs} runs crashed"
        if self.interval is not None and self.share is not None:
            low, high = self.interval
            answer += f" ({format_percent(self.share)}; 95 % interval: {format_percent(low)} to {format_percent(high)})"
        found = [answer, f"  recorded: {self.recorded_outcome} at step {self.recorded_steps}"]
        found += [f"  changed: {what}" for what in self.interventions]
        if self.outcomes:
            found.append(f"  outcomes: {', '.join(f'{name} {count}' for name, count in self.outcomes.items())}")
        if self.median_crash_step is not None:
            found.append(f"  crash steps: earliest {self.earliest_crash_step}, median {self.median_crash_step:g}")
        if self.from_step is not None and self.runs:
            found.append(
                f"  verified: every run started at step 0 and matched the recording up to step {self.from_step}"
            )
        if self.runs > 1 and self.different == 1:
            found.append("  all runs are bit-identical")
        found += [f"  excluded: {count} runs, {reason}" for reason, count in self.excluded.items()]
        if self.interrupted:
            why = "interrupted" if self.interrupted == "stopped" else self.interrupted
            found.append(f"  {why}: {len(self.each)} of {self.asked} runs count, those before the first unfinished run")
        return [*found, *(f"  warning: {warning}" for warning in self.warnings)]
