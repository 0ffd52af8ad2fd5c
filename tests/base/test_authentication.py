"""The key of a user: kept for this user alone, found again by every process, and never a key that others can guess."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from crashhunt.base.integrity import authentication_code, is_authentic, state_folders, user_key

STATEMENT = {"digest": "x", "arguments": {"ego": {"speed": 1.0}}}


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    return tmp_path / "state" / "crashhunt"


def test_code_is_for_one_purpose_one_statement_and_one_key(monkeypatch, tmp_path):
    code = authentication_code("bundle", STATEMENT)
    assert is_authentic("bundle", dict(reversed(STATEMENT.items())), code)
    assert not is_authentic("snapshot", STATEMENT, code)
    assert not is_authentic("bundle", {**STATEMENT, "digest": "y"}, code)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "of another user"))
    assert not is_authentic("bundle", STATEMENT, code)


@pytest.mark.parametrize("code", ["", None, 7, "ä" * 64, "0" * 64])
def test_what_is_no_code_proves_nothing(code):
    assert not is_authentic("bundle", STATEMENT, code)


def test_key_is_made_once_for_this_user_alone(home):
    words = [sys.executable, "-c", "from crashhunt.base.integrity import user_key; print(user_key().hex())"]
    at_once = [subprocess.Popen(words, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    keys = {process.communicate()[0].strip() for process in at_once}
    assert keys == {user_key().hex()}
    assert len(user_key()) == 32
    assert stat.S_IMODE((home / "archive-key").stat().st_mode) == 0o600
    assert [path.name for path in home.iterdir()] == ["archive-key"]


@pytest.mark.parametrize("cut", [b"", b"x", b"x" * 31])
def test_key_that_is_cut_off_is_replaced(home, cut):
    home.mkdir(parents=True)
    (home / "archive-key").write_bytes(cut)
    assert len(user_key()) == 32
    assert user_key() == (home / "archive-key").read_bytes()


def test_relative_state_folder_is_ignored(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_STATE_HOME", "state")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert next(state_folders()) == tmp_path / "home" / ".local" / "state" / "crashhunt"


def test_user_without_a_writable_home_has_a_private_folder(home, tmp_path):
    home.parent.write_text("a file where the folder should be")
    key = user_key()
    assert key == user_key()
    (kept,) = (tmp_path / "temporary").rglob("archive-key")
    assert kept.read_bytes() == key
    assert stat.S_IMODE(kept.parent.stat().st_mode) == 0o700


@pytest.mark.parametrize("planted", ["readable", "link", "file"])
def test_temporary_folder_that_others_may_have_made_keeps_no_key(home, tmp_path, planted):
    home.parent.write_text("a file where the folder should be")
    place = tmp_path / "temporary" / f"crashhunt-{os.geteuid()}"
    theirs = tmp_path / "theirs"
    theirs.mkdir(mode=0o700)
    if planted == "readable":
        place.mkdir()
        place.chmod(0o755)
    elif planted == "link":
        place.symlink_to(theirs)
    else:
        place.touch()
    key = user_key()
    assert key == user_key()  # of this process
    assert not [path for path in tmp_path.rglob("archive-key") if path.is_file()]
    assert [Path(folder) for folder in state_folders()] == [home]
