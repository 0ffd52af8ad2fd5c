"""Which commit brought a crash."""

from __future__ import annotations

import pytest
from repositories import git
from test_corpus import BROKEN, DRIVER, MENDED


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
