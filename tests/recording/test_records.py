"""One place per type of record: adding one, and what becomes of those that came with a later version."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest
from episodes import Episode, record
from mcap.reader import make_reader

from crashhunt.errors import BundleError
from crashhunt.recording import (
    AgentChannel,
    BlackBox,
    Divergence,
    Prologue,
    Recording,
    digest_of,
    encode_actors,
    first_divergence,
    read_black_box,
    read_log,
    values_around,
    write_log,
)
from crashhunt.recording._blackbox import FIRST_NON_EVIDENCE_TAG, is_evidence
from crashhunt.recording.records import RECORD_TYPES
from crashhunt.recording.records._scene_record import encode_roster
from crashhunt.recording.records._type import BytesForm, RecordType, TextForm
from crashhunt.world import Actor, Roster, Scene

WIND, WEATHER = 77, 201


def _read(reading, aux, payload):
    reading.current.more["wind"] = json.loads(payload)["wind_m_s"]


def _difference(left, right, _agent):
    was, now = left.more.get("wind"), right.more.get("wind")
    return None if was == now else Divergence(left.step, "", "wind", was, now, ("wind", ()))


TYPE = RecordType(
    WIND, "wind", "/weather/wind", TextForm(), _read, _difference, lambda step, agent, index: step.more.get("wind")
)


def recorded(path, *, wind=(3.0, 4.0), weather=b"\xff rain", steps=2):
    """An episode with a record of a further type in every step, and one that is no evidence."""
    box = BlackBox(path)
    box.begin(pid=os.getpid(), trial=7, started=0.0)
    box.prologue(Prologue((AgentChannel("ego", "<f4", (1,), "<f8", (1,)),), 0.1).encode(), 1)
    actor = Actor("ego", "passenger", 4.5, 1.8)
    roster = Roster((actor,))
    box.append(2, 0, encode_actors([actor]))
    box.append(3, 0, encode_roster([0]))
    for step in range(steps + 1):
        if step:
            box.observation(0, np.zeros(1, "<f4"))
            box.action(0, np.ones(1))
            box.append(WIND, 0, json.dumps({"wind_m_s": wind[step - 1]}).encode())
            box.append(WEATHER, 3, weather)
        box.step(step, Scene(step / 10, roster, [(step, 0.0)], [0.0], [10.0]), (0.0,))
    digest = digest_of(box.evidence())
    box.close()
    found = Recording(read_black_box(path))
    assert found.digest == digest
    return found


def through_a_log(recording, path):
    write_log(path, recording)
    found = read_log(path)
    assert found.records == recording.records
    assert found.digest == recording.digest
    return found


def test_a_further_type_goes_all_the_way_from_one_place(tmp_path, monkeypatch):
    monkeypatch.setitem(RECORD_TYPES, WIND, TYPE)
    first = through_a_log(recorded(tmp_path / "box"), tmp_path / "log.mcap")
    assert [step.more.get("wind") for step in first.all_steps] == [None, 3.0, 4.0]
    with (tmp_path / "log.mcap").open("rb") as file:
        assert "/weather/wind" in {channel.topic for _, channel, _ in make_reader(file).iter_messages()}
    other = through_a_log(recorded(tmp_path / "box", wind=(3.0, 5.0)), tmp_path / "log.mcap")
    found = first_divergence(first, other)
    assert (found.step, found.field, found.recorded, found.replayed) == (2, "wind", 4.0, 5.0)
    assert values_around(first, other, found)[1:-1] == [(1, 3.0, 3.0), (2, 4.0, 5.0), (3, None, None)]


def test_what_a_later_version_has_added_is_kept_and_counts_in_the_digest(tmp_path):
    ours = recorded(tmp_path / "box")
    assert through_a_log(ours, tmp_path / "log.mcap").steps == 2
    assert all(not step.more for step in ours.all_steps)
    other = recorded(tmp_path / "box", wind=(3.0, 5.0))
    assert first_divergence(ours, other).field == "digest"  # which is all that can be said of it
    assert first_divergence(ours, recorded(tmp_path / "box", weather=b"sun")) is None  # no evidence, says its tag
    assert is_evidence(WIND)
    assert not is_evidence(WEATHER)


def test_a_log_of_a_version_that_knows_a_type_is_read_by_one_that_does_not(tmp_path, monkeypatch):
    with monkeypatch.context() as newer:
        newer.setitem(RECORD_TYPES, WIND, TYPE)
        written = recorded(tmp_path / "box")
        write_log(tmp_path / "log.mcap", written)
    found = read_log(tmp_path / "log.mcap")
    assert (found.digest, found.records) == (written.digest, written.records)


def test_a_type_that_cannot_be_read_is_refused(tmp_path, monkeypatch):
    class Numbers(BytesForm):
        def to_message(self, payload, prologue, aux):
            return "IntArray", {"values": [len(payload)]}

    with monkeypatch.context() as newer:
        newer.setitem(RECORD_TYPES, WIND, RecordType(WIND, "wind", "/weather/wind", Numbers(), _read))
        write_log(tmp_path / "log.mcap", recorded(tmp_path / "box"))
    with pytest.raises(BundleError, match="a type that this version of crashhunt does not know") as refused:
        read_log(tmp_path / "log.mcap")
    assert refused.value.fix == "use the version of crashhunt that wrote the trial"


def test_a_prologue_of_a_later_version_is_read(tmp_path):
    recording = record(Episode(["ego"], 3, 1), tmp_path / "box")
    data = json.loads(recording.records[0].payload)
    data["weather"], data["agents"][0]["units"] = "rain", ["m"]
    first = recording.records[0]._replace(payload=json.dumps(data).encode())
    assert Recording([first, *recording.records[1:]]).prologue == recording.prologue
    del data["agents"][0]["observation_dtype"]
    with pytest.raises(BundleError, match="damaged"):
        Recording([first._replace(payload=json.dumps(data).encode()), *recording.records[1:]])


def test_no_tag_topic_or_name_is_given_twice_and_later_types_can_be_read_by_everybody():
    kinds = RECORD_TYPES.values()
    for what in ("tag", "topic", "name"):
        assert len({getattr(kind, what) for kind in kinds}) == len(kinds)
    assert [tag for tag in RECORD_TYPES if not is_evidence(tag)] == [11]
    assert all(isinstance(kind.form, TextForm | BytesForm) for kind in kinds if kind.tag > 11)
    assert max(RECORD_TYPES) < FIRST_NON_EVIDENCE_TAG
