"""Crashes to hand on, made by hand."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import subprocess
from pathlib import Path

import pytest
from episodes import Episode, write

from crashhunt.base import layout
from crashhunt.crashes import write_bundle
from crashhunt.recording import Recording, read_black_box
from crashhunt.trial import Collision, Outcome, TrialResult, TrialSpec
from crashhunt.world import Lane, paths_of

_INTERPRETER = os.environ.get("CRASHHUNT_READERS", "")
readers = pytest.mark.skipif(
    not _INTERPRETER, reason="scripts/tools/readers runs it, with the libraries of the formats"
)
AGENTS = ["ego", 'odd name/§ #1 <&"--->', "日本"]
LANES = [
    Lane("in_0", 3.0, ((-90.0, 0.0), (0.0, 0.0), (0.0, 0.0), (30.0, 5.0))),
    Lane("left_0", 3.5, ((30.0, 5.0), (60.0, 20.0))),
    Lane("right_0", 3.5, ((30.0, 5.0), (60.0, -5.0))),
    Lane("across_0", 3.0, ((30.0, 5.0), (50.0, -25.0))),
    Lane("point_0", 3.0, ((60.0, 20.0), (60.0, 20.0))),
]


def crash(directory, *, steps=16, seed=1, agents=AGENTS, lanes=LANES):
    """A bundle of a made-up episode in which others come and go; every third seed has hills."""
    result = TrialResult(
        TrialSpec(7, 1, {}, {}, max_steps=100),
        Outcome.COLLISION,
        steps=steps,
        collision=Collision(agents[0], "collider", agents[0], "car 0", ("overlap",), "collision", 1.0, 2.0),
    )
    scratch = directory / "scratch"
    scratch.mkdir(parents=True)
    write(Episode(list(agents), steps, seed), scratch / layout.BLACK_BOX)
    result = dataclasses.replace(result, digest=Recording(read_black_box(scratch / layout.BLACK_BOX)).digest)
    return write_bundle(directory, result, scratch, hunt_seed=5, snapshot="abc", lanes=lanes)


def recorded_paths(bundle):
    """The ways of agents and others, as they were recorded."""
    recording = bundle.recording()
    return paths_of(recording.scenes(), recording.agents)


def middles(path):
    """Where the middle of an actor was, by step: recorded is the middle of its front."""
    half = path.actor.length / 2
    return {
        step: (state.x - half * math.cos(state.heading), state.y - half * math.sin(state.heading))
        for step, state in enumerate(path.states, path.first)
    }


def read_back(form, file):
    """What the library of a format has understood of a file."""
    words = [_INTERPRETER, str(Path(__file__).with_name("reading.py")), form, str(file)]
    return json.loads(subprocess.run(words, check=True, capture_output=True, text=True).stdout)
