"""The request of a run of a suite, as its folder has it, and whether that run may import the code that it names."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError, HuntDirectoryError, UntrustedError
from crashhunt.base.files import whole_file
from crashhunt.base.integrity import authentication_code, is_authentic, read_bounded
from crashhunt.base.text import command_line
from crashhunt.crashes import add_trusted, describe_code, is_fingerprint_trusted, is_hunt_trusted, trust_snapshot
from crashhunt.plans import Request, SnapshotChoices, Subject, TrialOptions, fields_of, read_settings
from crashhunt.snapshots import Snapshot, latest_snapshot

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.crashes import TrustedOrigin


REQUEST = layout.REQUEST
_PURPOSE = "request of a suite"  # of its authentication code


@dataclass(frozen=True, slots=True)
class RunRequest:
    """The request for one run of a suite, stored as `request.json` in the folder of the run."""

    request: Request  # request of the hunt
    folder: str  # folder from which agents are imported

    def to_json(self) -> dict[str, object]:
        """Return JSON-compatible data: the options that determine trials, those of the run, those of the snapshot."""
        asked = self.request
        given = {name: getattr(asked, name) for name in (*fields_of(Subject), *fields_of(TrialOptions))}
        numbers = {"trials": asked.trials, "max_steps": asked.max_steps}
        snapshot = {name: getattr(asked, name) for name in fields_of(SnapshotChoices)}
        return {"request": {**given, **numbers, "run": asdict(asked.run)}, "folder": self.folder, **snapshot}

    def to_plain(self) -> object:
        """Return the request as the dictionaries, lists, texts and numbers that `json.load` reads from its file."""
        return json.loads(json.dumps(self.to_json(), default=str))

    @classmethod
    def read(cls, file: Path) -> RunRequest:
        """Read a request from its file.

        Raises:
            HuntDirectoryError: the file is missing or damaged.
        """
        try:
            data = json.loads(read_bounded(file))
            run, snapshot = data["request"].pop("run"), fields_of(SnapshotChoices)
            run |= {name: data[name] for name in snapshot if name in data}
            return cls(Request(**data["request"], **run), data["folder"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise HuntDirectoryError(f"no {REQUEST}: {error}", fix="plan the suite again", where=str(file)) from None


def write_request(folder: Path, request: RunRequest) -> None:
    """Write ``request.json``. The file is never incomplete."""
    data = json.loads(json.dumps(request.to_json(), default=str))
    data["authentication_code"] = authentication_code(_PURPOSE, data)
    with whole_file(folder / REQUEST) as temporary:
        temporary.write_text(json.dumps(data, indent=1), encoding="utf-8")


def refuse_untrusted_hunt(hunt: Path) -> None:
    """Refuse to run a hunt again that is neither made here nor trusted.

    Raises:
        UntrustedError: the hunt is not trusted; the message names the code that would be imported.
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
            runs = f"of {describe_code(snapshot, read_settings(hunt / layout.HUNT))}"
        else:
            request = RunRequest.read(hunt / REQUEST)
            runs = f"of {', '.join(request.request.locators.values()) or 'its agents'}, imported from {request.folder}"
    except CrashhuntError as error:
        runs = f"that cannot be described ({error.message})"
    raise UntrustedError(
        f"nothing proves that you began this hunt on this machine, and running it again would run code {runs}",
        fix=f"if you trust that code, run {command_line('crashhunt', 'trust', hunt)} once, or add --trust",
        where=str(hunt),
    )


def trust_hunt(hunt: Path, path: Path) -> list[TrustedOrigin]:
    """Trust all code of a hunt from now on, and return the new entries.

    Raises:
        BundleError: a snapshot is damaged.
        HuntDirectoryError: an entry cannot be written.
    """
    places = sorted((hunt / layout.SNAPSHOTS).glob(layout.SHOWN))
    for place in places:
        Snapshot(place).verify()
    found = [trust_snapshot(Snapshot(place), path) for place in places]
    if (hunt / REQUEST).is_file():
        agents = RunRequest.read(hunt / REQUEST).request.locators.values()
        runs = f"the request of a suite for {', '.join(agents) or 'the agents of its scenario'}"
        found.append(add_trusted(_fingerprint(hunt / REQUEST), path=str(path.resolve()), runs=runs))
    return found


def _is_request_trusted(file: Path) -> bool:
    try:
        data = json.loads(file.read_bytes())
        code = data.pop("authentication_code", None)
        return is_authentic(_PURPOSE, data, code) or is_fingerprint_trusted(_fingerprint(file))
    except (OSError, ValueError, AttributeError, TypeError, RecursionError):
        return False


def _fingerprint(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
