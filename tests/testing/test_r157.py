"""Cases of UN R157: the answers, against a published implementation and a second computation, and what is refused."""

from __future__ import annotations

import csv
import gzip
from pathlib import Path

import numpy as np
import pytest

from crashhunt.agents import REFERENCE_MODELS
from crashhunt.testing import r157
from crashhunt.testing._kinematic_cases import LENGTH_M, WIDTH_M, solve

ANSWERS = Path(__file__).parent / "r157"  # of the models that the authors of FSM published, run on a grid of cases


def columns(**values: float) -> dict[str, np.ndarray]:
    return {name: np.array([float(value)]) for name, value in values.items()}


def cut_in(model: str, **values: float) -> int:
    return int(solve("cut_in", columns(**values), model)[model][0])


@pytest.mark.parametrize("half", [0, pytest.param(1, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("kind", ["cut_in", "cut_out", "car_following"])
def test_answers_agree_with_the_published_implementation_in_each_half_of_the_cases(kind, half, tmp_path):
    cases, answers = tmp_path / "cases.csv", tmp_path / "out.csv"
    header, *lines = gzip.decompress((ANSWERS / f"{kind}.csv.gz").read_bytes()).splitlines(keepends=True)
    cases.write_bytes(b"".join([header, *lines[half::2]]))
    assert r157.main([kind, str(cases), str(answers)]) == 0
    with cases.open() as known, answers.open() as answered:
        rows = list(zip(csv.DictReader(known), csv.DictReader(answered), strict=True))
    for model in (name for name in rows[0][0] if name in REFERENCE_MODELS):
        same = sum(expected[model] == found[model] for expected, found in rows)
        assert same / len(rows) >= 0.996, f"{model} agrees in {same} of {len(rows)} cases"


@pytest.mark.parametrize("ego_kmh", [20, 60, 120])
@pytest.mark.parametrize("slower_kmh", [10, 15])
def test_regulation_driver_avoids_what_the_formula_of_5_2_5_2_allows(ego_kmh, slower_kmh):
    # Full lateral speed is reached 1.6 m beside the vehicle. The other vehicle is in the lane after another 1.1 m, or
    # five steps with 2.2 m/s.
    closing, lateral = slower_kmh / 3.6, 2.2
    limit_s = closing / (2 * 6.0) + 0.35
    gap = closing * (limit_s + 0.5)
    step_m = closing * 0.1  # the reaction ends in a step, and speeds are those of whole steps
    case = {"ego_kmh": ego_kmh, "other_kmh": ego_kmh - slower_kmh, "lateral_mps": lateral}
    assert cut_in("reg157", gap_m=gap + 1.5 * step_m, **case) == 0
    assert cut_in("reg157", gap_m=gap - 1.5 * step_m, **case) == 2


def test_no_model_reacts_to_a_vehicle_that_stays_in_its_lane():
    cases = {
        name: np.full(20, value) for name, value in (("ego_kmh", 100.0), ("other_kmh", 30.0), ("lateral_mps", 0.0))
    }
    for model in REFERENCE_MODELS:
        assert not solve("cut_in", {**cases, "gap_m": np.arange(1.0, 41.0, 2.0)}, model)[model].any()


def test_cut_in_without_a_reaction_agrees_with_plain_arithmetic():
    # A vehicle 60 km/h slower cuts in with 1.7 m/s: after ten steps the sides meet. At 100 times 1/6 m the fronts meet.
    shared = {"ego_kmh": 70, "other_kmh": 10, "lateral_mps": 1.7}
    closed = 60 / 3.6 * 1.0
    assert cut_in("reg157", gap_m=closed - 2 * LENGTH_M - 0.1, **shared) == 0  # already past
    assert cut_in("reg157", gap_m=closed - LENGTH_M - 0.1, **shared) == 1
    assert cut_in("reg157", gap_m=closed - LENGTH_M + 2.3, **shared) == 2
    assert WIDTH_M == 1.9


def test_careful_human_dismisses_a_cut_in_above_two_seconds_and_brakes_below():
    shared = {"ego_kmh": 130, "other_kmh": 10, "lateral_mps": 1.7}
    contact_s, closing = 1.0, 120 / 3.6
    assert cut_in("cc_human", gap_m=closing * (contact_s + 2.05), **shared) == 0
    assert cut_in("cc_human", gap_m=closing * (contact_s + 1.95), **shared) == 2


def test_careful_human_stops_behind_a_standing_vehicle_exactly_as_far_as_its_braking_takes():
    # After 0.75 s (eight steps) with 0.4 m/s² and a ramp of 0.6 s to 0.774 g follows 0.774 g: the integral.
    speed, brake, jerk = 80 / 3.6, 0.774 * 9.81, 12.65
    later = speed - 0.4 * 0.8
    slower = later - 0.4 * 0.6 - jerk * 0.6**2 / 2
    way = (speed + later) / 2 * 0.8 + later * 0.6 - 0.4 * 0.6**2 / 2 - jerk * 0.6**3 / 6 + slower**2 / (2 * brake)
    seen = 0.1 * speed  # the vehicle ahead is 0.95 m aside after one step
    front = way + seen - 2 * speed - LENGTH_M
    for extra, answer in ((0.0, 0), (-3.0, 1)):  # a step of 0.1 s is 2.2 m
        found = solve("cut_out", columns(ego_kmh=80, front_m=front + extra, lateral_mps=-9.5), "cc_human")
        assert (found["front_cc_human"][0], found["cc_human"][0]) == (0, answer)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "the file is empty"),
        ("ego_kmh,decel_g\n", "no cases"),
        ("ego_kmh\n1\n", "the column decel_g is missing"),
        ("ego_kmh,decel_g,ego_kmh\n1,1,1\n", "occurs twice"),
        ("ego_kmh,decel_g\n1,nan\n", "decel_g in line 2 is 'nan' (allowed: 0 to 2)"),
        ("ego_kmh,decel_g\n1,0.1\nfast,0.1\n", "ego_kmh in line 3 is 'fast' (allowed: 0 to 300)"),
        ("ego_kmh,decel_g\n1,1e99\n", "'1e99' (allowed: 0 to 2)"),
        ("ego_kmh,decel_g\n1\n", "line 2 has 1 cells (allowed: 2"),
        ('ego_kmh,decel_g\n"1,1\n', "is not CSV"),
    ],
)
def test_invalid_cases_are_refused_in_one_line(content, words, tmp_path, capsys):
    (tmp_path / "cases.csv").write_text(content)
    assert r157.main(["car_following", str(tmp_path / "cases.csv"), str(tmp_path / "out.csv")]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["cases.csv"]


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (["cut_up", "a", "b"], "did you mean 'cut_out'?"),
        (["cut_in", "a.csv"], "OUT.csv"),
        (["cut_in", "a.csv", "b.csv"], "No such file"),
        (["cut_in", "a.csv", "b.csv", "--simulator", "fast"], "the simulator 'fast' is unknown"),
    ],
)
def test_invalid_command_lines_are_refused_in_one_line(words, error, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert r157.main(words) == 2
    printed = capsys.readouterr().err
    assert error in printed
    assert printed.count("\n") == 1


def test_answers_follow_the_columns_of_the_cases(tmp_path):
    (tmp_path / "cases.csv").write_text("name,lateral_mps,gap_m,other_kmh,ego_kmh,fsm\n'a b',1.7,20,10,70,9\n")
    assert r157.main(["cut_in", str(tmp_path / "cases.csv"), str(tmp_path / "out.csv")]) == 0
    assert (tmp_path / "out.csv").read_text() == (
        "name,lateral_mps,gap_m,other_kmh,ego_kmh,cc_human,fsm,rss,reg157\n'a b',1.7,20,10,70,2,2,2,2\n"
    )


@pytest.mark.parametrize("kind", ["cut_in", "cut_out", "car_following"])
def test_vehicles_in_sumo_give_the_same_answers(kind, tmp_path):
    rng = np.random.default_rng(7)
    ranges = {name: (low + (high - low) * 0.02, high * 0.3) for name, (low, high) in r157._KINDS[kind].columns.items()}
    names = [*ranges]
    rows = [[f"{rng.uniform(*ranges[name]):.3f}" for name in names] for _ in range(40)]
    (tmp_path / "cases.csv").write_text("\n".join([",".join(names), *(",".join(row) for row in rows)]))
    for simulator in ("kinematic", "sumo"):
        words = [kind, str(tmp_path / "cases.csv"), str(tmp_path / f"{simulator}.csv"), "--simulator", simulator]
        assert r157.main(words) == 0
    found = (tmp_path / "sumo.csv").read_text().splitlines()
    expected = (tmp_path / "kinematic.csv").read_text().splitlines()
    assert found == expected
