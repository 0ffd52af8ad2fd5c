from __future__ import annotations

import copy
import struct
from pathlib import Path

import numpy as np
import pytest
from conftest import examples
from episodes import Episode, episodes, record, write
from hypothesis import HealthCheck, given, settings, strategies as st

from crashhunt.errors import BundleError
from crashhunt.recording import Recording, Tag, digest_of, first_divergence, read_black_box, read_header

shared_folder = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=examples(60)
)


@given(episodes)
@shared_folder
def test_what_was_written_is_read(tmp_path, episode):
    recording = record(episode, tmp_path / "box")
    assert recording.agents == tuple(episode.agents)
    assert recording.steps == episode.steps
    for agent in episode.agents:
        assert recording.actions(agent).shape == (episode.steps, 2)
        seen = episode.steps + (episode.unfinished and agent == episode.agents[0])
        assert recording.observations(agent).shape == (seen, 3, 2)
    assert len(recording.scenes()) == episode.steps + 1
    assert recording.scene(episode.steps).time_s == 20 + episode.steps * 0.1
    assert first_divergence(recording, recording) is None
    again = record(episode, tmp_path / "again")
    assert again.digest == recording.digest


@given(episodes, st.data())
@shared_folder
def test_a_black_box_that_was_cut_short_has_a_prefix_of_the_records(tmp_path, episode, data):
    path = tmp_path / "box"
    size = write(episode, path)
    whole = Recording(read_black_box(path)).records
    committed = data.draw(st.integers(64, 64 + size))
    with path.open("r+b") as file:  # which is large, and mostly empty
        file.seek(32)  # the header's committed offset
        file.write(struct.pack("<Q", committed))
    assert read_header(path).committed == committed
    found = read_black_box(path)
    assert found == whole[: len(found)]
    if found:
        assert Recording(found).steps <= episode.steps


@given(episodes, st.data())
@shared_folder
def test_the_first_difference_is_found_where_it_is(tmp_path, episode, data):
    path = tmp_path / "box"
    recording = record(episode, path)
    places = [n for n, r in enumerate(recording.records) if r.tag in (Tag.OBSERVATION, Tag.ACTION, Tag.STEP)]
    place = data.draw(st.sampled_from(places))
    tag, aux, payload = recording.records[place]
    start = 16 if tag == Tag.STEP else 0
    if len(payload) == start:
        return
    at = data.draw(st.integers(start, len(payload) - 1))
    changed = payload[:at] + bytes([payload[at] ^ (1 << data.draw(st.integers(0, 7)))]) + payload[at + 1 :]
    records = [
        *recording.records[:place],
        recording.records[place]._replace(payload=changed),
        *recording.records[place + 1 :],
    ]
    other = Recording(records)
    divergence = first_divergence(recording, other)
    steps = [r for r in recording.records[:place] if r.tag == Tag.STEP]
    assert divergence is not None
    assert divergence.step == len(steps)
    if tag == Tag.STEP:
        assert divergence.field.startswith(("scene.", "reward"))
    else:
        assert divergence.agent == episode.agents[aux]
        assert divergence.field.startswith("observation" if tag == Tag.OBSERVATION else "action")
    divergence.to_json()
    assert other.digest != recording.digest


def test_values_rosters_and_lengths_that_differ(tmp_path):
    recording = record(Episode(["ego"], 8, 1), tmp_path / "box")
    scene = recording.scene(5)
    changed = copy.deepcopy(recording)
    changed.all_steps[5].scene.points[0] = (scene.points[0][0] + 1e-12, scene.points[0][1])
    found = first_divergence(recording, changed)
    assert (found.step, found.agent, found.field) == (5, "ego", "scene.x")
    shorter = Recording(recording.records[: [r.tag for r in recording.records].index(Tag.STEP) + 1])
    found = first_divergence(recording, shorter)
    assert (found.step, found.field, found.recorded, found.replayed) == (1, "length", 8, 0)
    with pytest.raises(IndexError, match="0 to 8"):
        recording.scene(9)


def test_recording_without_records_is_refused():
    with pytest.raises(BundleError, match="no beginning"):
        Recording(())


def test_pages_are_used_again_and_leave_no_trace(tmp_path):
    """A second trial in the same file is exactly what it would be in a new one."""
    import os

    from crashhunt.recording import BlackBox, Prologue

    box = BlackBox(tmp_path / "box")
    digests = []
    for size in (3000, 10, 3000):
        box.begin(pid=os.getpid(), trial=size, started=0.0)
        box.prologue(Prologue((), 0.1).encode(), 0)
        for number in range(size):
            box.append(Tag.LANES, 0, b"x" * (number % 500))
        digests.append(digest_of([box.committed()]))
        assert read_header(tmp_path / "box").trial == size
    assert digests[0] == digests[2] != digests[1]


def test_a_large_episode_grows_the_file(tmp_path):
    import os

    from crashhunt.recording import BlackBox, Prologue

    path = tmp_path / "box"
    box = BlackBox(path)
    box.begin(pid=os.getpid(), trial=0, started=0.0)
    box.prologue(Prologue((), 0.1).encode(), 0)
    block = np.arange(1 << 17, dtype="<f8").tobytes()
    for _ in range(70):
        box.append(Tag.LANES, 0, block)
    box.close()
    records = list(read_black_box(path))
    assert len(records) == 71
    assert all(record.payload == block for record in records[1:])
    Path(path).unlink()
