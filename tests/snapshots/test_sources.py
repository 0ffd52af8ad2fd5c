from __future__ import annotations

import subprocess

from crashhunt.snapshots._sources import find_sources, git


def test_crashhunt_comes_along_without_the_pages_of_its_guide():
    kept = find_sources([]).files
    assert {"code/crashhunt/__init__.py", "code/crashhunt/guide/__init__.py", "code/crashhunt/py.typed"} <= set(kept)
    pages = "code/crashhunt/guide/"
    assert not [place for place in kept if place.startswith(pages) and place.endswith(".md")]


def test_in_a_hook_of_another_repository_a_folder_is_still_of_its_own(tmp_path, monkeypatch):
    for name in ("here", "elsewhere"):
        subprocess.run(["git", "init", "-q", str(tmp_path / name)], check=True)
    monkeypatch.setenv("GIT_DIR", str(tmp_path / "elsewhere" / ".git"))
    assert git(tmp_path / "here", "rev-parse", "--absolute-git-dir") == f"{tmp_path}/here/.git\n".encode()
