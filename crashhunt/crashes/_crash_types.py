"""Groups of crashes of the same type, from one hunt or several hunts."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.codec import Serializable
from crashhunt.base.errors import BundleError
from crashhunt.base.text import count_of, unescape_letters
from crashhunt.crashes import Bundle, judgement_of, preventable_by
from crashhunt.crashes._contact_record import ContactRecord, contact_record
from crashhunt.crashes._fault import Verdict, fault_of
from crashhunt.crashes._lanes import LaneMap
from crashhunt.trial import UNUSABLE_VALUE, Outcome

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from crashhunt.recording import Recording
    from crashhunt.trial import Collision, Failure, TrialResult


# The signature of a crash: the properties by which two crashes count as the same crash type.


SIGNATURE_VERSION = 7
"""Version of these rules. Raise it with each change by which a crash gets another type: types that an earlier version
has noted in a ledger are then determined again."""

# The place of a software fault in the user's code: the calls of a traceback or of a recorded stack.

_CALLER_MODULES = (
    ("crashhunt", "episode", "_fast_path.py"),
    ("crashhunt", "episode", "_episode.py"),
    ("crashhunt", "episode", "_blame.py"),
)
_REFUSING_MODULES = ("_actions.py", "_any_space.py", "_free_motion.py")  # whose calls are equal for all wrong actions
_VALUE_OF_ACTION = re.compile(r"(?<=^the action ).* (?=is not )", re.DOTALL)
_FRAME_LINE = re.compile(r'^\s*File "(?P<file>[^"]+)", line (?P<line>\d+),? in (?P<function>\S+)', re.MULTILINE)
_FRAME = re.compile(r".+?:[\w<>]+( < |$)")
_LIBRARY_PATH = re.compile(r"(site|dist)-packages|python3\.\d+")


@dataclass(frozen=True, slots=True)
class StackFrame:
    """A function call in a traceback."""

    file: PurePath  # path of the source file
    line: int  # line in the source file, counted from 1
    function: str  # name of the function


def own_frames(failure: Failure) -> list[StackFrame]:
    """Return the calls in the agent's own code, the innermost first; if there are none, the calls in libraries."""
    frames = _frames(failure.traceback) or _frames(failure.last_output)
    ours = [number for number, frame in enumerate(frames) if frame.file.parts[-3:] in _CALLER_MODULES]
    called = frames[: min(ours)] if ours else frames  # what the episode has called
    inner = [
        frame
        for frame in called
        if frame.file.name not in _REFUSING_MODULES or frame.file.parts[-3:-2] != ("crashhunt",)
    ]
    return [frame for frame in inner if not _is_of_a_library(frame.file)] or inner


def _frames(text: str) -> list[StackFrame]:
    """Return each call of a traceback, the innermost first."""
    found = [
        StackFrame(PurePath(match["file"]), int(match["line"]), match["function"])
        for match in _FRAME_LINE.finditer(unescape_letters(text))  # earlier versions kept the escapes of faulthandler
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
        manner: The manner of a collision: ``rear end``, ``side swipe``, ``crossing from the left``, ``crossing from the
            right``, ``head-on``, ``standing vehicle``, ``obstacle``, ``pedestrian`` or ``off road``. A crossing names
            the side of the collision partner. With ``standing vehicle``, one of two vehicles that face each other had
            stood. For a Gymnasium environment, the crash type that it reports, or its crash rule. For a traffic event,
            the type of the event, and the name of a violated requirement. For a software fault, the exception, signal
            or exit code.
        lane_change: which of the two actors were changing lanes: ``agent``, ``other``, ``both`` or empty.
        place: the text ``crossing`` where lanes of different directions overlap, ``road`` elsewhere; empty if the map
            is unknown, or if the place does not matter.
        where: for a software fault, the innermost functions of the agent's code; without any, the text of the message
            without its numbers and its fix.
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
        words += f"{' in ' if _FRAME.match(self.where) else ': '}{self.where}" if self.where else ""
        return f"{words}, disturbed" if self.disturbed else words


def signature_of(bundle: Bundle, recording: Recording | None = None, record: ContactRecord | None = None) -> Signature:
    """Return the signature of a crash; no code of the bundle runs.

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
    # Behind the type of an unusable value, its message has the value itself; that of an action has it in its middle.
    message = failure.message.partition(": ")[0] if failure.kind == UNUSABLE_VALUE else failure.message
    return _NUMBERS.sub("#", _VALUE_OF_ACTION.sub("", message).partition("; ")[0])


@dataclass(frozen=True, slots=True)
class Group(Serializable):
    """Crashes with the same signature."""

    signature: Signature  # the common signature of all crashes
    bundles: tuple[Bundle, ...]  # bundles in the order in which they were given; at least one
    faults: tuple[Verdict, ...] = ()  # vehicle at fault in each of these crashes; empty if that was not requested
    dropped: int = 0  # number of further crashes whose bundles were deleted (``--keep``)

    json_keys = (
        "words", "signature", "count", "saved", "outcome=signature.outcome", "manner=signature.manner", "fault",
        "avoidable", "first=first.path", "shortest=shortest.path", "members", "preventable_by?",
    )  # fmt: skip

    @property
    def count(self) -> int:
        """The number of crashes."""
        return len(self.bundles) + self.dropped

    @property
    def fault(self) -> str:
        """The vehicle at fault in the crashes with a bundle: a `Verdict`, or ``mixed``; empty if not requested."""
        said = set(self.faults)
        return "mixed" if len(said) > 1 else next(iter(said), "")

    @property
    def avoidable(self) -> bool | None:
        """True if runs avoided all crashes, False if they avoided none; None if crashes differ or are not judged."""
        if self.dropped:
            return None
        said = {_avoidable(bundle) for bundle in self.bundles}
        return said.pop() if len(said) == 1 else None

    @property
    def first(self) -> Bundle:
        """The crash that was found first, by trial number; with several hunts, the first crash of the first hunt."""
        return self.bundles[0]

    @property
    def shortest(self) -> Bundle:
        """The crash with the fewest steps; if several crashes have as few, the first of them."""
        return min(self.bundles, key=lambda bundle: bundle.result.steps)

    @property
    def preventable_by(self) -> dict[str, bool | None] | None:
        """Whether each model of a competent driver would have prevented the shortest crash; None if not judged."""
        return preventable_by(self.shortest)

    @property
    def words(self) -> str:
        """The signature as text."""
        return str(self.signature)

    @property
    def members(self) -> list[Path]:
        """The paths of the bundles."""
        return [bundle.path for bundle in self.bundles]

    @property
    def saved(self) -> int:
        """The number of crashes with a bundle."""
        return len(self.bundles)


@dataclass(frozen=True, slots=True)
class Groups:
    """The result of grouping crashes."""

    groups: tuple[Group, ...]  # the groups, the largest first
    # the crashes without a crash type, each with the reason, such as a missing or damaged log
    left_out: tuple[str, ...] = ()


def group_crashes(
    bundles: Iterable[Bundle], dropped: Mapping[str, int] | None = None, *, faults: bool = True
) -> Groups:
    """Group crashes by their signatures, and return the groups.

    ``dropped`` has the number of crashes without a bundle, by the description of their crash type. With ``faults``, the
    vehicle at fault is determined for each crash.
    """
    signed, unsigned = [], []
    verdicts: dict[Path, Verdict] = {}
    for bundle in bundles:
        try:
            recording = bundle.recording() if bundle.result.collision is not None else None
            record = contact_record(bundle, recording)
            signature = signature_of(bundle, recording, record)
            if faults:
                verdicts[bundle.path] = fault_of(bundle, recording, record).verdict
            signed.append((signature, bundle))
        except BundleError as error:
            unsigned.append(str(error))
    groups = groups_of(signed, dropped)
    if faults:
        groups = tuple(
            replace(group, faults=tuple(verdicts[bundle.path] for bundle in group.bundles)) for group in groups
        )
    typed = {str(group.signature) for group in groups}
    unsigned += [
        f"{count_of(count, 'crash')} of the type {words!r}: no bundle of this type is left"
        for words, count in (dropped or {}).items()
        if words not in typed
    ]
    return Groups(groups, tuple(unsigned))


def _avoidable(bundle: Bundle) -> bool | None:
    """Return whether runs of `judge` or of the hunt avoided a crash; None if no such run shows this."""
    judgement, escape = judgement_of(bundle), bundle.result.escape
    if judgement is not None and judgement.avoidable is not None:
        return judgement.avoidable
    return True if escape is not None and escape.step is not None else None


def groups_of(
    signed: Iterable[tuple[Signature, Bundle]], dropped: Mapping[str, int] | None = None
) -> tuple[Group, ...]:
    """Return the groups of crashes whose signatures are known, the largest first.

    ``dropped`` is as for `group_crashes`.
    """
    found: dict[Signature, list[Bundle]] = {}
    for signature, bundle in signed:
        found.setdefault(signature, []).append(bundle)
    more = dropped or {}
    groups = [
        Group(signature, tuple(members), dropped=more.get(str(signature), 0)) for signature, members in found.items()
    ]
    return tuple(sorted(groups, key=lambda group: (-group.count, group.signature)))
