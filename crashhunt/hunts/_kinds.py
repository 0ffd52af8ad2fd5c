"""Which kinds of crashes a hunt has found, while it runs."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, TypedDict

from crashhunt.base.errors import BundleError
from crashhunt.triage import Group, fault_of, groups_of, signature_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from crashhunt.crashes import Bundle
    from crashhunt.triage import Signature

__all__ = ["KindData", "Kinds", "kind_data"]


class KindData(TypedDict):
    """A kind of crashes in few words, as the ledger and ``--json`` have it."""

    words: str
    count: int
    first: str
    shortest: str


def kind_data(group: Group) -> KindData:
    """Return a group in few words, with the ids of its crashes."""
    return {
        "words": str(group.signature),
        "count": group.count,
        "first": group.first.id,
        "shortest": group.shortest.id,
    }


class Kinds:
    """The kinds of the crashes that a hunt has saved.

    Args:
        wanted: how many kinds are enough; 0 for never.
        crashes: that were saved before.
        newest: when the last new kind came, in s since the epoch; None where nobody knows.
        only_at_fault: whether only crashes that are the agent's own fault count towards what is wanted.
        dropped: of each kind, in words, the trials whose bundles were given up before.
    """

    def __init__(
        self,
        wanted: int,
        crashes: Sequence[Bundle] = (),
        newest: float | None = None,
        *,
        only_at_fault: bool = False,
        dropped: Mapping[str, Sequence[int]] | None = None,
    ) -> None:
        self._only_at_fault = only_at_fault
        self._at_fault: set[int] = set()
        self._wanted = wanted
        self._signed: dict[int, tuple[Signature, Bundle]] = {}  # by the number of the trial
        self._seen: set[Signature] = set()
        self._first: dict[Signature, int] = {}  # of each kind that counts, its trial of the least number
        self._groups: tuple[Group, ...] | None = None
        self.newest = newest
        self.newest_trial: int | None = None
        there = {bundle.result.spec.number for bundle in crashes}  # it was killed before it had removed them
        self.dropped = {
            words: [number for number in numbers if number not in there] for words, numbers in (dropped or {}).items()
        }
        for bundle in crashes:
            self._sign(bundle)

    def add(self, bundle: Bundle, ended: int) -> None:
        """Take in a crash that has been saved.

        Args:
            bundle: the crash.
            ended: how many trials have ended by now.
        """
        if self._sign(bundle):
            self.newest, self.newest_trial = time.time(), ended

    def groups(self) -> tuple[Group, ...]:
        """Return what there is, the most frequent kind first, each with its crashes in the order of their trials."""
        if self._groups is None:  # a screen asks ten times a second
            dropped = {words: len(numbers) for words, numbers in self.dropped.items()}
            self._groups = groups_of((self._signed[number] for number in sorted(self._signed)), dropped)
        return self._groups

    def surplus(self, keep: int) -> list[Bundle]:
        """Return the crashes of which there are so many of the same kind that are shorter, and give them up.

        They count on, and are no members any more.
        """
        found = []
        for group in groups_of(self._signed.values()):
            for bundle in sorted(group.bundles, key=self._worth)[keep:]:
                number = bundle.result.spec.number
                del self._signed[number]
                self._at_fault.discard(number)
                self.dropped.setdefault(str(group.signature), []).append(number)
                found.append(bundle)
        if found:
            self._groups = None
        return found

    def _worth(self, bundle: Bundle) -> tuple[bool, int, int]:
        """What is kept first: what was hunted for, and of that the shortest."""
        result = bundle.result
        return self._only_at_fault and result.spec.number not in self._at_fault, result.steps, result.spec.number

    @property
    def until(self) -> int | None:
        """The least number of a trial up to which there are enough kinds; None where there are not."""
        firsts = sorted(self._first.values())
        return firsts[self._wanted - 1] if 0 < self._wanted <= len(firsts) else None

    @property
    def at_fault(self) -> tuple[int, ...] | None:
        """The trials whose crashes are the agent's own fault; None where that was not asked."""
        return tuple(sorted(self._at_fault)) if self._only_at_fault else None

    def refresh(self, crashes: Sequence[Bundle]) -> None:
        """Take the crashes as they are now: they have been confirmed."""
        for bundle in crashes:
            number = bundle.result.spec.number
            if number in self._signed:
                self._signed[number] = self._signed[number][0], bundle
        self._groups = None

    def _sign(self, bundle: Bundle) -> bool:
        """Take in a crash; return whether it is of a kind that has not been there."""
        number = bundle.result.spec.number
        try:
            # Both look at it, and reading a log takes longer than looking.
            recording = bundle.recording() if self._only_at_fault and bundle.result.collision is not None else None
            signature = signature_of(bundle, recording)
            if self._only_at_fault and fault_of(bundle, recording).is_egos:
                self._at_fault.add(number)
        except BundleError:
            return False  # it is of no kind, and crashhunt check tells of it
        is_new = signature not in self._seen
        self._seen.add(signature)
        self._signed[number] = signature, bundle
        self._groups = None
        if number in self._at_fault or not self._only_at_fault:
            self._first[signature] = min(number, self._first.get(signature, number))
        return is_new
