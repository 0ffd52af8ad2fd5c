"""A crash is made smaller, and stays the same kind of crash."""

from __future__ import annotations

import shutil
import signal
import time

import pytest

from crashhunt.crashes import find_bundle, list_bundles
from crashhunt.errors import BundleError, UsageError
from crashhunt.shrinking import shrink
from crashhunt.triage import signature_of


def hunted(shell):
    words = ("--scenario", "toy", "--arg", "speed=12.3456:14", "--set", "gap_m=20:30", "--seed", "1")
    shell.crashhunt("run", "h", "1", "3", "99", *words, "--keep-going")


@pytest.fixture
def hunt(toy, made_once, monkeypatch):
    made_once(hunted, toy)
    monkeypatch.chdir(toy.folder)
    return toy


def test_arguments_become_plain_and_the_rest_stays(hunt):
    was = find_bundle(hunt.folder / "h")
    told = hunt.crashhunt("shrink", "h", "--json").json
    assert (told["verdict"], told["ended"], told["signature_kept"], told["confirmed"]) == ("shrunk", "done", True, True)
    assert told["steps_after"] <= told["steps_before"] == was.result.steps
    small = find_bundle(hunt.folder / "h", f"{was.id}.small")
    assert str(small.path) == str(hunt.folder / told["path"])
    assert signature_of(small) == signature_of(was)
    assert (
        len(str(small.result.spec.arguments["ego"]["speed"])) <= 4 < len(str(was.result.spec.arguments["ego"]["speed"]))
    )
    assert small.added["shrunk"]["changed"] == told["changed"] != {}
    assert hunt.crashhunt("replay", "h", "--crash", small.id, "--json").json["verdict"] == "reproduced"
    assert f"{was.id} made smaller" in hunt.crashhunt("show", "h", "--crash", small.id).out

    # To the hunt, it is none of its crashes.
    assert small.id not in [bundle.id for bundle in list_bundles(hunt.folder / "h")]
    assert find_bundle(hunt.folder / "h", str(was.result.spec.number)).id == was.id
    assert hunt.crashhunt("status", "h", "--json").json["hunts"][0]["crashes"] == len(list_bundles(hunt.folder / "h"))
    assert hunt.crashhunt("check", "h", "--json").json["fine"]
    with pytest.raises(UsageError, match="has been made smaller already"):
        shrink(small)
    hunt.crashhunt("corpus", "add", told["path"], "--to", "kept")
    assert hunt.crashhunt("corpus", "run", "kept", "--json").json["cases"][0]["got"] == "still"


def test_a_budget_that_is_too_small_leaves_the_best_and_is_gone_on_from(hunt):
    bundle = find_bundle(hunt.folder / "h")
    part = shrink(bundle, budget=3, parallel=1)
    assert part.ended == "budget"
    assert part.trials <= 3
    assert "larger --budget" in part.why
    whole = shrink(bundle, parallel=1)
    assert whole.ended == "done"
    shutil.rmtree(whole.small.path)
    again = shrink(bundle, parallel=2)
    assert (again.small.result.spec, again.small.result.digest) == (whole.small.result.spec, whole.small.result.digest)
    assert not list(bundle.path.parent.glob(".*"))


def test_a_crash_that_does_not_come_again_is_told(hunt, monkeypatch):
    bundle = find_bundle(hunt.folder / "h")
    monkeypatch.setattr("crashhunt.shrinking._runs.signature_of", lambda _: None)
    found = shrink(bundle, parallel=1)
    assert (found.verdict, found.small) == ("not_reproduced", None)
    assert "did not come again" in found.why
    (bundle.path / "log.mcap").unlink()
    with pytest.raises(BundleError):
        shrink(bundle)


@pytest.mark.nightly
def test_ctrl_c_leaves_the_best(hunt):
    running = hunt.start("shrink", "h", "--parallel", "1")
    deadline = time.monotonic() + 60
    while not list((hunt.folder / "h" / "crashes").glob(".*")) and time.monotonic() < deadline:
        time.sleep(0.02)  # until a candidate has been run
    running.send_signal(signal.SIGINT)
    _, err = running.communicate(timeout=60)
    assert running.returncode in (0, 130), err
    assert "Traceback" not in err


def test_what_is_asked_for_must_make_sense(hunt):
    assert "--budget is 0" in hunt.crashhunt("shrink", "h", "--budget", "0", expect=2).err
    hunt.crashhunt("export", "h", "crash.zip")
    assert "unpack it" in hunt.crashhunt("shrink", "crash.zip", expect=2).err


@pytest.mark.nightly
@pytest.mark.parametrize("parallel", ["1", "3"])
def test_others_are_left_out_on_sumo(shell, parallel, tmp_path_factory):
    shell.crashhunt("run", "h", "2", "15", "300", "--seed", "1", "--keep-going", "--arg", "speed=20:25")
    told = shell.crashhunt("shrink", "h", "--parallel", parallel, "--json").json
    assert told["actors_after"] <= 3 < told["actors_before"]
    assert told["confirmed"]
    small = find_bundle(shell.folder / "h", f"{told['crash']}.small")
    kept = tmp_path_factory.getbasetemp() / "shrunk-digest"
    if kept.exists():
        assert kept.read_text() == small.result.digest
    kept.write_text(small.result.digest)
