"""What is told of a crash, of every kind, without running code of the bundle."""

from __future__ import annotations

import json
import re

import pytest


def hunted(shell):
    shell.crashhunt("run", "h", "2", "50", "800", "--arg", "speed=20:25", "--seed", "1", "--deterministic")


@pytest.fixture
def crash(shell, made_once):
    return made_once(hunted, shell)


@pytest.mark.nightly  # by day, report/test_show_frozen.py and report/test_report_evidence.py
def test_a_collision_is_reported_in_words_and_a_table(crash):
    text = crash.crashhunt("show", "h").out
    facts = crash.crashhunt("show", "h", "--json").json
    assert facts["summary"] in text
    assert f"{facts['other']} was ahead of ego, going the same way" in text
    # What touched how fast is said once, and the same everywhere.
    crash_json = json.loads(next((crash.folder / "h" / "crashes").glob("*/crash.json")).read_text())
    hit = crash_json["collision"]
    speeds = f"{hit['collider_speed']:.1f} m/s", f"{hit['victim_speed']:.1f} m/s"
    assert f"ego drove {speeds[0]} and {facts['other']} {speeds[1]}" in text
    again = crash.crashhunt("run", "h", "2", "50", "800", "--arg", "speed=20:25", "--seed", "1", "--deterministic").out
    assert f"ego at {speeds[0]}, {facts['other']} at {speeds[1]}" in again
    (marked,) = (line for line in text.splitlines() if "<- the last step" in line)
    assert int(marked.split()[0]) == facts["last_escape_step"]
    runs = "a run from this step avoids it, and a run from one step later crashes."
    assert f"after step {facts['last_escape_step']}: {runs}" in text
    # The rows of the table are the moments.
    rows = [line.split() for line in text.splitlines() if re.match(r"\s*\d+  ", line)]
    by_step = {moment["step"]: moment for moment in facts["moments"]}
    for row in rows:
        moment = by_step[int(row[0])]
        assert float(row[2]) == pytest.approx(moment["speed"], abs=0.06)
        assert float(row[6]) == pytest.approx(moment["gap_to_other_m"], abs=0.06)
    softer = crash.crashhunt("show", "h", "--braking", "4", "--json").json
    assert softer["braking"]["by"] == "calculation"
    assert softer["last_escape_step"] is None or softer["last_escape_step"] < facts["last_escape_step"]
    harder = crash.crashhunt("show", "h", "--braking", "20").out
    assert "Braking at 20 m/s² (in the run, it braked with at most 8.0) could have avoided it" in harder


@pytest.mark.nightly  # by day, cli/test_answers_on_crashes.py and base/test_names.py
def test_bad_numbers_are_refused(crash):
    for words in (("--braking", "1e-9"), ("--last-seconds", "-1"), ("--braking", "nan"), ("--crash", "999")):
        refused = crash.crashhunt("show", "h", *words, expect=2)
        assert len(refused.err.strip().splitlines()) == 1


@pytest.mark.nightly  # by day, report/test_show_frozen.py
@pytest.mark.parametrize(
    ("agent", "says"),
    [("faulty:Raises", "ValueError: no plan"), ("faulty:Segfaults", "SIGSEGV"), ("faulty:Nan", "target_speed")],
)
def test_software_faults_are_reported_too(shell, agent, says):
    shell.crashhunt("run", "h", "1", "1", "100", "--agent", agent, "--set", "vehicles=10")
    text = shell.crashhunt("show", "h").out
    assert says in text
    assert "Its last observation, in step" in text


@pytest.mark.nightly  # by day, cli/test_answers.py
def test_a_terminal_that_does_not_know_every_letter_is_shown_the_others(crash):
    crash.environment["PYTHONIOENCODING"] = "ascii"
    text = crash.crashhunt("show", "h").out
    assert "Braking at 8 m/s\\xb2, the maximum of its vehicle type, could have avoided it" in text
