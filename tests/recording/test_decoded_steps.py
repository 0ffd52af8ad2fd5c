"""A long recording is decoded in parts at each use, with the same result as a recording that stays decoded."""

from __future__ import annotations

import gc
import struct
from collections import Counter
from dataclasses import replace

import pytest
from conftest import examples
from hypothesis import given, settings, strategies as st

from crashhunt.crashes import Encounter, closest_actors, danger_course
from crashhunt.recording import (
    BlackBox,
    Prologue,
    Recording,
    Tag,
    _recording,
    encode_actors,
    encode_disturbance,
    read_black_box,
)
from crashhunt.recording._blackbox_file import Record, Records
from crashhunt.recording._log import read_log, write_log
from crashhunt.recording.records._scene_record import encode_roster
from crashhunt.trial import Disturbance
from crashhunt.world import Actor, Roster, Scene, join_frames

PROLOGUE = Prologue((), 0.1)
ACTORS = tuple(Actor(name, "car", 5.0, 2.0) for name in ("ego", "ahead", "late", "last"))
STEPS = 75


@pytest.fixture(params=[30, 31], ids=["within a part", "in the step that two parts share"])
def arrival(request):
    """The step at which the third vehicle comes."""
    return request.param


@pytest.fixture
def records(tmp_path, arrival):
    """The ego approaches another vehicle and changes to its lane; a third vehicle comes late, and a fourth later."""
    box = BlackBox(tmp_path / "box")
    box.begin(pid=1, trial=0, started=0.0)
    box.prologue(replace(PROLOGUE).encode(), 0)
    box.append(Tag.ACTORS, 0, encode_actors(ACTORS[:2]))
    roster = Roster(ACTORS[:2])
    box.append(Tag.ROSTER, 0, encode_roster([0, 1]))
    for step in range(STEPS):
        if step in {arrival, arrival + 20}:
            count = len(roster) + 1
            box.append(Tag.ACTORS, 0, encode_actors(ACTORS[count - 1 : count]))
            box.append(Tag.ROSTER, 0, encode_roster([*range(count)]))
            roster = Roster(ACTORS[:count])
        points = [(2.0 * step, min(0.1 * step, 3.2)), (20.0 + 1.8 * step, 3.2), (2.5 * step - 80.0, 3.2), (0.0, 9.0)]
        count = len(roster)
        speeds = [20.0, 18.0, 25.0, 1.0][:count]
        box.step(step, Scene(0.1 * step, roster, points[:count], [0.0] * count, speeds), ())
    box.append(Tag.DISTURBANCE, 0, encode_disturbance(Disturbance(STEPS, "ahead", "brake", 3.0, 1.0)))
    yield read_black_box(tmp_path / "box")
    box.close()


@pytest.fixture
def decoded(monkeypatch):
    """The number of times that each part of a recording was decoded, while only four parts may be kept."""
    found = Counter()
    decode = _recording.DecodedSteps._decode

    def counted(self, number):
        found[number] += 1
        return decode(self, number)

    monkeypatch.setattr(_recording.DecodedSteps, "_decode", counted)
    monkeypatch.setattr(_recording, "_CHUNK_STEPS", 8)
    monkeypatch.setattr(_recording, "_MAX_DECODED_BYTES", 0)
    return found


def everything(recording):
    """All values of the steps of a recording, and of the scene before each."""
    return [
        (
            step.step, step.rewards, step.more,
            scene and (scene.time_s, scene.data.tolist(), scene.roster.actors),
            scene and scene.previous and scene.previous.data.tolist(),
        )
        for step in recording.all_steps
        for scene in [step.scene]
    ]  # fmt: skip


def measured(recording):
    course = danger_course(recording, "ego")
    arrays = course.own.tolist(), course.behind.tolist()
    rest = replace(course, own=None, behind=None)
    return repr((arrays, rest, Encounter(recording, "ego", "ahead").moments, closest_actors(recording, "ego")))


def test_steps_that_are_decoded_at_each_use_are_those_that_are_kept(records, request):
    kept = Recording(records)
    expected, numbers = everything(kept), measured(kept)
    times = [scene.time_s for scene in reversed(kept.scenes()[10:70:7])]
    request.getfixturevalue("decoded")
    long = Recording(records)
    assert everything(long) == expected
    assert measured(long) == numbers
    assert long.actors == kept.actors == [*ACTORS]
    assert (long.steps, len(long.scenes()), len(long.all_steps)) == (STEPS - 1, STEPS, len(kept.all_steps))
    assert long.digest == kept.digest
    assert [scene.time_s for scene in reversed(long.scenes()[10:70:7])] == times


@settings(max_examples=examples(60), deadline=None)
@given(
    presences=st.lists(st.lists(st.integers(0, 7), unique=True, max_size=4), min_size=1, max_size=40),
    size=st.integers(2, 9),
)
def test_parts_of_any_size_name_the_actors_that_come_and_go(presences, size):
    numbers: dict[int, int] = {}
    written = [Record(Tag.PROLOGUE, 0, PROLOGUE.encode())]
    expected = []
    for step, present in enumerate(presences):
        new = [vehicle for vehicle in present if vehicle not in numbers]
        if new:
            numbers.update({vehicle: len(numbers) + place for place, vehicle in enumerate(new)})
            written.append(Record(Tag.ACTORS, 0, encode_actors([Actor(f"v{one}", "car", 5.0, 2.0) for one in new])))
        written.append(Record(Tag.ROSTER, 0, encode_roster([numbers[vehicle] for vehicle in present])))
        values = [float(value) for one in present for value in (one, step)] + [0.0] * 2 * len(present)
        written.append(Record(Tag.STEP, 0, struct.pack(f"<qd{len(values)}d", step, 0.1 * step, *values)))
        expected.append([(f"v{one}", (one, step)) for one in present])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_recording, "_CHUNK_STEPS", size)
        patch.setattr(_recording, "_MAX_DECODED_BYTES", 0)
        recording = Recording(written)
        for scenes in (recording.scenes(), [*reversed(recording.scenes())][::-1]):
            named = [[(a.id, tuple(p)) for a, p in zip(one.roster.actors, one.points, strict=True)] for one in scenes]
            assert named == expected
    assert [actor.id for actor in recording.actors] == [f"v{one}" for one in numbers]


def test_a_short_recording_is_decoded_once(records, decoded, monkeypatch):
    monkeypatch.setattr(_recording, "_MAX_DECODED_BYTES", 64 << 20)
    recording = Recording(records)
    assert recording.scenes()[3] is recording.scenes()[3]
    measured(recording)
    assert set(decoded.values()) == {1}


@pytest.mark.parametrize(
    "use",
    [
        lambda recording: list(recording.all_steps),
        lambda recording: list(recording.scenes()),
        lambda recording: list(reversed(recording.scenes())),
        lambda recording: list(join_frames(recording.scenes())),
        lambda recording: Encounter(recording, "ego", "ahead"),
        lambda recording: recording.disturbances,
    ],
)
def test_a_use_of_all_steps_decodes_each_part_of_a_long_recording_once(records, decoded, use):
    recording = Recording(records)
    assert set(decoded.values()) == {1}, "reading the recording decodes it once"
    decoded.clear()
    recording.scenes()[0]  # so that no part is left that the use below needs first
    recording.scenes()[20], recording.scenes()[30], recording.scenes()[40]
    before = decoded.copy()
    use(recording)
    assert set((decoded - before).values()) == {1}


def test_the_criticality_is_measured_while_the_scenes_pass_once(records, decoded):
    recording = Recording(records)
    decoded.clear()
    danger_course(recording, "ego")
    assert sum(decoded.values()) <= STEPS // 8 + 2, "at most one part more, of the nearest moment"


def test_no_scene_of_a_long_recording_is_kept(records, decoded):
    gc.freeze()  # of other tests in this process; to look through all objects takes a second
    try:
        recording = Recording(records)
        used = (danger_course(recording, "ego"), Encounter(recording, "ego", "ahead"))
        gc.collect()
        alive = sum(isinstance(one, Scene) for one in gc.get_objects())
    finally:
        gc.unfreeze()
    assert used[1].moments
    assert 0 < alive <= 4 * (8 + 1) + 4  # the parts that are kept, each with the scene before it


def test_records_in_the_bytes_of_a_black_box_are_the_records(records):
    listed = list(records)
    assert Records.of(listed) == records == Records.of(iter(records))
    assert (len(records), records[-1], records[2]) == (len(listed), listed[-1], listed[2])
    assert list(records[1:-2]) == listed[1:-2]
    assert list(records.since(5)) == listed[5:]
    assert records[:-1] != records != Records.of([*listed[:-1], Record(Tag.NOTES, 0, b"x")])
    with pytest.raises(IndexError):
        records[len(records)]


def test_a_log_that_is_written_and_read_in_parts_is_the_log(records, request, tmp_path):
    write_log(tmp_path / "kept.mcap", Recording(records))
    request.getfixturevalue("decoded")
    write_log(tmp_path / "long.mcap", Recording(records))
    assert (tmp_path / "long.mcap").read_bytes() == (tmp_path / "kept.mcap").read_bytes()
    assert read_log(tmp_path / "long.mcap").records == records
