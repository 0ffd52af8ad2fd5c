"""A crash in one file: it replays elsewhere, and a hostile file can do nothing."""

from __future__ import annotations

import json
import shutil
import zipfile

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from repositories import make_repository
from test_replay import hunted, hunted_on_sumo

from crashhunt.base.integrity import digest_of_content
from crashhunt.crashes import open_archive
from crashhunt.errors import BundleError

AGENT = """
class Agent:
    def reset(self, seed): self.step = 0

    def act(self, observation):
        self.step += 1
        assert self.step < 20
        return 6.0, 0
"""


@pytest.fixture
def exported(shell, made_once):
    """A crash of an own agent as ``crash ä.zip``, the hunt and the agent gone."""
    return without_code(made_once(hunted, shell))


def without_code(shell):
    shell.crashhunt("export", "h", "crash ä.zip")
    shutil.rmtree(shell.folder / "h")
    shutil.rmtree(shell.folder / "my_pkg")
    return shell


def test_it_replays_here_and_elsewhere_if_trusted(exported):
    assert exported.crashhunt("replay", "crash ä.zip", "--json").json["verdict"] == "reproduced"
    exported.environment["XDG_STATE_HOME"] = str(exported.folder / "of another machine")
    for words in ((), ("--code", "current")):
        refused = exported.crashhunt("replay", "crash ä.zip", *words, expect=2)
        assert "--trust" in refused.err
        assert "my_pkg.agents:Planner" in refused.err
        assert len(refused.err.strip().splitlines()) == 1
    assert exported.crashhunt("replay", "crash ä.zip", "--trust", "--json").json["verdict"] == "reproduced"
    assert exported.crashhunt("replay", "crash ä.zip", "--from-log", "--json").json["code"] == "log"
    assert "out of ideas" in exported.crashhunt("show", "crash ä.zip").out


def rewritten(source, target, change):
    """Copy a zip file; ``change`` is given every (name, data) and returns what to write instead."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for info in old.infolist():
            for name, data in change(info.filename, old.read(info)):
                new.writestr(name, data, zipfile.ZIP_DEFLATED if len(data) > 10_000_000 else zipfile.ZIP_STORED)
    return target


@pytest.fixture(scope="module")
def small_archive(tmp_path_factory):
    path = tmp_path_factory.mktemp("archive") / "small.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("hunt.toml", "x = 1")
        index = {"schema": 1, "files": {"hunt.toml": {"size": 5, "blake2b": "0" * 32}}}
        archive.writestr("archive.json", json.dumps(index))
    return path.read_bytes()


@given(data=st.data())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_any_damage_is_refused_or_harmless(small_archive, tmp_path, data):
    position = data.draw(st.integers(0, len(small_archive) - 1))
    damaged = small_archive[:position] + data.draw(st.binary(max_size=40)) + small_archive[position + 1 :]
    path = tmp_path / "damaged.zip"
    path.write_bytes(damaged)
    with pytest.raises(BundleError), open_archive(path):
        pass


SIDE_EFFECTS = [
    ("scenario/scenario.toml", 'simulator = "sumo"', 'simulator = "os:system"', "os:system"),
    ("hunt.toml", '"overlap"', '"subprocess:run"', "subprocess:run"),
    ("scenario/scenario.toml", "[sumo.options]", '[sumo.options]\nsummary-output = "evil"', "summary-output"),
    ("scenario/traffic.rou.xml", "<routes>", '<routes><event commandPosix="evil"/>', "<event>"),
]


def test_a_strangers_recorded_actions_do_nothing_but_simulate(shell, made_once):
    source = without_code(made_once(hunted_on_sumo, shell)).folder / "crash ä.zip"
    for file, before, after, says in SIDE_EFFECTS:
        changed = {}

        def change(name, data, file=file, before=before, after=after, changed=changed):
            if name.endswith(file):
                assert before in data.decode()
                data = data.decode().replace(before, after).encode()
                changed[name] = {"size": len(data), "blake2b": digest_of_content(data)}
            if name == "archive.json":
                index = json.loads(data)
                data = json.dumps({**index, "files": {**index["files"], **changed}})
            return [(name, data)]

        rewritten(source, shell.folder / "bad.zip", change)
        refused = shell.crashhunt("replay", "bad.zip", "--from-log", "--force", expect=2)
        assert says in refused.err
        assert "not made on this machine" in refused.err


def test_file_that_a_module_reads_when_it_is_imported_is_named_once(toy):
    (toy.folder / "weights.npz").write_text("6")
    (toy.folder / "planner.py").write_text(f"LIMIT = float(open('weights.npz').read())\n{AGENT}")
    (toy.folder / ".gitignore").write_text("*.npz\nh/\n")
    make_repository(toy.folder)
    done = toy.crashhunt("run", "h", "2", "2", "9", "--scenario", "toy", "--agent", "planner:Agent")
    assert done.out.count("weights.npz is ignored by git, so the snapshot lacks it") == 1
