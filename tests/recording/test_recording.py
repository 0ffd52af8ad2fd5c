from __future__ import annotations

import struct

from conftest import examples
from episodes import episodes, record, write
from hypothesis import HealthCheck, given, settings, strategies as st

from crashhunt.recording import Recording, Tag, first_divergence, read_black_box, read_header

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
