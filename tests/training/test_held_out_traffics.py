"""The split of traffics, the record of a training, and comparisons of agents that were trained."""

from __future__ import annotations

import json
import multiprocessing
import re
import shutil
from contextlib import closing
from dataclasses import replace
from statistics import median

import pytest
from conftest import Shell
from hypothesis import given, strategies as st

import crashhunt
from crashhunt.crashes import list_bundles
from crashhunt.errors import HuntDirectoryError, UsageError
from crashhunt.ledger import Ledger
from crashhunt.report import comparison_page, describe_comparison, describe_gate, describe_running, gate_summary
from crashhunt.results import hunt_state
from crashhunt.statistics import CountingRule, GateReport, PairedHunts, PairWatch, TrialFacts, measure_rates
from crashhunt.statistics._counted_trials import RateCounter, UnitSequence
from crashhunt.statistics._rate_report import make_rate
from crashhunt.training import CrashEnv, HeldOutTraffics, TrainedOn, split_crashes
from crashhunt.training._held_out_traffics import is_test_traffic, read_trained_on

TOY = """
title = "A toy"
schema = 1
simulator = "toy"
[arguments.gap_m]
default = 12.0
range = "8:16"
[agents.ego]
agent = "held_out_driver:Driver"
"""
DRIVER = '''
from pathlib import Path

class Driver:
    """Drives with the speed in a file: its policy."""

    def __init__(self, path: str = "policy/speed.txt"):
        self.speed = float(Path(path).read_text())

    def reset(self, seed):
        pass

    def act(self, observation):
        return self.speed, 0
'''
TRIALS = 8


def trained(shell):
    """A hunt, an agent that was trained on its crashes, and hunts of that agent; for `made_once`."""
    folder = shell.folder
    (folder / "held.toml").write_text(TOY)
    (folder / "held_out_driver.py").write_text(DRIVER)
    for name, speed in (("policy", "12"), ("trained", "2")):
        (folder / name).mkdir()
        (folder / name / "speed.txt").write_text(speed)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.syspath_prepend(str(folder))
        run(folder, "before", "policy/speed.txt")
        CrashEnv("before", before_s=1.0, trained_on="trained").close()
        run(folder, "after", "trained/speed.txt")
        run(folder, "elsewhere", "trained/speed.txt", seed=5)


@pytest.fixture(scope="module")
def place(made_once, tmp_path_factory):
    folder = made_once(trained, Shell(tmp_path_factory.mktemp("held-out"))).folder
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.syspath_prepend(str(folder))
        yield folder


def run(folder, name, policy, seed=4):
    words = ("run", name, "2", str(TRIALS), "60", "--scenario", "held.toml", "--seed", str(seed), "--keep-going")
    Shell(folder).crashhunt(*words, "--arg", f"path={policy}")


def seeds_of(hunt):
    with closing(Ledger(hunt / "ledger.sqlite")) as ledger:
        return [result.spec.seed for result in ledger.results()]


# The split.


@given(st.integers(0, 2**31 - 1), st.floats(0, 1), st.floats(0, 1))
def test_a_larger_share_only_adds_to_the_test_part(seed, one, other):
    assert is_test_traffic(seed, min(one, other)) <= is_test_traffic(seed, max(one, other))
    assert not is_test_traffic(seed, 0.0)
    assert is_test_traffic(seed, 1.0)


def test_the_share_is_that_of_the_traffics_and_stays_the_same():
    for share in (0.1, 0.5, 0.8):
        count = sum(is_test_traffic(seed, share) for seed in range(20_000))
        assert abs(count / 20_000 - share) < 0.015
    # Files of a training name the share only, so later versions must draw the same line.
    assert [seed for seed in range(12) if is_test_traffic(seed, 0.5)] == [2, 4, 6]


def test_the_command_prints_the_parts(place, shell):
    shell.folder = place
    found = shell.crashhunt("split", "before", "--test", "0.5", "--json").json
    split = split_crashes([place / "before"], 0.5)
    assert [one["id"] for one in found["training"]] == [crash.bundle.id for crash in split.training]
    assert [one["id"] for one in found["held_out"]] == [crash.bundle.id for crash in split.held_out]
    assert len(found["training"]) + len(found["held_out"]) == len(list_bundles(place / "before"))
    for part, is_test in ((split.training, False), (split.held_out, True)):
        assert {is_test_traffic(crash.seed, 0.5) for crash in part} == {is_test}
    done = shell.crashhunt("split", "before", "--part", "test")
    assert done.out.splitlines() == [one["path"] for one in found["held_out"]]
    assert "--test is 1; give a share" in shell.crashhunt("split", "before", "--test", "1", expect=2).err
    assert "'gone' is not a directory" in shell.crashhunt("split", "gone", expect=2).err


# The record of a training.


def test_the_record_names_the_training_part_and_is_carried_in_snapshots(place):
    record = read_trained_on(place / "trained" / "trained_on.json")
    split = split_crashes([place / "before"], 0.5)
    assert record == TrainedOn(test=0.5, seeds=frozenset(one.seed for one in split.training), hunt_seeds=frozenset({4}))
    (carried,) = (place / "after").glob("snapshots/*/files/*-trained_on.json")
    assert read_trained_on(carried) == record
    assert not list((place / "before").glob("snapshots/*/files/*-trained_on.json"))


def _write(path, seed):
    TrainedOn(test=0.5, seeds=frozenset({seed}), hunt_seeds=frozenset({1})).write(path)


def test_processes_that_write_at_once_lose_nothing(tmp_path):
    file = tmp_path / "trained_on.json"
    context = multiprocessing.get_context("fork")
    children = [context.Process(target=_write, args=(file, seed)) for seed in range(8)]
    for child in children:
        child.start()
    for child in children:
        child.join()
    assert read_trained_on(file).seeds == frozenset(range(8))
    assert [path.name for path in tmp_path.iterdir()] == ["trained_on.json"]


def test_a_record_of_another_split_or_a_damaged_one_is_refused(tmp_path):
    file = tmp_path / "trained_on.json"
    _write(file, 1)
    with pytest.raises(UsageError, match=r"with test=0.5, but this training has test=0.2"):
        TrainedOn(test=0.2).write(file)
    of_wrong_type = '{"schema": 1, "test": 0.5, "seeds": ["1"], "hunt_seeds": []}'
    for text in ("", "[]", "{}", '{"schema": 1, "test": 2, "seeds": [], "hunt_seeds": []}', of_wrong_type):
        file.write_text(text)
        with pytest.raises(HuntDirectoryError, match="cannot be read: ") as caught:
            read_trained_on(file)
        assert "\n" not in str(caught.value)


# Comparisons.


def test_in_a_hunt_that_was_trained_on_only_the_hash_decides():
    record = TrainedOn(test=0.5, seeds=frozenset({3}), hunt_seeds=frozenset({4}))
    test = {seed for seed in range(40) if is_test_traffic(seed, 0.5)}
    assert {seed for seed in range(40) if HeldOutTraffics(4, (record,)).has(seed)} == test
    elsewhere = HeldOutTraffics(5, (record,))
    assert {seed for seed in range(40) if not elsewhere.has(seed)} == {3} - test
    assert not HeldOutTraffics(4, (record,)).is_empty
    whole = replace(record, test=0.0)
    assert HeldOutTraffics(4, (record, whole)).is_empty
    assert not HeldOutTraffics(5, (record, whole)).is_empty


def test_compare_counts_held_out_traffics_only(place):
    seeds = seeds_of(place / "before")
    held_out = sum(is_test_traffic(seed, 0.5) for seed in seeds)
    assert 0 < held_out < TRIALS
    (pair,) = crashhunt.compare("before", "after").pairs
    crashed = [bundle for bundle in list_bundles(place / "before") if is_test_traffic(bundle.result.spec.seed, 0.5)]
    assert (pair.trials, pair.only_first, pair.only_second) == (held_out, len(crashed), 0)
    assert pair.excluded == 2 * (TRIALS - held_out)
    expected = f"only {held_out} held-out pairs count: an agent was trained on traffics of the other"
    assert expected in describe_comparison(crashhunt.compare("before", "after"))
    # Training on other traffic changes nothing, and neither does an agent without a record.
    (plain,) = crashhunt.compare("before", "before").pairs
    assert (plain.trials, plain.excluded) == (TRIALS, 0)


@pytest.mark.usefixtures("without_test_part")
def test_compare_refuses_traffic_of_which_nothing_is_held_out():
    with pytest.raises(UsageError, match=f"an agent was trained on all {TRIALS} traffics"):
        crashhunt.compare("before", "after")


def test_rates_of_a_comparison_exclude_training_traffic_on_both_sides(place):
    found = crashhunt.compare("before", "after")
    held_out = sum(is_test_traffic(seed, 0.5) for seed in seeds_of(place / "before"))
    left_out = {"trained_on": TRIALS - held_out}
    crashed = [bundle for bundle in list_bundles(place / "before") if is_test_traffic(bundle.result.spec.seed, 0.5)]
    assert [(hunt.trials, hunt.exclusions) for hunt in found.hunts] == [(held_out, left_out)] * 2
    assert [hunt.crashes for hunt in found.hunts] == [len(crashed), 0]
    assert found.hunts[0].median_steps_to_crash == median(bundle.result.steps for bundle in crashed)
    said = describe_comparison(found)
    assert said.count(f": {TRIALS - held_out} trials on training traffic are excluded\n") == 2
    assert [hunt["left_out"] for hunt in found.to_json()["hunts"]] == [left_out] * 2
    comparison_page(found, place / "page.html")
    page = (place / "page.html").read_text()
    assert page.count(f"{TRIALS - held_out} trials on training traffic are excluded") == 2
    drawn = [int(count) for count in re.findall(r", (\d+) trials</title>", page)]
    assert sum(drawn) == 2 * held_out  # the plot of the only argument
    # Hunts of other traffic do not exclude it.
    (alone, elsewhere) = crashhunt.compare("before", "elsewhere").hunts
    assert (alone.exclusions, elsewhere.exclusions) == ({}, {})


def test_rate_excludes_training_traffic(place, shell):
    shell.folder = place
    held_out = sum(is_test_traffic(seed, 0.5) for seed in seeds_of(place / "before"))
    found = shell.crashhunt("rate", "after", "before", "--json", "--html", "rates.html")
    after, before = (next(one for one in found.json["rates"] if one["dir"] == name) for name in ("after", "before"))
    assert (after["units"], after["left_out"]) == (held_out, {"trained_on": TRIALS - held_out})
    assert (before["units"], before["left_out"]) == (TRIALS, {})
    said = f"{TRIALS - held_out} trials on training traffic are excluded"
    assert found.err.count(said) == 1
    assert said in (place / "rates.html").read_text()
    with_rate = hunt_state(place / "after").rate
    assert (with_rate["trials"], with_rate["trained_on"]) == (held_out, TRIALS - held_out)
    assert said in describe_running(with_rate)


def test_unpaired_comparison_uses_rates_on_held_out_traffic(place):
    (pair,) = crashhunt.compare("elsewhere", "after").pairs
    held_out = sum(is_test_traffic(seed, 0.5) for seed in seeds_of(place / "after"))
    assert (pair.test, pair.counts[1], pair.counts[3]) == ("intervals", TRIALS, held_out)


@pytest.fixture
def without_test_part(place):
    """The record of the trained agent without a test part, next to its policy and in its hunt's snapshot."""
    records = [*(place / "after").glob("snapshots/*/files/*-trained_on.json"), place / "trained" / "trained_on.json"]
    before = [record.read_text() for record in records]
    for record, text in zip(records, before, strict=True):
        record.write_text(json.dumps({**json.loads(text), "test": 0.0}))
    yield
    for record, text in zip(records, before, strict=True):
        record.write_text(text)


@pytest.mark.usefixtures("without_test_part")
def test_no_rate_without_held_out_traffic(place):
    for rate in measure_rates("after"):
        assert (rate.trials, rate.certain, rate.estimate) == (0, None, None)
        assert rate.why_not.startswith(f"an agent was trained on the traffic of all {TRIALS} trials")
    (pair,) = crashhunt.compare("elsewhere", "after").pairs
    assert (pair.test, pair.answer, pair.difference) == ("", "", None)
    assert f"after has no rate: an agent was trained on the traffic of all {TRIALS} trials" in pair.verdict


@pytest.mark.usefixtures("without_test_part")
def test_hunt_for_a_rate_on_training_traffic_is_refused(place, shell):
    shell.folder = place
    words = ("--scenario", "held.toml", "--seed", "4", "--arg", "path=trained/speed.txt")
    done = shell.crashhunt("run", "bar", "1", "0", "60", *words, "--until-rate", "0.5/trial", "--most", "20", expect=2)
    assert done.err.splitlines()[-1] == (
        "crashhunt: --until-rate: an agent was trained on all traffics of --seed 4; give another --seed"
    )
    assert not (place / "bar").exists()


def test_verdict_of_a_gate_reports_training_traffic():
    rule = CountingRule(max_steps=60, is_held_out=lambda seed: seed % 2 == 0)
    sequence, counter = UnitSequence(rule), RateCounter(rule, "trial")
    for number in range(24):
        for unit in sequence.add(TrialFacts(number, True, True, False, 60, None, None, None, "", seed=number)):
            counter.add(unit)
    rate = make_rate("h", "trial", counter, sequence)
    found = GateReport(verdict="undecided", base="a", head="b", pairs=12, trained_on=12, rates=(rate, rate))
    for text in (describe_gate(found), gate_summary(found)):
        assert "12 pairs do not count: an agent was trained on traffics of this part" in text
        assert text.count("0 crashes in 12 trials (12 trials on training traffic are excluded), at most") == 2
    assert found.to_json()["head"]["left_out"] == {"trained_on": 12}


def test_pairs_of_a_gate_have_the_record_of_a_snapshot_that_was_taken_after_the_ledger(place, tmp_path):
    for side in ("before", "after"):  # as a gate may see hunts that begin
        (tmp_path / side).mkdir()
        shutil.copy(place / side / "hunt.toml", tmp_path / side)
        Ledger(tmp_path / side / "ledger.sqlite", writable=True).close()
    pairs, watch = PairedHunts("toy", tmp_path / "before", tmp_path / "after", TRIALS), PairWatch(0.02)
    pairs.take(watch)
    assert (pairs.counts.pairs, pairs.trained_on, pairs.is_complete) == (0, 0, False)
    for side in ("before", "after"):
        shutil.copytree(place / side, tmp_path / side, dirs_exist_ok=True)
    pairs.take(watch)
    held_out = sum(is_test_traffic(seed, 0.5) for seed in seeds_of(place / "before"))
    assert (pairs.counts.pairs, pairs.trained_on) == (held_out, TRIALS - held_out)
    assert (watch.test.pairs, pairs.is_complete) == (held_out, True)


@pytest.mark.usefixtures("without_test_part")
def test_no_pair_of_a_gate_counts_where_nothing_is_held_out(place):
    pairs, watch = PairedHunts("toy", place / "before", place / "after", TRIALS), PairWatch(0.02)
    pairs.take(watch)
    assert (watch.test.pairs, pairs.trained_on, pairs.is_complete) == (0, TRIALS, True)
