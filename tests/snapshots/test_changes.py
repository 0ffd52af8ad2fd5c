"""The differences between two snapshots on which the results of trials may depend."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from crashhunt.snapshots import code_changes
from crashhunt.snapshots._snapshot import Snapshot, digest_of_manifest

FILES = {
    "code/crashhunt/__init__.py": "a", "code/crashhunt/trial/_space.py": "a", "code/@car/planner/agents.py": "a",
    "code/@car/planner/data.csv": "a", "code/@car/README.md": "a", "code/@car/.gitignore": "a", "code/alone.py": "a",
    "scenario/scenario.toml": "a", "scenario/town.net.xml": "a", "files/0-weights.zip": "a",
}  # fmt: skip
ENVIRONMENT = {
    "python": "3.12.1", "implementation": "CPython", "machine": "x86_64", "loaded": ["numpy", "crashhunt", "own"],
    "distributions": {"numpy": "2.1.0", "scipy": "1.0", "crashhunt": "1", "own": "1"},
}  # fmt: skip


def snapshot(files=None, *, conditions=None, arguments=("models/weights.zip",), paths=("code",), **environment):
    manifest = {
        "paths": list(paths),
        "argument_files": {name: f"files/{place}-{name.rpartition('/')[2]}" for place, name in enumerate(arguments)},
        "files": {name: {"size": 1, "blake2b": digest} for name, digest in (FILES | (files or {})).items() if digest},
    }
    found = SimpleNamespace(manifest=manifest, conditions=conditions or {})
    found.is_described = bool(paths) or any("/" in name for name in found.conditions)
    found.environment = ENVIRONMENT | environment
    return found


def changed(*given, **more):
    return code_changes(snapshot(), snapshot(*given, **more)).changed


@pytest.mark.parametrize(
    ("files", "names"),
    [
        ({}, ()),
        ({"code/@car/README.md": "b", "code/@car/.gitignore": None, "code/@car/LICENSE": "a"}, ()),
        ({"code/@car/docs/notes.md": "a"}, ()),  # new, and no trial imports it
        ({"code/@car/planner/agents.py": "b"}, ("planner/agents.py",)),
        ({"code/@car/planner/data.csv": "b"}, ("planner/data.csv",)),
        ({"code/@car/planner/data.csv": None}, ("planner/data.csv (removed)",)),
        ({"code/@car/numpy.py": "a"}, ("numpy.py (new)",)),
        ({"code/@car/lib.so": "a"}, ("lib.so (new)",)),
        ({"code/alone.py": "b"}, ("alone.py",)),
        ({"files/0-weights.zip": "b"}, ("models/weights.zip",)),
        ({"scenario/town.net.xml": "b"}, ("scenario/town.net.xml",)),
        ({"scenario/more.rou.xml": "a"}, ("scenario/more.rou.xml (new)",)),
        ({"code/crashhunt/__init__.py": "b"}, ("crashhunt itself (1 file)",)),
        (
            {"code/crashhunt/__init__.py": "b", "code/crashhunt/trial/_space.py": "b", "code/alone.py": "c"},
            ("alone.py", "crashhunt itself (2 files)"),
        ),
    ],
    ids=str,
)
def test_changed_files_are_those_that_a_trial_may_read(files, names):
    assert changed(files) == names


def test_new_files_that_no_trial_imports_are_named_apart():
    found = code_changes(snapshot(), snapshot({"code/@car/film.mp4": "a", "code/@car/README.rst": "a"}))
    assert (found.changed, found.added) == ((), ("film.mp4",))


def test_project_at_another_place_is_the_same_code():
    moved = {"code/@car/planner/agents.py": None, "code/@tree-2/planner/agents.py": "a"}
    moved |= {"code/@car/planner/data.csv": None, "code/@tree-2/planner/data.csv": "a"}
    assert changed(moved) == ()
    assert changed(moved | {"code/@tree-2/planner/agents.py": "b"}) == ("planner/agents.py",)


def test_file_of_an_argument_is_named_once_if_its_project_has_it_too():
    then = snapshot({"code/@car/weights.zip": "a"})
    now = snapshot({"code/@car/weights.zip": "b", "files/0-weights.zip": "b"})
    assert code_changes(then, now).changed == ("models/weights.zip",)


def test_versions_of_loaded_libraries_are_conditions():
    newer = ENVIRONMENT["distributions"] | {"numpy": "2.2.0", "scipy": "2.0", "crashhunt": "2", "later": "1"}
    assert changed(distributions=newer) == ("numpy 2.1.0 (now 2.2.0)",)
    assert changed(distributions={}) == (*changed(distributions={"numpy": "not installed", "own": "not installed"}),)
    assert changed(python="3.13.0", machine="") == ("python 3.12.1 (now 3.13.0)",)


def test_code_that_is_not_copied_is_compared_by_its_digests():
    described = {"code/@car/planner/agents.py": "a", "files/0-net.bin": "a", "numpy": "2.1.0"}
    then = snapshot(dict.fromkeys(FILES), conditions=described, arguments=(), paths=())
    now = snapshot(dict.fromkeys(FILES), conditions=described | {"files/0-net.bin": "b"}, arguments=(), paths=())
    assert code_changes(then, then).changed == ()
    assert code_changes(then, now).changed == ("files/0-net.bin",)
    assert [text.partition(",")[0] for text in code_changes(then, snapshot()).changed] != []
    unknown = snapshot(dict.fromkeys(FILES), arguments=(), paths=())
    assert code_changes(unknown, snapshot()).changed == ("the code, which the earlier snapshot lacks",)
    assert code_changes(snapshot(), unknown).changed == ("the code, which this snapshot lacks",)


def test_conditions_belong_to_the_digest_of_a_snapshot(tmp_path):
    manifest = {"paths": ["code"], "argument_files": {}, "files": {"code/a.py": {"size": 1, "blake2b": "a"}}}
    plain = digest_of_manifest(manifest)
    assert digest_of_manifest(manifest | {"conditions": {}}) == plain
    assert digest_of_manifest(manifest | {"conditions": {"numpy": "2.2.0"}}) != plain
    assert Snapshot(tmp_path / plain).digest == plain
