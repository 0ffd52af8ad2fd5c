"""Where in somebody's code a software fault was: the calls of a traceback, or of a stack that was written down."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import PurePath
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from crashhunt.trial import Failure

__all__ = ["Frame", "own_frames"]

_CALLERS = (
    ("crashhunt", "episode", "_ahead.py"),
    ("crashhunt", "episode", "_episode.py"),
    ("crashhunt", "episode.py"),
)  # of agents, simulators and oracles; the last one in earlier versions
_FRAME = re.compile(r'^\s*File "(?P<file>[^"]+)", line (?P<line>\d+),? in (?P<function>\S+)', re.MULTILINE)
_LIBRARIES = re.compile(r"(site|dist)-packages|python3\.\d+")


@dataclass(frozen=True, slots=True)
class Frame:
    """A call.

    Args:
        file: in which it is.
        line: of it, from 1.
        function: in which it is.
    """

    file: PurePath
    line: int
    function: str


def own_frames(failure: Failure) -> list[Frame]:
    """Return the calls that are the agent's own, the innermost first; those of libraries where it has none there."""
    frames = _frames(failure.traceback) or _frames(failure.last_output)
    ours = [
        number
        for number, frame in enumerate(frames)
        if any(frame.file.parts[-len(one) :] == one for one in _CALLERS)
    ]  # fmt: skip
    inner = frames[: min(ours)] if ours else frames  # what the episode has called
    return [frame for frame in inner if not _is_of_a_library(frame.file)] or inner


def _frames(text: str) -> list[Frame]:
    """Each call, the innermost first."""
    found = [Frame(PurePath(match["file"]), int(match["line"]), match["function"]) for match in _FRAME.finditer(text)]
    # A stuck or dead process has written its stack that way already, an exception the other way.
    return found if "most recent call first" in text else found[::-1]


def _is_of_a_library(file: PurePath) -> bool:
    return any(_LIBRARIES.fullmatch(part) for part in file.parts)
