from __future__ import annotations

import json
import subprocess
import sys

import pytest

from crashhunt.base import sandbox
from crashhunt.base.sandbox import confine, landlock_version

TRIES = """
import json, os, signal, socket, subprocess, sys
from pathlib import Path
from crashhunt.base.sandbox import confine
own, other, given = map(Path, sys.argv[1:])
os.chdir(other)
told = confine(own, [given])
def child():
    assert subprocess.run([sys.executable, "-c", f"open({str(other / 'x')!r}, 'w')"], stderr=-3).returncode == 0
tries = {
    "write own": lambda: (own / "a").write_text("a"),
    "make folder": lambda: (own / "b").mkdir(),
    "write nowhere": lambda: Path("/dev/null").write_text("a"),
    "read given": lambda: (given / "it").read_text(),
    "import": lambda: __import__("numpy"),
    "write other": lambda: (other / "it").write_text("a"),
    "write given": lambda: (given / "it").write_text("a"),
    "cut off": lambda: os.truncate(other / "it", 0),
    "remove": lambda: (other / "it").unlink(),
    "move": lambda: (other / "it").rename(own / "it"),
    "move out": lambda: (own / "a").rename(other / "a"),
    "link": lambda: (other / "l").symlink_to("/"),
    "read other": lambda: (other / "it").read_text(),
    "list other": lambda: os.listdir(other),
    "read a secret": lambda: Path("/etc/passwd").read_text(),
    "a child": child,
}
def works(what):
    try:
        what()
    except (OSError, AssertionError):
        return False
    return True
print(json.dumps([told, {name: works(what) for name, what in tries.items()}]))
"""
ALLOWED = {"write own", "make folder", "write nowhere", "read given", "import"}


@pytest.mark.skipif(not landlock_version(), reason="this kernel has no Landlock")
def test_only_its_own_folder(tmp_path):
    folders = [tmp_path / name for name in ("own", "other", "given")]
    for folder in folders:
        folder.mkdir()
        (folder / "it").write_text("mine")
    command = [sys.executable, "-P", "-c", TRIES, *map(str, folders)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    told, works = json.loads(done.stdout)
    assert told
    assert {name for name, could in works.items() if could} == ALLOWED
    assert (tmp_path / "other" / "it").read_text() == "mine"


def test_without_landlock_nothing_changes(tmp_path, monkeypatch):
    monkeypatch.setattr(sandbox, "landlock_version", lambda: 0)
    assert not confine(tmp_path)
    (tmp_path.parent / "still").touch()


@pytest.mark.parametrize(("version", "rights"), [(1, 13), (2, 14), (3, 15), (4, 15), (5, 16), (9, 16)])
def test_an_older_kernel_is_asked_for_what_it_knows(version, rights):
    assert sandbox._newest(sandbox._FILE_RIGHTS_BY_VERSION, version).bit_length() == rights
    assert bool(sandbox._newest(sandbox._PORT_RIGHTS_BY_VERSION, version)) == (version >= 4)
    assert bool(sandbox._newest(sandbox._SCOPES_BY_VERSION, version)) == (version >= 6)
