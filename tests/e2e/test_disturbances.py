"""A hunt with disturbances, from the command line to the report."""

from __future__ import annotations

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
