"""Crash bundles: each is a folder that contains everything needed to replay one crash."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NotRequired, TypedDict

from crashhunt.base import layout
from crashhunt.base.codec import JsonObject, merged
from crashhunt.base.errors import BundleError
from crashhunt.base.files import whole_file
from crashhunt.base.integrity import FileEntry, changed_file, describe_files, digest_of_data
from crashhunt.base.text import command_line
from crashhunt.snapshots import Snapshot, versions

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from crashhunt.base.json_types import Plain
    from crashhunt.recording import Recording
    from crashhunt.trial import TrialResult, Value


class CrashSummary(TypedDict):
    """The form in which ``run --json`` prints a crash."""

    id: str
    trial: int
    seed: int
    outcome: str
    step: int
    arguments: Mapping[str, Mapping[str, Value]]
    scenario_arguments: Mapping[str, Value]
    path: str
    digest: str
    confirmed: bool | None
    why_unconfirmed: NotRequired[str]
    disturbed: NotRequired[bool]
    log_likelihood: NotRequired[float | None]
    danger: NotRequired[float | None]
    requirement: NotRequired[str]


# The other files of a bundle, next to ``crash.json``, or next to ``params.json`` of a trial kept for another reason.


def describe_other_files(folder: Path) -> dict[str, FileEntry]:
    """Return size and digest of every file in a folder, except the file that stores this list."""
    found = describe_files(folder)
    return {
        name: entry for name, entry in found.items() if name not in (layout.CRASH, layout.PARAMS) and name[0] != "."
    }


SCHEMA = 1
_DAMAGE_FIX = "get an undamaged copy, or run crashhunt check to see what can be recovered"


@dataclass(frozen=True, slots=True)
class Bundle:
    """A crash that is stored on disk.

    Args:
        path: path of the folder of the bundle.
        result: result of the trial that crashed.
        hunt_seed: seed of the hunt that found it.
        snapshot: digest of the code that the trial ran.
        confirmed: Whether a replay in a new process was bit-identical; None if no replay has finished.
        divergence: The point where the replay deviated from the recording; None if it did not.
        files: Size and digest of each other file of the bundle.
        added: JSON keys of later versions of crashhunt, which are kept when the bundle is written.
        why_unconfirmed: The reason why no replay was completed; empty if a replay was completed, or if none was
            started.
        authentication_code: Code that proves to the user who made the bundle that its trial is unchanged; may be empty.
    """

    path: Path
    result: TrialResult
    hunt_seed: int
    snapshot: str
    confirmed: bool | None = None
    divergence: JsonObject | None = None
    files: Mapping[str, FileEntry] = field(default_factory=dict)
    added: Plain = field(default_factory=dict)
    why_unconfirmed: str = ""
    authentication_code: str = ""

    @property
    def id(self) -> str:
        """The name of the crash within the hunt, such as ``000012-collision``."""
        return self.path.name

    @property
    def hunt(self) -> Path:
        """The directory of the hunt."""
        return self.path.parent.parent

    @property
    def is_near_miss(self) -> bool:
        """Whether the bundle is a near miss: a trial without a crash that was kept because of its high criticality."""
        return self.result.outcome.category == "no crash"

    @property
    def driver(self) -> str:
        """The identifier of the agent that crashed; the first agent if the crash belongs to no agent."""
        result = self.result
        about = next((found.agent for found in (result.collision, result.event, result.failure) if found), "")
        return about or next(iter(self.result.spec.arguments), "")

    def recording(self) -> Recording:
        """Read the log of the bundle and return its recording.

        Raises:
            BundleError: the log is missing, damaged, or belongs to another crash.
        """
        from crashhunt.recording import read_log  # MCAP and protobuf take longer than a hunt that is refused

        log = self.path / layout.LOG
        if not log.exists() and (self.hunt / layout.CASE).is_file():
            raise BundleError(
                "the case has no log, because an earlier crashhunt did not save it",
                fix=f"run {command_line('crashhunt', 'corpus', 'run', self.hunt)} --keep out, and use "
                f"out/{self.hunt.name}",
                where=str(self.path),
            )
        found = read_log(log)
        if found.digest != self.result.digest:
            raise BundleError("the digest of the log differs from that in crash.json", fix=_DAMAGE_FIX, where=str(log))
        # The views for people, which have no part in the digest of the trial.
        wrong = changed_file(log, self.files[log.name]) if log.name in self.files else ""
        if wrong:
            raise BundleError(f"the log {wrong} since it was written", fix=_DAMAGE_FIX, where=str(log))
        return found

    def faults(self) -> list[str]:
        """Return descriptions of the changed, missing and added files of the bundle."""
        found = [
            f"{name} {wrong}" for name, entry in self.files.items() if (wrong := changed_file(self.path / name, entry))
        ]
        if self.files:
            names = {path.name for path in self.path.iterdir()} - {layout.CRASH}
            names.discard(layout.LIGHTS)  # a confirmation that was killed may have written it
            found += [f"{name} was not there" for name in sorted(names - self.files.keys()) if name[0] != "."]
        return found

    def summary(self) -> CrashSummary:
        """Return the crash in the form that ``run --json`` prints."""
        plain = self.result.to_json()
        spec = plain["spec"]
        found: CrashSummary = {
            "id": self.id, "trial": spec["number"], "seed": spec["seed"], "outcome": plain["outcome"],
            "step": plain["steps"], "arguments": spec["arguments"], "scenario_arguments": spec["scenario_arguments"],
            "path": str(self.path), "digest": plain["digest"], "confirmed": self.confirmed,
        }  # fmt: skip
        if self.why_unconfirmed:
            found["why_unconfirmed"] = self.why_unconfirmed
        if self.is_near_miss:
            found["danger"] = plain.get("danger")
        if self.result.event is not None and self.result.event.name:
            found["requirement"] = self.result.event.name
        if "log_likelihood" in plain or self.result.spec.disturbances:
            found["disturbed"] = self.result.disturbed
            found["log_likelihood"] = plain.get("log_likelihood")
        return found

    def write(self, into: Path | None = None) -> None:
        """Write ``crash.json`` atomically into the bundle's folder, or into the folder in which it is being built."""
        folder = into or self.path
        result = self.result
        plain = result.to_json()
        spec = plain["spec"]
        data: JsonObject = {
            "schema": SCHEMA,
            "id": self.id,
            "hunt_seed": self.hunt_seed,
            "trial": spec["number"],
            **{name: spec[name] for name in ("seed", "max_steps", "arguments", "scenario_arguments")},
            "outcome": plain["outcome"],
            "category": result.outcome.category,
            "summary": result.summary,
            "step": plain["steps"],
            **{name: plain[name] for name in ("sim_time_s", "collision", "failure", "escape", "event", "events")},
            "closest_approach": plain["closest"],
            "digest": plain["digest"],
            "snapshot": self.snapshot,
            "versions": versions(),
            "confirmed": self.confirmed,
            "divergence": self.divergence,
            "files": dict(self.files) or describe_other_files(folder),
            **({"why_unconfirmed": self.why_unconfirmed} if self.why_unconfirmed else {}),
            **{name: plain[name] for name in ("why_no_escape", "danger", "robustness") if name in plain},
        }
        if result.log_likelihood is not None or result.spec.disturbances:
            data["disturbed"] = result.disturbed
            data["log_likelihood"] = plain.get("log_likelihood")
            data["disturbances"] = plain.get("disturbances", [])
            data["planned_disturbances"] = spec.get("disturbances", [])
        data |= {name: spec[name] for name in ("only", "script", "digest_of_changes") if name in spec}
        if self.authentication_code:
            data["authentication_code"] = self.authentication_code
        whole = merged(data, self.added)
        whole["integrity"] = digest_of_data(whole)
        with whole_file(folder / layout.CRASH) as temporary:
            text = json.dumps(whole, indent=2, ensure_ascii=False) + "\n"
            temporary.write_text(text, encoding="utf-8", errors="surrogatepass")


def snapshot_of(bundle: Bundle) -> Snapshot:
    """Return the snapshot of the code that the trial of a bundle ran."""
    return Snapshot(bundle.hunt / layout.SNAPSHOTS / bundle.snapshot)
