"""The most dangerous trials without a crash, kept as bundles of their own.

They are run once more for that, each in a fresh process, after the last trial: so a hunt is no slower by them until
then, a hunt of before can be asked for them, and what is kept is known to happen again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError
from crashhunt.base.temporary import remove_at_once
from crashhunt.crashes import list_near_misses

if TYPE_CHECKING:
    from crashhunt.crashes import Bundle
    from crashhunt.hunts._again import RunsAgain

__all__ = ["keep_near_misses"]


def keep_near_misses(again: RunsAgain) -> tuple[Bundle, ...]:
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
    try:
        for one in again.run([result.spec for result in wanted.values()], layout.NEAR_MISSES):
            now, was = one.result, wanted[one.result.spec.number]
            if now.was_killed_from_outside:
                what = f"trial {now.spec.number}, a near miss, was {now.summary}"
                again.notes.append(f"{what}: it has no bundle until the same command is run again")
            elif (was.outcome, was.digest) == (now.outcome, now.digest):
                one.write(was, confirmed=True)
            else:
                again.failed.append(now)
                what = f"trial {now.spec.number}, a near miss, is another one in a fresh process"
                again.notes.append(f"{what}: it has no bundle")
    except CrashhuntError as error:
        again.notes.append(f"near misses could not be run again: {error}")
    return tuple(list_near_misses(directory))
