"""What goes wrong on a cluster while somebody hunts there: no trial is lost or run twice, nothing is left running."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import sqlite3
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path

import pytest
from ray_cluster import below, head, nodes

if find_spec("ray") is None:  # to import it takes a while, wherever its tests are not run
    pytest.skip("Ray is not installed: pip install 'crashhunt[ray]'", allow_module_level=True)

pytestmark = pytest.mark.nightly
DEADLINE_S = 500.0  # the hunt with a full disk took 195 s at a load of 12
SLOW = ("--scenario", "toy", "--seed", "3", "--set", "step_wall_s=0.02", "--keep-going")
TRIALS = 40


@pytest.fixture(scope="module")
def cluster():
    """A head that runs nothing."""
    with head() as found:
        yield found


@pytest.fixture
def add(cluster):
    """Adds nodes of one CPU, and removes them in the end."""
    with nodes(cluster) as added:

        def node(count=1, **options):
            added.extend(cluster.add_node(num_cpus=1, **options) for _ in range(count))
            return added[-count:]

        yield node


@pytest.fixture
def started(toy):
    """Starts hunts, and ends them."""
    begun = []

    def start(hunt, *words):
        begun.append(toy.start("run", hunt, "0", str(TRIALS), "30", *SLOW, *words))
        return begun[-1]

    yield start
    for process in begun:
        if process.poll() is None:
            process.kill()
        process.communicate()


def alive(pids):
    """Those that run, or could."""
    found = []
    for pid in pids:
        with contextlib.suppress(OSError):
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX":
                found.append(pid)
    return found


def kill(pid, number=signal.SIGKILL):
    """Signal a process and all below it; return them."""
    pids = [pid, *below(pid)]
    for one in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(one, number)
    return pids


def raylet(node):
    return node.all_processes["raylet"][0].process.pid


def eventually(what, said=""):
    deadline = time.monotonic() + DEADLINE_S
    while not (found := what()):
        assert time.monotonic() < deadline, said
        time.sleep(0.1)
    return found


def rows(toy, hunt):
    """Number to the result, as the ledger has it; each number once."""
    path = toy.folder / hunt / "ledger.sqlite"
    if not path.exists():
        return {}
    with contextlib.closing(sqlite3.connect(path)) as ledger:
        try:
            found = ledger.execute("select number, outcome, result, ended_at, wall_s from trials").fetchall()
        except sqlite3.OperationalError:  # not made yet
            return {}
    assert len({row[0] for row in found}) == len(found)
    return {number: (outcome, json.loads(result)["digest"], *times) for number, outcome, result, *times in found}


def whole(toy, hunt):
    """The trials of a hunt are those that it has on one machine, to the bit."""
    if not (toy.folder / "pool").exists():
        toy.crashhunt("run", "pool", "2", str(TRIALS), "30", *SLOW)
    same = rows(toy, "pool")
    assert sorted(same) == [*range(TRIALS)]
    found = rows(toy, hunt)
    assert {number: row[:2] for number, row in found.items()} == {number: row[:2] for number, row in same.items()}
    return found


def ends(process, code=0):
    """What is printed until a hunt has ended, and nothing of it is left."""
    left = below(process.pid)
    out, err = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == code, err
    assert "Traceback" not in err
    eventually(lambda: not alive(left), "something is left running")
    return out + err


def actors(node):
    found = []
    for pid in below(raylet(node)):
        with contextlib.suppress(OSError):
            if Path(f"/proc/{pid}/cmdline").read_bytes().startswith(b"ray::Site"):
                found.append(pid)
    return found


def test_half_of_the_nodes_go_and_another_one_is_slow(toy, cluster, add, started):
    nodes = add(4)
    hunt = started("h", "--executor", f"ray:{cluster.address}")
    eventually(lambda: len(rows(toy, "h")) > 4 and all(map(actors, nodes)))
    (stopped,) = actors(nodes[3])
    kill(stopped, signal.SIGSTOP)
    killed = [pid for node in nodes[:2] for pid in kill(raylet(node))]
    count = len(rows(toy, "h"))
    eventually(lambda: len(rows(toy, "h")) > count + 3)
    kill(stopped, signal.SIGCONT)
    said = ends(hunt)
    assert said.count("was lost") >= 2
    whole(toy, "h")
    assert not alive(killed)
    eventually(lambda: not any(map(actors, nodes[2:])), "an actor is left")


def test_two_hunts_share_a_cluster(toy, cluster, add, started):
    add(4)
    words = ("--executor", f"ray:{cluster.address}")
    hunts = [started(name, *words, "--seed", "3") for name in ("one", "two")]
    said = [process.communicate(timeout=DEADLINE_S)[1] for process in hunts]
    codes = [process.returncode for process in hunts]
    assert 0 in codes
    for name, code, err in zip(("one", "two"), codes, said, strict=True):
        if code:  # the other one had everything
            assert code == 2
            assert "none of its 4 CPUs is free" in err.splitlines()[-1]
        else:
            whole(toy, name)


ELSEWHERE = {
    "clock": """
import time
now, since = time.time, time.monotonic
time.time = lambda: now() + 4e7
time.monotonic = lambda: since() + 4e7
""",
    "disk": """
import resource, sys
if any("default_worker" in word for word in sys.orig_argv):
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 19, 1 << 19))  # as where nothing larger can be written
""",
}


def different(tmp_path, kind):
    """The environment of a node on which something is different for Python."""
    (tmp_path / kind).mkdir()
    (tmp_path / kind / "sitecustomize.py").write_text(ELSEWHERE[kind])
    return {"PYTHONPATH": str(tmp_path / kind)}


def test_a_clock_that_is_off_changes_nothing(toy, cluster, add, started, tmp_path):
    add(env_vars=different(tmp_path, "clock"))
    began = time.time()
    hunt = started("h", "--executor", f"ray:{cluster.address}")
    eventually(lambda: len(rows(toy, "h")) > 4)
    (node,) = eventually(lambda: toy.crashhunt("status", "h", "--json").json["hunts"][0].get("nodes"))
    assert 0 < node["rate_per_s"] < 100
    ends(hunt)
    for _, _, ended_at, wall_s in whole(toy, "h").values():
        assert began < ended_at < time.time()
        assert 0 <= wall_s < time.time() - began


def test_a_node_whose_disk_is_full_takes_no_part(toy, cluster, add, started, tmp_path):
    add(env_vars=different(tmp_path, "disk"))
    add()
    said = ends(started("h", "--executor", f"ray:{cluster.address}"))
    (line,) = [line for line in said.splitlines() if "takes no part" in line]
    assert "the limit on the size of a file is 0.5 MiB" in line or "disk" in line
    whole(toy, "h")


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


@contextlib.contextmanager
def by_hand(port, folder, **environment):
    """A cluster that is started as people start one."""
    command = [Path(sys.executable).with_name("ray"), "start", "--head", "--num-cpus", "2", "--port", str(port)]
    command += ["--temp-dir", str(folder), "--include-dashboard=false", "--disable-usage-stats", "--block"]
    process = subprocess.Popen(
        command, env={**os.environ, **environment}, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        eventually(lambda: process.poll() is not None or Path(folder, "ray_current_cluster").exists())
        yield process
    finally:
        kill(process.pid)
        process.wait()


def test_a_head_that_dies_is_waited_for_and_the_hunt_continues_with_the_next_one(toy, started):
    with tempfile.TemporaryDirectory(prefix="chf-", dir="/tmp") as short:
        port = free_port()
        words = ("--executor", f"ray:127.0.0.1:{port}")
        with by_hand(port, short):
            hunt, other = started("h", *words, "--seed", "3"), None
            eventually(lambda: len(rows(toy, "h")) > 4)
        count = len(rows(toy, "h"))
        assert count < TRIALS
        Path(short, "ray_current_cluster").unlink(missing_ok=True)
        with by_hand(port, short):
            said = ends(hunt)
            assert "the Ray cluster was lost" in said
            assert "the hunt waits until it is back" in said
            whole(toy, "h")
            other = started("g", *words)
            eventually(lambda: len(rows(toy, "g")) > 4)
        time.sleep(3)
        other.send_signal(signal.SIGINT)
        said = ends(other, code=130)
        assert "Interrupted. Run the same command to resume." in said
        assert len(rows(toy, "g")) < TRIALS
        toy.crashhunt("run", "g", "2", str(TRIALS), "30", *SLOW)
        whole(toy, "g")


def test_a_token_is_shown_to_a_cluster_that_asks_for_it(toy):
    """Whichever way the cluster was started, and whatever is in the home folder."""
    (toy.folder / ".ray").mkdir()
    token = toy.folder / ".ray" / "auth_token"
    toy.environment["HOME"] = str(toy.folder)
    with tempfile.TemporaryDirectory(prefix="chf-", dir="/tmp") as short:
        port = free_port()
        words = ("run", "0", "3", "5", "--scenario", "toy", "--seed", "1", "--executor", f"ray:127.0.0.1:{port}")
        with by_hand(port, short):
            token.write_text("0123456789" * 4)
            toy.crashhunt(words[0], "plain", *words[1:])
        Path(short, "ray_current_cluster").unlink()
        with by_hand(port, short, HOME=str(toy.folder), RAY_AUTH_MODE="token"):
            toy.crashhunt(words[0], "shown", *words[1:])
            token.write_text("9876543210" * 4)
            err = toy.crashhunt(words[0], "wrong", *words[1:], expect=2).err
            assert f"the Ray cluster at 127.0.0.1:{port} expects another token; put the token with which" in err
            token.unlink()
            err = toy.crashhunt(words[0], "none", *words[1:], expect=2).err
            assert f"the Ray cluster at 127.0.0.1:{port} needs a token; set RAY_AUTH_MODE=token, and put" in err


BEATING = """
import os, pathlib, time


class Agent:
    def __init__(self, number: int = 0):
        self.number = number
        self.beat = pathlib.Path("BEATS", f"{number}-{os.getpid()}")

    def reset(self, seed): pass

    def act(self, observation):
        time.sleep(0.01)
        self.beat.touch()
        if self.number == 0 and len(list(self.beat.parent.iterdir())) >= 3:  # all nodes are at work
            pathlib.Path("BEATS.at").open("a").write(f"{time.time()}\\n")
            raise RuntimeError("on purpose")
        return 1.0, 0
"""


def test_the_first_crash_stops_every_node(toy, cluster, add):
    """Generously, for a loaded machine; how soon it is, is measured by scripts/bench."""
    add(3)
    beats = toy.folder / "beats"
    beats.mkdir()
    (toy.folder / "beating.py").write_text(BEATING.replace("BEATS", str(beats)))
    words = ("--agent", "beating:Agent", "--arg", "number=0:29", "--sampler", "grid", "--points", "30")
    address = f"ray:{cluster.address}"
    toy.crashhunt("run", "h", "0", "30", "100000", "--scenario", "toy", *words, "--executor", address)
    ended = time.time()
    raised = float((toy.folder / "beats.at").read_text().split()[0])  # what follows is the crash's confirmation
    time.sleep(1)
    last = [beat.stat().st_mtime for beat in beats.iterdir() if not beat.name.startswith("0-")]
    assert len(last) >= 2
    assert max(last) < ended, "a node goes on after the hunt has ended"
    assert max(last) - raised < 10
