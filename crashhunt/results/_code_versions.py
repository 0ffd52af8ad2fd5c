"""The versions of the code with which the trials of a hunt ran, and the trials that count for the newest version.

A hunt does not resume with other code, because its crash rate would be that of no code at all. If the user asks for it,
the hunt continues. The snapshot of a trial identifies its version, and figures are those of the newest version.

Invariant: a trial counts for the newest version only if no trial of its number or of a greater number had begun with
another version. A trial that was under way when the code changed is a biased choice: it had not crashed by then. The
same trial with new code is no better, as it has the same seed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import BundleError, HuntDirectoryError
from crashhunt.snapshots import CodeChanges, Snapshot, code_changes
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence
    from pathlib import Path

    from crashhunt.ledger import CodeVersionsData, Facts, Ledger
    from crashhunt.plans import HuntSettings

_MAX_SHOWN = 4  # changed files
_MIN_UNDER_WAY = 64  # trials, for hunts that did not record how many were under way


@dataclass(frozen=True, slots=True)
class CodeVersions:
    """The versions of the code with which the trials of a hunt ran."""

    snapshots: tuple[tuple[str, ...], ...] = ()  # digests of the snapshots of each version, the first version first
    place: int = 0  # place of the newest version, the version that ran last
    first: int = 0  # number of the first trial that counts for the newest version

    @classmethod
    def of(cls, facts: Facts) -> CodeVersions:
        """Return the versions that a hunt has recorded; a hunt whose code never changed has recorded none."""
        data = facts.get("code_versions")
        if not data:
            return cls()
        return cls(tuple(map(tuple, data["snapshots"])), data["newest"], data["first"])

    @property
    def are_several(self) -> bool:
        """Whether the trials ran with more than one version."""
        return len(self.snapshots) > 1

    @property
    def newest(self) -> tuple[str, ...]:
        """The digests of the snapshots of the newest version; empty if there is only one version."""
        return self.snapshots[self.place] if self.are_several else ()

    @property
    def earlier(self) -> tuple[str, ...]:
        """The digests of the snapshots of all other versions; empty if there is only one version."""
        others = self.snapshots[: self.place] + self.snapshots[self.place + 1 :] if self.are_several else ()
        return tuple(digest for version in others for digest in version)

    def number_of(self, snapshot: str) -> int:
        """Return the number of the version that has a snapshot, from 1 on; 0 if it is unknown."""
        return next((number for number, version in enumerate(self.snapshots, 1) if snapshot in version), 0)

    def noted(self) -> CodeVersionsData | None:
        """Return the versions in the form that the ledger stores; None if there is only one version."""
        if not self.are_several:
            return None
        return {"snapshots": [list(version) for version in self.snapshots], "newest": self.place, "first": self.first}


@dataclass(frozen=True, slots=True)
class VersionCounts:
    """The trials of one version of the code."""

    version: int  # number of the version, from 1 on
    is_newest: bool  # whether the version ran last
    first: int | None  # for the newest version, number of the first trial that counts for figures; else None
    trials: int  # number of finished trials
    crashes: int  # number of these trials that crashed


def count_versions(ledger: Ledger, facts: Facts, crash_on: Collection[str]) -> tuple[VersionCounts, ...]:
    """Return the trials and crashes of each version; empty if all trials ran with the same code."""
    versions = CodeVersions.of(facts)
    if not versions.are_several:
        return ()
    used = ledger.snapshots()
    found = []
    for place, digests in enumerate(versions.snapshots):
        outcomes = [(name, count) for digest in digests for name, count in used.get(digest, {}).items()]
        is_newest = place == versions.place
        found.append(
            VersionCounts(
                version=place + 1,
                is_newest=is_newest,
                first=versions.first if is_newest else None,
                trials=sum(count for _, count in outcomes),
                crashes=sum(count for name, count in outcomes if name in crash_on),
            )
        )
    return tuple(found)


def resumed_versions(
    directory: Path,
    ledger: Ledger,
    taken: Snapshot,
    settings: HuntSettings,
    before: HuntSettings,
    *,
    new_code: bool | None,
) -> tuple[CodeVersions, tuple[str, ...]]:
    """Return the versions of the code of a hunt that resumes, and the new files that do not count as a change.

    ``new_code`` is None if the command has no option to allow other code.

    Raises:
        HuntDirectoryError: the code has changed since the hunt's trials, and the hunt must not or cannot continue.
    """
    facts, used, finished = ledger.facts(), ledger.snapshots(), ledger.finished()
    known = CodeVersions.of(facts) if facts.get("code_versions") else _versions_of(directory, tuple(used))
    if not known.snapshots:
        return known, ()
    _refuse_other_limit(directory, ledger, before.run.timeout_s, settings.run.timeout_s)
    begun = len(finished)  # trials that had begun
    if facts.get("state") != "all_trials" or max(finished, default=-1) >= begun:
        begun += facts.get("under_way") or max(2 * settings.run.parallel, _MIN_UNDER_WAY)
    if known.are_several and not facts.get("code_versions"):
        known = replace(known, first=begun)
    changes = [_changes(directory, version, taken) for version in known.snapshots]
    now = changes[known.place]
    if not now.changed and before.scenario_digest != settings.scenario_digest:
        now = CodeChanges(("the scenario",))
    if not now.changed:
        return _with(known, known.place, taken.digest, known.first), now.added
    trials = sum(count for digest in known.snapshots[known.place] for count in used.get(digest, {}).values())
    what = "; ".join(now.changed[:_MAX_SHOWN])
    if len(now.changed) > _MAX_SHOWN:
        what += f"; and {len(now.changed) - _MAX_SHOWN} more"
    message = f"the code has changed since the {trials} trials of this hunt: {what}"
    why = _why_not(settings)
    if why or not new_code:
        fix = "give a new directory to test the new code, or restore the code to resume"
        if not why and new_code is not None:
            fix += "; with --continue-with-new-code, this hunt continues and its crash rate counts only the new code"
        raise HuntDirectoryError(f"{message}; {why}" if why and new_code else message, fix=fix, where=str(directory))
    if settings.trials and settings.trials <= begun:
        raise HuntDirectoryError(
            f"TRIALS is {settings.trials}, but the first {begun} trials belong to earlier code: none is left for the "
            "new code",
            fix=f"give more than {begun} TRIALS, which count the trials of all versions, or a new directory",
            where=str(directory),
        )
    place = next((place for place, one in enumerate(changes) if not one.changed), len(known.snapshots))
    return _with(known, place, taken.digest, begun), changes[place].added if place < len(changes) else ()


def _refuse_other_limit(directory: Path, ledger: Ledger, before_s: float, now_s: float) -> None:
    """Refuse another time limit of trials, if it would change the outcomes of trials that have ended.

    Raises:
        HuntDirectoryError: earlier trials hung within the earlier limit, or took longer than the present limit.
    """
    if now_s == before_s:
        return
    hung = ledger.outcomes().get(Outcome.HANG, 0)
    count, what = (hung, "hung") if now_s > before_s else (hung + ledger.count_longer(now_s), "took longer or hung")
    if count:
        raise HuntDirectoryError(
            f"--timeout was {before_s:g} and is now {now_s:g}, but {count} of the hunt's trials {what}, and may end "
            "otherwise with this limit",
            fix=f"give --timeout {before_s:g}, or a new directory",
            where=str(directory),
        )


def _with(known: CodeVersions, place: int, digest: str, first: int) -> CodeVersions:
    """Return the versions with a snapshot added to the version at a place, which is then the newest."""
    versions = list(known.snapshots)
    if place == len(versions):
        versions.append(())
    if digest not in versions[place]:
        versions[place] = (*versions[place], digest)
    return CodeVersions(tuple(versions), place, first)


def _why_not(settings: HuntSettings) -> str:
    """Return why a hunt cannot have trials of several versions: its figures need all of its trials; empty if it can."""
    needing = {
        "--rare": settings.rare, "--probe": settings.probe, "--branch": settings.branch, "--seeds": settings.seeds,
    }  # fmt: skip
    option = next((name for name, given in needing.items() if given), "")
    return f"--continue-with-new-code and {option} exclude each other" if option else ""


def _changes(directory: Path, version: Sequence[str], taken: Snapshot) -> CodeChanges:
    """Return the differences between a version and the present code."""
    if taken.digest in version:
        return CodeChanges()
    try:
        return code_changes(Snapshot(directory / layout.SNAPSHOTS / version[0]), taken)
    except BundleError as error:
        return CodeChanges((f"the snapshot of these trials cannot be read ({error.message})",))


def _versions_of(directory: Path, used: Sequence[str]) -> CodeVersions:
    """Return the versions of a hunt that has recorded none, from the snapshots of its trials."""
    found = CodeVersions()
    for digest in used:
        snapshot = Snapshot(directory / layout.SNAPSHOTS / digest)
        same = (place for place, one in enumerate(found.snapshots) if not _changes(directory, one, snapshot).changed)
        place = next(same, len(found.snapshots))
        found = _with(found, place, digest, 0)
    return found
