"""A hunt for red lights, from the command line to the report: found, confirmed, replayed, told in words."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

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


def test_what_no_one_hunts_for_is_reported_at_the_end_and_in_the_table(shell):
    make(shell)
    words = ("--scenario", "signal", "--arg", "speed=10", "--seed", "1", "--no-snapshot")
    done = shell.crashhunt("run", "h", "1", "2", "300", *words)
    assert "No crash was found." in done.out
    assert "Traffic events: 2 red lights run in 2 trials. To hunt for them: --crash-on red_light" in done.out
    rows = json.loads(shell.crashhunt("trials", "h", "--format", "json").out)
    assert [(row["outcome"], row["red_light"], row["teleport"]) for row in rows] == [("finished", 1, 0)] * 2
