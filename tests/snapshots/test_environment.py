"""What is written down of an installation is what Python's own, slower, reader of it says."""

from __future__ import annotations

import sys
from importlib import import_module, metadata

from crashhunt.snapshots import environment, environment_changes, versions


def test_distributions_and_those_that_are_loaded_are_what_importlib_states():
    import_module("numpy")  # which other tests have imported, where there are any
    found = environment()
    assert found["distributions"] == {
        distribution.metadata["Name"]: distribution.version for distribution in metadata.distributions()
    }
    owners = metadata.packages_distributions()
    imported = {owner for name in list(sys.modules) for owner in owners.get(name, ())}
    assert {"pytest", "numpy"} <= imported
    # Since Python 3.13, packages_distributions() also has distributions of data only.
    imported = {owner for owner in imported if any(file.suffix == ".py" for file in metadata.files(owner) or ())}
    assert set(found["loaded"]) == imported | found["versions"].keys() - {"python"}
    for name in ("crashhunt", "numpy", "libsumo"):
        assert versions()[name] == found["distributions"][name] == metadata.version(name)


def test_another_version_than_it_was_is_reported():
    then = environment()
    assert environment_changes(then) == {}
    then["distributions"]["numpy"] = "1.0"
    then["loaded"].append("gone-by-now")
    then["distributions"]["gone-by-now"] = "2.0"
    assert environment_changes(then) == {
        "numpy": ("1.0", metadata.version("numpy")), "gone-by-now": ("2.0", "not installed"),
    }  # fmt: skip
