"""What `show` reports of frozen crashes, in process: the table, the facts in the sentences, and the JSON shape."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from crashhunt.analysis._interventions import step_before
from crashhunt.crashes import find_bundle, open_archive
from crashhunt.report._crash_text import Story, _steps_around, _thinned
from crashhunt.report._page import _crash

FROZEN = Path(__file__).parents[1] / "e2e" / "frozen" / "version-1"
TABLE = """\
                                                       braking
     time  ego target_  lane_ leader  gap closing  TTC  needed
step    s  m/s   speed change    m/s    m     m/s    s    m/s² criticality rear
  32  3.2 14.5    14.5      0    6.7 14.8    +7.8  1.9     2.0        0.39    -
  45  4.5 14.5    14.5      0    6.7  4.7    +7.8  0.6     6.3        0.76    -
  46  4.6 14.5    14.5      0    6.7  4.0    +7.8  0.5     7.6        0.76    - <- last avoidable step
  47  4.7 14.5    14.5      0    6.7  3.2    +7.8  0.4     9.4        0.76    -
  51  5.1 14.5    14.5      0    6.7  0.1    +7.8  0.0   334.0        0.99    -
  52  5.2 14.5    14.5      0    6.7  0.0    +7.8  0.0       -           -    -"""


@pytest.fixture(scope="module")
def rear_end():
    """ego drove into the back of a slower leader."""
    return find_bundle(FROZEN / "hunt", "")


@pytest.fixture
def exported():
    """Open an exported crash; it is closed after the test."""
    opened = []

    def story(archive):
        opened.append(open_archive(archive))
        return Story(find_bundle(opened[-1].__enter__().directory, ""))

    yield story
    for archive in opened:
        archive.__exit__(None, None, None)


def numbers(text):
    return re.findall(r"\d+(?:\.\d+)?", text)


def test_table_has_the_last_steps_in_aligned_columns(rear_end):
    rows = Story(rear_end).table()
    assert len(rows) == 22  # a head of three lines, and of 51 steps the last ones and some earlier ones
    assert [row for row in rows if row in TABLE.split("\n")] == TABLE.split("\n")
    assert [row.split()[0] for row in rows[3:12]] == ["2", "7", "12", "17", "22", "27", "32", "37", "42"]
    assert "19 of 51 steps shown" in Story(rear_end).describe()
    assert [row.split()[0] for row in Story(rear_end, last_s=0.35).table()[3:]] == ["49", "50", "51", "52"]


def test_sentences_have_the_distances_speeds_and_times_of_the_crash(rear_end):
    words = Story(rear_end).words()
    found = {sentence.partition(",")[0]: numbers(sentence) for sentence in words}
    assert found["ego drove into leader at step 52"] == ["52", "5.2"]
    assert found["5.0 s before"] == ["5.0", "29.9", "0.6", "7.3", "6.7"]
    assert found["When they touched"] == ["14.5", "6.7"]
    assert "1.0 s before, leader was ahead of ego, going the same way." in words
    assert numbers(words[4])[:3] == ["8", "0.6", "46"]
    assert words[5].startswith("At fault: ego, by the rule 'rear end': ")


def test_reason_for_an_unknown_last_step_is_a_sentence(rear_end):
    result = replace(rear_end.result, escape=None, why_no_escape="the search was killed")
    said = "The last step at which braking would have helped is unknown: the search was killed."
    assert said in Story(replace(rear_end, result=result)).words()


def test_player_of_the_report_has_the_clock_of_the_recording(rear_end):
    story = Story(rear_end)
    data = _crash(rear_end, story)
    times = [scene.time_s for scene in story.recording.scenes()]
    assert data["steps"] == len(times)
    assert [data["time0"] + step * data["dt"] for step in range(len(times))] == pytest.approx(times, abs=1e-9)


def test_times_of_short_steps_have_two_decimals(rear_end):
    story = Story(rear_end)
    prologue = replace(story.recording.prologue, step_length_s=0.05)
    story.recording.__dict__["prologue"] = prologue
    last = story.recording.steps
    assert story.recording.ago(last - 1) == f"{story.recording.before_end_s(last - 1):.2f} s before"
    assert re.search(r" \d+\.\d\d s after the episode began", story.describe())
    assert re.search(rf"^ *{last} +\d+\.\d\d ", story.describe(), re.MULTILINE)


@pytest.mark.parametrize("seconds", [0.1, 0.25, 0.3, 0.35, 1.0])
def test_time_before_a_crash_is_at_least_as_long_as_asked(rear_end, seconds):
    recording, step = rear_end.recording(), step_before(rear_end, seconds)
    assert recording.before_end_s(step + 1) < seconds - 1e-6
    assert recording.before_end_s(step) >= seconds - 1e-6


@pytest.mark.parametrize("braking", [None, 4.0])
def test_all_texts_have_the_clock_of_the_recording(rear_end, braking):
    """The actors touch within a step, and each text refers to the end of that step, as the table of steps does."""
    story = Story(rear_end, braking=braking)
    times = {record.step: record.scene.time_s for record in story.recording.all_steps}
    last = max(times)
    assert story.bundle.result.collision.time_s < times[last] - 0.01
    text = story.describe()
    (lasted,) = re.findall(r", ([\d.]+) s after the episode began", text)
    assert lasted == f"{times[last] - times[0]:.1f}"
    ago = re.findall(r"([\d.]+) s before, (?:after|at) step (\d+)", text)
    assert ago
    assert ago == [(f"{times[last] - times[int(step)]:.1f}", step) for _, step in ago]
    rows = re.findall(r"^ *(\d+) +(\d+\.\d) ", text, re.MULTILINE)
    assert len(rows) > 10
    assert rows == [(step, f"{times[int(step)]:.1f}") for step, _ in rows]
    assert [story.recording.before_end_s(step) for step in (0, last)] == [times[last] - times[0], 0.0]
    gap = dict(re.findall(r"([\d.]+) s before, they were ([\d.]+) m apart", text))
    moments = {f"{times[last] - moment['time_s']:.1f}": moment for moment in story.to_json()["moments"]}
    assert gap == {ago_s: f"{moments[ago_s]['gap_to_other_m']:.1f}" for ago_s in gap}


def test_calculated_braking_is_reported_as_a_calculation(rear_end):
    ran, calculated = Story(rear_end).to_json(), Story(rear_end, braking=4.0).to_json()
    assert (ran["last_escape_step"], calculated["last_escape_step"]) == (46, 41)
    how = {"how": "at 8 m/s², all that it can do,", "too_late_step": 47}
    assert ran["braking"] == {"by": "running it", "changed": [], "why_not": ""} | how
    how = {"how": None, "too_late_step": None}
    assert calculated["braking"] == {"by": "calculation", "changed": [], "why_not": ""} | how
    assert (ran["full_braking"], calculated["full_braking"]) == pytest.approx((8.0, 4.0))
    (sentence,) = (words for words in Story(rear_end, braking=4.0).words() if "calculation" in words)
    assert numbers(sentence) == ["4", "1.1", "41"]
    (harder,) = (words for words in Story(rear_end, braking=20.0).words() if "calculation" in words)
    assert "with at most 8.0" in harder  # the run could not brake so hard


def test_moments_of_the_json_are_those_of_the_table(rear_end):
    facts = Story(rear_end).to_json()
    moments = {moment["step"]: moment for moment in facts["moments"]}
    assert list(moments) == list(range(2, 53))
    assert (moments[46]["gap_to_other_m"], moments[46]["speed"]) == pytest.approx((3.96, 14.45), abs=0.05)
    assert moments[46]["action"] == pytest.approx([14.45, 0.0], abs=0.005)
    assert moments[2]["time_to_other_s"] == pytest.approx(49.9, abs=0.1)
    assert (facts["agent"], facts["other"], facts["fault"]["verdict"]) == ("ego", "leader", "ego")


def test_failure_shows_the_last_observation_and_the_innermost_frames(exported):
    words = exported(FROZEN / "fault.zip").words()
    (seen,) = (words for words in words if words.startswith("Its last observation"))
    assert numbers(seen)[:2] == ["9", "1"]
    assert "x 6.44, y 0, vx 9.1" in seen
    assert len(words[words.index("") + 1 :]) == 6  # the innermost frames
    assert words[-1].endswith("SimulatorError: the toy was told to fail")


def test_run_that_braking_does_not_save_is_reported(exported):
    story = exported(FROZEN / "highway.zip")
    (sentence,) = (words for words in story.words() if words.startswith("Braking"))
    assert numbers(sentence) == ["10.0", "11"]
    assert (story.escape, story.to_json()["braking"]["too_late_step"]) == (None, 11)
    assert "<-" not in "".join(story.table())


def test_lane_change_of_the_agent_and_the_touch_are_reported(exported):
    story = exported(FROZEN.parents[1] / "bundles" / "version-1.zip")
    assert "ego decided to change lanes to the left at step 40." in story.words()
    assert story.table()[-1].split()[:5] == ["40", "24.1", "13.9", "13.9", "1"]
    assert story._speeds_at_contact() == pytest.approx((13.9, 18.2), abs=0.1)


class Step:
    def __init__(self, step):
        self.step = step


def test_selection_of_steps_keeps_the_last_and_the_marked_ones():
    steps = [Step(number) for number in range(100)]
    shown = [step.step for step in _thinned(steps, 20, always=13)]
    assert shown[-10:] == [*range(90, 100)]
    assert shown[:-10] == [8, 13, 17, 26, 35, 44, 53, 62, 71, 80, 89]
    assert _thinned(steps[:20], 20, always=None) == steps[:20]
    around = [step.step for step in _steps_around(steps, 20, 52)]
    assert (52 in around, len(around), around[1] - around[0]) == (True, 20, 5)
