"""Trials are pairs where nothing but the agent differs."""

from __future__ import annotations

from contextlib import closing

import crashhunt
from crashhunt.ledger import Ledger
from crashhunt.plans import AgentSettings, ArgumentSpec, HuntSettings, RunSettings, write_settings
from crashhunt.report import describe_comparison
from crashhunt.trial import Outcome, TrialResult, TrialSpec


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
    )
    write_settings(path / "hunt.toml", settings, ["crashhunt"])
    with closing(Ledger(path / "ledger.sqlite", writable=True)) as ledger:
        for number in range(trials):
            origin = "" if plain is None else "random" if number % plain == 0 else "mutation"
            gap_m = 20 + number + (0 if origin == "random" else shift)
            spec = TrialSpec(number, seed + number, {"ego": {"speed": 4.0}}, {"gap_m": gap_m}, 9, origin=origin)
            outcome = Outcome.COLLISION if number < crashes else Outcome.SURVIVED
            ledger.record(TrialResult(spec, outcome, steps=9), snapshot="")
        facts = {} if plain is None else {"independent": False, "plain_origin": "random", "origins": True}
        ledger.enter("all_trials", planned=trials, hunt_seed=seed, **facts)
    return path


def test_same_seeds_are_pairs_only_in_the_same_traffic(tmp_path):
    first = hunt(tmp_path / "first", 20)
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
            assert (pair.trials, pair.only_first, pair.both, pair.test) == (40, 18, 2, "mcnemar"), name
            assert not pair.why_unpaired
            assert "crashes less: of 40 trials with the same seeds" in pair.verdict
            continue
        assert (pair.trials, pair.only_first, pair.only_second, pair.both) == (0, 0, 0, 0), name
        assert says in pair.verdict
        if name == "other draws":  # whose trials are not independent of each other
            assert (pair.test, pair.p_value) == ("", 1.0)
        else:
            assert (pair.test, pair.counts) == ("fisher", (20, 40, 2, 40))
            assert 0 < pair.p_value < 1e-4
            assert f"{name} crashes less: 20 of 40 trials crash in" in pair.verdict


def test_of_trials_that_share_traffics_nothing_is_said_that_takes_them_for_independent(tmp_path):
    found = crashhunt.compare(hunt(tmp_path / "shared", 20, seeds=5), hunt(tmp_path / "alone", 2))
    assert found.hunts[0].interval is None
    assert "its trials take place in 5 traffics" in found.hunts[0].why_not
    assert found.hunts[1].interval
    (pair,) = found.pairs
    assert (pair.trials, pair.test, pair.p_value) == (0, "", 1.0)
    assert "trials take place in 5 traffics (--seeds)" in pair.verdict


def test_trials_of_another_length_are_no_fair_comparison(tmp_path):
    (pair,) = crashhunt.compare(hunt(tmp_path / "a", 9), hunt(tmp_path / "b", 2, max_steps=5)).pairs
    assert "9 steps to crash in, those of the other 5" in pair.caution


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
    assert "guided: counted are the trials of origin random" in describe_comparison(found)


def test_a_hunt_that_stopped_at_a_guided_crash_states_nothing_either(tmp_path):
    """The trials that count have not crashed, but how many there are was up to one that does not."""
    guided = hunt(tmp_path / "guided", 0, sampler="guided", plain=5, trials=13, keep_going=False)
    with closing(Ledger(guided / "ledger.sqlite", writable=True)) as ledger:
        spec = TrialSpec(13, 14, {"ego": {"speed": 4.0}}, {"gap_m": 20}, max_steps=9, origin="mutation")
        ledger.record(TrialResult(spec, Outcome.COLLISION, steps=9), snapshot="")
    figures = crashhunt.compare(guided, hunt(tmp_path / "plain", 12)).hunts[0]
    assert (figures.crashes, figures.interval) == (0, None)
    assert "it stopped at its first crash" in figures.why_not


def test_a_hunt_without_a_last_trial_that_was_to_stop_at_kinds_has_no_interval(tmp_path):
    stopped = hunt(tmp_path / "stopped", 3, distinct=2)
    path = stopped / "hunt.toml"
    path.write_text(path.read_text().replace("trials = 40", "trials = 0"))
    figures = crashhunt.compare(stopped, hunt(tmp_path / "plain", 12)).hunts[0]
    assert "it stopped at 2 kinds of crashes" in figures.why_not
