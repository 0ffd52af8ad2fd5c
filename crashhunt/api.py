"""The functions of the command line for Python: ``import crashhunt``."""

from __future__ import annotations

import os
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.calls import called_with, clear_calls
from crashhunt.base.plugins import refuse_while_importing
from crashhunt.plans import Request, Spec, hunt_options

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from crashhunt.analysis import Counts, Form, Intervention, Shrunk
    from crashhunt.crashes import Bundle, Judgement
    from crashhunt.hunts import Hunt, HuntReport, HuntStatus
    from crashhunt.plans import HuntSettings
    from crashhunt.replays import Code, ReplayReport
    from crashhunt.scenario import Scenario
    from crashhunt.snapshots import SnapshotOptions


@dataclass(frozen=True)
class _Place:
    directory: Path | str


@dataclass(frozen=True)
class HuntCall(Request, _Place):
    """Arguments of `prepare`: the request, whose numbers are required and positional, and the directory of the hunt.

    Args:
        directory: directory of the hunt, created if it does not exist. An existing hunt with the same settings resumes.
        parallel: number of trials at a time; 0 for one per core.
        trials: maximum number of trials; 0 for no limit, which needs a ``duration``.
        max_steps: maximum number of steps of a trial.
        snapshot: options of the snapshot, instead of the ``snapshot_…`` arguments.
        overwrite: whether a new hunt replaces an existing one.
        command: the command line, which is written to ``hunt.toml`` as a comment.
    """

    parallel: int = field()
    trials: int = field()
    max_steps: int = field()
    _: KW_ONLY
    snapshot: SnapshotOptions | None = None
    overwrite: bool = False
    command: Sequence[str] | None = None


@dataclass(frozen=True)
class RunCall(HuntCall):
    """Arguments of `run`: all arguments of `prepare`, and a function that receives the progress.

    Args:
        directory: directory of the hunt, created if it does not exist. An existing hunt with the same settings resumes.
        parallel: number of trials at a time; 0 for one per core.
        trials: maximum number of trials; 0 for no limit, which needs a ``duration``.
        max_steps: maximum number of steps of a trial.
        watch: function called with the progress of the hunt about ten times a second.
        snapshot: options of the snapshot, instead of the ``snapshot_…`` arguments.
        overwrite: whether a new hunt replaces an existing one.
        command: the command line, which is written to ``hunt.toml`` as a comment.
    """

    _: KW_ONLY
    watch: Callable[[HuntStatus], None] | None = None


@called_with(HuntCall, documents=hunt_options())
def prepare(asked: HuntCall) -> Hunt:
    """Return a hunt that is ready to run.

    Raises:
        CrashhuntError: the input is invalid; the message gives the reason.
    """
    return _prepared(asked)


def _prepared(asked: HuntCall) -> Hunt:
    refuse_while_importing()
    # Refuse values out of range before large imports: the user waits at a terminal.
    request = asked.checked()
    from crashhunt.plans import plan_with_code

    def survey(scenario: Scenario, request: Request, settings: HuntSettings) -> Scenario:
        from crashhunt.hunts import TrafficSurveyor

        return TrafficSurveyor(Path(asked.directory), overwrite=asked.overwrite)(scenario, request, settings)

    found, settings, code = plan_with_code(request, survey=survey)
    from crashhunt.hunts import Hunt
    from crashhunt.snapshots import SnapshotOptions

    snapshot = asked.snapshot if asked.snapshot is not None else SnapshotOptions.of(asked)
    return Hunt(
        Path(asked.directory),
        found,
        settings,
        command=list(asked.command) if asked.command is not None else None,
        overwrite=asked.overwrite,
        seed_given=asked.seed is not None,
        snapshot=snapshot,
        imported=code.imported,
    )


@called_with(RunCall, documents=hunt_options())
def run(asked: RunCall) -> HuntReport:
    """Hunt for a crash, as ``crashhunt run`` does, and return the result.

    Raises:
        CrashhuntError: the input is invalid; the message gives the reason.
    """
    return _prepared(asked).run(asked.watch)


@clear_calls()
def replay(
    crash: Bundle | Path | str,
    crash_id: str = "",
    *,
    code: Code = "snapshot",
    changes: Mapping[str, Spec] | None = None,
    times: int = 1,
    force: bool = False,
    scenario: str | Path = "",
    accelerate: bool = True,
    trust: bool = False,
) -> ReplayReport:
    """Run a saved crash again in a new process, as ``crashhunt replay`` does.

    Args:
        crash: directory of a hunt or of one crash, or a crash of a hunt that `load` returned.
        crash_id: id of a crash of the hunt; by default the crash with the fewest steps.
        code: the code that drives: the code of the ``snapshot``, the ``current`` code, or the recorded actions of the
            ``log``.
        changes: new value of each argument, by ``NAME`` or ``AGENT.NAME``.
        times: number of replays.
        force: whether to replay from a damaged snapshot.
        scenario: name or path of another scenario in which the same agents drive; it may use another simulator.
        accelerate: whether to speed up simulators if the results stay bit-identical.
        trust: whether to run the crash's code even if it is neither made here nor trusted. With the actions of the
            ``log``, the scenario may then have side effects.

    Returns:
        The verdict on the replay, with its evidence.

    Raises:
        UntrustedError: the code of the crash would run, but the crash is neither made on this machine nor trusted.
        CrashhuntError: the crash cannot be run.
    """
    from crashhunt.plans import spec_words
    from crashhunt.replays import ReplayOptions, replay as replayed

    edits = spec_words(changes)
    options = ReplayOptions(
        code=code, changes=edits, times=times, force=force, scenario=str(scenario), accelerate=accelerate,
        trusted=True if trust else None,
    )  # fmt: skip
    return replayed(_bundle_of(crash, crash_id), options)


@clear_calls()
def what_if(
    crash: Bundle | Path | str,
    crash_id: str = "",
    *,
    changes: Mapping[str, Spec] | None = None,
    from_step: int | None = None,
    before_s: float | None = None,
    agent: str = "",
    arguments: Mapping[str, Spec] | None = None,
    futures: bool = False,
    overrule: str = "",
    leave_out: Sequence[str] = (),
    interventions: Sequence[Intervention] = (),
    code: Code | None = None,
    times: int = 0,
    parallel: int = 0,
    time_s: float | None = None,
    trust: bool = False,
) -> Counts:
    """Run a saved crash again with changes and count the outcomes, as ``crashhunt whatif`` does.

    Args:
        crash: directory of a hunt or of one crash, or a crash of a hunt that `load` returned.
        crash_id: id of a crash of the hunt; by default the crash with the fewest steps.
        changes: new value of each argument, by ``NAME`` or ``AGENT.NAME``; with a step, arguments of the agent from
            this step on.
        from_step: number of steps that stay as recorded.
        before_s: time before the crash at which the change begins, in s of simulation time; replaces ``from_step``.
        agent: the agent that takes control after the step, as ``module:Name``.
        arguments: arguments of the agent that takes control.
        futures: whether to give the simulator's random generators another seed after the step, a different seed in each
            run.
        overrule: the manoeuvre that replaces the agent's actions after the step: ``brake``, ``left``, ``right``,
            ``keep_lane``, ``keep_speed``, ``reference_speed``, ``reference_lanes`` or ``reference``. If there are
            several agents, ``ID=brake`` names the agent.
        leave_out: ids of actors to remove from the start.
        interventions: further interventions, from `crashhunt.analysis`.
        code: the code that drives: the code of the ``snapshot``, or the ``current`` code, which is the default with
            ``agent``.
        times: number of runs; 0 for 50 with ``futures``, else 1.
        parallel: number of runs at a time; 0 for one per core.
        time_s: maximum wall time of all runs, in s.
        trust: whether to run the crash's code even if it is neither made here nor trusted.

    Returns:
        The counts of the outcomes, with each run.

    Raises:
        UntrustedError: the code of the crash would run, but the crash is neither made on this machine nor trusted.
        CrashhuntError: the crash cannot be run, or the simulator does not support the change.
    """
    from crashhunt.analysis import WhatIfOptions, interventions_of, what_if as counted
    from crashhunt.plans import spec_words

    bundle = _bundle_of(crash, crash_id)
    asked = interventions_of(
        bundle, changes=spec_words(changes), from_step=from_step, before_s=before_s, agent=agent,
        arguments=spec_words(arguments), futures=futures, overrule=overrule, leave_out=tuple(leave_out), code=code,
        more=tuple(interventions),
    )  # fmt: skip
    options = WhatIfOptions(
        code=code or ("current" if agent else "snapshot"), times=times, time_s=time_s,
        parallel=parallel or len(os.sched_getaffinity(0)), trusted=True if trust else None,
    )  # fmt: skip
    return counted(bundle, asked, options)


@clear_calls()
def judge(
    crash: Bundle | Path | str,
    crash_id: str = "",
    *,
    runs: int = 60,
    why: int = 80,
    reference: int = 20,
    drivers: bool = True,
    parallel: int = 0,
    trust: bool = False,
) -> Judgement:
    """Find the last avoidable step and the causes of a crash, as ``crashhunt judge`` does.

    The answers are written to ``crash.json``.

    Args:
        crash: directory of a hunt or of one crash, or a crash of a hunt that `load` returned.
        crash_id: id of a crash of the hunt; by default the crash with the fewest steps.
        runs: maximum number of trials to find the last avoidable step.
        why: maximum number of trials to find the causes; 0 for none.
        reference: maximum number of trials with a reference driver, to find what the agent omitted to do; 0 for none.
        drivers: whether models of a competent driver are asked whether they would have prevented a collision.
        parallel: number of trials at a time; 0 for one per core.
        trust: whether to run the crash's code even if it is neither made here nor trusted.

    Returns:
        The judgement, together with the answers of earlier calls.

    Raises:
        UntrustedError: the code of the crash would run, but the crash is neither made on this machine nor trusted.
        CrashhuntError: the crash cannot be judged.
    """
    from crashhunt.analysis import judge_bundle
    from crashhunt.crashes import judgement_of
    from crashhunt.replays import ReplayOptions

    options = ReplayOptions(force=True, trusted=True if trust else None)
    judged = judge_bundle(
        _bundle_of(crash, crash_id), options, runs=runs, why=why, reference=reference, drivers=drivers,
        parallel=parallel,
    )  # fmt: skip
    judgement = judgement_of(judged)
    assert judgement is not None
    return judgement


@clear_calls()
def shrink(
    crash: Bundle | Path | str,
    crash_id: str = "",
    *,
    budget: int = 500,
    time_s: float | None = None,
    form: Form = "either",
    parallel: int = 0,
    trust: bool = False,
) -> Shrunk:
    """Minimize a crash, as ``crashhunt shrink`` does, and write the minimized crash next to it.

    Args:
        crash: directory of a hunt or of one crash, or a crash of a hunt that `load` returned.
        crash_id: id of a crash of the hunt; by default the crash with the fewest steps.
        budget: maximum number of trials.
        time_s: maximum wall time of the search, in s.
        form: how the other actors move: by themselves (``traffic``), along recorded paths (``scripted``), or depending
            on the number of remaining actors (``either``).
        parallel: number of trials at a time; 0 for one per core.
        trust: whether to run the crash's code even if it is neither made here nor trusted.

    Returns:
        The minimized crash in ``small``, and what was removed.

    Raises:
        UntrustedError: the code of the crash would run, but the crash is neither made on this machine nor trusted.
        CrashhuntError: the crash cannot be minimized.
    """
    from crashhunt.analysis import shrink as shrunk

    return shrunk(
        _bundle_of(crash, crash_id), budget=budget, time_s=time_s, form=form, parallel=parallel,
        trusted=True if trust else None,
    )  # fmt: skip


def _bundle_of(crash: Bundle | Path | str, crash_id: str) -> Bundle:
    refuse_while_importing()
    from crashhunt.crashes import Bundle, find_bundle

    return crash if isinstance(crash, Bundle) else find_bundle(Path(crash), crash_id)
