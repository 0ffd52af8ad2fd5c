"""Text from outside: from agents, simulators, networks, the operating system, and senders of crashes.

A name may contain control characters that move the cursor of a terminal, clear lines, retitle its window, or reorder
letters. Files keep the original text. Printed text is made visible first.
"""

from __future__ import annotations

import difflib
import math
import re
import shlex
import sys
import unicodedata
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Sequence
    from pathlib import Path


NOTICE_TOPIC = "\t"
"""Separates the topic of a notice of a worker from its text; of each topic, a hunt prints one notice."""
ABSENT_WORDS, PRESENT_WORDS = " names nothing that occurred: ", " names something that occurred"
"""Follow a condition in a notice of one trial, such as ``gym.crash.info = 'crash'``. What follows the first words
describes what occurred instead; a hunt prints the notice if the condition is absent from its trials."""

# Control and format characters, lone surrogates, and separators of lines that are no newline.
_INVISIBLE_CATEGORIES = {"Cc", "Cf", "Cs", "Zl", "Zp"}
# Words of some languages, and emoji, are spelled with these two; they only join.
_JOINERS = "\u200c\u200d"
_ASCII = re.compile(r"[ -~\n\t]*")
_FOUR_DIGITS = 999.5  # from here on, three significant digits would be no whole number
_MILLION = 999_999.5
_LINE_BREAKS = re.compile(r"[^\S\n]*(?:\r\n|[\n\r\v\f\x1c-\x1e\x85\u2028\u2029])\s*")


def encodable(text: str) -> str:
    """Return a text that can be written as UTF-8: lone surrogates, as in names of files, become escapes."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def visible(text: str) -> str:
    """Return a text in which escapes replace all control characters except newline and tab."""
    if _ASCII.fullmatch(text):
        return text
    return "".join(map(_visible_character, text.replace("\r\n", "\n")))


def _visible_character(character: str) -> str:
    if character in "\n\t" or character in _JOINERS or unicodedata.category(character) not in _INVISIBLE_CATEGORIES:
        return character
    return character.encode("unicode_escape").decode("ascii")


def one_line(text: str) -> str:
    """Return a text as one line without control characters."""
    return visible(_LINE_BREAKS.sub(" ", text.rstrip())).replace("\t", " ")


def format_time(seconds: float, step_length_s: float) -> str:
    """Return a time in s as text, with two decimals if steps are no multiples of 0.1 s.

    >>> format_time(3.25, 0.1), format_time(3.25, 0.05)
    ('3.2 s', '3.25 s')
    """
    tenths = 10 * step_length_s
    return f"{seconds:.{1 if abs(tenths - round(tenths)) < 1e-6 else 2}f} s"


def format_clock(seconds: float) -> str:
    """Return a simulation time in s as text, with two decimals if it is no multiple of 0.1 s.

    >>> format_clock(27.300000000000004), format_clock(19.45), format_clock(26)
    ('27.3 s', '19.45 s', '26.0 s')
    """
    return f"{seconds:.2f}".removesuffix("0") + " s"


def format_number(value: float, digits: int = 3) -> str:
    """Return a number for users with three significant digits; a whole number below 1,000,000 in full, with commas.

    All texts and pages use this function for rates, shares, arguments and evidence, as ``formatNumber`` in the browser.
    Measured times, distances and speeds have one decimal, so that the columns of tables agree with the texts.

    >>> [format_number(value) for value in (0.012345, 12.0, 15.4509, 12345.6, 0.9996, 0.0000123, math.inf)]
    ['0.0123', '12', '15.5', '12,346', '1', '1.23e-5', 'any number']
    """
    if not math.isfinite(value):
        return "any number" if value == math.inf else str(value)
    if abs(value) < _MILLION and (value == round(value) or abs(value) >= _FOUR_DIGITS):
        return f"{round(value):,}"
    text = f"{value:.{digits}g}"
    mantissa, _, power = text.partition("e")
    return f"{mantissa}e{int(power)}" if power else text


def format_percent(share: float) -> str:
    """Return a share from 0 to 1 as percent: ``12.3 %``."""
    return f"{format_number(100 * share)} %"


def count_of(number: int, noun: str) -> str:
    """Return a number with its noun.

    >>> count_of(1, "trial"), count_of(3, "trial"), count_of(1200, "crash")
    ('1 trial', '3 trials', '1,200 crashes')
    """
    plural = "es" if noun.endswith(("s", "sh")) else "s"
    return f"{number:,} {noun}{'' if number == 1 else plural}"


def aligned(rows: Sequence[Sequence[str]], *, left: Container[int] = (), width: int = 0) -> list[str]:
    """Return rows of a table as lines with columns that are two spaces apart.

    Args:
        rows: rows of the table, the heading first; cells beyond the columns of the heading are appended without
            alignment.
        left: indices of the columns that are aligned to the left; the other columns are aligned to the right.
        width: maximum number of characters in a line; if the columns need more, they are only one space apart. A width
            of 0 sets no limit.
    """
    count = len(rows[0])
    widths = [max(len(row[column]) for row in rows) for column in range(count)]
    gap = " " if 0 < width < sum(widths) + 2 * (count - 1) else "  "
    lines = []
    for row in rows:
        cells = [
            cell.ljust(wide) if column in left else cell.rjust(wide)
            for column, (cell, wide) in enumerate(zip(row, widths, strict=False))
        ]
        lines.append(one_line(gap.join([*cells, *row[count:]])))
    return lines


def command_line(*words: str | Path) -> str:
    """Return words as one line that a shell such as bash or zsh splits into the same words.

    Characters that a terminal would obey, and line breaks, are written as escapes in ``$'...'``.
    """
    return " ".join(_shell_word(str(word)) for word in words)


def _shell_word(word: str) -> str:
    if one_line(word) == word:
        return shlex.quote(word)
    return f"$'{''.join(map(_shell_character, word))}'"


def _shell_character(character: str) -> str:
    if character in "\\'":
        return f"\\{character}"
    if one_line(f"{character}.") == f"{character}.":  # the dot, because spaces at the end would be removed
        return character
    # Undecodable bytes of a file name are lone surrogates from U+DC80 on.
    errors = "surrogateescape" if "\udc80" <= character <= "\udcff" else "surrogatepass"
    return "".join(f"\\x{byte:02x}" for byte in character.encode("utf-8", errors))


def in_lines(lines: Iterable[str]) -> str:
    """Join lines into one text; line breaks inside a line become spaces."""
    return "\n".join(map(one_line, lines))


# What is proposed for a name that is not known: "did you mean …", or what there is.

_MAX_LISTED_NAMES = 20  # a hunt may have thousands of crashes, and the answer is one line


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return ``did you mean 'NAME'?`` for the most similar name; empty if no name is similar."""
    spelled = {_normalized(other): str(other) for other in reversed(list(known))}  # of two that look alike, the first
    close = difflib.get_close_matches(_normalized(name), spelled, 1)
    return f"did you mean {spelled[close[0]]!r}?" if close else ""


def near_path(path: Path, *endings: str, with_file: tuple[str, ...] = ()) -> str:
    """Return ``did you mean 'PATH'? `` for a missing path, with a similar name or an allowed ending.

    Args:
        path: the missing path.
        endings: the endings of files that are suggested in addition.
        with_file: names of files; a folder is suggested only if it, or a folder in it, contains one of these files.
            Empty: all folders are suggested.
    """
    try:
        siblings = sorted(path.parent.iterdir())
    except OSError:
        return ""
    wanted = [
        str(path.parent / found.name)
        for found in siblings
        if not found.name.startswith(".")
        and found != path
        and ((found.is_dir() and _has_file(found, with_file)) or found.name.endswith(endings))
    ]
    hint = did_you_mean(str(path), wanted)
    return f"{hint} " if hint else ""


def _has_file(folder: Path, names: tuple[str, ...]) -> bool:
    found = (path for name in names for path in (folder / name, *folder.glob(f"*/{name}")))
    return not names or any(path.exists() for path in found)


def listed(known: Iterable[str], *, none: str = "none") -> str:
    """Return names as one line; a long list is cut."""
    names = list(known)
    more = f", … ({len(names)} in all)" if len(names) > _MAX_LISTED_NAMES else ""
    return f"{', '.join(names[:_MAX_LISTED_NAMES])}{more}" or none


def one_of(name: str, known: Iterable[str], *, give: str = "give one of", none: str = "none") -> str:
    """Return the fix for an unknown name: the most similar name, and all names."""
    names = list(known)
    similar = did_you_mean(name, names)
    if len(names) == 1:  # the question and the list would say the same
        return f"give {names[0]}" if give == "give one of" else similar or f"{give} {names[0]}"
    return f"{similar} {give} {listed(names, none=none)}".lstrip()


def any_of(names: Iterable[str]) -> str:
    """Return names as a choice: ``a, b or c``."""
    *first, last = names
    return f"{', '.join(first)} or {last}" if first else last


def out_of(done: int, planned: int, separator: str = " of ") -> str:
    """Return how many of the planned trials have ended: ``3 of 8``.

    Args:
        done: number of trials that have ended.
        planned: number of planned trials; 0 for no limit. In a resumed hunt, it may be smaller than ``done``.
        separator: text between the two numbers.
    """
    return f"{done}{separator}{planned}" if planned and done <= planned else str(done)


_ESCAPED_LETTER = re.compile(r"\\(x[0-9a-f]{2}|u[0-9a-f]{4}|U[0-9a-f]{8})")


def unescape_letters(stack: str) -> str:
    r"""Return a stack with the letters that `faulthandler` escapes outside of ASCII, such as ``\xdf`` in a path."""

    def letter(found: re.Match[str]) -> str:
        number = int(found[1][1:], 16)
        is_letter = 0x80 <= number < 0xD800 or 0xE000 <= number <= sys.maxunicode  # JSON has no surrogates
        return chr(number) if is_letter else found[0]

    return _ESCAPED_LETTER.sub(letter, stack)


def _normalized(name: str) -> str:
    """Return a name in lower case, with ``_`` in place of ``-``, so that similar names can be compared."""
    return name.lower().replace("_", "-")
