"""The verdict of a gate as lines for the terminal, Markdown for a pull request, JUnit for CI, and an annotation."""

from __future__ import annotations

from typing import TYPE_CHECKING
from xml.etree import ElementTree as Xml

from crashhunt.base.files import output_file
from crashhunt.base.text import command_line, count_of, format_number, in_lines, visible
from crashhunt.report._ci_findings import annotation_of, escaped, row_of
from crashhunt.report._rate_text import count_training_trials, format_interval

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from crashhunt.statistics import CrashRate, GateReport, SideCounts

_MAX_TYPES = 3  # named of each version
_ICONS = {"better": "✅", "no_difference": "✅", "worse": "❌", "undecided": "❔"}


def describe_gate(found: GateReport) -> str:
    """Return the verdict of a gate as text: the answer first, then the evidence, then the next command."""
    lines = [_answer(found)]
    if found.why:
        lines.append(f"  {found.why}")
    lines += [f"  {line}" for line in (*_evidence(found), *_invalid_pairs(found), *_new_types(found))]
    if found.trained_on:
        lines.append(f"  {_training_pairs(found)}")
    if found.preventable is not None:
        lines.append(f"  {_preventable(found.preventable)}")
    if found.rates is not None:
        lines += [f"  {line}" for line in _rates(found)]
    if len(found.scenarios) > 1:
        lines += [f"  {line}" for line in _scenarios(found)]
    lines += [f"  {line}" for line in (*_corpus(found), *(f"but {caution}" for caution in found.cautions))]
    if found.seed is not None:
        lines.append(f"  seed of the hunts: {found.seed}")
    if found.dir:
        lines.append(f"see {command_line('crashhunt', 'compare', found.dir)}")
    return in_lines(lines)


def _preventable(numbers: Mapping[str, int]) -> str:
    """Return which crashes of both versions count, if only preventable ones do."""
    other = f"; crashes without a collision: {numbers['no_collision']}, all count" if numbers["no_collision"] else ""
    total = numbers["yes"] + numbers["no"] + numbers["unknown"]
    return (
        f"only preventable collisions count: {numbers['yes']} of {total}; "
        f"no model prevents {numbers['no']}, and no model has an answer for {numbers['unknown']}{other}"
    )


def _answer(found: GateReport) -> str:
    base, head = f"BASE {found.base}", f"HEAD {found.head}"
    if found.verdict == "worse":
        if found.back:
            return f"worse: {head}"
        return f"worse: {head} {_verb(found)} more often than {base}"
    if found.verdict == "better":
        return f"better: {head} {_verb(found)} less often than {base}"
    if found.verdict == "no_difference":
        return f"no difference above {format_number(found.margin)} {_events(found)} per trial: {head}, {base}"
    return f"undecided: {head}, {base}"


def _events(found: GateReport) -> str:
    """Return the name of the counted failures: trials that do not start count if there are any."""
    return "failures" if any(side.not_started for side in found.sides) else "crashes"


def _verb(found: GateReport) -> str:
    return "fails" if _events(found) == "failures" else "crashes"


def _plural(found: GateReport) -> str:
    return "fail" if _events(found) == "failures" else "crash"


def _evidence(found: GateReport) -> list[str]:
    if not found.pairs:
        return ["no pair of trials has ended"]
    verb = _plural(found)
    counts = f"{found.only_base} {verb} only with BASE, {found.only_head} only with HEAD, {found.both} with both"
    needed = 1 / (1 - found.confidence / 100)
    confidence = f"{found.confidence:g} %, valid whenever you look"
    lines = [
        f"{found.pairs:,} pairs: {counts}",
        f"evidence: {format_number(found.evidence)}; {format_number(needed)} decides ({confidence})",
    ]
    if found.difference is not None:
        lines.append(f"difference: {found.difference.as_difference()} {_events(found)} per trial (HEAD minus BASE)")
    return lines


def _invalid_pairs(found: GateReport) -> list[str]:
    """Return the pairs with invalid trials as text: those that count as failures, those without a result, the rest."""
    sides = tuple(zip(("BASE", "HEAD"), found.sides, strict=True))
    lines = [
        f"{name} does not start in {side.not_started} of these pairs, which count as failures ({side.example})"
        for name, side in sides
        if side.not_started
    ]
    lines += [_lost(name, side, found.verdict) for name, side in sides if side.lost]
    if found.invalid:
        lines.append(f"{count_of(found.invalid, 'pair')} not counted: the trial is invalid with both versions")
    return lines


def _lost(name: str, side: SideCounts, verdict: str) -> str:
    """Return why pairs have no result because of one version, and what this means for the verdict."""
    reasons = [
        f"{what} in {count}"
        for what, count in (("was killed from outside", side.killed), ("could not be set up", side.unknown))
        if count
    ]
    example = "" if side.not_started else f" ({side.example})"
    effect = "must hold" if verdict == "undecided" else "holds"
    words = f"{name} {' and '.join(reasons)}{example}"
    return f"{count_of(side.lost, 'pair')} without a result: {words}; the verdict {effect} for any result"


def _new_types(found: GateReport) -> list[str]:
    """Return the crash types that only one of the versions has, as text."""
    lines = []
    for side, name in ((1, "HEAD"), (0, "BASE")):
        types = sorted(found.new_types(side).items(), key=lambda one: (-one[1], one[0]))
        if types:
            words = ", ".join(f"{what} ({count_of(count, 'crash')})" for what, count in types[:_MAX_TYPES])
            more = f" and {len(types) - _MAX_TYPES} more" if len(types) > _MAX_TYPES else ""
            lines.append(f"crash {'type' if len(types) == 1 else 'types'} only with {name}: {words}{more}")
    return lines


def _training_pairs(found: GateReport) -> str:
    return f"{found.trained_on:,} pairs do not count: an agent was trained on traffics of this part"


def _rates(found: GateReport) -> list[str]:
    """Return the rates of both versions; a rate counts only the trials before the first trial that was killed."""
    lines = []
    for name, rate, side in zip(("BASE", "HEAD"), found.rates or (), found.sides, strict=True):
        after = rate.excluded.get("after_unfinished") if side.killed else 0
        lines.append(f"{name}: {_rate(rate)}{f'; {after:,} trials after a killed one do not count' if after else ''}")
    return lines


def _rate(rate: CrashRate) -> str:
    crashes = f"{count_of(rate.crashes, 'crash')} in {rate.trials:,} trials"
    if invalid := rate.excluded.get("invalid"):
        crashes += f" and {invalid:,} invalid"
    if trained_on := rate.excluded.get("trained_on"):
        crashes += f" ({count_training_trials(trained_on)})"
    if rate.certain is None:
        return f"{crashes}, no rate: {rate.why_not}"
    return f"{crashes}, {format_interval(rate.certain)} per trial"


def _scenarios(found: GateReport) -> list[str]:
    return [
        f"{one.name}: {count_of(one.pairs, 'pair')}, {one.only_base} {_plural(found)} only with BASE, "
        f"{one.only_head} only with HEAD, {one.both} with both"
        for one in found.scenarios
    ]


def _corpus(found: GateReport) -> list[str]:
    if found.corpus is None:
        return []
    lines = [f"corpus of HEAD: {count_of(len(found.corpus), 'case')}, {len(found.back)} crash again"]
    lines += [f"  {case.name} was fixed, now: {case.now}" for case in found.back]
    lines += [f"  {case.name} cannot run: {case.now}" for case in found.corpus if case.got == "cannot_run"]
    return lines


def gate_summary(found: GateReport) -> str:
    """Return the verdict of a gate as Markdown, for a pull request or the summary of a CI job."""
    lines = [f"### {_ICONS[found.verdict]} crashhunt gate: {escaped(_answer(found))}", ""]
    if found.why:
        lines += [f"{escaped(found.why)}.", ""]
    if found.pairs:
        verb = _plural(found)
        lines += [row_of(("pairs of trials", f"{verb} only with BASE", "only with HEAD", "with both", "evidence"))]
        lines += [row_of(["---:"] * 5)]
        counts = (found.pairs, found.only_base, found.only_head, found.both)
        lines += [row_of([*(f"{count:,}" for count in counts), format_number(found.evidence)]), ""]
    if found.difference is not None:
        confidence = f"{found.confidence:g} %, valid whenever you look"
        difference = f"**{found.difference.as_difference()}** {_events(found)} per trial"
        lines += [f"Difference: {difference} (HEAD minus BASE, {confidence}).", ""]
    if other := [*found.cautions, *_invalid_pairs(found), *_new_types(found)]:
        lines += [*(f"- {escaped(line)}" for line in other), ""]
    if found.trained_on:
        lines += [f"{_training_pairs(found)}.", ""]
    if found.rates is not None:
        lines += [f"- {line}" for line in _rates(found)]
        lines.append("")
    if len(found.scenarios) > 1:
        lines += [
            row_of(("hunt", "pairs", "only BASE", "only HEAD", "both")),
            row_of(["---", *["---:"] * 4]),
        ]
        lines += [
            row_of((escaped(one.name), f"{one.pairs:,}", str(one.only_base), str(one.only_head), str(one.both)))
            for one in found.scenarios
        ]
        lines.append("")
    if found.corpus is not None:
        first, *others = _corpus(found)
        lines += [f"{escaped(first)}.", "", *(f"- {escaped(other.strip())}" for other in others)]
        lines += [""] if others else []
    return "\n".join(lines)


def gate_annotations(found: GateReport) -> list[str]:
    """Return a GitHub annotation command if HEAD is worse, or if the verdict is undecided."""
    if found.verdict in ("better", "no_difference"):
        return []
    level = "error" if found.verdict == "worse" else "warning"
    title, *words = describe_gate(found).splitlines()
    return [annotation_of(level, f"crashhunt gate: {title}", "\n".join(words))]


def write_gate_junit(found: GateReport, path: Path) -> None:
    """Write the verdict of a gate as JUnit XML: one test for the pairs of trials, and one for each case of the corpus.

    The verdict *worse* is a failure, *undecided* is an error. A case that cannot run is an error as well.

    Raises:
        HuntDirectoryError: the file cannot be written.
    """
    suite = Xml.Element("testsuite", name="crashhunt gate")
    for case in found.corpus or ():
        test = Xml.SubElement(suite, "testcase", classname="crashhunt.gate.corpus", name=visible(case.name))
        if case.has_come_back:
            Xml.SubElement(test, "failure", message=visible(f"was fixed, now: {case.now}"), type="came_back")
        elif case.got == "cannot_run":
            Xml.SubElement(test, "error", message=visible(case.now), type="cannot_run")
    if found.pairs or not found.back:
        test = Xml.SubElement(suite, "testcase", classname="crashhunt.gate", name="paired trials")
        said = visible(describe_gate(found))
        if found.verdict == "worse" and not found.back:
            Xml.SubElement(test, "failure", message=visible(_answer(found)), type="worse").text = said
        elif found.verdict == "undecided":
            Xml.SubElement(test, "error", message=visible(_answer(found)), type="undecided").text = said
        else:
            Xml.SubElement(test, "system-out").text = said
    suite.set("tests", str(len(suite)))
    suite.set("failures", str(sum(test.find("failure") is not None for test in suite)))
    suite.set("errors", str(sum(test.find("error") is not None for test in suite)))
    root = Xml.Element("testsuites")
    root.append(suite)
    Xml.indent(root)
    with output_file(path) as temporary:
        Xml.ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)
