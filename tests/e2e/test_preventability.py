"""`judge` asks models of a competent driver whether they would have prevented a crash."""

from __future__ import annotations

import json

import pytest

from crashhunt.dashboard._catalog import FoundHunt
from crashhunt.dashboard._crash_list import CrashList

MODELS = {"cc_human", "fsm", "rss", "reg157"}


@pytest.mark.long
def test_crash_of_a_blind_agent_is_preventable_in_all_outputs(shell):
    words = ("--scenario", "r157-cut-in", "--agent", "keep-lane", "--seed", "1", "--no-snapshot")
    shell.crashhunt("run", "h", "1", "2", "60", *words)
    few = ("--runs", "1", "--why", "0", "--reference", "0")
    (judged,) = shell.crashhunt("judge", "h", *few, "--json").json["judged"]
    assert judged["preventable_by"] == dict.fromkeys(MODELS, True)
    runs = {run["model"]: run for run in judged["drivers"]["runs"]}
    assert all(runs[model]["margin_m"] > 0 for model in MODELS)
    assert all(runs[model]["perceived_step"] >= judged["drivers"]["since_step"] for model in MODELS)
    shown = shell.crashhunt("show", "h").out
    assert "Preventable by a competent driver (careful human: yes, by " in " ".join(shown.split())
    assert "careful human: yes, FSM: yes, RSS: yes" in shell.crashhunt("crashes", "h").out
    (group,) = shell.crashhunt("crashes", "h", "--sarif", "s.sarif", "--json").json["groups"]
    assert group["preventable_by"] == judged["preventable_by"]
    (alert,) = json.loads((shell.folder / "s.sarif").read_text())["runs"][0]["results"]
    assert alert["properties"]["preventable_by"] == judged["preventable_by"]
    assert "Preventable (careful human: yes, FSM: yes, RSS: yes, R157 5.2.5.2: yes)." in alert["message"]["text"]
    rows = [json.loads(line) for line in shell.crashhunt("trials", "h", "--format", "jsonl").out.splitlines()]
    answers = {name: row[f"preventable_by.{name}"] for row in rows if row["outcome"] == "collision" for name in MODELS}
    assert answers == judged["preventable_by"]
    assert all(row["preventable_by.fsm"] is None for row in rows if row["outcome"] != "collision")
    shell.crashhunt("report", "h", "--out", "r.html")
    assert "Preventable by a competent driver (careful human: yes" in (shell.folder / "r.html").read_text()
    (listed,) = CrashList(FoundHunt("h", shell.folder / "h", shell.folder, "h", "")).rows()["crashes"]
    assert listed["preventable_by"] == judged["preventable_by"]
    (kept,) = shell.crashhunt("judge", "h", *few, "--no-drivers", "--json").json["judged"]
    assert kept["preventable_by"] == judged["preventable_by"]
