"""Which kinds of crashes a corpus has already."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from crashhunt.corpus._case import Case
    from crashhunt.triage import Signature

__all__ = ["known_kinds"]


def known_kinds(signatures: Iterable[Signature], cases: Iterable[Case]) -> dict[Signature, Case]:
    """Return the cases that are of the same kinds as some crashes.

    A case that is ``fixed`` makes nothing known: it must not crash any more.

    Args:
        signatures: of the crashes.
        cases: of the corpus.
    """
    still = [case for case in cases if case.expect == "still" and case.signature]
    found = {}
    for signature in signatures:
        parts = signature.to_json()
        same = (case for case in still if all(parts.get(name, said) == said for name, said in case.signature.items()))
        case = next(same, None)
        if case is not None:
            found[signature] = case
    return found
