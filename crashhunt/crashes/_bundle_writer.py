"""Writes crash bundles, and the files of other kept trials, from what trials left in their scratch folders."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError
from crashhunt.base.files import put_in_place, sync_folder, sync_tree, whole_file
from crashhunt.base.integrity import FileEntry, digest_of_content, digest_of_data
from crashhunt.base.temporary import temporary_beside
from crashhunt.crashes._bundle import SCHEMA, Bundle, describe_other_files
from crashhunt.crashes._bundle_trust import authenticate_bundle
from crashhunt.recording import Recording, read_black_box

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from crashhunt.trial import TrialResult
    from crashhunt.world import Lane


def collect_output(result: TrialResult, scratch: Path, target: Path) -> None:
    """Copy the output of a trial to a folder, and write its failure to ``error.log``."""
    run_log = scratch / layout.RUN_LOG
    if run_log.is_file() and run_log.stat().st_size:
        shutil.copyfile(run_log, target / layout.RUN_LOG)
    failure = result.failure
    if failure is not None:
        parts = (failure.line, failure.traceback, failure.last_output)
        text = "\n\n".join(part.rstrip() for part in parts if part.strip())
        (target / layout.ERROR_LOG).write_text(text + "\n", encoding="utf-8", errors="replace")


def with_lights(bundle: Bundle, content: bytes) -> Bundle:
    """Write lights and routes into the folder of a bundle; return the bundle with this file, or as it was."""
    if not bundle.files or not bundle.path.is_dir():
        return bundle
    try:
        with whole_file(bundle.path / layout.LIGHTS) as temporary:
            temporary.write_bytes(content)
    except (CrashhuntError, OSError):  # a hunt with ``--keep`` may delete the bundle meanwhile
        return bundle
    entry: FileEntry = {"size": len(content), "blake2b": digest_of_content(content)}
    return replace(bundle, files={**bundle.files, layout.LIGHTS: entry})


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
    recording: Recording | None = None,
) -> Bundle:
    """Write the bundle of a crash or near miss from the files that its trial left in its scratch folder.

    Args:
        directory: directory of the hunt.
        result: result of the trial that crashed.
        scratch: scratch folder of the trial; it is emptied.
        hunt_seed: seed of the hunt.
        snapshot: digest of the code that the trial ran.
        lanes: The lanes of the map, for viewers of the log.
        name: name of the bundle's folder, if it differs from the number and outcome of the trial.
        place: subfolder of the hunt's directory in which the bundle is written.
        confirmed: whether a replay in a new process was bit-identical; None if unknown.
        authenticate: whether to add the code that proves that this user made the bundle; only if the snapshot is from
            this user.
        recording: recording of the trial; None to read it from the scratch folder.
    """
    from crashhunt.recording import foxglove_layout, write_log

    name = name or layout.crash_folder(result.spec.number, result.outcome)
    final = directory / place / name
    recording = recording or Recording(read_black_box(scratch / layout.BLACK_BOX))
    crash = result if result.outcome.category != "no crash" else None
    metadata = {"trial": str(result.spec.number), "seed": str(result.spec.seed), "outcome": str(result.outcome)}
    view = json.dumps(foxglove_layout(recording), indent=1)
    with temporary_beside(final) as building:
        building.mkdir(parents=True)
        write_log(building / layout.LOG, recording, lanes=lanes, metadata=metadata, crash=crash)
        (building / layout.FOXGLOVE_LAYOUT).write_text(view, encoding="utf-8")
        collect_output(result, scratch, building)
        bundle = Bundle(
            path=final,
            result=result,
            hunt_seed=hunt_seed,
            snapshot=snapshot,
            confirmed=confirmed,
            files=describe_other_files(building),
        )
        if authenticate:
            bundle = replace(bundle, authentication_code=authenticate_bundle(bundle))
        bundle.write(into=building)
        sync_tree(building)
        put_in_place(building, final)
        sync_folder(final.parent, directory)
    shutil.rmtree(scratch, ignore_errors=True)
    return bundle


def write_trial(directory: Path, result: TrialResult, scratch: Path) -> None:
    """Keep the output of a trial that did not crash; its scratch folder is emptied."""
    target = directory / layout.TRIALS / f"{result.spec.number:06d}"
    target.mkdir(parents=True, exist_ok=True)
    collect_output(result, scratch, target)
    data = {**result.to_json(), "schema": SCHEMA, "files": describe_other_files(target)}
    data["integrity"] = digest_of_data(data)
    with whole_file(target / layout.PARAMS, lasting=False) as temporary:
        temporary.write_text(json.dumps(data, indent=2), encoding="utf-8")
    shutil.rmtree(scratch, ignore_errors=True)
