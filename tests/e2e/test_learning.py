"""Hunts with samplers of somebody's own: that learn, that are killed, and that nobody can import any more."""

from __future__ import annotations

import json
import random
import shutil
import sqlite3
import time
from contextlib import closing, suppress
from pathlib import Path

import pytest

from crashhunt.ledger import Ledger

HERE = Path(__file__).parent
HUNT = ("2", "60", "20", "--scenario", "toy", "--seed", "3", "--keep-going", "--crash-on", "hang", "--json")

INDEPENDENT = """
from crashhunt.samplers import RandomSampler


class Mine:
    learns = False
    independent = True

    def __init__(self, space, *, points):
        self._inner = RandomSampler(space)

    def ask(self, number, rng):
        return self._inner.ask(number, rng)

    def tell(self, result):
        raise AssertionError("it does not learn")
"""


@pytest.fixture
def own(toy):
    shutil.copy(HERE.parent / "hunts" / "climber.py", toy.folder / "climber.py")
    (toy.folder / "mine.py").write_text(INDEPENDENT)
    return toy


def trials(hunt):
    """Number to specification and digest of every trial that has ended."""
    with suppress(sqlite3.Error), closing(sqlite3.connect(f"file:{hunt}/ledger.sqlite?mode=ro", uri=True)) as database:
        found = {number: json.loads(text) for number, text in database.execute("SELECT number, result FROM trials")}
        return {number: (data["spec"], data["digest"]) for number, data in found.items()}
    return {}


@pytest.mark.nightly  # by day, hunts/test_next_trials.py kills hunts that learn, without processes
@pytest.mark.parametrize("sampler", ["climber:Climber", "optuna:tpe"])
def test_a_hunt_that_learns_and_is_killed_runs_the_same_trials(own, sampler):
    words = (*HUNT, "--sampler", sampler, "--deterministic")
    own.crashhunt("run", "whole", *words)
    whole = trials(own.folder / "whole")
    assert sorted(whole) == list(range(60))
    assert sum("parent" in spec or spec["origin"] == "optuna" for spec, _ in whole.values()) > 5
    chance = random.Random(5)
    for ends in (chance.randrange(2, 30), chance.randrange(30, 50)):
        process = own.begin("run", "killed", *words, "--set", "step_wall_s=0.002")
        deadline = time.monotonic() + 300
        while len(trials(own.folder / "killed")) < ends:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        process.kill()
        process.communicate()
    own.crashhunt("run", "killed", *words, "--set", "step_wall_s=0.002")
    killed = trials(own.folder / "killed")
    for spec, _ in killed.values():
        assert spec["scenario_arguments"].pop("step_wall_s") == 0.002
    for spec, _ in whole.values():
        assert spec["scenario_arguments"].pop("step_wall_s") == 0.0
    assert killed == whole
    own.crashhunt("check", "killed")


@pytest.mark.nightly  # by day, report/test_page_search.py reads parents and origins
def test_where_trials_come_from_is_in_the_table(own):
    own.crashhunt("run", "h", *HUNT, "--sampler", "climber:Climber")
    head, *lines = own.crashhunt("trials", "h", "--format", "csv").out.splitlines()
    assert head.split(",")[-2:] == ["parent", "origin"]
    assert lines[0].split(",")[-2:] == ["", "draw 0"]
    assert any(line.split(",")[-1].startswith("climb ") and line.split(",")[-2].isdigit() for line in lines)
    own.crashhunt("run", "random", "1", "2", *HUNT[2:])
    assert "parent" not in own.crashhunt("trials", "random", "--format", "csv").out
    own.crashhunt("trials", "h", "--format", "parquet", "--out", "h.parquet")
    import polars as pl

    table = pl.read_parquet(own.folder / "h.parquet")
    assert (table.schema["parent"], table.schema["origin"]) == (pl.Int64, pl.String)


@pytest.mark.nightly
def test_a_damaged_proposal_is_found_and_the_others_are_saved(own):
    words = (*HUNT, "--sampler", "climber:Climber", "--deterministic")
    own.crashhunt("run", "h", *words)
    with closing(sqlite3.connect(own.folder / "h" / "ledger.sqlite")) as database, database:
        (number,) = database.execute("SELECT max(number) FROM proposals WHERE spec LIKE '%climb%'").fetchone()
        database.execute("UPDATE proposals SET spec = replace(spec, 'climb', 'draw') WHERE number = ?", (number,))
    assert (
        f"the proposal of trial {number} has changed since it was written" in own.crashhunt("check", "h", expect=1).out
    )
    assert f"trial {number}" in own.crashhunt("run", "h", *words, expect=2).err
    own.crashhunt("check", "h", "--salvage", "saved", expect=None)
    with closing(sqlite3.connect(own.folder / "saved" / "ledger.sqlite")) as database:
        numbers = {one for (one,) in database.execute("SELECT number FROM proposals")}
    assert numbers == set(range(60)) - {number}
    before = trials(own.folder / "h")
    own.crashhunt("run", "saved", *words)
    assert trials(own.folder / "saved") == before


@pytest.mark.nightly
def test_a_sampler_that_states_so_is_independent_even_when_no_one_can_import_it(own):
    own.crashhunt("run", "mine", *HUNT, "--sampler", "mine:Mine")
    own.crashhunt("run", "random", *HUNT)
    own.crashhunt("run", "old", *HUNT, "--sampler", "climber:Old")
    (own.folder / "mine.py").unlink()
    mine, theirs, old = own.crashhunt("compare", "mine", "random", "old", "--json").json["hunts"]
    assert mine["interval"] == theirs["interval"] is not None
    assert (old["interval"], old["why_not"]) == (None, "the sampler climber:Old does not draw trials independently")
    assert trials(own.folder / "mine") == trials(own.folder / "random") == trials(own.folder / "old")


def test_what_is_wrong_with_a_sampler_is_one_line(own):
    done = own.crashhunt("run", "h", *HUNT[:-1], "--sampler", "climber:Bad", expect=2)
    assert "the sampler 'climber:Bad' fails when it is asked for trial 0: KeyError" in done.err
    assert "climber.py, line" in done.err


@pytest.mark.nightly  # by day, hunts/test_hunt_loop.py writes a missing row
def test_a_crash_without_a_row_gets_one_that_states_where_it_is_from(own):
    words = ("1", "3", "20", "--scenario", "toy", "--agent", "faulty:Raises", "--arg", "at=5", "--keep-going")
    own.crashhunt("run", "h", *words, "--sampler", "climber:Climber")
    before = trials(own.folder / "h")
    assert before[1][0]["origin"] == "draw 0"
    with closing(Ledger(own.folder / "h" / "ledger.sqlite", writable=True)) as ledger:
        assert ledger.replace([1]) == 1
    own.crashhunt("run", "h", *words, "--sampler", "climber:Climber")
    assert trials(own.folder / "h") == before
