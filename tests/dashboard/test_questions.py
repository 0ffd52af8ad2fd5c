"""Ten questions at a crash, and five questions of a new user: where the answer is.

An answer at a crash is on the page of the crash, or one click away. An answer in the guide is at most two clicks from
the first page, in at most 600 words.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from conftest import crashes_on_loop
from served import served

import crashhunt
from crashhunt.guide import search_pages

ON_THE_PAGE_OF_THE_CRASH = {
    "Why did it crash?": "#verdict",  # the sentence at the top; "What happened, and why" has the causes
    "Who is at fault?": "#badges",  # "at fault: …" with the rule, or "fault: not decided"
    "When was it too late?": "#avoidable",  # a button that jumps there, with the braking ghost after it
    "What did the agent see?": "#now",  # the values of the step; with --observe, the layer Observed (key o) as well
    "What did it plan?": "#plot",  # the rows "action: …"; a trajectory is drawn in the scene
    "How do I pass it on?": "#export",  # the crash as one file; notes name who has written them
    "Is it fixed?": "#commands",  # replay with your present code
}
ONE_CLICK_AWAY = {  # on the page of the hunt, behind the link at the top
    "Is it known?": "#kinds",  # crash types with their number and the first crash of each
    "Since when?": "#crashes",  # the crashes in the order of trials; `crashhunt bisect` finds the change
    "How often?": "#tiles",  # the crash rate with its interval
}
IN_THE_GUIDE = {
    "crash does not reproduce": ("troubleshooting", "My crash does not reproduce"),
    "crash-free kilometres": ("start/how-often-does-it-crash", "How many crash-free kilometres do I need?"),
    "network has no pedestrians": ("troubleshooting", "My own network has no pedestrians"),
    "extra missing": ("troubleshooting", "An extra is missing"),
    "verdict on a change": ("howto/gate", "Give a verdict on a change"),
}
GUIDE = Path(crashhunt.__file__).parent / "guide"
MAX_WORDS = 600


@pytest.mark.nightly  # by day, test_browser.py opens these pages
@pytest.mark.long
def test_ten_questions_at_a_crash_are_answered_on_its_page_or_one_click_away(shell, made_once, page):
    hunts = made_once(crashes_on_loop, shell).folder / "runs"
    assert len(ON_THE_PAGE_OF_THE_CRASH | ONE_CLICK_AWAY) == 10
    with served(hunts) as dashboard:
        row = dashboard.hunts()["one"]
        found = dashboard.get(f"/api/hunts/{row['id']}/crashes")["crashes"]
        crash = next(one for one in found if "collision" in one["id"])
        page.open(f"{dashboard.url}/hunts/{row['id']}/crashes/{crash['id']}")
        for question, place in ON_THE_PAGE_OF_THE_CRASH.items():
            assert page.run("return document.querySelector(arguments[0]).checkVisibility()", place), question
        assert "fault: " in page.text("#badges")
        assert "action: " in page.run("return crashhuntView.crash.rows.map((row) => row.title).join()")
        assert "--code current" in page.text("#commands")
        page.run("document.getElementById('hunt').click()")
        page.wait("document.querySelector('#kinds a') && document.querySelector('#crashes a')")
        for question, place in ONE_CLICK_AWAY.items():
            assert page.run("return document.querySelector(arguments[0]).checkVisibility()", place), question
        assert "crash rate" in page.text("#tiles")


@pytest.mark.parametrize(("words", "answer"), IN_THE_GUIDE.items())
def test_question_of_a_new_user_is_two_clicks_and_600_words_away(words, answer):
    topic, heading = answer
    assert re.search(rf"\({topic}\.md\)", (GUIDE / "index.md").read_text(encoding="utf-8"))  # the first click
    lines = (GUIDE / f"{topic}.md").read_text(encoding="utf-8").splitlines()
    begin = next(number for number, line in enumerate(lines) if line.startswith("#") and heading in line)
    level = lines[begin].count("#")
    ends = (n for n in range(begin + 1, len(lines)) if re.match(rf"#{{2,{max(level, 2)}}} ", lines[n]) and level > 1)
    section = "\n".join(lines[begin : next(ends, len(lines))])  # the second click: the heading in the page's contents
    assert len(re.sub(r"```.*?```", "", section, flags=re.DOTALL).split()) <= MAX_WORDS
    first = search_pages(words)[0]
    assert first.page.topic == topic.rpartition("/")[2]
