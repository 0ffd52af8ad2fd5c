"""From when on an agent was shown the other one."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from crashhunt.crashes import visible_from
from crashhunt.recording import AgentChannel, ObservedPart
from crashhunt.scenario import ObservationSetup
from crashhunt.simulators import Kinematics
from crashhunt.world import Actor, Roster, Scene

ROSTER = Roster(
    tuple(Actor(name, "passenger", length, 2.0) for name, length in (("far", 12.0), ("ego", 5.0), ("a", 4.0)))
)


def recording(*distances, rows=2, noise=1.0, normalize=False, names=None):
    """Of an ego that is shown one other; another one stays 30 m away, and ``far`` comes nearer."""
    kinematics = Kinematics(ObservationSetup(vehicles=rows, normalize=normalize))
    steps, shown = [], None
    for number, distance in enumerate(distances):
        points = [(100.0, 40.0 - distance), (100.0, 40.0), (100.0, 70.0)]
        scene = Scene(0.1 * number, ROSTER, points, [0.5, -1.2, 0.3], [3.0, 17.0, 8.0])
        observations = {} if shown is None else {"ego": shown}
        steps.append(SimpleNamespace(step=number, scene=scene, observations=observations))
        shown = kinematics.observe(scene, 1, distance=5.0, from_left=0.0, lateral_speed=0.0, lanes=1)
        shown = (shown * np.float32(noise)).astype(np.float32)
    names = tuple(kinematics.features) if names is None else names
    agent = AgentChannel("ego", "<f4", (rows, 7), "<f8", (2,), observation_names=names)
    return SimpleNamespace(prologue=SimpleNamespace(agents=[agent]), all_steps=steps)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, 2),
        ({"rows": 3}, 0),
        ({"noise": 1.01}, None),
        ({"normalize": True}, None),
        ({"names": ()}, None),
        ({"names": ("presence", "x")}, None),
    ],
)
def test_it_is_the_first_step_in_whose_observation_it_is(options, expected):
    assert visible_from(recording(200.0, 90.0, 25.0, 20.0, 60.0, 8.0, **options), "ego", "far") == expected


def test_who_is_never_shown_is_not():
    assert visible_from(recording(200.0, 90.0, 50.0), "ego", "far") is None


@pytest.mark.parametrize(("history", "noise", "expected"), [(0, 0.0, 1), (3, 0.0, 1), (0, 0.5, None)])
def test_it_is_known_of_the_part_actors_which_has_places_on_the_map(history, noise, expected):
    steps, shown, columns = [], None, ("present", "x", "y", "speed")
    for number, distance in enumerate((200.0, 25.0, 20.0)):
        scene = Scene(
            0.0, ROSTER, [(100.0, 40.0 - distance), (100.0, 40.0), (100.0, 70.0)], [0.5, -1.2, 0.3], [1.0] * 3
        )
        steps.append(SimpleNamespace(step=number, scene=scene, observations={} if shown is None else {"ego": shown}))
        rows = np.zeros((2, 4))
        for place, row in enumerate([0, 2] if distance < 100.0 else [2]):
            rows[place] = 1.0, *(scene.centers[row] + noise), 1.0
        rows = np.stack([np.zeros((2, 4))] * (history - 1) + [rows]) if history else rows
        shown = np.concatenate((np.full(3, 7.0), rows.ravel()))
    steps.append(SimpleNamespace(step=3, scene=steps[-1].scene, observations={"ego": shown}))
    parts = ObservedPart("a", (3,)), ObservedPart("actors", rows.shape, columns)
    agent = AgentChannel("ego", "<f8", shown.shape, "<f8", (2,), observation_parts=parts)
    found = SimpleNamespace(prologue=SimpleNamespace(agents=[agent]), all_steps=steps)
    assert visible_from(found, "ego", "far") == expected
