"""What an agent omitted, by runs with a reference driver; each sentence against runs of its own."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from crashhunt.analysis import judge
from crashhunt.crashes import find_bundle, list_bundles
from crashhunt.replays import ReplayOptions

OMITTING = Path(__file__).with_name("omitting.py")


def hunt(shell, *words):
    shutil.copy(OMITTING, shell.folder)
    shell.crashhunt("run", "h", "2", "8", "400", *words)
    return find_bundle(shell.folder / "h")


@pytest.mark.nightly
def test_judge_names_an_unsafe_lane_change(shell):
    words = ("--scenario", "merge", "--agent", "omitting:NeverLooksAside", "--seed", "1", "--keep-going")
    hunt(shell, *words)
    bundles = [one for one in list_bundles(shell.folder / "h") if one.result.collision is not None]
    found = [judge(one, ReplayOptions(), runs=1, reference=20, parallel=2).reference for one in bundles[:3]]
    lateral = [one.omission for one in found if one.omission is not None]
    assert len(lateral) == len(found) > 0
    assert {one.faculty for one in lateral} == {"lateral"}
    assert {one.instead for one in lateral} == {"changed lanes"}


@pytest.mark.nightly
def test_crash_of_format_version_1_has_its_omission(shell):
    archive = Path(__file__).parent / "bundles" / "version-1.zip"
    words = ("judge", str(archive), "--runs", "1", "--why", "0", "--trust", "--json")
    (judged,) = shell.crashhunt(*words).json["judged"]
    omission = judged["reference"]["omission"]
    assert (omission["faculty"], omission["kind"], omission["actor"]) == ("lateral", "alongside left", "left.8")
    assert [run["ending"] for run in judged["reference"]["runs"]] == ["none"] * 3
    assert judged["attempts"][0]["changed"] == ["ego does not change lanes"]  # braking drops the lane change, too
