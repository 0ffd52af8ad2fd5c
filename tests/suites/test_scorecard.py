"""The scorecard: its cases, the maps of the models, shares with intervals, the page and the table."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest

from crashhunt.crashes import COMPETENT_DRIVERS, wilson
from crashhunt.errors import UsageError
from crashhunt.report import describe_scorecard, scorecard_page, scorecard_table
from crashhunt.results import HuntState
from crashhunt.suites._scorecard_cases import (
    STEPS,
    ReferenceMaps,
    Scorecard,
    ScorecardHunt,
    Share,
    entries_of,
    groups_of,
)
from crashhunt.testing._kinematic_cases import solve


def hunts(**more):
    made = entries_of(groups_of("r157"), "keep-lane", [20, 60], options={}, **more)
    return {entry.id: entry for _, entry in made}


def test_every_group_of_the_regulation_has_a_hunt():
    found = hunts(grid=False)
    assert list(found) == [
        "cut-in-20", "cut-in-60", "cut-out", "deceleration", "lane-keeping", "following", "blocked-lane",
        "multiple-targets", "pedestrian", "detection-range",
    ]  # fmt: skip
    assert found["cut-in-60"].scenario_arguments["other_kmh"] == "10:50:10"
    assert found["cut-in-60"].trials == 5 * 13 * 6
    assert found["cut-out"].scenario_arguments["ego_kmh"] == "20|60"
    assert {entry.sampler for entry in found.values()} == {"boundary"}
    assert {entry.sampler for entry in hunts(grid=True).values()} == {"grid"}


@pytest.mark.parametrize(
    ("speed", "others"), [(1, "0"), (10, "5"), (11, "10"), (20, "10"), (21, "10:20:10"), (130, "10:120:10")]
)
def test_vehicle_that_cuts_in_is_always_slower(speed, others):
    ((_, entry),) = entries_of(groups_of("r157", ["cut-in"]), "keep-lane", [speed], grid=True, options={})
    assert entry.scenario_arguments["other_kmh"] == others


def test_unknown_suite_group_or_speed_is_refused():
    with pytest.raises(UsageError, match="--suite is 'r158'"):
        groups_of("r158")
    with pytest.raises(UsageError, match="--group 'cutin' is no group") as refused:
        groups_of("r157", ["cutin"])
    assert "cut-in" in refused.value.fix
    with pytest.raises(UsageError, match=r"--speeds contains 0 \(allowed: 1 to 250\)"):
        list(entries_of(groups_of("r157"), "keep-lane", [0], grid=True, options={}))


@pytest.mark.parametrize("model", COMPETENT_DRIVERS)
def test_map_of_a_model_is_that_of_the_published_cases(model):
    axes = {"other_kmh": (10, 30), "gap_m": np.arange(0, 61, 7.5), "lateral_mps": (0.5, 0.9, 1.7, 2.6)}
    cases = [
        {"ego_kmh": 50, "side": 1, **dict(zip(axes, one, strict=True))} for one in itertools.product(*axes.values())
    ]
    columns = {name: np.array([float(case[name]) for case in cases]) for name in ("ego_kmh", *axes)}
    found = ReferenceMaps("cut_in", cases, steps=STEPS, step_s=0.1).crashes(model)
    assert 0 < found.sum() < len(cases)
    assert found.tolist() == (solve("cut_in", columns, model)[model] > 0).tolist()


def test_careful_human_reacts_when_the_vehicle_ahead_shows_the_standing_vehicle():
    cases = [{"ego_kmh": 80, "front_m": front, "lateral_mps": 1.5, "headway_s": 2.0, "side": 1} for front in (5, 30.0)]
    columns = {name: np.array([float(case[name]) for case in cases]) for name in ("ego_kmh", "front_m", "lateral_mps")}
    found = ReferenceMaps("cut_out", cases, steps=350, step_s=0.1).crashes("cc_human")
    assert found.tolist() == (solve("cut_out", columns, "cc_human")["cc_human"] > 0).tolist() == [True, False]


def test_share_of_one_hunt_has_the_interval_of_wilson_and_of_all_cases_none():
    assert Share(((100, 20, 3),)).interval == pytest.approx(wilson(3, 20))
    assert Share(((20, 20, 3),)).interval == (0.15, 0.15)
    assert Share(((20, 0, 0),)).interval is None


def test_share_of_several_hunts_covers_the_true_share():
    """By brute force: random samples of two hunts with known shares."""
    rng, cases, true = np.random.default_rng(1), (300, 100), (0.1, 0.6)
    expected = (300 * 0.1 + 100 * 0.6) / 400
    inside = 0
    for _ in range(1000):
        drawn = [
            (n, 30, int(rng.hypergeometric(round(n * p), n - round(n * p), 30)))
            for n, p in zip(cases, true, strict=True)
        ]
        low, high = Share(tuple(drawn)).interval
        inside += low <= expected <= high
    assert inside >= 940


@pytest.fixture
def card():
    (group,) = groups_of("r157", ["cut-out"])
    agent = np.array([[1, 1, 0], [1, 0, 0]], bool)
    human = np.array([[1, 0, 0], [0, 0, 0]], bool)
    hunt = ScorecardHunt(
        group=group,
        state=HuntState(dir="d", state="crashed"),
        axes={"front_m": (10.0, 20.0), "lateral_mps": (0.5, 1.0, 1.5)},
        constants={"ego_kmh": 60},
        ran={number: bool(hit) for number, hit in enumerate(agent.ravel()) if number != 5},
        random=frozenset({0, 1, 4}),
        invalid=1,
        drivers={"cc_human": human.ravel(), "fsm": agent.ravel()},
        facts={
            "dir": "d", "state": "crashed", "seed": 7, "scenario_digest": "aa", "snapshot": "bb",
            "trials": 5, "trials_digest": "cc", "versions": {"python": "3.x"},
        },
        units={"front_m": "m"},
    )  # fmt: skip
    return Scorecard("r157", "<b>|", grid=False, hunts=(hunt,))


def test_maps_have_a_row_for_each_vertical_value(card):
    data = json.loads(json.dumps(card.to_json()))
    (group,) = data["groups"]
    (one,) = group["maps"]
    assert (one["x"]["name"], one["x"]["unit"], one["y"]["name"]) == ("front_m", "m", "lateral_mps")
    assert one["agent"] == [[True, True], [True, False], [False, False]]
    assert one["ran"] == [[True, True], [True, True], [True, False]]
    assert one["drivers"]["cc_human"] == [[True, False], [False, False], [False, False]]
    assert group["crashes"] == 3
    assert group["crashes_of_drivers"] == {"cc_human": 1, "fsm": 3, "rss": None, "reg157": None}
    share = group["preventable_by"]["cc_human"]
    assert (share["share"], share["random_cases"], share["found"]) == (pytest.approx(1 / 3), 3, 1)
    assert group["preventable_by"]["fsm"]["found"] == 0
    assert group["preventable_by"]["rss"] is None
    assert data["preventable_by"]["cc_human"]["share"] == share["share"]


def test_page_and_table_name_versions_seeds_and_digests(card):
    data = card.to_json()
    page, table, text = scorecard_page(data), scorecard_table(data), describe_scorecard(data, "d")
    for words in ("python 3.x", "bb", "cc", "7"):
        assert words in page
        assert words in table
    assert "&lt;b&gt;|" in page
    assert "<b>|" not in page
    assert page.count('class="only"') == 1 + 2  # the key, and two cases
    assert "In 33.3 % (6.1 % to 79.2 %) of the cases, <b>| crashes and a careful human does not" in text
    assert len({line.count("|") for line in table.splitlines() if line.startswith("| ")}) == 2


@pytest.mark.nightly
def test_scorecard_on_the_command_line_and_resumed(shell):
    words = (
        "scorecard",
        "keep-lane",
        "--arg",
        "speed=16",
        "--suite",
        "r157",
        "--group",
        "pedestrian,cut-out",
        "--speeds",
        "60",
    )
    first = json.loads(shell.crashhunt(*words, "--json").out)
    again = json.loads(shell.crashhunt(*words, "--json").out)
    assert again == first
    assert first["complete"]
    assert first["ran"] < first["cases"]
    assert (shell.folder / "scorecard-r157-keep-lane" / "scorecard.html").exists()
