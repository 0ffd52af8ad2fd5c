"""What is kept of a user's project, a git work tree, without a hunt."""

from __future__ import annotations

import os
import shutil
import stat

import pytest
from repositories import git, make_repository

from crashhunt.base import layout
from crashhunt.base.errors import BundleError, SnapshotError
from crashhunt.base.plugins import ImportedModules
from crashhunt.plans import AgentSettings, ArgumentSpec, HuntSettings
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.snapshots import Snapshot, SnapshotOptions, _take, code_changes, take_snapshot

BASE = "code/@my project"


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A work tree: src layout, a dirty file, an untracked one, ignored ones, links, a deleted one and a pipe."""
    tree = tmp_path_factory.mktemp("projects") / "my project"
    package = tree / "src" / "planner"
    package.mkdir(parents=True)
    for name, text in {
        "__init__.py": "", "agents.py": "", "tuning.py": "LAST = 1000\n", "data.txt": "0.5", "deleted.py": "",
        "real.py": "OFFSET = 0.25\n",
    }.items():  # fmt: skip
        (package / name).write_text(text)
    (package / "linked.py").symlink_to("real.py")
    (tree / "outside").symlink_to("/etc")
    (tree / ".gitignore").write_text("*.secret\nbuild/\n")
    make_repository(tree)
    (package / "tuning.py").write_text("LAST = 20\n")
    (package / "untracked.py").write_text("")
    (package / "deleted.py").unlink()
    (tree / "token.secret").write_text("s3cr3t")
    (tree / "build").mkdir()
    (tree / "build" / "big.bin").write_bytes(bytes(1000))
    return tree


@pytest.fixture
def project(original, tmp_path):
    tree = shutil.copytree(original, tmp_path / original.name, symlinks=True)
    os.mkfifo(tree / "pipe")
    return tree


@pytest.fixture
def take(project, tmp_path):
    """Takes a snapshot of a hunt with an agent of the project, as if its process had imported nothing else."""
    package = project / "src" / "planner"
    imported = ImportedModules(
        places={"planner": (str(package / "__init__.py"), (str(package),))}, path=(str(project / "src"),),
        named=frozenset({"planner"}), agents=(str(package / "agents.py"),), variables={},
    )  # fmt: skip
    scenario = Scenario(simulator="toy", agents={"ego": AgentSetup(agent="planner.agents:Planner")})
    (tmp_path / "out").mkdir()

    def take(hunt=tmp_path / "out", weights="", **options):
        arguments = {"weights": ArgumentSpec(spec=str(weights), kind="str")}
        agents = {"ego": AgentSettings(agent="planner.agents:Planner", arguments=arguments)}
        settings = HuntSettings(scenario="toy", scenario_digest="0", trials=1, max_steps=9, seed=1, agents=agents)
        options = SnapshotOptions(**options)
        return take_snapshot(hunt / layout.SNAPSHOTS, scenario, settings, options, imported=imported)

    return take


def test_work_tree_is_kept_as_it_is_and_nothing_else(project, take):
    status = git(project, "status", "--porcelain")  # git writes the index of a copied tree again
    before = (project / ".git" / "index").read_bytes()
    snapshot = take()
    assert (project / ".git" / "index").read_bytes() == before
    assert git(project, "status", "--porcelain") == status
    kept = {path.relative_to(snapshot.path).as_posix() for path in (snapshot.path / "code").rglob("*.*")}
    assert kept == {
        f"{BASE}/{name}"
        for name in (
            ".gitignore", "src/planner/data.txt",
            *(f"src/planner/{name}.py" for name in ("__init__", "agents", "tuning", "real", "linked", "untracked")),
        )
    }  # fmt: skip
    assert not any(path.is_symlink() for path in snapshot.path.rglob("*"))
    assert snapshot.manifest["paths"] == ["code", f"{BASE}/src"]
    assert any("outside" in line for line in snapshot.manifest["left_out"])
    assert snapshot.manifest["files"][f"{BASE}/src/planner/tuning.py"]["size"] == len("LAST = 20\n")
    assert "+LAST = 20" in (snapshot.path / "git.diff").read_text()
    environment = snapshot.environment
    assert environment["git"] == {str(project): git(project, "rev-parse", "HEAD").strip()}
    assert {"libsumo", "numpy"} <= set(environment["distributions"])
    assert environment["python"]


def test_generated_files_and_hunts_are_no_code(project, take):
    names = ["src/planner/__pycache__/tuning.cpython-311.pyc", ".venv/lib/huge.py"]
    hunts = ["hunts/first", "second", "here"]
    for name in [*names, *(f"{hunt}/{file}" for hunt in hunts for file in ("hunt.toml", "ledger.sqlite", "log.mcap"))]:
        (project / name).parent.mkdir(parents=True, exist_ok=True)
        (project / name).write_bytes(b"generated")
    (project / "here" / "hunt.toml").unlink()  # as the one that is about to begin
    git(project, "add", "--force", "src/planner/__pycache__")
    kept = take(project / "here").manifest["files"]
    assert f"{BASE}/src/planner/tuning.py" in kept
    assert not [name for name in kept if "__pycache__" in name or ".venv" in name]
    assert not [name for name in kept if name.startswith(tuple(f"{BASE}/{hunt}/" for hunt in hunts))]


def test_submodules_and_roots_are_taken_in(project, take, tmp_path):
    other = tmp_path / "library"
    other.mkdir()
    (other / "inside.py").write_text("VALUE = 1\n")
    make_repository(other)
    git(project, "-c", "protocol.file.allow=always", "submodule", "add", "-q", str(other), "libs/library")
    (tmp_path / "extra").mkdir()
    (tmp_path / "extra" / "notes.txt").write_text("read me")
    (tmp_path / "single.txt").write_text("1")
    snapshot = take(roots=(tmp_path / "extra", tmp_path / "single.txt"))
    assert (snapshot.path / BASE / "libs" / "library" / "inside.py").is_file()
    assert (snapshot.path / "code" / "@extra" / "notes.txt").read_text() == "read me"
    assert list((snapshot.path / "code").glob("@*/single.txt"))
    with pytest.raises(SnapshotError, match="gone' does not exist"):
        take(roots=(tmp_path / "gone",))


def test_equal_code_is_stored_once_and_up_to_a_limit(project, take):
    first = take()
    written = first.path.stat().st_ino
    assert take().path == first.path
    assert first.path.stat().st_ino == written
    (project / "src" / "planner" / "tuning.py").write_text("LAST = 25\n")
    assert take().path != first.path
    assert len(list(first.path.parent.iterdir())) == 2
    without = take(code=False)
    assert not (without.path / "code").exists()
    assert not without.has_code
    (project / "recording.bin").write_bytes(bytes(3_000_000))
    with pytest.raises(SnapshotError, match=r"recording.bin \(3 MB\)") as caught:
        take(limit_mb=2)
    assert "--no-snapshot" in caught.value.fix
    assert f"{BASE}/recording.bin" in take(limit_mb=10).manifest["files"]


def test_other_versions_of_libraries_make_another_snapshot(take, monkeypatch):
    first = take()
    assert "conditions" not in first.manifest
    monkeypatch.setattr(_take, "environment", lambda _: {**first.environment, "python": "9.9"})
    other = take()
    assert other.digest != first.digest
    assert (other.conditions, other.manifest["files"]) == ({"python": "9.9"}, first.manifest["files"])
    other.verify()
    assert code_changes(first, other).changed == (f"python {first.environment['python']} (now 9.9)",)
    assert take().digest == other.digest
    monkeypatch.undo()
    assert take().digest == first.digest


def test_code_that_is_not_copied_still_identifies_a_snapshot(project, take):
    first = take(code=False)
    assert not first.has_code
    assert first.is_described
    assert [place for place in first.manifest["files"] if place.startswith("code/")] == []
    assert f"{BASE}/src/planner/agents.py" in first.conditions
    first.verify()
    (project / "src" / "planner" / "agents.py").write_text("changed = True\n")
    other = take(code=False)
    assert other.digest != first.digest
    assert code_changes(first, other).changed == ("src/planner/agents.py",)


def test_large_file_that_is_not_copied_is_known_by_its_ends(tmp_path, monkeypatch):
    monkeypatch.setattr(_take, "_WHOLE_FILE_BYTES", 100)
    monkeypatch.setattr(_take, "_SMALL_FILE_BYTES", 10)
    file = tmp_path / "data.bin"
    digests = []
    for content in (bytes(300), bytes(299), bytes(290) + b"1" * 10, b"1" + bytes(299), bytes(300)):
        file.write_bytes(content)
        digests.append(_take._digest_of_original(str(file)))
    assert len(set(digests)) == 4
    assert digests[0] == digests[-1]
    assert _take._digest_of_original(str(tmp_path / "gone")) == ""


def test_what_is_missing_new_or_changed_is_named(take, tmp_path):
    weights = tmp_path / "policy ä.npz"
    weights.write_bytes(os.urandom(2_000_000))
    snapshot = take(weights=weights)
    (kept,) = (snapshot.path / "files").iterdir()
    assert snapshot.argument_files == {str(weights): str(kept)}
    assert kept.read_bytes() == weights.read_bytes()
    package = snapshot.path / BASE / "src" / "planner"
    (package / "cache.json").write_text("{}")  # an agent may write beside itself
    assert snapshot.faults() == []
    (package / "numpy.py").write_text("")
    with pytest.raises(BundleError, match=r"numpy.py was not there"):
        snapshot.verify()
    (package / "numpy.py").unlink()
    snapshot.verify()
    (package / "untracked.py").unlink()
    with pytest.raises(BundleError, match=r"untracked.py is missing"):
        snapshot.verify()
    (package / "untracked.py").touch()
    kept.write_bytes(kept.read_bytes()[:-1] + b"x")
    with pytest.raises(BundleError, match=r"policy ä.npz has changed"):
        snapshot.verify()
    (snapshot.path / "manifest.json").write_text("[]")
    with pytest.raises(BundleError, match="manifest"):
        Snapshot(snapshot.path).verify()
    shutil.rmtree(snapshot.path)
    with pytest.raises(BundleError, match="the snapshot is missing"):
        Snapshot(snapshot.path).verify()


def test_program_stays_executable_and_nothing_more(project, take):
    for name, mode in (("program", 0o6775), ("large", 0o6775), ("private", 0o600), ("read_only", 0o444)):
        (project / name).write_bytes(bytes(2 << 20 if name == "large" else 2))
        (project / name).chmod(mode)
    snapshot = take()
    for name, mode in (("program", 0o755), ("large", 0o755), ("private", 0o600), ("read_only", 0o644)):
        assert stat.S_IMODE((snapshot.path / BASE / name).stat().st_mode) == mode
        assert ("executable" in snapshot.manifest["files"][f"{BASE}/{name}"]) == (mode == 0o755)
    (project / "private").chmod(0o700)
    assert os.access(take().path / BASE / "private", os.X_OK)  # although no content has changed
    (snapshot.path / BASE / "program").chmod(0o644)
    assert Snapshot(snapshot.path).changes() == [f"{BASE}/program is no longer executable"]


def test_root_inside_a_project_is_kept_at_its_place_although_git_ignores_it(project, take):
    for root, names in (("build", ["build/big.bin"]), ("token.secret", ["token.secret"])):
        files = take(roots=(project / root,)).manifest["files"]
        assert [name for name in files if name.endswith((".bin", ".secret"))] == [f"{BASE}/{name}" for name in names]
