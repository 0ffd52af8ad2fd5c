"""Text that others have written: agents, simulators, networks, the operating system, and who sent a crash.

A name may hold whatever its writer wanted, and a terminal obeys some of it: it moves the cursor, clears lines,
retitles its window, or shows letters in another order than they are in. Files keep what was said; what is printed
is made visible first.
"""

from __future__ import annotations

import re
import unicodedata
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

__all__ = ["encodable", "in_lines", "one_line", "visible"]

# Control and format characters, lone surrogates, and separators of lines that are no newline.
_UNSEEN = {"Cc", "Cf", "Cs", "Zl", "Zp"}
# Words of some languages, and emoji, are spelled with these two; they only join.
_JOINERS = "\u200c\u200d"
_ASCII = re.compile(r"[ -~\n\t]*")
_BREAKS = re.compile(r"[^\S\n]*(?:\r\n|[\n\r\v\f\x1c-\x1e\x85\u2028\u2029])\s*")


def encodable(text: str) -> str:
    """Return the text so that it can be written as UTF-8: half a pair of surrogates, as in names of files, is spelt."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def visible(text: str) -> str:
    """Return a text in which every character that a terminal would obey is written out, but for newline and tab."""
    if _ASCII.fullmatch(text):
        return text
    return "".join(map(_seen, text.replace("\r\n", "\n")))


def _seen(character: str) -> str:
    if character in "\n\t" or character in _JOINERS or unicodedata.category(character) not in _UNSEEN:
        return character
    return character.encode("unicode_escape").decode("ascii")


def one_line(text: str) -> str:
    """Return a text as one line that is visible."""
    return visible(_BREAKS.sub(" ", text.rstrip())).replace("\t", " ")


def in_lines(lines: Iterable[str]) -> str:
    """Return lines as one text; what somebody says in one of them makes no other."""
    return "\n".join(map(one_line, lines))
