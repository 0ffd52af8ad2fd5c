"""Whether a hunt may run again without asking: what it names is imported, so it has to be trusted first."""

from __future__ import annotations

import hashlib
import json
import shlex
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.authentication import is_authentic
from crashhunt.base.errors import CrashhuntError, UntrustedError
from crashhunt.crashes import add_trusted, describe_code, is_fingerprint_trusted, is_hunt_trusted, trust_snapshot
from crashhunt.plans import read_settings
from crashhunt.snapshots import Snapshot, latest_snapshot
from crashhunt.suites._processes import PURPOSE_OF_REQUEST, REQUEST, RunRequest

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.crashes import TrustedOrigin

__all__ = ["refuse_untrusted_hunt", "trust_hunt"]


def refuse_untrusted_hunt(hunt: Path) -> None:
    """Refuse to run a hunt again that is neither made here nor trusted.

    Raises:
        UntrustedError: with what would be imported.
    """
    requested = (hunt / REQUEST).exists()
    begun = (hunt / layout.HUNT).exists()
    snapshot = latest_snapshot(hunt) if begun else None
    trusted = not requested or _is_request_trusted(hunt / REQUEST)
    if snapshot is not None:
        trusted = trusted and is_hunt_trusted(hunt, snapshot)
    elif not requested:  # it was killed before it had a snapshot, so nothing proves anything
        trusted = False
    if trusted:
        return
    try:
        if snapshot is not None:
            runs = describe_code(snapshot, read_settings(hunt / layout.HUNT))
        else:
            request = RunRequest.read(hunt / REQUEST)
            runs = f"{', '.join(request.request.agents.values()) or 'its agents'}, imported from {request.folder}"
    except CrashhuntError as error:
        runs = f"what cannot be described: {error.message}"
    raise UntrustedError(
        "nothing proves that you began this hunt on this machine (earlier versions of crashhunt wrote no proof), and "
        f"running it again would run code: {runs}",
        fix=f"if you trust that code, run crashhunt trust {shlex.quote(str(hunt))} once, or add --trust",
        where=str(hunt),
    )


def trust_hunt(hunt: Path, path: Path) -> list[TrustedOrigin]:
    """Trust all code of a hunt from now on, and return the entries.

    Args:
        hunt: its directory.
        path: what the user named.

    Raises:
        BundleError: a snapshot is damaged.
        HuntDirectoryError: an entry cannot be written.
    """
    places = sorted((hunt / layout.SNAPSHOTS).glob(layout.SHOWN))
    for place in places:
        Snapshot(place).verify()
    found = [trust_snapshot(Snapshot(place), path) for place in places]
    if (hunt / REQUEST).is_file():
        agents = RunRequest.read(hunt / REQUEST).request.agents.values()
        runs = f"the request of a suite for {', '.join(agents) or 'the agents of its scenario'}"
        found.append(add_trusted(_fingerprint(hunt / REQUEST), path=str(path.resolve()), runs=runs))
    return found


def _is_request_trusted(file: Path) -> bool:
    try:
        data = json.loads(file.read_bytes())
        code = data.pop("authentication_code", None)
        return is_authentic(PURPOSE_OF_REQUEST, data, code) or is_fingerprint_trusted(_fingerprint(file))
    except (OSError, ValueError, AttributeError, RecursionError):
        return False


def _fingerprint(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
