"""The text that the terminal shows at the end of a replay."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.base.text import aligned, command_line, in_lines
from crashhunt.report._argument_words import format_inputs

if TYPE_CHECKING:
    from crashhunt.replays import ReplayReport


_MAX_FILES = 10


def describe_replay(report: ReplayReport) -> str:
    """Return the result of a replay as text."""
    bundle, rerun = report.bundle, report.rerun
    drivers = {
        "log": "the recorded actions",
        "current": "today's code",
        "snapshot": f"the code in {command_line(rerun.snapshot.path)}",
    }
    was = bundle.result
    lines = [
        f"{bundle.id}: {was.summary}",
        f"  {format_inputs(was)}",
        f"  driven by {drivers[rerun.code]}",
    ]
    lines += [f"  {line}" for line in _describe_differences(rerun.code_differences)]
    lines += [f"  warning: {warning}" for warning in rerun.warnings]
    lines += [f"  no longer the recorded trial: {edit}" for edit in rerun.edits]
    lines += _verdict(report)
    if report.divergence is not None and report.verdict != "not_comparable":
        lines.append(f"  first difference at {report.divergence}")
        lines += [f"    {line}" for line in _table_around(report)]
    times = sum(report.verdicts.values())
    if times > 1:
        counts = ", ".join(f"{count} {verdict.replace('_', ' ')}" for verdict, count in report.verdicts.items())
        lines.append(f"of {times} runs: {counts}")
    return in_lines(lines)


def _describe_differences(files: list[str] | None) -> list[str]:
    if files is None:
        return []
    if not files:
        return ["no file of the code differs from the snapshot"]
    more = f" and {len(files) - _MAX_FILES} more" if len(files) > _MAX_FILES else ""
    return [f"differs from the snapshot: {', '.join(files[:_MAX_FILES])}{more}"]


def _verdict(report: ReplayReport) -> list[str]:
    was, now, steps = report.bundle.result, report.replayed, report.rerun.recorded.steps
    count = f"{report.steps_replayed} of {steps} steps, digest {now.digest}"
    if report.verdict == "reproduced":
        what = "every observation, action and scene is bit-identical"
        if report.rerun.code == "log":
            what = "every observation and scene that results from the recorded actions is bit-identical"
        return [f"reproduced: {count}", f"  {what}"]
    if report.rerun.elsewhere and report.verdict == "changed":
        return [f"changed: it crashes there as well; {now.summary}", f"  it was: {was.summary}"]
    if report.verdict == "fixed":
        return [f"fixed: no crash; {now.summary}", f"  it was: {was.summary}"]
    if report.verdict == "changed":
        what = "it crashes now" if report.bundle.is_near_miss else "it still crashes, in a run that differs"
        return [f"changed: {what}", f"  it was: {was.summary}", f"  it is:  {now.summary}"]
    if report.verdict == "not_comparable":
        ended = [f"  it was: {was.summary}", f"  it is:  {now.summary}"] if report.rerun.other_traffic else []
        return [f"not comparable: {report.reason}", *ended]
    lines = [f"diverged: {count}"]
    if was.outcome is not now.outcome or was.steps != now.steps:
        lines.append(f"  now: {now.summary}")
    return lines


def _table_around(report: ReplayReport) -> list[str]:
    if not report.around or report.divergence is None:
        return []
    rows = [("step", "recorded", "replayed")]
    for step, was, now in report.around:
        mark = ("<- first difference",) if step == report.divergence.step else ()
        rows.append((str(step), "-" if was is None else f"{was!r}", "-" if now is None else f"{now!r}", *mark))
    return aligned(rows)
