"""Files that a trial needs and that its snapshot lacks: they are named with the reason and the fix."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest
from repositories import make_repository

from crashhunt.snapshots import describe_missing, describe_unsaved, with_original_paths


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A project with an ignored library, and its snapshot."""
    tree, copy = tmp_path / "my project", tmp_path / "out" / "snapshots" / "0123"
    for folder in (tree / "build", copy / "code" / "@my project"):
        folder.mkdir(parents=True)
    for name in ("agent.py", "build/libplanner.so", "weights: 1.npz"):
        (tree / name).write_text("")
    (tree / ".gitignore").write_text("build/\n*.npz\n")
    (copy / "code" / "@my project" / "agent.py").write_text("")
    make_repository(tree)
    monkeypatch.chdir(tree)
    snapshot = SimpleNamespace(
        path=copy, environment={"origins": [["code/@my project", str(tree)]]}, argument_files={"a.npz": "x"},
        manifest={"files": {"code/@my project/agent.py": {}}},
    )  # fmt: skip
    return SimpleNamespace(tree=tree, copy=copy / "code" / "@my project", snapshot=snapshot, folder=tmp_path)


@pytest.mark.parametrize("name", ["build/libplanner.so", "weights: 1.npz"])
@pytest.mark.parametrize("text", ["{}: cannot open shared object file", "[Errno 2] No such file: '{}'", "{}"])
def test_error_about_a_file_that_git_ignores_names_the_fix(project, name, text):
    said = describe_missing(text.format(project.copy / name), project.snapshot)
    quoted = f"'{name}'" if " " in name else name
    assert said == f"{name} is ignored by git, so the snapshot lacks it; add --snapshot-root {quoted}"
    assert with_original_paths(text.format(project.copy / name), project.snapshot) == text.format(name)


@pytest.mark.parametrize("name", ["agent.py", "nowhere.npz", "build/", "../../../../build/libplanner.so"])
def test_other_errors_are_not_explained(project, name):
    assert describe_missing(f"{project.copy}/{name}: no such file", project.snapshot) == ""


def test_files_of_the_user_are_named_and_those_of_others_are_not(project):
    outside = project.folder / "elsewhere.bin"
    outside.write_text("")
    installed = project.folder / "lib" / "site-packages" / "torch.so"  # pip install --target, and PYTHONPATH
    installed.parent.mkdir(parents=True)
    installed.write_text("")
    opened = [
        project.copy / "build" / "libplanner.so", project.tree / "build" / "libplanner.so", outside,
        project.copy / "agent.py", project.tree / "agent.py", project.copy / "nothing", project.folder / "nothing",
        sys.executable, os.__file__, pytest.__file__, "/etc/passwd", "/proc/self/maps", project.tree / ".git" / "HEAD",
        installed,
    ]  # fmt: skip
    said = describe_unsaved(map(str, opened), project.snapshot, since=time.time() + 9)
    assert [line.partition(",")[0] for line in said] == [
        "build/libplanner.so is ignored by git", "build/libplanner.so is ignored by git",
        f"{outside} lies outside of the agent's project",
    ]  # fmt: skip
    assert "relative to __file__" in said[1]
    assert said[2].endswith("; give its path to the agent with --arg NAME=PATH")
    assert describe_unsaved([str(outside)], project.snapshot, since=0.0) == []  # the trial itself has written it


def test_many_files_are_counted(project):
    names = [project.folder / f"{number}.png" for number in range(9)]
    for name in names:
        name.write_text("")
    said = describe_unsaved(map(str, names), project.snapshot, since=time.time() + 9)
    assert len(said) == 4
    assert said[3] == "the snapshot lacks 6 more such files"


_OPENS = """
import contextlib, ctypes, json, mmap, os, subprocess, sys
from crashhunt.base.opened_files import OpenedFiles
inherited = open("inherited")
opened = OpenedFiles()
for work in (
    lambda: open("read"), lambda: open("written", "w"), lambda: os.open("flags", os.O_RDONLY), lambda: open("missing"),
    lambda: ctypes.CDLL("./library.so"), lambda: ctypes.CDLL("libm.so.6"), lambda: subprocess.run(["./program"]),
    lambda: subprocess.run(["sh", "script"], cwd="sub"), lambda: os.system("./shell argument"),
):
    with contextlib.suppress(OSError):
        work()
kept = mmap.mmap(os.open("mapped", os.O_RDONLY), 0, prot=mmap.PROT_READ)
os.chdir("sub")
print(json.dumps(opened.paths()))
"""


def test_opened_loaded_and_started_files_are_found(tmp_path):
    (tmp_path / "sub").mkdir()
    for name in ("read", "inherited", "flags", "mapped", "program", "sub/script", "shell"):
        (tmp_path / name).write_text("exit")
    done = subprocess.run([sys.executable, "-c", _OPENS], cwd=tmp_path, capture_output=True, text=True, check=True)
    found = {os.path.relpath(path, tmp_path) for path in json.loads(done.stdout) if path.startswith(str(tmp_path))}
    assert found == {"read", "flags", "missing", "library.so", "program", "sub/script", "shell", "mapped"}
