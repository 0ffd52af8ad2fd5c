"""The end of a hunt: what copies of its trials have found is run from the start."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.hunts._branched import look_at_branches
from crashhunt.hunts._copies import BRANCHES, PROBES
from crashhunt.hunts._probed import look_at_probes

if TYPE_CHECKING:
    from crashhunt.hunts._branched import BranchReport
    from crashhunt.hunts._from_the_start import FromTheStart
    from crashhunt.hunts._probed import ProbeReport

__all__ = ["look_at_copies"]


def look_at_copies(copies: FromTheStart) -> tuple[ProbeReport | None, BranchReport | None]:
    """Run what copies have found from the start, and write down how much of it is confirmed.

    Args:
        copies: runs that.
    """
    probes, branches = look_at_probes(copies), look_at_branches(copies)
    found = {PROBES: probes, BRANCHES: branches}
    confirmed = {
        name: (one.run_again - one.not_finished, len(one.crashes)) for name, one in found.items() if one is not None
    }
    if confirmed:
        copies.again.ledger.note(confirmed=confirmed)
    return probes, branches
