"""Replay: run a saved crash again, in a fresh process, and say whether it is the same to the bit."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from crashhunt.errors import BundleError, CrashhuntError
from crashhunt.executors import BLACK_BOX, FreshProcessExecutor, WorkerSettings, scratch_of
from crashhunt.plan import with_settings
from crashhunt.recording import Divergence, Recording, Tag, first_divergence, read_black_box
from crashhunt.settings import HuntSettings, read_settings
from crashhunt.snapshot import Snapshot

if TYPE_CHECKING:
    from crashhunt.bundle import Bundle
    from crashhunt.trial import TrialResult

__all__ = ["ReplayReport", "Verdict", "confirm", "replay"]

Verdict = Literal["reproduced", "diverged", "fixed", "changed", "not_comparable"]


@dataclass(frozen=True, slots=True)
class ReplayReport:
    """What came of a replay.

    Args:
        bundle: the crash.
        verdict: whether it is the same.
        code: whose code drove: the snapshot's, or the log's recorded actions.
        recorded: the recording.
        replayed: the trial that was run now.
        steps_replayed: how many steps it completed.
        divergence: the first difference.
    """

    bundle: Bundle
    verdict: Verdict
    code: Literal["snapshot", "current", "log"]
    recorded: Recording
    replayed: TrialResult
    steps_replayed: int
    divergence: Divergence | None

    def to_json(self) -> dict[str, Any]:
        """Return the shape that ``replay --json`` prints."""
        return {
            "crash": self.bundle.id,
            "verdict": self.verdict,
            "code": self.code,
            "steps_recorded": self.recorded.steps,
            "steps_replayed": self.steps_replayed,
            "digest_recorded": self.bundle.result.digest,
            "digest_replayed": self.replayed.digest,
            "divergence": self.divergence.to_json() if self.divergence else None,
        }


def replay(bundle: Bundle, *, from_log: bool = False) -> ReplayReport:
    """Run a crash again from its bundle alone.

    The scenario and the agent's code come from the snapshot, whatever has become of the originals.

    Args:
        bundle: the crash.
        from_log: drive with the recorded actions instead of the agent's code.

    Raises:
        BundleError: the bundle is damaged.
        CrashhuntError: the replay could not be run.
    """
    snapshot = Snapshot(bundle.hunt / "snapshots" / bundle.snapshot)
    snapshot.verify()
    return _replay(bundle, snapshot, read_settings(bundle.hunt / "hunt.toml"), from_log=from_log)


def confirm(bundle: Bundle, snapshot: Snapshot, settings: HuntSettings) -> Bundle:
    """Return the bundle with the verdict of a first replay."""
    try:
        report = _replay(bundle, snapshot, settings, from_log=False)
    except CrashhuntError as error:
        failure = {"step": 0, "agent": "", "field": "replay", "recorded": None, "replayed": str(error)}
        return replace(bundle, confirmed=False, divergence=failure)
    divergence = report.divergence.to_json() if report.divergence else None
    return replace(bundle, confirmed=report.verdict == "reproduced", divergence=divergence)


def _replay(bundle: Bundle, snapshot: Snapshot, settings: HuntSettings, *, from_log: bool) -> ReplayReport:
    recorded = bundle.recording()
    if recorded.digest != bundle.result.digest:
        raise BundleError(
            "the log does not have the digest that crash.json says",
            fix="get an undamaged copy of the bundle",
            where=str(bundle.path / "log.mcap"),
        )
    scenario = with_settings(snapshot.scenario(), settings)
    spec = bundle.result.spec
    if from_log:
        log = str((bundle.path / "log.mcap").resolve())
        scenario = scenario.with_agents(dict.fromkeys(scenario.agents, "crashhunt.agents:Recorded"))
        spec = replace(spec, arguments={agent: {"log": log, "agent": agent} for agent in scenario.agents})
        # An agent that failed did not act in its last step, and neither can its record.
        acted = max((len(recorded.actions(agent)) for agent in recorded.agents), default=0)
        spec = replace(spec, max_steps=max(1, min(spec.max_steps, acted)))
    with tempfile.TemporaryDirectory(prefix="crashhunt-replay-") as folder:
        scratch = Path(folder)
        worker = WorkerSettings(
            scenario=scenario,
            oracles=settings.oracles,
            crash_on=settings.crash_on,
            scratch=scratch,
            code=str(snapshot.code.resolve()),
            timeout_s=settings.run.timeout_s,
            keep_trials=True,
        )
        executor = FreshProcessExecutor(worker)
        try:
            executor.submit(spec)
            result = next(result for _ in iter(int, 1) for result in executor.completed(1.0))
        finally:
            executor.close()
        box = scratch_of(scratch, spec.number) / BLACK_BOX
        try:
            replayed = Recording(read_black_box(box))
        except BundleError as error:
            message = result.failure.message if result.failure else str(error)
            raise CrashhuntError(
                f"the replay did not get as far as the first step: {message}",
                fix="see that what the agent needs is installed",
                where=bundle.id,
            ) from error
        shutil.rmtree(scratch, ignore_errors=True)
    if from_log:
        recorded_part, replayed_part = _driven_part(recorded), _driven_part(replayed)
    else:
        recorded_part, replayed_part = recorded, replayed
    divergence = first_divergence(recorded_part, replayed_part)
    if divergence is None and not from_log:
        divergence = _outcome_divergence(bundle.result, result)
    return ReplayReport(
        bundle,
        "reproduced" if divergence is None else "diverged",
        "log" if from_log else "snapshot",
        recorded,
        result,
        replayed.steps,
        divergence,
    )


def _outcome_divergence(was: TrialResult, now: TrialResult) -> Divergence | None:
    """Where two runs that are equal to the bit ended in another way, such as a hang that did not come again."""
    if was.outcome is now.outcome:
        return None
    return Divergence(now.steps, "", "outcome", str(was.outcome), str(now.outcome))


def _driven_part(recording: Recording) -> Recording:
    """The recording up to its last complete step: what recorded actions can bring back."""
    last = next((n for n in range(len(recording.records) - 1, -1, -1) if recording.records[n].tag == Tag.STEP), None)
    return recording if last is None else Recording(recording.records[: last + 1])
