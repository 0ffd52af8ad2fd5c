"""What is written down of an installation is what Python's own, slower, reader of it says."""

from __future__ import annotations

import sys
from importlib import import_module, metadata

import numpy as np

from crashhunt.snapshots import environment, environment_changes, versions


def test_distributions_and_those_that_are_loaded_are_what_importlib_states():
    import_module("numpy")  # which other tests have imported, where there are any
    found = environment()
    assert found["distributions"] == {
        name: metadata.version(name) for name in {one.metadata["Name"] for one in metadata.distributions()}
    }
    owners = metadata.packages_distributions()
    imported = {owner for name in list(sys.modules) for owner in owners.get(name, ())}
    assert {"pytest", "numpy"} <= imported
    # Since Python 3.13, packages_distributions() also has distributions of data only.
    imported = {owner for owner in imported if any(file.suffix == ".py" for file in metadata.files(owner) or ())}
    assert set(found["loaded"]) == imported | found["versions"].keys() - {"python"}
    for name in ("crashhunt", "numpy", "libsumo"):
        assert versions()[name] == found["distributions"][name] == metadata.version(name)


def test_vector_extension_is_the_last_one_that_numpy_has_found():
    found = np.show_config(mode="dicts")["SIMD Extensions"]["found"]
    assert [environment()["simd"]] == (found[-1:] or [""])


def test_of_two_versions_the_one_that_is_imported_is_recorded(tmp_path, monkeypatch):
    (tmp_path / "numpy-99.0.dist-info").mkdir()
    (tmp_path / "numpy-99.0.dist-info/METADATA").write_text("Metadata-Version: 2.1\nName: numpy\nVersion: 99.0\n")
    recorded = environment()
    monkeypatch.syspath_prepend(tmp_path)
    found = environment()
    assert found["distributions"]["numpy"] == found["versions"]["numpy"] == metadata.version("numpy") == "99.0"
    assert environment_changes(found) == {}
    assert environment_changes(recorded) == {"numpy": (recorded["distributions"]["numpy"], "99.0")}
    monkeypatch.setattr(sys, "path", [*sys.path[1:], sys.path[0]])
    assert environment() == recorded


def test_another_version_than_it_was_is_reported():
    then = environment()
    assert environment_changes(then) == {}
    then["distributions"]["numpy"] = "1.0"
    then["loaded"].append("gone-by-now")
    then["distributions"]["gone-by-now"] = "2.0"
    assert environment_changes(then) == {
        "numpy": ("1.0", metadata.version("numpy")), "gone-by-now": ("2.0", "not installed"),
    }  # fmt: skip
