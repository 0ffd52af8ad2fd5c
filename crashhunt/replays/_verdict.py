"""Whether a replay is the same as what was recorded, and where it first is not."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, NotRequired, TypedDict

from crashhunt.plans import load_order_change
from crashhunt.recording import Divergence, Recording, Tag, first_divergence, values_around
from crashhunt.snapshots import environment_changes

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.base.plain import Plain
    from crashhunt.crashes import Bundle
    from crashhunt.recording import AgentChannel, DivergenceData, Prologue
    from crashhunt.replays._prepare import Code, Rerun
    from crashhunt.trial import TrialResult

__all__ = ["ReplayData", "ReplayReport", "Verdict", "judged", "up_to"]

_AROUND = 2  # steps that are told before and after the first difference

Verdict = Literal["reproduced", "diverged", "fixed", "changed", "not_comparable"]


class ReplayData(TypedDict):
    """What ``replay --json`` prints of a crash; ``table`` has the fields that were asked for, a row a step."""

    crash: str
    verdict: Verdict
    code: Code
    steps_recorded: int
    steps_replayed: int
    digest_recorded: str
    digest_replayed: str
    divergence: DivergenceData | None
    outcome_recorded: str
    outcome_replayed: str
    reason: str
    edits: list[str]
    warnings: list[str]
    times: int
    agreed: int
    verdicts: dict[Verdict, int]
    table: NotRequired[Sequence[Plain]]


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
    around: tuple[tuple[int, object, object], ...] = ()
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

    def to_json(self) -> ReplayData:
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


def judged(
    rerun: Rerun, recorded: Recording, replayed: Recording, result: TrialResult, *, whole: bool = True
) -> ReplayReport:
    """Compare two recordings of a crash.

    Args:
        rerun: what was run.
        recorded: the recording, or its beginning.
        replayed: of as many steps.
        result: what came of the replay.
        whole: whether the replay was to end where the crash did.
    """
    if rerun.elsewhere:
        if result.outcome in rerun.worker.crash_on:
            return ReplayReport(rerun, "changed", result, replayed)
        return ReplayReport(rerun, "not_comparable", result, replayed, reason=_no_fix(rerun))
    divergence = first_divergence(recorded, replayed)
    if divergence is None and whole:
        divergence = _end_divergence(rerun.bundle.result, result, rerun.code)
    verdict, reason = _judge(rerun, replayed, result, divergence, whole=whole)
    around = tuple(values_around(recorded, replayed, divergence, reach=_AROUND)) if divergence is not None else ()
    return ReplayReport(rerun, verdict, result, replayed, divergence, around, reason)


def _judge(
    rerun: Rerun, replayed: Recording, result: TrialResult, divergence: Divergence | None, *, whole: bool
) -> tuple[Verdict, str]:
    if divergence is None:
        return "reproduced", ""
    was, now = rerun.recorded.prologue, replayed.prologue
    if was != now:
        return "not_comparable", f"what is recorded is another: {_prologue_change(was, now)}"
    environment = rerun.snapshot.environment()
    if order := load_order_change(rerun.worker.scenario, environment.get("load_order")):
        return "not_comparable", f"the simulator differs: {order}"
    changed = environment_changes(environment)
    for name in rerun.worker.scenario.backend.versions:
        if name in changed:
            return "not_comparable", f"the simulator differs: {name} was {changed[name][0]} and is {changed[name][1]}"
    crashed = result.outcome in rerun.worker.crash_on
    # Whoever stopped before the crash does not know whether it would have come.
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
    """Where two runs that are equal to the bit ended in another way, such as a hang that did not come again."""
    if code == "log" and was.collision is None:  # the record of an agent's fault does not fail
        return None
    if was.outcome is not now.outcome:
        return Divergence(now.steps, "", "outcome", str(was.outcome), str(now.outcome))
    if was.steps != now.steps:
        return Divergence(now.steps, "", "steps", was.steps, now.steps)
    left, right = (dict(hit.to_json()) if hit else {} for hit in (was.collision, now.collision))
    # Another crashhunt may know more about the same collision, or measure it in another way, but not who hit whom.
    for name in {**left, **right}:
        always = name in ("agent", "role", "collider", "victim")
        if (code == "snapshot" or always) and left.get(name) != right.get(name):
            return Divergence(
                now.steps, str(left.get("agent", "")), f"collision.{name}", left.get(name), right.get(name)
            )
    return None


def up_to(recording: Recording, step: int) -> Recording:
    """Return a recording to the end of a step. What recorded actions can bring back ends with its last whole one."""
    ends = [number for number, record in enumerate(recording.records) if record.tag == Tag.STEP]
    return recording if step >= len(ends) else Recording(recording.records[: ends[step] + 1])
