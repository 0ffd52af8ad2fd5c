"""A log that somebody has taken something out of, or put in another order, is none."""

from __future__ import annotations

import pytest
from episodes import Episode, record
from mcap.reader import make_reader
from mcap.writer import Writer

from crashhunt.base.errors import BundleError
from crashhunt.recording import Tag, read_log, write_log


@pytest.fixture
def recording(tmp_path):
    return record(Episode(["ego", "a.b"], 6, 3, contact_at=2), tmp_path / "box")


def rewrite(path, change):
    """Write the log anew with other messages; each is (topic, schema, data, sequence)."""
    with path.open("rb") as file:
        reader = make_reader(file)
        messages = [
            (channel.topic, schema.name, schema.data, message.data, message.sequence, message.log_time)
            for schema, channel, message in reader.iter_messages(log_time_order=False)
        ]
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_metadata("crashhunt", {"crashhunt_log_schema": "1"})
        for topic, name, described, data, sequence, time_ns in change(messages):
            channel = writer.register_channel(topic, "protobuf", writer.register_schema(name, "protobuf", described))
            writer.add_message(channel, time_ns, data, time_ns, sequence)
        writer.finish()


def evidence(messages):
    return [message for message in messages if message[1].startswith("crashhunt.") and message[4]]


def test_the_order_in_the_file_does_not_matter(recording, tmp_path):
    path = tmp_path / "log.mcap"
    write_log(path, recording)
    rewrite(path, lambda messages: messages[::-1])
    assert read_log(path).records == recording.records


@pytest.mark.parametrize("place", [0, 1, 2, 10, -2])
def test_a_log_whose_evidence_is_missing_is_refused(recording, tmp_path, place):
    path = tmp_path / "log.mcap"
    write_log(path, recording)

    def without(messages):
        gone = evidence(messages)[place]
        return [message for message in messages if message is not gone]

    rewrite(path, without)
    with pytest.raises(BundleError, match=r"message \d+ of the log is missing") as caught:
        read_log(path)
    assert caught.value.where == str(path)
    assert caught.value.fix


def test_without_any_evidence_or_its_end_it_is_another_recording(recording, tmp_path):
    path = tmp_path / "log.mcap"
    write_log(path, recording)
    rewrite(path, lambda messages: [message for message in messages if message not in evidence(messages)])
    with pytest.raises(BundleError, match="no beginning"):
        read_log(path)
    write_log(path, recording)
    rewrite(path, lambda messages: [message for message in messages if message is not evidence(messages)[-1]])
    assert read_log(path).records == recording.records[:-1]
    assert read_log(path).digest != recording.digest
    write_log(path, recording)
    rewrite(path, lambda messages: [*messages, evidence(messages)[3]])  # twice
    with pytest.raises(BundleError, match="message 4 of the log is there twice"):
        read_log(path)


def test_evidence_of_no_one_is_refused(recording, tmp_path):
    path = tmp_path / "log.mcap"
    write_log(path, recording)
    rewrite(
        path,
        lambda messages: [
            ("/agents/stranger/action", *message[1:]) if message[0].endswith("action") else message
            for message in messages
        ],
    )
    with pytest.raises(BundleError, match="KeyError"):
        read_log(path)


def test_messages_are_at_simulation_time_and_on_their_channels(recording, tmp_path):
    path = tmp_path / "log.mcap"
    write_log(path, recording, metadata={"trial": "7"})
    times = {}
    with path.open("rb") as file:
        reader = make_reader(file)
        assert {"trial": "7", "crashhunt_log_schema": "1"} in [entry.metadata for entry in reader.iter_metadata()]
        assert reader.get_header().library.startswith("crashhunt")
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            assert message.log_time == message.publish_time
            if message.sequence and schema.name.startswith("crashhunt."):
                times.setdefault(channel.topic, []).append(message.log_time)
    assert times["/scene"] == [20_000_000_000 + step * 100_000_000 for step in range(7)]
    assert times["/prologue"] == times["/scene"][:1]  # otherwise viewers begin with 20 s of nothing
    assert times["/agents/ego/action"] == times["/agents/a.b/observation"] == times["/scene"][:-1]
    assert times["/events"] == [times["/scene"][2]]  # of the contact at step 2
    assert set(times["/scene/roster"]) < set(times["/scene"])
    assert {"/scene/actor_definitions", "/scene/roster", "/scene/lanes", "/scene/heights", "/scene/spines"} < set(times)
    kinds = [record.tag for record in read_log(path).records]
    assert kinds.count(Tag.STEP) == 7
