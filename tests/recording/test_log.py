from __future__ import annotations

import functools
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import examples
from episodes import Episode, episodes, record
from hypothesis import HealthCheck, given, settings, strategies as st
from mcap.reader import SeekingReader, make_reader
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import CompressionType, Writer

from crashhunt.errors import BundleError
from crashhunt.recording import _foxglove, _log, read_log, write_log
from crashhunt.recording._foxglove import messages_of
from crashhunt.trial import Collision, Outcome, TrialResult, TrialSpec
from crashhunt.world import Lane

shared_folder = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=examples(30)
)
LANES = [Lane("x_0", 3.2, ((0.0, 0.0), (50.0, 0.0), (80.0, 20.0))), Lane("far_0", 3.2, ((9e5, 9e5), (9e5 + 1, 9e5)))]
CRASH = TrialResult(
    TrialSpec(7, 1, {}, {}, max_steps=100),
    Outcome.COLLISION,
    steps=20,
    collision=Collision("ego", "collider", "ego", "car 0", ("overlap",), "collision", 1.0, 2.0),
)


@given(episodes)
@shared_folder
def test_a_log_gives_back_every_bit(tmp_path, episode):
    recording = record(episode, tmp_path / "box")
    write_log(tmp_path / "log.mcap", recording, lanes=LANES, crash=CRASH)
    found = read_log(tmp_path / "log.mcap")
    assert found.records == recording.records
    assert found.digest == recording.digest


@pytest.mark.parametrize("chunk_size", [1 << 20, 2000])
def test_messages_are_those_of_the_reader_of_mcap(tmp_path, monkeypatch, chunk_size):
    path = tmp_path / "log.mcap"
    recording = record(Episode(["ego"], 40, 3), tmp_path / "box")
    monkeypatch.setattr(_log, "Writer", functools.partial(Writer, chunk_size=chunk_size))
    write_log(path, recording, lanes=LANES, crash=CRASH)
    with path.open("rb") as file:
        reader = SeekingReader(file)
        theirs = [
            (schema.name, channel.topic, message.sequence, message.data)
            for schema, channel, message in reader.iter_messages(log_time_order=False)
        ]
        ours = [
            (schema.name, channel.topic, sequence, data)
            for schema, channel, sequence, data in messages_of(file, reader)
        ]
        assert (len(reader.get_summary().chunk_indexes) > 1) == (chunk_size == 2000)
        assert ours == theirs
        assert [one for *_, one in messages_of(file, reader, topic="/tf")] == [
            data for _, topic, _, data in theirs if topic == "/tf"
        ]


@pytest.mark.parametrize("missing", [1, 12])
def test_record_that_is_longer_than_its_chunk_is_refused(tmp_path, monkeypatch, missing):
    path = tmp_path / "log.mcap"
    write_log(path, record(Episode(["ego"], 12, 3), tmp_path / "box"), lanes=LANES)

    def shortened(chunk, *, validate_crc):
        stream, size = get_chunk_data_stream(chunk, validate_crc)
        return stream, size - missing

    monkeypatch.setattr(_foxglove, "get_chunk_data_stream", shortened)
    with pytest.raises(BundleError, match="McapError: a record of"):
        read_log(path)


@given(st.data())
@shared_folder
def test_a_damaged_log_never_passes_for_another(tmp_path, data):
    path = tmp_path / "log.mcap"
    recording = record(Episode(["ego"], 12, 3), tmp_path / "box")
    write_log(path, recording, lanes=LANES)
    whole = path.read_bytes()
    if data.draw(st.booleans()):
        damaged = whole[: data.draw(st.integers(0, len(whole) - 1))]
    else:
        at = data.draw(st.integers(0, len(whole) - 1))
        damaged = whole[:at] + bytes([whole[at] ^ (1 << data.draw(st.integers(0, 7)))]) + whole[at + 1 :]
    path.write_bytes(damaged)
    try:
        assert read_log(path).digest == recording.digest  # the damage was in a view channel or in an index
    except BundleError as error:
        assert error.where == str(path)
        assert error.fix


def test_what_is_no_log_is_refused(tmp_path):
    from mcap.writer import Writer

    path = tmp_path / "log.mcap"
    with pytest.raises(BundleError, match="cannot be read"):
        read_log(path)
    os.mkfifo(path)  # no process writes into it
    with pytest.raises(BundleError, match="incomplete MCAP file: "):
        read_log(path)
    path.unlink()
    for metadata, says in (
        ({}, "not written by crashhunt"),
        ({"crashhunt_log_schema": "99"}, "is 99; this crashhunt reads 1"),
    ):
        with path.open("wb") as file:
            writer = Writer(file)
            writer.start()
            if metadata:
                writer.add_metadata("crashhunt", metadata)
            writer.finish()
        with pytest.raises(BundleError, match=says):
            read_log(path)


def test_a_full_disk_leaves_nothing_behind(tmp_path):
    program = f"""
import resource, signal, sys
sys.path.insert(0, {str(Path(__file__).parents[1])!r})
from pathlib import Path
from episodes import Episode, record
from crashhunt.errors import HuntDirectoryError
from crashhunt.recording import write_log
folder = Path({str(tmp_path)!r})
recording = record(Episode(["ego"], 25, 1), folder / "box")
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, resource.RLIM_INFINITY))
try:
    write_log(folder / "log.mcap", recording)
except HuntDirectoryError as error:
    print("refused:", error.message)
"""
    # -B: what Python compiles would be cut off as well.
    done = subprocess.run([sys.executable, "-B", "-c", program], capture_output=True, text=True, check=True)
    assert "refused: cannot be written: File too large" in done.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["box"]
    assert signal.SIGXFSZ
    assert resource.RLIMIT_FSIZE


READER = """
import { McapIndexedReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { decompress } from "fzstd";
import { open } from "node:fs/promises";
import { createHash } from "node:crypto";
const readable = new FileHandleReadable(await open(process.argv[2]));
const decompressHandlers = { zstd: (data, size) => decompress(data, new Uint8Array(Number(size))) };
const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
const topics = {};
for await (const message of reader.readMessages()) {
  const channel = reader.channelsById.get(message.channelId);
  const schema = reader.schemasById.get(channel.schemaId).name;
  const entry = (topics[channel.topic] ??= { count: 0, schema, hash: createHash("sha256") });
  entry.count += 1;
  entry.hash.update(message.data);
}
for (const entry of Object.values(topics)) entry.hash = entry.hash.digest("hex");
console.log(JSON.stringify(topics));
"""


@pytest.mark.nightly  # installs from the network; by day, the reader of the package mcap agrees
def test_an_independent_reader_agrees(tmp_path):
    """The npm package @mcap/core, Foxglove's own reader, finds the same messages to the byte."""
    import hashlib

    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None or npm is None:
        pytest.skip("Node.js is not on this machine")
    recording = record(Episode(["ego", "日本"], 25, 5), tmp_path / "box")
    write_log(tmp_path / "log.mcap", recording, lanes=LANES, crash=CRASH)
    packages = ["@mcap/core@2", "@mcap/nodejs@1", "fzstd@0.1"]
    command = [npm, "install", "--no-audit", "--no-fund", "--prefix", str(tmp_path), *packages]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    (tmp_path / "read.mjs").write_text(READER)
    done = subprocess.run(
        [node, "read.mjs", str(tmp_path / "log.mcap")],
        cwd=tmp_path,
        check=True,
        capture_output=True,
        text=True,
        timeout=60,
    )
    theirs = json.loads(done.stdout)
    ours: dict[str, dict] = {}
    with (tmp_path / "log.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            entry = ours.setdefault(channel.topic, {"count": 0, "schema": schema.name, "hash": hashlib.sha256()})
            entry["count"] += 1
            entry["hash"].update(message.data)
    for entry in ours.values():
        entry["hash"] = entry["hash"].hexdigest()
    assert theirs == ours
    assert theirs["/scene"]["count"] == 26
    assert theirs["/agents/ego/action"]["count"] == 25


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_chunk_that_would_fill_the_memory_is_refused(tmp_path, monkeypatch, compression):
    kind = getattr(CompressionType, compression.upper())
    monkeypatch.setattr(_log, "Writer", functools.partial(Writer, compression=kind))
    monkeypatch.setattr(_foxglove, "_MAX_CHUNK_BYTES", 1000)
    write_log(tmp_path / "log.mcap", record(Episode(["ego"], 40, 3), tmp_path / "box"))
    with pytest.raises(BundleError, match=r"a chunk has [\d,]+ bytes when it is unpacked \(allowed: 1,000\)"):
        read_log(tmp_path / "log.mcap")
