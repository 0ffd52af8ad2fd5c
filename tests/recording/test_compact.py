"""A recording without far actors: what is left agrees with the whole one, and the digest decides about the rest."""

from __future__ import annotations

import numpy as np
import pytest
from test_compare import ACTORS, AGENTS, SPINE

from crashhunt.recording import (
    Prologue,
    Recording,
    Tag,
    encode_actors,
    encode_heights,
    encode_spines,
    first_divergence,
    has_same_scenes,
    read_log,
    write_log,
)
from crashhunt.recording._blackbox_file import Record
from crashhunt.recording.records._scene_record import encode_lanes, encode_roster
from crashhunt.world import Actor, Roster, Scene

FAR = Actor("far", "bus", 18.0, 2.5)


def recorded(changed=None, steps=4):
    """Four actors from step 2 on, the last of them 500 m away until step 3; one value may be changed."""
    records = [Record(Tag.PROLOGUE, 0, Prologue(AGENTS, 0.5).encode())]
    here = ()
    for step in range(steps + 1):
        there = (FAR, *ACTORS) if step >= 2 else ACTORS
        if there != here:
            numbers = [3, 0, 1, 2] if FAR in there else [0, 1, 2]
            new = ACTORS if not here else (FAR,)
            records += [Record(Tag.ACTORS, 0, encode_actors(new)), Record(Tag.ROSTER, 0, encode_roster(numbers))]
            here = there
        if step:
            for number, shape in ((0, 4), (1, 3)):
                records.append(Record(Tag.OBSERVATION, number, (np.arange(shape, dtype="<f4") + step).tobytes()))
                records.append(Record(Tag.ACTION, number, np.array([1.0, 0.0][: 2 - number]).tobytes()))
        points = [(0.0, step), (5.0, step), (12.0, step)]
        points = [(8.0 if step == 4 else 500.0, step), *points] if FAR in there else points
        values = np.array([*np.array(points, float).ravel(), *range(2 * len(there))], float)
        if changed is not None and changed[0] == step:
            values[changed[1]] += 1e-9
        row = len(there) - 1
        scene = Scene(step / 2, Roster(there), points, [0] * len(there), [0] * len(there),
                      heights=tuple(map(float, range(len(there)))), grades=(0.5,) * len(there),
                      spines={0: SPINE, row: SPINE[::-1]})  # fmt: skip
        lanes = [f"lane_{actor.id}" for actor in there]
        records.append(Record(Tag.LANES, 0, encode_lanes(lanes)))
        records.append(Record(Tag.HEIGHTS, 0, encode_heights(scene)))
        records.append(Record(Tag.SPINES, 0, encode_spines(scene)))
        head = np.array([step], "<i8").tobytes() + np.array([step / 2, 0.25, -0.5], "<f8").tobytes()
        records.append(Record(Tag.STEP, 0, head + values.tobytes()))
    return Recording(records)


def small(observations=True):
    return recorded().compacted(("bus",), 10.0, observations=observations)


def test_what_is_left_has_the_values_of_the_whole(tmp_path):
    whole = recorded()
    write_log(tmp_path / "log.mcap", small(), views=False)
    write_log(tmp_path / "whole.mcap", whole, views=False)
    found = read_log(tmp_path / "log.mcap")
    assert found.digest == whole.digest
    assert found.compact == small().compact
    assert (found.compact.actors, found.compact.radius_m, read_log(tmp_path / "whole.mcap").compact) == (4, 10.0, None)
    for step, (left, right) in enumerate(zip(whole.scenes(), found.scenes(), strict=True)):
        kept = [actor.id for actor in left.roster.actors if actor.id != "far" or step == 4]
        assert [actor.id for actor in right.roster.actors] == kept
        for name in kept:
            row, here = left.roster.index[name], right.roster.index[name]
            assert left.roster.actors[row] == right.roster.actors[here]
            assert left.data[row].tobytes() == right.data[here].tobytes()
            assert (left.heights[row], left.lanes[row]) == (right.heights[here], right.lanes[here])
            assert left.spines.get(row) == right.spines.get(here)
    assert found.actions("ego").tobytes() == whole.actions("ego").tobytes()
    assert len(small(observations=False).observations("ego")) == 0


@pytest.mark.parametrize("observations", [True, False])
def test_a_replay_is_compared_with_what_is_left_and_by_its_digest(observations):
    was = small(observations)
    assert first_divergence(was, recorded()) is None
    near = first_divergence(was, recorded((3, 2)))  # of ego
    assert (near.step, near.agent, near.field) == (3, "ego", "scene.x")
    far = first_divergence(was, recorded((3, 0)))  # of an actor that is not left there
    assert (far.step, far.field, far.recorded) == (4, "digest", recorded().digest)
    late = first_divergence(was, recorded((4, 0)))
    assert (late.step, late.agent, late.field) == (4, "far", "scene.x")
    assert first_divergence(was, recorded(steps=3)).field == "length"
    assert has_same_scenes(was, recorded((4, 2)), 3)
    assert not has_same_scenes(was, recorded((3, 2)), 3)


def test_the_beginning_of_one_is_compared_by_what_is_left():
    was, now = small(), recorded()
    ends = [[number for number, record in enumerate(one.records) if record.tag == Tag.STEP] for one in (was, now)]
    first = [one.beginning(end[2] + 1) for one, end in zip((was, now), ends, strict=True)]
    assert [one.steps for one in first] == [2, 2]
    assert first_divergence(*first) is None
    other = recorded((2, 2))
    assert first_divergence(first[0], other.beginning(ends[1][2] + 1)).field == "scene.x"


def test_a_compact_recording_is_compared_with_another_as_it_is():
    assert first_divergence(small(), small()) is None
    assert recorded().like(recorded()) is not None
    assert small().like(small()).compact == small().compact
