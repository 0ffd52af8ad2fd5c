"""Search of the guide: the section of each page that fits some words best."""

from __future__ import annotations

import re
from typing import NamedTuple

from crashhunt.guide._pages import Page, list_pages


class FoundPage(NamedTuple):
    """A page that contains the words of a search."""

    page: Page
    heading: str  # heading of the section that fits best; empty for the beginning of the page
    score: int  # how well the section fits


def search_pages(text: str) -> list[FoundPage]:
    """Return the pages with a section that contains all words of a text, the best first.

    Upper and lower case and the endings of plurals and verbs do not matter, and words such as "how" and "my" are
    ignored. Words in the title of a page count most, then words in the heading of a section. If no section contains all
    of three or more words, sections with all words but one are found.
    """
    given = re.findall(r"[\w-]+", text.casefold())
    words = [re.compile(rf"(?<![\w-]){re.escape(_stem(word))}") for word in given if word not in _IGNORED] or [
        re.compile(rf"(?<!\w){re.escape(word)}(?!\w)") for word in given
    ]
    for fewest in (len(words), *([len(words) - 1] if len(words) >= _MIN_WORDS_TO_MISS_ONE else [])):
        found = [one for page in list_pages() if words and (one := _best_section(page, words, fewest)) is not None]
        if found:
            return sorted(found, key=lambda one: -one.score)
    return []


_IGNORED = frozenset((
    "a", "an", "and", "are", "at", "be", "can", "do", "does", "for", "from", "get", "has", "have", "how", "i", "if",
    "in", "is", "it", "its", "many", "me", "much", "my", "no", "not", "of", "on", "or", "so", "that", "the", "this",
    "to", "too", "was", "what", "when", "where", "which", "who", "why", "will", "with", "you", "your",
))  # fmt: skip
_ENDINGS = ("ible", "able", "ing", "ed", "es", "s", "e")
_MIN_STEM = 4  # letters
_MIN_WORDS_TO_MISS_ONE = 3
_IN_TITLE, _IN_HEADING = 8, 6  # as many times as in the text of a section


def _stem(word: str) -> str:
    ending = next((one for one in _ENDINGS if word.endswith(one) and len(word) - len(one) >= _MIN_STEM), "")
    return word.removesuffix(ending)


def _best_section(page: Page, words: list[re.Pattern[str]], fewest: int) -> FoundPage | None:
    """Return the section of a page with so many of the words and most of them in headings; None without one."""
    title = f"{page.topic} {page.title}".casefold()
    parts = re.split(r"^#{2,3} +(.*)$", page.file.read_text(encoding="utf-8"), flags=re.MULTILINE)
    best: FoundPage | None = None
    for heading, text in zip(["", *parts[1::2]], parts[::2], strict=True):
        scores = [
            _IN_TITLE * bool(word.search(title)) + _IN_HEADING * bool(word.search(heading.casefold()))
            or bool(word.search(text.casefold()))
            for word in words
        ]
        if sum(map(bool, scores)) >= fewest and (best is None or sum(scores) > best.score):
            best = FoundPage(page, heading, sum(scores))
    return best
