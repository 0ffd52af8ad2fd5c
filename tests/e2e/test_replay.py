"""A replay needs the bundle and nothing else, and says where it differs."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from conftest import add_toy, rewritten

from crashhunt.base.version import __version__
from crashhunt.corpus._case_runs import _run_case
from crashhunt.crashes import find_bundle
from crashhunt.replays import ReplayOptions, prepare
from crashhunt.sumo import SumoSetup

AGENT = '''
import helper

class Planner:
    """Keeps its speed; a user's agent with a module beside it."""

    def __init__(self, speed: float = 8.0):
        self.speed = speed

    def reset(self, seed):
        self.step = 0

    def act(self, observation):
        self.step += 1
        if self.step == 30:
            raise ValueError(helper.WORDS)
        return self.speed + self.step * helper.GAIN, 0
'''


def write_planner(shell):
    (shell.folder / "my_pkg").mkdir()
    (shell.folder / "my_pkg" / "__init__.py").write_text("")
    (shell.folder / "my_pkg" / "agents.py").write_text(AGENT)
    (shell.folder / "helper.py").write_text("WORDS = 'out of ideas'\nGAIN = 0.01\n")


def hunted(shell):
    write_planner(shell)
    words = ("--scenario", "own", "--agent", "my_pkg.agents:Planner", "--set", "gap_m=30")
    add_toy(shell).folder.joinpath("toy").rename(shell.folder / "own")
    shell.crashhunt("run", "h", "1", "2", "100", *words)


def hunted_on_sumo(shell):
    write_planner(shell)
    shutil.copytree(Path(__file__).parents[2] / "scenarios" / "loop", shell.folder / "own")
    words = ("--scenario", "own", "--agent", "my_pkg.agents:Planner", "--set", "vehicles=10")
    shell.crashhunt("run", "h", "1", "2", "100", *words)


@pytest.fixture
def crash(shell, made_once):
    return made_once(hunted, shell)


@pytest.fixture
def crash_on_sumo(shell, made_once):
    return made_once(hunted_on_sumo, shell)


def test_the_actions_of_the_log_lead_to_the_same_scenes(crash):
    verdict = crash.crashhunt("replay", "h", "--from-log", "--json").json
    assert (verdict["verdict"], verdict["code"], verdict["divergence"]) == ("reproduced", "log", None)


def change_snapshot(crash, before: str, after: str) -> None:
    (snapshot,) = (crash.folder / "h" / "snapshots").iterdir()
    agents = snapshot / "code" / "my_pkg" / "agents.py"
    assert before in agents.read_text()
    agents.write_text(agents.read_text().replace(before, after))


def test_a_change_is_found_where_it_happens(crash):
    change_snapshot(crash, "return self.speed + self.step", "return self.speed + (self.step > 17) + self.step")
    refused = crash.crashhunt("replay", "h", expect=2)
    assert "code/my_pkg/agents.py has changed" in refused.err
    assert "--force" in refused.err
    again = crash.crashhunt("replay", "h", "--force", expect=2)
    assert "code/my_pkg/agents.py has changed" in again.err  # whoever changed it
    assert "--trust" in again.err
    done = crash.crashhunt("replay", "h", "--force", "--trust", "--json", expect=1)
    assert done.json["verdict"] == "diverged"
    assert any("agents.py has changed" in warning for warning in done.json["warnings"])
    assert done.json["divergence"]["step"] == 18
    assert done.json["divergence"]["agent"] == "ego"
    assert done.json["divergence"]["field"] == "action[target_speed]"
    assert done.json["divergence"]["replayed"] == pytest.approx(done.json["divergence"]["recorded"] + 1)
    # For people, with the steps around it.
    shown = done.err.splitlines()
    (marked,) = (line for line in shown if "<- first difference" in line)
    assert marked.split()[:3] == [
        "18",
        str(done.json["divergence"]["recorded"]),
        str(done.json["divergence"]["replayed"]),
    ]
    assert [line.split()[0] for line in shown[shown.index(marked) - 2 : shown.index(marked) + 3]] == [
        "16", "17", "18", "19", "20",
    ]  # fmt: skip
    # The recorded actions do not need the code, changed or not.
    assert crash.crashhunt("replay", "h", "--from-log", "--force", "--json").json["verdict"] == "reproduced"


@pytest.mark.parametrize(("step", "field"), [pytest.param(25, "length", marks=pytest.mark.nightly), (35, "action")])
def test_a_run_that_is_shorter_or_longer_diverges(crash, step, field):
    change_snapshot(crash, "== 30", f"== {step}")
    divergence = crash.crashhunt("replay", "h", "--force", "--trust", "--json", expect=1).json["divergence"]
    assert divergence["step"] == min(step, 30)
    assert divergence["field"] in (field, "action")


def test_a_damaged_bundle_is_refused(crash):
    (bundle,) = (crash.folder / "h" / "crashes").iterdir()
    log = bundle / "log.mcap"
    whole = log.read_bytes()
    for name, data in (("cut", whole[: len(whole) // 2]), ("flipped", _flip(whole)), ("empty", b"")):
        log.write_bytes(data)
        done = crash.crashhunt("replay", "h", expect=2)
        assert "log.mcap" in done.err, name
        assert len(done.err.strip().splitlines()) == 1
    log.write_bytes(whole)
    (bundle / "crash.json").write_text("{}")
    assert "crash.json" in crash.crashhunt("replay", "h", expect=2).err


def _flip(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]


def edit(path: Path, before: str, after: str) -> None:
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after))


@pytest.mark.nightly
def test_an_agent_that_is_not_deterministic_is_found_out(toy):
    (toy.folder / "coin.py").write_text(
        "import os\n\nclass Agent:\n    def reset(self, seed): self.step = 0\n\n"
        "    def act(self, observation):\n        self.step += 1\n        assert self.step < 20\n"
        "        return 5 + int.from_bytes(os.urandom(6)) / 2**49 * (self.step > 9), 0\n"
    )
    hunt = toy.crashhunt("run", "h", "1", "1", "100", "--agent", "coin:Agent", "--scenario", "toy", "--json").json
    (crash,) = hunt["crashes"]
    assert (crash["step"], crash["confirmed"]) == (19, False)
    assert hunt["steps_total"] == 2 * 19  # what was simulated to confirm it is in vain
    saved = json.loads((toy.folder / crash["path"] / "crash.json").read_text())["divergence"]
    assert (saved["step"], saved["field"]) == (10, "action[target_speed]")
    done = toy.crashhunt("replay", "h", "--times", "3", "--json", expect=1).json
    assert (done["verdict"], done["times"]) == ("diverged", 3)
    assert done["divergence"]["step"] == 10
    assert done["divergence"]["field"] == "action[target_speed]"
    assert done["agreed"] < 3


def test_a_crash_keeps_the_order_of_links_that_it_was_recorded_with(crash_on_sumo, monkeypatch):
    crash = crash_on_sumo
    (snapshot,) = (crash.folder / "h" / "snapshots").iterdir()
    environment = json.loads((snapshot / "environment.json").read_text())

    def prepared(code, **recorded):
        rewritten(snapshot, "environment.json", json.dumps({**environment, **recorded}))
        rerun = prepare(find_bundle(crash.folder / "h"), ReplayOptions(code=code))
        return rerun.worker.scenario.table(SumoSetup).fix_link_order, rerun.warnings

    monkeypatch.setattr("crashhunt.native._link_order._load_library", lambda: "/somewhere/library.so")
    monkeypatch.setattr("crashhunt.native._link_order._interface", lambda: 1)
    for code in ("current", "snapshot"):
        assert prepared(code, load_order="fixed") == (None, ())
        assert prepared(code, load_order="not fixed: the library is not built") == (False, ())
    monkeypatch.setattr("crashhunt.native._link_order._load_library", lambda: None)
    warning = "the order of SUMO's links was fixed and is not fixed: the library is not built"
    assert prepared("current", load_order="fixed") == (None, (warning,))
    del environment["load_order"]
    assert prepared("current") == (False, ())
    same = crash.crashhunt("replay", "h", "--code", "current", "--json").json
    assert (same["verdict"], same["warnings"]) == ("reproduced", [])


def test_a_case_keeps_the_order_of_links_that_it_was_recorded_with(crash_on_sumo, monkeypatch):
    crash = crash_on_sumo
    crash.crashhunt("corpus", "add", "h", "--to", "cases")
    (path,) = (crash.folder / "cases").iterdir()
    (snapshot,) = (path / "snapshots").iterdir()
    environment = json.loads((snapshot / "environment.json").read_text())
    asked = []
    monkeypatch.setattr("crashhunt.corpus._case_runs.run_alone", lambda worker, *given: asked.append(worker) or ())
    monkeypatch.setattr("crashhunt.native._link_order._load_library", lambda: None)
    missing = "the order of SUMO's links was fixed and is not fixed: the library is not built, which may be why"
    for recorded, kept, warnings in (({}, False, ()), ({"load_order": "fixed"}, None, (missing,))):
        environment.pop("load_order", None)
        rewritten(snapshot, "environment.json", json.dumps({**environment, **recorded}))
        report = _run_case(path, None, lambda: False)
        assert asked.pop().scenario.table(SumoSetup).fix_link_order is kept
        assert report.warnings == warnings


def test_a_snapshot_of_a_crashhunt_that_runs_trials_in_another_way_states_so(crash):
    (snapshot,) = (crash.folder / "h" / "snapshots").iterdir()
    code = snapshot / "code" / "crashhunt"
    edit(code / "episode" / "_worker_settings.py", "_SCHEMA = 1", "_SCHEMA = 99")
    edit(code / "base" / "version.py", f'__version__ = "{__version__}"', '__version__ = "7.8.9"')
    for words in ((), ("--until", "5")):
        refused = crash.crashhunt("replay", "h", "--force", "--trust", *words, expect=2)
        assert "the snapshot has crashhunt 7.8.9" in refused.err
        assert "pip install crashhunt==7.8.9" in refused.err
    current = crash.crashhunt("replay", "h", "--force", "--trust", "--code", "current", "--json")
    assert current.json["verdict"] == "reproduced"


def test_the_recorded_actions_run_no_code_of_the_bundle(crash):
    (snapshot,) = (crash.folder / "h" / "snapshots").iterdir()
    for module in (
        "my_pkg/agents.py",
        "my_pkg/__init__.py",
        "helper.py",
        "crashhunt/__init__.py",
        "crashhunt/episode/__init__.py",
    ):
        (snapshot / "code" / module).write_text(f"open('evil', 'a').write({module!r})\n")
    crash.crashhunt("replay", "h", "--from-log", "--force")
    assert not (crash.folder / "evil").exists()
