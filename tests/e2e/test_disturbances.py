"""A hunt with disturbances, from the command line to the report."""

from __future__ import annotations

import pytest

import crashhunt

WORDS = ("--scenario", "toy", "--seed", "4", "--arg", "speed=10", "--no-snapshot", "--keep-going")


def hunt(shell, *more, trials="6"):
    return shell.crashhunt("run", "h", "1", trials, "100", *WORDS, *more, "--json")


def test_what_is_not_asked_for_is_nowhere_and_what_is_not_drawn_changes_nothing(toy):
    plain = hunt(toy, trials="2")
    assert all("disturbed" not in crash for crash in plain.json["crashes"])
    assert "isturb" not in plain.err
    assert "disturb" not in (toy.folder / "h" / "hunt.toml").read_text()
    assert "log_likelihood" not in toy.crashhunt("trials", "h").out
    assert "disturbed" not in toy.crashhunt("status", "h", "--json").json["hunts"][0]
    digests = [trial.digest for trial in crashhunt.load(toy.folder / "h").results()]
    assert len(digests) == 2
    hunt(toy, "--disturb", "stop=0.000001", "--overwrite", trials="2")
    assert [trial.digest for trial in crashhunt.load(toy.folder / "h").results()] == digests
    assert 'disturb = [\n    "stop=1e-06",\n]' in (toy.folder / "h" / "hunt.toml").read_text()


def hunt_refused(shell, *more):
    done = shell.crashhunt("run", "h2", "1", "1", "9", *WORDS, *more, expect=2)
    assert not (shell.folder / "h2").exists()
    assert len(done.err.strip().splitlines()) == 1
    return done.err


def test_what_cannot_be_meant_is_one_line_before_the_hunt(toy):
    assert "'brake' has no rate; write NAME=RATE" in hunt_refused(toy, "--disturb", "brake")


@pytest.mark.nightly
def test_what_every_trial_has_in_the_hunt_the_scenario_and_the_replay(toy):
    words = "stop@30=ahead:6:8"
    done = hunt(toy, "--disturb", words, "--set", "gap_m=5", trials="1")
    (crash,) = done.json["crashes"]
    assert crash["disturbed"]
    assert "log-likelihood" not in done.err
    assert "Crashes: 0 in undisturbed traffic, 1 with disturbances." in done.err
    file = toy.folder / "h" / "hunt.toml"
    assert 'disturb = [\n    "stop@30=ahead:6.0:8.0",\n]' in file.read_text()
    assert toy.crashhunt("replay", "h", "--json").json["verdict"] == "reproduced"
    for change, said in (
        ("disturbances.30.how_strong=0", "disturbances.30.how_strong was 6.0 and is 0.0"),
        ("disturbances.stop@30=none", "disturbances.stop@30 was stop@30=ahead:6.0:8.0 and is none"),
        ("disturbances.brake@40=ahead:1:1", "disturbances.brake@40 was none and is brake@40=ahead:1.0:1.0"),
    ):
        assert said in toy.crashhunt("replay", "h", "--set", change, expect=None).out
    for change, said in (
        ("disturbances.brake@101=ahead:1:1", "brake@101 cannot happen: the trial has 100 steps"),
        (
            "disturbances.cut_in@40=left:1:1",
            "the toy does not support the disturbance 'cut_in'; it supports brake, stop",
        ),
    ):
        assert said in toy.crashhunt("replay", "h", "--set", change, expect=2).err
    file.write_text(file.read_text().replace("stop@30=ahead:6.0", "stop@30=ahead:1.0"))
    assert "disturb was stop@30=ahead:6.0:8.0 and is" in toy.crashhunt("replay", "h", expect=None).out

    scenario = toy.folder / "toy" / "scenario.toml"
    scenario.write_text(f'{scenario.read_text()}\n[disturbances]\nbrake = 1\n"stop@30" = "ahead:6:8"\n')
    hunt(toy, "--overwrite", "--set", "gap_m=5", trials="1")
    assert '"brake=1.0",\n    "stop@30=ahead:6.0:8.0",' in file.read_text()
    toy.crashhunt("run", "short", "1", "1", "20", *WORDS)  # in which that is never
    assert crashhunt.load(toy.folder / "short").settings.disturb == ("brake=1.0",)
