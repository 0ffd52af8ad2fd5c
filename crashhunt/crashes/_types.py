"""Groups of crashes of the same type, from one hunt or several hunts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from crashhunt.base.codec import Serializable
from crashhunt.base.errors import BundleError
from crashhunt.crashes import Bundle, judgement_of, preventable_by
from crashhunt.crashes._contact_record import contact_record
from crashhunt.crashes._fault import Verdict, fault_of
from crashhunt.crashes._signature import Signature, signature_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path


@dataclass(frozen=True, slots=True)
class Group(Serializable):
    """Crashes with the same signature.

    Args:
        signature: the common signature of all crashes.
        bundles: bundles in the order in which they were given; at least one.
        faults: vehicle at fault in each of these crashes; empty if that was not requested.
        dropped: number of further crashes whose bundles were deleted (``--keep``).
    """

    signature: Signature
    bundles: tuple[Bundle, ...]
    faults: tuple[Verdict, ...] = ()
    dropped: int = 0

    json_keys = (
        "words", "signature", "count", "saved", "outcome=signature.outcome", "manner=signature.manner", "fault",
        "avoidable", "first=first.path", "shortest=shortest.path", "members", "preventable_by?",
    )  # fmt: skip

    @property
    def count(self) -> int:
        """The number of crashes."""
        return len(self.bundles) + self.dropped

    @property
    def fault(self) -> str:
        """The vehicle at fault in the crashes with a bundle: a `Verdict`, or ``mixed``; empty if not requested."""
        said = set(self.faults)
        return "mixed" if len(said) > 1 else next(iter(said), "")

    @property
    def avoidable(self) -> bool | None:
        """True if runs avoided all crashes, False if they avoided none; None if crashes differ or are not judged."""
        if self.dropped:
            return None
        said = {_avoidable(bundle) for bundle in self.bundles}
        return said.pop() if len(said) == 1 else None

    @property
    def first(self) -> Bundle:
        """The crash that was found first, by trial number; with several hunts, the first crash of the first hunt."""
        return self.bundles[0]

    @property
    def shortest(self) -> Bundle:
        """The crash with the fewest steps; if several crashes have as few, the first of them."""
        return min(self.bundles, key=lambda bundle: bundle.result.steps)

    @property
    def preventable_by(self) -> dict[str, bool | None] | None:
        """Whether each model of a competent driver would have prevented the shortest crash; None if not judged."""
        return preventable_by(self.shortest)

    @property
    def words(self) -> str:
        """The signature as text."""
        return str(self.signature)

    @property
    def members(self) -> list[Path]:
        """The paths of the bundles."""
        return [bundle.path for bundle in self.bundles]

    @property
    def saved(self) -> int:
        """The number of crashes with a bundle."""
        return len(self.bundles)


@dataclass(frozen=True, slots=True)
class Groups:
    """The result of grouping crashes.

    Args:
        groups: the groups, the largest first.
        left_out: The crashes without a crash type, each with the reason, such as a missing or damaged log.
    """

    groups: tuple[Group, ...]
    left_out: tuple[str, ...] = ()


def group_crashes(
    bundles: Iterable[Bundle], dropped: Mapping[str, int] | None = None, *, faults: bool = True
) -> Groups:
    """Group crashes by their signatures, and return the groups.

    Args:
        bundles: bundles of one hunt or several; the log of each is read.
        dropped: number of crashes without a bundle, by the description of their crash type.
        faults: whether to find the vehicle at fault for each crash.
    """
    signed, unsigned = [], []
    verdicts: dict[Path, Verdict] = {}
    for bundle in bundles:
        try:
            recording = bundle.recording() if bundle.result.collision is not None else None
            record = contact_record(bundle, recording)
            signed.append((signature_of(bundle, recording, record), bundle))
            if faults:
                verdicts[bundle.path] = fault_of(bundle, recording, record).verdict
        except BundleError as error:
            unsigned.append(str(error))
    groups = groups_of(signed, dropped)
    if faults:
        groups = tuple(
            replace(group, faults=tuple(verdicts[bundle.path] for bundle in group.bundles)) for group in groups
        )
    typed = {str(group.signature) for group in groups}
    unsigned += [
        f"{count} {'crash' if count == 1 else 'crashes'} of the type {words!r}: no bundle of this type is left"
        for words, count in (dropped or {}).items()
        if words not in typed
    ]
    return Groups(groups, tuple(unsigned))


def _avoidable(bundle: Bundle) -> bool | None:
    """Return whether runs of `judge` or of the hunt avoided a crash; None if no such run shows this."""
    judgement, escape = judgement_of(bundle), bundle.result.escape
    if judgement is not None and judgement.avoidable is not None:
        return judgement.avoidable
    return True if escape is not None and escape.step is not None else None


def groups_of(
    signed: Iterable[tuple[Signature, Bundle]], dropped: Mapping[str, int] | None = None
) -> tuple[Group, ...]:
    """Return the groups of crashes whose signatures are known, the largest first.

    Args:
        signed: the crashes, each with its signature.
        dropped: number of crashes without a bundle, by the description of their crash type.
    """
    found: dict[Signature, list[Bundle]] = {}
    for signature, bundle in signed:
        found.setdefault(signature, []).append(bundle)
    more = dropped or {}
    groups = [
        Group(signature, tuple(members), dropped=more.get(str(signature), 0)) for signature, members in found.items()
    ]
    return tuple(sorted(groups, key=lambda group: (-group.count, group.signature)))
