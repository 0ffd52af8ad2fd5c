"""The study of constants, `scripts/search_sensitivity.py`: each constant exists, and has its value again afterwards."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import pytest

from crashhunt.samplers import _guided, _model

SCRIPT = Path(__file__).parents[2] / "scripts" / "search_sensitivity.py"


@pytest.fixture(scope="module")
def study():
    spec = importlib.util.spec_from_file_location("search_sensitivity", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_constant_has_half_or_twice_its_value_during_a_hunt_alone(study):
    for name in (*study.CONSTANTS, *study.METHOD):
        usual = study._value(name)
        for value, factor in zip(study._values(name), (0.5, 2.0), strict=True):
            assert value == pytest.approx(factor * usual, abs=0.5)
            seen = study._cost(lambda *_, of=name: study._value(of), name, value, "easy", 1)
            assert seen == value
            assert study._value(name) == usual


def test_number_of_trials_in_memory_is_set_in_both_modules(study):
    seen = study._cost(lambda *_: (_guided.TRIALS, _model.TRIALS), "TRIALS", 48, "easy", 1)
    assert seen == (48, 48)


def test_table_divides_by_the_hunts_with_the_usual_value_and_names_the_worst_problem(study, tmp_path):
    usual = {"easy": {"1": 10, "2": 10}, "blind": {"1": 100, "2": 100}}
    half = {"easy": {"1": 20, "2": 20}, "blind": {"1": 50, "2": 50}}
    path = tmp_path / "sensitivity.json"
    path.write_text(json.dumps({"usual": usual, "_FAR=1": half, "_FAR=4": usual}), encoding="utf-8")
    row = study.sensitivity_table(path).splitlines()[-1]
    assert row == "| `_FAR` (2) | 1: 1.00 (1.00-1.00) | 4: 1.00 (1.00-1.00) | easy 2.00 (2.00-2.00) |"
