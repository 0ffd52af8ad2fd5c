"""Oracles of others, chosen on the command line: their outcomes, from the hunt to the report."""

from __future__ import annotations

import json

import pytest

OWN = """
from crashhunt.oracles import Finding
from crashhunt.trial import Outcome
from crashhunt.world import Event

class Fast:
    '''Sees who drives too fast, from the second step on.'''

    name = "fast"
    outcomes = {"too_fast": "traffic crash"}

    def __init__(self, above: float = 5.0) -> None:
        self.above, self.steps, self.map = above, 0, None

    def see_map(self, lanes):
        self.map = lanes

    def check(self, scene, agents):
        self.steps += scene.previous is not None
        row = scene.roster.index["ego"]
        if self.steps < 2 or scene.speeds[row] <= self.above:
            return []
        what = f"ego: {scene.speeds[row]:.0f} m/s on {len(self.map)} lanes, {self.steps} steps after it began"
        return [Finding(Outcome("too_fast"), event=Event("too_fast", "ego", what))]
"""


@pytest.fixture
def own(toy):
    (toy.folder / "own.py").write_text(OWN)
    return toy


def run(own, *words, name="h", trials="40"):
    options = ("--scenario", "toy", "--seed", "1", "--no-snapshot", "--json")
    return own.crashhunt("run", name, "1", trials, "60", *options, *words).json


def test_a_hunt_stops_on_what_an_oracle_of_ones_own_sees(own):
    done = run(own, "--oracle", "own:Fast:above=8", "--arg", "speed=10:14", "--keep-going", trials="2")
    assert done["outcomes"]["too_fast"] == sum(crash["outcome"] == "too_fast" for crash in done["crashes"]) > 1
    crash = next(crash for crash in done["crashes"] if crash["outcome"] == "too_fast")
    assert crash["confirmed"] is True
    told = json.loads((own.folder / "h" / "crashes" / crash["id"] / "crash.json").read_text())
    assert told["category"] == "traffic crash"
    # Made anew for every trial, it counts from 1 in each, whichever worker ran it.
    assert {"2 steps after it began" in told["summary"]} == {True}
    assert own.crashhunt("replay", "h", "--crash", crash["id"], "--json").json["verdict"] == "reproduced"
    assert "(traffic crash)" in own.crashhunt("show", "h", "--crash", crash["id"]).out
    rows = own.crashhunt("trials", "h", "--outcome", "too_fast").out.splitlines()
    assert len(rows) == 1 + done["outcomes"]["too_fast"]
    assert f"too_fast {done['outcomes']['too_fast']}" in own.crashhunt("status", "h").out
    own.crashhunt("report", "h")
    assert '"categories": {' in (page := (own.folder / "h" / "report.html").read_text())
    assert '"too_fast": "traffic crash"' in page
    assert own.crashhunt("check", "h").code == 0
