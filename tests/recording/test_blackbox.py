"""The bytes of the black box, and what its header says at every moment."""

from __future__ import annotations

import errno
import mmap
import struct

import numpy as np
import pytest

from crashhunt.base.errors import BundleError, RecorderError
from crashhunt.recording import BlackBox, BlackBoxFile, Phase, Tag, read_black_box, read_header
from crashhunt.recording._blackbox_file import Record, Records
from crashhunt.world import Actor, Roster, Scene

ROSTER = Roster((Actor("ego", "passenger", 5.0, 2.0), Actor("other", "passenger", 5.0, 2.0)))


def scene(time_s, roster=ROSTER, **more):
    rows = range(len(roster))
    points = [(time_s + row, time_s - row) for row in rows]
    return Scene(time_s, roster, points, [0.1 * row for row in rows], [5.0 + row for row in rows], **more)


@pytest.fixture
def box(tmp_path):
    box = BlackBox(tmp_path / "box")
    box.begin(pid=42, trial=7, started=12.5)
    yield box
    box.close()


def header(tmp_path):
    found = read_header(tmp_path / "box")
    return found.step, found.phase, found.agent


def test_the_header_states_where_the_process_is(box, tmp_path):
    found = read_header(tmp_path / "box")
    assert (found.pid, found.trial, found.started, found.committed) == (42, 7, 12.5, 64)
    assert header(tmp_path) == (0, Phase.SETUP, 0)
    box.prologue(b"p", 2)
    assert header(tmp_path) == (0, Phase.SETUP, 0)
    assert read_header(tmp_path / "box").committed == 64 + 16
    box.append(Tag.ROSTER, 0, b"12345678")
    assert read_header(tmp_path / "box").committed == 64 + 16 + 16
    assert header(tmp_path) == (0, Phase.SETUP, 0)
    box.step(0, scene(0.0), (0.0, 0.0))
    assert header(tmp_path) == (0, Phase.SIMULATE, 0)
    box.observation(1, np.zeros(3, "<f4"))
    assert header(tmp_path) == (0, Phase.ACT, 1)
    box.action(1, np.zeros(2, "<f8"))
    assert header(tmp_path) == (0, Phase.SIMULATE, 1)
    box.append(Tag.LANES, 0, b"a\nb")
    assert header(tmp_path) == (0, Phase.SIMULATE, 0)
    box.step(1, scene(0.5), (0.0, 0.0))
    assert header(tmp_path) == (1, Phase.SIMULATE, 0)
    box.mark(Phase.ACT, 3)
    assert header(tmp_path) == (1, Phase.ACT, 3)
    box.mark(Phase.DONE)
    assert header(tmp_path) == (1, Phase.DONE, 0)
    assert read_header(tmp_path / "box").committed == 64 + len(box.committed())
    box.begin(pid=43, trial=8, started=0.0)
    assert header(tmp_path) == (0, Phase.SETUP, 0)
    assert read_header(tmp_path / "box").committed == 64
    box.append(Tag.LANES, 0, b"a")
    assert header(tmp_path) == (0, Phase.SETUP, 0)  # no scene has been seen yet


def test_every_record_is_read_as_it_was_written(box, tmp_path):
    box.prologue(b"twelve bytes", 1)
    observation, action = np.array([1.5, -2.5, 3.5], "<f4"), np.array([3], "|u1")
    box.observation(0, observation)
    box.action(3, action)
    box.step(4, scene(2.0), (0.75,))
    box.append(Tag.LANES, 9, b"")
    expected = [
        Record(Tag.PROLOGUE, 0, b"twelve bytes"),
        Record(Tag.OBSERVATION, 0, observation.tobytes()),
        Record(Tag.ACTION, 3, b"\3"),
        Record(Tag.STEP, 0, struct.pack("<qd9d", 4, 2.0, 0.75, 2, 2, 3, 1, 0, 0.1, 5, 6)),
        Record(Tag.LANES, 9, b""),
    ]
    assert list(read_black_box(tmp_path / "box")) == expected
    assert bytes(box.committed()) == b"".join(record.encode() for record in expected)
    assert expected[0].encode() == struct.pack("<BBHI", 1, 0, 0, 12) + b"twelve bytes" + bytes(4)
    assert expected[4].encode() == struct.pack("<BBHI", 7, 0, 9, 0)
    # What lay there before a shorter record leaves no trace in its padding.
    box.begin(pid=1, trial=1, started=0.0)
    box.append(Tag.LANES, 0, b"x" * 15)
    box.begin(pid=1, trial=1, started=0.0)
    box.append(Tag.LANES, 0, b"y")
    assert bytes(box.committed())[8:] == b"y" + bytes(7)
    box.begin(pid=1, trial=1, started=0.0)
    box.append(Tag.LANES, 0, b"x" * 40)
    box.begin(pid=1, trial=1, started=0.0)
    box.observation(0, np.array([1, 2, 3], "|u1"))
    assert bytes(box.committed())[8:] == b"\1\2\3" + bytes(5)


def test_the_numbers_on_disk_stay_what_they_are():
    """Digests run over them, and logs that were written before have them."""
    assert [(tag.name, tag.value) for tag in Tag] == [
        ("PROLOGUE", 1), ("ACTORS", 2), ("ROSTER", 3), ("OBSERVATION", 4), ("ACTION", 5), ("STEP", 6), ("LANES", 7),
        ("EVENTS", 8), ("HEIGHTS", 9), ("SPINES", 10), ("NOTES", 11), ("DISTURBANCE", 12),
    ]  # fmt: skip
    assert [(phase.name, phase.value) for phase in Phase] == [("SETUP", 0), ("ACT", 1), ("SIMULATE", 2), ("DONE", 3)]


def test_an_incomplete_record_is_excluded():
    whole = Record(Tag.LANES, 0, b"12345").encode() + Record(Tag.EVENTS, 1, b"{}").encode()
    assert [record.tag for record in Records(whole)] == [Tag.LANES, Tag.EVENTS]
    assert [record.tag for record in Records(whole[:-6])] == [Tag.LANES, Tag.EVENTS]  # without its padding
    for size in (16, 17, 23, 24, 25):
        assert [record.tag for record in Records(whole[:size])] == [Tag.LANES]
    assert list(Records(b"")) == list(Records(bytes(64))) == []
    assert [record.tag for record in Records(whole[:16] + bytes(16) + whole[16:])] == [Tag.LANES]


def test_notes_are_no_part_of_the_evidence(box):
    box.prologue(b"p", 0)
    begun = bytes(box.committed())
    box.note(b"[1]")
    box.append(Tag.LANES, 0, b"a")
    box.note(b"[2]")
    box.note(b"[3]")
    lanes = Record(Tag.LANES, 0, b"a").encode()
    assert b"".join(box.evidence()) == begun + lanes
    assert len(bytes(box.committed())) == len(begun + lanes) + 3 * 16
    assert {record.aux for record in Records(bytes(box.committed()))} == {0}
    box.append(Tag.LANES, 0, b"a")
    assert b"".join(box.evidence()) == begun + 2 * lanes
    box.begin(pid=1, trial=1, started=0.0)
    box.append(Tag.LANES, 0, b"a")
    assert b"".join(box.evidence()) == lanes


def test_scenes_are_taken_once_as_columns(box):
    alone = Roster(ROSTER.actors[:1])
    box.prologue(b"p", 1)
    high = scene(2.0, heights=(1.0, 2.0), grades=(0.1, 0.2))
    for step, view in enumerate([scene(0.0), scene(1.0), high, scene(3.0, alone), scene(4.0)]):
        box.step(step, view, (float(step),))
    first, second, third = box.take_frames()
    assert first.columns.tolist() == [
        [time, time, time + 1, time - 1, 0, 0.1, 5, 6] for time in (0.0, 1.0, 2.0)
    ]  # fmt: skip
    assert first.heights.tolist() == [[0, 0, 0, 0], [0, 0, 0, 0], [1, 2, 0.1, 0.2]]
    assert (first.roster, second.roster, third.roster) == (ROSTER, alone, ROSTER)
    assert second.columns.tolist() == [[3, 3, 0, 5]]
    assert (second.heights, third.columns[0, 0]) == (None, 4)
    assert box.take_frames() == []
    spine = ((1.0, 2.0, 0.0), (0.0, 2.0, 0.0))
    box.step(5, scene(5.0, spines={1: spine}), (0.0,))
    (frame,) = box.take_frames()
    assert (frame.spines, frame.heights) == (({1: spine},), None)
    box.step(6, scene(6.0), (0.0,))
    box.begin(pid=1, trial=1, started=0.0)
    assert box.take_frames() == []


def test_more_than_is_reserved_is_reserved_in_time(tmp_path, monkeypatch):
    """Records of every size that just fit, just do not, and begin a new mapping."""
    chunk = 1 << 12
    monkeypatch.setattr("crashhunt.recording._blackbox.CHUNK", chunk)
    monkeypatch.setattr("crashhunt.recording._blackbox.MAPPED", 64 * chunk)
    box = BlackBox(tmp_path / "box")
    box.begin(pid=1, trial=1, started=0.0)
    box.prologue(b"", 0)
    sizes = [chunk - 64 - 8 - 8 - 16, 0, 7, 3 * chunk - 24, 65 * chunk, 1, chunk - 8]
    for number, size in enumerate(sizes):
        box.append(Tag.LANES, number, bytes([number + 1]) * size)
        # Of what is not, a disk that is full is told by a signal.
        assert (tmp_path / "box").stat().st_size >= box.reserved >= read_header(tmp_path / "box").committed
    found = [(record.aux, len(record.payload), set(record.payload)) for record in read_black_box(tmp_path / "box")][1:]
    assert found == [(number, size, {number + 1} if size else set()) for number, size in enumerate(sizes)]
    box.begin(pid=1, trial=1, started=0.0)
    box.prologue(b"", 0)
    box.append(Tag.LANES, 0, bytes(chunk - 64 - 8 - 8 - 8))
    box.observation(0, np.ones(5, "<f8"))
    box.step(1, scene(1.0), ())
    box.close()
    assert [record.tag for record in read_black_box(tmp_path / "box")] == [1, Tag.LANES, Tag.OBSERVATION, Tag.STEP]


def test_a_full_disk_is_an_error_that_states_so(tmp_path, monkeypatch):
    box = BlackBox(tmp_path / "box")
    box.begin(pid=1, trial=1, started=0.0)

    def fails_with(code):
        def full(*_):
            raise OSError(code, "no room")

        monkeypatch.setattr("os.pwrite", full)

    for code in (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS):
        fails_with(code)
        with pytest.raises(RecorderError, match="no room") as caught:
            box.append(Tag.LANES, 0, bytes(2 << 20))
        assert caught.value.where == str(tmp_path / "box")
        with pytest.raises(RecorderError):
            BlackBox(tmp_path / "another")
    fails_with(errno.EBADF)  # such as a file that the agent has closed
    with pytest.raises(OSError, match="no room") as closed:
        box.append(Tag.LANES, 0, bytes(2 << 20))
    assert not isinstance(closed.value, RecorderError)
    box.append(Tag.LANES, 0, b"x")  # what has room is still recorded
    assert [record.payload for record in read_black_box(tmp_path / "box")] == [b"x"]
    box.close()
    with pytest.raises(OSError, match="Bad file"):
        box.close()


def test_file_of_a_black_box_is_always_a_new_one(box, tmp_path):
    with pytest.raises(FileExistsError):
        BlackBoxFile(tmp_path / "box")
    assert BlackBoxFile(tmp_path / "another").reserved > 0


def test_a_copy_of_the_process_writes_to_nowhere(box, tmp_path):
    box.prologue(b"p", 0)
    before = (tmp_path / "box").read_bytes()[: 1 << 16]
    box.detach()
    assert isinstance(box._map, mmap.mmap)
    box.append(Tag.LANES, 0, bytes(3 << 20))
    box.mark(Phase.ACT, 5)
    assert (tmp_path / "box").read_bytes()[: 1 << 16] == before


def test_what_is_too_short_or_of_others_has_no_header(tmp_path):
    path = tmp_path / "box"
    assert read_header(path) is None
    with pytest.raises(BundleError):
        list(read_black_box(path))
    for content in (b"", b"CRASHBB1", b"CRASHBB1" + bytes(30), b"CRASHBB2" + bytes(80), b"x" * 200):
        path.write_bytes(content)
        assert read_header(path) is None
        with pytest.raises(BundleError, match="left no recording"):
            list(read_black_box(path))
