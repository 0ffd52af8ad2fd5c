"""Crashes that are the same one, over one hunt or many, and their order."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypedDict

from crashhunt.base.errors import BundleError
from crashhunt.triage._signature import Signature, signature_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    from crashhunt.crashes import Bundle
    from crashhunt.triage._signature import SignatureData

__all__ = ["Group", "GroupData", "Groups", "group_crashes", "groups_of"]


class GroupData(TypedDict):
    """A group as ``crashes --json`` prints it."""

    words: str
    signature: SignatureData
    count: int
    outcome: str
    manner: str
    first: str
    shortest: str
    members: list[str]


@dataclass(frozen=True, slots=True)
class Group:
    """Crashes with one signature.

    Args:
        signature: of all of them.
        bundles: in the order in which they were given; at least one.
    """

    signature: Signature
    bundles: tuple[Bundle, ...]

    @property
    def first(self) -> Bundle:
        """The one that was found first, by its trial's number; over several hunts, in the first of them."""
        return self.bundles[0]

    @property
    def shortest(self) -> Bundle:
        """The one with the fewest steps, and of several the first."""
        return min(self.bundles, key=lambda bundle: bundle.result.steps)

    def to_json(self) -> GroupData:
        """Return the shape that ``crashes --json`` prints; crashes are given by their paths."""
        return {
            "words": str(self.signature),
            "signature": self.signature.to_json(),
            "count": len(self.bundles),
            "outcome": self.signature.outcome,
            "manner": self.signature.manner,
            "first": str(self.first.path),
            "shortest": str(self.shortest.path),
            "members": [str(bundle.path) for bundle in self.bundles],
        }


@dataclass(frozen=True, slots=True)
class Groups:
    """What came of grouping crashes.

    Args:
        groups: the largest first.
        left_out: why a crash belongs to none: its log is missing or damaged.
    """

    groups: tuple[Group, ...]
    left_out: tuple[str, ...] = ()


def group_crashes(bundles: Iterable[Bundle]) -> Groups:
    """Group crashes by their signatures.

    Args:
        bundles: of one hunt or several; the log of each is read.
    """
    signed, left_out = [], []
    for bundle in bundles:
        try:
            signed.append((signature_of(bundle), bundle))
        except BundleError as error:
            left_out.append(str(error))
    return Groups(groups_of(signed), tuple(left_out))


def groups_of(signed: Iterable[tuple[Signature, Bundle]]) -> tuple[Group, ...]:
    """Return the groups of crashes whose signatures are known, the largest first."""
    found: dict[Signature, list[Bundle]] = {}
    for signature, bundle in signed:
        found.setdefault(signature, []).append(bundle)
    groups = [Group(signature, tuple(members)) for signature, members in found.items()]
    return tuple(sorted(groups, key=lambda group: (-len(group.bundles), group.signature)))
