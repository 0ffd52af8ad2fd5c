"""The table of crash types. `crashhunt.crashes` decides which crashes are of one type, and in which order."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.base.text import aligned, count_of
from crashhunt.crashes import count_causes, join_causes
from crashhunt.report._judgement_words import fault_words, list_preventing
from crashhunt.report._live_screen import describe_types

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.crashes import CauseGroup, Group, Signature


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
