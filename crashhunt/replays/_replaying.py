"""Replay and confirmation: run a crash again in a new process, and check whether the run is bit-identical."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

from crashhunt.base.codec import Serializable
from crashhunt.base.errors import CrashhuntError, UntrustedError, UsageError
from crashhunt.crashes import with_lights
from crashhunt.recording import Divergence, Recording, Tag, first_divergence, values_around
from crashhunt.replays._prepare import Code, Look, ReplayOptions, Rerun, prepare
from crashhunt.scenario import load_order_change
from crashhunt.snapshots import environment_changes
from crashhunt.trial import Outcome, TrialResult
from crashhunt.trial_reruns import SharedReruns, StoppedError, run_alone

if TYPE_CHECKING:
    from crashhunt.base.binaries import BinaryFacts
    from crashhunt.crashes import Bundle
    from crashhunt.recording import AgentChannel, Prologue


# Whether a replay is the same as what was recorded, and where it first is not.

Verdict = Literal["reproduced", "diverged", "fixed", "changed", "not_comparable"]


@dataclass(frozen=True, slots=True)
class ReplayReport(Serializable):
    """The result of a replay.

    Args:
        rerun: description of the replayed run.
        verdict: the verdict; of several replays, the verdict of the first replay that deviates.
        replayed: result of the replayed trial.
        recording: recording of the replayed trial.
        divergence: the first difference between recording and replay.
        around: values around the divergence: step, recorded value and replayed value of the field that differs.
        reason: the reason why the two runs cannot be compared.
        verdicts: number of runs for each verdict.
        lights: lights and routes that the replay has read from the simulator, as in `layout.LIGHTS`.
    """

    rerun: Rerun
    verdict: Verdict
    replayed: TrialResult
    recording: Recording
    divergence: Divergence | None = None
    around: tuple[tuple[int, object, object], ...] = ()
    reason: str = ""
    verdicts: Mapping[Verdict, int] = field(default_factory=dict)
    lights: bytes = b""

    json_keys = (
        "crash=bundle.id", "verdict", "code=rerun.code", "steps_recorded=rerun.recorded.steps", "steps_replayed",
        "digest_recorded=bundle.result.digest", "digest_replayed=replayed.digest", "divergence",
        "outcome_recorded=bundle.result.outcome", "outcome_replayed=replayed.outcome", "reason", "edits=rerun.edits",
        "code_differences=rerun.code_differences", "warnings=rerun.warnings", "times", "agreed", "verdicts",
        "programs?",
    )  # fmt: skip

    @property
    def bundle(self) -> Bundle:
        """The bundle of the crash."""
        return self.rerun.bundle

    @property
    def programs(self) -> Mapping[str, BinaryFacts] | None:
        """What identifies the recorded programs and libraries of agents, by the word that names each."""
        return self.rerun.snapshot.environment.get("programs") or None

    @property
    def steps_replayed(self) -> int:
        """The number of completed steps of the replay."""
        return self.recording.steps

    @property
    def times(self) -> int:
        """The number of replays."""
        return sum(self.verdicts.values())

    @property
    def agreed(self) -> int:
        """The number of replays that reproduced the crash."""
        return self.verdicts.get("reproduced", 0)


def judged(
    rerun: Rerun, recorded: Recording, replayed: Recording, result: TrialResult, *, whole: bool = True
) -> ReplayReport:
    """Compare two recordings of a crash, and return the report."""
    divergence = None
    if rerun.elsewhere:
        verdict: Verdict = "changed" if result.outcome in rerun.worker.crash_on else "not_comparable"
        reason = "" if verdict == "changed" else _no_fix(rerun)
    else:
        divergence = first_divergence(recorded, replayed)
        if divergence is None and whole:
            divergence = _end_divergence(rerun.bundle.result, result, rerun.code)
        verdict, reason = _judge(rerun, replayed, result, divergence, whole=whole)
    around = tuple(values_around(recorded, replayed, divergence)) if divergence is not None else ()
    return ReplayReport(
        rerun=rerun,
        verdict=verdict,
        replayed=result,
        recording=replayed,
        divergence=divergence,
        around=around,
        reason=reason,
    )


def _judge(
    rerun: Rerun, replayed: Recording, result: TrialResult, divergence: Divergence | None, *, whole: bool
) -> tuple[Verdict, str]:
    if divergence is None:
        return "reproduced", ""
    was, now = rerun.recorded.prologue, replayed.prologue
    if was != now:
        return "not_comparable", f"what is recorded is another: {_prologue_change(was, now)}"
    environment = rerun.snapshot.environment
    if order := load_order_change(rerun.worker.scenario, environment.get("load_order")):
        return "not_comparable", f"the simulator differs: {order}"
    changed = environment_changes(environment)
    for name in rerun.worker.scenario.backend.versions:
        if name in changed:
            return "not_comparable", f"the simulator differs: {name} was {changed[name][0]} and is {changed[name][1]}"
    crashed = result.outcome in rerun.worker.crash_on
    # If the replay stopped before the step of the crash, it is unknown whether the crash reproduces.
    if (rerun.code == "current" or rerun.edits) and crashed:
        return "changed", ""
    if rerun.bundle.is_near_miss:  # there is no crash that could be fixed
        return "diverged", ""
    if rerun.other_traffic and whole:
        return "not_comparable", _no_fix(rerun)
    if (rerun.code == "current" or rerun.edits) and whole:
        return "fixed", ""
    return "diverged", ""


def _prologue_change(was: Prologue, now: Prologue) -> str:
    if was.step_length_s != now.step_length_s:
        return f"the step length was {was.step_length_s:g} s and is {now.step_length_s:g} s"
    for left, right in zip(was.agents, now.agents, strict=False):
        if left != right:
            return f"{left.id}'s channel was {_channel(left)} and is {_channel(right)}"
    return f"the agents were {', '.join(a.id for a in was.agents)} and are {', '.join(a.id for a in now.agents)}"


def _channel(agent: AgentChannel) -> str:
    return f"{agent.observation_shape} {agent.observation_dtype} → {agent.action_shape} {agent.action_dtype}"


def _no_fix(rerun: Rerun) -> str:
    return (
        f"no crash, but {rerun.other_traffic[0]}, and one draw of other traffic does not show a fix: hunt there with "
        "--keep-going, and compare"
    )


def _end_divergence(was: TrialResult, now: TrialResult, code: Code) -> Divergence | None:
    """Return where two otherwise identical recordings ended differently, such as a hang that did not reproduce."""
    if code == "log" and was.collision is None:  # the record of an agent's fault does not fail
        return None
    if was.outcome is not now.outcome:
        return Divergence(
            step=now.steps, agent="", field="outcome", recorded=str(was.outcome), replayed=str(now.outcome)
        )
    if was.steps != now.steps:
        return Divergence(step=now.steps, agent="", field="steps", recorded=was.steps, replayed=now.steps)
    left, right = (dict(hit.to_json()) if hit else {} for hit in (was.collision, now.collision))
    # Another version may describe the same collision in more detail, but agent, role and actors must be equal.
    for name in {**left, **right}:
        always = name in ("agent", "role", "collider", "victim")
        if (code == "snapshot" or always) and left.get(name) != right.get(name):
            return Divergence(
                step=now.steps,
                agent=str(left.get("agent", "")),
                field=f"collision.{name}",
                recorded=left.get(name),
                replayed=right.get(name),
            )
    return None


def up_to(recording: Recording, step: int) -> Recording:
    """Return the part of a recording up to the end of a step.

    Recorded actions can repeat the episode only up to the last complete step.
    """
    ends = [number for number, record in enumerate(recording.records) if record.tag == Tag.STEP]
    return recording if step >= len(ends) else recording.beginning(ends[step] + 1)


def replay(
    bundle: Bundle, options: ReplayOptions | None = None, stopped: Callable[[], bool] = lambda: False
) -> ReplayReport:
    """Run a crash again from its bundle alone, and compare every step with the log.

    The scenario comes from the snapshot, even if the original has changed. So does the agent's code, unless the options
    choose other code. With recorded actions, no code of the bundle runs. After a stop, the report has the replays that
    finished before.

    Raises:
        BundleError: the bundle is damaged.
        CrashhuntError: the replay could not be run.
        StoppedError: it was stopped before a replay finished.
    """
    options = options or ReplayOptions()
    if options.times < 1:
        raise UsageError(f"--times is {options.times}", fix="give at least 1")
    rerun = prepare(bundle, options)
    if options.look is not None:
        return _look_into(rerun, options.look)
    reports: list[ReplayReport] = []
    try:
        while len(reports) < options.times:
            reports.append(_run(rerun, stopped))
    except StoppedError:
        if not reports:
            raise
    shown = next((report for report in reports if report.verdict != "reproduced"), reports[0])
    return replace(shown, verdicts=Counter(report.verdict for report in reports))


def confirm(
    bundle: Bundle,
    stopped: Callable[[], bool] = lambda: False,
    *,
    failed: list[TrialResult] | None = None,
    executors: SharedReruns | None = None,
    trusted: bool | None = None,
) -> Bundle | None:
    """Return the bundle with the verdict of a first replay, and with the last step from which braking avoids the crash.

    Args:
        bundle: the crash to confirm.
        stopped: function that returns whether to stop; called repeatedly. A replay that fails after a stop does not
            count.
        failed: list to which the result of the replay is added if the replay does not crash in the same way.
        executors: the executors that run the trial; None for a new Python process.
        trusted: whether the code of the crash may run; None to determine it.

    Returns:
        The bundle with the result, or None if the confirmation was stopped. If no replay runs to its end, for example
        because it takes too long, or is killed from outside each time, `confirmed` is None and `why_unconfirmed` has
        the reason.

    Raises:
        UntrustedError: the code of the crash is neither made here nor trusted.
    """
    try:
        rerun = prepare(bundle, ReplayOptions(force=True, trusted=trusted))
        report = _run(replace(rerun, worker=replace(rerun.worker, find_escapes=True)), stopped, executors)
    except StoppedError:
        return None
    except UntrustedError:  # which says nothing about the crash
        raise
    except _NotSetUpError as error:
        failure: dict[str, object] = {
            "step": 0,
            "agent": "",
            "field": "replay",
            "recorded": None,
            "replayed": str(error),
        }
        return replace(bundle, confirmed=False, divergence=failure, why_unconfirmed="")
    except CrashhuntError as error:  # it did not take place, or not to its end
        return replace(bundle, confirmed=None, divergence=None, why_unconfirmed=error.message)
    divergence = report.divergence.to_json() if report.divergence else None
    confirmed = report.verdict == "reproduced"
    if not confirmed and failed is not None:
        failed.append(report.replayed)
    now = report.replayed
    if now.is_no_answer_to(bundle.result.outcome) and report.divergence is not None and report.divergence.is_end:
        message = now.failure.message if now.failure else ""
        return replace(bundle, confirmed=None, divergence=None, why_unconfirmed=f"the replay was {message}")
    escape, why_no_escape = (now.escape, now.why_no_escape) if confirmed else (None, "")
    result = replace(bundle.result, escape=escape, why_no_escape=why_no_escape)
    found = replace(bundle, result=result, confirmed=confirmed, divergence=divergence, why_unconfirmed="")
    return with_lights(found, report.lights) if confirmed and report.lights else found


class _NotSetUpError(CrashhuntError):
    """The replay ran, but ended before its first step."""


def _run(rerun: Rerun, stopped: Callable[[], bool], executors: SharedReruns | None = None) -> ReplayReport:
    """Run the trial and compare it with the recording.

    Raises:
        StoppedError: the user has stopped the run.
    """
    if executors is not None:
        ended = executors.run(rerun.worker, rerun.spec, stopped)
    else:
        (ended,) = run_alone(rerun.worker, rerun.spec, stopped)
    result, recorded, replayed = ended.result, rerun.recorded, ended.recording
    message = result.failure.message if result.failure else "it left no recording"
    if result.was_killed_from_outside:
        raise CrashhuntError(
            f"the replay was {message}",
            fix="run it again; if memory is short, end other processes first",
            where=rerun.bundle.id,
        )
    if result.outcome is Outcome.INVALID or replayed is None:
        raise _not_set_up(rerun, message)
    if rerun.code == "log":
        recorded, replayed = up_to(recorded, recorded.steps), up_to(replayed, replayed.steps)
    report = judged(rerun, recorded, replayed, result)
    return replace(report, lights=ended.lights) if ended.lights else report


def _look_into(rerun: Rerun, look: Look) -> ReplayReport:
    """Run the first steps attached to the terminal, and compare them with the steps of the log."""
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
