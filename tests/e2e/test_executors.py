"""Where trials run is chosen by name: one of ours, or somebody's own, on every way to a hunt."""

from __future__ import annotations

import json
import tomllib

import pytest

MINE = '''
from pathlib import Path
from crashhunt.executors import PoolExecutor


class Logged:
    """A pool that writes down what it is asked; it knows the protocol and nothing else."""

    def __init__(self, settings, *, parallel, argument=""):
        self._pool = PoolExecutor(settings, parallel=parallel)
        self._log = Path("calls.log")
        self._said = ["an executor of mine was here"]
        self._write(f"made {parallel} {argument}")

    def _write(self, line):
        with self._log.open("a") as file:
            file.write(f"{line}\\n")

    @property
    def capacity(self):
        return self._pool.capacity

    def submit(self, spec):
        self._write(f"submit {spec.number}")
        self._pool.submit(spec)

    def completed(self, timeout_s):
        return self._pool.completed(timeout_s)

    def cancel(self, *, above=-1):
        self._pool.cancel(above=above)

    def where(self):
        return self._pool.where()

    def notes(self):
        said, self._said = self._said, []
        return [*said, *self._pool.notes()]

    def close(self):
        self._write("close")
        self._pool.close()


class Broken:
    def __init__(self, settings, *, parallel):
        raise RuntimeError("no cluster\\nhere")


class Refuses:
    def __init__(self, settings, *, parallel):
        from crashhunt.errors import UsageError

        raise UsageError("nobody answers at 10.0.0.1", fix="start it")
'''
WORDS = ("run", "h", "2", "4", "40", "--scenario", "toy", "--seed", "3", "--arg", "speed=5", "--keep-going")


@pytest.fixture
def mine(toy):
    (toy.folder / "mine.py").write_text(MINE)
    return toy


def calls(shell, name="calls.log"):
    lines = (shell.folder / name).read_text().splitlines()
    (shell.folder / name).unlink()
    return lines


@pytest.mark.nightly
def test_an_executor_of_somebodys_own_runs_the_trials(mine):
    usual = mine.crashhunt(*WORDS, "--json").json
    done = mine.crashhunt("run", "g", *WORDS[2:], "--executor", "mine:Logged:there:10001", "--json")
    same = {"dir": "", "wall_s": 0}
    assert done.json | same == usual | same | {"notes": ["an executor of mine was here"]}
    found = calls(mine)
    assert found[0] == "made 2 there:10001"
    assert found[1:5] == [f"submit {number}" for number in range(4)]
    assert set(found[5:]) == {"close"}
    assert "an executor of mine was here" in mine.crashhunt("logs", "g").out
    assert tomllib.loads((mine.folder / "g" / "hunt.toml").read_text())["run"]["executor"] == "mine:Logged:there:10001"
    assert "executor" not in (mine.folder / "h" / "hunt.toml").read_text()
    digests = [
        [line.split(",")[-1] for line in mine.crashhunt("trials", hunt, "--format", "csv").out.splitlines()]
        for hunt in "hg"
    ]
    assert digests[0] == digests[1]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nope", "'nope' is not a registered name of executors; give one of fresh, pool, "),
        ("pol", "did you mean 'pool'?"),
        ("pool:3", "--executor pool:3: 'pool' takes no argument; write --executor pool"),
        ("mine:Nothing", "'mine:Nothing': mine has no attribute 'Nothing'"),
        ("elsewhere:Pool:3", "No module named 'elsewhere'"),
        ("mine:Broken:x", "'mine:Broken' takes no argument"),
    ],
)
def test_what_there_is_not_is_one_line(mine, name, message):
    commands = [WORDS] if name != "nope" else [WORDS, ("suite", "run", "s.toml", "s"), ("rerun", "made")]
    (mine.folder / "s.toml").write_text('[[hunts]]\nid = "a"\nscenario = "toy"\n')
    (mine.folder / "made").mkdir()
    (mine.folder / "made" / "request.json").write_text("{}")
    for words in commands:
        done = mine.crashhunt(*words, "--executor", name, expect=2)
        assert message in done.err
        assert done.err.count("\n") == 1
    assert not (mine.folder / "h").exists()
    assert not (mine.folder / "s").exists()


def test_one_that_cannot_be_made_states_why(mine):
    done = mine.crashhunt(*WORDS, "--executor", "mine:Broken", "--json", expect=2)
    message = "the executor 'mine:Broken' cannot be created: RuntimeError: no cluster here"
    assert done.json["error"]["message"] == message
    assert "mine.py, line" in done.json["error"]["where"]
    done = mine.crashhunt(*WORDS, "--executor", "mine:Refuses", expect=2)
    assert done.err.strip().endswith("crashhunt: nobody answers at 10.0.0.1; start it")
    assert json.loads(mine.crashhunt("status", "h", "--json").out)["hunts"][0]["state"] == "error"
