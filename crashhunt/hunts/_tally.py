"""Counts of crashes over all trials of a hunt, whether or not their bundles are kept or shown."""

from __future__ import annotations

import math
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError
from crashhunt.crashes import (
    SIGNATURE_VERSION,
    crash_folders,
    group_crashes,
    list_bundles,
    read_bundle,
)
from crashhunt.ledger import Ledger, has_begun
from crashhunt.plans import read_settings

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from crashhunt.crashes import Bundle
    from crashhunt.ledger import Facts, KindData
    from crashhunt.trial import TrialResult

__all__ = ["CrashTally", "FoundCrashes", "find_crashes", "outcomes_of_crashes", "tally_crashes"]

_MOST_LOGS = 200  # of crashes that are read for their types; a log takes 0.05 s


@dataclass(slots=True)
class CrashTally:
    """Counts the crashes of all trials of a hunt.

    Args:
        found: number of crashes.
        disturbed: number of crashes with disturbances.
        likeliest: identifier of the crash with disturbances that has the greatest log-likelihood; empty for none.
        log_likelihood: of that crash.
    """

    found: int = 0
    disturbed: int = 0
    likeliest: str = ""
    log_likelihood: float = -math.inf

    def add(self, result: TrialResult) -> None:
        """Count a crash."""
        self.found += 1
        if not result.disturbed:
            return
        self.disturbed += 1
        if result.log_likelihood is not None and result.log_likelihood > self.log_likelihood:
            self.likeliest = layout.crash_folder(result.spec.number, result.outcome)
            self.log_likelihood = result.log_likelihood


def tally_crashes(ledger: Ledger, crash_on: Sequence[str], *, disturbed: bool) -> CrashTally:
    """Return the counts of the crashes of a ledger.

    Args:
        ledger: of the hunt.
        crash_on: the outcomes that count as a crash.
        disturbed: whether the hunt has disturbances, so that those are counted.
    """
    outcomes = ledger.outcomes()
    found = CrashTally(sum(outcomes.get(name, 0) for name in crash_on))
    if disturbed and found.found:
        found.disturbed, likeliest = ledger.disturbed_crashes(tuple(crash_on))
        if likeliest is not None:
            number, outcome, found.log_likelihood = likeliest
            found.likeliest = layout.crash_folder(number, outcome)
    return found


def outcomes_of_crashes(directory: Path, facts: Facts) -> Sequence[str] | None:
    """Return the outcomes that count as a crash in a hunt; None where neither its ledger nor its settings say."""
    noted = facts.get("crash_on")
    if noted is not None:
        return noted
    try:
        return read_settings(directory / layout.HUNT).crash_on
    except CrashhuntError:
        return None


@dataclass(frozen=True, slots=True)
class FoundCrashes:
    """The crashes of a hunt: how many, of which types, and those to show.

    Args:
        tally: counts over all trials.
        saved: number of crashes that have a bundle.
        types: number of crashes of each type, in words, over all trials, the most frequent type first.
        shortest: identifier of the shortest saved crash of each of these types.
        untyped: number of crashes whose type is not determined, because a log is missing or not read yet.
        shown: the crashes to show: the shortest of each type, then the shortest of all.
    """

    tally: CrashTally
    saved: int
    types: Mapping[str, int]
    shortest: Mapping[str, str]
    untyped: int
    shown: tuple[Bundle, ...]


def find_crashes(directory: Path, limit: int) -> FoundCrashes:
    """Return the crashes of a hunt; reads at most `limit` bundles where the ledger has the types of all crashes.

    Args:
        directory: of the hunt; its ledger may be missing, as in an exported crash.
        limit: number of crashes to show, at most.

    Raises:
        BundleError: a crash that is to be shown is damaged.
        HuntDirectoryError: the ledger is damaged.
    """
    folders = {folder.name: folder for folder in crash_folders(directory)}
    if not has_begun(directory / layout.LEDGER):
        bundles = list_bundles(directory)
        types, shortest = _types_of(bundles, {})
        tally = CrashTally(len(bundles))
        return FoundCrashes(
            tally=tally,
            saved=len(bundles),
            types=types,
            shortest=shortest,
            untyped=len(bundles) - sum(types.values()),
            shown=_shown(folders, _by_steps(bundles), shortest, limit),
        )
    with closing(Ledger(directory / layout.LEDGER)) as ledger:
        facts = ledger.facts()
        dropped = {words: len(numbers) for words, numbers in (facts.get("dropped") or {}).items()}
        crash_on = outcomes_of_crashes(directory, facts) or ()
        tally = tally_crashes(ledger, crash_on, disturbed=bool(facts.get("disturb")))
        tally.found = max(tally.found, len(folders) + sum(dropped.values()))  # a bundle is written before its row
        steps = {number: steps for number, _, name, steps, _ in ledger.table() if name in crash_on}
    noted = _noted_types(facts)
    if noted is None or (sum(kind["count"] for kind in noted) != tally.found and len(folders) <= _MOST_LOGS):
        types, shortest = _types_of(list_bundles(directory), dropped)
    else:
        types = {kind["words"]: kind["count"] for kind in noted}
        shortest = {kind["words"]: kind["shortest"] for kind in noted}
    names = sorted(folders, key=lambda name: (steps.get(_number(name), math.inf), _number(name)))
    return FoundCrashes(
        tally=tally,
        saved=len(folders),
        types=types,
        shortest=shortest,
        untyped=max(0, tally.found - sum(types.values())),
        shown=_shown(folders, names, shortest, limit),
    )


def _noted_types(facts: Facts) -> Sequence[KindData] | None:
    """Return the crash types that the hunt has noted; None where another version has determined them."""
    return facts.get("kinds") if facts.get("kinds_version") == SIGNATURE_VERSION else None


def _types_of(bundles: Sequence[Bundle], dropped: Mapping[str, int]) -> tuple[dict[str, int], dict[str, str]]:
    """Return the crash types of bundles, from their logs, with those of crashes without a bundle."""
    groups = group_crashes(bundles, dropped, faults=False).groups
    types = {**dropped, **{str(group.signature): group.count for group in groups}}
    ranked = sorted(types.items(), key=lambda entry: -entry[1])
    return dict(ranked), {str(group.signature): group.shortest.id for group in groups}


def _by_steps(bundles: Sequence[Bundle]) -> list[str]:
    ordered = sorted(bundles, key=lambda bundle: (bundle.result.steps, bundle.result.spec.number))
    return [bundle.id for bundle in ordered]


def _number(name: str) -> int:
    digits = name.partition("-")[0]
    return int(digits) if digits.isdecimal() else -1


def _shown(
    folders: Mapping[str, Path], by_steps: Sequence[str], shortest: Mapping[str, str], limit: int
) -> tuple[Bundle, ...]:
    examples = [name for name in shortest.values() if name in folders][:limit]
    names = dict.fromkeys([*examples, *by_steps])
    chosen = [name for name in names if name in folders][:limit]
    bundles = [read_bundle(folders[name]) for name in chosen]
    return tuple(sorted(bundles, key=lambda bundle: (bundle.result.steps, bundle.result.spec.number)))
