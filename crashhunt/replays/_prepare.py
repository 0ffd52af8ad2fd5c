"""Preparation of a replay: the recording, the edited trial, the code that drives, and the warnings."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from crashhunt.base import layout
from crashhunt.base.calls import clear_constructor
from crashhunt.base.errors import UsageError
from crashhunt.base.sandbox import landlock_version
from crashhunt.crashes import is_bundle_trusted, refuse_side_effects, refuse_untrusted
from crashhunt.episode import WorkerSettings
from crashhunt.plans import read_settings, with_settings
from crashhunt.replays._edits import edited_spec
from crashhunt.scenario import argument_values, load_order_change, load_scenario, with_recorded_load_order
from crashhunt.snapshots import (
    Snapshot,
    code_differences,
    environment_changes,
    processor,
    program_warnings,
    vector_extension,
)
from crashhunt.trial import SENSOR_KINDS
from crashhunt.trial_reruns import Reruns, Where

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from crashhunt.crashes import Bundle
    from crashhunt.plans import HuntSettings
    from crashhunt.recording import Recording
    from crashhunt.replays._edits import Edits
    from crashhunt.scenario import Scenario
    from crashhunt.trial import TrialSpec, Value


Code = Literal["snapshot", "current", "log"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """The options of a debugged replay."""

    until: int  # number of steps to run
    stop_at: int = 0  # the step in which the debugger stops in ``act`` of the crashed agent; 0 for none
    to_stderr: bool = False  # whether the output of the process goes to standard error
    quiet: bool = False  # whether to hide the output of the process, including the simulator's warnings
    panels: tuple[int, Path] | None = None  # the first step whose panels are drawn, and the folder for the pictures
    # wall time between two steps in the simulator's window, in s; the window pauses before the crash. With None, no
    # window opens.
    window: float | None = None


@clear_constructor
@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayOptions:
    """The options of a replay."""

    # what controls the agents: the code of the snapshot, the current code, or the recorded actions
    code: Code = "snapshot"
    # new value of each argument, by ``NAME`` or ``AGENT.NAME``
    changes: Mapping[str, str] = field(default_factory=dict)
    force: bool = False  # whether to replay from a damaged snapshot
    times: int = 1  # number of replays
    scenario: str = ""  # name or path of another scenario in which to drive; empty for the scenario of the crash
    accelerate: bool = True  # whether simulators are accelerated if the results stay bit-identical
    # whether the code of the crash may run; None to determine it. If the code is not trusted, only recorded actions are
    # replayed, and only if the simulator runs no other code.
    trusted: bool | None = None
    # what to examine in a process that uses this process's terminal; None to run in the background without the terminal
    look: Look | None = None


@dataclass(frozen=True, slots=True)
class Rerun:
    """A crash that has been prepared for a replay."""

    bundle: Bundle  # bundle of the crash
    recorded: Recording  # the recording of the crash
    spec: TrialSpec  # the trial to run, with all edits
    worker: WorkerSettings  # settings of the worker that runs the trial; its scratch folder is not set yet
    code: Code  # the code that controls the agents, as in `ReplayOptions`
    snapshot: Snapshot  # snapshot of the bundle
    edits: tuple[str, ...]  # the differences from the recorded trial, as text
    warnings: tuple[str, ...]  # warnings about possible causes of different results, as text
    # the edits that do not concern the agents; if the crash does not occur, they may be the reason
    other_traffic: tuple[str, ...] = ()
    elsewhere: bool = False  # whether the replay uses another scenario, so that its steps cannot be compared

    @property
    def code_differences(self) -> list[str] | None:
        """The files of today's code that differ from the snapshot; None if today's code does not run."""
        if self.code != "current":
            return None
        return code_differences(self.snapshot, [setup.agent for setup in self.worker.scenario.agents.values()])

    @property
    def defaults(self) -> dict[tuple[str, str], Value | None]:
        """The default of each argument, by agent (empty for the scenario) and name; None if there is no default."""
        scenario = self.worker.scenario
        found = {("", name): known.default for name, known in scenario.scenario_arguments().items()}
        for agent in scenario.agents:
            found |= {(agent, name): known.default for name, known in scenario.agent_arguments(agent).items()}
        return found


def prepare(bundle: Bundle, options: ReplayOptions) -> Rerun:
    """Check a bundle, and return everything that is needed to run its crash again.

    Raises:
        BundleError: the bundle is damaged.
        UsageError: an edit is invalid.
        UntrustedError: the code of the crash would run, but the crash is neither made on this machine nor trusted.
    """
    recorded = bundle.recording()
    snapshot = Snapshot(bundle.hunt / layout.SNAPSHOTS / bundle.snapshot)
    warnings = []
    code: Code = options.code
    if code == "snapshot" and not snapshot.has_code:
        code = "current"
        warnings.append("the hunt kept no snapshot of the code (--no-snapshot), so that today's code drives")
    faults: list[str] = []
    if options.force:
        faults = snapshot.faults()
        warnings += [f"the snapshot is damaged: {fault}" for fault in faults]
    else:
        snapshot.verify()
    trusted = is_bundle_trusted(bundle, faults=faults) if options.trusted is None else options.trusted
    if not trusted and options.code != "log":
        raise refuse_untrusted(bundle)
    warnings += [f"{name} was not in the snapshot, and may make a difference" for name in snapshot.additions()]
    settings = read_settings(bundle.hunt / layout.HUNT)
    settings = replace(settings, run=replace(settings.run, accelerate=settings.run.accelerate and options.accelerate))
    scenario = with_settings(snapshot.scenario, settings)
    scenario = with_recorded_load_order(scenario, snapshot.environment.get("load_order"))
    warnings += _machine_warnings(scenario, snapshot)
    if code == "snapshot" and trusted:
        warnings += program_warnings(snapshot, [setup.agent for setup in scenario.agents.values()])
    runs = None if code == "log" or not trusted else snapshot.code if code == "snapshot" else ()
    spec, edits = edited_spec(bundle.result.spec, settings, snapshot.settings, options.changes, code=runs)
    warnings += edits.ignored
    if not options.scenario:
        _refuse_unsupported(scenario, spec)
    if code == "log":
        _refuse_changed(edits, options.scenario)
        if not trusted:
            refuse_side_effects(scenario, settings, spec.scenario_arguments)
            if not landlock_version():
                warnings.append("this kernel has no Landlock, with which the simulator could write in its folder only")
        scenario, spec = _with_recorded_actions(scenario, spec, bundle, recorded)
    if options.scenario:
        scenario, spec = _in_scenario(options.scenario, settings, spec, recorded.prologue.step_length_s)
        elsewhere = f"the scenario was {settings.scenario} and is {options.scenario}"
        edits = replace(edits, others=(*edits.others, elsewhere))
    worker = WorkerSettings(
        scenario=scenario,
        oracles=settings.oracles,
        crash_on=settings.crash_on,
        scratch=Path(),
        code=snapshot.code if code == "snapshot" else (),
        argument_files=snapshot.argument_files if code == "snapshot" else {},
        timeout_s=settings.run.timeout_s,
        step_timeout_s=settings.run.step_timeout_s,
        keep_trials=True,
        sealed=None if code != "log" or trusted else (str(bundle.path.resolve()),),
    )
    return Rerun(
        bundle=bundle,
        recorded=recorded,
        spec=spec,
        worker=worker,
        code=code,
        snapshot=snapshot,
        edits=edits.all,
        warnings=tuple(warnings),
        other_traffic=edits.others,
        elsewhere=bool(options.scenario),
    )


def _machine_warnings(scenario: Scenario, snapshot: Snapshot) -> Iterator[str]:
    """Yield what differs between the machine of the crash and this one, as text."""
    environment = snapshot.environment
    for name, (then, now) in environment_changes(environment).items():
        yield f"{name} was {then} and is {now}"
    if changed := load_order_change(scenario, environment.get("load_order")):
        yield changed
    if not scenario.backend.per_processor:
        return
    if (there := environment.get("cpu", "")) != (here := processor()):
        yield f"the processor was {there!r} and is {here!r}, on which NumPy may round otherwise"
    elif (there := environment.get("simd", "")) and there != (here := vector_extension()):
        yield f"the processor had the vector extension {there} and has {here}, with which NumPy may round otherwise"


def _with_recorded_actions(
    scenario: Scenario, spec: TrialSpec, bundle: Bundle, recorded: Recording
) -> tuple[Scenario, TrialSpec]:
    """Return the trial with agents that repeat the recorded actions."""
    log = str((bundle.path / layout.LOG).resolve())
    # An agent that failed did not act in its last step, and neither can its record.
    acted = max((len(recorded.actions(agent)) for agent in recorded.agents), default=0)
    arguments = {agent: {"log": log, "agent": agent} for agent in scenario.agents}
    return (
        scenario.with_agents(dict.fromkeys(scenario.agents, "crashhunt.agents:Recorded")),
        replace(spec, arguments=arguments, max_steps=max(1, min(spec.max_steps, acted))),
    )


def _in_scenario(
    name: str, settings: HuntSettings, spec: TrialSpec, step_length_s: float
) -> tuple[Scenario, TrialSpec]:
    """Return the trial in another scenario, with the same agents, arguments, seed and simulation time."""
    other = load_scenario(name)
    if len(other.agents) != len(settings.agents):
        counts = f"{len(other.agents)} controlled vehicles, and the crash has {len(settings.agents)}"
        message = f"--scenario {name!r} has {counts}"
        raise UsageError(message, fix="give a scenario with as many controlled vehicles")
    ids = dict(zip(settings.agents, other.agents, strict=True))
    agents = {ids[agent]: chosen for agent, chosen in settings.agents.items()}
    shared = {key: value for key, value in spec.scenario_arguments.items() if key in other.arguments}
    there = other.backend.step_length_s(other)
    _refuse_unsupported(other, spec, chosen=name)
    return with_settings(other, replace(settings, agents=agents)), replace(
        spec,
        arguments={ids[agent]: values for agent, values in spec.arguments.items()},
        scenario_arguments=argument_values(other) | shared,
        max_steps=max(1, round(spec.max_steps * step_length_s / there)),
        only=None,
        script=None,
        disturbances=tuple(
            replace(one, step=max(1, round(one.step * step_length_s / there)), agent=ids.get(one.agent, one.agent))
            for one in spec.disturbances
        ),
    )


def _refuse_unsupported(scenario: Scenario, spec: TrialSpec, *, chosen: str = "") -> None:
    """Refuse a trial with a disturbance that the simulator does not support, in its own or a ``chosen`` scenario."""
    able = scenario.backend.disturbances
    for one in spec.disturbances:
        if able is not None and one.what not in (*able, *SENSOR_KINDS):
            where = f"--scenario {chosen!r}: " if chosen else ""
            fix = f"it supports {', '.join((*able, *SENSOR_KINDS))}"
            fix = "replay with --set disturbances=none as well" if chosen else fix
            raise UsageError(f"{where}{scenario.backend.title} does not support the disturbance {one.what!r}", fix=fix)


def _refuse_changed(edits: Edits, scenario: str) -> None:
    """Refuse a changed trial or another scenario, for which the recorded actions are not meant."""
    if edits.all:
        raise UsageError(
            f"the recorded actions cannot be repeated, because the trial was changed: {edits.all[0]}",
            fix="run the agent's code in the changed trial, with --code snapshot",
        )
    if scenario:
        message = f"recorded actions belong to the recorded scenario, not to {scenario!r}"
        raise UsageError(message, fix="omit --scenario or --from-log")


def is_current_code(rerun: Rerun) -> bool:
    """Return whether the trials run with the current crashhunt, and not with the crashhunt of the snapshot."""
    if not rerun.worker.code:
        return True
    files = rerun.snapshot.manifest["files"]
    ours = {name: entry for name, entry in files.items() if f"/{layout.PACKAGE.name}/executors/" in name}
    return bool(ours) and all(_is_ours(name, entry["size"]) for name, entry in ours.items())


def _is_ours(name: str, size: int) -> bool:
    path = layout.PACKAGE / name.partition(f"/{layout.PACKAGE.name}/")[2]
    try:
        return os.stat(path).st_size == size  # noqa: PTH116
    except OSError:
        return False


_SUSPENDED_SETUPS = 2  # suspended set-ups of each worker: most runs begin as the crash did


def reruns_of(
    rerun: Rerun,
    *,
    parallel: int,
    stopped: Callable[[], bool],
    keep_all: bool = True,
    warm_copies: int = _SUSPENDED_SETUPS,
    todays: bool | None = None,
) -> Reruns:
    """Return an object that runs trials that differ from the trial of a crash.

    Args:
        rerun: the crash whose trial is changed.
        parallel: number of trials at a time.
        stopped: function that returns whether to stop, or raises an exception; called repeatedly.
        keep_all: whether trials without a crash are recorded as well.
        warm_copies: number of suspended simulators for each worker, which have already been set up.
        todays: whether trials run with the current crashhunt and not with the snapshot's; None to determine it.
    """
    worker = replace(rerun.worker, keep_trials=keep_all, warm_copies=warm_copies)
    where: Where = "current" if (is_current_code(rerun) if todays is None else todays) else "snapshot"
    return Reruns(worker, where, parallel=parallel, stopped=stopped, numbered=True)
