"""Git as a program: its output, its errors in one line, and no repository but the one that is meant."""

from __future__ import annotations

import subprocess

import pytest

from crashhunt.base.errors import CrashhuntError, UsageError
from crashhunt.base.git import checked_out, commit_of, git, import_environment, top_of, tracked_files, work_tree


@pytest.fixture
def repository(tmp_path):
    folder = tmp_path / "project"
    (folder / "inner").mkdir(parents=True)
    (folder / "inner" / "file").write_text("")
    for words in (
        ["init", "-q"],
        ["add", "."],
        ["-c", "user.name=T", "-c", "user.email=t@e.org", "commit", "-qm", "x"],
    ):
        subprocess.run(["git", *words], cwd=folder, check=True)
    return folder


def test_a_command_returns_its_output_and_an_error_is_one_line(repository):
    head = git(repository, "rev-parse", "HEAD").strip()
    assert len(head) == 40
    with pytest.raises(UsageError, match="'gone' is not a commit of the repository"):
        git(repository, "rev-parse", "--verify", "gone", what="gone")
    with pytest.raises(CrashhuntError) as caught:
        git(repository, "no-such-command")
    assert "\n" not in str(caught.value)
    assert git(repository, "rev-parse", "--verify", "--quiet", "gone", skipped=True) == ""
    assert git(repository, "rev-parse", "HEAD", skipped=True).strip() == head


def test_the_repository_is_found_from_inside_and_its_commits_by_name(repository, tmp_path):
    head = git(repository, "rev-parse", "HEAD").strip()
    assert top_of(repository / "inner").resolve() == repository.resolve()
    assert commit_of(repository, "HEAD") == commit_of(repository, head[:10]) == head
    with pytest.raises(UsageError):
        commit_of(repository, "HEAD~1")
    assert work_tree(repository / "inner").resolve() == repository.resolve()
    assert work_tree(tmp_path) is None
    with pytest.raises(CrashhuntError, match="run the command in the repository"):
        top_of(tmp_path)


def test_a_commit_is_checked_out_for_a_while_and_imports_come_from_it(repository, monkeypatch):
    first = commit_of(repository, "HEAD")
    (repository / "src").mkdir()
    (repository / "src" / "planned.py").write_text("")
    subprocess.run(["git", "add", "."], cwd=repository, check=True)
    subprocess.run(
        ["git", "-c", "user.name=T", "-c", "user.email=t@e.org", "commit", "-qm", "y"], cwd=repository, check=True
    )
    monkeypatch.setenv("PYTHONPATH", "/mine")
    before = {path.name for path in repository.iterdir()}
    with (
        checked_out(repository, first, purpose="test", name="old") as old,
        checked_out(repository, commit_of(repository, "HEAD"), purpose="test", name="new") as new,
    ):
        assert not (old / "src").exists()
        assert (new / "src" / "planned.py").exists()
        environment = import_environment(new / "inner", new)
        assert environment["PYTHONPATH"].split(":") == [str(new / "inner"), str(new), str(new / "src"), "/mine"]
    assert not old.exists()
    assert not new.exists()
    assert git(repository, "worktree", "list").count("\n") <= 1
    assert {path.name for path in repository.iterdir()} == before
    assert tracked_files(repository) == {"inner/file", "src/planned.py"}
