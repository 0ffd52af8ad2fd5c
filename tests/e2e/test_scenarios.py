"""Every shipped scenario has a crash, and everything that is done with a crash works on it."""

from __future__ import annotations

import pytest

from crashhunt.scenario import shipped_scenarios

SEEDS = {"merge": 3, "intersection": 3}  # with which a crash comes soon


@pytest.mark.parametrize("scenario", sorted(shipped_scenarios()))
def test_a_crash_of_it_is_found_replayed_shown_filmed_and_handed_on(shell, scenario):
    seed = str(SEEDS.get(scenario, 1))
    words = ("--scenario", scenario, "--seed", seed, "--deterministic")
    found = shell.crashhunt("run", "h", "2", "400", "1500", *words, "--json").json
    (crash,) = found["crashes"]
    assert crash["confirmed"]
    for who in ((), ("--code", "current"), ("--from-log",)):
        assert shell.crashhunt("replay", "h", *who, "--json").json["verdict"] == "reproduced"
    shell.crashhunt("export", "h", "crash.zip")
    assert shell.crashhunt("replay", "crash.zip", "--json").json["digest_replayed"] == crash["digest"]
    told = shell.crashhunt("show", "h").out
    assert f"step {crash['step']}" in told
    written = shell.crashhunt("replay", "h", "--frames", "f", "--last-seconds", "1", "--size", "160x120", "--json").json
    assert written["written"]["f"] == 21
    shell.crashhunt("report", "h")
    assert crash["id"] in (shell.folder / "h/report.html").read_text(encoding="utf-8")
