"""A stranger's crash, with the actions that were recorded: it simulates, and does nothing else."""

from __future__ import annotations

import gzip
import hashlib
import json
import zipfile
from typing import TYPE_CHECKING

import pytest
from conftest import Shell
from test_replay import hunted_on_sumo

from crashhunt.base.sandbox import landlock_version
from crashhunt.crashes import find_bundle, open_archive
from crashhunt.errors import CrashhuntError, UsageError
from crashhunt.replays import ReplayOptions, replay

if TYPE_CHECKING:
    from pathlib import Path

STRANGER = ReplayOptions(code="log", force=True, trusted=False)
OPTIONS, ROUTES = "scenario/scenario.toml", "scenario/traffic.rou.xml"


@pytest.fixture(scope="module")
def crash(tmp_path_factory):
    """A crash of the shipped scenario without its code, hundreds of files that recorded actions have no need of."""
    shell = Shell(tmp_path_factory.mktemp("exported"))
    words = ("--arg", "speed=19", "--set", "vehicles=35", "--seed", "1", "--timeout", "140", "--no-snapshot")
    done = shell.crashhunt("run", "h", "1", "9", "600", *words, "--json", expect=None)
    assert done.json["crashes"], done.err
    shell.crashhunt("export", "h", "crash.zip")
    return shell.folder / "crash.zip"


@pytest.fixture
def with_code(shell, made_once):
    """A crash of a copy of the shipped scenario, with its code; `test_replay` hunts for it as well."""
    made_once(hunted_on_sumo, shell).crashhunt("export", "h", "crash.zip")
    return shell.folder / "crash.zip"


def changed(source: Path, target: Path, *edits: tuple[str, str, str]) -> Path:
    """Copy an exported crash with texts of its files replaced, as somebody would who has read how it is checked."""
    files = {}
    with zipfile.ZipFile(source) as old:
        for name in old.namelist():
            files[name] = old.read(name)
    for file, before, after in edits:
        name = file if file in files else next(name for name in files if name.endswith(f"/{file}"))
        assert before.encode() in files[name], file
        files[name] = files[name].replace(before.encode(), after.encode(), 1)
        if ".add.xml" in after:
            files[name.replace("scenario.toml", "d.add.xml")] = after.partition("<!--")[2].partition("-->")[0].encode()
    index = json.loads(files.pop("archive.json"))
    for name, data in files.items():
        digest = hashlib.blake2b(data, digest_size=16).hexdigest()
        index["files"][name] = {"size": len(data), "blake2b": digest}
    with zipfile.ZipFile(target, "w") as new:
        for name, data in {**files, "archive.json": json.dumps(index).encode()}.items():
            new.writestr(name, data)
    return target


def option(name: str, value: object) -> tuple[str, str, str]:
    return OPTIONS, "[sumo.options]", f"[sumo.options]\n{json.dumps(name)} = {json.dumps(value)}"


def detector(victim: Path) -> tuple[str, str, str]:
    """An additional file, which stands in a comment of the scenario."""
    loop = f'<inductionLoop id="d" lane="south_0" pos="5" period="1" file="{victim}"/>'
    text = f'# <!--<additional>{loop}</additional>-->\nadditional = ["d.add.xml"]\nnet = '
    return OPTIONS, "net = ", text


ADDITIONAL = (OPTIONS, "additional = []\n", "")
# Of the issue, and what else came to mind.
NAMES = ["netstate-dump", "ndump", "tripinfo", "summary", "vehroutes", "C", "l", "log-file", "save-state.prefix"]
NAMES += ["device.ssm.file", "device.toc.file", "fcd-output", "made-up", "remote-port", "configuration-file", "weights"]


DOORS_OPEN = """
from crashhunt.sumo import _files as files
files.is_output = files.is_shown = lambda name: False
files.rewritten = lambda content, *_: content
files.FIXED_OPTIONS.pop("device.ssm.file", None)
"""


@pytest.mark.nightly  # by day, base/test_sandbox.py, and executors/test_zygotes.py seals
@pytest.mark.skipif(not landlock_version(), reason="this kernel has no Landlock")
@pytest.mark.parametrize("attack", ["netstate-dump", "C", "a detector"])
def test_the_kernel_alone_holds_what_has_got_past_all_else(crash, tmp_path, monkeypatch, attack):
    victim = tmp_path / "victim"
    victim.write_text("mine")
    edits = [ADDITIONAL, detector(victim)] if attack == "a detector" else [option(attack, str(victim))]
    (tmp_path / "open").mkdir()
    (tmp_path / "open" / "sitecustomize.py").write_text(DOORS_OPEN)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "open"))
    monkeypatch.setattr("crashhunt.replays._prepare.refuse_side_effects", lambda *_: None)
    with open_archive(changed(crash, tmp_path / "bad.zip", *edits)) as archive:
        bundle = find_bundle(archive.directory, "")
        try:
            verdict = replay(bundle, STRANGER).verdict
        except CrashhuntError as error:
            verdict = str(error)
        assert verdict != "reproduced"
        assert victim.read_text() == "mine"
        if attack == "netstate-dump":  # it is the kernel that has held
            replay(bundle, ReplayOptions(code="log", force=True, trusted=True))
            assert "netstate" in victim.read_text()


EVIL = 'from pathlib import Path\nPath("evil was here").touch()\n'


@pytest.mark.parametrize(
    ("file", "before", "after"),
    [
        ("hunt.toml", 'agent = "my_pkg.agents:Planner"', 'agent = "evil:Agent"'),
        pytest.param("hunt.toml", 'sampler = "random"', 'sampler = "evil:Sampler"', marks=pytest.mark.nightly),
        pytest.param("hunt.toml", '"overlap"', '"evil:Oracle"', marks=pytest.mark.nightly),
        pytest.param(OPTIONS, 'simulator = "sumo"', 'simulator = "evil:Simulator"', marks=pytest.mark.nightly),
        pytest.param(OPTIONS, 'agent = "my_pkg.agents:Planner"', 'agent = "evil:Agent"', marks=pytest.mark.nightly),
    ],
)
def test_no_code_is_imported(with_code, tmp_path, monkeypatch, capsys, file, before, after):
    from crashhunt.cli import main

    (tmp_path / "evil.py").write_text(EVIL)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "of another machine"))
    changed(with_code, tmp_path / "bad.zip", (file, before, after))
    for words in (
        ["show", "bad.zip"],
        ["report", "bad.zip", "--output", "x.html"],
        ["replay", "bad.zip", "--from-log"],
    ):
        with pytest.raises(SystemExit):
            main(words)
    assert not (tmp_path / "evil was here").exists()


def test_gymnasium_may_import_nothing_either(tmp_path):
    from crashhunt.crashes import refuse_side_effects
    from crashhunt.plans import HuntSettings
    from crashhunt.scenario import scenario_from_dict

    settings = HuntSettings(scenario="x", scenario_digest="", trials=1, max_steps=1, seed=1)

    def refused(values: dict[str, object], **tables: object) -> str:
        scenario = scenario_from_dict(dict(tables), where="here", folder=tmp_path)
        with pytest.raises(UsageError) as caught:
            refuse_side_effects(scenario, settings, values)
        return str(caught.value)

    assert "'evil'" in refused({}, simulator="gym", gym={"id": "evil:Env-v0"})
    assert "'evil'" in refused({}, simulator="gym", gym={"id": "CartPole-v1", "crash": {"function": "evil:crash"}})
    assert "arguments" in refused({}, simulator="gym", gym={"id": "CartPole-v1", "kwargs": {"a": 1}})
    assert "arguments" in refused({"a": 1}, simulator="gym", gym={"id": "CartPole-v1"})
    assert "'evil'" in refused({}, simulator="highway", highway={"id": "evil:highway-v0"})
    assert "os.system" in refused({"other_vehicles_type": "os.system"}, simulator="highway", highway={"id": "merge-v0"})


def test_a_compressed_file_without_end_is_refused(tmp_path, monkeypatch):
    from crashhunt.sumo import _files as _sumo_xml

    monkeypatch.setattr(_sumo_xml, "_MAX_BYTES", 1000)
    (tmp_path / "a.xml.gz").write_bytes(gzip.compress(bytes(10_000)))
    with pytest.raises(CrashhuntError, match="cannot be read"):
        _sumo_xml.read_xml(tmp_path / "a.xml.gz")
