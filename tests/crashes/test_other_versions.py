"""What another version has written: keys that are not known here, and keys that it did not write yet."""

from __future__ import annotations

import copy
import dataclasses
import json
import shutil
import tomllib
import zipfile
from pathlib import Path

import pytest
import tomli_w
from conftest import examples
from hypothesis import HealthCheck, given, settings, strategies as st

from crashhunt.base.codec import ESSENTIAL, known_part, merged, required_in
from crashhunt.base.errors import BundleError, CrashhuntError, HuntDirectoryError, ScenarioError
from crashhunt.base.integrity import describe_files, digest_of_data
from crashhunt.crashes import export_crash, find_bundle, open_archive, read_bundle
from crashhunt.episode import WorkerSettings
from crashhunt.plans import HuntSettings, read_settings, with_settings, write_settings
from crashhunt.scenario import load_scenario
from crashhunt.snapshots import Snapshot, environment_changes
from crashhunt.trial import Outcome, Overruled, TrialResult, TrialSpec

HUNT = next(iter(sorted((Path(__file__).parents[1] / "e2e" / "frozen").glob("*/hunt"))))
shared = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=examples(20))
values = st.recursive(
    st.none() | st.booleans() | st.integers(-9, 9) | st.text("ab", max_size=3),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text("xyz", min_size=1), inner, max_size=2),
    max_leaves=4,
)
MAPS = (
    "arguments", "scenario_arguments", "versions", "files", "described", "argument_files", "variables", "divergence",
    "events", "distributions", "git",
)  # fmt: skip
"""Tables whose keys are names of something, and not those of a format."""
NEEDED = {
    "schema", "trial", "seed", "max_steps", "step", "outcome", "digest", "snapshot", "files", "integrity", "agent",
    "role", "collider", "number", "spec", "steps", "kind", "what", "paths", "described", "scenario", "oracles",
    "crash_on", "scratch", "folder", "path",
}  # fmt: skip


def grown(data, draw):
    """The data with keys of a later version at every level."""
    found = {}
    for name, value in data.items():
        if name == "agents":
            value = {agent: grown(setup, draw) for agent, setup in value.items()}
        elif isinstance(value, dict) and name not in MAPS:
            value = grown(value, draw)
        found[name] = value
    return found | {f"later {number}": draw(values) for number in range(draw(st.integers(0, 2)))}


def later_keys(data):
    return {name: value for name, value in data.items() if name.startswith("later")}


@pytest.fixture
def hunt(tmp_path):
    shutil.copytree(HUNT, tmp_path / "hunt")
    return tmp_path / "hunt"


def signed(data):
    data = {name: value for name, value in data.items() if name != "integrity"}
    return {**data, "integrity": digest_of_data(data)}


@given(data=st.data())
@shared
def test_a_crash_json_of_a_later_version_is_read_and_its_keys_are_kept(hunt, data):
    bundle = find_bundle(hunt, "0")
    file = bundle.path / "crash.json"
    written = json.loads((HUNT / "crashes" / bundle.id / "crash.json").read_text())
    later = signed(grown(written, data.draw))
    file.write_text(json.dumps(later))
    found = read_bundle(bundle.path)
    parts = ("collision", "failure", "escape", "event", "closest_approach")
    inside = {name: later_keys(later[name]) for name in parts if isinstance(later.get(name), dict)}
    assert dataclasses.replace(found, added={}) == bundle
    assert found.added == {**later_keys(later), **{name: keys for name, keys in inside.items() if keys}}
    found.write()
    again = json.loads(file.read_text())
    assert later_keys(again) == later_keys(later)
    assert {name: later_keys(again[name]) for name in inside} == inside
    assert read_bundle(bundle.path) == found
    file.write_text(json.dumps({**later, "later x": 1}))
    with pytest.raises(BundleError, match="the file has changed since it was written"):
        read_bundle(bundle.path)
    file.write_text(json.dumps(written))


@given(data=st.data())
@shared
def test_what_is_missing_of_a_crash_json_is_its_default(hunt, data):
    bundle = find_bundle(hunt, "0")
    file = bundle.path / "crash.json"
    written = json.loads((HUNT / "crashes" / bundle.id / "crash.json").read_text())
    optional = sorted(written.keys() - NEEDED)
    gone = set(data.draw(st.lists(st.sampled_from(optional), unique=True)))
    of_hit = sorted(written["collision"].keys() - NEEDED)
    gone_of_hit = set(data.draw(st.lists(st.sampled_from(of_hit), unique=True)))
    left = {name: value for name, value in written.items() if name not in gone}
    if "collision" in left:
        left["collision"] = {name: value for name, value in left["collision"].items() if name not in gone_of_hit}
    file.write_text(json.dumps(signed(left)))
    found = read_bundle(bundle.path)
    assert (found.result.spec.seed, found.result.digest) == (bundle.result.spec.seed, bundle.result.digest)
    assert (found.result.collision is None) == ("collision" in gone)
    if not gone:
        assert found.result.collision.collider == bundle.result.collision.collider
    file.write_text(json.dumps(signed({**left, "step": "9"})))
    with pytest.raises(BundleError, match="step is '9'"):  # what is known is checked as ever
        read_bundle(bundle.path)
    file.write_text(json.dumps(written))


@given(data=st.data())
@shared
def test_a_snapshot_of_a_later_version_is_read(hunt, data):
    snapshot = Snapshot(next((hunt / "snapshots").iterdir()))
    original = HUNT / "snapshots" / snapshot.digest
    before = Snapshot(original)
    manifest, environment = (
        json.loads((original / f"{name}.json").read_text()) for name in ("manifest", "environment")
    )
    asked = tomllib.loads((original / "hunt.toml").read_text())
    plain = (
        st.integers(0, 9) | st.text("ab", max_size=3) | st.dictionaries(st.text("xyz", min_size=1), st.integers(0, 9))
    )
    asked |= {f"later {n}": data.draw(plain) for n in range(2)} | {"run": {**asked["run"], "later": data.draw(plain)}}
    later = grown(environment, data.draw)
    (snapshot.path / "environment.json").write_text(json.dumps(later))
    (snapshot.path / "hunt.toml").write_text(tomli_w.dumps(asked))
    manifest = grown(manifest, data.draw)
    described = describe_files(snapshot.path)
    manifest["described"] = {name: described[name] for name in manifest["described"]}
    (snapshot.path / "manifest.json").write_text(json.dumps(signed(manifest)))
    again = Snapshot(snapshot.path)
    assert again.faults() == []
    assert again.settings == before.settings
    assert again.environment == later
    assert environment_changes(again.environment) == environment_changes(environment)
    assert again.scenario.agents == before.scenario.agents
    place = snapshot.path / "scenario" / "scenario.toml"
    said = tomllib.loads((original / "scenario" / "scenario.toml").read_text())
    said |= {f"later {n}": data.draw(plain) for n in range(2)}
    said["agents"]["ego"]["later"] = data.draw(plain)
    place.write_text(tomli_w.dumps(said))
    kept = dataclasses.replace(Snapshot(snapshot.path).scenario, folder=before.scenario.folder)
    assert kept == before.scenario
    crossed = dataclasses.replace(worker(hunt), scenario=kept).to_json()["scenario"]
    assert later_keys(crossed) == later_keys(said)  # for the worker of the version that has written them
    assert crossed["agents"]["ego"]["later"] == said["agents"]["ego"]["later"]
    with pytest.raises(ScenarioError, match="unknown key"):  # which somebody has written
        load_scenario(place)
    place.write_text((original / "scenario" / "scenario.toml").read_text())


def test_what_a_later_version_asked_is_kept_where_hunt_toml_is_written_again(hunt):
    file = hunt / "hunt.toml"
    asked = tomllib.loads(file.read_text())
    later = {**asked, "weather": {"every_s": 2}, "run": {**asked["run"], "probing": True}}
    file.write_text(tomli_w.dumps(later))
    settings = read_settings(file)
    write_settings(file, settings, ["crashhunt", "run"])
    assert tomllib.loads(file.read_text()) == later
    write_settings(hunt / "other.toml", settings, ["crashhunt", "run"], like=file)
    assert tomllib.loads((hunt / "other.toml").read_text()) == later


@pytest.mark.parametrize(
    ("was", "now"), [("max_steps", "max_stepz"), ("sampler", "smapler"), ("timeout_s", "timeut_s")]
)
def test_a_slip_in_hunt_toml_is_reported(hunt, was, now):
    file = hunt / "hunt.toml"
    file.write_text(file.read_text().replace(f"\n{was} =", f"\n{now} ="))
    with pytest.raises(HuntDirectoryError, match=f"unknown key '.*{now}'|the key '{was}' is missing"):
        read_settings(file)


def test_an_archive_of_a_later_version_is_read(hunt, tmp_path):
    target = tmp_path / "crash.zip"
    export_crash(find_bundle(hunt, "0"), target)
    with zipfile.ZipFile(target) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    index = json.loads(content["archive.json"])
    index["signed by"], index["files"]["hunt.toml"]["kind"] = ["nobody"], "text"
    del index["made_by"], index["made_at"], index["crash"]
    with zipfile.ZipFile(target, "w") as archive:
        for name, text in {**content, "archive.json": json.dumps(index).encode()}.items():
            archive.writestr(name, text)
    with open_archive(target) as opened:
        assert find_bundle(opened.directory).id == "000000-collision"
        assert (opened.made_by, opened.made_here) == ("?", False)


def worker(hunt):
    snapshot = Snapshot(next((hunt / "snapshots").iterdir()))
    settings = snapshot.settings
    return WorkerSettings(
        scenario=with_settings(snapshot.scenario, settings),
        oracles=settings.oracles,
        crash_on=settings.crash_on,
        scratch=hunt,
    )


@given(data=st.data())
@shared
def test_the_wire_to_a_worker_of_another_version(hunt, data):
    asked = worker(hunt)
    wire = json.loads(json.dumps(asked.to_json()))
    later = grown(wire, data.draw)
    for name in data.draw(st.lists(st.sampled_from(sorted(wire.keys() - NEEDED)), unique=True)):
        del later[name]
    assert WorkerSettings.from_json(later) == asked
    with pytest.raises(CrashhuntError, match=r"which .* does not support; pip install crashhunt=="):
        WorkerSettings.from_json({**later, "requires": ["sealed", "weather"]})
    result = find_bundle(hunt, "0").result
    wire = json.loads(json.dumps(result.to_json()))
    later = grown(copy.deepcopy(wire), data.draw)
    for name in data.draw(st.lists(st.sampled_from(sorted(wire.keys() - NEEDED)), unique=True)):
        del later[name]
    found = TrialResult.from_json(later)
    assert (found.spec, found.outcome, found.steps) == (result.spec, Outcome.COLLISION, result.steps)
    for name in wire.keys() & later.keys() - {"spec", "outcome"}:
        assert getattr(found, name) == getattr(result, name)


def test_what_is_essential_is_said_and_refused_by_those_who_do_not_know_it(hunt):
    asked = worker(hunt)
    assert "requires" not in asked.to_json()
    sealed = dataclasses.replace(asked, sealed=("/x",))
    assert sealed.to_json()["requires"] == ["sealed"]
    assert WorkerSettings.from_json(sealed.to_json()) == sealed
    spec = TrialSpec(3, 1, {}, {}, max_steps=5)
    assert "requires" not in spec.to_json()
    overruled = dataclasses.replace(spec, overruled=Overruled("ego", 2))
    assert overruled.to_json()["requires"] == ["overruled"]
    assert TrialSpec.from_json(overruled.to_json()) == overruled
    with pytest.raises(CrashhuntError, match="trial 3 has fork, which crashhunt"):
        TrialSpec.from_json({**spec.to_json(), "requires": ["fork"]})


def test_what_is_not_known_is_left_aside_and_put_back():
    @dataclasses.dataclass
    class Inner:
        a: int = 0
        b: int | None = dataclasses.field(default=None, metadata=ESSENTIAL)

    data = {"scenario": "x", "agents": {"ego": {"agent": "m:A", "later": 1}}, "later": {"a": [1]}}
    known, rest = known_part(HuntSettings, data)
    assert known == {"scenario": "x", "agents": {"ego": {"agent": "m:A"}}}
    assert rest == {"agents": {"ego": {"later": 1}}, "later": {"a": [1]}}
    assert merged(known, rest) == data
    assert merged({"agents": {}, "later": 2}, rest) == {"agents": {"ego": {"later": 1}}, "later": 2}
    assert required_in({"x": [Inner(), Inner(b=1)]}) == ["b"]
