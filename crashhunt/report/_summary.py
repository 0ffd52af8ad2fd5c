"""The text that the terminal shows at the end of a hunt and of a replay."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.text import aligned, command_line, count_of, in_lines, out_of
from crashhunt.crashes import count_causes, join_causes
from crashhunt.report._disturbance_words import (
    by_likelihood,
    describe_branches,
    describe_disturbances,
    describe_probes,
    list_disturbances,
)
from crashhunt.report._judgement_words import fault_words, list_preventing
from crashhunt.report._live_screen import describe_types, format_arguments, format_inputs, format_seconds
from crashhunt.report._rate_text import describe_rates
from crashhunt.report._version_words import describe_versions
from crashhunt.world import event_counts

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.base.json_types import Plain
    from crashhunt.crashes import Bundle, CauseGroup, Group, Signature
    from crashhunt.hunts import HuntReport
    from crashhunt.replays import ReplayReport
    from crashhunt.trial import TrialResult


# The table of crash types. `crashhunt.crashes` decides which crashes are of one type, and in which order.


def describe_groups(groups: Sequence[Group], known: Mapping[Signature, str] | None = None) -> str:
    """Return one line for each crash type, with its shortest crash.

    With a corpus, ``known`` has the name of its case for each known crash type.
    """
    if not groups:
        return "No crash was saved."
    hunts = {bundle.hunt for group in groups for bundle in group.bundles}
    faults = any(group.fault for group in groups)
    prevented = [list_preventing(group.preventable_by) for group in groups]
    rows = [["crashes", "type", *(["at fault"] if faults else []), "shortest"]]
    rows[0] += [*(["known as"] if known is not None else []), *(["preventable"] if any(prevented) else []), "steps"]
    for group, answers in zip(groups, prevented, strict=True):
        shortest = group.shortest
        name = shortest.id if len(hunts) == 1 else str(shortest.path)
        rows.append(
            [
                str(group.count),
                str(group.signature),
                *([fault_words(group.fault)] if faults else []),
                name,
                *([known.get(group.signature, "new")] if known is not None else []),
                *([answers] if any(prevented) else []),
                str(shortest.result.steps),
            ]
        )
    count = sum(group.count for group in groups)
    words = f"{count_of(count, 'crash')} of {describe_types(len(groups), None)}"
    saved = sum(len(group.bundles) for group in groups)
    if saved < count:
        words += f" ({saved} of {count} have a bundle{', and faults are of these' if faults else ''})"
    return "\n".join([f"{words}:", "", *aligned(rows, left=range(1, len(rows[0]) - 1))])


def describe_causes(groups: Sequence[Group], causes: Sequence[Sequence[CauseGroup]]) -> str:
    """Return the crashes by cause, each cause with a line for each crash type in which it appears."""
    joined = join_causes(groups, causes)
    rows = [["crashes", "cause and types", "judged", "shortest", "steps"]]
    for one in joined:
        rows.append([str(one.count), str(one.cause), "", "", ""])
        for group, part in one.variants:
            shortest = part.shortest
            cells = [f"  {group.signature}", str(len(part.judged)), shortest.id, str(shortest.result.steps)]
            rows.append([str(len(part.members)), *cells])
    dropped = sum(group.dropped for group in groups)
    if dropped:
        rows.append([str(dropped), "not judged: their bundles were deleted (--keep)", "", "", ""])
    count, unknown = count_causes(joined)
    words = f"{describe_types(count, None)} by cause"
    if unknown:
        words += f" (the cause of {count_of(unknown, 'more crash')} is unknown)"
    return "\n".join(["", f"{words}:", "", *aligned(rows, left=range(1, len(rows[0]) - 1))])


_MAX_SHOWN = 10
_MAX_BLOCKS = 2  # crashes that are described in full, so that the text fits a screen of 24 lines
_MAX_TYPES = 5
_MAX_LISTED = 3  # crashes of which only the names are given
_MAX_REASONS = 3
_MAX_OUTPUT_CHARACTERS = 300  # of the last line that a process has printed
_SOURCE_WORDS = {
    ("overlap", "reported"): "the simulator reports it, and the outlines overlap",
    ("overlap",): "the outlines overlap; the simulator does not report it",
    ("reported",): "the simulator reports it; the outlines do not overlap",
}


def describe_hunt(report: HuntReport, *, has_dashboard: bool = False) -> str:
    """Return the result of a hunt as text that fits a screen.

    A single crash is described with its cause, its directory and the command that replays it. Of several crashes, the
    text has each crash type with its shortest crash, and the counts of the hunt follow. With a dashboard, the last line
    is the command that shows the crashes in it.
    """
    ran = sum(report.outcomes.values())
    outcomes = ", ".join(f"{name} {count}" for name, count in report.outcomes.items()) or "none"
    total = f" ({report.steps_total} simulated in all)" if report.steps_total > report.trial_steps else ""
    count = f"{out_of(ran, report.settings.trials)} trials, {report.trial_steps} steps{total}"
    counts = f"{count}, {format_seconds(report.wall_s)} ({outcomes}); hunt seed {report.settings.seed}"
    has_types = report.kinds is not None and sum(group.count for group in report.kinds) > 1
    lines = [] if has_types else [counts]
    if report.stopped_because == "no_valid_trial":
        lines.append(f"No trial was valid: {report.reason}")
    if report.code_versions:
        lines.append(f"Note: {describe_versions(map(asdict, report.code_versions))}")
    lines += [f"Note: {note}" for note in report.notes]
    lines += _describe_audit(report)
    if report.stopped_because == "distinct":
        lines.append(f"Found {_wanted_types(report)} (--distinct {report.settings.run.distinct}).")
    if report.rate is not None:
        lines += describe_rates([report.rate]).splitlines()
    if report.copied is not None:
        number = report.copied.result.spec.number
        lines.append(f"Trial {number} did not crash, but a copy of it did. The crash reproduces from the start.")
    if report.unanswered:
        one = report.unanswered == 1
        trials, them = ("trial has", "it") if one else ("trials have", "them")
        why = "processes were killed from outside"
        fix = f"Run the same command to run {them} again."
        lines.append(f"{report.unanswered} {trials} incomplete answers: {why}. {fix}")
    if report.unconfirmed:
        count = f"{report.unconfirmed} of {len(report.crashes)} crashes"
        lines.append(f"Interrupted: {count} are not confirmed. Run the same command to confirm them.")
    elif report.stopped_because == "interrupted":
        lines.append("Interrupted. Run the same command to resume.")
    if not report.crashes and report.stopped_because in ("all_trials", "time"):
        lines.append(
            "No crash was found."
            if report.stopped_because == "all_trials"
            else "No crash was found within the time limit."
        )
    lines += _describe_events(report)
    lines += describe_probes(report)
    lines += describe_branches(report)
    lines += report.rare.lines if report.rare is not None else []
    lines += describe_disturbances(report)
    if report.at_fault is not None and report.crashes:
        all_of_them = report.tally.found
        what = "crash is" if all_of_them == 1 else "crashes are"
        lines.append(f"{len(report.at_fault)} of {all_of_them} {what} the agent's own fault.")
    crashes = by_likelihood(report.crashes)
    if has_types:
        lines += [*([""] if lines else []), *_describe_types(report)]
    else:
        for bundle in crashes[:_MAX_BLOCKS]:
            lines += ["", *_describe_crash(bundle)]
        if len(crashes) > _MAX_BLOCKS:
            lines += ["", f"{_MAX_BLOCKS} of {report.tally.found} crashes shown; all are in {_crash_folder(report)}"]
    lines += _near_misses(report)
    lines += ["", counts] if has_types else []
    if report.copied is not None:
        lines += ["", *_describe_crash(report.copied)]
        lines += ["", f"Replay it:  {command_line('crashhunt', 'replay', report.copied.path)}"]
    if report.crashes:
        chosen = ["--crash", crashes[0].id] if len(crashes) > 1 else []
        replay = command_line("crashhunt", "replay", report.directory, *chosen)
        lines += [f"Replay one:  {replay}"] if has_types else ["", f"Replay it:  {replay}"]
        lines += [f"Show one:    {command_line('crashhunt', 'show', report.directory, *chosen)}"] if has_types else []
    if has_types:
        lines.append(f"Show types:  {command_line('crashhunt', 'crashes', report.directory)}")
    if has_dashboard and report.crashes:
        space = " " * has_types  # the labels before it are longer then
        lines.append(f"Look at it: {space}{command_line('crashhunt', 'dashboard', report.directory)}")
    return in_lines(lines)


def _crash_folder(report: HuntReport) -> str:
    return command_line(report.directory / layout.CRASHES)


def _describe_types(report: HuntReport) -> list[str]:
    """Return each crash type with its shortest crash, then which crashes are confirmed."""
    groups, crashes = report.kinds or (), report.crashes
    count = sum(group.count for group in groups)
    lines = [f"{count} crashes of {describe_types(len(groups), report.types_by_cause)}:"]
    if len(crashes) < count:
        lines[0] = f"{lines[0].removesuffix(':')} ({len(crashes)} of {count} have a bundle):"
    width = len(str(groups[0].count))
    for group in groups[:_MAX_TYPES]:
        fault = f" (at fault: {fault_words(group.fault)})" if group.fault else ""
        shortest = group.shortest
        lines.append(f"  {group.count:{width}}  {group.signature}{fault}")
        lines.append(f"  {'':{width}}  shortest {shortest.id}: {shortest.result.summary}")
    if len(groups) > _MAX_TYPES:
        lines.append(f"  and {len(groups) - _MAX_TYPES} more types")
    confirmed = sum(bundle.confirmed is True for bundle in crashes)
    lines.append(f"{confirmed} of {len(crashes)} bundles confirmed: bit-identical when replayed in a new process")
    flaky = [bundle.id for bundle in crashes if bundle.confirmed is False]
    lines += [f"flaky, the replay deviates: {_listed(flaky)}"] if flaky else []
    missing: dict[str, list[str]] = {}
    for bundle in crashes:
        if bundle.confirmed is None and bundle.why_unconfirmed:
            missing.setdefault(f"not confirmed: {bundle.why_unconfirmed}", []).append(bundle.id)
        if bundle.result.why_no_escape:
            why = f"last avoidable step unknown: {bundle.result.why_no_escape}"
            missing.setdefault(why, []).append(bundle.id)
    lines += [f"{why}: {_listed(ids)}" for why, ids in list(missing.items())[:_MAX_REASONS]]
    lines += ["Run the same command to try again."] if missing else []
    return [*lines, f"saved in {_crash_folder(report)}"]


def _listed(crashes: list[str]) -> str:
    more = f" and {len(crashes) - _MAX_LISTED} more" if len(crashes) > _MAX_LISTED else ""
    return f"{', '.join(crashes[:_MAX_LISTED])}{more}"


def _near_misses(report: HuntReport) -> list[str]:
    """Return the saved near misses as text, one line each."""
    if not report.near_misses:
        return []
    if report.crashes:
        count = count_of(len(report.near_misses), "near miss")
        return [f"{count} saved in {command_line(report.directory / layout.NEAR_MISSES)}"]
    lines = ["", f"Near misses, saved in {command_line(report.directory / layout.NEAR_MISSES)}:"]
    for bundle in report.near_misses[:_MAX_SHOWN]:
        result = bundle.result
        lines.append(f"  {bundle.id}  criticality {result.danger or 0.0:.2f}  {format_arguments(result)}")
    if len(report.near_misses) > _MAX_SHOWN:
        lines.append(f"  {_MAX_SHOWN} of {len(report.near_misses)} near misses shown")
    first = report.near_misses[0].id
    return [*lines, f"Replay one:  {command_line('crashhunt', 'replay', report.directory, '--crash', first)}"]


def _describe_events(report: HuntReport) -> list[str]:
    """Return as text the traffic events that are not crashes in this hunt, and the option that makes them crashes."""
    others = {kind: found for kind, found in report.events.items() if kind not in report.settings.crash_on}
    if not others:
        return []
    counts = ", ".join(
        f"{event_counts({kind: count})} in {count_of(trials, 'trial')}" for kind, (count, trials) in others.items()
    )
    return [f"Traffic events: {counts}. To hunt for them: --crash-on {','.join(others)}"]


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
    more = f" and {len(files) - _MAX_SHOWN} more" if len(files) > _MAX_SHOWN else ""
    return [f"differs from the snapshot: {', '.join(files[:_MAX_SHOWN])}{more}"]


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


def _wanted_types(report: HuntReport) -> str:
    """Return as text the crash types that count for ``--distinct``: of the agent's own fault if only these count."""
    groups = report.kinds or ()
    if report.at_fault is None:
        return describe_types(len(groups), report.types_by_cause, "crash type")
    trials = set(report.at_fault)
    count = sum(any(bundle.result.spec.number in trials for bundle in group.bundles) for group in groups)
    return f"{describe_types(count, report.types_by_cause, 'crash type')} of the agent's own fault"


def _describe_audit(report: HuntReport) -> list[str]:
    found = report.audit
    if found is None:
        return []
    same = found.trials - len(found.differences)
    if found.trials == found.not_finished == 0:
        return ["Audit: no trial without a crash belonged to the sample."]
    lines = [f"Audit: {found.trials} replayed in new processes, {same} bit-identical."]
    if found.not_finished:
        lines.append(f"  {found.not_finished} more did not finish. Run the same command to replay them")
    lines += [f"  {difference}" for difference in found.differences[:_MAX_SHOWN]]
    if found.differences and report.settings.run.reuse:
        lines.append(
            "  a program that drives in one trial after another may remember earlier trials; "
            "have it forget them at reset, or omit reuse"
        )
    if len(found.differences) > _MAX_SHOWN:
        lines.append(f"  … and {len(found.differences) - _MAX_SHOWN} more; for all of them, run: crashhunt logs")
    return lines


def _describe_crash(bundle: Bundle) -> list[str]:
    result = bundle.result
    lines = [
        f"{bundle.id}  ({result.outcome.category})",
        f"  {result.summary}",
        f"  after {count_of(result.steps, 'step')}, simulation time {result.sim_time_s:.1f} s",
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
        frames = failure.traceback.strip().splitlines()
        # Python prints the most recent call last. faulthandler, for dead and hanging processes, prints it first.
        dumped = [line for line in frames if line.lstrip().startswith("File")]
        lines += dumped[:3] if failure.kind in ("signal", "timeout") else frames[-4:]
        if failure.last_output.strip():
            last = failure.last_output.strip().splitlines()[-1]
            lines.append(f"last output: {last[:_MAX_OUTPUT_CHARACTERS]}{'…' * (len(last) > _MAX_OUTPUT_CHARACTERS)}")
    return lines
