"""Trials are pairs where nothing but the agent differs."""

from __future__ import annotations

from contextlib import closing

import crashhunt
from crashhunt.hunts import Ledger
from crashhunt.plans import AgentSettings, ArgumentSpec, HuntSettings, RunSettings, write_settings
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
        run=RunSettings(keep_going=True),
        disturb=disturb,
    )
    write_settings(path / "hunt.toml", settings, ["crashhunt"])
    with closing(Ledger(path / "ledger.sqlite", writable=True)) as ledger:
        for number in range(trials):
            spec = TrialSpec(
                number, seed + number, {"ego": {"speed": 4.0}}, {"gap_m": 20 + number + shift}, max_steps=9
            )
            outcome = Outcome.COLLISION if number < crashes else Outcome.SURVIVED
            ledger.record(TrialResult(spec, outcome, steps=9), snapshot="")
        ledger.enter("all_trials", planned=trials, hunt_seed=seed)
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


def test_trials_of_another_length_are_no_fair_comparison(tmp_path):
    (pair,) = crashhunt.compare(hunt(tmp_path / "a", 9), hunt(tmp_path / "b", 2, max_steps=5)).pairs
    assert "9 steps to crash in, those of the other 5" in pair.caution
