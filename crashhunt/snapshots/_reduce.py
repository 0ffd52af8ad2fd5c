"""A snapshot without its code: the scenario alone, for whoever runs it with today's code."""

from __future__ import annotations

import json
import shutil
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import BundleError
from crashhunt.base.integrity import changed_file, describe_files, digest_of_data
from crashhunt.scenario import digest_of_described
from crashhunt.snapshots._snapshot import SCHEMA, Snapshot, code_of_manifest

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.snapshots._data import Environment, Manifest

__all__ = ["without_code"]


def without_code(snapshot: Snapshot, snapshots: Path) -> Snapshot:
    """Copy what of a snapshot is no code: the scenario with its files, and on what its results depended.

    Args:
        snapshot: of a hunt; nobody else needs to have it looked at.
        snapshots: the folder to make the copy in.

    Raises:
        BundleError: a file of it is missing or has changed.
        OSError: it cannot be written.
    """
    kept = {
        name: entry
        for name, entry in snapshot.manifest["files"].items()
        if name.startswith(f"{layout.SCENARIO_FILES}/")
    }
    digest = digest_of_described(kept, says=[[], {}])
    final = snapshots / digest
    (final / layout.SCENARIO_FILES).mkdir(parents=True)
    for name, entry in kept.items():
        wrong = changed_file(snapshot.path / name, entry)
        if wrong:
            fix = "get an undamaged copy of the hunt's directory"
            raise BundleError(f"the snapshot is damaged: {name} {wrong}", fix=fix, where=str(snapshot.path))
        (final / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(snapshot.path / name, final / name)
    shutil.copyfile(snapshot.path / layout.HUNT, final / layout.HUNT)
    environment = json.dumps(_of_simulation(snapshot.environment()), indent=1)
    (final / layout.ENVIRONMENT).write_text(environment, encoding="utf-8")
    manifest: Manifest = {"schema": SCHEMA, "paths": [], "argument_files": {}, "left_out": [], "files": kept}
    manifest["described"] = describe_files(final)
    manifest["authentication_code"] = code_of_manifest(manifest)
    manifest["integrity"] = digest_of_data(manifest)
    (final / layout.MANIFEST).write_text(json.dumps(manifest, indent=1), encoding="utf-8")
    return Snapshot(final)


def _of_simulation(found: Environment) -> Environment:
    """What a result depends on; not what else was installed, nor the folders of whoever ran it."""
    loaded = set(found["loaded"])
    distributions = {name: version for name, version in found["distributions"].items() if name in loaded}
    return {**found, "distributions": distributions, "variables": {}, "git": {}}
