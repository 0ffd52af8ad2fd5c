"""The signature of a crash: the properties by which two crashes count as the same crash type."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.codec import Serializable
from crashhunt.crashes._contact_record import contact_record
from crashhunt.crashes._lanes import LaneMap
from crashhunt.trial import UNUSABLE_VALUE, Outcome

if TYPE_CHECKING:
    from crashhunt.crashes import Bundle
    from crashhunt.crashes._contact_record import ContactRecord
    from crashhunt.recording import Recording
    from crashhunt.trial import Collision, Failure, TrialResult


SIGNATURE_VERSION = 4
"""Version of these rules. Raise it with each change by which a crash gets another type: types that an earlier version
has noted in a ledger are then determined again."""

# The place of a software fault in the user's code: the calls of a traceback or of a recorded stack.

_CALLER_MODULES = (
    ("crashhunt", "episode", "_fast_path.py"),
    ("crashhunt", "episode", "_episode.py"),
    ("crashhunt", "episode", "_blame.py"),
)
_FRAME_LINE = re.compile(r'^\s*File "(?P<file>[^"]+)", line (?P<line>\d+),? in (?P<function>\S+)', re.MULTILINE)
_LIBRARY_PATH = re.compile(r"(site|dist)-packages|python3\.\d+")


@dataclass(frozen=True, slots=True)
class StackFrame:
    """A function call in a traceback.

    Args:
        file: path of the source file.
        line: line in the source file, counted from 1.
        function: name of the function.
    """

    file: PurePath
    line: int
    function: str


def own_frames(failure: Failure) -> list[StackFrame]:
    """Return the calls in the agent's own code, the innermost first; if there are none, the calls in libraries."""
    frames = _frames(failure.traceback) or _frames(failure.last_output)
    ours = [
        number
        for number, frame in enumerate(frames)
        if any(frame.file.parts[-len(one) :] == one for one in _CALLER_MODULES)
    ]  # fmt: skip
    inner = frames[: min(ours)] if ours else frames  # what the episode has called
    return [frame for frame in inner if not _is_of_a_library(frame.file)] or inner


def _frames(text: str) -> list[StackFrame]:
    """Return each call of a traceback, the innermost first."""
    found = [
        StackFrame(PurePath(match["file"]), int(match["line"]), match["function"])
        for match in _FRAME_LINE.finditer(text)
    ]
    # A stuck or dead process has written its stack that way already, an exception the other way.
    return found if "most recent call first" in text else found[::-1]


def _is_of_a_library(file: PurePath) -> bool:
    return any(_LIBRARY_PATH.fullmatch(part) for part in file.parts)


_BEFORE_S = 3.0  # a lane change that began longer ago is over
_LANE_CHANGE_WORDS = {
    "agent": "while the agent changes lanes",
    "other": "while the other changes lanes",
    "both": "while both change lanes",
}
_MAX_FRAMES = 3  # of a stack, the innermost ones
_NUMBERS = re.compile(r"0x[0-9a-fA-F]+|-?\d+(\.\d+)?")


@dataclass(frozen=True, slots=True, order=True)
class Signature(Serializable):
    """The properties that define a crash type. Speeds, ids and times are excluded because they differ between trials.

    Args:
        outcome: outcome of the trial.
        role: role of the agent: ``collider``, ``victim`` or ``alone``; empty if the crash is not a collision.
        manner: The manner of a collision: ``rear end``, ``side swipe``, ``crossing from the left`` (the side of the
            collision partner), ``crossing from the right``, ``head-on``, ``pedestrian`` or ``off road``. For a
            Gymnasium environment, the crash type that it reports, or its crash rule. For a traffic event, the type of
            the event, and the name of a violated requirement. For a software fault, the exception, signal or exit code.
        lane_change: which of the two actors were changing lanes: ``agent``, ``other``, ``both`` or empty.
        place: the text ``crossing`` where lanes of different directions overlap, ``road`` elsewhere; empty if the map
            is unknown, or if the place does not matter.
        where: for a software fault, the innermost functions of the agent's code; without any, the text of the message.
        disturbed: whether the agent was disturbed before the crash; a crash in undisturbed traffic is a different crash
            type.
    """

    outcome: str
    role: str = ""
    manner: str = ""
    lane_change: str = ""
    place: str = ""
    where: str = ""
    disturbed: bool = False

    def __str__(self) -> str:
        words = self.manner or self.outcome
        words += {"collider": ", the agent into the other", "victim": ", the other into the agent"}.get(self.role, "")
        words += f", {_LANE_CHANGE_WORDS[self.lane_change]}" if self.lane_change else ""
        words += ", where lanes cross" if self.place == "crossing" else ""
        words += f" in {self.where}" if self.where else ""
        return f"{words}, disturbed" if self.disturbed else words


def signature_of(bundle: Bundle, recording: Recording | None = None, record: ContactRecord | None = None) -> Signature:
    """Return the signature of a crash; no code of the bundle runs.

    Args:
        bundle: the crash to describe.
        recording: recording of the crash, if it has already been read.
        record: record of the contact, if it has already been made.

    Raises:
        BundleError: the log of the crash is missing or damaged.
    """
    result = bundle.result
    hit = result.collision
    if hit is None:
        found = signature_of_fault(result)
    elif not hit.other:
        from crashhunt.recording import read_lanes  # MCAP takes longer than a list of software faults

        lanes = LaneMap(read_lanes(bundle.path / layout.LOG), (hit.x, hit.y))
        # A collision with nothing is that of an environment without scenes, which says itself what happened.
        is_named = result.outcome is Outcome.COLLISION and hit.kind
        manner = _NUMBERS.sub("#", hit.kind) if is_named else "off road"
        found = Signature(str(result.outcome), hit.role, manner, place=_place(lanes, hit))
    else:
        contact = record or contact_record(bundle, recording)
        found = Signature(str(result.outcome), hit.role) if contact is None else _of_a_contact(result, hit, contact)
    return replace(found, disturbed=result.disturbed)


def _of_a_contact(result: TrialResult, hit: Collision, contact: ContactRecord) -> Signature:
    changers = contact.lane_changers(_BEFORE_S)
    lane_change = (
        "both" if len(changers) == 2 else "".join("agent" if one == hit.agent else "other" for one in changers)
    )
    return Signature(
        outcome=str(result.outcome),
        role=hit.role,
        manner=contact.manner,
        lane_change=lane_change,
        place=_place(contact.lanes, hit),
    )


def _place(lanes: LaneMap, hit: Collision) -> str:
    return ("crossing" if lanes.cross((hit.x, hit.y)) else "road") if lanes else ""


def signature_of_fault(result: TrialResult) -> Signature:
    """Return the signature of a crash that is not a collision, from its trial's result; disturbances do not count."""
    outcome, failure, event = str(result.outcome), result.failure, result.event
    if event is not None:
        return Signature(outcome, manner=event.label)
    if failure is None:
        return Signature(outcome)
    return Signature(outcome, manner=_failure_type(failure), where=_innermost_frames(failure))


def _failure_type(failure: Failure) -> str:
    """Return the type of a failure: the exception's type, or how the process died."""
    return f"{failure.kind} {failure.exit_code}" if failure.exit_code is not None else failure.kind


def _innermost_frames(failure: Failure) -> str:
    """Return the innermost functions of the agent; if there are none, the message without its numbers."""
    chosen = own_frames(failure)
    if chosen:
        return " < ".join(f"{frame.file.name}:{frame.function}" for frame in chosen[:_MAX_FRAMES])
    # Behind the type of an unusable value, its message has the value itself.
    message = failure.message.partition(": ")[0] if failure.kind == UNUSABLE_VALUE else failure.message
    return _NUMBERS.sub("#", message)
