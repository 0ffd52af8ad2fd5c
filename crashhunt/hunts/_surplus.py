"""``--keep N``: of each kind of crash the bundles of the shortest few stay, and of the others the rows of the ledger.

The ledger is told first, for good, so that a bundle that is not there has either been given up or is missing.
"""

from __future__ import annotations

from collections import Counter
from contextlib import closing, suppress
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import HuntDirectoryError
from crashhunt.base.temporary import remove_at_once
from crashhunt.hunts._ledger import Ledger

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from crashhunt.hunts._progress import Progress
    from crashhunt.plans import RunSettings

__all__ = ["dropped_crashes", "give_up_surplus"]


def give_up_surplus(ledger: Ledger, progress: Progress, run: RunSettings) -> None:
    """Remove the bundles of crashes of which there are enough that are shorter.

    Raises:
        HuntDirectoryError: the ledger cannot be written.
    """
    surplus = progress.kinds.surplus(run.keep) if progress.kinds is not None and run.keep else []
    if not surplus or progress.kinds is None:
        return
    ledger.note(dropped=progress.kinds.dropped)
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
