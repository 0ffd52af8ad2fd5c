"""Replay and confirmation: run a crash again, in a fresh process, and say whether it is the same to the bit."""

from __future__ import annotations

import shutil
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import BundleError, CrashhuntError, UntrustedError, UsageError
from crashhunt.base.temporary import temporary_folder
from crashhunt.episode import scratch_of
from crashhunt.executors import run_alone
from crashhunt.recording import Recording, read_black_box
from crashhunt.replays._prepare import ReplayOptions, prepare
from crashhunt.replays._verdict import judged, up_to
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.crashes import Bundle
    from crashhunt.executors import SharedExecutors
    from crashhunt.recording import DivergenceData
    from crashhunt.replays._debugger import Look
    from crashhunt.replays._prepare import Rerun
    from crashhunt.replays._verdict import ReplayReport
    from crashhunt.trial import TrialResult

__all__ = ["confirm", "replay"]


def replay(bundle: Bundle, options: ReplayOptions | None = None) -> ReplayReport:
    """Run a crash again from its bundle alone, and compare every step with the log.

    The scenario comes from the snapshot, whatever has become of the original; so does the agent's code, unless the
    options say otherwise. With recorded actions at the wheel, nothing of the bundle's code is run.

    Raises:
        BundleError: the bundle is damaged.
        CrashhuntError: the replay could not be run.
    """
    options = options or ReplayOptions()
    if options.times < 1:
        raise UsageError(f"--times is {options.times}", fix="give at least 1")
    rerun = prepare(bundle, options)
    if options.look is not None:
        return _look_into(rerun, options.look)
    reports = [_run(rerun) for _ in range(options.times)]
    shown = next((report for report in reports if report.verdict != "reproduced"), reports[0])
    return replace(shown, verdicts=Counter(report.verdict for report in reports))


def confirm(
    bundle: Bundle,
    stopped: Callable[[], bool] = lambda: False,
    *,
    failed: list[TrialResult] | None = None,
    executors: SharedExecutors | None = None,
    trusted: bool | None = None,
) -> Bundle | None:
    """Return the bundle with the verdict of a first replay, and until when braking would have avoided the crash.

    Args:
        bundle: the crash.
        stopped: asked now and then whether to give up; what a replay does afterwards says nothing about the crash.
        failed: gets what came of the replay, where that is not the crash.
        executors: which run it; a new Python process where there are none.
        trusted: whether its code may run; None to find out.

    Returns:
        None where it was given up. A replay that cannot be run to its end, as when it is killed from outside again and
        again, says nothing about the crash: then `confirmed` is None, and `why_unconfirmed` has the reason.

    Raises:
        UntrustedError: its code is neither made here nor trusted.
    """
    try:
        rerun = prepare(bundle, ReplayOptions(force=True, trusted=trusted))
        report = _run(replace(rerun, worker=replace(rerun.worker, find_escapes=True)), stopped, executors)
    except _StoppedError:
        return None
    except UntrustedError:  # which says nothing about the crash
        raise
    except _NotSetUpError as error:
        failure: DivergenceData = {"step": 0, "agent": "", "field": "replay", "recorded": None, "replayed": str(error)}
        return replace(bundle, confirmed=False, divergence=failure, why_unconfirmed="")
    except CrashhuntError as error:  # it did not take place, or not to its end
        return replace(bundle, confirmed=None, divergence=None, why_unconfirmed=error.message)
    divergence = report.divergence.to_json() if report.divergence else None
    confirmed = report.verdict == "reproduced"
    if not confirmed and failed is not None:
        failed.append(report.replayed)
    now = report.replayed
    escape, why_no_escape = (now.escape, now.why_no_escape) if confirmed else (None, "")
    result = replace(bundle.result, escape=escape, why_no_escape=why_no_escape)
    return replace(bundle, result=result, confirmed=confirmed, divergence=divergence, why_unconfirmed="")


class _StoppedError(Exception):
    pass


class _NotSetUpError(CrashhuntError):
    """The replay took place, and did not get as far as the first step."""


def _run(
    rerun: Rerun, stopped: Callable[[], bool] = lambda: False, executors: SharedExecutors | None = None
) -> ReplayReport:
    with temporary_folder("replay") as scratch:
        found = None
        if executors is not None:
            found = executors.run(rerun.worker, rerun.spec, stopped)
        elif alone := run_alone(replace(rerun.worker, scratch=scratch), rerun.spec, stopped):
            found = alone, scratch_of(scratch, rerun.spec.number)
        if found is None:
            raise _StoppedError
        result, recorded_in = found
        message = result.failure.message if result.failure else "it left no recording"
        if result.was_killed_from_outside:
            raise CrashhuntError(
                f"the replay was {message}",
                fix="run it again; where memory ran out, with less beside it",
                where=rerun.bundle.id,
            )
        try:
            if result.outcome is Outcome.INVALID:
                raise _not_set_up(rerun, message)
            replayed = Recording(read_black_box(recorded_in / layout.BLACK_BOX))
        except BundleError as error:
            raise _not_set_up(rerun, message) from error
        finally:
            shutil.rmtree(recorded_in, ignore_errors=True)
    recorded = rerun.recorded
    if rerun.code == "log":
        return judged(rerun, up_to(recorded, recorded.steps), up_to(replayed, replayed.steps), result)
    return judged(rerun, recorded, replayed, result)


def _look_into(rerun: Rerun, look: Look) -> ReplayReport:
    """Run the first steps with the terminal at hand, and compare them with those of the log."""
    from crashhunt.replays._debugger import debug

    result, replayed = debug(rerun, look)
    if result.outcome is Outcome.INVALID:
        raise _not_set_up(rerun, result.failure.message if result.failure else "it left no recording")
    recorded = rerun.recorded
    if look.until <= recorded.steps:
        recorded, replayed = up_to(recorded, look.until), up_to(replayed, look.until)
    report = judged(rerun, recorded, replayed, result, whole=look.until > recorded.steps)
    return replace(report, verdicts={report.verdict: 1})


def _not_set_up(rerun: Rerun, message: str) -> _NotSetUpError:
    return _NotSetUpError(
        f"the replay did not get as far as the first step: {message}",
        fix="see that what the agent needs is installed",
        where=rerun.bundle.id,
    )
