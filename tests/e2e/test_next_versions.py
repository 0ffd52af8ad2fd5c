"""A libsumo and a highway-env that crashhunt does not know yet: one line, and the same results."""

from __future__ import annotations

import importlib.util
import json
import shutil
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from pathlib import Path

pytest.importorskip("_crashhunt_core", reason="the compiled core is not built")


def pretend(folder: Path, name: str) -> None:
    """Put version 99.0 of a distribution into a folder: its metadata, and of highway-env also the code."""
    facts = folder / f"{name.replace('-', '_')}-99.0.dist-info/METADATA"
    facts.parent.mkdir(parents=True)
    facts.write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 99.0\n", encoding="utf-8")
    if name == "highway-env":
        (code,) = importlib.util.find_spec("highway_env").submodule_search_locations
        shutil.copytree(code, folder / "highway_env")
        with (folder / "highway_env/__init__.py").open("a", encoding="utf-8") as file:
            file.write('__version__ = "99.0"\n')
        for module in (folder / "highway_env").rglob("*.py"):  # a class that only the accelerator imports is renamed
            text = module.read_text(encoding="utf-8")
            if "OccupancyGridObservation" in text:  # what is compiled of the others stays valid
                module.write_text(text.replace("OccupancyGridObservation", "GridObservation"), encoding="utf-8")


@pytest.mark.parametrize(
    ("name", "scenario", "notes"),
    [
        ("libsumo", "loop", ("the compiled core is not used: it was", "the order of SUMO's links is not fixed: the")),
        ("highway-env", "highway", ("the accelerator does not know highway-env 99.0 and steps aside; it knows",)),
    ],
)  # fmt: skip
def test_hunt_with_the_next_version_states_what_steps_aside_and_does_the_same(name, scenario, notes, shell):
    words = ("1", "2", "5", "--scenario", scenario, "--seed", "1", "--no-snapshot")
    pretend(shell.folder / "site", name)
    known = shell.crashhunt("run", "known", *words)
    shell.environment["PYTHONPATH"] = str(shell.folder / "site")
    later = shell.process("run", "later", *words)
    first = later.out.partition("running:")[0].splitlines()
    assert [line.startswith(note) for line, note in zip(first, notes, strict=True)] == [True] * len(notes)
    assert all("99.0" in line for line in first)
    assert not any(note in known.out for note in notes)
    del shell.environment["PYTHONPATH"]
    tables = [json.loads(shell.crashhunt("trials", hunt, "--format", "json").out) for hunt in ("known", "later")]
    digests = [[row["digest"] for row in rows] for rows in tables]
    assert digests[0] == digests[1]
    assert len(digests[0]) == 2
