"""A crash is made smaller, and stays the same kind of crash."""

from __future__ import annotations

import errno
import os

import pytest

from crashhunt.analysis import shrink
from crashhunt.crashes import find_bundle, write_bundle
from crashhunt.errors import BundleError


def hunted(shell):
    words = ("--scenario", "toy", "--arg", "speed=12.3456:14", "--set", "gap_m=20:30", "--seed", "1")
    shell.crashhunt("run", "h", "1", "3", "99", *words, "--keep-going")


@pytest.fixture
def hunt(toy, made_once, monkeypatch):
    made_once(hunted, toy)
    monkeypatch.chdir(toy.folder)
    return toy


@pytest.mark.nightly
def test_a_full_disk_is_reported_and_what_came_of_the_trials_is_remembered(hunt, monkeypatch):
    bundle = find_bundle(hunt.folder / "h")
    folder = bundle.path.parent

    def full(hunt_folder, result, trial, **how):
        if "name" in how:  # of what is left; what is written to be looked at is elsewhere
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write_bundle(hunt_folder, result, trial, **how)

    def full_later(small, **_):
        assert "shrunk" in small.added
        assert small.path.name.startswith(".")  # a kill at this moment leaves no bundle under the final name
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr("crashhunt.analysis._minimization.write_bundle", full)
        with pytest.raises(BundleError, match=r"small' cannot be written: No space left") as raised:
            shrink(bundle, parallel=1)
    assert "run the same command again" in raised.value.fix
    (memory,) = folder.glob(".*")  # and no part of a bundle
    assert memory.stat().st_size > 0
    with monkeypatch.context() as patched:  # only after it has been written as a whole
        patched.setattr("crashhunt.analysis._minimization.confirm", full_later)
        with pytest.raises(BundleError, match=r"small' cannot be written: No space left"):
            shrink(bundle, parallel=1)
    assert not list(folder.glob("*.small"))
    run_again = []
    monkeypatch.setattr(
        "crashhunt.analysis._minimization_runs.Runs._remember", lambda _, spec, ran: run_again.append(spec)
    )
    found = shrink(bundle, parallel=1)
    assert (found.verdict, found.ended, run_again) == ("shrunk", "done", [])
    assert not list(folder.glob(".*"))


BAD = """
import os

class Dies:
    def __init__(self, speed: float = 12.0):
        self.speed = speed

    def reset(self, seed):
        self.steps = 0

    def act(self, observation):
        self.steps += 1
        if self.steps > 20 and self.speed > 5:
            os._exit(7)
        return self.speed, 0

class Flaky(Dies):
    def act(self, observation):
        self.steps += 1
        if self.steps == 6 and os.urandom(1)[0] < 160:
            raise ValueError("now and then")
        return min(self.speed, 6.0), 0
"""


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("agent", "words", "confirmed"), [("Dies", (), True), ("Dies", ("--no-snapshot",), True), ("Flaky", (), None)]
)
def test_a_dead_process_a_flaky_crash_and_one_without_a_snapshot_become_smaller(toy, agent, words, confirmed):
    (toy.folder / "bad.py").write_text(BAD, encoding="utf-8")
    given = ("--scenario", "toy", "--agent", f"bad:{agent}", "--arg", "speed=6.1234:14", "--seed", "1", *words)
    toy.crashhunt("run", "h", "1", "30", "60", *given)
    told = toy.crashhunt("shrink", "h", "--json", expect=None).json
    if confirmed is None and told["verdict"] == "not_reproduced":  # by chance, three or ten times
        assert "did not come again" in told["why"]
        return
    assert told["verdict"] == "shrunk"
    small = find_bundle(toy.folder / "h", f"{told['crash']}.small")
    assert small.result.outcome is find_bundle(toy.folder / "h").result.outcome
    if confirmed is not None:
        assert told["confirmed"] is confirmed
        assert toy.crashhunt("replay", "h", "--crash", small.id, "--json").json["verdict"] == "reproduced"
    assert any("--no-snapshot" in note for note in told["notes"]) is bool(words)


@pytest.mark.nightly
def test_of_several_agents_one_is_left_in_traffic(shell):
    words = ("--scenario", "loop-two-agents", "--seed", "1", "--keep-going")
    shell.crashhunt("run", "h", "2", "10", "600", *words)
    told = shell.crashhunt("shrink", "h", "--json").json
    small = find_bundle(shell.folder / "h", f"{told['crash']}.small")
    assert (told["confirmed"], told["actors_after"] <= 3) == (True, True)
    assert list(small.result.spec.arguments) == [path.actor.id for path in small.result.spec.script.agents]
    assert len(small.result.spec.arguments) == 1
    assert shell.crashhunt("replay", "h", "--crash", small.id, "--json").json["verdict"] == "reproduced"


@pytest.mark.nightly
@pytest.mark.parametrize("parallel", ["1", "3"])
def test_others_are_excluded_on_sumo(shell, parallel, tmp_path_factory):
    shell.crashhunt("run", "h", "2", "15", "300", "--seed", "1", "--keep-going", "--arg", "speed=20:25")
    told = shell.crashhunt("shrink", "h", "--parallel", parallel, "--json").json
    assert told["actors_after"] <= 3 < told["actors_before"]
    assert told["confirmed"]
    small = find_bundle(shell.folder / "h", f"{told['crash']}.small")
    kept = tmp_path_factory.getbasetemp() / "shrunk-digest"
    if kept.exists():
        assert kept.read_text() == small.result.digest
    kept.write_text(small.result.digest)
