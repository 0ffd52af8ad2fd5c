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
