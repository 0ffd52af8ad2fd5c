"""A crash in some lines, as the end of a hunt shows it: what happened, where, and whether it is confirmed."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from crashhunt.base.text import command_line, count_of, format_clock
from crashhunt.crashes import own_frames
from crashhunt.report._argument_words import format_inputs
from crashhunt.report._disturbance_words import list_disturbances
from crashhunt.trial import BAD_ACTION

if TYPE_CHECKING:
    from crashhunt.base.json_types import Plain
    from crashhunt.crashes import Bundle
    from crashhunt.trial import Failure, TrialResult


_MAX_OUTPUT_CHARACTERS = 300  # of the last line that a process has printed
_SOURCE_WORDS = {
    ("overlap", "reported"): "the simulator reports it, and the outlines overlap",
    ("overlap",): "the outlines overlap; the simulator does not report it",
    ("reported",): "the simulator reports it; the outlines do not overlap",
}


def describe_crash(bundle: Bundle) -> list[str]:
    """Return a crash as lines of text."""
    result = bundle.result
    lines = [
        f"{bundle.id}  ({result.outcome.category})",
        f"  {result.summary}",
        f"  after {count_of(result.steps, 'step')}, simulation time {format_clock(result.sim_time_s)}",
        f"  {format_inputs(result)}",
    ]
    lines += [f"  {line}" for line in (*_evidence(result), *list_disturbances(result))]
    lines.append(f"  saved in {command_line(bundle.path)}")
    if bundle.confirmed is not None:
        first: Plain = bundle.divergence or {}
        what = f"{first.get('agent') or ''} {first.get('field')}".strip()
        diverged = f"first difference at step {first.get('step')}, {what}"
        lines.append(
            "  confirmed: bit-identical when replayed in a new process"
            if bundle.confirmed
            else f"  flaky: the replay in a new process deviates ({diverged})"
        )
    elif bundle.why_unconfirmed:
        lines.append(f"  not confirmed: {bundle.why_unconfirmed}. Run the same command to try again")
    if result.why_no_escape:
        why = result.why_no_escape
        lines.append(f"  last avoidable step: unknown, because {why}. Run the same command to try again")
    return lines


def _evidence(result: TrialResult) -> list[str]:
    lines = []
    hit, failure, event = result.collision, result.failure, result.event
    if event is not None and math.isfinite(event.x):
        where = f"at ({event.x:.1f}, {event.y:.1f})" + (f" on lane {event.lane}" if event.lane else "")
        lines.append(f"{event.agent} {where}, at {event.speed:.1f} m/s")
    if hit is not None:
        where = f"at ({hit.x:.1f}, {hit.y:.1f})" + (f" on lane {hit.lane}" if hit.lane else "")
        speeds = f"{hit.collider} at {hit.collider_speed:.1f} m/s"
        if hit.victim:
            speeds += f", {hit.victim} at {hit.victim_speed:.1f} m/s"
        if math.isfinite(hit.x):  # an environment without a scene has no places
            lines.append(f"{where}; {speeds}")
        if hit.victim:
            lines.append(_SOURCE_WORDS.get(hit.seen_by, f"seen by {', '.join(hit.seen_by)}"))
    if failure is not None:
        lines += innermost_calls(failure, 3, lines=4)
        if failure.last_output.strip():
            last = failure.last_output.strip().splitlines()[-1]
            lines.append(f"last output: {last[:_MAX_OUTPUT_CHARACTERS]}{'…' * (len(last) > _MAX_OUTPUT_CHARACTERS)}")
    return lines


def innermost_calls(failure: Failure, calls: int, *, lines: int) -> list[str]:
    """Return the last ``lines`` of a traceback, or the innermost ``calls`` of the stack of a dead or hanging process.

    For an action that crashhunt refuses, the message is complete, and the calls are crashhunt's own.
    """
    if failure.kind == BAD_ACTION and not own_frames(failure):
        return []
    frames = [line for line in failure.traceback.splitlines() if line.strip()]
    # Python prints the most recent call last. faulthandler, for dead and hanging processes, prints it first.
    dumped = [line for line in frames if line.lstrip().startswith("File")]
    return dumped[:calls] if failure.kind in ("signal", "timeout") else frames[-lines:]
