"""Which seeds the runs of a suite have."""

from __future__ import annotations

import numpy as np

from crashhunt.base import layout
from crashhunt.suites import RunRequest, Suite

TWO = """
[defaults]
scenario = "loop"
[[hunts]]
id = "a"
seed = 3
runs = 3
[[hunts]]
id = "b"
seed = 3
runs = 2
arguments = { speed = 4 }
[[hunts]]
id = "drawn"
runs = 2
"""


def seeds(folder, text, directory="out"):
    (folder / "suite.toml").write_text(text, encoding="utf-8")
    planned = Suite.read(folder / "suite.toml").plan(folder / directory)
    read = {
        place.relative_to(folder / directory).as_posix(): RunRequest.read(place / layout.REQUEST) for place in planned
    }
    return {name: request.request.seed for name, request in read.items()}


def test_a_runs_seed_is_drawn_from_its_hunts_and_its_number_alone(tmp_path):
    found = seeds(tmp_path, TWO)
    for name in ("a/0", "a/1", "a/2", "b/0", "b/1"):
        number = int(name[-1])
        assert found[name] == np.random.SeedSequence(3, spawn_key=(number,)).generate_state(1)[0]
    assert len(set(found.values())) == 3 + 2  # those of `a` and `b` are the same, run by run
    assert seeds(tmp_path, TWO) == found  # what was drawn is kept
    head, *hunts = TWO.split("[[hunts]]")
    other = seeds(tmp_path, "[[hunts]]".join([head, *reversed(hunts)]), "other")
    assert all(other[name] == found[name] for name in found if name[0] in "ab")
    assert other["drawn/0"] != found["drawn/0"]
