"""The command that installs an extra fits the environment that runs."""

from __future__ import annotations

import shlex
import shutil
import sys

import pytest

from crashhunt.base import extras, layout


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with an environment in ``.venv``; sets what is on the PATH, and whether the folder is a clone."""

    def make(*, clone, on_path, pip=True):
        programs = tmp_path / ".venv" / "bin"
        programs.mkdir(parents=True, exist_ok=True)
        for name in ("python", *(["pip"] if pip else [])):
            (programs / name).touch(0o755)
        if clone:
            (tmp_path / "pyproject.toml").touch()
        monkeypatch.setattr(sys, "prefix", str(tmp_path / ".venv"))
        monkeypatch.setattr(sys, "executable", str(programs / "python"))
        monkeypatch.setattr(layout, "PACKAGE", tmp_path / "crashhunt")
        monkeypatch.setattr(shutil, "which", lambda name: str(programs / name) if on_path else "/usr/bin/pip")
        return tmp_path

    return make


def test_clone_names_its_own_pip_and_folder(place, monkeypatch):
    root = place(clone=True, on_path=False)
    monkeypatch.chdir(root)
    assert extras.install_command("dashboard") == ".venv/bin/pip install -e '.[dashboard]'"
    (root / "runs").mkdir()
    monkeypatch.chdir(root / "runs")
    assert shlex.split(extras.install_command("maps")) == [
        f"{root}/.venv/bin/pip", "install", "-e", f"{root}[maps]",
    ]  # fmt: skip


def test_installed_package_names_the_package(place, monkeypatch):
    monkeypatch.chdir(place(clone=False, on_path=True))
    assert extras.install_command("video") == "pip install 'crashhunt[video]'"


def test_environment_whose_pip_is_not_the_one_of_the_shell_names_its_own(place, monkeypatch):
    monkeypatch.chdir(place(clone=False, on_path=False))
    assert extras.install_command("video") == ".venv/bin/pip install 'crashhunt[video]'"


def test_environment_without_pip_names_its_python(place, monkeypatch):
    monkeypatch.chdir(place(clone=False, on_path=False, pip=False))
    assert extras.install_command("video") == ".venv/bin/python -m pip install 'crashhunt[video]'"


def test_only_a_fix_with_the_whole_command_names_an_installation(place, monkeypatch):
    monkeypatch.chdir(place(clone=True, on_path=False))
    command = extras.install_command("video")
    assert extras.installation_in(f"{command}, or give --gif") == shlex.split(command)
    assert extras.installation_in("give speed=[a] or pip install x[video]") == []
    assert extras.installation_in("") == []
