"""What an older crashhunt has left is read, shown, replayed and gone on with.

Every version of the formats leaves some of it here, which ``frozen/make.sh .venv/bin/crashhunt version-N`` makes; it is
never made anew.
"""

from __future__ import annotations

import json
import shutil
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest
from conftest import mostly_nightly

BUNDLES = sorted((Path(__file__).parent / "bundles").glob("*.zip"))
SAME_TRAFFIC = version("libsumo") == "1.28.0"  # which recorded them; another one may compute other traffic
bundles = pytest.mark.parametrize("bundle", list(map(str, BUNDLES)), ids=[path.stem for path in BUNDLES])
FROZEN = Path(__file__).parent / "frozen"
HUNTS = sorted(path.parent for path in FROZEN.glob("*/hunt"))
hunts = pytest.mark.parametrize("place", HUNTS, ids=[path.name for path in HUNTS])


@bundles
def test_it_is_reported_and_driven_from_its_log_without_running_its_code(shell, bundle):
    assert "drove into left.8 at step 40" in shell.crashhunt("show", bundle).out
    shell.crashhunt("report", bundle, "--output", "page.html")
    assert "left.8" in (shell.folder / "page.html").read_text()
    driven = shell.crashhunt("replay", bundle, "--from-log", "--json", expect=0 if SAME_TRAFFIC else None)
    assert driven.json["code"] == "log"


@hunts
def test_a_hunt_is_listed_read_and_checked(shell, place):
    shutil.copytree(place / "hunt", shell.folder / "hunt")
    told = shell.crashhunt("trials", "hunt", "--format", "jsonl").out.splitlines()
    assert [json.loads(line)["outcome"] for line in told] == ["collision", "survived", "collision", "survived"]
    (state,) = shell.crashhunt("status", "hunt", "--json").json["hunts"]
    assert (state["trials_run"], state["crashes"]) == (4, 2)
    assert "4 trials and 2 crashes are intact" in shell.crashhunt("check", "hunt").out
    assert "drove into leader" in shell.crashhunt("show", "hunt", "--crash", "0").out
    shell.crashhunt("report", "hunt", "--output", "page.html")
    assert "leader" in (shell.folder / "page.html").read_text()


@hunts
@pytest.mark.parametrize(
    "name", mostly_nightly(["hunt", "fault.zip", "highway.zip"], ["hunt", "highway.zip"])
)  # test_golden.py has it
def test_crashes_are_replayed_by_the_code_of_today(shell, place, name):
    shutil.copytree(place, shell.folder / "kept")
    report = shell.crashhunt("replay", f"kept/{name}", "--trust", "--json", expect=None).json
    expected = ("reproduced",) if name != "highway.zip" else ("reproduced", "not_comparable")
    assert report["verdict"] in expected
    assert "step" in shell.crashhunt("show", f"kept/{name}").out


@hunts
def test_a_bundle_alone_is_shown(shell, place):
    with zipfile.ZipFile(place / "highway.zip") as archive:
        archive.extractall(shell.folder)
    (crash,) = (shell.folder / "crashes").iterdir()
    assert "drove into vehicle." in shell.crashhunt("show", str(crash)).out


@pytest.mark.nightly
def test_crash_of_format_version_1_has_its_omission(shell):
    archive = BUNDLES[0]
    words = ("judge", str(archive), "--runs", "1", "--why", "0", "--trust", "--json")
    (judged,) = shell.crashhunt(*words).json["judged"]
    omission = judged["reference"]["omission"]
    assert (omission["faculty"], omission["kind"], omission["actor"]) == ("lateral", "alongside left", "left.8")
    assert [run["ending"] for run in judged["reference"]["runs"]] == ["none"] * 3
    assert judged["attempts"][0]["changed"] == ["ego does not change lanes"]  # braking drops the lane change, too
