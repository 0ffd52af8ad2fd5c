"""Hunts with samplers of somebody's own: that learn, that are killed, and that nobody can import any more."""

from __future__ import annotations

import shutil
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


def test_what_is_wrong_with_a_sampler_is_one_line(own):
    done = own.crashhunt("run", "h", *HUNT[:-1], "--sampler", "climber:Bad", expect=2)
    assert "the sampler 'climber:Bad' fails when it is asked for trial 0: KeyError" in done.err
    assert "climber.py, line" in done.err
