"""Hunts with samplers of somebody's own: that learn, that are killed, and that nobody can import any more."""

from __future__ import annotations

import json
import shutil
import sqlite3
from contextlib import closing, suppress
from pathlib import Path

import pytest

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
