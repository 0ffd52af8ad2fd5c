"""The gallery of crashes, `scripts/tools/gallery.py`, and what it has written."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "scripts" / "tools" / "gallery.py"
spec = importlib.util.spec_from_file_location("gallery_script", SCRIPT)
assert spec is not None
assert spec.loader is not None
gallery = importlib.util.module_from_spec(spec)
sys.modules[spec.name] = gallery  # where dataclasses look for the module
spec.loader.exec_module(gallery)

SHOWN = {
    "summary": "ego drove into b at step 9",
    "agent": "ego",
    "other": "b",
    "last_escape_step": 7,
    "fault": {"verdict": "ego", "findings": [{"rule": "rear end"}]},
}


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({}, "ego drove into b at step 9: the fault of ego (rear end), avoidable by full braking until step 7."),
        ({"last_escape_step": None}, "ego drove into b at step 9: the fault of ego (rear end)."),
        (
            {"fault": {"verdict": "the other", "findings": [{"rule": "right of way"}]}, "last_escape_step": None},
            "ego drove into b at step 9: the fault of b (right of way).",
        ),
        (
            {"fault": {"verdict": "nobody can tell", "findings": []}, "last_escape_step": 0},
            "ego drove into b at step 9: fault not decided, avoidable by full braking until step 0.",
        ),
    ],
)
def test_verdict_is_one_sentence_of_what_show_reports(change, sentence):
    assert gallery.describe({**SHOWN, **change}) == sentence


def test_page_has_every_scenario_with_its_film_and_its_command():
    exhibits = [gallery.Exhibit(**entry) for entry in json.loads((gallery.FILMS / "gallery.json").read_text())]
    assert [shown.scenario for shown in exhibits] == list(gallery.CRASHES)
    assert gallery.PAGE.read_text(encoding="utf-8") == gallery.page(exhibits)
    for shown in exhibits:
        trials, steps, _ = gallery.CRASHES[shown.scenario]
        assert f" {trials} {steps} --scenario {shown.scenario} --seed 1 --deterministic" in shown.command


def test_films_are_small_enough_for_every_clone():
    films = sorted(gallery.FILMS.glob("*.gif"))
    assert {film.stem for film in films} == set(gallery.CRASHES)
    assert sum(film.stat().st_size for film in films) <= gallery.MAX_BYTES


def test_unknown_exhibit_is_one_line():
    with pytest.raises(SystemExit, match="no exhibit 'nowhere'"):
        gallery.main(["nowhere"])
