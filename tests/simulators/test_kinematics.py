"""The Kinematics observation, each column from the geometry of a scene."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from crashhunt.scenario import ObservationSetup
from crashhunt.simulators import Kinematics
from crashhunt.simulators._kinematics_observation import Unseen
from crashhunt.world import Actor, Roster, Scene

COLUMNS = ("presence", "x", "y", "vx", "vy", "heading", "cos_h", "sin_h", "kind")


def scene_of(*rows):
    """A scene with an agent and others: front bumper, heading, speed, length and kind."""
    actors = tuple(Actor(f"a{number}", row[5], row[4], 2.0, 1.5) for number, row in enumerate(rows))
    return Scene(0.0, Roster(actors), [row[:2] for row in rows], [row[2] for row in rows], [row[3] for row in rows])


def seen(scene, *, vehicles=4, features=COLUMNS, normalize=False, row=0, lanes=3, hidden=()):
    kinematics = Kinematics(ObservationSetup(vehicles=vehicles, features=features, normalize=normalize))
    kinematics.hidden |= set(hidden)
    shown = kinematics.observe(scene, row, distance=30.0, from_left=3.5, lateral_speed=-0.5, lanes=lanes)
    assert (shown.shape, shown.dtype) == ((vehicles, len(features)), np.float32)
    assert kinematics.space.contains(shown)
    return shown


@pytest.mark.parametrize("turn", [0.0, 0.7, math.pi / 2, -2.5])
def test_columns_are_seen_from_the_agents_centre(turn):
    """Others are relative: x ahead, y to the right, velocity and heading, which grow clockwise."""
    c, s = math.cos(turn), math.sin(turn)
    ahead, right, angle = 20.0, 3.0, 0.4  # of the other's centre; it points to the right
    heading = turn - angle
    x, y = 5.0 - 2.0 * c + ahead * c + right * s, 7.0 - 2.0 * s + ahead * s - right * c
    other = (x + 3.0 * math.cos(heading), y + 3.0 * math.sin(heading), heading, 12.0, 6.0, "truck")
    own, them, *empty = seen(scene_of((5.0, 7.0, turn, 10.0, 4.0, "passenger"), other))
    assert own == pytest.approx([1, 30.0, 3.5, 10.0, -0.5, -turn, c, -s, 1], abs=1e-5)
    velocity = (12.0 * math.cos(angle) - 10.0, 12.0 * math.sin(angle))
    expected = [1, ahead, right, *velocity, angle, math.cos(angle), math.sin(angle), 1]
    assert them == pytest.approx(expected, abs=1e-4)
    assert not np.any(empty)
    usual = seen(scene_of((5.0, 7.0, turn, 10.0, 4.0, "passenger"), other), features=(*COLUMNS[:5], *COLUMNS[6:8]))
    assert usual[1] == pytest.approx([*expected[:5], *expected[6:8]], abs=1e-4)
    assert usual[0] == pytest.approx([1, 30.0, 3.5, 10.0, -0.5, c, -s], abs=1e-5)
    from_there = seen(scene_of(other, (5.0, 7.0, turn, 10.0, 4.0, "passenger")), row=1)
    assert from_there[1] == pytest.approx(expected, abs=1e-4)


def test_values_are_scaled_by_the_ranges_of_highway_env_and_clipped():
    scene = scene_of((0.0, 0.0, 0.0, 40.0, 4.0, "passenger"), (102.0, -3.0, 0.0, 20.0, 4.0, "tram"),
                     (-399.0, 30.0, math.pi, 79.0, 4.0, "bicycle"))  # fmt: skip
    own, near, far = seen(scene, vehicles=3, normalize=True, lanes=3)
    assert own == pytest.approx([1, 30 / 200, 3.5 / 12, 40 / 80, -0.5 / 80, 0, 1, 0, 0.2])
    assert near == pytest.approx([1, 102 / 200, 3 / 12, -20 / 80, 0, 0, 1, 0, 0.8])
    assert far[[1, 2, 3]].tolist() == [-1.0, -1.0, -1.0]
    assert abs(far[5]) == pytest.approx(math.pi)
    assert seen(scene, vehicles=2, normalize=True, lanes=0)[0, 2] == pytest.approx(3.5 / 4)
    assert seen(scene, vehicles=2, normalize=True, lanes=1)[0, 2] == pytest.approx(3.5 / 4)


@pytest.mark.parametrize(
    ("kind", "number"),
    [("passenger", 1), ("IDMVehicle", 1), ("bicycle", 2), ("motorcycle", 2), ("moped", 2), ("scooter", 2),
     ("pedestrian", 3), ("wheelchair", 3), ("tram", 4), ("rail_fast", 4), ("Obstacle", 5), ("Landmark", 5)],
)  # fmt: skip
def test_kind_is_a_number(kind, number):
    scene = scene_of((0.0, 0.0, 0.0, 1.0, 4.0, kind), (9.0, 0.0, 0.0, 1.0, 4.0, kind))
    assert seen(scene, vehicles=2, features=("kind",)).ravel().tolist() == [number, number]


def test_nearest_actors_are_shown_except_hidden_ones_and_those_on_another_level():
    rows = [
        (0.0, 0.0, 0.0, 1.0, 4.0, "passenger"),
        *((x, 0.0, 0.0, 1.0, 4.0, "passenger") for x in (40.0, 20.0, -30.0)),
    ]
    assert seen(scene_of(*rows), features=("x",)).ravel().tolist() == [30.0, 20.0, -30.0, 40.0]
    assert seen(scene_of(*rows), vehicles=3, features=("x",)).ravel().tolist() == [30.0, 20.0, -30.0]
    hidden = [("a0", "a2"), ("a1", "a3")]
    assert seen(scene_of(*rows), features=("x",), hidden=hidden).ravel().tolist() == [30.0, -30.0, 40.0, 0.0]
    scene = scene_of(*rows)
    scene.heights, scene.grades = (0.0, 0.0, 0.0, 9.0), (0.0,) * 4
    assert seen(scene, features=("x",)).ravel().tolist() == [30.0, 20.0, 40.0, 0.0]
    assert seen(scene_of(rows[0]), vehicles=1, features=("x",)).tolist() == [[30.0]]


@pytest.mark.parametrize(
    ("setup", "usual"),
    [
        ({}, True),
        ({"normalize": True}, False),
        ({"features": COLUMNS}, False),
        ({"features": ("presence", "x")}, False),
    ],
)
def test_core_observes_only_the_usual_columns(setup, usual):
    made = Kinematics(ObservationSetup(vehicles=3, **setup))
    assert made.usual is usual
    scene = scene_of((0.0, 0.0, 0.0, 1.0, 4.0, "passenger"))
    asked, given = [], np.arange(made.shape[0] * made.shape[1], dtype="<f4")

    def shown():
        asked.clear()
        return made.observe(scene, 0, distance=1.0, from_left=2.0, lateral_speed=3.0, lanes=1)

    plain = shown()
    scene.core = SimpleNamespace(observe=lambda *words: asked.append(words) or answer)
    scene.columns = "columns"
    answer = given.tobytes()
    assert (shown() == (given.reshape(made.shape) if usual else plain)).all()
    assert asked == ([("columns", 0, 2, 1.0, 2.0, 3.0)] if usual else [])
    answer = None  # the core leaves it to Python
    assert (shown() == plain).all()
    made.hidden.add(("a0", "x"))
    assert (shown() == plain).all()
    assert asked == []


def test_space_has_bounds_that_no_simulation_reaches():
    space = Kinematics(ObservationSetup(vehicles=2, features=COLUMNS)).space
    high = dict(zip(COLUMNS, space.high[1].tolist(), strict=True))
    assert high == {"presence": 1.0, "x": 1e6, "y": 1e6, "vx": 1e3, "vy": 1e3, "heading": pytest.approx(math.pi),
                    "cos_h": 1.0, "sin_h": 1.0, "kind": 5.0}  # fmt: skip
    assert space.shape == (2, 9)
    assert space.low[0].tolist() == [0.0, *(-space.high[0, 1:8]).tolist(), 0.0]
    scaled = Kinematics(ObservationSetup(vehicles=2, features=COLUMNS, normalize=True)).space
    assert [value for name, value in zip(COLUMNS, scaled.high[0], strict=True) if name != "heading"] == [1.0] * 8
    blank = Kinematics(ObservationSetup(vehicles=2, features=COLUMNS)).blank()
    assert (blank.shape, blank.dtype, blank.any()) == ((2, 9), np.float32, np.False_)


def test_vehicle_is_hidden_from_one_agent_until_the_end():
    made = Kinematics(ObservationSetup())
    hides = [Unseen(made, agent, "x") for agent in ("a", "b")]
    assert (made.hidden, hides[0].how_strong) == ({("a", "x"), ("b", "x")}, 1.0)
    hides[0].keep()
    hides[0].end()
    hides[0].end()
    assert made.hidden == {("b", "x")}
