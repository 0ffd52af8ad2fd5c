"""A replay needs the bundle and nothing else, and says where it differs."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

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


@pytest.fixture
def crash(shell):
    (shell.folder / "my_pkg").mkdir()
    (shell.folder / "my_pkg" / "__init__.py").write_text("")
    (shell.folder / "my_pkg" / "agents.py").write_text(AGENT)
    (shell.folder / "helper.py").write_text("WORDS = 'out of ideas'\nGAIN = 0.01\n")
    shutil.copytree(Path(__file__).parents[2] / "scenarios" / "loop", shell.folder / "own")
    words = (
        "run",
        "h",
        "1",
        "2",
        "100",
        "--scenario",
        "own",
        "--agent",
        "my_pkg.agents:Planner",
        "--set",
        "vehicles=10",
    )
    shell.crashhunt(*words)
    return shell


def test_the_originals_may_be_gone(crash):
    for name in ("my_pkg", "own"):
        shutil.rmtree(crash.folder / name)
    (crash.folder / "helper.py").write_text("WORDS = 'something else'\nGAIN = 5.0\n")
    moved = crash.folder / "elsewhere"
    (crash.folder / "h").rename(moved)
    verdict = crash.crashhunt("replay", "elsewhere", "--json").json
    assert (verdict["verdict"], verdict["code"], verdict["steps_replayed"]) == ("reproduced", "snapshot", 29)
    (bundle,) = (moved / "crashes").iterdir()
    assert crash.crashhunt("replay", str(bundle), "--json").json == verdict


def test_the_actions_of_the_log_lead_to_the_same_scenes(crash):
    verdict = crash.crashhunt("replay", "h", "--from-log", "--json").json
    assert (verdict["verdict"], verdict["code"], verdict["divergence"]) == ("reproduced", "log", None)


def test_a_change_is_found_where_it_happens(crash):
    """Change the code in the snapshot as if it had always been so, and see what the replay says."""
    (snapshot,) = (crash.folder / "h" / "snapshots").iterdir()
    agents = snapshot / "code" / "my_pkg" / "agents.py"
    agents.write_text(
        AGENT.replace("return self.speed + self.step", "return self.speed + (self.step > 17) + self.step")
    )
    refused = crash.crashhunt("replay", "h", expect=2)
    assert "agents.py" in refused.err
    assert "changed since" in refused.err
    manifest = snapshot / "manifest.json"
    data = json.loads(manifest.read_text())
    from crashhunt.snapshot import _hash

    data["files"]["code/my_pkg/agents.py"]["blake2b"] = _hash(agents)
    manifest.write_text(json.dumps(data))
    done = crash.crashhunt("replay", "h", "--json", expect=1)
    assert done.json["verdict"] == "diverged"
    assert done.json["divergence"]["step"] == 18
    assert done.json["divergence"]["agent"] == "ego"
    assert done.json["divergence"]["field"] == "action[target_speed]"
    assert done.json["divergence"]["replayed"] == pytest.approx(done.json["divergence"]["recorded"] + 1)
    # The recorded actions do not need the code, changed or not.
    assert crash.crashhunt("replay", "h", "--from-log", "--json").json["verdict"] == "reproduced"


@pytest.mark.parametrize(("step", "field"), [(25, "length"), (35, "action")])
def test_a_run_that_is_shorter_or_longer_diverges(crash, step, field):
    (snapshot,) = (crash.folder / "h" / "snapshots").iterdir()
    agents = snapshot / "code" / "my_pkg" / "agents.py"
    agents.write_text(AGENT.replace("== 30", f"== {step}"))
    manifest = snapshot / "manifest.json"
    data = json.loads(manifest.read_text())
    from crashhunt.snapshot import _hash

    data["files"]["code/my_pkg/agents.py"]["blake2b"] = _hash(agents)
    manifest.write_text(json.dumps(data))
    divergence = crash.crashhunt("replay", "h", "--json", expect=1).json["divergence"]
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


def test_replay_takes_the_crash_with_the_fewest_steps(shell):
    words = ("run", "h", "2", "6", "200", "--agent", "faulty:Raises", "--arg", "at=5:60", "--set", "vehicles=10")
    report = shell.crashhunt(*words, "--keep-going", "--json").json
    steps = [crash["step"] for crash in report["crashes"]]
    assert steps == sorted(steps)
    assert shell.crashhunt("replay", "h", "--json").json["crash"] == report["crashes"][0]["id"]
    done = shell.crashhunt("replay", "h", "--crash", "77", expect=2)
    assert report["crashes"][0]["id"] in done.err
