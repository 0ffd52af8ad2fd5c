"""The generators of the process: seeded, noted, and gone on with where they were."""

from __future__ import annotations

import random
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from crashhunt.episode import seed_everything
from crashhunt.executors._warm_traffics import generators, set_generators


def drawn():
    return random.random(), float(np.random.random())  # noqa: NPY002 - agents may use the global generator


@pytest.mark.parametrize("torch", [None, "there"])
def test_all_of_them_continue_where_they_were(monkeypatch, torch):
    told = []
    there = SimpleNamespace(
        manual_seed=lambda seed: told.append(("seed", seed)),
        get_rng_state=lambda: "state",
        set_rng_state=lambda state: told.append(("set", state)),
    )
    monkeypatch.setitem(sys.modules, "torch", there if torch else None)
    seed_everything(5)
    first, state = drawn(), generators()
    second = drawn()
    assert first != second
    set_generators(state)
    assert drawn() == second
    seed_everything(5)
    assert drawn() == first
    seed_everything(6)
    assert drawn() != first
    seeds = [("seed", 5), ("seed", 5), ("seed", 6)]
    assert told == ([seeds[0], ("set", "state"), *seeds[1:]] if torch else [])
