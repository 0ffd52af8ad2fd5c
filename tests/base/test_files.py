"""Files that are written as a whole: what cannot be written is one error, with the file and the fix."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from crashhunt.base.files import whole_file
from crashhunt.errors import HuntDirectoryError


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("a" * 300, "cannot be written: File name too long"),
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
