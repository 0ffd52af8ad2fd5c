"""Status, logs, rerun, trials and compare on single hunts."""

from __future__ import annotations

import csv
import json
import shutil

from conftest import keeps_going


def rows(shell, hunt: str, *words: str) -> list[dict]:
    return json.loads(shell.crashhunt("trials", hunt, "--format", "json", *words).out)


def test_tables_of_trials(toy, made_once):
    made_once(keeps_going, toy)
    table = rows(toy, "h")
    assert [row["number"] for row in table] == list(range(12))
    assert {"ego.speed", "scenario.gap_m", "seed", "outcome", "steps", "digest", "time_to_collision_s"} <= table[
        0
    ].keys()
    assert all(4 <= row["ego.speed"] <= 14 for row in table)
    plain = list(csv.DictReader(toy.crashhunt("trials", "h").out.splitlines()))
    assert [float(row["ego.speed"]) for row in plain] == [row["ego.speed"] for row in table]
    crashes = [row for row in table if row["outcome"] == "collision"]
    assert 0 < len(crashes) < 12
    assert rows(toy, "h", "--outcome", "collision") == crashes
    said = toy.crashhunt("trials", "h", "--format", "parquet", "--out", "t.parquet")
    assert "t.parquet has 12 trials" in said.err
    import polars as pl  # which takes a while, wherever this is not run

    frame = pl.read_parquet(toy.folder / "t.parquet")
    assert frame["number"].to_list() == list(range(12))
    assert frame["ego.speed"].to_list() == [row["ego.speed"] for row in table]
    assert frame["digest"].to_list() == [row["digest"] for row in table]
    toy.crashhunt("trials", "h", "--format", "jsonl", "--out", "t.jsonl")
    assert [json.loads(line) for line in (toy.folder / "t.jsonl").read_text().splitlines()] == table
    for words, says in (
        (("--format", "parquet"), "cannot be printed on a terminal"),
        (("--outcome", "boom"), "--outcome: there is no outcome 'boom'"),
        (("--out", "no/where.csv"), "cannot be written"),
    ):
        assert says in toy.crashhunt("trials", "h", *words, expect=2).err
    assert not list(toy.folder.glob(".*.part"))


def test_what_has_no_crashes_and_what_is_no_hunt(toy, made_once):
    shutil.rmtree(made_once(keeps_going, toy).folder / "h" / "crashes")
    assert toy.crashhunt("crashes", "h").out == "No crash was saved.\n"
    assert toy.crashhunt("crashes", "h", "--json").json == {"groups": [], "left_out": []}
    assert "'h2' does not exist" in toy.crashhunt("crashes", "h2", expect=2).err
