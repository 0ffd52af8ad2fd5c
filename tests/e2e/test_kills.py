"""Kills at random moments of any process of a command: no row is lost, the command ends well, and nothing is left.

`test_killed.py` kills commands at chosen steps. Here, a signal ends the command itself six times in succession,
two of the processes below it, or two commands that run at once, on the toy, SUMO, highway-env and Gymnasium.

``CRASHHUNT_TEST_KILLS`` is the number of cycles for each command (default: 3). ``CRASHHUNT_TEST_KILLS_SIGNALS`` names
the signals (default: SIGKILL,SIGTERM,SIGINT). ``CRASHHUNT_TEST_KILLS_TABLE`` is a file to which each kill appends a
line: command, process, signal, whether it was hit, milliseconds since the start.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import socket
import sqlite3
import subprocess
import threading
import time
import urllib.request
from contextlib import closing, contextmanager, suppress
from http.client import HTTPException
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from conftest import FAULTY, Shell, add_toy, wait_for
from repositories import git
from test_corpus import DRIVER, MENDED
from test_killed import processes_of

from crashhunt.base.process_owners import owner_in
from crashhunt.base.processes import children_of
from crashhunt.base.temporary import remove_tree
from crashhunt.scenario import shipped_folder

if TYPE_CHECKING:
    from collections.abc import Iterator

    from commands import Begun

    Process = Begun | subprocess.Popen[str]

pytestmark = pytest.mark.nightly

CYCLES = int(os.environ.get("CRASHHUNT_TEST_KILLS", "3"))
TABLE = os.environ.get("CRASHHUNT_TEST_KILLS_TABLE", os.devnull)
SIGNALS = [
    signal.Signals[name] for name in os.environ.get("CRASHHUNT_TEST_KILLS_SIGNALS", "SIGKILL,SIGTERM,SIGINT").split(",")
]
INSIDE = ("keeper", "fork server", "template", "supervisor", "zygote", "trial")
LATEST_S = 300.0  # for a command to end by itself

SUITE = """
[defaults]
scenario = "toy"
trials = 6
max_steps = 60
seed = 2
[[hunts]]
id = "fast"
[hunts.arguments]
speed = "9:14"
[[hunts]]
id = "slow"
[hunts.arguments]
speed = "4:5"
"""
AGENT = ("--scenario", "toy", "--agent", "driver:Driver", "--arg", "speed=20:22", "--seed", "1", "--keep-going")
LOOP = ("--scenario", "loop", "--seed", "3", "--keep-going")
HIGHWAY = ("--scenario", "highway", "--seed", "1", "--keep-going")
ERRING = ("--disturb", "brake=0.02", "--probe", "0.5", "--branch", "--audit", "0.5")
COMMANDS = {
    "run": ("run", "new", "2", "12", "60", *AGENT, "--near-misses", "2", "--keep", "2"),
    "run SUMO": ("run", "new", "2", "12", "120", *LOOP, "--audit", "0.5"),
    "run SUMO, seeds": ("run", "new", "2", "12", "120", *LOOP, "--seeds", "3", "--near-misses", "1"),
    "run SUMO, probes": ("run", "new", "2", "6", "120", *LOOP, *ERRING),
    "run SUMO, any": ("run", "new", "2", "6", "60", "--scenario", "town.sumocfg", "--arg", "speed=5:9", "--seed", "1",
                      "--keep-going"),
    "run SUMO, guided": ("run", "new", "2", "12", "120", *LOOP, "--sampler", "guided"),
    "run highway": ("run", "new", "2", "6", "40", *HIGHWAY, "--audit", "0.5"),
    "run probes": ("run", "new", "2", "6", "60", "--scenario", "toy", "--seed", "3", "--arg", "speed=9",
                   "--keep-going", *ERRING),
    "run guided": ("run", "new", "2", "20", "60", *AGENT, "--sampler", "guided"),
    "run rare": ("run", "new", "2", "15", "60", "--scenario", "toy", "--agent", "crashhunt.agents:CarFollowing",
                 "--disturb", "stop=0.1", "--rare", "--seed", "3"),
    "run by cause": ("run", "new", "2", "12", "60", *AGENT, "--keep", "1", "--by-cause", "2"),
    "run deterministic": ("run", "new", "3", "30", "60", "--scenario", "toy", "--arg", "speed=5:12", "--seed", "1",
                          "--deterministic"),
    "run fresh": ("run", "new", "2", "5", "60", *AGENT, "--executor", "fresh"),
    "run Gymnasium": ("run", "new", "2", "12", "60", "--scenario", "cart", "--seed", "1",
                      "--keep-going", "--keep", "2"),
    "rerun": ("rerun", "h", "--to", "again", "--set", "trials=5"),
    "suite": ("suite", "run", "suite.toml", "many", "2"),
    "shrink": ("shrink", "h", "--crash", "0", "--budget", "60"),
    "shrink SUMO": ("shrink", "sumo", "--budget", "12"),
    "judge": ("judge", "h", "--crash", "0", "--why", "10"),
    "judge SUMO": ("judge", "sumo", "--why", "4"),
    "corpus run": ("corpus", "run", "kept", "--keep", "today"),
    "bisect": ("bisect", "../h", "--good", "HEAD~2"),
    "salvage": ("check", "h", "--salvage", "saved"),
    "export": ("export", "h", "crash.zip", "--crash", "0"),
    "report": ("report", "h", "--output", "report.html"),
    "replay": ("replay", "h", "--crash", "0", "--code", "current"),
    "replay SUMO": ("replay", "sumo"),
    "replay archive": ("replay", "before.zip", "--trust"),
    "film": ("replay", "sumo", "--video", "film.mp4"),
}  # fmt: skip
TOLD_ONCE = {"run guided", "run SUMO, guided"}  # what is drawn depends on the order in which trials end
READER = ("dashboard", ".", "--no-browser", "--port")
AT_ONCE = {
    "run": READER,
    "run probes": READER,
    "suite": READER,
    "run highway": COMMANDS["run highway"],
    "corpus run": COMMANDS["corpus run"],
    "judge": COMMANDS["shrink"],
    "report": COMMANDS["judge"],
    "replay": COMMANDS["salvage"],
}
WITHOUT_TRIALS = {"salvage", "export", "report"}


def prepared(shell: Shell) -> None:
    """A folder with what the commands on the toy need."""
    (shell.folder / "driver.py").write_text(DRIVER)
    (shell.folder / "suite.toml").write_text(SUITE)
    (shell.folder / "cart").mkdir()
    (shell.folder / "cart" / "scenario.toml").write_text(
        'schema = 1\nsimulator = "gym"\n[gym]\nid = "CartPole-v1"\n'
        'crash = { termination = true }\n[agents.cart]\nagent = "random"\n'
    )
    shell.crashhunt("run", "h", "2", "3", "60", *AGENT)
    crashes = map(str, (shell.folder / "h" / "crashes").glob("00000[01]-*"))
    shell.crashhunt("corpus", "add", *crashes, "--to", "kept")
    shell.crashhunt("export", "h", "before.zip", "--crash", "0")
    project = shell.folder / "my project"
    project.mkdir()
    git(project, "init", "-q")
    for number, code in enumerate((MENDED, f"{MENDED}# 1\n", DRIVER)):
        (project / "driver.py").write_text(code)
        git(project, "add", "driver.py")
        git(project, "commit", "-qm", str(number))


def prepared_on_sumo(shell: Shell) -> None:
    """A folder with what the commands on SUMO need."""
    (shell.folder / "driver.py").write_text(DRIVER)
    shell.crashhunt("run", "sumo", "2", "40", "200", "--scenario", "loop", "--seed", "3", "--deterministic")
    shutil.copy(shipped_folder() / "loop" / "loop.net.xml", shell.folder / "net.net.xml")
    (shell.folder / "r.rou.xml").write_text(
        '<routes><route id="way" edges="south east north west"/>'
        '<flow id="free" route="way" begin="2" period="3" number="9" departPos="30" departLane="1"/></routes>'
    )
    (shell.folder / "town.sumocfg").write_text(
        '<configuration><n v="net.net.xml"/><r v="r.rou.xml"/><step-length v="0.5"/></configuration>'
    )


class Killing:
    """One command in a folder of its own, and what is known of its undisturbed run.

    Args:
        base: the folder.
        name: of the command.
        temporary: folder for temporary files.
    """

    def __init__(self, base: Path, name: str, temporary: Path) -> None:
        self.base, self.name, self.words = base, name, COMMANDS[name]
        self.folder = base / "my project" if name == "bisect" else base
        self.shell = Shell(self.folder)
        self.environment = self.shell.environment
        self.environment["TMPDIR"] = str(temporary)
        self.temporary = temporary
        self.code, self.took_s, self.right = 0, 0.0, {}

    def run_undisturbed(self) -> None:
        """Run it to its end, and keep what it makes."""
        began = time.monotonic()
        self.code, said = ended(self.shell.begin(*self.words))
        assert self.code in (0, 1), said
        self.took_s = time.monotonic() - began
        self.right = self.made()
        self.see_that_nothing_is_left()

    def made(self) -> dict[str, object]:
        """What the command has made, where that does not depend on time."""
        found = facts(self.base)
        if self.name == "run by cause":  # which crash stays depends on which of them was judged first
            kept = [name for name in found if name.startswith("new/crashes/") and name.endswith("/crash.json")]
            return {"rows": found["new/ledger.sqlite"], "crashes": len(kept)}
        if self.name not in TOLD_ONCE:
            return found
        ledger = found["new/ledger.sqlite"]
        assert isinstance(ledger, list)
        return {"numbers": [row[0] for row in ledger]}

    def rows(self) -> dict[str, dict[int, str]]:
        """The rows of each ledger: number to digest. What a killed command leaves half made is removed later."""
        ledgers = [path.relative_to(self.base) for path in self.base.rglob("ledger.sqlite") if not path.is_symlink()]
        kept = (path for path in ledgers if not any(owner_in(part) for part in path.parts))
        return {str(path): rows_by_digest(self.base / path.parent) for path in kept}

    def see_that_nothing_is_left(self) -> None:
        """Run a command that removes what others left, and see that nothing is there."""
        wait_for(lambda: not processes_of(self.base))
        places = [self.base / word for word in self.words if word in ("new", "h", "sumo", "saved", "many")]
        hunts = [path.parent for place in places for path in [*place.glob("ledger.*"), *place.glob("*/ledger.*")]]
        for hunt in {*hunts}:
            self.shell.crashhunt("check", str(hunt))
        if not hunts:
            self.shell.crashhunt("oracles")
        tokens = [path for path in self.base.rglob("*") if owner_in(path.name) is not None]
        assert [*tokens, *self.temporary.iterdir()] == []
        assert not [*self.base.glob("my project/.git/worktrees")]

    def kill(self, number: int, process: Process, role: str, after_s: float) -> bool:
        """Send a signal to a process of the command after some time; return whether it was there."""
        began = time.monotonic()
        with suppress(subprocess.TimeoutExpired):
            process.wait(after_s)
        hit = False
        while process.poll() is None:
            doomed = [process.pid] if role == "command" else processes_in(process.pid).get(role, [])
            if doomed:
                with suppress(ProcessLookupError):
                    os.kill(random.choice(doomed), number)
                    hit = True
                break
            time.sleep(0.005)
        with Path(TABLE).open("a") as table:
            told = {"command": self.name, "process": role, "signal": signal.Signals(number).name, "hit": hit}
            table.write(json.dumps({**told, "ms": round((time.monotonic() - began) * 1000)}) + "\n")
        return hit


def processes_in(command: int) -> dict[str, list[int]]:
    """The processes below a command by what they do."""
    found: dict[str, list[int]] = {role: [] for role in INSIDE}

    def descend(pid: int) -> None:
        for child in children_of(pid):
            if "reaper.py" in described(child):
                found["keeper"].append(child)
                below_keeper(child)
            else:
                descend(child)

    def below_keeper(keeper: int) -> None:
        for server in children_of(keeper):
            found["fork server"].append(server)
            for child in children_of(server):
                below = children_of(child)
                if below:
                    found["template"].append(child)
                    found["zygote"] += below
                    found["trial"] += [trial for zygote in below for trial in children_of(zygote)]
                else:
                    found["supervisor"].append(child)

    descend(command)
    return found


def described(pid: int) -> str:
    with suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    return ""


def ended(process: Process) -> tuple[int, str]:
    """Wait for the end of a command; return its exit code and what it said."""
    try:
        said = process.communicate(timeout=LATEST_S)[1]
    except BaseException as error:
        if isinstance(process, subprocess.Popen):
            process.kill()
            process.communicate()  # an unclosed file would fail another test
        else:
            process.abandon(error)
        raise
    assert process.returncode is not None
    return process.returncode, said


@pytest.fixture(scope="module")
def whole(tmp_path_factory, made_once):
    """Return a function that gives a command in its folder; what it makes undisturbed is found out once."""
    base = tmp_path_factory.mktemp("kills")
    known: dict[str, tuple[Killing, Path]] = {}

    def make(name: str) -> Killing:
        if name not in known:
            folder = base / name / "work"
            remove_tree(base / name)  # of a test that failed
            folder.mkdir(parents=True)
            shutil.copy(FAULTY, folder / "faulty.py")
            make = prepared_on_sumo if "SUMO" in name or name == "film" else prepared
            shell = made_once(make, add_toy(Shell(folder)))
            temporary = base / name / "temporary"
            temporary.mkdir()
            fresh = base / name / "fresh"
            shutil.copytree(folder, fresh, symlinks=True)
            killing = Killing(shell.folder, name, temporary)
            killing.run_undisturbed()
            known[name] = killing, fresh
        killing, fresh = known[name]
        remove_tree(killing.base)
        remove_tree(killing.temporary)
        killing.temporary.mkdir()
        shutil.copytree(fresh, killing.base, symlinks=True)
        return killing

    return make


@pytest.mark.parametrize("number", range(CYCLES))
@pytest.mark.parametrize("name", COMMANDS)
def test_command_killed_at_random_moments_resumes_loses_no_row_and_leaves_nothing(whole, name, number):
    if name == "film":
        pytest.importorskip("av")
    killing: Killing = whole(name)
    drawn = random.Random(f"{name} {number}")
    rows: dict[str, dict[int, str]] = {}
    for again in range(6):
        process = killing.shell.begin(*killing.words)
        with_what = drawn.choice(SIGNALS)
        killing.kill(with_what, process, "command", drawn.uniform(0.1, 1.0 if not again else 0.7) * killing.took_s)
        code, said = ended(process)
        assert "Traceback" not in said or "KeyboardInterrupt" in said, said
        assert code in (-with_what, 130, killing.code), (code, said)
        wait_for(lambda: not processes_of(killing.base))
        see_that_rows_are_kept(rows, killing.rows())
        rows = killing.rows()
        if drawn.random() < 0.5:  # else the same command, which is the next one, removes what is left
            killing.see_that_nothing_is_left()
    if name == "film" and (killing.base / "film.mp4").exists():
        remove_tree(killing.base / "film.mp4")
    code, said = ended(killing.shell.begin(*killing.words))
    assert (code, "Traceback" in said) == (killing.code, False), said
    see_that_rows_are_kept(rows, killing.rows())
    assert killing.made() == killing.right
    killing.see_that_nothing_is_left()


@pytest.mark.parametrize("number", range(CYCLES))
@pytest.mark.parametrize("name", [name for name in COMMANDS if name not in WITHOUT_TRIALS])
def test_command_of_which_any_process_is_killed_ends_as_it_does_undisturbed(whole, name, number):
    killing: Killing = whole(name)
    drawn = random.Random(f"{name} {number} inside")
    process = killing.shell.start(*killing.words)  # of which its keepers are children, and theirs what they keep
    for begins, ends in ((0.05, 0.4), (0.2, 0.5)):  # a trial that is killed twice at the same step counts as a crash
        after_s = drawn.uniform(begins, ends) * killing.took_s
        killing.kill(drawn.choice(SIGNALS), process, drawn.choice(INSIDE), after_s)
    code, said = ended(process)
    assert (code, "Traceback" in said) == (killing.code, False), said
    assert killing.made() == killing.right
    killing.see_that_nothing_is_left()


@pytest.mark.parametrize("number", range(CYCLES))
@pytest.mark.parametrize("name", AT_ONCE)
def test_two_commands_at_once_are_killed_and_the_next_ones_lose_no_row_and_leave_nothing(whole, name, number):
    killing: Killing = whole(name)
    drawn = random.Random(f"{name} {number} at once")
    rows: dict[str, dict[int, str]] = {}
    for again in range(3):
        second = at_once(name)
        processes = killing.shell.begin(*killing.words), killing.shell.begin(*second)
        with read_continually(second):
            for process in drawn.sample(processes, 2):
                killing.kill(drawn.choice(SIGNALS), process, "command", drawn.uniform(0.1, 0.6) * killing.took_s)
            for process in processes:
                _, said = ended(process)
                assert "Traceback" not in said or "KeyboardInterrupt" in said, said
        wait_for(lambda: not processes_of(killing.base))
        see_that_rows_are_kept(rows, killing.rows())
        rows = killing.rows()
        if again:  # else the same commands, which are the next ones, remove what is left
            killing.see_that_nothing_is_left()
    second = at_once(name)
    if second[0] == "dashboard":
        dashboard = killing.shell.begin(*second)
        with read_continually(second) as read:
            code, said = ended(killing.shell.begin(*killing.words))
            wait_for(lambda: read)
            dashboard.kill()
            ended(dashboard)
    else:
        ended(killing.shell.begin(*second))
        code, said = ended(killing.shell.begin(*killing.words))
    assert (code, "Traceback" in said) == (killing.code, False), said
    see_that_rows_are_kept(rows, killing.rows())
    made = killing.made()
    assert {name: made.get(name) for name in killing.right} == killing.right
    killing.see_that_nothing_is_left()


def at_once(name: str) -> tuple[str, ...]:
    """Return the command that runs at the same time as another one; a dashboard with a free port."""
    words = AT_ONCE[name]
    if words != READER:
        return words
    with socket.create_server(("127.0.0.1", 0)) as free:
        return *words, str(free.getsockname()[1])


@contextmanager
def read_continually(words: tuple[str, ...]) -> Iterator[list[str]]:
    """Read the pages of a dashboard until the end; yield the addresses that have been answered."""
    read: list[str] = []
    if words[0] != "dashboard":
        yield read
        return
    over = threading.Event()

    def get(address: str) -> Any:
        with urllib.request.urlopen(f"http://127.0.0.1:{words[-1]}/api/{address}", timeout=20) as reply:
            found = json.load(reply)
        read.append(address)
        return found

    def run() -> None:
        while not over.wait(0.05):
            with suppress(OSError, ValueError, HTTPException):  # it is killed, or has not begun to listen
                for hunt in get("hunts")["hunts"]:
                    for part in ("", "/trials", "/crashes"):
                        get(f"hunts/{hunt['id']}{part}")

    reader = threading.Thread(target=run)
    reader.start()
    try:
        yield read
    finally:
        over.set()
        reader.join()


def test_processes_of_a_command_are_found_by_their_roles(tmp_path):
    # Otherwise, the test above kills no process, and passes.
    (tmp_path / "driver.py").write_text(DRIVER)
    shell = add_toy(Shell(tmp_path))
    process = shell.start("run", "new", "2", "2000", "60", *AGENT)
    missing, deadline = {*INSIDE}, time.monotonic() + 300.0
    try:
        while missing and process.poll() is None and time.monotonic() < deadline:
            missing -= {role for role, found in processes_in(process.pid).items() if found}
    finally:
        process.terminate()
        process.communicate(timeout=300)
    assert not missing


def see_that_rows_are_kept(before: dict[str, dict[int, str]], after: dict[str, dict[int, str]]) -> None:
    for ledger, rows in before.items():
        assert {number: after[ledger].get(number) for number in rows} == rows


def facts(base: Path) -> dict[str, object]:
    """What commands have made, but for what tells when, and by which process."""
    found: dict[str, object] = {}
    for path in sorted(base.rglob("*")):
        name = str(path.relative_to(base))
        if path.name == "ledger.sqlite":
            with closing(sqlite3.connect(path)) as database:
                rows = database.execute("SELECT number, result FROM trials ORDER BY number")
                found[name] = [(number, json.loads(row)["outcome"], json.loads(row)["digest"]) for number, row in rows]
        elif path.name == "crash.json":
            data = json.loads(path.read_text())
            found[name] = [data.get(key) for key in ("outcome", "digest", "confirmed", "step", "shrunk")]
        elif path.suffix in (".sqlite-wal", ".sqlite-shm", ".pyc", ".jsonl") or ".git/" in name or "__pyca" in name:
            continue
        elif path.is_file() and path.name not in ("steps", "run.log", ".lock"):
            found[name] = path.name
    return found


def rows_by_digest(hunt: Path) -> dict[int, str]:
    """The committed rows of a hunt: number to trace digest."""
    with suppress(sqlite3.Error), closing(sqlite3.connect(f"file:{hunt}/ledger.sqlite?mode=ro", uri=True)) as database:
        found = database.execute("SELECT number, result FROM trials")
        return {number: json.loads(row)["digest"] for number, row in found}
    return {}
