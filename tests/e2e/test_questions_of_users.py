"""Five questions of a new user: the answer is at most two clicks from the first page, in at most 600 words."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import crashhunt
from crashhunt.guide import search_pages

IN_THE_GUIDE = {
    "crash does not reproduce": ("troubleshooting", "My crash does not reproduce"),
    "crash-free kilometres": ("start/how-often-does-it-crash", "How many crash-free kilometres do I need?"),
    "network has no pedestrians": ("troubleshooting", "My own network has no pedestrians"),
    "extra missing": ("troubleshooting", "An extra is missing"),
    "verdict on a change": ("howto/gate", "Give a verdict on a change"),
}
GUIDE = Path(crashhunt.__file__).parent / "guide"
MAX_WORDS = 600


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
