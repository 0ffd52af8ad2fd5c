"""A night in CI: hunts, a corpus in the repository, and an exit code that tells new crashes from known ones."""

from __future__ import annotations

import json

import pytest

SUITE = """\
[[hunts]]
id = "toy"
scenario = "toy"
arguments = { speed = "10:20" }
trials = 4
max_steps = 60
seed = 1
keep_going = true
"""


@pytest.mark.nightly  # by day, test_answers_on_crashes.py
def test_crash_that_is_not_in_the_corpus_ends_the_night_with_1(toy):
    toy.crashhunt(
        "run", "h", "1", "4", "60", "--scenario", "toy", "--arg", "speed=10:20", "--seed", "1", "--keep-going"
    )
    bundles = sorted(path.name for path in (toy.folder / "h" / "crashes").iterdir())
    assert len(bundles) > 1
    (toy.folder / "corpus").mkdir()
    words = ("crashes", "h", "--known", "corpus", "--fail-on-new")
    done = toy.crashhunt(*words, expect=1)
    assert done.out.endswith("\n1 new crash type\n")
    added = toy.crashhunt("corpus", "add", "h", "--crash", bundles[-1], "--to", "corpus", "--json").json["cases"]
    assert [one["path"].startswith(f"corpus/{bundles[-1]}-") for one in added] == [True]
    done = toy.crashhunt("corpus", "add", "h", "--crash", "77", "--to", "corpus", expect=2)
    assert f"give one of {bundles[0]}" in done.err
    done = toy.crashhunt("corpus", "add", "h", "h", "--crash", bundles[0], "--to", "corpus", expect=2)
    assert "--crash chooses a crash of one hunt, and 2 bundles are given" in done.err
    group = toy.crashhunt(*words, "--json").json["groups"][0]
    assert (group["known"], group["known_by"]) == (added[0]["path"], "type")


@pytest.mark.nightly  # by day, one hunt's are compared
def test_suite_compares_its_crash_types_with_a_corpus(toy):
    (toy.folder / "suite.toml").write_text(SUITE)
    words = ("suite", "run", "suite.toml", "night", "1", "--known", "corpus", "--fail-on-new")
    done = toy.crashhunt(*words, expect=2)
    assert "'corpus' does not exist" in done.err
    assert not (toy.folder / "night").exists()  # which is said before the hunts
    (toy.folder / "corpus").mkdir()
    assert toy.crashhunt(*words[:5]).code == 0
    assert "1 new crash type" in toy.crashhunt(*words, expect=1).out
    assert toy.crashhunt(*words[:-1]).code == 0
    data = json.loads(toy.crashhunt(*words, "--json", expect=1).out)
    assert [(one["known"], one["known_by"]) for one in data["groups"]] == [(None, None)]
    toy.crashhunt("corpus", "add", "night/toy/0", "--to", "corpus")
    assert len(toy.crashhunt(*words, "--json").json["groups"]) == 1
