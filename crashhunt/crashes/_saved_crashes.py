"""Reads the crashes that a hunt has saved, and finds the crash that the user names."""

from __future__ import annotations

import re
from contextlib import ExitStack, contextmanager, suppress
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.codec import JsonObject, known_part, typed_where_there
from crashhunt.base.errors import BundleError
from crashhunt.base.files import locked_folder
from crashhunt.base.integrity import FILES, FileEntry, changed_file, digest_of_data, read_object, typed
from crashhunt.base.older_versions import HOW_TO_READ
from crashhunt.base.text import listed, near_path, one_of
from crashhunt.crashes._bundle import _DAMAGE_FIX, SCHEMA, Bundle
from crashhunt.trial import (
    Collision,
    Escape,
    Failure,
    TrialResult,
    check_disturbances,
    check_parts,
)
from crashhunt.world import ClosestApproach, Event

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from crashhunt.base.json_types import Plain


def list_bundles(directory: Path) -> list[Bundle]:
    """Return the crashes of a hunt, in order of their trials."""
    return [read_bundle(folder) for folder in crash_folders(directory)]


def list_near_misses(directory: Path) -> list[Bundle]:
    """Return the near misses of a hunt, the most dangerous first."""
    found = [read_bundle(folder) for folder in crash_folders(directory, layout.NEAR_MISSES)]
    return sorted(found, key=lambda bundle: (-(bundle.result.danger or 0.0), bundle.result.spec.number))


def crash_folders(directory: Path, place: str = layout.CRASHES) -> list[Path]:
    """Return the folders of crashes, also without ``crash.json``, but not the folders of minimized crashes."""
    folders = (directory / place).glob(layout.SHOWN)
    found = (path for path in folders if path.is_dir() and not path.name.endswith(layout.SMALL))
    return sorted(path for path in found if re.match(r"\d+-", path.name) or (path / layout.CRASH).exists())


def find_bundle(directory: Path, crash: str = "") -> Bundle:
    """Return one crash or near miss of a hunt: the one that the user names, or else the crash with the fewest steps.

    If the hunt has no crash, its most critical near miss is returned. Without near misses, a crash found by a fork is
    returned, or else a minimized crash, as in an exported file.

    Args:
        directory: directory of the hunt, or of one bundle.
        crash: The id of a crash, of a near miss, or of a crash found by a robustness probe or a branch. The beginning
            of an id or the number of the trial suffices. A minimized crash needs its whole id.

    Raises:
        BundleError: the hunt has no such crash.
    """
    if (directory / layout.CRASH).is_file() and not crash:
        return read_bundle(directory)
    small = directory / layout.CRASHES / crash
    if crash.endswith(layout.SMALL) and small.parent == directory / layout.CRASHES and small.is_dir():
        return read_bundle(small)
    if crash:
        # What copies have found of a trial has its number as well, and may have the name of a crash.
        found = (_readable(directory, crash, places) for places in _FOLDERS_BY_PRIORITY)
        bundles = next((some for some in found if any(_may_be(bundle, crash) for bundle in some)), None)
        bundles = bundles if bundles is not None else _readable(directory, crash, _FOLDERS_BY_PRIORITY[0])
    else:
        bundles = list_bundles(directory) or list_near_misses(directory)[:1] or _of_copies(directory)
        bundles = bundles or _minimized_sources(directory)
    if not bundles:
        if directory.is_file():
            raise BundleError(
                f"{str(directory)!r} is a file, not the directory of a hunt",
                fix="unpack it into a new folder if crashhunt export wrote it, and give that folder",
            )
        if directory.exists() and not directory.is_dir():  # such as a shell's <(command)
            message = f"{str(directory)!r} is a device or a pipe, which cannot be read twice"
            raise BundleError(message, fix="write its contents to a file, and give that file")
        if not directory.is_dir():
            fix = f"{near_path(directory, '.zip', with_file=(layout.HUNT, layout.CRASH))}give the directory of a hunt"
            raise BundleError(f"{str(directory)!r} does not exist", fix=fix)
        # The directory of a gate or a suite has those of its hunts.
        hunts = [str(path.parent) for path in sorted(directory.glob(f"*/{layout.HUNT}"))]
        fix = f"give the directory of a hunt that found one{f': {listed(hunts)}' if hunts else ''}"
        raise BundleError("no crash was saved here", fix=fix, where=str(directory))
    if not crash:
        return min(bundles, key=lambda bundle: (bundle.result.steps, bundle.result.spec.number))
    return _named(bundles, crash, directory)


_FOLDERS_BY_PRIORITY = ((layout.CRASHES, layout.NEAR_MISSES), (layout.PROBES,), (layout.BRANCHES,))


def _of_copies(directory: Path) -> list[Bundle]:
    return [
        read_bundle(folder) for place in (layout.PROBES, layout.BRANCHES) for folder in crash_folders(directory, place)
    ]


def _minimized_sources(directory: Path) -> list[Bundle]:
    found = sorted((directory / layout.CRASHES).glob(f"*{layout.SMALL}"))
    return [read_bundle(path) for path in found if (path / layout.CRASH).is_file()]


def _may_be(bundle: Bundle, crash: str) -> bool:
    return bundle.id.startswith(crash) or (crash.isdecimal() and bundle.result.spec.number == int(crash))


def _readable(directory: Path, crash: str, places: Sequence[str]) -> list[Bundle]:
    """Return the crashes of a hunt that can be read; a damaged crash raises an error only if the user names it."""
    found = []
    for path in (folder for place in places for folder in crash_folders(directory, place)):
        try:
            found.append(read_bundle(path))
        except BundleError:
            name = path.name
            if name.startswith(crash) or name.partition("-")[0].lstrip("0") == crash.lstrip("0"):
                raise
    return found


def _named(bundles: Sequence[Bundle], crash: str, directory: Path) -> Bundle:
    """Return the crash that the user names by its id, its trial number or the beginning of its id, in this order."""
    number = int(crash) if crash.isdecimal() else None
    for meant in (
        [bundle for bundle in bundles if bundle.id == crash],
        [bundle for bundle in bundles if bundle.result.spec.number == number],
        [bundle for bundle in bundles if bundle.id.startswith(crash)],
    ):
        if len(meant) == 1:
            return meant[0]
        if meant:
            fix = f"give one of {listed(bundle.id for bundle in meant)}"
            raise BundleError(f"{crash!r} matches several crashes", fix=fix, where=str(directory))
    fix = one_of(crash, (bundle.id for bundle in bundles))
    raise BundleError(f"there is no crash {crash!r}", fix=fix, where=str(directory))


# How a bundle is read: ``crash.json``, whose integrity is checked first, and the files that it lists.


def refuse_damaged(data: JsonObject) -> None:
    """Raise an error if the description of a crash has changed since it was written.

    Raises:
        ValueError: the description has changed.
    """
    typed(data, {"integrity": str, "files": FILES})
    said = data.pop("integrity")
    if digest_of_data(data) != said:
        raise ValueError("the file has changed since it was written")
    for name, entry in data["files"].items():
        typed(entry, {"size": int, "blake2b": str})
        if "/" in name or name in ("", ".", ".."):
            raise ValueError(f"the file {name!r} is not in the folder of the bundle")


def files_of(folder: Path) -> dict[str, FileEntry]:
    """Return the recorded size and digest of each file of a crash or kept trial; empty if the record cannot be read."""
    for name in (layout.CRASH, layout.PARAMS):
        with suppress(OSError, ValueError):
            data: JsonObject = read_object(folder / name, dict)
            refuse_damaged(data)
            return dict(data["files"])
    return {}


def read_params(folder: Path) -> list[str]:
    """Return the names of a trial's saved files that have changed since they were written."""
    try:
        data: JsonObject = read_object(folder / layout.PARAMS, dict)
        refuse_damaged(data)
        return [
            f"{name} {wrong}" for name, entry in data["files"].items() if (wrong := changed_file(folder / name, entry))
        ]
    except (OSError, ValueError) as error:
        return [f"params.json: {error.strerror if isinstance(error, OSError) else error}"]


_MAX_OLDER_SCHEMA = 5  # from before format version 1, as schema 1 without ``integrity``
_SCALAR = bool | float | str | None
_REQUIRED_KEYS: Plain = {
    **dict.fromkeys(("trial", "seed", "max_steps", "step"), int),
    **dict.fromkeys(("outcome", "digest", "snapshot"), str),
}
_TYPES: Plain = {
    "hunt_seed": int,
    "arguments": dict[str, dict[str, _SCALAR]],
    "scenario_arguments": dict[str, _SCALAR],
    "sim_time_s": float,
    "confirmed": bool | None,
    "divergence": dict | None,
    **dict.fromkeys(("disturbed", "digest_of_changes"), bool),
    **dict.fromkeys(("log_likelihood", "danger"), float | None),
    "only": list[str] | None,
    "events": dict[str, int] | None,
    "robustness": dict[str, float | None] | None,
    **dict.fromkeys(("why_unconfirmed", "why_no_escape"), str),
    "script": dict | None,
    "authentication_code": str,
}
# The keys of ``crash.json`` by the fields of the trial's specification and of its result.
_SPEC_KEYS = {
    "number": "trial", "disturbances": "planned_disturbances",
    **{name: name for name in ("seed", "arguments", "scenario_arguments", "max_steps", "only", "script",
                               "digest_of_changes")},
}  # fmt: skip
_RESULT_KEYS = {
    "steps": "step", "closest": "closest_approach",
    **{name: name for name in ("outcome", "category", "sim_time_s", "digest", "collision", "failure", "escape", "event",
                               "events", "disturbances", "log_likelihood", "danger", "robustness", "why_no_escape")},
}  # fmt: skip
_PARTS: Mapping[str, type] = {
    "collision": Collision, "failure": Failure, "escape": Escape, "event": Event, "closest_approach": ClosestApproach,
}  # fmt: skip
_KEYS = {
    *_REQUIRED_KEYS, *_TYPES, *_PARTS, "schema", "id", "category", "summary", "versions", "files", "integrity",
    "disturbances", "planned_disturbances",
}  # fmt: skip


def read_lights(bundle: Bundle) -> JsonObject:
    """Return the lights and routes of a bundle; empty if it has none, or if the file has changed."""
    path, entry = bundle.path / layout.LIGHTS, bundle.files.get(layout.LIGHTS)
    if entry is None or changed_file(path, entry):
        return {}
    with suppress(OSError, ValueError):
        found: JsonObject = read_object(path, dict)
        return found
    return {}


def names_of_actions(bundle: Bundle, agent: str) -> tuple[str, ...]:
    """Return the name of each discrete action of an agent, such as ``SLOWER``, by number; empty if unknown.

    The replay that confirms a crash writes them in the file of the lights: the log has the numbers only.
    """
    found = read_lights(bundle).get("actions")
    names = found.get(agent) if isinstance(found, dict) else None
    return tuple(map(str, names)) if isinstance(names, list) else ()


def read_bundle(path: Path) -> Bundle:
    """Read a crash bundle from its folder.

    Raises:
        BundleError: the folder is not a crash bundle, or the bundle is damaged.
    """
    file = path / layout.CRASH
    try:
        data: JsonObject = read_object(file, dict)
        typed(data, {"schema": int})
        if 1 < data["schema"] <= _MAX_OLDER_SCHEMA or (data["schema"] == SCHEMA and "integrity" not in data):
            raise BundleError("the crash is older than format version 1", fix=HOW_TO_READ, where=str(file))
        if data["schema"] != SCHEMA:
            raise BundleError(
                f"schema version {data['schema']} is not supported (supported: {SCHEMA})",
                fix="use the version of crashhunt that wrote the trial",
                where=str(file),
            )
        refuse_damaged(data)
        return _bundle(path, data)
    except OSError as error:
        raise BundleError(
            f"the folder contains no crash bundle: {error.strerror}",
            fix="give another folder, or run crashhunt check to see what can be recovered",
            where=str(file),
        ) from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        reason = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
        raise BundleError(f"crash.json is damaged: {reason}", fix=_DAMAGE_FIX, where=str(file)) from None


def as_stored(bundle: Bundle) -> Bundle:
    """Return a bundle as it is on the disk now; the given bundle if it cannot be read, or contains another crash.

    A hunt that runs may confirm a crash while a command judges it. Each of the two writes the whole ``crash.json``.
    """
    try:
        stored = read_bundle(bundle.path)
    except BundleError:
        return bundle
    is_same = (stored.id, stored.result.digest) == (bundle.id, bundle.result.digest)
    return stored if is_same else bundle


@contextmanager
def changing(bundle: Bundle) -> Iterator[Bundle]:
    """Yield a bundle as it is on the disk now, to be changed and written; other processes wait until it is written."""
    with ExitStack() as held:
        with suppress(OSError):  # a hunt has deleted the bundle, or the file system has no locks
            held.enter_context(locked_folder(bundle.path))
        yield as_stored(bundle)


def _bundle(path: Path, data: JsonObject) -> Bundle:
    typed(data, _REQUIRED_KEYS)
    typed_where_there(data, _TYPES)
    check_parts(
        data.get("closest_approach", {}), *(data.get(name) for name in ("collision", "failure", "escape", "event"))
    )
    for disturbances in (data.get("planned_disturbances"), data.get("disturbances")):
        check_disturbances(disturbances)
    if not 0 <= data["seed"] < 2**31 or min(data["trial"], data["step"]) < 0 or data["max_steps"] < 1:
        numbers = ", ".join(f"{name} = {data[name]}" for name in ("trial", "seed", "step", "max_steps"))
        raise ValueError(f"one of these numbers is out of range: {numbers}")
    if not re.fullmatch(r"\w+", data["snapshot"]):
        raise ValueError(f"snapshot {data['snapshot']!r} is not the name of a snapshot")
    spec = {name: data[key] for name, key in _SPEC_KEYS.items() if key in data}
    result = {name: data[key] for name, key in _RESULT_KEYS.items() if key in data}
    own = ("confirmed", "divergence", "why_unconfirmed", "authentication_code")
    return Bundle(
        path=path,
        result=TrialResult.from_json({**result, "spec": spec}),
        hunt_seed=data.get("hunt_seed", 0),
        snapshot=data["snapshot"],
        files=data["files"],
        added=_added(data),
        **{name: data[name] for name in own if name in data},
    )


def _added(data: JsonObject) -> dict[str, object]:
    """Return the JSON keys that a later version of crashhunt added to the crash and its parts."""
    added: dict[str, object] = {name: value for name, value in data.items() if name not in _KEYS}
    for name, kind in _PARTS.items():
        _, rest = known_part(kind, data.get(name))
        if rest:
            added[name] = rest
    return added
