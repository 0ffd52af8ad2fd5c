"""Types of JSON data, and whether files are as they were described."""

from __future__ import annotations

import os
import resource
import socket

import pytest

from crashhunt.base.integrity import (
    changed_file,
    describe_files,
    digest_of_content,
    digest_of_data,
    digest_of_file,
    read_bounded,
    read_object,
    too_large,
    typed,
)

FITS = [
    (3, int), (3, float), (3.5, float), ("x", str), (True, bool), (None, int | None), (4, int | None),
    ([], list[int]), ([1, 2], list[int]), ({}, dict[str, int]), ({"a": 1}, dict[str, int]),
    ({"a": {"b": "c"}}, dict[str, dict[str, int | str]]),
]  # fmt: skip
FAILS = [
    (True, int), (True, float), (3.5, int), (1 << 63, int), ("3", int), (3, str), ("x", int | None),
    ([1, "2"], list[int]), (["2", 1], list[int]), ("ab", list[str]), ({"a": 1}, list[int]), ([1], dict[str, int]),
    ({"a": 1, "b": "c"}, dict[str, int]), ({"a": {"b": None}}, dict[str, dict[str, int | str]]),
]  # fmt: skip


@pytest.mark.parametrize(("value", "kind"), FITS)
def test_a_value_of_its_type_is_accepted(value, kind):
    typed({"key": value, "other": object()}, {"key": kind})


@pytest.mark.parametrize(("value", "kind"), FAILS)
def test_a_value_of_another_type_is_named_with_its_key(value, kind):
    with pytest.raises(ValueError, match=r"key is .*, not ") as caught:
        typed({"key": value}, {"key": kind})
    assert "\n" not in str(caught.value)


def test_a_key_that_is_missing_is_named():
    with pytest.raises(ValueError, match="'other' is missing"):
        typed({"key": 1}, {"key": int, "other": int})


def test_files_are_described_with_those_in_folders_and_any_change_is_seen(tmp_path):
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "a" / "b" / "inner").write_bytes(b"12345")
    (tmp_path / "top").write_bytes(b"")
    found = describe_files(tmp_path / "a" / "b")
    entry = found["inner"]
    assert entry["size"] == 5
    assert entry["blake2b"] == digest_of_file(tmp_path / "a" / "b" / "inner") == digest_of_content(b"12345")
    file = tmp_path / "a" / "b" / "inner"
    assert not changed_file(file, entry)
    file.write_bytes(b"12346")
    assert "changed" in changed_file(file, entry)
    file.write_bytes(b"1234")
    assert changed_file(file, entry)
    file.unlink()
    assert "missing" in changed_file(file, entry)


def test_only_a_regular_file_is_the_recorded_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "file"
    file.write_bytes(b"12345")
    entry = describe_files(tmp_path)["file"]
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to(file)
    os.mkfifo(tmp_path / "pipe")
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind("socket")  # the whole path may be too long
        for name in ("folder", "link", "pipe", "socket", "file/inside", "nothing", "no\0name"):
            assert changed_file(f"{tmp_path}/{name}", entry) == "is missing", name
    assert "cannot be read" in changed_file(tmp_path / ("x" * 300), entry)
    assert changed_file(file, entry) == ""


def test_a_pipe_in_place_of_a_file_is_empty(tmp_path):
    os.mkfifo(tmp_path / "crash.json")
    assert read_bounded(tmp_path / "crash.json") == b""
    assert digest_of_file(tmp_path / "crash.json") == digest_of_content(b"")


def test_the_digest_of_data_does_not_depend_on_the_order_of_keys():
    assert digest_of_data({"a": 1, "b": [1, 2]}) == digest_of_data({"b": [1, 2], "a": 1})
    assert digest_of_data({"a": 1, "b": [1, 2]}) != digest_of_data({"a": 1, "b": [2, 1]})


@pytest.mark.parametrize(
    ("name", "limit"), [("hunt.toml", 4 << 20), ("crash.json", 16 << 20), ("params.json", 16 << 20),
                        ("manifest.json", 32 << 20), ("environment.json", 64 << 20)],
)  # fmt: skip
def test_file_of_a_hunt_that_is_too_large_is_not_read(tmp_path, name, limit):
    file = tmp_path / name
    file.write_bytes(b"{}")
    assert read_bounded(file) == b"{}"
    os.truncate(file, limit + 1)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match=rf"the file has {limit + 1:,} bytes \(allowed: {limit:,}\)"):
        read_object(file, dict)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 4096  # KB
    assert bool(too_large(name, limit + 1)) == (name != "environment.json")
    assert not too_large(name, limit)


def test_program_that_can_no_longer_run_has_changed(tmp_path):
    file = tmp_path / "planner"
    file.write_bytes(b"x")
    file.chmod(0o700)
    entry = {**describe_files(tmp_path)["planner"], "executable": 1}
    assert changed_file(file, entry) == ""
    file.chmod(0o644)
    assert changed_file(file, entry) == "is no longer executable"
