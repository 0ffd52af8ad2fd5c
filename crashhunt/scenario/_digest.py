"""A digest of what a scenario is: its files, and what it says."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

from crashhunt.base.integrity import digest_of_file

if TYPE_CHECKING:
    from collections.abc import Mapping

    from crashhunt.base.plain import Plain
    from crashhunt.scenario._scenario import Scenario

__all__ = ["as_in_file", "as_plain_data", "digest_of_described", "scenario_digest"]


class HasDigest(TypedDict):
    """What is written down of a file."""

    blake2b: str


def scenario_digest(scenario: Scenario) -> str:
    """Return a digest of the scenario's files and of what it says, whoever drives in it."""
    files: dict[str, HasDigest] = {
        name: {"blake2b": digest_of_file(scenario.folder / name)} for name in scenario.files()
    }
    says = as_plain_data(scenario)
    del says["agents"]
    files[""] = {"blake2b": json.dumps(says, sort_keys=True)}
    return digest_of_described(files)


def digest_of_described(files: Mapping[str, HasDigest], *, says: object = None) -> str:
    """Return a digest of files that have been described (name to an entry with ``blake2b``), and of plain data."""
    content = {name: entry["blake2b"] for name, entry in files.items()}
    text = json.dumps(content if says is None else [content, says], sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def as_in_file(data: Plain) -> dict[str, object]:
    """Return the fields of a scenario as plain data, in which the simulator's table stands where it does in a file."""
    found: dict[str, object] = {}
    for key, value in data.items():
        found |= value if key == "tables" and isinstance(value, dict) else {key: value}
    return found


def as_plain_data(scenario: Scenario) -> dict[str, object]:
    """Return what a scenario says, as TOML can hold it, without what is nobody's business but this process's."""

    def plain(value: object) -> object:
        if isinstance(value, dict):
            return {key: plain(item) for key, item in value.items() if item is not None}
        return [plain(item) for item in value] if isinstance(value, list | tuple) else value

    said = asdict(replace(scenario, folder=Path()))
    data = as_in_file({key: plain(value) for key, value in said.items() if value is not None})
    for later in ("events", "disturbances"):  # which an earlier crashhunt does not know
        if not data[later]:
            del data[later]
    return {key: value for key, value in data.items() if key not in ("folder", "file", "notes", "added")}
