"""The conditions under which trials run, and the failures of trials that are no results because one no longer holds."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from types import SimpleNamespace

import pytest

from crashhunt.base import layout
from crashhunt.base.errors import HostError
from crashhunt.base.process_owners import this_process
from crashhunt.episode import WorkerSettings
from crashhunt.executors import HostConditions, _host_conditions
from crashhunt.scenario import AgentSetup, Scenario
from crashhunt.trial import CRASHES

SNAPSHOT = "snapshots/0123"


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with the current folder, the folder for temporary files and the directory of a hunt."""
    for name in ("here", "tmp", f"hunt/{SNAPSHOT}/scenario", "hunt/.scratch-1/confirmations"):
        (tmp_path / name).mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("TMPDIR", str(tmp_path / "tmp"))
    monkeypatch.setattr(_host_conditions, "_REMOVAL_S", 0.0)
    (tmp_path / "hunt" / SNAPSHOT / layout.MANIFEST).write_text("{}")
    return tmp_path


@pytest.fixture
def settings(place):
    scenario = Scenario(simulator="toy", agents={"ego": AgentSetup(agent="keep-lane")})
    folder = place / "hunt" / SNAPSHOT / "scenario"
    return WorkerSettings(
        scenario=replace(scenario, folder=folder), oracles=("overlap",), crash_on=CRASHES,
        scratch=place / "hunt" / f"{layout.SCRATCH}-{this_process().token}",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("gone", "message"),
    [
        ("here", "the current folder of the command was deleted or moved while trials ran"),
        ("tmp", "the folder for temporary files (TMPDIR) was deleted or moved while trials ran"),
        ("hunt", "the directory of the hunt was deleted or moved while trials ran"),
    ],
)
@pytest.mark.parametrize("moved", [False, True])
def test_folder_that_is_gone_is_named(place, settings, gone, message, moved):
    conditions = HostConditions(settings)
    conditions.check()
    conditions.check_hunt()
    (place / gone).rename(place / "elsewhere") if moved else shutil.rmtree(place / gone)
    with pytest.raises(HostError, match="run the same command again") as caught:
        conditions.check()
    assert (caught.value.message, caught.value.where) == (message, str(place / gone))
    if gone == "hunt":
        with pytest.raises(HostError, match="the directory of the hunt"):
            conditions.check_hunt()
    else:
        conditions.check_hunt()  # as long as no trial fails, trials do not need it


def test_current_folder_that_was_made_again_is_another_one(place, settings):
    conditions = HostConditions(settings)
    shutil.rmtree(place / "here")
    (place / "here").mkdir()
    with pytest.raises(HostError, match="was deleted while trials ran, and another folder has its name now"):
        conditions.check()


def test_missing_files_of_the_snapshot_are_named(place, settings, monkeypatch):
    manifest = place / "hunt" / SNAPSHOT / layout.MANIFEST
    monkeypatch.setattr(
        "crashhunt.snapshots.Snapshot", lambda path: SimpleNamespace(manifest={"files": {"code/agent.py": {}}})
    )
    conditions = HostConditions(settings)
    with pytest.raises(
        HostError, match=r"a file of the snapshot was deleted.*; delete its folder with rm -r"
    ) as caught:
        conditions.check()
    assert caught.value.where == str(manifest.parent / "code" / "agent.py")
    conditions.check_hunt()
    manifest.unlink()
    with pytest.raises(HostError) as caught:
        conditions.check_hunt()
    assert caught.value.where == str(manifest)
    shutil.rmtree(manifest.parent)
    with pytest.raises(HostError) as caught:
        conditions.check_hunt()
    assert caught.value.fix.startswith("run the same command again")  # there is no folder to delete


def test_hunt_whose_files_are_being_removed_is_reported_as_removed(place, settings, monkeypatch):
    conditions = HostConditions(settings)
    (place / "hunt" / SNAPSHOT / layout.MANIFEST).unlink()
    monkeypatch.setattr(_host_conditions.time, "sleep", lambda _: shutil.rmtree(place / "hunt"))
    with pytest.raises(HostError, match="the directory of the hunt was deleted or moved"):
        conditions.check_hunt()


def test_disk_that_becomes_full_is_named_and_one_that_was_full_is_not(place, settings, monkeypatch):
    free = SimpleNamespace(f_bavail=10**6, f_frsize=4096, f_favail=10**6, f_files=10**6)
    found = {str(place / "tmp"): free}
    monkeypatch.setattr(_host_conditions.os, "statvfs", lambda path: found.get(str(path), free))
    for full in ({"f_bavail": 1}, {"f_favail": 0}):
        conditions = HostConditions(settings)
        found[str(place / "tmp")] = SimpleNamespace(**{**vars(free), **full})
        with pytest.raises(HostError, match=r"the disk of the folder for temporary files \(TMPDIR\) is full"):
            conditions.check()
        HostConditions(settings).check()
        found[str(place / "tmp")] = free
    found[str(place / "tmp")] = SimpleNamespace(**{**vars(free), "f_favail": 0, "f_files": 0})
    conditions.check()  # this file system does not count files


def test_folder_that_became_read_only_is_named(place, settings, monkeypatch):
    conditions = HostConditions(settings)
    monkeypatch.setattr(os, "access", lambda path, right: str(path) != str(place / "tmp"))
    with pytest.raises(HostError, match=r"\(TMPDIR\) was made inaccessible while trials ran"):
        conditions.check()


def test_folders_of_an_agent_are_no_conditions(place, settings, monkeypatch):
    conditions = HostConditions(settings)
    own = place / "own"
    own.mkdir()
    monkeypatch.setenv("TMPDIR", str(own))  # as in the process of a trial
    own.rmdir()
    conditions.check()
