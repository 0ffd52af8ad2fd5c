"""A command that is killed loses nothing; the next command removes what it left, and the same one finishes the work.

Kills are real: by the process itself at a step, which is an operation on files that Python reports to audit hooks, or
by a signal after some time.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import sqlite3
import sys
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from conftest import keeps_going, mostly_nightly, wait_for

from crashhunt.base.git import run_to_end
from crashhunt.base.process_owners import OwnerProcess, owner_in, start_time, this_process
from crashhunt.base.temporary import remove_leftovers, remove_tree
from crashhunt.crashes import list_bundles
from crashhunt.errors import HuntDirectoryError
from crashhunt.hunts import Hunt, check, salvage
from crashhunt.plans import Request, plan
from crashhunt.results import hunt_state
from crashhunt.suites import _hunt_reruns, _processes, _request_file

# What a command does to files, and to processes; opening is one where it is for writing.
STEPS = {"os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.symlink", "os.link", "os.truncate", "subprocess.Popen",
         "shutil.copyfile", "shutil.copytree", "shutil.rmtree", "sqlite3.connect"}  # fmt: skip
NEVER = 10**9


@pytest.fixture(autouse=True)
def temporary_files(tmp_path_factory, monkeypatch):
    folder = tmp_path_factory.mktemp("temporary files")
    monkeypatch.setenv("TMPDIR", str(folder))
    return folder


def killed(function, step: int) -> int:
    """Call a function in a fork that is killed at a step; return how many steps there were, 0 where it was killed."""
    hear, tell = os.pipe()
    pid = os.fork()
    if pid == 0:
        seen = 0

        def hook(event, arguments):
            nonlocal seen
            if event in STEPS or (event == "open" and isinstance(arguments[2], int) and arguments[2] & 3):
                seen += 1
                if seen == step:
                    os.kill(os.getpid(), signal.SIGKILL)

        with suppress(BaseException):
            sys.addaudithook(hook)
            function()
            os.write(tell, str(seen).encode())
        os._exit(0)
    os.close(tell)
    os.waitpid(pid, 0)
    with os.fdopen(hear) as file:
        return int(file.read() or 0)


def left_in(*folders: Path) -> list[str]:
    """What has the token of a process in its name, and what lies in the folder for temporary files."""
    found = [str(path) for folder in folders for path in folder.rglob("*") if owner_in(path.name) is not None]
    return found + [str(path) for path in Path(os.environ["TMPDIR"]).rglob("*")]


def processes_of(folder: Path) -> list[int]:
    """The processes that have something of a folder open, or work there."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            links = [process / "cwd", *(process / "fd").iterdir()]
            if int(process.name) != os.getpid() and any(in_folder(link, folder) for link in links):
                found.append(int(process.name))
    return found


def in_folder(link: Path, folder: Path) -> bool:
    try:
        return str(link.readlink()).startswith(f"{folder}/")
    except OSError:
        return False


def spread(count: int, most: int, *, seed: int) -> list[int]:
    """Steps of so many, the first and the last among them."""
    some = random.Random(seed).sample(range(1, count + 1), min(most, count))
    return sorted({1, 2, count - 1, count, *some} & {*range(1, count + 1)})


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def damaged(toy, made_once, monkeypatch):
    """A folder with a hunt of which one crash is damaged."""
    made_once(keeps_going, toy)
    monkeypatch.chdir(toy.folder)
    crash = min((toy.folder / "h" / "crashes").iterdir())
    (crash / "log.mcap").write_bytes(b"")
    return toy


@pytest.mark.nightly
def test_salvage_that_was_killed_at_a_step_is_done_when_it_is_run_again(damaged):
    folder, to = damaged.folder, damaged.folder / "saved here"
    (found,) = check(folder / "h")
    before = content(folder / "h")
    count = killed(lambda: salvage(found, to), NEVER)
    assert count > 20
    shutil.rmtree(to)
    whole = None
    for step in range(1, count + 1):
        assert killed(lambda: salvage(found, to), step) == 0
        remove_leftovers()
        assert left_in(folder) == []
        there = to.exists()
        saved = salvage(found, to)
        assert salvage(found, to) == saved == {"trials": len(rows(to)), "crashes": len(found.crashes)}, step
        if there:  # it was killed too late
            assert step > count - 10
        (state,) = check(to)
        assert (state.trials, state.crashes) == ({*rows(to)}, found.crashes)
        whole = whole or content(to).keys()
        assert content(to).keys() == whole
        assert content(folder / "h") == before
        shutil.rmtree(to)


def rows(hunt: Path) -> list[int]:
    with suppress(sqlite3.Error), closing(sqlite3.connect(f"file:{hunt}/ledger.sqlite?mode=ro", uri=True)) as database:
        return [number for (number,) in database.execute("SELECT number FROM trials")]
    return []


def test_rerun_to_that_was_killed_before_it_ran_continues(damaged, monkeypatch):
    hunt, to = damaged.folder / "h", damaged.folder / "to"
    ran: list[Path] = []
    monkeypatch.setattr(_hunt_reruns, "run_all", lambda folders, *_, **__: ran.extend(folders))

    def again(**options):
        return _hunt_reruns.rerun([hunt], to=to, trusted=True, **{"changes": {"seed": "7"}, **options})

    killed(again, NEVER)
    request = json.loads((to / "request.json").read_text())
    shutil.rmtree(to)
    step = 0
    while not killed(again, step := step + 1):
        remove_leftovers()
        assert left_in(damaged.folder) == []
        assert not to.exists() or json.loads((to / "request.json").read_text()) == request
        ((state,), _) = again()
        assert (state.state, ran) == ("queued", [to])
        ran.clear()
        shutil.rmtree(to)
    assert step > 5
    for options, says in (
        ({"changes": {}}, "the directory exists already"),
        ({"changes": {"seed": "6"}}, "the directory exists already"),
    ):
        with pytest.raises(HuntDirectoryError, match=says):
            again(**options)
    with monkeypatch.context() as patched:
        for state, says in (("running", "the hunt is running"), ("error", "ended in an error")):
            patched.setattr(_hunt_reruns, "hunt_state", lambda _, state=state: SimpleNamespace(state=state))
            with pytest.raises(HuntDirectoryError, match=says):
                again()
        for state, resumes in (("finished", False), ("crashed", False), ("killed", True), ("interrupted", True)):
            patched.setattr(_hunt_reruns, "hunt_state", lambda _, state=state: SimpleNamespace(state=state))
            ran.clear()
            again()
            assert bool(ran) == resumes, state
    ran.clear()
    shutil.rmtree(to)
    to.mkdir()
    again()  # into one that is empty
    assert ran == [to]
    (damaged.folder / "file").touch()
    with pytest.raises(HuntDirectoryError, match="exists already"):
        _hunt_reruns.rerun([hunt], to=damaged.folder / "file", trusted=True)


@pytest.mark.parametrize("exchanges", [True, pytest.param(False, marks=pytest.mark.nightly)])
def test_a_rerun_that_was_killed_while_it_sets_a_hunt_aside_loses_nothing(damaged, monkeypatch, exchanges):
    hunt = damaged.folder / "h"
    if not exchanges:  # as on some network file systems
        monkeypatch.setattr(_processes, "exchange", lambda *_: False)
        monkeypatch.setattr("crashhunt.base.files.exchange", lambda *_: False)
    request = _hunt_reruns._request(hunt)
    before, aside = content(hunt), hunt.with_name("h.replaced-0")
    copy = damaged.folder / "copy"
    shutil.copytree(hunt, copy)
    step = 0
    while not killed(lambda: _processes.set_aside(hunt, lambda _: request), step := step + 1):
        remove_leftovers()
        assert left_in(damaged.folder) == []
        assert before in [content(folder) for folder in (hunt, aside) if folder.exists()]
        if exchanges:
            assert hunt_state(hunt).state in ("crashed", "queued")
        if hunt.exists() and content(hunt) == before:
            assert _processes.set_aside(hunt, lambda _: request) == aside
            assert (content(aside), [*content(hunt)]) == (before, ["request.json"])
        for folder in (hunt, aside):
            shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(copy, hunt)
    assert step > 5
    assert (content(aside), [*content(hunt)]) == (before, ["request.json"])
    # A hunt that was set aside before it began is no plan of this one.
    shutil.rmtree(aside)
    aside.mkdir()
    _request_file.write_request(aside, replace(request, folder="/elsewhere"))
    assert _processes.set_aside(hunt, lambda _: request).name == "h.replaced-1"
    shutil.rmtree(hunt)
    hunt.with_name("h.replaced-1").rename(hunt)
    shutil.rmtree(aside)
    shutil.copytree(copy, aside)
    shutil.copytree(copy, hunt, dirs_exist_ok=True)
    assert _processes.set_aside(hunt, lambda _: request).name == "h.replaced-1"


WRITERS = [
    "corpus add h --to kept",
    "export h crash.zip",
    "report h --output report.html",
    "trials h --out trials.csv",
    "export h out.xosc --as openscenario",
]


@pytest.mark.parametrize("words", mostly_nightly(WRITERS, always=WRITERS[:1]))
def test_what_is_written_is_whole_or_not_there(toy, made_once, monkeypatch, words):
    made_once(keeps_going, toy)
    monkeypatch.chdir(toy.folder)
    from crashhunt.cli import main

    def command():
        for descriptor in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)
        with suppress(SystemExit):
            main(words.split())

    before = {*toy.folder.iterdir()}
    count = killed(command, NEVER)
    made = {*toy.folder.iterdir()} - before
    whole = {path: described(path) for path in made}
    for step in spread(count, 4, seed=len(words)):
        for path in {*toy.folder.iterdir()} - before:
            remove_tree(path)
        assert killed(command, step) == 0
        remove_leftovers()
        assert left_in(toy.folder) == []
        for path in {*toy.folder.iterdir()} - before:
            assert described(path) in (whole[path], {})  # a corpus may have no case yet
        assert killed(command, NEVER)
        assert {path: described(path) for path in {*toy.folder.iterdir()} - before} == whole


def described(path: Path) -> dict[str, int]:
    """The names below a folder with their sizes; of a file, whose size depends on the time, how many kB it has."""
    if path.is_dir():
        return {str(file.relative_to(path)): file.stat().st_size for file in path.rglob("*") if file.is_file()}
    return {path.name: path.stat().st_size // 1000}


def test_what_bisect_runs_ends_with_it(tmp_path):
    said = tmp_path / "pid"
    pid = os.fork()
    if pid == 0:
        with suppress(BaseException):
            run_to_end(["sh", "-c", f"echo $$ > '{said}'; exec sleep 600"], None, os.environ)
        os._exit(0)
    wait_for(lambda: said.exists() and said.read_text())
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    wait_for(lambda: start_time(int(said.read_text())) == 0)


def test_a_signal_ends_a_command_after_it_has_removed_everything(toy, made_once, temporary_files):
    made_once(keeps_going, toy)
    toy.environment["TMPDIR"] = str(temporary_files)
    process = toy.begin("replay", "h")
    wait_for(lambda: [*temporary_files.glob("crashhunt-temporary-*/*/rerun-1/*")], every_s=0.01)
    process.terminate()
    process.communicate(timeout=300)
    assert process.returncode == -signal.SIGTERM
    assert left_in(toy.folder) == []


LEAVES_MEMORY = """
from multiprocessing import shared_memory
from crashhunt.agents import KeepLaneWithSpeed
kept = []
class Leaves(KeepLaneWithSpeed):
    def __init__(self, **arguments):
        super().__init__(**arguments)
        kept.append(shared_memory.SharedMemory(create=True, size=64))
        open("created.txt", "a").write(kept[-1].name + "\\n")
"""


@pytest.mark.nightly
def test_a_hunt_that_was_killed_leaves_nothing_for_long_not_even_shared_memory(toy, temporary_files):
    (toy.folder / "leaves.py").write_text(LEAVES_MEMORY)
    toy.environment["TMPDIR"] = str(temporary_files)
    words = ("run", "h", "2", "8", "40", "--scenario", "toy", "--agent", "leaves:Leaves", "--arg", "speed=5", "--set",
             "step_wall_s=0.01", "--seed", "1")  # fmt: skip
    process = toy.start(*words)
    wait_for(lambda: rows(toy.folder / "h"))
    created = toy.folder / "created.txt"
    wait_for(lambda: not all(Path("/dev/shm", name).exists() for name in created.read_text().split()))
    assert process.poll() is None  # what a trial left does not stay until the end of a long hunt
    wait_for(lambda: [*toy.folder.glob("h/.scratch-*/shared-memory-*.txt")], every_s=0.01)
    process.kill()
    process.communicate(timeout=300)
    wait_for(lambda: not processes_of(toy.folder))
    assert len([*toy.folder.glob("h/.scratch-*")]) == 1
    toy.crashhunt("oracles")
    assert left_in(toy.folder) == []
    assert not [name for name in created.read_text().split() if Path("/dev/shm", name).exists()]
    toy.crashhunt(*words)
    assert sorted(rows(toy.folder / "h")) == [*range(8)]
    assert len(created.read_text().split()) >= 8
    assert not [name for name in created.read_text().split() if Path("/dev/shm", name).exists()]
    assert left_in(toy.folder) == []


def leftover(folder: Path, start: str, *, alive: bool = False, boot: str = "") -> Path:
    """Make a folder with the name of something temporary, of this process or of one that has ended."""
    here = this_process()
    made = (
        folder / f"{start}{OwnerProcess(here.pid, here.started - (not alive), boot or here.boot, here.namespace).token}"
    )
    made.mkdir(parents=True)
    return made


def test_what_no_link_leads_to_goes_where_it_lies(toy, made_once, monkeypatch):
    """As after a reboot, or where the folder for temporary files was another one."""
    made_once(keeps_going, toy)
    monkeypatch.chdir(toy.folder)
    hunt, corpus = toy.folder / "h", toy.folder / "kept"
    (hunt / ".scratch").mkdir()  # of an earlier version
    before = [leftover(hunt, ".scratch-"), leftover(hunt, ".scratch-", boot="0123456789ab"), hunt / ".scratch",
              leftover(hunt / "crashes", ".000000-hang."), leftover(hunt / "probes", ".000001-hang."),
              leftover(hunt / "snapshots", ".building-"), leftover(corpus, ".case.")]  # fmt: skip
    stay = [leftover(hunt / "crashes", ".000000-hang.", alive=True), leftover(corpus, ".case.", alive=True),
            leftover(hunt / "snapshots", ".building-", boot="0123456789ab")]  # fmt: skip
    (found,) = check(hunt)
    said = {finding.where for finding in found.findings}
    assert {str(path) for path in before[:4]} <= said
    assert str(stay[0]) not in said  # shrink may be writing it
    toy.crashhunt("run", "h", "2", "12", "99", "--scenario", "toy", "--seed", "5", "--keep-going", "--no-snapshot")
    toy.crashhunt("corpus", "add", str(min((hunt / "crashes").glob("[!.]*"))), "--to", "kept")
    assert [path for path in before if path.exists()] == []
    assert [path for path in stay if not path.exists()] == []


@pytest.mark.nightly
def test_a_hunt_that_is_stopped_while_it_confirms_is_resumed_by_a_rerun(toy, monkeypatch):
    monkeypatch.chdir(toy.folder)
    scenario, settings = plan(Request(scenario="toy", trials=3, max_steps=60, arguments={"speed": "20"}))
    asked = []

    def stop(status):
        if status.phase == "confirming" and not asked:
            asked.append(os.kill(os.getpid(), signal.SIGTERM))

    report = Hunt(toy.folder / "h", scenario, settings).run(stop)
    assert [crash.confirmed for crash in report.crashes] == [None]
    assert hunt_state(toy.folder / "h").state == "interrupted"
    (state,) = toy.crashhunt("rerun", "h", "--json").json["hunts"]
    assert state["state"] == "crashed"
    assert [bundle.confirmed for bundle in list_bundles(toy.folder / "h")] == [True]
