"""What a recording gives back of what its records say, and which records make no sense."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.util
import json
import struct

import numpy as np
import pytest
from hypothesis import given, strategies as some

from crashhunt.base.errors import BundleError
from crashhunt.recording import (
    AgentChannel,
    Prologue,
    Recording,
    Tag,
    digest_of,
    encode_actors,
    encode_events,
    encode_heights,
    encode_notes,
    encode_spines,
)
from crashhunt.recording._blackbox_file import Record
from crashhunt.recording._trace_digest import _with_changes_only, changes_of
from crashhunt.world import Actor, Contact, Event, Roster, Scene

AGENTS = (
    AgentChannel("ego", "<f4", (2,), "<f8", (1,), ("speed",), ("a", "b")),
    AgentChannel("b", "<f4", (), "<i8", (2,)),
)
ACTORS = [Actor("ego", "passenger", 5.0, 2.0), Actor("b", "bus", 12.0, 2.5, 3.5), Actor("late", "passenger", 4.0, 2.0)]
PROLOGUE = Prologue(AGENTS, 0.25)
SPINES = {1: ((1.0, 2.0, 3.0), (4.0, 5.0, 6.0), (7.0, 8.0, 9.5)), 0: ((0.5, 0.25, 0.0), (-1.0, -2.0, -3.0))}


def step(number, count=2, time_s=None, rewards=(0.5, -1.5)):
    values = [*rewards, *(100.0 * number + place for place in range(4 * count))]
    time_s = number * 0.25 if time_s is None else time_s
    return Record(Tag.STEP, 0, struct.pack(f"<qd{len(values)}d", number, time_s, *values))


def roster(*numbers):
    return Record(Tag.ROSTER, 0, np.array(numbers, "<u4").tobytes())


def observed(number, *values):
    return Record(Tag.OBSERVATION, number, np.array(values, "<f4").tobytes())


START = [Record(Tag.PROLOGUE, 0, PROLOGUE.encode()), Record(Tag.ACTORS, 0, encode_actors(ACTORS[:2])), roster(0, 1)]


def scene(**more):
    return Scene(0.0, Roster(tuple(ACTORS[:2])), [(0, 0)] * 2, [0, 0], [0, 0], **more)


def test_payloads_give_back_what_they_were_given():
    assert Prologue.decode(PROLOGUE.encode()) == PROLOGUE
    assert json.loads(PROLOGUE.encode())["step_length_s"] == 0.25
    assert json.loads(encode_actors(ACTORS[:2])) == [["ego", "passenger", 5.0, 2.0], ["b", "bus", 12.0, 2.5, 3.5]]
    contact = Contact("ego", "b", "collision", "x_0", 3.0, 1.0)
    assert json.loads(encode_events(scene(contacts=(contact,), off_road=("b",)))) == {
        "contacts": [["ego", "b", "collision", "x_0", 3.0, 1.0]], "off_road": ["b"],
    }  # fmt: skip
    assert digest_of([b"a", b"bc"]) == digest_of([b"abc"]) != digest_of([b"abd"])
    assert len(digest_of([])) == 32


def test_everything_of_a_step_is_in_its_scene():
    contact = Contact("ego", "b", "collision", "x_0", 3.0, 1.0)
    event = Event("teleport", "b", "b was put elsewhere", ("ego",), "x_0", 1.0, 2.0, 3.0)
    whole = scene(contacts=(contact,), off_road=("b",), heights=(1.0, 2.0), grades=(0.1, 0.2), spines=SPINES)
    recording = Recording([
        *START,
        step(0),
        observed(0, 1.5, 2.5),
        Record(Tag.ACTION, 0, np.array([7.0]).tobytes()),
        observed(1, 9.0),
        Record(Tag.ACTION, 1, np.array([3, -4], "<i8").tobytes()),
        Record(Tag.LANES, 0, b"x_0\ny_1"),
        Record(Tag.EVENTS, 0, encode_events(whole)),
        Record(Tag.HEIGHTS, 0, encode_heights(whole)),
        Record(Tag.SPINES, 0, encode_spines(whole)),
        Record(Tag.NOTES, 0, encode_notes([event])),
        step(1),
        Record(Tag.ACTORS, 0, encode_actors(ACTORS[2:])),
        roster(2, 0),
        step(2),
        observed(0, 3.5, 4.5),
    ])  # fmt: skip
    assert recording.agents == ("ego", "b")
    assert (recording.steps, len(recording.all_steps), len(recording.scenes())) == (2, 4, 3)
    first, second, third = recording.scenes()
    assert (first.previous, second.previous, third.previous) == (None, first, second)
    assert (second.time_s, second.points, second.headings, second.speeds) == (
        0.25, [(100, 101), (102, 103)], [104, 105], [106, 107],
    )  # fmt: skip
    assert (second.contacts, second.off_road, second.lanes) == ((contact,), ("b",), ("x_0", "y_1"))
    assert (second.heights, second.grades, second.spines) == ([1, 2], [0.1, 0.2], SPINES)
    assert second.events == (event,)
    for other in (first, third):  # what is said of one step holds for that step
        assert (other.contacts, other.off_road, other.lanes, other.events) == ((), (), (), ())
        assert (other.heights, other.grades, other.spines) == ([], [], {})
    assert [actor.id for actor in third.roster.actors] == ["late", "ego"]
    assert recording.actors == ACTORS
    zero, one, two, rest = recording.all_steps
    assert [each.step for each in recording.all_steps] == [0, 1, 2, 3]
    assert one.rewards == {"ego": 0.5, "b": -1.5}
    assert (zero.observations, zero.actions, two.observations) == ({}, {}, {})
    assert one.observations["ego"].tolist() == [1.5, 2.5]
    assert one.observations["b"].shape == ()
    assert one.actions["b"].tolist() == [3, -4]
    assert (one.whole, rest.whole, rest.scene, rest.observations["ego"].tolist()) == (True, False, None, [3.5, 4.5])
    assert recording.observations("ego").tolist() == [[1.5, 2.5], [3.5, 4.5]]
    assert recording.actions("b").tolist() == [[3, -4]]
    assert recording.actions("b").dtype == np.int64
    for number in (-1, 3, 4):
        with pytest.raises(IndexError, match="the steps 0 to 2"):
            recording.scene(number)
    assert recording.scene(2) is third
    with pytest.raises(BundleError, match="no agent 'c'"):
        recording.actions("c")


def test_without_steps_there_is_a_recording_all_the_same():
    recording = Recording(START[:1])
    assert (recording.steps, list(recording.all_steps), list(recording.scenes())) == (0, [], [])
    assert recording.observations("ego").shape == (0, 2)
    assert recording.actions("b").shape == (0, 2)


# The digest of a trial whose agents observe parts: of the first observation of each agent and the changes since.

compiled = importlib.import_module("_crashhunt_core") if importlib.util.find_spec("_crashhunt_core") else None
words = some.sampled_from([b"\0" * 8, b"\0" * 7 + b"\x80", b"abcdefgh", b"\xff" * 8])  # 0.0, -0.0, a NaN
rows = some.lists(some.tuples(some.integers(0, 1), some.lists(words, max_size=19)), max_size=12)


def records_of(observations):
    prologue = dataclasses.replace(PROLOGUE, digest_of_changes=True)
    between = [Record(Tag.ACTION, 0, b"action"), step(0)]
    seen = [Record(Tag.OBSERVATION, agent, b"".join(row)) for agent, row in observations]
    return [Record(Tag.PROLOGUE, 0, prologue.encode()), *(one for each in seen for one in (each, *between))]


def read_back(hashed, prologue):
    """The observations that follow from what is hashed, with what is in between, read by another program."""
    last, found, place = {}, [], len(prologue.encode())
    while place < len(hashed):
        tag, agent, length = struct.unpack_from("<BxHI", hashed, place)
        place += 8
        words = (length + 7) // 8
        if tag == Tag.OBSERVATION and agent in last and len(last[agent]) == words:
            bits = np.unpackbits(np.frombuffer(hashed, "u1", (words + 7) // 8, place))[:words].astype(bool)
            place += (words + 7) // 8
            values = last[agent].copy()
            values[bits] = np.frombuffer(hashed, "<u8", bits.sum(), place)
            place += 8 * bits.sum()
        else:
            values = np.frombuffer(hashed, "<u8", words, place)
            place += 8 * words
        if tag == Tag.OBSERVATION:
            last[agent] = values
        found.append(Record(tag, agent, values.tobytes()[:length]))
    return found


@given(rows, some.data())
def test_every_observation_follows_from_what_a_digest_of_changes_covers(observations, data):
    records = records_of(observations)
    cuts = sorted(data.draw(some.lists(some.integers(0, len(records)), max_size=2)))
    parts = [
        b"".join(record.encode() for record in records[begin:end])
        for begin, end in zip([0, *cuts], [*cuts, len(records)], strict=True)
    ]
    hashed = b"".join(map(bytes, _with_changes_only(parts, changes_of)))
    assert read_back(hashed, records[0]) == records[1:]
    expected = hashlib.blake2b(hashed, digest_size=16).hexdigest()
    for core in (None, compiled):
        assert digest_of(parts, of_changes=True, core=core) == expected


def test_digest_of_a_recording_follows_its_prologue():
    twice = [observed(0, 1.0, 2.0), step(0), observed(0, 1.0, 3.0), step(1)]
    of_changes = dataclasses.replace(PROLOGUE, digest_of_changes=True)
    for prologue in (PROLOGUE, of_changes):
        records = [Record(Tag.PROLOGUE, 0, prologue.encode()), *START[1:], *twice]
        encoded = [record.encode() for record in records]
        digests = [digest_of(encoded, of_changes=changes) for changes in (False, True)]
        assert (
            Recording(records).digest == digests[prologue.digest_of_changes] != digests[not prologue.digest_of_changes]
        )


def test_a_digest_of_changes_covers_little_of_what_stays():
    same = np.arange(2000.0)
    records = records_of([(0, [(same + 0.5 * (same == number)).tobytes()]) for number in range(20)])
    hashed = b"".join(map(bytes, _with_changes_only([record.encode() for record in records], changes_of)))
    assert len(hashed) < 2000 * 8 + 20 * 500


@pytest.mark.parametrize(
    "records",
    [
        [step(1)],  # the first is 0
        [step(0), step(2)],
        [step(0), step(0)],
        [step(0, count=1)],
        [step(0, count=3)],
        [Record(Tag.STEP, 0, b"short")],
        [Record(Tag.HEIGHTS, 0, np.zeros(3).tobytes()), step(0)],
        [Record(Tag.HEIGHTS, 0, np.zeros(2).tobytes()), step(0)],
        [Record(Tag.SPINES, 0, encode_spines(scene(spines={2: SPINES[1]}))), step(0)],
        [Record(Tag.SPINES, 0, encode_spines(scene(spines={1: SPINES[1]}))[:-3]), step(0)],
        [roster(0, 2), step(0)],
        [observed(2, 1.0, 2.0)],
        [observed(0, 1.0)],
        [Record(Tag.EVENTS, 0, b"{"), step(0)],
        [Record(Tag.EVENTS, 0, b'{"contacts": [[1]]}'), step(0)],
        [Record(Tag.ACTORS, 0, b"[[1]]")],
    ],
)
def test_records_that_make_no_sense_are_refused(records):
    with pytest.raises(BundleError, match="damaged") as caught:
        Recording([*START, *records])
    assert caught.value.fix


def test_a_beginning_is_asked_for():
    for records in ([], START[1:], [step(0)]):
        with pytest.raises(BundleError, match="no beginning"):
            Recording(records)
    assert dataclasses.replace(AGENTS[0], id="x").id == "x"
