"""The trials and crashes of each version of the code, in words."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from crashhunt.base.text import count_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping


def describe_versions(versions: Iterable[Mapping[str, Any]]) -> str:
    """Return the trials of each version of the code as text, the newest version first.

    Each version has the fields of `VersionCounts`.
    """
    ordered = sorted(versions, key=lambda one: not one["is_newest"])
    newest = ordered[0]
    each = "; ".join(
        f"{'newest ' if one['is_newest'] else ''}version {one['version']}: {one['crashes']} of "
        f"{count_of(one['trials'], 'trial')} crashed"
        for one in ordered
    )
    return (
        f"the code has changed: {each}; crash types are of version {newest['version']}, and its rate is of the trials "
        f"from {newest['first']} on"
    )


def describe_types_by_version(versions: Mapping[str, Mapping[str, Mapping[int, int]]]) -> list[str]:
    """Return for each hunt and crash type how often it occurred with each version of the code, one line each."""
    lines = []
    for hunt, types in versions.items():
        for words, counts in types.items():
            each = ", ".join(f"{count} with version {version}" for version, count in counts.items())
            lines.append(f"{hunt}: {words}: {each} of the code")
    return lines
