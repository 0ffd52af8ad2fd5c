"""Builds of commits: what ends them, what they report, and that a snapshot contains what they make."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import wait_for

import crashhunt.base.git
from crashhunt.base.git import BuildError, clean_tree, copy_built, files_outside, run_build, track_built
from crashhunt.snapshots import _take


def build(command, folder, log=None, limit_s=math.inf, **more):
    run_build(command, folder, log, limit_s=limit_s, name="HEAD (abc)", **more)


@pytest.fixture(autouse=True)
def temporary(tmp_path, monkeypatch):
    """The folder for temporary files."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    return folder


def test_failed_build_is_one_line_with_the_end_of_its_output_and_keeps_its_log(tmp_path, temporary):
    build("echo fine > made", tmp_path)
    assert (tmp_path / "made").read_text() == "fine\n"
    assert not list(temporary.iterdir())
    with pytest.raises(BuildError) as caught:
        build("echo one; echo; echo two \\ 2 >&2; echo three; echo four; exit 3", tmp_path)
    (log,) = temporary.iterdir()
    assert str(caught.value).startswith("HEAD (abc): --build 'echo one; echo;")
    assert str(caught.value).endswith(f" exited with 3: two 2 | three | four; {log} has its whole output")
    assert log.read_text() == "one\n\ntwo  2\nthree\nfour\n"
    with pytest.raises(BuildError, match=r"was killed by SIGKILL: no output; .*kept\.log has"):
        build("kill -9 $$", tmp_path, tmp_path / "kept.log")
    printed = "warning: y|a.c:9:2: error: expected ';'|  9 - x|error[E0425]: no x|make: *** [all] Error 1"
    (tmp_path / "printed").write_text(printed.replace("|", "\n"))
    with pytest.raises(BuildError, match=r"with 1: a\.c:9:2: error: expected ';' \| error\[E0425\]: no x; "):
        build("cat printed; exit 1", tmp_path)


def test_long_build_is_announced_once(tmp_path, monkeypatch):
    said = []
    build("true", tmp_path, tell=said.append)
    assert said == []
    monkeypatch.setattr(crashhunt.base.git, "_QUIET_S", 0.0)
    build("sleep 0.2", tmp_path, tell=said.append)
    assert said == ["building HEAD (abc): sleep 0.2"]


def is_running(pid):
    try:
        return bool(Path(f"/proc/{pid}/cmdline").read_bytes())  # which a zombie has empty
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.parametrize("why", ["too long", "interrupted"])
def test_build_that_is_ended_leaves_no_process(tmp_path, temporary, monkeypatch, why):
    wait = subprocess.Popen.wait

    def interrupted(process, timeout=None):
        monkeypatch.setattr(subprocess.Popen, "wait", wait)
        wait_for((tmp_path / "second").exists)
        if why == "interrupted":
            raise KeyboardInterrupt
        raise subprocess.TimeoutExpired("sleep", timeout)

    monkeypatch.setattr(crashhunt.base.git, "_QUIET_S", 9.0)
    monkeypatch.setattr(subprocess.Popen, "wait", interrupted)
    error = KeyboardInterrupt if why == "interrupted" else BuildError
    with pytest.raises(error, match="^$" if why == "interrupted" else "still ran after 9 s: begun"):
        build("echo begun; sleep 600 & echo $! > first; mv first second; wait", tmp_path, limit_s=9)
    wait_for(lambda: not is_running((tmp_path / "second").read_text().strip()))
    assert bool(list(temporary.iterdir())) == (why == "too long")


def test_processes_of_a_build_end_with_a_crashhunt_that_is_killed(tmp_path):
    code = "from crashhunt.base.git import run_build as run; from pathlib import Path; run({!r}, Path(), None, {})"
    words = code.format("sleep 600 & echo $! > first; mv first second; wait; true", "limit_s=600.0, name='HEAD'")
    builder = subprocess.Popen([sys.executable, "-c", words], cwd=tmp_path)
    wait_for((tmp_path / "second").exists)
    builder.kill()
    builder.wait()
    wait_for(lambda: not is_running((tmp_path / "second").read_text().strip()))


def git(folder, *words):
    subprocess.run(["git", *words], cwd=folder, check=True, capture_output=True)


@pytest.fixture
def tree(tmp_path):
    """A work tree with a program that git ignores."""
    top = tmp_path / "top"
    top.mkdir()
    git(top, "init", "-q")
    (top / ".gitignore").write_text("out/\n*.so\n")
    (top / "main.cpp").write_text("int main() {}\n")
    git(top, "add", ".")
    git(top, "-c", "user.name=a", "-c", "user.email=a@b", "commit", "-qm", "first")
    build("mkdir out; echo x > out/planner; chmod +x out/planner; ln -s out/planner run; echo y > main.cpp", top)
    return top


def test_snapshot_contains_the_ignored_files_that_a_build_has_made(tree):
    assert "out/planner" not in list(_take._listed(tree))
    track_built(tree)
    assert {"out/planner", "run", "main.cpp", ".gitignore"} == {*_take._listed(tree)}
    clean_tree(tree)
    assert (tree / "main.cpp").read_text() == "int main() {}\n"
    assert not (tree / "out").exists()
    assert not (tree / "run").is_symlink()


def test_built_and_changed_files_are_copied_with_their_modes(tree, tmp_path):
    copy_built(tree, tmp_path / "built")
    assert {path.relative_to(tmp_path / "built").as_posix() for path in (tmp_path / "built").rglob("*")} == {
        "out", "out/planner", "run", "main.cpp",
    }  # fmt: skip
    assert os.access(tmp_path / "built/out/planner", os.X_OK)
    assert (tmp_path / "built/run").is_symlink()


def test_files_that_several_folders_share_lie_outside_of_them(tmp_path):
    for side in ("base", "head"):
        (tmp_path / side).mkdir()
        (tmp_path / side / "planner").touch()
    (tmp_path / "planner").touch()
    values = ["planner", str(tmp_path / "planner"), "../planner", "fast", "", str(tmp_path), "x\0"]
    found = list(files_outside(values, (tmp_path / "base", tmp_path / "head")))
    assert found == [str(tmp_path / "planner")] * 2
