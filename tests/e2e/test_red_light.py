"""A hunt for red lights, from the command line to the report: found, confirmed, replayed, told in words."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from crashhunt.recording import read_log

NET = Path(__file__).parents[1] / "on_sumo" / "signal.net.xml"
SCENARIO = """
title = "A crossing with a signal, at which the vehicle arrives when it is red"
schema = 1
simulator = "sumo"
warmup_s = 10.0
[sumo]
net = "signal.net.xml"
routes = ["r.rou.xml"]
[agents.ego]
agent = "crashhunt.agents:KeepLaneWithSpeed"
route = "across"
[agents.ego.arguments.speed]
default = 10.0
"""
ROUTES = '<routes><route id="across" edges="west east"/></routes>'


def make(shell):
    folder = shell.folder / "signal"
    folder.mkdir()
    shutil.copy(NET, folder)
    (folder / "scenario.toml").write_text(SCENARIO)
    (folder / "r.rou.xml").write_text(ROUTES)


@pytest.mark.nightly
def test_a_red_light_from_the_hunt_to_the_report(shell):
    make(shell)
    words = ("--scenario", "signal", "--arg", "speed=10", "--seed", "1", "--no-snapshot")
    done = shell.crashhunt("run", "h", "1", "1", "300", *words, "--crash-on", "collision,red_light", "--json")
    (crash,) = done.json["crashes"]
    assert (crash["outcome"], crash["confirmed"]) == ("red_light", True)
    assert done.json["events"] == {"red_light": {"count": 1, "trials": 1}}
    assert "(traffic event)" in done.err
    assert "ego ran a red light at 10.0 m/s, coming from lane west_0, at step" in done.err
    assert "on lane :c_3_0" in done.err
    saved = json.loads((shell.folder / crash["path"] / "crash.json").read_text())
    assert (saved["event"]["kind"], saved["events"], saved["collision"]) == ("red_light", {"red_light": 1}, None)
    told = [event for scene in read_log(shell.folder / crash["path"] / "log.mcap").scenes() for event in scene.events]
    assert [event.kind for event in told] == ["red_light"]
    assert shell.crashhunt("replay", "h", "--json").json["verdict"] == "reproduced"
    shown = shell.crashhunt("show", "h").out
    assert "ego ran a red light at 10.0 m/s" in shown
    assert "ego's last decision was target_speed 10" in shown
    shell.crashhunt("report", "h", "--out", "report.html")
    assert "traffic event" in (shell.folder / "report.html").read_text()
    shell.crashhunt("replay", "h", "--from-log", "--gif", "crash.gif", "--last-seconds", "0.3", "--size", "320x240")
    assert (shell.folder / "crash.gif").stat().st_size > 1000


def test_what_no_one_hunts_for_is_reported_at_the_end_and_in_the_table(shell):
    make(shell)
    words = ("--scenario", "signal", "--arg", "speed=10", "--seed", "1", "--no-snapshot")
    done = shell.crashhunt("run", "h", "1", "2", "300", *words)
    assert "No crash was found." in done.out
    assert "Traffic events: 2 red lights run in 2 trials. To hunt for them: --crash-on red_light" in done.out
    rows = json.loads(shell.crashhunt("trials", "h", "--format", "json").out)
    assert [(row["outcome"], row["red_light"], row["teleport"]) for row in rows] == [("finished", 1, 0)] * 2
