"""Recorded paths."""

from __future__ import annotations

import base64
import json
import math
import zlib

import pytest

from crashhunt.world import Actor, ActorState, Paths, Roster, Scene, paths_of

EGO, LEFT, BUS = Actor("ego", "passenger", 5.0, 1.8), Actor("left.1", "truck", 7.1, 2.4), Actor("bus", "bus", 14.0, 2.5)
SPINE = ((1 / 3, 0.1, 0.0), (-13.0, 0.2, 0.5))


def scenes():
    """Five scenes: ego in all, the truck away in the middle, the bus from the second one on."""
    made = []
    for step, actors in enumerate(([EGO, LEFT], [EGO, LEFT, BUS], [BUS, EGO], [LEFT, EGO], [EGO, LEFT])):
        points = [(len(actor.id) + step / 3, step * 0.1) for actor in actors]
        lanes = tuple(f"{actor.id}_{step}" for actor in actors) if step % 2 == 0 else ()
        spines = {actors.index(BUS): SPINE} if BUS in actors else {}
        made.append(
            Scene(7.5 + step / 10, Roster(tuple(actors)), points, [math.pi / 7] * len(actors), [step / 7] * len(actors),
                  lanes=lanes, spines=spines, heights=[step * 1.1] * len(actors), grades=[0.01] * len(actors))
        )  # fmt: skip
    return made


def test_everybody_is_where_it_was_and_who_comes_back_has_two_paths():
    found = paths_of(scenes(), ("ego",))
    assert (found.time_s, found.steps, found.names) == (7.5, 4, ("left.1", "bus"))
    assert [(path.actor, path.first, path.last) for path in (*found.agents, *found.others)] == [
        (EGO, 0, 4), (LEFT, 0, 1), (BUS, 1, 2), (LEFT, 3, 4),
    ]  # fmt: skip
    assert found.agents[0].states[3] == ActorState(3 + 3 / 3, 3 * 0.1, math.pi / 7, 3 / 7, 3.3000000000000003, 0.01)
    assert found.agents[0].lanes == ((0, "ego_0"), (2, "ego_2"), (4, "ego_4"))
    assert found.others[1].spines == ((1, SPINE), (2, SPINE))
    assert found.only(["bus"]).names == ("bus",)
    assert found.driven_by(()).names == ("ego", "left.1", "bus")
    assert found.driven_by(()).agents == ()
    assert found.driven_by(("ego",)) == found


def test_they_come_back_from_json_bit_by_bit():
    found = paths_of(scenes(), ("ego",))
    assert Paths.from_json(json.loads(json.dumps(found.to_json()))) == found
    flat = paths_of([Scene(0.0, Roster((EGO,)), [(0.1, 0.2)], [0.3], [0.4])], ())
    assert Paths.from_json(flat.to_json()) == flat
    plain = json.dumps([[[["ego", "car", 4.0, 2.0], 0, [], [], []]], []])
    nowhere = base64.b64encode(zlib.compress(plain.encode())).decode()
    for wrong in ({"packed": "?"}, {"packed": "QUJD"}, {"steps": "x"}, {"steps": 1e999}, {"packed": nowhere}, {}):
        with pytest.raises(ValueError, match="damaged"):
            Paths.from_json({**found.to_json(), **wrong} if wrong else {})


def test_what_is_cut_counts_from_there():
    found = paths_of(scenes(), ("ego",)).cut(2, 3, 0.1)
    assert (found.time_s, found.steps, found.names) == (7.7, 1, ("bus", "left.1"))
    (ego,), (bus, left) = found.agents, found.others
    assert (ego.first, ego.last, ego.lanes) == (0, 1, ((0, "ego_2"),))
    assert (bus.first, bus.last, bus.spines) == (0, 0, ((0, SPINE),))
    assert (left.first, left.last) == (1, 1)
    assert paths_of(scenes(), ("ego",)).cut(3, 9, 0.1).agents[0].lanes == ((0, "ego_2"), (1, "ego_4"))
    assert [path.states for path in found.placing().agents] == [ego.states[:1]]
