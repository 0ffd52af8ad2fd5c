"""What earlier versions of crashhunt knew, and what to do instead: files from before version 1, removed options.

The formats of crashhunt were numbered again when they became version 1, and every later version reads version 1. Files
from before are read only by `LAST_REVISION`, and `HOW_TO_READ` says so wherever such a file is refused.

`removed_fix` is consulted wherever an unknown option, key or argument is refused. A name is written once, as on the
command line; the keys of Python and TOML follow from it (``--recycle-after``, ``recycle_after``).
"""

from __future__ import annotations

import re
from itertools import pairwise
from typing import TYPE_CHECKING

from crashhunt.base.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

LAST_REVISION = "40b50271"
"""Git revision of crashhunt that reads every file from before format version 1."""
HOW_TO_READ = (
    f"read it with crashhunt of git revision {LAST_REVISION} (pip install "
    f"'git+https://github.com/crashhunt/crashhunt@{LAST_REVISION}'), or hunt again"
)
"""The fix of the error that refuses such a file."""
_RARE = "use --rare with --disturb and rates, such as --disturb brake=0.001: crashhunt no longer splits paths"
_REMOVED = {
    "--splitting": _RARE,
    "--rare splitting": _RARE,
    "--recycle-after": "omit it: every trial has its own process",
}
"""Instructions by option, or by an option with its value."""


def removed_fix(name: str) -> str:
    """Return the instruction for an option of an earlier version; empty if there was no such option."""
    return _REMOVED.get("--" + name.removeprefix("--").replace("_", "-"), "")


def removed_fix_in(text: str) -> str:
    """Return the instruction for the option of an earlier version that an error message names; empty if there is none.

    User code may pass such an option on, or require it as an argument.
    """
    return next((fix for word in re.findall(r"\w+", text) if (fix := removed_fix(word))), "")


def refuse_removed_words(words: Sequence[str]) -> None:
    """Refuse a command line that gives an option a value which only earlier versions knew.

    Raises:
        UsageError: the value was removed.
    """
    for pair in map(" ".join, pairwise(words)):
        if fix := _REMOVED.get(pair):
            raise UsageError(f"there is no {pair!r}", fix=fix)
