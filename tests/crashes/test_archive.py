"""Exported crashes: nothing that an archive says of itself is believed."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import stat
import zipfile

import pytest
from episodes import Episode, write

from crashhunt.base import integrity, layout
from crashhunt.base.errors import BundleError, HuntDirectoryError
from crashhunt.crashes import (
    _archive as archives,
    export_crash,
    find_bundle,
    open_archive,
    read_bundle,
    write_bundle,
)
from crashhunt.recording import Recording, read_black_box
from crashhunt.scenario import digest_of_described
from crashhunt.trial import Collision, Outcome, TrialResult, TrialSpec


def described(data: bytes):
    return {"size": len(data), "blake2b": hashlib.blake2b(data, digest_size=16).hexdigest()}


@pytest.fixture(scope="module")
def crash(tmp_path_factory):
    """A hunt with one crash, and a snapshot of one module."""
    directory = tmp_path_factory.mktemp("hunt")
    (directory / layout.HUNT).write_text("# how it was asked\n")
    code = b"x = 1\n"
    files = {"code/agent.py": described(code)}
    digest = digest_of_described(files, plain_data=[["code"], {}])
    snapshot = directory / layout.SNAPSHOTS / digest
    (snapshot / "code").mkdir(parents=True)
    (snapshot / "code" / "agent.py").write_bytes(code)
    (snapshot / "code" / "data.bin").write_bytes(b"an agent's own")
    manifest = {"schema": 1, "paths": ["code"], "files": files, "described": {}}
    manifest["integrity"] = integrity.digest_of_data(manifest)
    (snapshot / layout.MANIFEST).write_text(json.dumps(manifest))
    (snapshot / layout.ENVIRONMENT).write_text("{}")
    scratch = directory / "scratch"
    scratch.mkdir()
    write(Episode(["ego"], 5, 1), scratch / layout.BLACK_BOX)
    result = TrialResult(
        TrialSpec(3, 1, {"ego": {}}, {}, max_steps=9), Outcome.COLLISION, steps=5,
        digest=Recording(read_black_box(scratch / layout.BLACK_BOX)).digest,
        collision=Collision("ego", "collider", "ego", "other", ("overlap",)),
    )  # fmt: skip
    return write_bundle(directory, result, scratch, hunt_seed=1, snapshot=digest, lanes=())


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))  # where a key is kept that has no other place
    monkeypatch.setattr("crashhunt.crashes._archive.is_bundle_made_here", lambda _: True)
    return tmp_path / "state"


@pytest.fixture
def file(crash, tmp_path):
    export_crash(crash, tmp_path / "crash.zip")
    return tmp_path / "crash.zip"


def entries(path):
    with zipfile.ZipFile(path) as archive:
        return {entry.filename: archive.read(entry) for entry in archive.infolist()}


def written(path, contents, *, listed=None, more=(), **index):
    """Write an archive by hand, with an index that fits."""
    listed = {name: described(data) for name, data in contents.items()} if listed is None else listed
    whole = {"schema": 1, "crash": "x", "files": listed, **index}
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in contents.items():
            archive.writestr(name, data)
        for entry, data in more:
            archive.writestr(entry, data)
        archive.writestr(layout.ARCHIVE_INDEX, json.dumps(whole))
    return path


def test_what_was_exported_is_unpacked(crash, file, tmp_path):
    seen = []
    size = export_crash(crash, tmp_path / "again.zip", watch=lambda done, whole: seen.append((done, whole)))
    assert size == (tmp_path / "again.zip").stat().st_size
    assert seen
    with open_archive(file) as archive:
        there = sorted(p.relative_to(archive.directory).as_posix() for p in archive.directory.rglob("*") if p.is_file())
        folder = f"crashes/{crash.id}"
        snapshot = f"snapshots/{crash.snapshot}"
        assert there == sorted([
            "hunt.toml", *(f"{folder}/{name}" for name in ("crash.json", "log.mcap", "foxglove-layout.json")),
            *(f"{snapshot}/{name}" for name in ("code/agent.py", "manifest.json", "environment.json")),
        ])  # fmt: skip
        for name in there:
            assert (archive.directory / name).read_bytes() == (crash.hunt / name).read_bytes()
        assert archive.made_here
        assert "@" in archive.made_by
        assert archive.made_at.endswith(" UTC")
        kept = archive.directory
    assert not kept.exists()
    index = json.loads(entries(file)[layout.ARCHIVE_INDEX])
    assert (index["schema"], index["crash"]) == (1, crash.id)
    assert set(index["files"]) == set(there)


def test_one_that_was_made_smaller_is_found_in_its_archive(crash, tmp_path):
    """It is the only one there, and in the directory of its hunt only meant by its whole id."""
    path = crash.path.with_name(f"{crash.id}{layout.SMALL}")
    shutil.copytree(crash.path, path)
    try:
        assert find_bundle(crash.hunt).path == crash.path
        export_crash(read_bundle(path), tmp_path / "small.zip")
    finally:
        shutil.rmtree(path)
    with open_archive(tmp_path / "small.zip") as archive:
        assert find_bundle(archive.directory).path.name == path.name


def test_only_who_made_it_here_is_believed_to_have(file, home):
    key = home / "crashhunt" / "archive-key"
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    assert len(key.read_bytes()) == 32
    assert [path.name for path in key.parent.iterdir()] == ["archive-key"]
    files = entries(file)
    index = json.loads(files.pop(layout.ARCHIVE_INDEX))
    with open_archive(written(file, files, **index)) as archive:
        assert archive.made_here
    with open_archive(written(file, files, **{**index, "made_by": "somebody"})) as archive:
        assert not archive.made_here
        assert archive.made_by == "somebody"
    with open_archive(written(file, files)) as archive:
        assert (archive.made_here, archive.made_by, archive.made_at) == (False, "?", "?")
    written(file, files, **index)
    key.write_bytes(b"0" * 32)  # another user, or another machine
    with open_archive(file) as archive:
        assert not archive.made_here
    key.unlink()
    with open_archive(file) as archive:
        assert not archive.made_here


def test_crash_of_unknown_origin_is_exported_without_signature(crash, tmp_path, monkeypatch):
    monkeypatch.undo()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    export_crash(crash, tmp_path / "crash.zip")
    assert "signature" not in json.loads(entries(tmp_path / "crash.zip")[layout.ARCHIVE_INDEX])
    with open_archive(tmp_path / "crash.zip") as archive:
        assert not archive.made_here


def test_a_user_without_a_name_or_a_home_exports_as_well(crash, tmp_path, monkeypatch):
    """As in a container that was started with ``--user 54321``."""
    for name in ("HOME", "XDG_STATE_HOME", "USER", "LOGNAME", "LNAME", "USERNAME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os, "getuid", lambda: 54321)
    export_crash(crash, tmp_path / "crash.zip")
    with open_archive(tmp_path / "crash.zip") as archive:
        assert archive.made_by.startswith("54321@")


def test_what_is_damaged_is_not_exported(crash, tmp_path):
    log = crash.path / layout.LOG
    whole = log.read_bytes()
    try:
        log.write_bytes(whole[:-20])
        with pytest.raises(BundleError):
            export_crash(crash, tmp_path / "crash.zip")
    finally:
        log.write_bytes(whole)
    module = crash.hunt / layout.SNAPSHOTS / crash.snapshot / "code" / "agent.py"
    module.write_text("x = 2\n")
    try:
        with pytest.raises(BundleError):
            export_crash(crash, tmp_path / "crash.zip")
    finally:
        module.write_text("x = 1\n")
    assert [path.name for path in tmp_path.iterdir()] == []
    with pytest.raises(HuntDirectoryError, match=r"gone/crash\.zip"):
        export_crash(crash, tmp_path / "gone" / "crash.zip")


def test_an_export_writes_nothing_into_the_hunt_and_leaves_out_what_was_added(crash, tmp_path):
    folder = crash.hunt / layout.SNAPSHOTS / crash.snapshot / "code" / "__pycache__"
    folder.mkdir()
    added = folder / "agent.cpython-311.pyc"
    added.write_bytes(b"x")
    try:
        export_crash(crash, tmp_path / "crash.zip")
        assert added.exists()
    finally:
        shutil.rmtree(folder)
    assert not any(name.endswith(".pyc") for name in entries(tmp_path / "crash.zip"))


def test_a_link_next_to_a_crash_is_not_followed(crash, tmp_path):
    link = crash.path / "secret"
    link.symlink_to("/etc/hostname")
    try:
        export_crash(crash, tmp_path / "crash.zip")
    finally:
        link.unlink()
    assert not any(name.endswith("secret") for name in entries(tmp_path / "crash.zip"))


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("crashes/../../x", "leads out"), ("/crashes/x", "leads out"), ("crashes\\x", "leads out"),
        ("C:/x", "leads out"), ("crashes:x/y", "leads out"), ("ledger.sqlite", "does not belong to a crash"),
        ("other/hunt.toml", "does not belong to a crash"), ("crashes/x/", "is not a file"),
    ],
)  # fmt: skip
def test_names_that_lead_elsewhere_are_refused(tmp_path, name, says):
    path = written(tmp_path / "bad.zip", {"hunt.toml": b"", name: b"x"})
    with pytest.raises(BundleError, match=says) as caught, open_archive(path):
        pass
    assert caught.value.where == str(path)
    assert caught.value.fix
    assert [file.name for file in tmp_path.iterdir()] == ["bad.zip"]  # where it would be unpacked


def test_links_twins_and_strangers_are_refused(tmp_path):
    def says(path):
        with pytest.raises(BundleError) as caught, open_archive(path):
            pass
        return caught.value.message

    bad = tmp_path / "bad.zip"
    link = zipfile.ZipInfo("crashes/link")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    assert "is not a file" in says(written(bad, {}, listed={"crashes/link": described(b"x")}, more=[(link, b"x")]))
    plain = zipfile.ZipInfo("crashes/plain")
    plain.external_attr = (stat.S_IFREG | 0o644) << 16
    with open_archive(written(bad, {}, listed={"crashes/plain": described(b"x")}, more=[(plain, b"x")])) as archive:
        assert (archive.directory / "crashes" / "plain").read_bytes() == b"x"
    with pytest.warns(UserWarning, match="Duplicate name"):
        written(bad, {"hunt.toml": b"1"}, more=[("hunt.toml", b"1")])
    assert "two files with the same name" in says(bad)
    assert "is not listed" in says(
        written(bad, {"hunt.toml": b"1", "crashes/a": b"2"}, listed={"hunt.toml": described(b"1")})
    )
    assert "'crashes/b' is missing" in says(written(bad, {}, listed={"crashes/b": described(b"2")}))


def test_sizes_and_hashes_are_checked(tmp_path, monkeypatch):
    def says(**listed):
        written(tmp_path / "bad.zip", {"hunt.toml": b"12345"}, listed={"hunt.toml": listed})
        with pytest.raises(BundleError) as caught, open_archive(tmp_path / "bad.zip"):
            pass
        return caught.value.message

    right = described(b"12345")
    assert "is larger than its index states" in says(**{**right, "size": 4})
    assert "has changed" in says(**{**right, "size": 6})
    assert "has changed" in says(**{**right, "blake2b": described(b"12346")["blake2b"]})
    monkeypatch.setattr(archives, "_MAX_BYTES", 4)
    assert "too large" in says(**right)
    monkeypatch.setattr(archives, "_MAX_BYTES", 5)
    with open_archive(written(tmp_path / "good.zip", {"hunt.toml": b"12345"})) as archive:
        assert (archive.directory / "hunt.toml").read_bytes() == b"12345"
    monkeypatch.setattr(archives, "_MAX_FILES", 1)
    with open_archive(tmp_path / "good.zip"):
        pass
    written(tmp_path / "good.zip", {"hunt.toml": b"1", "crashes/a": b"2"})
    with pytest.raises(BundleError, match="too large"), open_archive(tmp_path / "good.zip"):
        pass
    # Also what is longer than one piece that is read at a time.
    monkeypatch.undo()
    monkeypatch.setattr(archives, "_CHUNK_BYTES", 7)
    with open_archive(written(tmp_path / "good.zip", {"hunt.toml": b"12345" * 9})) as archive:
        assert (archive.directory / "hunt.toml").read_bytes() == b"12345" * 9


def test_an_index_is_asked_for(tmp_path):
    path = tmp_path / "bad.zip"

    def says():
        with pytest.raises(BundleError) as caught, open_archive(path):
            pass
        return caught.value.message

    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("hunt.toml", "")
    assert "not an exported crash" in says()
    written(path, {}, schema=2)
    assert says() == "schema version 2 is not supported (supported: 1)"
    for index in ({"schema": "1"}, {"files": []}, {"files": {"a": {"size": "1", "blake2b": ""}}}, {"files": {"a": {}}}):
        written(path, {}, **{"listed": index.pop("files", {}), **index})
        assert "not an exported crash" in says(), index
    path.write_bytes(path.read_bytes()[:-30])
    assert "damaged, or not a zip file" in says()
    path.write_bytes(b"")
    assert "damaged, or not a zip file" in says()
    path.unlink()
    assert "cannot be unpacked: No such file" in says()


def test_only_the_permission_to_execute_travels(tmp_path):
    listed = {"hunt.toml": described(b"1"), "snapshots/x/code/planner": {**described(b"2"), "executable": 1}}
    path = written(tmp_path / "good.zip", {"hunt.toml": b"1", "snapshots/x/code/planner": b"2"}, listed=listed)
    with open_archive(path) as archive:
        modes = [(archive.directory / name).stat().st_mode for name in listed]
    assert [mode & 0o7133 for mode in modes] == [0, 0o111]


@pytest.mark.parametrize("name", ["crashes/x/crash.json", "hunt.toml", "snapshots/x/manifest.json"])
def test_archive_has_the_limits_of_a_folder(tmp_path, monkeypatch, name):
    path = written(tmp_path / "big.zip", {"hunt.toml": b"1", name: b"12345"})
    monkeypatch.setitem(integrity._MAX_BYTES, name.rpartition("/")[2], 4)
    with pytest.raises(BundleError, match=r"has 5 bytes \(allowed: 4\)"), open_archive(path):
        pass
    path = written(tmp_path / "good.zip", {"hunt.toml": b"1", f"snapshots/x/code/{name}": b"12345"})
    with open_archive(path) as archive:  # an agent names its files as it likes
        assert (archive.directory / "snapshots" / "x" / "code" / name).exists()
