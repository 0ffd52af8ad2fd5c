"""Files that are written as a whole: what cannot be written is one error, with the file and the fix."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from crashhunt.base.files import exchange, is_empty_folder, sync_tree, whole_file
from crashhunt.errors import HuntDirectoryError


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("a" * 300, "cannot be written: File name too long"),
        ("/", "cannot be written: Is a directory; choose another place"),
        ("missing/file", "cannot be written: No such file or directory"),
        ("pipe", "is a device or a pipe"),
        ("/dev/null", "is a device or a pipe"),
        ("/dev/crashhunt.html", "is in the folder of device files"),
    ],
)
def test_file_that_cannot_be_written_is_an_error_with_its_name(tmp_path, name, says):
    os.mkfifo(tmp_path / "pipe")
    file = tmp_path / name
    with pytest.raises(HuntDirectoryError, match=says) as raised, whole_file(file) as temporary:
        temporary.write_text("new", encoding="utf-8")
    assert raised.value.where == str(file)
    assert not Path("/dev/crashhunt.html").exists()


def test_a_tree_is_synced_whole_and_a_broken_disk_is_an_error(tmp_path, monkeypatch):
    (tmp_path / "a" / "b").mkdir(parents=True)
    for name in ("top", "a/one", "a/b/two"):
        (tmp_path / name).write_text("x")
    (tmp_path / "a" / "gone").symlink_to("nowhere")
    synced = []
    monkeypatch.setattr(os, "fsync", lambda opened: synced.append(str(Path(f"/proc/self/fd/{opened}").readlink())))
    sync_tree(tmp_path)
    assert sorted(synced) == sorted(str(tmp_path / name) for name in ("", "a", "a/b", "top", "a/one", "a/b/two"))

    def fail(opened):
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="Input/output error"):
        sync_tree(tmp_path)


def test_two_files_or_folders_change_places_at_once(tmp_path):
    (tmp_path / "one").write_text("1")
    (tmp_path / "two").mkdir()
    if exchange(tmp_path / "one", tmp_path / "two"):  # not every file system can
        assert (tmp_path / "one").is_dir()
        assert (tmp_path / "two").read_text() == "1"
    assert not exchange(tmp_path / "one", tmp_path / "gone")


def test_only_a_folder_without_anything_is_empty(tmp_path):
    assert is_empty_folder(tmp_path)
    (tmp_path / ".hidden").write_text("")
    assert not is_empty_folder(tmp_path)
    assert not is_empty_folder(tmp_path / ".hidden")
