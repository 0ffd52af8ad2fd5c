"""Which commit brought a crash."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from repositories import git
from test_corpus import BROKEN, DRIVER, MENDED

from crashhunt.base.errors import UsageError
from crashhunt.corpus import _bisection as _bisect


@pytest.fixture
def repository(toy):
    """A repository with the code of the agent, and a hunt of its last commit beside it."""
    project = toy.folder / "my project"
    project.mkdir()
    git(project, "init", "-q")
    for number, code in enumerate(
        (MENDED, MENDED + "\n# 1\n", BROKEN.replace("raise", "raise SystemError or"), DRIVER)
    ):
        (project / "driver.py").write_text(code)
        git(project, "add", "driver.py")
        git(project, "commit", "-qm", f"change {number}")
    (project / "driver.py").write_text(DRIVER + "\n# not committed\n")
    toy.folder = project
    words = ("--scenario", "../toy", "--agent", "driver:Driver", "--arg", "speed=20:22", "--seed", "1")
    toy.crashhunt("run", "../h", "1", "1", "99", *words)
    return toy


@pytest.mark.nightly
def test_the_commit_is_found_and_the_work_tree_left_alone(repository):
    before = git(repository.folder, "status", "--short")  # the hunt has left Python's caches there
    assert " M driver.py" in before
    found = repository.crashhunt("bisect", "../h", "--good", "HEAD~3", "--json", expect=1).json
    # The commit before cannot be told from it: there, it crashes in another way.
    assert set(found["tried"].values()) == {"still", "fixed", "changed"}
    assert found["commit"] is None
    assert len(found["candidates"]) == 2
    assert (repository.folder / "driver.py").read_text().endswith("# not committed\n")
    assert len(git(repository.folder, "worktree", "list").splitlines()) == 1
    assert git(repository.folder, "status", "--short") == before


@pytest.mark.nightly
def test_the_first_of_them_is_reported(repository):
    git(repository.folder, "rebase", "-q", "--autostash", "--onto", "HEAD~2", "HEAD~1", "-X", "theirs")
    done = repository.crashhunt("bisect", "../h", "--good", "HEAD~2")
    assert "is the first in which it crashes: change 3" in done.out
    repository.crashhunt("export", "../h", "../crash.zip")
    refused = repository.crashhunt("bisect", "../crash.zip", "--good", "HEAD", expect=2)
    assert "the crash is still, and not fixed" in refused.err


@pytest.mark.nightly
def test_a_revision_on_another_branch_that_mended_it_is_reported(tmp_path, monkeypatch):
    """Git says so again and again, and goes on to no other revision."""
    git(tmp_path, "init", "-q", "-b", "main")
    for words, code in ((), "bad"), (("-b", "mended"), "good"), (("main",), "bad as well"):
        if words:
            git(tmp_path, "checkout", "-q", *words)
        (tmp_path / "code").write_text(code)
        git(tmp_path, "add", "code")
        git(tmp_path, "commit", "-qm", code)

    def ran(case, folder, tree, modules):
        return "still" if (tree / "code").read_text().startswith("bad") else "fixed", ""

    monkeypatch.setattr(_bisect, "_run", ran)
    monkeypatch.setattr(_bisect, "add_case", lambda bundle, to: SimpleNamespace(case=SimpleNamespace(path=to)))
    monkeypatch.setattr(_bisect, "read_settings", lambda path: SimpleNamespace(agents={}, texts={}))
    parts = git(tmp_path, "rev-parse", "main~1")[:12]
    monkeypatch.setenv("GIT_DIR", str(tmp_path / ".git"))  # as in a hook; it goes before git's -C
    monkeypatch.setenv("GIT_INDEX_FILE", str(tmp_path / ".git" / "index"))
    expected = f"--good mended is not before --bad main: their common ancestor {parts} already"
    with pytest.raises(UsageError, match=expected):
        _bisect.bisect(SimpleNamespace(hunt=tmp_path), "mended", bad="main", folder=tmp_path)
    assert git(tmp_path, "status", "--short", "--branch") == "## main\n"
    assert len(git(tmp_path, "worktree", "list").splitlines()) == 1
