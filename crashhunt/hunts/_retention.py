"""``--keep N``: of each kind of crash the bundles of the shortest few stay, and of the others the rows of the ledger.

The deletion is written to the ledger first, so `check` can distinguish a deleted bundle from a missing one.
"""

from __future__ import annotations

from collections import Counter
from contextlib import closing, suppress
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError, HuntDirectoryError
from crashhunt.base.temporary import remove_at_once
from crashhunt.crashes import list_near_misses
from crashhunt.ledger import Ledger

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from crashhunt.crashes import Bundle
    from crashhunt.hunts._progress import Progress
    from crashhunt.hunts._verification import TrialReruns
    from crashhunt.plans import RunSettings


__all__ = ["dropped_crashes", "keep_near_misses", "prune_bundles"]


def prune_bundles(ledger: Ledger, progress: Progress, run: RunSettings, *, final: bool = False) -> None:
    """Remove the bundles of crashes of which there are enough that are shorter.

    Args:
        ledger: of the hunt.
        progress: of the hunt, which forgets them.
        run: says how many stay.
        final: whether no more crashes are judged.

    Raises:
        HuntDirectoryError: the ledger cannot be written.
    """
    surplus = progress.kinds.surplus(run.keep, final=final) if progress.kinds is not None and run.keep else []
    if not surplus or progress.kinds is None:
        return
    ledger.note(dropped=progress.kinds.dropped, dropped_at_fault=progress.kinds.dropped_at_fault)
    for bundle in surplus:
        remove_at_once(bundle.path)  # half a bundle would be a damaged one
    gone = {bundle.id for bundle in surplus}
    progress.crashes = [bundle for bundle in progress.crashes if bundle.id not in gone]


def dropped_crashes(hunts: Iterable[Path]) -> dict[str, int]:
    """Return of each kind of crash, in words, how many are in the ledgers of some hunts only."""
    found: Counter[str] = Counter()
    for hunt in hunts:
        if not (hunt / layout.LEDGER).is_file():
            continue
        with suppress(HuntDirectoryError), closing(Ledger(hunt / layout.LEDGER)) as ledger:
            dropped = ledger.facts().get("dropped") or {}
            found.update({words: len(numbers) for words, numbers in dropped.items()})
    return dict(found)


# The most dangerous trials without a crash, kept as bundles of their own.
#
# They are run once more for that, each in a fresh process, after the last trial: so a hunt is no slower by them until
# then, a hunt of before can be asked for them, and what is kept is known to happen again.


def keep_near_misses(again: TrialReruns) -> tuple[Bundle, ...]:
    """See that the most dangerous trials of a hunt are there as bundles, and no others; return them in that order.

    Args:
        again: runs trials of the hunt again. Its settings say how many; where that is none, those that are there stay.
            Its notes get a line for each trial that could not be kept, and why.
    """
    directory, ledger, keep = again.place.path, again.ledger, again.settings.run.near_misses
    if not keep or len(again.stops):
        return ()
    wanted = {number: result for number in ledger.most_dangerous(keep)
              if (result := ledger.result(number)) is not None}  # fmt: skip
    for bundle in list_near_misses(directory):
        result = wanted.get(bundle.result.spec.number)
        if result is not None and result.digest == bundle.result.digest:
            del wanted[bundle.result.spec.number]
        else:
            remove_at_once(bundle.path)
    if wanted:
        again.phases.begin("near misses", len(wanted))
    try:
        for one in again.run([result.spec for result in wanted.values()], layout.NEAR_MISSES):
            again.phases.advance()
            now, was = one.result, wanted[one.result.spec.number]
            if now.was_killed_from_outside:
                what = f"trial {now.spec.number}, a near miss, was {now.summary}"
                again.notes.append(f"{what}: it has no bundle until the same command is run again")
            elif was.is_identical_run(now):
                one.write(was, confirmed=True)
            else:
                again.failed.append(now)
                what = f"trial {now.spec.number}, a near miss, is another one in a fresh process"
                again.notes.append(f"{what}: it has no bundle")
    except CrashhuntError as error:
        again.notes.append(f"near misses could not be run again: {error}")
    return tuple(list_near_misses(directory))
