"""`judge` asks models of a competent driver whether they would have prevented a crash."""

from __future__ import annotations

import pytest

MODELS = {"cc_human", "fsm", "rss", "reg157"}


@pytest.mark.long
def test_crash_of_a_blind_agent_is_preventable_in_all_outputs(shell):
    shell.crashhunt("run", "h", "2", "40", "400", "--scenario", "loop", "--arg", "speed=22:25", "--seed", "1")
    few = ("--runs", "1", "--why", "0", "--reference", "0")
    (judged,) = shell.crashhunt("judge", "h", *few, "--json").json["judged"]
    assert judged["preventable_by"] == {"cc_human": True, "fsm": True, "rss": True, "reg157": None}
    runs = {run["model"]: run for run in judged["drivers"]["runs"]}
    assert "did not cut in" in runs["reg157"]["why_not"]
    assert all(runs[model]["margin_m"] > 0 for model in MODELS - {"reg157"})
    assert all(runs[model]["perceived_step"] >= judged["drivers"]["since_step"] for model in MODELS - {"reg157"})
    shown = shell.crashhunt("show", "h").out
    assert "Preventable by a competent driver (careful human: yes, by " in " ".join(shown.split())
    assert "careful human: yes, FSM: yes, RSS: yes" in shell.crashhunt("crashes", "h").out
    (kept,) = shell.crashhunt("judge", "h", *few, "--no-drivers", "--json").json["judged"]
    assert kept["preventable_by"] == judged["preventable_by"]


def test_crash_without_another_vehicle_has_no_answer(toy):
    words = ("--scenario", "toy", "--agent", "faulty:Raises", "--arg", "at=2", "--seed", "1")
    toy.crashhunt("run", "h", "1", "1", "9", *words)
    (judged,) = toy.crashhunt("judge", "h", "--why", "2", "--json").json["judged"]
    assert judged["preventable_by"] == dict.fromkeys(MODELS)
