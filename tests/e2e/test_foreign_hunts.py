"""A folder that came from elsewhere: no command runs its code before this user trusts it, and none asks twice."""

from __future__ import annotations

import json
import os
import sys
from contextlib import closing
from pathlib import Path

import pytest
from conftest import mostly_nightly

import crashhunt
from crashhunt.corpus import run_cases
from crashhunt.crashes import find_bundle, is_bundle_made_here
from crashhunt.errors import UntrustedError

AGENT = """
import os
with open(os.environ.get("RAN", os.devnull), "a") as file:
    file.write("it ran")

class Agent:
    def __init__(self, speed: float = 20.0): self.speed = speed
    def reset(self, seed): pass
    def act(self, observation): return self.speed, 0
"""
HUNT = ("run", "h", "1", "2", "99", "--scenario", "toy", "--agent", "theirs:Agent", "--seed", "1", "--keep-going")


def hunted(shell):
    shell.environment["XDG_STATE_HOME"] = str(shell.folder / "their state")
    (shell.folder / "theirs.py").write_text(AGENT)
    shell.crashhunt(*HUNT)
    for crash in sorted((shell.folder / "h" / "crashes").iterdir()):
        shell.crashhunt("corpus", "add", str(crash), "--to", "corpus")
    shell.crashhunt("export", "h", "their.zip")


@pytest.fixture
def theirs(toy, made_once, monkeypatch):
    """A hunt of another user, its corpus and an export; what it runs leaves a file ``ran``."""
    made_once(hunted, toy)
    for name, value in (("XDG_STATE_HOME", toy.folder / "state"), ("RAN", toy.folder / "ran")):
        toy.environment[name] = str(value)
        monkeypatch.setenv(name, str(value))
    for environment in (toy.environment, os.environ):
        environment.pop("CI", None)
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(toy.folder.parent))
    monkeypatch.chdir(toy.folder)
    return toy


def ran(shell):
    return (shell.folder / "ran").exists()


COMMANDS = (
    "replay h",
    "replay h --code current",
    "replay h --force --times 2",
    "replay h --until 3",
    "replay h --frames film",
    "judge h",
    "judge h --all",
    "shrink h",
    "whatif h --from-step 1 --futures",
    "whatif h --agent theirs:Agent --arg speed=3",
    "whatif h --from-step 1 --set speed=3",
    "whatif their.zip --set speed=3",
    "corpus add h/crashes/000000-collision --to new",
    "corpus run corpus",
    "corpus run corpus --keep kept",
    "bisect h --good HEAD",
    "bisect their.zip --good HEAD",
    "rerun h --all",
    "rerun h --to elsewhere --set trials=1",
    "replay their.zip",
    "judge their.zip",
)


@pytest.mark.parametrize("command", mostly_nightly(COMMANDS, always=(COMMANDS[0], *COMMANDS[6::6])))
def test_command_refuses_in_one_line_and_runs_nothing(theirs, command):
    words = command.split()
    before = sorted(theirs.folder.rglob("*"))
    done = theirs.crashhunt(*words, expect=2)
    assert "theirs:Agent" in done.err
    assert "--trust" in done.err
    assert "crashhunt trust " in done.err
    assert len(done.err.splitlines()) == 1
    assert done.out == ""
    assert not ran(theirs)
    new = {path.relative_to(theirs.folder).parts[0] for path in {*theirs.folder.rglob("*")} - {*before}}
    assert new <= {"state"}
    said = theirs.crashhunt(*words, "--json", expect=2).json["error"]
    assert "theirs:Agent" in said["message"]
    assert "crashhunt trust " in said["fix"]


def test_commands_that_only_read_still_do(theirs):
    for words in (
        ("show", "h"),
        ("report", "h"),
        ("status", "h"),
        ("logs", "h"),
        ("trials", "h"),
        ("crashes", "h"),
        ("check", "h"),
        ("export", "h", "again.zip"),
        ("corpus", "list", "corpus"),
        ("replay", "h", "--from-log"),
        ("trust", "h"),
    ):
        theirs.crashhunt(*words)
        assert not ran(theirs), words


def test_python_refuses_as_well(theirs):
    with pytest.raises(UntrustedError, match="theirs:Agent"):
        crashhunt.replay("h")
    with pytest.raises(UntrustedError, match="theirs:Agent"):
        crashhunt.load("h").agent(0)
    with pytest.raises(UntrustedError, match="theirs:Agent"):
        run_cases([path.parent for path in Path("corpus").glob("*/crashhunt-case.toml")])
    assert not ran(theirs)
    assert crashhunt.replay("h", trust=True).verdict == "reproduced"
    assert ran(theirs)
    sys.modules.pop("theirs", None)
    assert crashhunt.load("h").agent(0, trust=True).speed == 20.0


@pytest.mark.nightly
def test_one_command_trusts_a_folder_for_all_others(theirs):
    theirs.crashhunt("trust", "h", "corpus")
    assert not ran(theirs)
    for words in (
        ("replay", "h"),
        ("replay", "h", "--crash", "1"),
        ("replay", "their.zip"),
        ("corpus", "run", "corpus"),
    ):
        theirs.crashhunt(*words, expect=0)
    theirs.crashhunt("judge", "h", "--runs", "2", "--why", "0")
    theirs.crashhunt("shrink", "h", "--budget", "12")
    (small,) = (theirs.folder / "h" / "crashes").glob("*.small")
    theirs.crashhunt("replay", str(small))
    theirs.crashhunt("trust", "--remove", "h")
    for folder in ("h", str(small)):  # what was made of it is no more trusted than it is
        theirs.crashhunt("replay", folder, expect=2)


@pytest.mark.nightly
def test_trust_for_one_command_makes_nothing_ones_own(theirs):
    theirs.crashhunt("replay", "h", "--trust")
    theirs.crashhunt("judge", "h", "--trust", "--runs", "2", "--why", "0")
    theirs.crashhunt("shrink", "h", "--trust", "--budget", "12")
    (small,) = (theirs.folder / "h" / "crashes").glob("*.small")
    theirs.crashhunt("export", "h", "laundered.zip")
    for place in ("h", str(small), "laundered.zip"):
        theirs.crashhunt("replay", place, expect=2)


@pytest.mark.nightly
def test_hunt_that_continues_runs_no_code_of_another_user(theirs):
    """What is there already would run from the snapshot of the other user, and other code is refused."""
    crash = find_bundle(theirs.folder / "h", "0")
    data = json.loads((crash.path / "crash.json").read_text())
    assert data["confirmed"] is True
    from crashhunt.base.integrity import digest_of_data

    del data["integrity"]
    data["confirmed"] = None
    (crash.path / "crash.json").write_text(json.dumps({**data, "integrity": digest_of_data(data)}))
    changed = theirs.folder / "theirs.py"
    changed.write_text(AGENT.replace("it ran", "mine").replace("RAN", "MINE"))
    assert "the code has changed" in theirs.crashhunt(*HUNT, "--near-misses", "2", expect=2).err
    assert not ran(theirs)
    changed.write_text(AGENT)
    done = theirs.crashhunt(*HUNT)
    assert f"{crash.id} was not confirmed" in done.out
    assert "crashhunt trust" in done.out
    assert find_bundle(theirs.folder / "h", "0").confirmed is None
    theirs.crashhunt("trust", "h")
    theirs.crashhunt(*HUNT)
    assert find_bundle(theirs.folder / "h", "0").confirmed is True


def test_what_is_added_to_a_corpus_is_ones_own(theirs):
    theirs.crashhunt("corpus", "add", "h/crashes/000000-collision", "--to", "mine", "--trust")
    (case,) = (theirs.folder / "mine").iterdir()
    assert is_bundle_made_here(find_bundle(case))
    theirs.crashhunt("corpus", "run", "mine")


@pytest.mark.nightly
def test_suite_that_continues_in_a_foreign_folder_is_refused(theirs):
    suite = """
    [defaults]
    scenario = "toy"
    agent = "theirs:Agent"
    trials = 2
    max_steps = 20
    [[hunts]]
    id = "a"
    """
    (theirs.folder / "suite.toml").write_text(suite.replace("\n    ", "\n"))
    mine = theirs.environment["XDG_STATE_HOME"]
    theirs.environment["XDG_STATE_HOME"] = str(theirs.folder / "their state")
    theirs.crashhunt("suite", "run", "suite.toml", "out", "--json")
    theirs.crashhunt("rerun", "out", "--all", "--json")
    from crashhunt.ledger import Ledger

    with closing(Ledger(theirs.folder / "out/a/0/ledger.sqlite", writable=True)) as ledger:
        ledger.enter("interrupted", "")
    theirs.environment["XDG_STATE_HOME"] = mine
    (theirs.folder / "ran").unlink(missing_ok=True)
    for words in (("suite", "run", "suite.toml", "out"), ("rerun", "out")):
        refused = theirs.crashhunt(*words, expect=2)
        assert "theirs:Agent" in refused.err
        assert "crashhunt trust out/a/0" in refused.err
    assert not ran(theirs)
    theirs.crashhunt("trust", "out")
    theirs.crashhunt("suite", "run", "suite.toml", "out")
    theirs.crashhunt("rerun", "out", "--all")
    assert ran(theirs)
