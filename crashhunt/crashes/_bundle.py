"""Crash bundles: the folder with all that replaying one crash needs, and what its log says of itself."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import BundleError
from crashhunt.base.files import put_in_place, sync_folder, sync_tree, whole_file
from crashhunt.base.integrity import changed_file, digest_of_data, read_object, typed
from crashhunt.base.temporary import temporary_beside
from crashhunt.base.tolerance import known_part, merged, typed_where_there
from crashhunt.crashes._beside import collect_output, files_beside, see_that_it_is_whole
from crashhunt.crashes._data import CrashData
from crashhunt.crashes._origins import authenticate_bundle
from crashhunt.recording import Recording, read_black_box
from crashhunt.snapshots import versions
from crashhunt.trial import (
    Collision,
    Disturbance,
    Escape,
    Failure,
    TrialResult,
    TrialSpec,
    check_disturbances,
    check_parts,
    outcome_of,
)
from crashhunt.world import ClosestApproach, Event, Paths

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from crashhunt.base.integrity import FileEntry
    from crashhunt.base.plain import Plain
    from crashhunt.crashes._data import CrashSummary
    from crashhunt.recording import DivergenceData
    from crashhunt.world import Lane

__all__ = [
    "Bundle",
    "read_bundle",
    "write_bundle",
    "write_trial",
]

SCHEMA = 5
_ALL_DRIVE = 4  # what is written where nobody is scripted
_ALL_TAKE_PART = 3  # what is written where nobody is left out
_UNDISTURBED = 2  # what is written where there are no disturbances: without them, it would be another trial
_PROTECTED = 2  # the first version with a digest of itself and of the files beside it
_KNOWN = bool | float | str | None
_NEEDED: Plain = {
    **dict.fromkeys(("trial", "seed", "max_steps", "step"), int),
    **dict.fromkeys(("outcome", "digest", "snapshot"), str),
}
_TYPES: Plain = {
    "hunt_seed": int,
    "arguments": dict[str, dict[str, _KNOWN]],
    "scenario_arguments": dict[str, _KNOWN],
    "sim_time_s": float,
    "confirmed": bool | None,
    "divergence": dict | None,
    "disturbed": bool,
    **dict.fromkeys(("log_likelihood", "danger"), float | None),
    "only": list[str] | None,
    **dict.fromkeys(("why_unconfirmed", "why_no_escape"), str),
    "script": dict | None,
    "authentication_code": str,
}
_KEYS = CrashData.__required_keys__ | CrashData.__optional_keys__
_PARTS: Mapping[str, type] = {
    "collision": Collision, "failure": Failure, "escape": Escape, "event": Event, "closest_approach": ClosestApproach,
}  # fmt: skip
_UNDAMAGED = "get an undamaged copy, or see with crashhunt check what can be saved"


@dataclass(frozen=True, slots=True)
class Bundle:
    """A crash on disk.

    Args:
        path: of its folder.
        result: the crash.
        hunt_seed: of the hunt that found it.
        snapshot: the digest of the code that it ran.
        confirmed: whether a fresh process did the same to the bit; None where nobody tried, or no try came to its end.
        divergence: where it did not.
        files: size and digest of the files beside ``crash.json``, as they were written; earlier versions did not say.
        added: what a later version says of it, which is written back.
        why_unconfirmed: why the try did not come to its end; empty where it did, or nobody tried.
        authentication_code: proves to the user who made it what determines the trial; empty where nothing does.
    """

    path: Path
    result: TrialResult
    hunt_seed: int
    snapshot: str
    confirmed: bool | None = None
    divergence: DivergenceData | None = None
    files: Mapping[str, FileEntry] = field(default_factory=dict)
    added: Plain = field(default_factory=dict)
    why_unconfirmed: str = ""
    authentication_code: str = ""

    @property
    def id(self) -> str:
        """Its name within the hunt, such as ``000012-collision``."""
        return self.path.name

    @property
    def hunt(self) -> Path:
        """The hunt's directory."""
        return self.path.parent.parent

    @property
    def is_near_miss(self) -> bool:
        """Whether it is a trial without a crash, which was kept because it was dangerous."""
        return self.result.outcome.category == "no crash"

    @property
    def driver(self) -> str:
        """The agent that it is about; of one that is about none, the first."""
        result = self.result
        about = next((found.agent for found in (result.collision, result.event, result.failure) if found), "")
        return about or next(iter(self.result.spec.arguments), "")

    def recording(self) -> Recording:
        """Read the log.

        Raises:
            BundleError: it is missing, damaged, or that of another crash.
        """
        from crashhunt.recording import read_log  # MCAP and protobuf take longer than a hunt that is refused

        log = self.path / layout.LOG
        found = read_log(log)
        if found.digest != self.result.digest:
            raise BundleError("the log does not have the digest that crash.json says", fix=_UNDAMAGED, where=str(log))
        # The views for people, which have no part in the digest of the trial.
        wrong = changed_file(log, self.files[log.name]) if log.name in self.files else ""
        if wrong:
            raise BundleError(f"it {wrong} since it was written", fix=_UNDAMAGED, where=str(log))
        return found

    def faults(self) -> list[str]:
        """Return which files beside ``crash.json`` are not as they were written, and those that were not there."""
        found = [
            f"{name} {wrong}" for name, entry in self.files.items() if (wrong := changed_file(self.path / name, entry))
        ]
        if self.files:
            names = {path.name for path in self.path.iterdir()} - {layout.CRASH}
            found += [f"{name} was not there" for name in sorted(names - self.files.keys()) if name[0] != "."]
        return found

    def summary(self) -> CrashSummary:
        """Return the shape that ``run --json`` prints."""
        plain = self.result.to_json()
        spec = plain["spec"]
        found: CrashSummary = {
            "id": self.id,
            "trial": spec["number"],
            "seed": spec["seed"],
            "outcome": plain["outcome"],
            "step": plain["steps"],
            "arguments": spec["arguments"],
            "scenario_arguments": spec["scenario_arguments"],
            "path": str(self.path),
            "digest": plain["digest"],
            "confirmed": self.confirmed,
        }
        if self.why_unconfirmed:
            found["why_unconfirmed"] = self.why_unconfirmed
        if self.is_near_miss:
            found["danger"] = plain.get("danger")
        if "log_likelihood" in plain or self.result.spec.disturbances:
            found["disturbed"] = self.result.disturbed
            found["log_likelihood"] = plain.get("log_likelihood")
        return found

    def write(self, into: Path | None = None) -> None:
        """Write ``crash.json``, all of it or nothing; into another folder where the bundle is still being built."""
        folder = into or self.path
        result = self.result
        plain = result.to_json()
        spec = plain["spec"]
        data: CrashData = {
            "schema": _schema_of(result.spec),
            "id": self.id,
            "hunt_seed": self.hunt_seed,
            "trial": spec["number"],
            "seed": spec["seed"],
            "max_steps": spec["max_steps"],
            "arguments": spec["arguments"],
            "scenario_arguments": spec["scenario_arguments"],
            "outcome": plain["outcome"],
            "category": result.outcome.category,
            "summary": result.summary,
            "step": plain["steps"],
            "sim_time_s": plain["sim_time_s"],
            "collision": plain["collision"],
            "failure": plain["failure"],
            "escape": plain["escape"],
            "event": plain["event"],
            "events": plain["events"],
            "closest_approach": plain["closest"],
            "digest": plain["digest"],
            "snapshot": self.snapshot,
            "versions": versions(),
            "confirmed": self.confirmed,
            "divergence": self.divergence,
            "files": dict(self.files) or files_beside(folder),
        }
        if self.why_unconfirmed:
            data["why_unconfirmed"] = self.why_unconfirmed
        if result.why_no_escape:
            data["why_no_escape"] = result.why_no_escape
        if result.danger is not None:
            data["danger"] = plain.get("danger")
        if result.log_likelihood is not None or result.spec.disturbances:
            data["disturbed"] = result.disturbed
            data["log_likelihood"] = plain.get("log_likelihood")
            data["disturbances"] = plain.get("disturbances", [])
            data["planned_disturbances"] = spec.get("disturbances", [])
        if "only" in spec:
            data["only"] = spec["only"]
        if "script" in spec:
            data["script"] = spec["script"]
        if self.authentication_code:
            data["authentication_code"] = self.authentication_code
        whole = merged(data, self.added)
        whole["integrity"] = digest_of_data(whole)
        with whole_file(folder / layout.CRASH) as temporary:
            text = json.dumps(whole, indent=2, ensure_ascii=False) + "\n"
            temporary.write_text(text, encoding="utf-8", errors="surrogatepass")


def _schema_of(spec: TrialSpec) -> int:
    """The first version that knows everything that determines the trial."""
    if spec.script is not None:
        return SCHEMA
    if spec.only is not None:
        return _ALL_DRIVE
    return _ALL_TAKE_PART if spec.disturbances else _UNDISTURBED


def read_bundle(path: Path) -> Bundle:
    """Read a crash bundle.

    Raises:
        BundleError: it is not one, or it is damaged.
    """
    file = path / layout.CRASH
    try:
        data = read_object(file, CrashData)
        typed(data, {"schema": int})
        if not 1 <= data["schema"] <= SCHEMA:
            raise BundleError(
                f"schema {data['schema']} is above {SCHEMA}", fix="use the version that wrote it", where=str(file)
            )
        if data["schema"] >= _PROTECTED or "integrity" in data:
            see_that_it_is_whole(data)
        return _bundle(path, data)
    except OSError as error:
        raise BundleError(
            f"no crash bundle here: {error.strerror}",
            fix="give another folder, or see with crashhunt check what can be saved",
            where=str(file),
        ) from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        reason = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
        raise BundleError(f"not an undamaged crash.json: {reason}", fix=_UNDAMAGED, where=str(file)) from None


def _bundle(path: Path, data: CrashData) -> Bundle:
    typed(data, _NEEDED)
    typed_where_there(data, _TYPES)
    hit, failure, event, escape = data.get("collision"), data.get("failure"), data.get("event"), data.get("escape")
    closest = data.get("closest_approach", {})
    check_parts(closest, hit, failure, escape, event)
    for disturbances in (data.get("planned_disturbances"), data.get("disturbances")):
        check_disturbances(disturbances)
    typed({"events": data.get("events")}, {"events": dict[str, int] | None})
    if not 0 <= data["seed"] < 2**31 or min(data["trial"], data["step"]) < 0 or data["max_steps"] < 1:
        raise ValueError("trial, seed, step or max_steps is out of its range")
    if not re.fullmatch(r"\w+", data["snapshot"]):
        raise ValueError(f"snapshot {data['snapshot']!r} is no name of one")
    spec = TrialSpec(
        data["trial"],
        data["seed"],
        data.get("arguments", {}),
        data.get("scenario_arguments", {}),
        max_steps=data["max_steps"],
        disturbances=tuple(map(Disturbance.from_json, data.get("planned_disturbances") or ())),
        only=tuple(only) if (only := data.get("only")) is not None else None,
        script=Paths.from_json(script) if (script := data.get("script")) else None,
    )
    result = TrialResult(
        spec,
        outcome_of(data),
        steps=data["step"],
        sim_time_s=data.get("sim_time_s", 0.0),
        digest=data["digest"],
        closest=ClosestApproach.from_json(closest),
        collision=Collision.from_json(hit) if hit else None,
        failure=Failure.from_json(failure) if failure else None,
        escape=Escape.from_json(escape) if escape else None,
        event=Event.from_json(event) if event else None,
        events=data.get("events"),
        disturbances=tuple(map(Disturbance.from_json, data.get("disturbances") or ())),
        log_likelihood=data.get("log_likelihood"),
        danger=data.get("danger"),
        why_no_escape=data.get("why_no_escape", ""),
    )
    files = data.get("files", {}) if data["schema"] >= _PROTECTED else {}
    return Bundle(
        path,
        result,
        data.get("hunt_seed", 0),
        data["snapshot"],
        data.get("confirmed"),
        data.get("divergence"),
        files,
        added=_added(data),
        why_unconfirmed=data.get("why_unconfirmed", ""),
        authentication_code=data.get("authentication_code", ""),
    )


def _added(data: CrashData) -> dict[str, object]:
    """What a later version says, of the crash and inside its parts."""
    added: dict[str, object] = {name: value for name, value in data.items() if name not in _KEYS}
    for name, kind in _PARTS.items():
        _, rest = known_part(kind, data.get(name))
        if rest:
            added[name] = rest
    return added


def write_bundle(
    directory: Path,
    result: TrialResult,
    scratch: Path,
    *,
    hunt_seed: int,
    snapshot: str,
    lanes: Sequence[Lane],
    name: str = "",
    place: str = layout.CRASHES,
    confirmed: bool | None = None,
    authenticate: bool = True,
) -> Bundle:
    """Make the bundle of a crash, or of a near miss, from what its trial left behind.

    Args:
        directory: of the hunt.
        result: the crash.
        scratch: the trial's scratch folder; it is emptied.
        hunt_seed: of the hunt.
        snapshot: the digest of the code that ran.
        lanes: of the map, for whoever looks at the log.
        name: of its folder, where that is not made of the trial's number and the outcome.
        place: the folder of the directory that it goes into.
        confirmed: whether a fresh process did the same, where that is known already.
        authenticate: whether to write down the proof that this user made it; only where the snapshot is this user's.
    """
    from crashhunt.recording import foxglove_layout, write_log

    name = name or layout.crash_folder(result.spec.number, result.outcome)
    final = directory / place / name
    recording = Recording(read_black_box(scratch / layout.BLACK_BOX))
    crash = result if result.outcome.category != "no crash" else None
    metadata = {"trial": str(result.spec.number), "seed": str(result.spec.seed), "outcome": str(result.outcome)}
    view = json.dumps(foxglove_layout(recording), indent=1)
    with temporary_beside(final) as building:
        building.mkdir(parents=True)
        write_log(building / layout.LOG, recording, lanes=lanes, metadata=metadata, crash=crash)
        (building / layout.FOXGLOVE_LAYOUT).write_text(view, encoding="utf-8")
        collect_output(result, scratch, building)
        bundle = Bundle(final, result, hunt_seed, snapshot, confirmed, files=files_beside(building))
        if authenticate:
            bundle = replace(bundle, authentication_code=authenticate_bundle(bundle))
        bundle.write(into=building)
        sync_tree(building)
        put_in_place(building, final)
        sync_folder(final.parent, directory)
    shutil.rmtree(scratch, ignore_errors=True)
    return bundle


def write_trial(directory: Path, result: TrialResult, scratch: Path) -> None:
    """Keep what a trial printed that is no crash; its scratch folder is emptied."""
    target = directory / layout.TRIALS / f"{result.spec.number:06d}"
    target.mkdir(parents=True, exist_ok=True)
    collect_output(result, scratch, target)
    data = {**result.to_json(), "schema": _UNDISTURBED, "files": files_beside(target)}
    data["integrity"] = digest_of_data(data)
    with whole_file(target / layout.PARAMS, lasting=False) as temporary:
        temporary.write_text(json.dumps(data, indent=2), encoding="utf-8")
    shutil.rmtree(scratch, ignore_errors=True)
