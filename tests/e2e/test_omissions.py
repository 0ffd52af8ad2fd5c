"""What an agent omitted, by runs with a reference driver; each sentence against runs of its own."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from crashhunt.analysis import Overrule, WhatIfOptions, judge, what_if
from crashhunt.crashes import find_bundle, judgement_of, list_bundles, with_judgement
from crashhunt.replays import ReplayOptions

OMITTING = Path(__file__).with_name("omitting.py")


def hunt(shell, *words):
    shutil.copy(OMITTING, shell.folder)
    shell.crashhunt("run", "h", "2", "8", "400", *words)
    return find_bundle(shell.folder / "h")


def without_crash(bundle, step, manoeuvre):
    """How many of two runs end without a crash, by `what_if`, which knows nothing of `judge`."""
    found = what_if(bundle, [Overrule(from_step=step, manoeuvre=manoeuvre)], WhatIfOptions(trusted=True, times=2))
    return sum(not run.crashed and not run.excluded for run in found.each)


@pytest.fixture
def rear_end(shell):
    return hunt(shell, "--scenario", "loop", "--agent", "omitting:NeverBrakes", "--arg", "speed=20:25", "--seed", "1")


@pytest.mark.nightly  # by day, episode/test_reference_driver.py and report/test_omission_words.py
def test_judge_names_the_vehicle_for_which_the_agent_did_not_brake(rear_end, shell):
    judgement = judge(rear_end, ReplayOptions(), runs=1, reference=20, parallel=2)
    found = judgement.reference
    omission, hit = found.omission, rear_end.result.collision
    assert (omission.faculty, omission.kind, omission.actor) == ("longitudinal", "vehicle", hit.other)
    assert omission.instead == "kept its speed"
    assert omission.speed_mps > omission.safe
    assert [run.ending for run in found.deciding] == ["none"] * len(found.deciding)
    assert omission.step < rear_end.result.steps - 5  # not the last possible rescue
    assert omission.visible_step is not None
    assert without_crash(rear_end, omission.step, "reference_speed") == 2
    assert without_crash(rear_end, omission.step, "reference_lanes") == 0
    with_judgement(rear_end, judgement).write()
    said = shell.crashhunt("show", "h", "--crash", rear_end.id).out
    assert f"Cause: ego did not brake for {hit.other}" in said
    assert said.index("Cause: ") < said.index("It could be avoided") if "It could be avoided" in said else True
    assert judgement_of(find_bundle(shell.folder / "h", rear_end.id)) == judgement


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
def test_a_bundle_of_the_first_version_has_its_omission(shell):
    archive = Path(__file__).parent / "bundles" / "crashhunt-0.1.0-packages.zip"
    words = ("judge", str(archive), "--runs", "1", "--why", "0", "--trust", "--json")
    (judged,) = shell.crashhunt(*words).json["judged"]
    omission = judged["reference"]["omission"]
    assert (omission["faculty"], omission["kind"], omission["actor"]) == ("lateral", "alongside left", "left.8")
    assert [run["ending"] for run in judged["reference"]["runs"]] == ["none"] * 3
    assert judged["attempts"][0]["changed"] == ["ego does not change lanes"]  # braking drops the lane change, too
