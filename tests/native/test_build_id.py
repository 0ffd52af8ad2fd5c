"""Compiled modules are compared with the C++ sources of the checkout."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from crashhunt.native import _build_id


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A package whose compiled core was built from its sources."""
    for folder, text in (("native", "int a;"), ("accelerator", "int b;")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "part.cpp").write_text(text)
    built = tmp_path / "core.so"
    built.write_bytes(b"\x7fELF" + bytes.fromhex(_build_id.build_id(tmp_path / "native")) + b"rest")
    found = {"_crashhunt_core": SimpleNamespace(origin=str(built))}
    monkeypatch.setattr(_build_id, "find_spec", found.get)
    return tmp_path


def test_module_of_these_sources_is_current(checkout):
    assert _build_id.outdated_modules(checkout) == []


@pytest.mark.parametrize(
    "change",
    [
        lambda native: (native / "part.cpp").write_text("int c;"),
        lambda native: (native / "part.cpp").rename(native / "other.cpp"),
        lambda native: (native / "part.hpp").write_text(""),
    ],
    ids=["edited", "renamed", "added"],
)
def test_module_of_other_sources_is_outdated(checkout, change):
    change(checkout / "native")
    assert _build_id.outdated_modules(checkout) == ["_crashhunt_core"]


def test_header_of_another_folder_is_a_source_of_those_that_include_it(checkout):
    before = _build_id.build_id(checkout / "accelerator")
    (checkout / "accelerator" / "part.cpp").write_text('#include "../native/part.hpp"')
    digests = []
    for text in ("int c;", "int d;"):
        (checkout / "native" / "part.hpp").write_text(text)
        digests.append(_build_id.build_id(checkout / "accelerator"))
    assert len({before, *digests}) == 3


def test_python_file_changes_no_build_id(checkout):
    (checkout / "native" / "part.py").write_text("x = 1")
    assert _build_id.outdated_modules(checkout) == []


def test_package_without_sources_has_no_outdated_modules(checkout):
    """A snapshot of the code runs with the modules that are installed."""
    (checkout / "native" / "part.cpp").unlink()
    assert _build_id.outdated_modules(checkout) == []


def test_modules_of_this_environment_are_current():
    assert _build_id.outdated_modules() == []
