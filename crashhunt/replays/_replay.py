"""Replay: run a saved crash again, in a fresh process, and say whether it is the same to the bit."""

from __future__ import annotations

import tempfile
from collections import Counter
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from crashhunt.base import layout
from crashhunt.base.errors import BundleError, CrashhuntError, UsageError
from crashhunt.base.sandbox import landlock_version
from crashhunt.crashes import refuse_side_effects
from crashhunt.episode import WorkerSettings, scratch_of
from crashhunt.executors import FreshProcessExecutor
from crashhunt.plans import read_settings, with_settings
from crashhunt.recording import Divergence, Recording, Tag, first_divergence, read_black_box, values_around
from crashhunt.replays._edits import edited_spec
from crashhunt.scenario import argument_values, load_scenario
from crashhunt.snapshots import Snapshot, environment_changes, processor
from crashhunt.trial import Outcome, finite

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from crashhunt.crashes import Bundle
    from crashhunt.plans import HuntSettings
    from crashhunt.replays._debugger import Look
    from crashhunt.scenario import Scenario
    from crashhunt.trial import TrialResult, TrialSpec

__all__ = ["Code", "ReplayOptions", "ReplayReport", "Rerun", "Verdict", "confirm", "prepare", "replay"]

_LOOK_EVERY_S = 0.5  # how late Ctrl-C may be

Verdict = Literal["reproduced", "diverged", "fixed", "changed", "not_comparable"]
Code = Literal["snapshot", "current", "log"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayOptions:
    """How to replay.

    Args:
        code: who drives: the code of the snapshot, today's, or the recorded actions.
        changes: ``NAME`` or ``AGENT.NAME`` of an argument to another value.
        force: replay even from a snapshot that is damaged.
        times: how often.
        scenario: the name or path of another scenario to drive in; empty for that of the crash.
        accelerate: whether simulators are sped up where that changes no bit.
        trusted: whether it is ours. Of a stranger's, recorded actions are driven only where that cannot do anything
            but simulate.
        look: what to look at, in a process that has this one's terminal; without it, it runs in one of its own.
    """

    code: Code = "snapshot"
    changes: Mapping[str, str] = field(default_factory=dict)
    force: bool = False
    times: int = 1
    scenario: str = ""
    accelerate: bool = True
    trusted: bool = True
    look: Look | None = None


@dataclass(frozen=True, slots=True)
class Rerun:
    """A crash, ready to be run again.

    Args:
        bundle: the crash.
        recorded: the recording.
        spec: the trial, with all edits.
        worker: where and how it runs; its scratch folder is not set yet.
        code: who drives.
        snapshot: of the bundle.
        edits: what is not as it was recorded, in words.
        warnings: what may make a difference, in words.
        other_traffic: those edits that are not about who drives: without the crash, they may be why.
        elsewhere: whether it is in another scenario, so that steps cannot be compared.
    """

    bundle: Bundle
    recorded: Recording
    spec: TrialSpec
    worker: WorkerSettings
    code: Code
    snapshot: Snapshot
    edits: tuple[str, ...]
    warnings: tuple[str, ...]
    other_traffic: tuple[str, ...] = ()
    elsewhere: bool = False


@dataclass(frozen=True, slots=True)
class ReplayReport:
    """What came of a replay.

    Args:
        rerun: what was run.
        verdict: whether it is the same; of several times, the first that was not.
        replayed: the trial that was run now.
        recording: of it.
        divergence: the first difference.
        around: step, recorded and replayed value of the field that differs, in the steps around.
        reason: why the two cannot be compared.
        verdicts: of all runs, and how many had each.
    """

    rerun: Rerun
    verdict: Verdict
    replayed: TrialResult
    recording: Recording
    divergence: Divergence | None = None
    around: tuple[tuple[int, Any, Any], ...] = ()
    reason: str = ""
    verdicts: Mapping[Verdict, int] = field(default_factory=dict)

    @property
    def bundle(self) -> Bundle:
        """The crash."""
        return self.rerun.bundle

    @property
    def steps_replayed(self) -> int:
        """How many steps it completed."""
        return self.recording.steps

    def to_json(self) -> dict[str, Any]:
        """Return the shape that ``replay --json`` prints."""
        return {
            "crash": self.bundle.id,
            "verdict": self.verdict,
            "code": self.rerun.code,
            "steps_recorded": self.rerun.recorded.steps,
            "steps_replayed": self.steps_replayed,
            "digest_recorded": self.bundle.result.digest,
            "digest_replayed": self.replayed.digest,
            "divergence": self.divergence.to_json() if self.divergence else None,
            "outcome_recorded": str(self.bundle.result.outcome),
            "outcome_replayed": str(self.replayed.outcome),
            "reason": self.reason,
            "edits": list(self.rerun.edits),
            "warnings": list(self.rerun.warnings),
            "times": sum(self.verdicts.values()),
            "agreed": self.verdicts.get("reproduced", 0),
            "verdicts": dict(self.verdicts),
        }


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


def confirm(bundle: Bundle, stopped: Callable[[], bool] = lambda: False) -> Bundle | None:
    """Return the bundle with the verdict of a first replay, and until when braking would have avoided the crash.

    Args:
        bundle: the crash.
        stopped: asked now and then whether to give up; what a replay does afterwards says nothing about the crash.

    Returns:
        None where it was given up.
    """
    try:
        rerun = prepare(bundle, ReplayOptions(force=True))
        report = _run(replace(rerun, worker=replace(rerun.worker, find_escapes=True)), stopped)
    except _StoppedError:
        return None
    except CrashhuntError as error:
        failure = {"step": 0, "agent": "", "field": "replay", "recorded": None, "replayed": str(error)}
        return replace(bundle, confirmed=False, divergence=failure)
    divergence = report.divergence.to_json() if report.divergence else None
    confirmed = report.verdict == "reproduced"
    result = replace(bundle.result, escape=report.replayed.escape if confirmed else None)
    return replace(bundle, result=result, confirmed=confirmed, divergence=divergence)


def prepare(bundle: Bundle, options: ReplayOptions) -> Rerun:
    """Check a bundle, and gather what its crash needs to be run again.

    Raises:
        BundleError: the bundle is damaged.
        UsageError: an edit cannot be meant.
    """
    recorded = bundle.recording()
    snapshot = Snapshot(bundle.hunt / layout.SNAPSHOTS / bundle.snapshot)
    warnings = []
    code: Code = options.code
    if code == "snapshot" and not snapshot.has_code:
        code = "current"
        warnings.append("the hunt kept no snapshot of the code (--no-snapshot), so that today's code drives")
    if options.force:
        warnings += [f"the snapshot is damaged: {fault}" for fault in snapshot.faults()]
    else:
        snapshot.verify()
    warnings += [f"{name} was not in the snapshot, and may make a difference" for name in snapshot.additions()]
    settings = read_settings(bundle.hunt / layout.HUNT)
    settings = replace(settings, run=replace(settings.run, accelerate=settings.run.accelerate and options.accelerate))
    scenario = with_settings(snapshot.scenario(), settings)
    environment = snapshot.environment()
    warnings += [f"{name} was {then} and is {now}" for name, (then, now) in environment_changes(environment).items()]
    there, here = environment.get("cpu", ""), processor()
    if scenario.backend.per_processor and there != here:
        warnings.append(f"the processor was {there!r} and is {here!r}, on which NumPy may round otherwise")
    runs = None if code == "log" or not options.trusted else snapshot.code if code == "snapshot" else ()
    spec, edits = edited_spec(bundle.result.spec, settings, snapshot.settings(), options.changes, code=runs)
    warnings += edits.ignored
    if code == "log":
        if edits.all:
            raise UsageError(
                f"recorded actions belong to the recorded trial, and {edits.all[0]}", fix="replay with --code snapshot"
            )
        if not options.trusted:
            refuse_side_effects(scenario, settings, spec.scenario_arguments)
            if not landlock_version():
                warnings.append("this kernel has no Landlock, with which the simulator could write in its folder only")
        log = str((bundle.path / layout.LOG).resolve())
        scenario = scenario.with_agents(dict.fromkeys(scenario.agents, "crashhunt.agents:Recorded"))
        # An agent that failed did not act in its last step, and neither can its record.
        acted = max((len(recorded.actions(agent)) for agent in recorded.agents), default=0)
        arguments = {agent: {"log": log, "agent": agent} for agent in scenario.agents}
        spec = replace(spec, arguments=arguments, max_steps=max(1, min(spec.max_steps, acted)))
    if options.scenario:
        if code == "log":
            message = f"recorded actions belong to the recorded scenario, not to {options.scenario!r}"
            raise UsageError(message, fix="leave --scenario or --from-log out")
        scenario, spec = _elsewhere(options.scenario, settings, spec, recorded.prologue.step_length_s)
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
        keep_trials=True,
        sealed=None if code != "log" or options.trusted else (str(bundle.path),),
    )
    return Rerun(
        bundle,
        recorded,
        spec,
        worker,
        code,
        snapshot,
        edits.all,
        tuple(warnings),
        other_traffic=edits.others,
        elsewhere=bool(options.scenario),
    )


def _elsewhere(name: str, settings: HuntSettings, spec: TrialSpec, step_length_s: float) -> tuple[Scenario, TrialSpec]:
    """The same agents, arguments, seed and simulation time elsewhere; the traffic is its own but for what both have."""
    other = load_scenario(name)
    if len(other.agents) != len(settings.agents):
        counts = f"{len(other.agents)} controlled vehicles, and the crash has {len(settings.agents)}"
        message = f"--scenario {name!r} has {counts}"
        raise UsageError(message, fix="give one with as many")
    ids = dict(zip(settings.agents, other.agents, strict=True))
    agents = {ids[agent]: chosen for agent, chosen in settings.agents.items()}
    shared = {key: value for key, value in spec.scenario_arguments.items() if key in other.arguments}
    there = other.backend.step_length_s(other)
    return with_settings(other, replace(settings, agents=agents)), replace(
        spec,
        arguments={ids[agent]: values for agent, values in spec.arguments.items()},
        scenario_arguments=argument_values(other) | shared,
        max_steps=max(1, round(spec.max_steps * step_length_s / there)),
    )


class _StoppedError(Exception):
    pass


def _run(rerun: Rerun, stopped: Callable[[], bool] = lambda: False) -> ReplayReport:
    with tempfile.TemporaryDirectory(prefix="crashhunt-replay-") as folder:
        scratch = Path(folder)
        executor = FreshProcessExecutor(replace(rerun.worker, scratch=scratch))
        try:
            executor.submit(rerun.spec)
            found: list[TrialResult] = []
            while not found:
                found = list(executor.completed(_LOOK_EVERY_S))
                if stopped():
                    raise _StoppedError
            result = found[0]
        finally:
            executor.close()
        message = result.failure.message if result.failure else "it left no recording"
        if result.outcome is Outcome.INVALID:
            raise _not_set_up(rerun, message)
        try:
            replayed = Recording(read_black_box(scratch_of(scratch, rerun.spec.number) / layout.BLACK_BOX))
        except BundleError as error:
            raise _not_set_up(rerun, message) from error
    recorded = rerun.recorded
    if rerun.code == "log":
        return _report(rerun, _up_to(recorded, recorded.steps), _up_to(replayed, replayed.steps), result)
    return _report(rerun, recorded, replayed, result)


def _look_into(rerun: Rerun, look: Look) -> ReplayReport:
    """Run the first steps with the terminal at hand, and compare them with those of the log."""
    from crashhunt.replays._debugger import debug

    result, replayed = debug(rerun, look)
    if result.outcome is Outcome.INVALID:
        raise _not_set_up(rerun, result.failure.message if result.failure else "it left no recording")
    recorded = rerun.recorded
    if look.until <= recorded.steps:
        recorded, replayed = _up_to(recorded, look.until), _up_to(replayed, look.until)
    report = _report(rerun, recorded, replayed, result, whole=look.until > recorded.steps)
    return replace(report, verdicts={report.verdict: 1})


def _report(
    rerun: Rerun, recorded: Recording, replayed: Recording, result: TrialResult, *, whole: bool = True
) -> ReplayReport:
    if rerun.elsewhere:
        if result.outcome in rerun.worker.crash_on:
            return ReplayReport(rerun, "changed", result, replayed)
        return ReplayReport(rerun, "not_comparable", result, replayed, reason=_no_fix(rerun))
    divergence = first_divergence(recorded, replayed)
    if divergence is None and whole:
        divergence = _end_divergence(rerun.bundle.result, result, rerun.code)
    verdict, reason = _judge(rerun, replayed, result, divergence, whole=whole)
    around = tuple(values_around(recorded, replayed, divergence)) if divergence is not None else ()
    return ReplayReport(rerun, verdict, result, replayed, divergence, around, reason)


def _judge(
    rerun: Rerun, replayed: Recording, result: TrialResult, divergence: Divergence | None, *, whole: bool
) -> tuple[Verdict, str]:
    if divergence is None:
        return "reproduced", ""
    was, now = rerun.recorded.prologue, replayed.prologue
    if was != now:
        return "not_comparable", f"what is recorded is another: {_prologue_change(was, now)}"
    changed = environment_changes(rerun.snapshot.environment())
    for name in rerun.worker.scenario.backend.versions:
        if name in changed:
            return "not_comparable", f"the simulator differs: {name} was {changed[name][0]} and is {changed[name][1]}"
    crashed = result.outcome in rerun.worker.crash_on
    # Whoever stopped before the crash does not know whether it would have come.
    if (rerun.code == "current" or rerun.edits) and crashed:
        return "changed", ""
    if rerun.other_traffic and whole:
        return "not_comparable", _no_fix(rerun)
    if (rerun.code == "current" or rerun.edits) and whole:
        return "fixed", ""
    return "diverged", ""


def _prologue_change(was: Any, now: Any) -> str:
    if was.step_length_s != now.step_length_s:
        return f"the step length was {was.step_length_s:g} s and is {now.step_length_s:g} s"
    for left, right in zip(was.agents, now.agents, strict=False):
        if left != right:
            return f"{left.id}'s channel was {_channel(left)} and is {_channel(right)}"
    return f"the agents were {', '.join(a.id for a in was.agents)} and are {', '.join(a.id for a in now.agents)}"


def _channel(agent: Any) -> str:
    return f"{agent.observation_shape} {agent.observation_dtype} → {agent.action_shape} {agent.action_dtype}"


def _not_set_up(rerun: Rerun, message: str) -> CrashhuntError:
    return CrashhuntError(
        f"the replay did not get as far as the first step: {message}",
        fix="see that what the agent needs is installed",
        where=rerun.bundle.id,
    )


def _no_fix(rerun: Rerun) -> str:
    return (
        f"no crash, but {rerun.other_traffic[0]}, and one draw of other traffic does not show a fix: hunt there with "
        "--keep-going, and compare"
    )


def _end_divergence(was: TrialResult, now: TrialResult, code: Code) -> Divergence | None:
    """Where two runs that are equal to the bit ended in another way, such as a hang that did not come again."""
    if code == "log" and was.collision is None:  # the record of an agent's fault does not fail
        return None
    if was.outcome is not now.outcome:
        return Divergence(now.steps, "", "outcome", str(was.outcome), str(now.outcome))
    if was.steps != now.steps:
        return Divergence(now.steps, "", "steps", was.steps, now.steps)
    left, right = ({} if hit is None else finite(asdict(hit)) for hit in (was.collision, now.collision))
    # Another crashhunt may know more about the same collision, or measure it in another way, but not who hit whom.
    for name in {**left, **right}:
        always = name in ("agent", "role", "collider", "victim")
        if (code == "snapshot" or always) and left.get(name) != right.get(name):
            return Divergence(now.steps, left.get("agent", ""), f"collision.{name}", left.get(name), right.get(name))
    return None


def _up_to(recording: Recording, step: int) -> Recording:
    """The recording to the end of a step. What recorded actions can bring back ends with its last complete one."""
    ends = [number for number, record in enumerate(recording.records) if record.tag == Tag.STEP]
    return recording if step >= len(ends) else Recording(recording.records[: ends[step] + 1])
