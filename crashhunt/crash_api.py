"""The functions of the command line for Python that run a saved crash again."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.calls import clear_calls
from crashhunt.base.plugins import refuse_while_importing

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.analysis import Counts, Form, Intervention, Shrunk
    from crashhunt.crashes import Bundle, Judgement
    from crashhunt.plans import Spec
    from crashhunt.replays import Code, ReplayReport


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
