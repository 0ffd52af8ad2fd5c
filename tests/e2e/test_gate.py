"""A verdict on a change: `crashhunt gate` of two agents, of two commits, and of the hunts of a suite."""

from __future__ import annotations

import json
import signal
import sqlite3
import xml.etree.ElementTree as ET
from contextlib import closing

import pytest
from conftest import one_in, wait_for
from repositories import git

DRIVERS = """
class Calm:
    def __init__(self, speed: float = 3.0):
        self.speed = speed

    def reset(self, seed):
        pass

    def act(self, observation):
        return (self.speed, 0)


class Wild(Calm):
    def __init__(self):
        super().__init__(14.0)


class Twin(Calm):
    pass


"""
TOY = ("--scenario", "toy", "--set", "gap_m=20:30", "--max-steps", "99", "--parallel", "1")
CALM, WILD, TWIN = "drivers:Calm", "drivers:Wild", "drivers:Twin"
SEED = ("--seed", "4")


@pytest.fixture
def drivers(toy):
    (toy.folder / "drivers.py").write_text(DRIVERS)
    return toy


def gate(shell, *words, expect):
    return shell.crashhunt("gate", *words, *TOY, "--json", expect=expect).json


def specs(folder):
    with closing(sqlite3.connect(folder / "ledger.sqlite")) as database:
        return {
            number: json.loads(text)["spec"] for number, text in database.execute("SELECT number, result FROM trials")
        }


def test_worse_agent_fails_the_gate_and_the_hunts_stay_for_compare(drivers):
    report = ("--markdown", "m.md", "--junit", "j.xml", "--summary", "s.md", "--annotate")
    # Trials of BASE end without a crash, many times as fast as those of HEAD: more of them than pairs are no use.
    most = ("--most", "7", "--confidence", "80")
    done = drivers.crashhunt("gate", CALM, WILD, *TOY, *SEED, *most, "--keep", "kept", "--json", *report, expect=1)
    found = done.json
    assert (found["verdict"], found["pairs"], found["only_base"], found["only_head"]) == ("worse", 5, 0, 5)
    assert found["evidence"] >= 5
    assert 0 < found["difference"]["low"] < 1 == found["difference"]["high"]
    assert found["base"]["certain"]["low"] == 0 < found["head"]["certain"]["low"]  # BASE has as many trials as fit
    assert (found["corpus"], found["dir"], found["seed"], found["interrupted"]) == (None, "kept", 4, False)
    assert done.err.splitlines()[-1].startswith("::error title=crashhunt gate%3A worse")
    assert "| 5 | 0 | 5 | 0 |" in (drivers.folder / "m.md").read_text()
    assert "❌ crashhunt gate: worse" in (drivers.folder / "s.md").read_text()
    suite = ET.parse(drivers.folder / "j.xml").find("testsuite")
    assert (suite.get("tests"), suite.get("failures"), suite.get("errors")) == ("1", "1", "0")
    assert suite.find("testcase/failure").get("type") == "worse"
    (pair,) = drivers.crashhunt("compare", "kept", "--json").json["pairs"]
    assert pair["only_first"] == 0
    assert pair["only_second"] >= 5
    trials = len(specs(drivers.folder / "kept" / "head"))
    again = gate(drivers, CALM, WILD, *SEED, *most, "--keep", "kept", expect=1)
    assert {**again, "base": 0, "head": 0} == {**found, "base": 0, "head": 0}
    assert len(specs(drivers.folder / "kept" / "head")) == trials  # decided before, so nothing runs
    refused = drivers.crashhunt("gate", CALM, TWIN, *TOY, *SEED, "--keep", "kept", expect=2)
    assert "the directory contains a gate with other versions, hunts or seeds" in refused.err
    refused = drivers.crashhunt("gate", CALM, WILD, *TOY, *SEED, "--keep", "kept", "--set", "gap_m=5", expect=2)
    assert "--set" in refused.err  # given twice


@pytest.fixture
def repository(drivers):
    """A repository with a calm driver, then a wild one, then a calm one that is not committed."""
    project = drivers.folder / "my project"
    project.mkdir()
    git(project, "init", "-q")
    for name, code in (("calm", DRIVERS), ("wild", DRIVERS.replace("self.speed, 0", "14.0, 0"))):
        (project / "drivers.py").write_text(code)
        git(project, "add", "drivers.py")
        git(project, "commit", "-qm", name)
        git(project, "tag", name)
    (project / "drivers.py").write_text(DRIVERS + "# not committed\n")
    drivers.folder = project
    return drivers


IN_REPOSITORY = ("--scenario", "../toy", "--set", "gap_m=20:30", "--max-steps", "99", "--agent", CALM, *SEED)


@pytest.mark.parametrize(
    ("words", "says"),
    one_in(
        3,
        [
            (("drivers:Calm", "HEAD"), "'drivers:Calm' is an agent and 'HEAD' is a commit; give two commits, or two"),
            (("HEAD", "HEAD", "--agent", "crashhunt.agents:RandomAgent"), "'crashhunt.agents' is imported from"),
            (
                ("drivers:Calm", "drivers:Missing"),
                "HEAD (drivers:Missing): the hunt cannot run: 'drivers:Missing': drivers has",
            ),
            (("drivers:Calm", "drivers:Wild", "--most", "0"), "--most is 0; give at least 1"),
            (
                ("drivers:Calm", "drivers:Wild", "--margin", "x"),
                "--margin 'x' is not a share; give a share from 0 to below 1",
            ),
            (("drivers:Calm", "drivers:Wild", "--confidence", "3"), "--confidence is 3; give percent from 50"),
            (("drivers:Calm", "drivers:Wild", "--keep", "."), "the folder is not empty, and does not contain"),
            (("drivers:Calm", "drivers:Wild", "--corpus", "no"), "--corpus no is not a folder in HEAD"),
            (("drivers:Calm", "drivers:Wild", "--scenario", "nowhere"), "nowhere"),
            (
                ("calm", "wild", "--build", "make", "--build-timeout", "soon"),
                "--build-timeout is 'soon'; give a time above",
            ),
            (("calm", "wild", "--build", "echo no; exit 3"), "): --build 'echo no; exit 3' exited with 3: no; "),
            (("drivers:Calm", "drivers:Wild", "--suite", "s.toml"), "--suite and --scenario exclude each other"),
        ],
    ),
)
def test_bad_input_is_one_line_that_names_it(repository, words, says):
    options = ("--scenario", "../toy") if "--scenario" not in words else ()
    done = repository.crashhunt("gate", *words, *options, expect=2)
    assert says in done.err
    assert "Traceback" not in done.err
    assert len(done.err.splitlines()) == 1
    assert len(git(repository.folder, "worktree", "list").splitlines()) == 1


def trials_of(folder):
    try:
        return len(specs(folder))
    except sqlite3.Error:
        return 0


def begun(shell, *words):
    """Begin a gate of slow trials, and wait for pairs."""
    slow = ("--set", "step_wall_s=0.002", "--margin", "0", "--keep", "kept", *SEED)
    process = shell.begin("gate", CALM, TWIN, *TOY, *slow, "--json", *words)
    sides = [shell.folder / "kept" / side for side in ("base", "head")]
    wait_for(lambda: min(map(trials_of, sides)) >= 1, every_s=0.05, process=process)
    return process


def test_interrupted_gate_reports_its_pairs_and_resumes(drivers):
    process = begun(drivers, "--most", "5000")
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(300)
    found = json.loads(out)
    assert (process.returncode, found["verdict"], found["interrupted"]) == (130, "undecided", True)
    assert found["pairs"] >= 1
    assert found["difference"]["low"] < 0 < found["difference"]["high"]
    assert "undecided" in err
    before = found["pairs"]
    words = ("--set", "step_wall_s=0.002", "--margin", "0", "--keep", "kept", "--most", str(before + 1), *SEED)
    found = gate(drivers, CALM, TWIN, *words, expect=3)
    assert (found["pairs"], found["interrupted"]) == (before + 1, False)


@pytest.mark.nightly
def test_killed_gate_leaves_nothing_running_and_resumes_to_the_same_verdict(repository):
    words = (*IN_REPOSITORY, "--set", "step_wall_s=0.004", "--json")
    whole = repository.crashhunt("gate", "calm", "wild", *words, "--keep", "../whole", expect=1).json
    process = repository.start("gate", "calm", "wild", *words, "--keep", "../kept")
    wait_for(lambda: trials_of(repository.folder.parent / "kept" / "head") >= 2, every_s=0.01)
    process.kill()
    process.communicate(300)
    found = repository.crashhunt("gate", "calm", "wild", *words, "--keep", "../kept", expect=1).json
    verdict = ("verdict", "pairs", "only_base", "only_head", "both", "evidence", "difference")
    assert {name: found[name] for name in verdict} == {name: whole[name] for name in verdict}
    assert len(git(repository.folder, "worktree", "list").splitlines()) == 1
