"""The table of the kinds of crashes, for people; which are of one kind, and their order, is in `triage`."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.triage import Group, Signature

__all__ = ["describe_groups"]


def describe_groups(groups: Sequence[Group], known: Mapping[Signature, str] | None = None) -> str:
    """Return a line a kind of crash, with the one to look at first.

    Args:
        groups: the kinds.
        known: the cases of a corpus by kind; None where nobody has asked.
    """
    if not groups:
        return "No crash was saved."
    hunts = {bundle.hunt for group in groups for bundle in group.bundles}
    faults = any(group.fault for group in groups)
    rows = [["crashes", "kind", *(["at fault"] if faults else []), "shortest"]]
    rows[0] += [*(["known as"] if known is not None else []), "steps"]
    for group in groups:
        shortest = group.shortest
        name = shortest.id if len(hunts) == 1 else str(shortest.path)
        rows.append(
            [
                str(group.count),
                str(group.signature),
                *([group.fault] if faults else []),
                name,
                *([known.get(group.signature, "new")] if known is not None else []),
                str(shortest.result.steps),
            ]
        )
    count = sum(group.count for group in groups)
    words = f"{count} {'crash' if count == 1 else 'crashes'} of {len(groups)} {'kind' if len(groups) == 1 else 'kinds'}"
    return "\n".join([f"{words}:", "", *_lines(rows)])


def _lines(rows: list[list[str]]) -> list[str]:
    """Numbers to the right, words to the left."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.rjust(width) if place in (0, len(row) - 1) else cell.ljust(width)
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    ]
