"""What a hunt keeps of the code that it ran, with real git work trees."""

from __future__ import annotations

import json
import os
import shutil

import numpy as np
import pytest
from repositories import git, make_repository

AGENT = """
from pathlib import Path

import numpy as np

from planner import tuning
from planner.linked import OFFSET

class Planner:
    def __init__(self, weights: str = "", mode: str = "a"):
        self.table = np.load(weights)["speeds"] if weights else np.full(100, 8.0)
        self.data = float((Path(__file__).parent / "data.txt").read_text())

    def reset(self, seed):
        self.step = 0

    def act(self, observation):
        self.step += 1
        if self.step == tuning.LAST:
            raise ValueError("out of ideas")
        return float(self.table[self.step]) + self.data + OFFSET, 0
"""
RUN = ("run", "../out", "1", "1", "80", "--agent", "planner.agents:Planner", "--scenario", "../toy", "--seed", "1")


@pytest.fixture
def project(toy):
    """A git work tree: src layout, a dirty file, an untracked one, an ignored one, links, an old hunt."""
    tree = toy.folder / "my project"
    package = tree / "src" / "planner"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "agents.py").write_text(AGENT)
    (package / "tuning.py").write_text("LAST = 1000\n")
    (package / "data.txt").write_text("0.5")
    (package / "deleted.py").write_text("")
    (package / "real.py").write_text("OFFSET = 0.25\n")
    (package / "linked.py").symlink_to("real.py")
    (tree / "outside").symlink_to("/etc")
    (tree / ".gitignore").write_text("*.secret\nbuild/\n")
    make_repository(tree)
    (package / "tuning.py").write_text("LAST = 20\n")  # dirty
    (package / "untracked.py").write_text("")
    (package / "deleted.py").unlink()
    (tree / "token.secret").write_text("s3cr3t")
    (tree / "build").mkdir()
    (tree / "build" / "big.bin").write_bytes(bytes(1000))
    os.mkfifo(tree / "pipe")
    toy.environment["PYTHONPATH"] = str(tree / "src")
    toy.folder = tree
    return toy


def snapshots(shell) -> list:
    return sorted((shell.folder.parent / "out" / "snapshots").iterdir(), key=lambda path: path.stat().st_mtime_ns)


@pytest.mark.nightly  # by day, snapshots/test_projects.py
def test_the_whole_work_tree_is_kept_and_nothing_else(project):
    before = (project.folder / ".git" / "index").read_bytes()
    status = git(project.folder, "status", "--porcelain")
    project.crashhunt(*RUN)
    assert (project.folder / ".git" / "index").read_bytes() == before
    after = git(project.folder, "status", "--porcelain").splitlines()
    assert [line for line in after if "__pycache__" not in line] == status.splitlines()
    (snapshot,) = snapshots(project)
    kept = {
        path.relative_to(snapshot / "code").as_posix()
        for path in (snapshot / "code").rglob("*")
        if path.is_file() and "crashhunt" not in path.parts and "__pycache__" not in path.parts
    }
    assert kept == {
        f"@my project/{name}"
        for name in (
            ".gitignore",
            *(f"src/planner/{name}.py" for name in ("__init__", "agents", "tuning", "real", "linked", "untracked")),
            "src/planner/data.txt",
        )
    }
    assert not any(path.is_symlink() for path in snapshot.rglob("*"))
    manifest = json.loads((snapshot / "manifest.json").read_text())
    assert manifest["paths"][:2] == ["code", "code/@my project/src"]
    assert any("outside" in line for line in manifest["left_out"])
    entry = manifest["files"]["code/@my project/src/planner/tuning.py"]
    assert entry["size"] == len("LAST = 20\n")
    diff = (snapshot / "git.diff").read_text()
    assert "+LAST = 20" in diff
    environment = json.loads((snapshot / "environment.json").read_text())
    assert environment["git"] == {str(project.folder): git(project.folder, "rev-parse", "HEAD").strip()}
    assert {"libsumo", "numpy"} <= set(environment["distributions"])
    assert environment["python"]


def test_a_crash_replays_when_the_project_is_gone(project):
    project.crashhunt(*RUN)
    shutil.rmtree(project.folder)
    project.folder = project.folder.parent
    del project.environment["PYTHONPATH"]
    shutil.copytree(project.folder / "out", project.folder / "elsewhere")
    shutil.rmtree(project.folder / "out")
    assert project.crashhunt("replay", "elsewhere", "--json").json["verdict"] == "reproduced"


@pytest.mark.nightly  # by day, snapshots/test_projects.py
def test_files_that_arguments_name_are_kept(project):
    folder = project.folder.parent
    weights = folder / "policy ä.npz"
    generator = np.random.default_rng(0)
    np.savez(weights, speeds=generator.uniform(5, 9, 100), padding=generator.bytes(20_000_000))
    project.crashhunt(*RUN, "--arg", f"weights={weights}")
    weights.unlink()
    assert project.crashhunt("replay", "../out", "--json").json["verdict"] == "reproduced"
    (snapshot,) = snapshots(project)
    (kept,) = (snapshot / "files").iterdir()
    kept.write_bytes(kept.read_bytes()[:-1] + b"x")
    refused = project.crashhunt("replay", "../out", expect=2)
    assert "policy ä.npz has changed" in refused.err


@pytest.mark.nightly  # by day, snapshots/test_projects.py
def test_what_python_and_others_generate_is_not_code(project):
    """Nothing of it is ignored there; Python writes its caches again whenever it likes."""
    for name in ("src/planner/__pycache__/tuning.cpython-311.pyc", ".venv/lib/huge.py"):
        (project.folder / name).parent.mkdir(parents=True)
        (project.folder / name).write_bytes(b"generated")
    git(project.folder, "add", "--force", "src/planner/__pycache__")
    project.crashhunt(*RUN)
    (snapshot,) = snapshots(project)
    kept = json.loads((snapshot / "manifest.json").read_text())["files"]
    assert not any("__pycache__" in name or ".venv" in name for name in kept)
    assert project.crashhunt("replay", "../out", "--json").json["verdict"] == "reproduced"


@pytest.mark.nightly  # by day, snapshots/test_projects.py, and test_replay.py forces a replay
def test_a_missing_file_is_named_and_a_new_module_too(project):
    project.crashhunt(*RUN)
    (snapshot,) = snapshots(project)
    package = snapshot / "code" / "@my project" / "src" / "planner"
    (package / "cache.json").write_text("{}")  # an agent may write beside itself
    project.crashhunt("replay", "../out")
    (package / "numpy.py").write_text("")
    assert "numpy.py was not there" in project.crashhunt("replay", "../out", expect=2).err
    (package / "numpy.py").unlink()
    (package / "untracked.py").unlink()
    assert "untracked.py is missing" in project.crashhunt("replay", "../out", expect=2).err
    warned = project.crashhunt("replay", "../out", "--force", "--trust")
    assert "untracked.py is missing" in warned.out
    (snapshot / "manifest.json").write_text("[]")
    assert "manifest" in project.crashhunt("replay", "../out", expect=2).err
    shutil.rmtree(snapshot)
    assert "manifest" in project.crashhunt("replay", "../out", expect=2).err


@pytest.mark.nightly  # by day, snapshots/test_projects.py
def test_the_same_code_is_stored_once_and_changed_code_again(project):
    words = [*RUN, "--keep-going"]
    project.crashhunt(*words)
    project.crashhunt(*words)
    assert len(snapshots(project)) == 1
    (project.folder / "src" / "planner" / "tuning.py").write_text("LAST = 25\n")
    words[3] = "2"
    crashes = project.crashhunt(*words, "--json").json["crashes"]
    first, second = snapshots(project)
    named = {
        crash["trial"]: json.loads((project.folder / crash["path"] / "crash.json").read_text())["snapshot"]
        for crash in crashes
    }
    assert named == {0: first.name, 1: second.name}
    for crash in crashes:
        done = project.crashhunt("replay", "../out", "--crash", crash["id"], "--json").json
        assert (done["verdict"], done["steps_replayed"]) == ("reproduced", 24 if crash["trial"] == 1 else 19)


@pytest.mark.nightly  # by day, snapshots/test_projects.py
def test_a_snapshot_has_a_limit(project):
    big = project.folder / "recording.bin"
    big.write_bytes(bytes(3_000_000))
    refused = project.crashhunt(*RUN, "--snapshot-limit", "2", expect=2)
    assert "recording.bin (3 MB)" in refused.err
    assert "--no-snapshot" in refused.err
    assert len(refused.err.strip().splitlines()) == 1
    project.crashhunt(*RUN, "--snapshot-limit", "10")


@pytest.mark.nightly  # by day, snapshots/test_projects.py and replays/test_prepare.py
def test_without_a_snapshot_todays_code_is_replayed(project):
    project.crashhunt(*RUN, "--no-snapshot")
    (snapshot,) = snapshots(project)
    assert not (snapshot / "code").exists()
    done = project.crashhunt("replay", "../out", "--json")
    assert (done.json["verdict"], done.json["code"]) == ("reproduced", "current")
    assert "--no-snapshot" in done.json["warnings"][0]


@pytest.mark.nightly  # by day, snapshots/test_projects.py
def test_more_can_be_taken_in(project):
    extra = project.folder.parent / "extra"
    extra.mkdir()
    (extra / "notes.txt").write_text("read me")
    single = project.folder.parent / "single.txt"
    single.write_text("1")
    project.crashhunt(*RUN, "--snapshot-root", "../extra", "--snapshot-root", "../single.txt")
    (snapshot,) = snapshots(project)
    assert (snapshot / "code" / "@extra" / "notes.txt").read_text() == "read me"
    assert list((snapshot / "code").glob("@*/single.txt"))
    refused = project.crashhunt(*RUN, "--overwrite", "--snapshot-root", "../gone", expect=2)
    assert "'../gone' does not exist" in refused.err


@pytest.mark.nightly  # by day, snapshots/test_projects.py
def test_hunts_inside_the_work_tree_are_excluded(project):
    words = list(RUN)
    for name in ("hunts/first", "second"):
        (project.folder / "hunts").mkdir(exist_ok=True)
        words[1] = name
        project.crashhunt(*words)
    for name in ("hunts/first", "second"):
        (snapshot,) = (project.folder / name / "snapshots").iterdir()
        assert not list(snapshot.rglob("ledger.sqlite"))
        assert not list(snapshot.rglob("log.mcap"))


@pytest.mark.nightly  # by day, snapshots/test_projects.py
def test_a_submodule_comes_along(project):
    other = project.folder.parent / "library"
    other.mkdir()
    (other / "inside.py").write_text("VALUE = 1\n")
    make_repository(other)
    git(project.folder, "-c", "protocol.file.allow=always", "submodule", "add", "-q", str(other), "libs/library")
    project.crashhunt(*RUN)
    (snapshot,) = snapshots(project)
    assert (snapshot / "code" / "@my project" / "libs" / "library" / "inside.py").is_file()


@pytest.mark.nightly
def test_a_large_work_tree_is_kept_whole(project):
    for number in range(3000):
        folder = project.folder / "many" / str(number % 50)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{number}.txt").write_text(str(number))
    project.crashhunt(*RUN)
    (snapshot,) = snapshots(project)
    assert len(list((snapshot / "code" / "@my project" / "many").rglob("*.txt"))) == 3000


def test_replay_of_todays_code_names_the_files_that_differ(toy):
    def differences(*words):
        return toy.crashhunt("replay", "h", "--code", "current", "--json", *words, expect=None).json["code_differences"]

    (toy.folder / "driver.py").write_text(
        "import helper\nclass Agent:\n    def reset(self, seed): pass\n    def act(self, observation): 1 / 0\n"
    )
    for name in ("helper.py", "weights.txt"):
        (toy.folder / name).write_text("")
    (toy.folder / ".gitignore").write_text("*.txt\n")
    make_repository(toy.folder)
    words = ("--scenario", "toy", "--agent", "driver:Agent", "--snapshot-root", "weights.txt")
    toy.crashhunt("run", "h", "1", "1", "9", *words)
    assert differences() == []
    done = toy.crashhunt("replay", "h", "--code", "current")
    assert "no file of the code differs from the snapshot" in done.out
    (toy.folder / "helper.py").write_text("# another one\n")
    (toy.folder / "weights.txt").unlink()
    (toy.folder / "added.py").write_text("")
    assert differences() == ["added.py is new", "helper.py has changed", "weights.txt is missing"]
    assert toy.crashhunt("replay", "h", "--json").json["code_differences"] is None
    shutil.copytree(toy.folder, toy.folder / "elsewhere", ignore=shutil.ignore_patterns("h", "elsewhere", ".git"))
    toy.folder = toy.folder / "elsewhere"  # the modules of the current folder run, wherever the hunt was
    (toy.folder / "helper.py").write_text("")
    (toy.folder / "h").symlink_to(toy.folder.parent / "h")
    assert differences() == ["added.py is new", "weights.txt is missing"]
