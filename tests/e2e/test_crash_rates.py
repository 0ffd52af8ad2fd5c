"""How often an agent crashes: distances in ledgers, `rate`, `run --until-rate`."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing

import pytest


def results(folder):
    with closing(sqlite3.connect(folder / "ledger.sqlite")) as database:
        rows = database.execute("SELECT result FROM trials ORDER BY number").fetchall()
    return [json.loads(text) for (text,) in rows]


def test_ledger_has_the_distance_and_time_of_each_valid_trial(toy):
    toy.crashhunt("run", "h", "2", "6", "60", "--scenario", "toy", "--seed", "3", "--keep-going")
    found = results(toy.folder / "h")
    assert len(found) == 6
    for trial in found:
        assert trial["step_length_s"] == 0.1
        assert trial["driven_s"] == pytest.approx(trial["steps"] * 0.1)
        assert 0 < trial["driven_m"] < 60 * trial["driven_s"]


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("scenario", "slow"),
    [("loop", "--no-native"), ("highway", "--no-accelerate"), ("intersection-two-agents", "--no-accelerate")],
)
def test_compiled_core_and_accelerator_measure_the_same_distances(shell, scenario, slow):
    found = []
    for folder, options in (("fast", ()), ("slow", (slow,))):
        shell.crashhunt("run", folder, "1", "3", "200", "--scenario", scenario, "--seed", "5", "--keep-going", *options)
        found.append([(one["driven_m"], one["driven_s"], one["digest"]) for one in results(shell.folder / folder)])
    assert found[0] == found[1]
    assert all(meters > 10 for meters, *_ in found[0])
