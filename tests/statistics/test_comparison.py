"""Trials are pairs where nothing but the agent differs."""

from __future__ import annotations

import math
from collections import Counter
from contextlib import closing
from dataclasses import replace

import pytest

import crashhunt
from crashhunt.base.errors import UsageError
from crashhunt.ledger import Ledger
from crashhunt.plans import AgentSettings, ArgumentSpec, HuntSettings, RunSettings, write_settings
from crashhunt.report import describe_comparison
from crashhunt.statistics import PairTest, _comparison
from crashhunt.training import _held_out_traffics
from crashhunt.trial import KILLED, Failure, Outcome, TrialResult, TrialSpec


def hunt(
    path,
    crashes,
    *,
    gap="20.0:30.0",
    digest="a",
    sampler="random",
    seed=1,
    trials=40,
    shift=0.0,
    max_steps=9,
    disturb=(),
    plain=None,
    seeds=0,
    rare=False,
    drive=None,
    **run,
):
    """A hunt whose trials below ``crashes`` crash, without running it."""
    path.mkdir()
    settings = HuntSettings(
        scenario="toy",
        scenario_digest=digest,
        trials=trials,
        max_steps=max_steps,
        seed=seed,
        sampler=sampler,
        agents={"ego": AgentSettings(agent="keep-lane", arguments={"speed": ArgumentSpec(spec="4.0")})},
        scenario_arguments={"gap_m": ArgumentSpec(spec=gap, kind="float")},
        run=RunSettings(**{"keep_going": True, **run}),
        disturb=disturb,
        seeds=seeds,
        rare=rare,
    )
    write_settings(path / "hunt.toml", settings, ["crashhunt"])
    with closing(Ledger(path / "ledger.sqlite", writable=True)) as ledger:
        for number in range(trials):
            origin = "" if plain is None else "random" if number % plain == 0 else "mutation"
            gap_m = 20 + number + (0 if origin == "random" else shift)
            place = number % seeds if seeds else number
            spec = TrialSpec(number, seed + place, {"ego": {"speed": 4.0}}, {"gap_m": gap_m}, 9, origin=origin)
            outcome = Outcome.COLLISION if number < crashes else Outcome.SURVIVED
            driven = {"driven_s": drive(number), "driven_m": 40 * drive(number), "step_length_s": 1.0} if drive else {}
            ledger.record(TrialResult(spec, outcome, steps=9, **driven), snapshot="")
        facts = {} if plain is None else {"independent": False, "plain_origin": "random", "origins": True}
        ledger.enter("all_trials", planned=trials, hunt_seed=seed, **facts)
    return path


def test_a_single_pair_is_one_trial(tmp_path):
    (pair,) = crashhunt.compare(hunt(tmp_path / "one", 1, trials=1), hunt(tmp_path / "two", 0, trials=1)).pairs
    assert "of 1 trial with the same seeds, 1 crash only in " in pair.verdict


def test_same_seeds_are_pairs_only_in_the_same_traffic(tmp_path):
    first, discordant = hunt(tmp_path / "first", 20), PairTest()
    discordant.add_counts(18, 0, 22)
    for name, options, says in (
        ("same", {}, ""),
        ("elsewhere", {"digest": "b"}, "are of two scenarios, in which the same seed is another traffic"),
        ("other values", {"gap": "5.0:6.0"}, "do not try the same values of gap_m"),
        ("other seeds", {"seed": 1000}, "have no seed in common"),
        ("other draws", {"sampler": "halton", "shift": 0.5}, "have other values of the scenario's arguments"),
        ("own draws", {"sampler": "halton"}, ""),
        ("disturbed", {"disturb": ("brake=0.1",)}, "have no disturbances and the disturbances brake=0.1, so that"),
    ):  # fmt: skip
        (pair,) = crashhunt.compare(first, hunt(tmp_path / name, 2, **options)).pairs
        if not says:
            assert (pair.trials, pair.only_first, pair.both, pair.test) == (40, 18, 2, "pairs"), name
            assert not pair.why_unpaired
            assert (pair.p_value is None) == (name == "own draws")
            assert pair.evidence == pytest.approx(math.exp(discordant.log_evidence))
            assert pair.difference.low < -18 / 40 < pair.difference.high < 0
            assert "crashes less: of 40 trials with the same seeds" in pair.verdict
            continue
        assert (pair.trials, pair.only_first, pair.only_second, pair.both) == (0, 0, 0, 0), name
        assert says in pair.verdict
        assert pair.evidence is None
        if name == "other draws":  # whose trials are not independent of each other
            assert (pair.test, pair.p_value, pair.difference) == ("", None, None)
        else:
            assert (pair.test, pair.counts, pair.answer) == ("intervals", (20, 40, 2, 40), "second")
            assert pair.difference.high < 0
            assert pair.p_value == pytest.approx(8.334e-06, rel=1e-3)  # Fisher's test of 20/40 and 2/40
            assert f"{name} crashes less: 20 of 40 trials crash in" in pair.verdict


def test_difference_is_in_the_requested_unit_and_decides_although_the_intervals_overlap(tmp_path):
    few = hunt(tmp_path / "few", 4, trials=120, drive=lambda n: 4.0 if n < 4 else 9.0)
    many = hunt(tmp_path / "many", 17, trials=120, drive=lambda n: 4.0 if n < 17 else 9.0)
    for per, low, unit in (
        ("trial", 0.02, "per trial"),
        ("hour", 5.0, "per hour"),
        ("1000km", 100.0, "per 1,000 km"),
    ):
        found = crashhunt.compare(few, many, per=per)
        (pair,) = found.pairs
        one, other = found.hunts
        assert one.interval[1] > other.interval[0]
        assert (pair.answer, pair.per, one.per) == ("first", per, per)
        assert pair.difference.low > 0
        assert pair.difference.low < other.crash_rate - one.crash_rate < pair.difference.high
        assert pair.difference.high > low
        assert f"crashes {unit} (" in pair.verdict
        assert "the intervals of the two hunts overlap: the difference of trials" in pair.caution
        assert (pair.evidence is None) == (per != "trial")
        assert describe_comparison(found)
    (pair,) = crashhunt.compare(many, few, per="hour").pairs
    assert (pair.answer, pair.difference.high < 0) == ("second", True)
    (pair,) = crashhunt.compare(hunt(tmp_path / "a", 2), hunt(tmp_path / "b", 9), per="hour").pairs
    assert (pair.difference, pair.answer) == (None, "")
    assert "no trial has a driven distance and time" in pair.caution
    with pytest.raises(UsageError, match="per is 'mile'; "):
        crashhunt.compare(few, many, per="mile")


def test_answer_is_that_of_the_interval_and_not_of_a_test_at_the_end(tmp_path):
    """A test that is made once has p = 0.039, and the interval that is valid at any time still contains 0."""
    (pair,) = crashhunt.compare(hunt(tmp_path / "a", 10), hunt(tmp_path / "b", 3)).pairs
    assert pair.p_value < 0.05
    assert pair.answer == "undecided"
    assert pair.difference.low < 0 < pair.difference.high
    assert pair.verdict.startswith("undecided, because the difference may be 0: of 40 trials")
    assert "p =" not in pair.verdict


def test_traffics_are_the_pairs_of_hunts_that_share_traffics(tmp_path):
    several = {"trials": 120, "seeds": 24}
    found = crashhunt.compare(hunt(tmp_path / "a", 60, **several), hunt(tmp_path / "b", 6, **several))
    assert all(figures.interval is not None for figures in found.hunts)
    (pair,) = found.pairs
    # Of 24 traffics with 5 trials each the first crashes 2 or 3 times in each, the second once in six.
    assert (pair.units, pair.trials, pair.only_first, pair.only_second) == (24, 120, 24, 0)
    assert pair.p_value is None
    assert pair.answer == "second"
    assert "of 24 traffics with 120 trials each way, " in pair.verdict
    assert pair.difference.low < -54 / 120 < pair.difference.high < 0
    (pair,) = crashhunt.compare(tmp_path / "a", hunt(tmp_path / "alone", 2)).pairs
    assert (pair.trials, pair.p_value) == (0, None)
    assert "have 24 traffics and one per trial (--seeds)" in pair.verdict


def test_differences_of_traffics_are_those_of_the_trials_that_both_hunts_have(tmp_path):
    first, second = hunt(tmp_path / "a", 60, trials=120, seeds=24), hunt(tmp_path / "b", 0, trials=48, seeds=24)
    for one, other, sign in ((first, second, -1), (second, first, 1)):
        (pair,) = crashhunt.compare(one, other).pairs
        assert (pair.units, pair.trials) == (24, 48)
        assert pair.difference.low < sign * 0.99 < pair.difference.high


def test_a_hunt_that_was_extended_has_no_p_value(tmp_path):
    whole, extended = hunt(tmp_path / "whole", 20), hunt(tmp_path / "extended", 2)
    assert crashhunt.compare(whole, extended).pairs[0].p_value is not None
    with closing(Ledger(extended / "ledger.sqlite", writable=True)) as ledger:
        ledger.note(replanned=True)
    (pair,) = crashhunt.compare(whole, extended).pairs
    assert pair.p_value is None
    assert pair.answer == "second"
    (pair,) = crashhunt.compare(whole, hunt(tmp_path / "elsewhere", 2, digest="b")).pairs
    assert pair.p_value is not None


def test_hunts_that_were_killed_or_stopped_are_compared_up_to_the_first_trial_that_has_not_ended(tmp_path):
    whole, killed = hunt(tmp_path / "whole", 20), hunt(tmp_path / "killed", 2, keep_going=False)
    with closing(Ledger(killed / "ledger.sqlite", writable=True)) as ledger:
        ledger.replace([30, 33])
    found = crashhunt.compare(whole, killed)
    assert (found.hunts[1].trials, found.hunts[1].excluded) == (30, 8)
    assert math.isnan(found.hunts[1].crash_rate)
    assert found.hunts[1].interval is not None
    (pair,) = found.pairs
    assert (pair.trials, pair.only_first, pair.both, pair.excluded) == (30, 18, 2, 18)
    assert pair.p_value is None
    assert pair.answer == "second"


def test_hunt_whose_first_trial_has_not_ended_has_no_rate_for_that_reason(tmp_path):
    stopped = hunt(tmp_path / "stopped", 3, keep_going=False, trials=3)
    with closing(Ledger(stopped / "ledger.sqlite", writable=True)) as ledger:
        ledger.replace([0, 1])
    figures = (found := crashhunt.compare(stopped, hunt(tmp_path / "whole", 3))).hunts[0]
    assert (figures.trials, figures.excluded) == (0, 1)
    assert figures.why_not == "trial 0 has not ended, and trials count in the order of their numbers"
    assert f"{stopped}: no crash rate: {figures.why_not}" in describe_comparison(found)
    assert f"{stopped}: not counted: 1 trial after one that has not ended" in describe_comparison(found)


def test_trials_that_are_invalid_for_both_agents_leave_both_sides(tmp_path):
    few, many = hunt(tmp_path / "few", 20, trials=100), hunt(tmp_path / "many", 2, trials=100)
    invalidate(few, 0)
    invalidate(many, 0)
    (pair,) = crashhunt.compare(few, many).pairs
    assert (pair.trials, pair.only_first, pair.both, pair.excluded) == (99, 18, 1, 2)
    for folder in (few, many):
        invalidate(folder, 30, 31, 32, 33, 34)
    (pair,) = crashhunt.compare(few, many).pairs
    assert (pair.trials, pair.evidence) == (0, None)
    assert "6 of 100 pairs have an invalid trial, more than 5 %" in pair.verdict


def test_trials_that_are_invalid_for_one_agent_only_count_against_it_or_have_no_result(tmp_path):
    few, many = hunt(tmp_path / "few", 2, trials=100), hunt(tmp_path / "many", 2, trials=100)
    invalidate(many, *range(30, 40), failure=Failure("KeyError", "'x'", "Traceback", "ego", party="agent"))
    (pair,) = crashhunt.compare(few, many).pairs
    assert (pair.trials, pair.only_second, pair.answer, pair.not_started) == (100, 10, "first", (0, 10))
    assert pair.difference.low > 0
    assert "many does not start in 10 of the pairs, which count as crashes (trial 30: KeyError: 'x')" in pair.caution
    invalidate(many, *range(30, 40), failure=Failure(KILLED, "killed from outside 3 times"))
    (pair,) = crashhunt.compare(few, many).pairs
    assert (pair.trials, pair.only_second, pair.answer, pair.without_result) == (90, 0, "undecided", 10)
    assert "10 more pairs without a result: " in pair.caution


def invalidate(folder, *numbers, failure=None):
    with closing(Ledger(folder / "ledger.sqlite", writable=True)) as ledger:
        before = [ledger.result(number) for number in numbers]
        ledger.replace(numbers)
        for result in before:
            ledger.record(replace(result, outcome=Outcome.INVALID, failure=failure), snapshot="")


def test_hunts_in_rare_mode_are_not_paired(tmp_path):
    words = {"disturb": ("brake=0.1",)}
    found = crashhunt.compare(hunt(tmp_path / "a", 20, rare=True, **words), hunt(tmp_path / "b", 2, rare=True, **words))
    (pair,) = found.pairs
    assert [math.isnan(figures.crash_rate) for figures in found.hunts] == [True, True]
    assert all("in rare mode" in figures.why_not for figures in found.hunts)
    assert (pair.test, pair.answer, pair.difference) == ("", "", None)
    assert "are in rare mode" in pair.verdict


def test_trials_of_another_length_are_no_fair_comparison(tmp_path):
    first, same, other = hunt(tmp_path / "a", 9), tmp_path / "b", tmp_path / "c"
    found = crashhunt.compare(first, hunt(same, 2, max_steps=5), hunt(other, 2, seed=2, max_steps=5))
    assert [pair.test for pair in found.pairs][1:] == ["intervals"]
    assert all("9 steps to crash in, those of the other 5" in pair.caution for pair in found.pairs)


def test_of_a_hunt_that_guided_its_trials_only_those_count_that_it_did_not(tmp_path):
    guided = hunt(tmp_path / "guided", 16, sampler="guided", plain=5, shift=0.5)  # 0, 5, 10 and 15 crash of its eight
    plain = hunt(tmp_path / "plain", 12)
    found = crashhunt.compare(guided, plain)
    first, second = found.hunts
    assert (first.trials, first.crashes, first.crash_rate, first.counted) == (8, 4, 0.5, "random")
    assert first.outcomes == {"collision": 16, "survived": 24}
    assert first.interval is not None
    assert first.interval[0] < 0.2 < 0.8 < first.interval[1]  # of eight trials, and not of forty
    assert (second.trials, second.counted) == (40, "")
    (pair,) = found.pairs  # the same trials, as the same number and seed is the same draw
    assert (pair.trials, pair.only_first, pair.only_second, pair.both) == (8, 1, 0, 3)
    assert "guided: only trials of origin random count" in describe_comparison(found)


def test_a_hunt_that_stopped_at_a_guided_crash_has_no_crash_rate_either(tmp_path):
    """The trials that count have not crashed, but how many there are was up to one that does not."""
    guided = hunt(tmp_path / "guided", 0, sampler="guided", plain=5, trials=13, keep_going=False)
    with closing(Ledger(guided / "ledger.sqlite", writable=True)) as ledger:
        spec = TrialSpec(13, 14, {"ego": {"speed": 4.0}}, {"gap_m": 20}, max_steps=9, origin="mutation")
        ledger.record(TrialResult(spec, Outcome.COLLISION, steps=9), snapshot="")
    figures = crashhunt.compare(guided, hunt(tmp_path / "plain", 12)).hunts[0]
    assert (figures.trials, figures.crashes) == (3, 0)  # 0, 5 and 10
    assert math.isnan(figures.crash_rate)
    assert "the hunt stops at its first crash" in figures.why_not


def test_a_hunt_without_a_last_trial_that_was_to_stop_at_kinds_has_no_crash_rate(tmp_path):
    stopped = hunt(tmp_path / "stopped", 3, distinct=2)
    path = stopped / "hunt.toml"
    path.write_text(path.read_text().replace("trials = 40", "trials = 0"))
    figures = crashhunt.compare(stopped, hunt(tmp_path / "plain", 12)).hunts[0]
    assert "the hunt stops at 2 crash types" in figures.why_not
    assert math.isnan(figures.crash_rate)
    assert figures.interval is not None


def test_each_hunt_of_a_comparison_is_read_a_fixed_number_of_times(tmp_path, monkeypatch):
    read, opened = [], []
    records, measured = _held_out_traffics.Snapshot, _comparison.measure_rates
    monkeypatch.setattr(_held_out_traffics, "Snapshot", lambda path: read.append(path.parents[1].name) or records(path))
    monkeypatch.setattr(
        _comparison, "measure_rates", lambda hunt, **given: opened.append(hunt.name) or measured(hunt, **given)
    )
    hunts = [hunt(tmp_path / f"h{number}", number) for number in range(6)]
    for path in hunts:
        (path / "snapshots" / "0f").mkdir(parents=True)
        (path / "snapshots" / "0f" / "manifest.json").write_text('{"schema": 2}')
    crashhunt.compare(*hunts)
    # For all hunts of its seed, and for its own pairs.
    assert Counter(read) == Counter({path.name: 2 for path in hunts})
    assert Counter(opened) == Counter({path.name: 1 for path in hunts})
