"""The crashes of a hunt: their number, with or without a bundle; their types; and which bundles are kept."""

from __future__ import annotations

import math
import time
from collections import Counter
from contextlib import closing, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import BundleError, CrashhuntError, HuntDirectoryError
from crashhunt.base.pacing import Paced
from crashhunt.base.temporary import remove_at_once
from crashhunt.crashes import (
    SIGNATURE_VERSION,
    Division,
    Group,
    cause_of,
    crash_folders,
    fault_of,
    features_of,
    group_crashes,
    groups_of,
    judgement_of,
    list_bundles,
    read_bundle,
    signature_of,
    without_chance_lengths,
)
from crashhunt.ledger import Ledger, has_begun
from crashhunt.plans import read_settings
from crashhunt.results._code_versions import CodeVersions

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence
    from pathlib import Path

    from crashhunt.base.codec import JsonObject
    from crashhunt.crashes import Bundle, Cause, Signature
    from crashhunt.ledger import Facts, Noted
    from crashhunt.recording import Recording
    from crashhunt.trial import TrialResult

_MAX_READ_LOGS = 200  # of crashes that are read for their types; a log takes 0.05 s


@dataclass(slots=True)
class CrashTally:
    """Counts the crashes of all trials of a hunt."""

    found: int = 0  # number of crashes
    disturbed: int = 0  # number of crashes with disturbances
    # identifier of the crash with disturbances that has the greatest log-likelihood; empty if there is none
    likeliest: str = ""
    log_likelihood: float = -math.inf  # log-likelihood of this crash

    def add(self, result: TrialResult) -> None:
        """Add a crash to the counts."""
        self.found += 1
        if not result.disturbed:
            return
        self.disturbed += 1
        if result.log_likelihood is not None and result.log_likelihood > self.log_likelihood:
            self.likeliest = layout.crash_folder(result.spec.number, result.outcome)
            self.log_likelihood = result.log_likelihood


def tally_crashes(
    ledger: Ledger, crash_on: Sequence[str], *, disturbed: bool, snapshots: Sequence[str] = ()
) -> CrashTally:
    """Return the counts of the crashes in a ledger.

    With ``disturbed``, crashes with disturbances are counted. Without ``snapshots``, all trials count.
    """
    outcomes = Counter(ledger.outcomes())
    if snapshots:
        used = ledger.snapshots()
        outcomes = sum((Counter(used.get(digest)) for digest in snapshots), Counter())
    found = CrashTally(sum(outcomes.get(name, 0) for name in crash_on))
    if disturbed and found.found:
        found.disturbed, likeliest = ledger.disturbed_crashes(tuple(crash_on), snapshots)
        if likeliest is not None:
            number, outcome, found.log_likelihood = likeliest
            found.likeliest = layout.crash_folder(number, outcome)
    return found


def outcomes_of_crashes(directory: Path, facts: Facts) -> Sequence[str] | None:
    """Return the outcomes that count as a crash in a hunt; None if its ledger and its settings do not contain them."""
    noted = facts.get("crash_on")
    if noted is not None:
        return noted
    try:
        return read_settings(directory / layout.HUNT).crash_on
    except CrashhuntError:
        return None


@dataclass(frozen=True, slots=True)
class FoundCrashes:
    """The crashes of a hunt: their number, their types, and the crashes to show."""

    tally: CrashTally  # counts of the crashes over all trials
    saved: int  # number of crashes that have a bundle
    # number of crashes of each crash type (as text) over all trials, the most frequent type first
    types: Mapping[str, int]
    shortest: Mapping[str, str]  # identifier of the shortest saved crash of each crash type
    first: Mapping[str, int]  # number of the trial in which each crash type occurred for the first time
    untyped: int  # number of crashes whose type is unknown, because a log is missing or has not been read yet
    # the crashes to show: the shortest crash of each type, then the shortest of all other crashes
    shown: tuple[Bundle, ...]


def find_crashes(directory: Path, limit: int) -> FoundCrashes:
    """Return the crashes of a hunt. If the ledger has the types of all crashes, at most `limit` bundles are read.

    The ledger may be missing, as in an exported crash.

    Raises:
        BundleError: a crash that is to be shown is damaged.
        HuntDirectoryError: the ledger is damaged.
    """
    folders = {folder.name: folder for folder in crash_folders(directory)}
    if not has_begun(directory / layout.LEDGER):
        bundles = list_bundles(directory)
        types, shortest, first = _types_of(bundles, {})
        tally = CrashTally(len(bundles))
        return FoundCrashes(
            tally=tally,
            saved=len(bundles),
            types=types,
            shortest=shortest,
            first=first,
            untyped=len(bundles) - sum(types.values()),
            shown=_listed_crashes(folders, _by_steps(bundles), shortest, limit),
        )
    with closing(Ledger(directory / layout.LEDGER)) as ledger:
        facts = ledger.facts()
        dropped = facts.get("dropped") or {}
        crash_on = outcomes_of_crashes(directory, facts) or ()
        tally = tally_crashes(ledger, crash_on, disturbed=bool(facts.get("disturb")))
        tally.found = max(
            tally.found, len(folders) + sum(map(len, dropped.values()))
        )  # a bundle is written before its row
        steps = {number: steps for number, _, name, steps, _ in ledger.table() if name in crash_on}
        versions = CodeVersions.of(facts)
        apart = ledger.numbers_from(versions.earlier)
    noted = facts.get("kinds") if facts.get("kinds_version") == SIGNATURE_VERSION else None
    if apart:  # types are those of the newest code
        dropped = {words: rest for words, numbers in dropped.items() if (rest := sorted(set(numbers) - apart))}
        bundles = [bundle for bundle in list_bundles(directory) if bundle.snapshot not in versions.earlier]
        types, shortest, first = _types_of(bundles, dropped)
    elif noted is None or (sum(kind["count"] for kind in noted) != tally.found and len(folders) <= _MAX_READ_LOGS):
        types, shortest, first = _types_of(list_bundles(directory), dropped)
    else:
        types = {kind["words"]: kind["count"] for kind in noted}
        shortest = {kind["words"]: kind["shortest"] for kind in noted}
        first = first_trials({kind["words"]: kind["first"] for kind in noted}, dropped)
    names = sorted(folders, key=lambda name: (steps.get(_number(name), math.inf), _number(name)))
    return FoundCrashes(
        tally=tally,
        saved=len(folders),
        types=types,
        shortest=shortest,
        first=first,
        untyped=max(0, tally.found - sum(number in apart for number in steps) - sum(types.values())),
        shown=_listed_crashes(folders, names, shortest, limit),
    )


def _types_of(
    bundles: Sequence[Bundle], dropped: Mapping[str, Sequence[int]]
) -> tuple[dict[str, int], dict[str, str], dict[str, int]]:
    """Return the crash types of bundles, from their logs, and of crashes without a bundle: counts, shortest, first."""
    counts = {words: len(numbers) for words, numbers in dropped.items()}
    groups = {str(group.signature): group for group in group_crashes(bundles, counts, faults=False).groups}
    counts |= {words: group.count for words, group in groups.items()}
    ranked = sorted(counts.items(), key=lambda entry: -entry[1])
    first = first_trials({words: group.first.id for words, group in groups.items()}, dropped)
    return dict(ranked), {words: group.shortest.id for words, group in groups.items()}, first


def first_trials(first: Mapping[str, str], dropped: Mapping[str, Sequence[int]]) -> dict[str, int]:
    """Return the number of the trial in which each crash type occurred for the first time.

    ``dropped`` has the trials of each type whose bundles were deleted; the first crash may be one of them.
    """
    saved = {words: [number] for words, crash in first.items() if (number := _number(crash)) >= 0}
    numbers = {words: [*dropped.get(words, ()), *saved.get(words, ())] for words in {**first, **dropped}}
    return {words: min(each) for words, each in numbers.items() if each}


def _by_steps(bundles: Sequence[Bundle]) -> list[str]:
    ordered = sorted(bundles, key=lambda bundle: (bundle.result.steps, bundle.result.spec.number))
    return [bundle.id for bundle in ordered]


def _number(name: str) -> int:
    digits = name.partition("-")[0]
    return int(digits) if digits.isascii() and digits.isdecimal() else -1


def _listed_crashes(
    folders: Mapping[str, Path], by_steps: Sequence[str], shortest: Mapping[str, str], limit: int
) -> tuple[Bundle, ...]:
    examples = [name for name in shortest.values() if name in folders][:limit]
    names = dict.fromkeys([*examples, *by_steps])
    chosen = [name for name in names if name in folders][:limit]
    bundles = [read_bundle(folders[name]) for name in chosen]
    return tuple(sorted(bundles, key=lambda bundle: (bundle.result.steps, bundle.result.spec.number)))


# Which kinds of crashes a hunt has found, while it runs.


@dataclass(frozen=True, slots=True)
class Judged:
    """A crash whose cause has been searched for."""

    bundle: Bundle  # bundle of the crash, with its judgement
    cause: Cause | None = None  # the cause; None if the crash cannot be run again
    is_stopped: bool = False  # whether the search was interrupted, so that the cause is unknown


class Kinds:
    """The crash types of a hunt, and the crashes to keep, to judge and to show.

    Args:
        wanted: number of crash types after which the hunt ends; 0 for no limit.
        crashes: the crashes that earlier runs of the hunt have saved.
        newest: time at which the last new crash type was found, in s since the epoch; None if it is unknown.
        only_at_fault: whether only crashes that are the agent's fault count towards the number of wanted crash types.
        dropped: trials of each crash type (as text) whose bundles were deleted in earlier runs of the hunt.
        dropped_at_fault: those of the trials in `dropped` whose crashes are the agent's fault.
        dropped_judged: those of the trials in `dropped` whose crashes were judged, with their causes.
        by_cause: number of crashes of each type to judge, so that causes count; 0 if types count.
        apart: the numbers of trials with other versions of the code, whose crashes do not count.
    """

    def __init__(
        self,
        wanted: int,
        crashes: Sequence[Bundle] = (),
        newest: float | None = None,
        *,
        only_at_fault: bool = False,
        dropped: Mapping[str, Sequence[int]] | None = None,
        dropped_at_fault: Sequence[int] = (),
        dropped_judged: Mapping[str, Mapping[str, JsonObject]] | None = None,
        by_cause: int = 0,
        apart: Collection[int] = frozenset(),
    ) -> None:
        self._by_cause = by_cause
        self._divisions: dict[Signature, Division] = {}
        self._only_at_fault = only_at_fault
        self._at_fault: set[int] = set()
        self._wanted = wanted
        self._signed: dict[int, tuple[Signature, Bundle]] = {}  # by the number of the trial
        self._seen: set[Signature] = set()
        self._first: dict[tuple[Signature, Cause | None], int] = {}  # of what counts, its trial of the least number
        self._until: int | None = None
        self._groups: Paced[tuple[Group, ...]] = Paced()
        self._changes = 0  # of the groups
        self.newest = newest
        self.newest_trial: int | None = None
        there = {bundle.result.spec.number for bundle in crashes}  # it was killed before it had removed them
        self.dropped, self._dropped_apart = {}, {}
        for words, numbers in (dropped or {}).items():
            self.dropped[words] = [number for number in numbers if number not in there and number not in apart]
            self._dropped_apart[words] = [number for number in numbers if number in apart]
        self._dropped_at_fault = {number for number in dropped_at_fault if number not in there and number not in apart}
        self._at_fault_apart = {number for number in dropped_at_fault if number in apart}
        self.dropped_judged: dict[str, dict[str, JsonObject]] = {}
        self._judged_apart: dict[str, dict[str, JsonObject]] = {}
        for words, answers in (dropped_judged or {}).items():
            for word, answer in answers.items():
                if int(word) not in there:
                    judged = self._judged_apart if int(word) in apart else self.dropped_judged
                    judged.setdefault(words, {})[word] = answer
        for bundle in crashes:
            self._add_signature(bundle)
        for signature in self._seen:
            for number in self.dropped.get(str(signature), ()):
                self._count(number, signature, None)
        for signature, division in self._divisions.items():
            for word, answer in self.dropped_judged.get(str(signature), {}).items():
                self._count(int(word), signature, division.restore(int(word), answer))

    def add(self, bundle: Bundle, ended: int, recording: Recording | None = None) -> None:
        """Add a saved crash; its recording is read from the log if it is not given."""
        if self._add_signature(bundle, recording):
            self.newest, self.newest_trial = time.time(), ended

    def groups(self, *, running: bool = False) -> tuple[Group, ...]:
        """Return the crash types, the most frequent first, each with its crashes in the order of their trials.

        While a hunt is ``running``, groups some moments old are sufficient, as for a screen that is refreshed ten times
        a second. With 10,000 crashes, new groups would take too long.
        """

        def make() -> tuple[Group, ...]:
            dropped = {words: len(numbers) for words, numbers in self.dropped.items()}
            return groups_of((self._signed[number] for number in sorted(self._signed)), dropped)

        return self._groups(self._changes, make, now=not running)

    def drop_excess(self, keep: int, *, final: bool = False) -> list[Bundle]:
        """Remove and return the crashes beyond the `keep` shortest of each crash type, or of each cause.

        The removed crashes still count, but are no longer members of a group. A type whose crashes are still being
        judged keeps all crashes. ``final`` is whether no more crashes will be judged.
        """
        found = []
        for group in groups_of(self._signed.values()):
            for bundles in self._parts(group, final=final):
                ordered = sorted(bundles, key=self._priority)
                judged = self._divisions[group.signature].judged if group.signature in self._divisions else frozenset()
                # The runs that show the cause are in the bundle of a judged crash, so one of them stays.
                shown = next((place for place, one in enumerate(ordered) if one.result.spec.number in judged), 0)
                if keep <= shown:
                    ordered.insert(keep - 1, ordered.pop(shown))
                for bundle in ordered[keep:]:
                    number = bundle.result.spec.number
                    del self._signed[number]
                    if number in self._at_fault:
                        self._at_fault.discard(number)
                        self._dropped_at_fault.add(number)
                    self.dropped.setdefault(str(group.signature), []).append(number)
                    division = self._divisions.get(group.signature)
                    if division is not None and (answer := division.answer(number)) is not None:
                        self.dropped_judged.setdefault(str(group.signature), {})[str(number)] = answer
                    found.append(bundle)
        if found:
            self._changes += 1
        return found

    def _parts(self, group: Group, *, final: bool) -> list[list[Bundle]]:
        """Return the crashes of a type by cause; a crash whose cause is still unknown is omitted."""
        division = self._divisions.get(group.signature)
        if division is None:
            return [list(group.bundles)]
        if not division.is_complete and not final:
            return []
        causes = division.causes()
        parts: dict[Cause, list[Bundle]] = {}
        for bundle in group.bundles:
            parts.setdefault(causes[bundle.result.spec.number], []).append(bundle)
        return list(parts.values())

    def next_to_judge(self) -> Bundle | None:
        """Return the next crash whose cause is to be searched for; None if there is currently none."""
        for division in self._divisions.values():
            if (number := division.choose()) is not None:
                return self._signed[number][1]
        return None

    def count_to_judge(self) -> int:
        """Return the number of crashes whose cause is still to be searched for."""
        return sum(division.left for division in self._divisions.values())

    def settle(self, judged: Judged) -> None:
        """Add the cause of a judged crash."""
        number = judged.bundle.result.spec.number
        if judged.is_stopped:
            self._divisions[self._signed[number][0]].postpone(number)
        else:
            self._settle(number, judged.cause)

    def _settle(self, number: int, cause: Cause | None) -> None:
        signature = self._signed[number][0]
        self._divisions[signature].settle(number, cause)
        self._count(number, signature, cause)

    @property
    def types_by_cause(self) -> int | None:
        """The number of crash types by cause; None if the hunt counts types.

        A cause that names a defect counts once over all types, and a type without a known cause counts once.
        """
        return len(self._counted()) if self._by_cause else None

    def _count(self, number: int, signature: Signature, cause: Cause | None) -> None:
        if number in self._at_fault or number in self._dropped_at_fault or not self._only_at_fault:
            known = None if cause is None or cause.kind == "unknown" else cause
            self._first[signature, known] = min(number, self._first.get((signature, known), number))

    def _counted(self, *, answered: bool = False) -> list[int]:
        """Return the first trial of each type or cause that counts; a type without a known cause counts once.

        Args:
            answered: whether to exclude types for which no crash has been judged yet. Their crashes may have a cause
                that another type has, too.
        """
        caused = {signature for signature, cause in self._first if cause is not None}
        lengths = without_chance_lengths({cause for _, cause in self._first if cause is not None})
        found: dict[object, int] = {}
        for (signature, cause), number in self._first.items():
            if cause is None and (signature in caused or (answered and self._is_pending(signature))):
                continue
            known = None if cause is None else lengths[cause]
            key = known if known is not None and known.is_defect else (signature, known)
            found[key] = min(number, found.get(key, number))
        return sorted(found.values())

    def _is_pending(self, signature: Signature) -> bool:
        return signature in self._divisions and not self._divisions[signature].is_answered

    def _priority(self, bundle: Bundle) -> tuple[bool, int, int]:
        """Return the sort key of crashes to keep: wanted crashes first, and shorter crashes before longer ones."""
        result = bundle.result
        return self._only_at_fault and result.spec.number not in self._at_fault, result.steps, result.spec.number

    @property
    def until(self) -> int | None:
        """The least number N for which the trials 0 to N contain enough crash types; None if there are not enough."""
        firsts = self._counted(answered=True)
        if 0 < self._wanted <= len(firsts):
            self._until = firsts[self._wanted - 1]
        # A type without a cause may turn out to have a cause that already counts. A hunt that has ended stays so.
        return self._until

    @property
    def at_fault(self) -> tuple[int, ...] | None:
        """The trials whose crashes are the agent's fault, also without a bundle; None without ``--only-at-fault``."""
        return tuple(sorted(self._at_fault | self._dropped_at_fault)) if self._only_at_fault else None

    def dropped_facts(self) -> Noted:
        """Return the crashes whose bundles were deleted in the form that the ledger stores, of all versions."""
        dropped = {words: list(numbers) for words, numbers in self._dropped_apart.items()}
        judged = {words: dict(answers) for words, answers in self._judged_apart.items()}
        for words, numbers in self.dropped.items():
            dropped.setdefault(words, []).extend(numbers)
        for words, answers in self.dropped_judged.items():
            judged.setdefault(words, {}).update(answers)
        at_fault = sorted(self._dropped_at_fault | self._at_fault_apart)
        return {"dropped": dropped, "dropped_at_fault": at_fault, "dropped_judged": judged or None}

    def refresh(self, crashes: Sequence[Bundle]) -> None:
        """Replace the crashes by their confirmed versions."""
        for bundle in crashes:
            number = bundle.result.spec.number
            if number in self._signed:
                self._signed[number] = self._signed[number][0], bundle
        self._changes += 1

    def _add_signature(self, bundle: Bundle, recording: Recording | None = None) -> bool:
        """Add a crash; return whether its crash type is new."""
        number = bundle.result.spec.number
        collided = bundle.result.collision is not None
        try:
            # All look at it, and reading a log takes longer than looking.
            if recording is None and collided and (self._only_at_fault or self._by_cause):
                recording = bundle.recording()
            signature = signature_of(bundle, recording)
            if self._only_at_fault and fault_of(bundle, recording).is_egos:
                self._at_fault.add(number)
            if self._by_cause and not bundle.result.outcome.is_software_fault:
                division = self._divisions.setdefault(signature, Division(self._by_cause))
                division.add(number, bundle.result.steps, features_of(bundle, recording))
        except BundleError:
            return False  # it has no crash type, and crashhunt check reports it
        is_new = signature not in self._seen
        self._seen.add(signature)
        self._signed[number] = signature, bundle
        self._changes += 1
        self._count(number, signature, None)
        judgement = judgement_of(bundle) if signature in self._divisions else None
        if judgement is not None and not judgement.is_interrupted:
            cause = cause_of(bundle, judgement)
            if cause.kind != "unknown":
                self._settle(number, cause)
        return is_new


# ``--keep N``: of each crash type, the bundles of the shortest N crashes stay, and the rows of all crashes.
#
# The deletion is written to the ledger first, so `check` can distinguish a deleted bundle from a missing one.


def prune_bundles(
    ledger: Ledger, kinds: Kinds | None, crashes: list[Bundle], keep: int, *, final: bool = False
) -> list[Bundle]:
    """Delete bundles beyond the `keep` shortest of each crash type; return the remaining crashes.

    Without ``kinds``, the hunt ends at its first crash; otherwise removed crashes are deleted from it. A ``keep`` of 0
    keeps all bundles. ``final`` is whether no more crashes will be judged.

    Raises:
        HuntDirectoryError: the ledger cannot be written.
    """
    if kinds is None or not keep or not (excess := kinds.drop_excess(keep, final=final)):
        return crashes
    ledger.note(**kinds.dropped_facts())
    for bundle in excess:
        remove_at_once(bundle.path)  # half a bundle would be a damaged one
    gone = {bundle.id for bundle in excess}
    return [bundle for bundle in crashes if bundle.id not in gone]


def crashes_by_version(hunts: Iterable[Path], groups: Iterable[Group]) -> dict[str, dict[str, dict[int, int]]]:
    """Return the number of crashes of each type (as text) with each version of the code, of hunts with several."""
    found: dict[str, dict[str, dict[int, int]]] = {}
    every = list(groups)
    for hunt in hunts:
        if not has_begun(hunt / layout.LEDGER):
            continue
        with suppress(HuntDirectoryError), closing(Ledger(hunt / layout.LEDGER)) as ledger:
            facts = ledger.facts()
            versions = CodeVersions.of(facts)
            if not versions.are_several:
                continue
            ran = {number: ledger.numbers_from(one) for number, one in enumerate(versions.snapshots, 1)}
            dropped = facts.get("dropped") or {}
            for group in every:
                own = [bundle.result.spec.number for bundle in group.bundles if bundle.hunt == hunt]
                own += dropped.get(str(group.signature), ())
                counts = {version: len(numbers.intersection(own)) for version, numbers in ran.items()}
                found.setdefault(str(hunt), {})[str(group.signature)] = counts
    return found


def dropped_crashes(hunts: Iterable[Path]) -> dict[str, int]:
    """Return the number of crashes without a bundle, which have only a row in a ledger, by crash type (as text)."""
    found: Counter[str] = Counter()
    for hunt in hunts:
        if not (hunt / layout.LEDGER).is_file():
            continue
        with suppress(HuntDirectoryError), closing(Ledger(hunt / layout.LEDGER)) as ledger:
            dropped = ledger.facts().get("dropped") or {}
            found.update({words: len(numbers) for words, numbers in dropped.items()})
    return dict(found)
