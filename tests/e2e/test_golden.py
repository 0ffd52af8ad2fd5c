"""What the commands print and what the simulators compute is what it was: compared with the files of tests/golden/.

Written anew by ``CRASHHUNT_GOLDEN=write scripts/test -m "nightly or not nightly" tests/e2e/test_golden.py``.
"""

from __future__ import annotations

import argparse
import json
import shutil
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from golden import compare_golden, compare_golden_json, need_python, need_versions, normalised, read_golden
from repositories import git
from test_corpus import BROKEN, DRIVER, MENDED
from test_stops import rows, wait_for

from crashhunt.cli import make_parser
from crashhunt.scenario import shipped_scenarios

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from conftest import Shell

TESTS = Path(__file__).parents[1]

# --- the help of every command


def parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for inner in action.choices.values():
                yield from parsers(inner)


def test_help_of_every_command_is_as_before(monkeypatch):
    need_python(11)
    monkeypatch.setenv("COLUMNS", "80")
    found = [f"$ {parser.prog} --help\n{parser.format_help()}" for parser in parsers(make_parser())]
    compare_golden("help.txt", "\n".join(found))


# --- digests of trials

SUMO, HIGHWAY, GYM = ("libsumo", "numpy"), ("highway-env", "gymnasium", "numpy"), ("gymnasium", "numpy")
PENDULUM = """
title = "A pendulum"
schema = 1
simulator = "gym"
[gym]
id = "Pendulum-v1"
[arguments.g]
default = 10.0
range = "8:12"
[agents.ego]
agent = "crashhunt.agents:RandomAgent"
"""
# Name: packages, steps, and the options of each hunt of two trials.
TRIALS: dict[str, tuple[tuple[str, ...], int, list[tuple[str, ...]]]] = {
    "toy": (("numpy",), 60, [(), ("--disturb", "brake=0.5"), ("--seeds", "2", "--sampler", "sobol")]),
    "gym": (GYM, 60, [(), ("--set", "g=9:11")]),
    "highway": (HIGHWAY, 40, [(), ("--arg", "headway_s=0.3"), ("--disturb", "brake=0.2,cut_in=0.1")]),
    "highway-policy": (HIGHWAY, 20, [()]),
    "intersection-highway-env": (HIGHWAY, 25, [()]),
    "intersection-two-agents": (HIGHWAY, 25, [()]),
    "merge-highway-env": (HIGHWAY, 40, [()]),
    "roundabout": (HIGHWAY, 25, [()]),
    "loop": (
        SUMO, 200,
        [(), ("--arg", "speed=22"), ("--action", "meta"), ("--disturb", "brake=0.1,cut_in=0.05,late_action=0.1")],
    ),
    "loop-two-agents": (SUMO, 150, [()]),
    "intersection": (SUMO, 150, [(), ("--disturb", "ignore_priority=0.1")]),
    "merge": (SUMO, 150, [(), ("--seeds", "1")]),
    "motorway": (SUMO, 150, [()]),
    "r157-cut-in": (SUMO, 100, [(), ("--arg", "model=fsm")]),
    "r157-cut-out": (SUMO, 100, [()]),
    "r157-deceleration": (SUMO, 100, [()]),
    "r157-lane-keeping": (SUMO, 100, [()]),
    "r157-following": (SUMO, 100, [()]),
    "r157-blocked-lane": (SUMO, 100, [()]),
    "r157-multiple-targets": (SUMO, 100, [()]),
    "r157-pedestrian": (SUMO, 100, [()]),
    "r157-detection-range": (SUMO, 100, [()]),
}  # fmt: skip
TABLE = ("number", "seed", "outcome", "steps", "sim_time_s", "digest")


def hunted(shell: Shell, name: str, steps: int, options: Sequence[str]) -> list[dict[str, Any]]:
    """Run two trials in a folder of their own, and return what identifies each."""
    words = ("run", name, "1", "2", str(steps), "--seed", "5", "--keep-going", "--no-snapshot", *options)
    shell.crashhunt(*words)
    rows = map(json.loads, shell.crashhunt("trials", name, "--format", "jsonl").out.splitlines())
    return [{key: row[key] for key in TABLE} for row in rows]


def test_digests_of_the_first_hunt_are_as_before(shell):
    """By day on SUMO; the session `short` has those of the toy. All scenarios, with all their options, run at night."""
    packages, steps, _ = TRIALS["loop"]
    need_versions("trials/loop.json", *packages)
    assert hunted(shell, "h", steps, ("--scenario", "loop")) == read_golden("trials/loop.json")["trials"]["as it is"]


@pytest.mark.nightly
@pytest.mark.parametrize("scenario", TRIALS)
def test_digests_of_trials_are_as_before(toy, scenario):
    """With the compiled core, or the accelerator, and without: the same file holds for both."""
    packages, steps, variants = TRIALS[scenario]
    name = f"trials/{scenario}.json"
    versions = need_versions(name, *packages)
    (toy.folder / "gym").mkdir()
    (toy.folder / "gym" / "scenario.toml").write_text(PENDULUM, encoding="utf-8")
    slow = {SUMO: "--no-native", HIGHWAY: "--no-accelerate"}.get(packages)
    found = {}
    for number, options in enumerate(variants):
        where = ("--scenario", scenario)
        fast = hunted(toy, f"fast-{number}", steps, (*where, *options))
        if slow:
            assert hunted(toy, f"slow-{number}", steps, (*where, *options, slow)) == fast
        found[" ".join(options) or "as it is"] = fast
    compare_golden_json(name, {"versions": versions, "trials": found})


def test_every_shipped_scenario_has_golden_trials():
    assert set(shipped_scenarios()) <= set(TRIALS)


# --- ledgers and bundles of earlier versions

LEDGERS = sorted((TESTS / "ledger" / "versions").glob("version-*.sqlite"))
BUNDLES = [
    *sorted((TESTS / "e2e" / "bundles").glob("version-*.zip")),
    *sorted((TESTS / "e2e" / "frozen").glob("*/*.zip")),
    *sorted((TESTS / "e2e" / "frozen").glob("*/hunt")),
]


# Each value of these ledgers is compared in tests/ledger/test_ledger_versions.py; here it is what the commands print.
@pytest.mark.parametrize(
    "ledger",
    [
        pytest.param(path, id=path.stem, marks=[pytest.mark.nightly] * (number < len(LEDGERS) - 1))
        for number, path in enumerate(LEDGERS)
    ],
)
def test_commands_read_of_an_earlier_ledger_what_they_did(shell, ledger):
    (shell.folder / "h").mkdir()
    shutil.copy(ledger, shell.folder / "h" / "ledger.sqlite")
    settings = (TESTS / "e2e" / "frozen" / "version-1" / "hunt" / "hunt.toml").read_text(encoding="utf-8")
    settings = settings.replace("\nseed = 1\n", "\nseed = 5\n").replace("\ntrials = 4\n", "\ntrials = 12\n")
    (shell.folder / "h" / "hunt.toml").write_text(settings, encoding="utf-8")
    found = {}
    for words in (("trials", "h", "--format", "json"), ("status", "h", "--json")):
        done = shell.crashhunt(*words, expect=None)
        found[" ".join(words)] = [done.code, normalised(json.loads(done.out), shell.folder)]
    compare_golden_json(f"ledgers/{ledger.stem}.json", found)


@pytest.mark.parametrize(
    "bundle",
    [
        pytest.param(path, id="-".join(path.with_suffix("").parts[-2:]), marks=[pytest.mark.nightly] * (number > 0))
        for number, path in enumerate(sorted(BUNDLES, key=lambda path: path.stem not in ("fault", "highway")))
    ],
)
def test_a_bundle_of_an_older_version_replays_bit_identically(shell, bundle):
    name = f"bundles/{'-'.join(bundle.with_suffix('').parts[-2:])}.json"
    need_versions_of = SUMO if bundle.parent.name == "bundles" else HIGHWAY
    versions = need_versions(name, *need_versions_of)
    copy = shell.folder / bundle.name
    (shutil.copytree if bundle.is_dir() else shutil.copy)(bundle, copy)
    reports = {}
    for words in ((), ("--from-log",)):
        done = shell.crashhunt("replay", bundle.name, "--trust", "--json", *words, expect=None)
        reports[" ".join(("replay", *words))] = [done.code, normalised(json.loads(done.out), shell.folder)]
    compare_golden_json(name, {"versions": versions, "replays": reports})


# --- exit codes and the JSON of every command

TOY = "--scenario toy --seed 4 --keep-going"
CRASHES = f"{TOY} --arg speed=13:14 --set gap_m=10:20"
SUITE = """
[defaults]
scenario = "toy"
trials = 2
max_steps = 60
seed = 3
[[hunts]]
id = "fast"
runs = 2
arguments.speed = "12:14"
[[hunts]]
id = "nowhere"
agent = "nothing:There"
"""


def drive(code: str) -> Callable[[Path], None]:
    """Make today's code of the agent `driver:Driver` the one that is given."""
    return lambda folder: (folder / "driver.py").write_text(code, encoding="utf-8")


def damage(folder: Path) -> None:
    log = next(folder.glob("h/crashes/*/log.mcap"))
    log.write_bytes(log.read_bytes()[:-9])


def write_suite(folder: Path) -> None:
    (folder / "suite.toml").write_text(SUITE, encoding="utf-8")


def commit(folder: Path) -> None:
    """Make a repository of three commits of the agent, of which the last crashes."""
    git(folder, "init", "-q")
    for code in (MENDED, MENDED + "\n# 1\n", DRIVER):
        drive(code)(folder)
        git(folder, "add", "driver.py")
        git(folder, "commit", "-qm", "a change")


# Each session runs in a folder of its own; a word that ends a command with --json gives its data to the golden file.
SESSIONS: dict[str, list[str | Callable[[Path], None]]] = {
    "short": [f"run h 1 2 60 {CRASHES} --no-snapshot --json", "status h --json", "trials h --format json", "nothing"],
    "hunt": [
        f"run h 1 3 60 {CRASHES} --json",
        f"run h 1 3 60 {CRASHES} --json",
        "status h --json",
        "trials h --format json",
        "crashes h --json",
        "show h --json",
        "replay h --json",
        "check h --json",
    ],
    "lists": [
        "agents --json", "disturbances --json", "oracles --json", "scenarios --json", "guide --json",
        "guide glossary --json", "completion bash", "trust --json",
    ],
    "refusals": [
        "", "nothing", "--version", "run h", "run h 1 1 9 --json --scenario nowhere",
        "run h 1 1 9 --json --scenario toy --arg nothing=1", "run h 1 1 9 --json --scenario toy --arg speed=fast",
        "run h 1 1 9 --json --scenario toy --agent nothing:There",
        "run h 1 1 9 --json --scenario toy --sampler nothing",
        "status h --json", "replay h --json", "show h --json", "check h --json", "crashes h --json", "judge h --json",
        "shrink h --json", "report h --json", "export h x.zip --json", "suite run nowhere.toml s --json",
        "corpus run nowhere --json", "corpus list nowhere --json", "compare h h --json", "rerun h --json", "trials h",
        "logs h", "bisect h --good HEAD --json", "trust h --json", "guide xyzzy --json", "completion nothing",
    ],
    "files": [
        f"run h 1 2 60 {CRASHES} --json",
        f"run g 1 2 60 {TOY} --arg speed=5 --json",
        f"run c 1 2 60 {CRASHES} --no-snapshot --fail-on-crash --json",
        "compare h g --json", "compare h --json", "trials h --format csv",
        "trials h --format jsonl --outcome collision",
        "report h --output page.html --json", "export h crash.zip --json", "show crash.zip --json",
        "replay crash.zip --json", "check crash.zip --json", "export h crash --as commonroad --json",
        "export h crash --as openscenario --json", "logs h --type state", "rerun h --json",
        "rerun h --to again --set speed=5 --parallel 1 --json", "status h g again --json", "trust h --json",
        damage, "check h --json", "check h --salvage whole --json", "check whole --json",
    ],
    "replays": [
        f"run h 1 2 60 {CRASHES} --json", "replay h --from-log --json", "replay h --code current --json",
        "replay h --times 2 --json", "replay h --set speed=5 --json", "replay h --set speed=5 --expect fixed --json",
        "replay h --expect fixed --json", "replay h --until 5 --json", "replay h --print x,gap_m --json",
        "replay h --set nothing=5 --json", "replay h --crash 1 --json", "replay h --crash 9 --json",
        "judge h --runs 9 --why 8 --parallel 1 --json", "judge h --all --runs 5 --why 0 --parallel 1 --json",
        "show h --json", "crashes h --json", "shrink h --budget 30 --parallel 1 --json", "show h --json",
        "replay h --crash 000000-collision.small --json",
    ],
    "kinds of hunts": [
        f"run probed 1 2 60 {TOY} --arg speed=9 --probe 2s --json", "status probed --json",
        f"run branched 1 2 120 {TOY} --arg speed=9.5 --disturb brake=0.01,stop=0.01 --branch --set gap_m=12 --json",
        "status branched --json", "crashes branched --json", "check branched --json",
        f"run kept 1 4 60 {TOY} --arg speed=9 --near-misses 2 --audit 1 --keep-trials --json", "show kept --json",
        "check kept --json", f"run few 1 4 60 {CRASHES} --keep 1 --distinct 1 --json",
        f"run at-fault 1 4 60 {CRASHES} --only-at-fault --json", f"run steps 1 2 60 {TOY} --sampler guided --json",
        f"run for 1 0 60 {TOY} --for 1ms --json", f"run none 1 3 60 {TOY} --set fail_reset=true --json",
        "status none --json", f"run fresh 1 1 60 {TOY} --executor fresh --json",
        f"run disturbed 1 2 60 {TOY} --arg speed=9 --disturb brake@5=ahead:8:4 --json", "show disturbed --json",
    ],
    "faults": [
        f"run raises 1 1 60 {TOY} --agent faulty:Raises --json", "show raises --json", "crashes raises --json",
        f"run exits 1 1 60 {TOY} --agent faulty:Exits3 --json", "show exits --json", "replay exits --json",
        f"run segfaults 1 1 60 {TOY} --agent faulty:Segfaults --json", "show segfaults --json",
        f"run hangs 1 1 60 {TOY} --agent faulty:Hangs --timeout 1 --json", "show hangs --json",
        f"run nan 1 1 60 {TOY} --agent faulty:Nan --json", "show nan --json", "judge nan --json",
        f"run starts 1 1 60 {TOY} --agent faulty:FailsToStart --json", "status starts --json",
        f"run dies 1 9 60 {TOY} --agent faulty:DiesAtStart --json", "status dies --json", "rerun dies --json",
        "shrink raises --budget 20 --parallel 1 --json",
    ],
    "corpus": [
        drive(DRIVER), f"run h 1 2 60 {TOY} --agent driver:Driver --arg speed=20:22 --json",
        "corpus add h/crashes/000000-collision h/crashes/000001-collision --to kept --note two --json",
        "corpus list kept --json", "crashes h --known kept --json", "corpus run kept --parallel 1 --json",
        drive(MENDED), "corpus run kept --parallel 1 --json", "replay h --code current --json",
        "replay h --code current --expect fixed --json", drive(BROKEN), "corpus run kept --parallel 1 --json",
        "corpus add h/crashes/000000-collision --to kept --expect fixed --json", "trust kept --json",
    ],
    "suite": [
        write_suite, "suite run suite.toml s 1 --json", "status s --json", "crashes s --json", "compare s --json",
        "rerun s --failed --parallel 1 --json", "check s --json", "logs s --errors-only", "suite defaults",
    ],
    "bisect": [
        commit, f"run h 1 1 60 {TOY} --agent driver:Driver --arg speed=20:22 --json",
        "bisect h --good HEAD~2 --json", "bisect h --good HEAD --json",
    ],
    "SUMO": [
        "run h 1 2 400 --seed 3 --arg speed=22:25 --keep-going --json", "status h --json", "crashes h --json",
        "show h --json", "show h --braking 5 --json", "replay h --json", "check h --json",
        "judge h --runs 6 --why 4 --parallel 1 --json", "show h --json",
        "shrink h --budget 12 --parallel 1 --json", "export h crash --as commonroad --json",
        "export h crash --as openscenario --json", "compare h h --json",
    ],
}  # fmt: skip
BY_DAY = {"short"}
REPEATED = "again: "


@pytest.mark.parametrize(
    "session", [pytest.param(name, marks=[pytest.mark.nightly] * (name not in BY_DAY)) for name in SESSIONS]
)
def test_commands_exit_and_answer_as_before(toy, session, monkeypatch):
    toy.environment["XDG_STATE_HOME"] = str(toy.folder / "state")  # what is trusted there is of this test alone
    for name in ("GIT_AUTHOR_DATE", "GIT_COMMITTER_DATE"):  # with which a commit has the same name every time
        monkeypatch.setenv(name, "2026-01-01T00:00:00Z")
    name = f"commands/{session.replace(' ', '-')}.json"
    versions = need_versions(name, *(SUMO if session == "SUMO" else ("numpy",)))
    found: dict[str, Any] = {}
    for step in SESSIONS[session]:
        if callable(step):
            step(toy.folder)
            continue
        done = toy.crashhunt(*step.split(), expect=None)
        answer: dict[str, Any] = {"exit code": done.code}
        if done.out and ("--json" in step.split() or "--format json" in step):
            data = [json.loads(line) for line in done.out.splitlines()] if "jsonl" in step else json.loads(done.out)
            answer["json"] = normalised(data, toy.folder)
        elif step.endswith("--format csv"):
            answer["columns"] = done.out.splitlines()[0].split(",")
        while step in found:
            step = REPEATED + step
        found[step] = answer
    compare_golden_json(name, {"versions": versions, "commands": found})


@pytest.mark.nightly
def test_an_interrupted_hunt_exits_and_answers_as_before(toy):
    words = ("run", "h", "1", "500", "60", "--scenario", "toy", "--seed", "4", "--set", "step_wall_s=0.005", "--json")
    run = toy.begin(*words)
    wait_for(lambda: rows(toy.folder / "h"))
    run.send_signal(signal.SIGINT)
    out, _ = run.communicate(timeout=100)
    (state,) = toy.crashhunt("status", "h", "--json").json["hunts"]
    report = json.loads(out) if out else {}
    found = {"exit code": run.returncode, "report": sorted(report), "status": sorted(state), "state": state["state"]}
    compare_golden_json("commands/interrupted.json", found)
