"""What is proposed for a name that is not known: "did you mean …", or what there is."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

__all__ = ["did_you_mean", "listed", "near_path", "one_of"]

_SHOWN = 20  # a hunt may have thousands of crashes, and the answer is one line


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return ``did you mean 'NAME'?`` for what was most likely meant; empty where nothing is near."""
    spelled = {_plain(other): str(other) for other in reversed(list(known))}  # of two that look alike, the first
    close = difflib.get_close_matches(_plain(name), spelled, 1)
    return f"did you mean {spelled[close[0]]!r}?" if close else ""


def near_path(path: Path, *endings: str) -> str:
    """Return ``did you mean 'PATH'? `` for a path that is not there: a folder beside it, or a file with an ending.

    Args:
        path: that is not there.
        endings: of the files that would do as well.
    """
    try:
        beside = sorted(path.parent.iterdir())
    except OSError:
        return ""
    wanted = [
        str(path.parent / found.name)
        for found in beside
        if not found.name.startswith(".") and (found.is_dir() or found.name.endswith(endings))
    ]
    hint = did_you_mean(str(path), wanted)
    return f"{hint} " if hint else ""


def listed(known: Iterable[str], *, none: str = "none") -> str:
    """Return names in one line; of very many, the first."""
    names = list(known)
    more = f", … ({len(names)} in all)" if len(names) > _SHOWN else ""
    return f"{', '.join(names[:_SHOWN])}{more}" or none


def one_of(name: str, known: Iterable[str], *, give: str = "give one of", none: str = "none") -> str:
    """Return the fix for an unknown name: what was most likely meant, and everything that there is.

    Args:
        name: the one that is not known.
        known: those that are.
        give: what to say before them.
        none: what to say instead where there are none.
    """
    names = list(known)
    return f"{did_you_mean(name, names)} {give} {listed(names, none=none)}".lstrip()


def _plain(name: str) -> str:
    """A name without what people mix up: upper and lower case, ``-`` and ``_``."""
    return name.lower().replace("_", "-")
