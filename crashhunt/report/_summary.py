"""What people are told at the end of a hunt and of a replay."""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING

from crashhunt.report._screen import format_arguments, format_seconds

if TYPE_CHECKING:
    from crashhunt.bundle import Bundle
    from crashhunt.hunt import HuntReport
    from crashhunt.replay import ReplayReport
    from crashhunt.trial import TrialResult

__all__ = ["describe_hunt", "describe_replay"]

_SHOWN = 10
_WITNESSES = {
    ("overlap", "reported"): "the simulator reports it, and the outlines overlap",
    ("overlap",): "the outlines overlap; the simulator does not report it",
    ("reported",): "the simulator reports it; the outlines do not overlap",
}


def describe_hunt(report: HuntReport, program: str = "crashhunt") -> str:
    """Return what came of a hunt: what crashed, how, where it is, and how to replay it."""
    ran = sum(report.outcomes.values())
    outcomes = ", ".join(f"{name} {count}" for name, count in report.outcomes.items()) or "none"
    count = f"{ran} of {report.settings.trials} trials, {report.steps_total} steps"
    lines = [f"{count}, {format_seconds(report.wall_s)} ({outcomes}); hunt seed {report.settings.seed}"]
    if report.stopped_because == "no_valid_trial":
        lines.append(f"Not one trial was valid: {report.reason}")
    if report.stopped_because == "interrupted":
        lines.append("Interrupted; the same command goes on from here.")
    if not report.crashes and report.stopped_because == "all_trials":
        lines.append("No crash was found.")
    for bundle in report.crashes[:_SHOWN]:
        lines += ["", *_describe_crash(bundle)]
    if len(report.crashes) > _SHOWN:
        lines += ["", f"… and {len(report.crashes) - _SHOWN} more in {report.directory / 'crashes'}"]
    if report.crashes:
        first = report.crashes[0]
        command = [program, "replay", str(report.directory)]
        if len(report.crashes) > 1:
            command += ["--crash", first.id]
        lines += ["", f"Replay it:  {shlex.join(command)}"]
    return "\n".join(lines)


def describe_replay(report: ReplayReport) -> str:
    """Return what came of a replay."""
    bundle = report.bundle
    driver = (
        "the recorded actions" if report.code == "log" else f"the code in {bundle.hunt / 'snapshots' / bundle.snapshot}"
    )
    lines = [
        f"{bundle.id}: {bundle.result.summary}",
        f"  seed {bundle.result.spec.seed}, {format_arguments(bundle.result)}",
        f"  driven by {driver}",
        f"{report.verdict}: {report.steps_replayed} of {report.recorded.steps} steps, digest {report.replayed.digest}",
    ]
    if report.divergence is not None:
        lines.append(f"  first difference at {report.divergence}")
    elif report.code == "log":
        lines.append("  every observation and scene that the recorded actions lead to is the same to the bit")
    else:
        lines.append("  every observation, action and scene is the same to the bit")
    return "\n".join(lines)


def _describe_crash(bundle: Bundle) -> list[str]:
    result = bundle.result
    lines = [
        f"{bundle.id}  ({result.outcome.category})",
        f"  {result.summary}",
        f"  after {result.steps} steps, simulation time {result.sim_time_s:.1f} s",
        f"  seed {result.spec.seed}, {format_arguments(result)}",
    ]
    lines += [f"  {line}" for line in _evidence(result)]
    lines.append(f"  saved in {bundle.path}")
    if bundle.confirmed is not None:
        first = bundle.divergence or {}
        diverged = f"first difference at step {first.get('step')}, {first.get('agent')} {first.get('field')}"
        lines.append(
            "  confirmed: a fresh process did the same to the bit"
            if bundle.confirmed
            else f"  flaky: a fresh process did not do the same ({diverged})"
        )
    return lines


def _evidence(result: TrialResult) -> list[str]:
    lines = []
    hit, failure = result.collision, result.failure
    if hit is not None:
        where = f"at ({hit.x:.1f}, {hit.y:.1f})" + (f" on lane {hit.lane}" if hit.lane else "")
        speeds = f"{hit.collider} at {hit.collider_speed:.1f} m/s"
        if hit.victim:
            speeds += f", {hit.victim} at {hit.victim_speed:.1f} m/s"
        lines.append(f"{where}; {speeds}")
        if hit.victim:
            lines.append(_WITNESSES.get(hit.seen_by, f"seen by {', '.join(hit.seen_by)}"))
    if failure is not None:
        frames = failure.traceback.strip().splitlines()
        # Python prints the most recent call last; faulthandler, which speaks for the dead and the stuck, first.
        dumped = [line for line in frames if line.lstrip().startswith("File")]
        lines += dumped[:3] if failure.kind in ("signal", "timeout") else frames[-4:]
        if failure.last_output.strip():
            lines.append(f"last output: {failure.last_output.strip().splitlines()[-1]}")
    return lines
