"""The text that the terminal shows at the end of a hunt."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.text import command_line, count_of, in_lines, out_of
from crashhunt.report._argument_words import format_arguments
from crashhunt.report._crash_summary import describe_crash
from crashhunt.report._disturbance_words import (
    by_likelihood,
    describe_branches,
    describe_disturbances,
    describe_probes,
)
from crashhunt.report._judgement_words import fault_words
from crashhunt.report._live_screen import describe_types, format_seconds
from crashhunt.report._rate_text import describe_rates
from crashhunt.report._version_words import describe_versions
from crashhunt.world import event_counts

if TYPE_CHECKING:
    from crashhunt.hunts import HuntReport


_MAX_SHOWN = 10
_MAX_BLOCKS = 2  # crashes that are described in full, so that the text fits a screen of 24 lines
_MAX_TYPES = 5
_MAX_LISTED = 3  # crashes of which only the names are given
_MAX_REASONS = 3


def describe_hunt(report: HuntReport, *, has_dashboard: bool = False) -> str:
    """Return the result of a hunt as text that fits a screen.

    A single crash is described with its cause, its directory and the command that replays it. Of several crashes, the
    text has each crash type with its shortest crash, and the counts of the hunt follow. With a dashboard, the last line
    is the command that shows the crashes in it.
    """
    counts = _describe_counts(report)
    has_types = report.kinds is not None and sum(group.count for group in report.kinds) > 1
    lines = [] if has_types else [counts]
    if report.stopped_because == "no_valid_trial":
        lines.append(f"No trial was valid: {report.reason}")
    if report.code_versions:
        lines.append(f"Note: {describe_versions(map(asdict, report.code_versions))}")
    lines += [f"Note: {note}" for note in report.notes]
    lines += [*_describe_audit(report), *_describe_end(report), *_describe_events(report)]
    lines += [*describe_probes(report), *describe_branches(report)]
    lines += report.rare.lines if report.rare is not None else []
    lines += describe_disturbances(report)
    if report.at_fault is not None and report.crashes:
        all_of_them = report.tally.found
        what = "crash is" if all_of_them == 1 else "crashes are"
        lines.append(f"{len(report.at_fault)} of {all_of_them} {what} the agent's own fault.")
    if has_types:
        lines += [*([""] if lines else []), *_describe_types(report), *_near_misses(report), "", counts]
    else:
        lines += [*_describe_crashes(report), *_near_misses(report)]
    if report.copied is not None:
        lines += ["", *describe_crash(report.copied)]
        lines += ["", f"Replay it:  {command_line('crashhunt', 'replay', report.copied.path)}"]
    return in_lines([*lines, *_next_commands(report, has_types=has_types, has_dashboard=has_dashboard)])


def _describe_counts(report: HuntReport) -> str:
    """Return the numbers of trials and steps, the time, the outcomes and the seed of a hunt as text."""
    ran = sum(report.outcomes.values())
    outcomes = ", ".join(f"{name} {count}" for name, count in report.outcomes.items()) or "none"
    total = f" ({report.steps_total} simulated in all)" if report.steps_total > report.trial_steps else ""
    count = f"{out_of(ran, report.settings.trials)} trials, {report.trial_steps} steps{total}"
    return f"{count}, {format_seconds(report.wall_s)} ({outcomes}); hunt seed {report.settings.seed}"


def _describe_end(report: HuntReport) -> list[str]:
    """Return as text why the hunt ended, and what the same command would complete."""
    lines = []
    if report.stopped_because == "distinct":
        lines.append(f"Found {_wanted_types(report)} (--distinct {report.settings.run.distinct}).")
    if report.rate is not None:
        lines += describe_rates([report.rate]).splitlines()
    if report.copied is not None:
        number = report.copied.result.spec.number
        lines.append(f"Trial {number} did not crash, but a copy of it did. The crash reproduces from the start.")
    if report.unanswered:
        trials, them = ("trial has", "it") if report.unanswered == 1 else ("trials have", "them")
        why = "processes were killed from outside"
        fix = f"Run the same command to run {them} again."
        lines.append(f"{report.unanswered} {trials} incomplete answers: {why}. {fix}")
    if report.unconfirmed:
        count = f"{report.unconfirmed} of {len(report.crashes)} crashes"
        lines.append(f"Interrupted: {count} are not confirmed. Run the same command to confirm them.")
    elif report.stopped_because == "interrupted":
        lines.append("Interrupted. Run the same command to resume.")
    if not report.crashes and report.stopped_because in ("all_trials", "time"):
        limit = " within the time limit" if report.stopped_because == "time" else ""
        lines.append(f"No crash was found{limit}.")
    return lines


def _describe_crashes(report: HuntReport) -> list[str]:
    """Return the first crashes in full, and the number of all."""
    crashes = by_likelihood(report.crashes)
    lines = [line for bundle in crashes[:_MAX_BLOCKS] for line in ("", *describe_crash(bundle))]
    if len(crashes) > _MAX_BLOCKS:
        lines += ["", f"{_MAX_BLOCKS} of {report.tally.found} crashes shown; all are in {_crash_folder(report)}"]
    return lines


def _next_commands(report: HuntReport, *, has_types: bool, has_dashboard: bool) -> list[str]:
    """Return the commands that show the crashes of a hunt, one line each."""
    lines = []
    if report.crashes:
        chosen = ["--crash", by_likelihood(report.crashes)[0].id] if len(report.crashes) > 1 else []
        replay = command_line("crashhunt", "replay", report.directory, *chosen)
        lines += [f"Replay one:  {replay}"] if has_types else ["", f"Replay it:  {replay}"]
        lines += [f"Show one:    {command_line('crashhunt', 'show', report.directory, *chosen)}"] if has_types else []
    if has_types:
        lines.append(f"Show types:  {command_line('crashhunt', 'crashes', report.directory)}")
    if has_dashboard and report.crashes:
        space = " " * has_types  # the labels before it are longer then
        lines.append(f"Look at it: {space}{command_line('crashhunt', 'dashboard', report.directory)}")
    return lines


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
        lines.append(f"  and {count_of(len(groups) - _MAX_TYPES, 'more type')}")
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
