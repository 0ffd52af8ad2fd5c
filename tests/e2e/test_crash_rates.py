"""How often an agent crashes: distances in ledgers, `rate`, `run --until-rate`."""

from __future__ import annotations

import json
import os
import sqlite3
from contextlib import closing

import pytest


def results(folder):
    with closing(sqlite3.connect(folder / "ledger.sqlite")) as database:
        rows = database.execute("SELECT result FROM trials ORDER BY number").fetchall()
    return [json.loads(text) for (text,) in rows]


def test_ledger_has_the_distance_and_time_of_each_valid_trial(hunt):
    found = results(hunt.folder / "h")
    assert len(found) == 12
    for trial in found:
        assert trial["step_length_s"] == 0.1
        assert trial["driven_s"] == pytest.approx(trial["steps"] * 0.1)
        assert 0 < trial["driven_m"] < 60 * trial["driven_s"]


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("scenario", "slow"),
    [("loop", "--no-native"), ("highway", "--no-accelerate"), ("intersection-two-agents", "--no-accelerate")],
)
def test_compiled_core_and_accelerator_measure_the_same_distances(shell, scenario, slow):
    found = []
    for folder, options in (("fast", ()), ("slow", (slow,))):
        shell.crashhunt("run", folder, "1", "3", "200", "--scenario", scenario, "--seed", "5", "--keep-going", *options)
        found.append([(one["driven_m"], one["driven_s"], one["digest"]) for one in results(shell.folder / folder)])
    assert found[0] == found[1]
    assert all(meters > 10 for meters, *_ in found[0])


def rates(toy, *words, expect=0):
    return toy.crashhunt("rate", *words, "--json", expect=expect).json["rates"]


HUNT = ("60", "--no-snapshot", "--scenario", "toy", "--seed", "4", "--arg", "speed=10:14", "--set", "gap_m=10:20")


def hunted(shell):
    """Hunt 12 trials of which some crash, in ``h``; of each type, one crash is confirmed."""
    shell.crashhunt("run", "h", "1", "12", *HUNT, "--keep-going", "--keep", "1")


@pytest.fixture
def hunt(toy, made_once):
    return made_once(hunted, toy)


def test_rate_counts_trials_and_divides_them_by_an_argument(hunt):
    toy = hunt
    crashes = sum(trial["outcome"] == "collision" for trial in results(toy.folder / "h"))
    assert crashes > 2
    by_trial, by_hour, by_km = rates(toy, "h")
    assert (by_trial["units"], by_trial["crashes"], by_trial["estimate"]) == (12, crashes, crashes / 12)
    for rate in (by_trial, by_hour, by_km):
        assert 0 < rate["certain"]["low"] < rate["estimate"] < rate["certain"]["high"]
    (parts,) = rates(toy, "h", "--by", "speed:3")
    assert sum(part["trials"] for part in parts["parts"]) == 12
    assert sum(part["crashes"] for part in parts["parts"]) == crashes
    said = toy.crashhunt("rate", "h", "--by", "kind", "--html", "page.html").out
    assert f"h: {crashes} crashes in 12 trials (95 %, valid whenever you look)" in said
    assert "Crash rates" in (toy.folder / "page.html").read_text(encoding="utf-8")
    lines = toy.crashhunt("rate", "h", "--csv", "--by", "fault").out.splitlines()
    assert lines[0].startswith("dir,per,by,part")
    assert len(lines) >= 3


def test_bar_decides_the_exit_code(hunt):
    assert rates(hunt, "h", "--bar", "0.99/trial")[0]["verdict"] == "below"
    assert rates(hunt, "h", "--bar", "1e-6/trial", expect=1)[0]["verdict"] == "above"
    (close,) = rates(hunt, "h", "--per", "trial")
    assert rates(hunt, "h", "--bar", f"{close['estimate']}/trial", expect=3)[0]["verdict"] == "undecided"


def test_bad_input_is_one_line(hunt):
    toy = hunt
    os.mkfifo(toy.folder / "pipe")
    for words, says in (
        (("--bar", "7/mile"), "--bar is 7/mile; give a rate from 1e-12 to 1e12"),
        (("--confidence", "100"), "--confidence is 100; give percent from 50 to 99.9999"),
        (("--by", "kind:3"), "kind cannot be divided into bins; give --by kind"),
        (("h/hunt.toml",), "'h/hunt.toml' is a file; give the directory of a hunt or a suite"),
    ):
        done = toy.crashhunt("rate", "h", *words, expect=2)
        assert says in done.err
        assert done.err.count("\n") == 1
    assert "pipe: is a device or a pipe" in toy.crashhunt("rate", "h", "--html", "pipe", expect=2).err


# --- run --until-rate


FEW = ("--keep", "1")  # every crash with a bundle is confirmed


def until(toy, folder, workers, trials, rate, *words, expect):
    options = ("--until-rate", rate, "--json", *words)
    return toy.crashhunt("run", folder, workers, trials, *HUNT, *options, expect=expect).json


def test_hunt_that_cannot_decide_ends_at_most_and_exits_with_3(toy):
    found = until(toy, "h", "1", "0", "0.3/trial", *FEW, "--most", "3", expect=3)
    assert (found["stopped_because"], found["trials_run"], found["rate"]["verdict"]) == ("all_trials", 3, "undecided")


def test_hunt_with_too_many_invalid_trials_ends_with_a_line(toy):
    words = ("--arg", "speed=2", "--set", "fail_reset=true|false", "--until-rate", "1e-4/trial", "--seed", "3")
    done = toy.crashhunt("run", "h", "1", "0", "20", "--scenario", "toy", *words, "--no-snapshot", expect=3)
    why = "too many trials are invalid, so more of them do not help"
    assert f"undecided about the bar of 0.0001 per trial: {why}" in done.out
    assert "more than 5 %: the rest is other traffic than described" in done.out


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--until-rate", "3/hour", "--sampler", "guided"), "omit --sampler guided"),
        (("--until-rate", "3/hour", "--seeds", "2"), "omit --seeds"),
        (("--most", "9"), "--most 9 needs --until-rate"),
    ],
)
def test_option_that_contradicts_a_bar_is_refused(toy, words, says):
    done = toy.crashhunt("run", "h", "1", "5", *HUNT, *words, expect=2)
    assert says in done.err


RARE = ("60", "--scenario", "toy", "--agent", "crashhunt.agents:CarFollowing", "--disturb", "stop=0.1", "--rare")


def test_rare_mode_and_a_bar_exclude_each_other(toy):
    done = toy.crashhunt("run", "h", "2", "4", *RARE, "--until-rate", "1e-3/trial", expect=2)
    assert done.err == "crashhunt: --rare and --until-rate exclude each other; omit --until-rate\n"
