"""Texts of exceptions of any class and size, created in bounded time and memory."""

from __future__ import annotations

import importlib
import linecache
import os
import stat
import sysconfig
import traceback
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.errors import PluginError
from crashhunt.base.layout import PACKAGE

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from types import TracebackType
    from typing import Final


__all__ = [
    "MAX_MESSAGE_CHARACTERS",
    "MAX_TRACEBACK_CHARACTERS",
    "blamed",
    "class_name",
    "format_error",
    "in_words",
    "is_users",
    "message_of",
    "place_of",
    "shown_path",
]


MAX_MESSAGE_CHARACTERS: Final = 10_000
MAX_TRACEBACK_CHARACTERS: Final = 100_000
_MAX_NAME_CHARACTERS: Final = 200
# Python itself formats what is within these limits: then the text is what every user of Python knows.
_MAX_EXCEPTIONS: Final = 50
_MAX_FRAMES: Final = 2_000
# What exceeds them is cut to these, from both ends.
_FRAMES_PER_END: Final = 50  # at each end of a traceback
_EXCEPTIONS_PER_END: Final = 8  # at each end of a chain of exceptions
_MAX_GROUP_MEMBERS: Final = 10  # of a group of exceptions
_MAX_ELEMENTS: Final = 100_000  # of a container that is the argument of an exception
_MAX_SOURCE_BYTES: Final = 10 << 20
_NO_MESSAGE: Final = "(its message cannot be had: {})"

_CAUSE_LINE = "\nThe above exception was the direct cause of the following exception:\n\n"
_CONTEXT_LINE = "\nDuring handling of the above exception, another exception occurred:\n\n"


def class_name(error: BaseException) -> str:
    """Return the name of an exception's class, in at most 200 characters."""
    # A metaclass may define its own ``__name__``, so ask the descriptor of ``type``.
    name: str = type.__dict__["__name__"].__get__(type(error))
    return name[:_MAX_NAME_CHARACTERS]


def message_of(error: BaseException, limit: int = MAX_MESSAGE_CHARACTERS) -> str:
    """Return the message of an exception; after ``limit`` characters, it is cut with a note on the remaining number.

    If an exception's ``__str__`` fails, the message says so.
    """
    text = _whole_message(error)
    return text if len(text) <= limit else f"{text[:limit]}… ({len(text) - limit} more characters are left out)"


def format_error(error: BaseException) -> str:
    """Return traceback and message of an exception and its causes, in Python's format.

    The text has at most `MAX_TRACEBACK_CHARACTERS` characters, and a line for each cut. Long tracebacks, messages,
    chains and groups of exceptions are cut before they are formatted, because Python needs 13 s for a million frames.
    The text is empty if formatting fails.
    """
    try:
        text = "".join(traceback.format_exception(error)) if _is_small(error) else "".join(_formatted_chain(error))
    except BaseException:  # raised by a class of a user's, or by something that an agent has patched
        try:
            text = f"{_qualified_name(error)}: {_whole_message(error)}\n"
        except BaseException:
            return ""
    return _without_middle(text, MAX_TRACEBACK_CHARACTERS)


def _whole_message(error: BaseException) -> str:
    try:
        large = _large_argument(error)
        # ``__str__`` may return a subclass of str with methods of its own; joining makes it a plain one.
        return large or "".join([str(error)])
    except BaseException as other:
        return _NO_MESSAGE.format(class_name(other))


def _large_argument(error: BaseException) -> str:
    """Return a short description that replaces a message which only shows a large container; else empty."""
    if type(error).__str__ not in (BaseException.__str__, KeyError.__str__):
        return ""
    for argument in error.args[:_MAX_GROUP_MEMBERS]:
        if type(argument) in (list, tuple, dict, set, frozenset, bytes, bytearray) and len(argument) > _MAX_ELEMENTS:
            return f"({type(argument).__name__} of {len(argument)} elements)"
    return ""


def _is_small(error: BaseException) -> bool:
    """Return whether Python can format an exception within milliseconds."""
    seen: set[int] = set()
    left: list[BaseException | None] = [error]
    frames = 0
    files: set[str] = set()
    while left:
        one = left.pop()
        if one is None or id(one) in seen:
            continue
        seen.add(id(one))
        if len(seen) > _MAX_EXCEPTIONS or _large_argument(one) or len(_whole_message(one)) > MAX_MESSAGE_CHARACTERS:
            return False
        if _size_of_notes(one) > MAX_MESSAGE_CHARACTERS or len(class_name(one)) >= _MAX_NAME_CHARACTERS:
            return False
        if isinstance(one, SyntaxError) and len(str(one.text or "")) > MAX_MESSAGE_CHARACTERS:
            return False
        for link in _links(one.__traceback__):
            frames += 1
            if frames > _MAX_FRAMES:
                return False
            files.add(link.tb_frame.f_code.co_filename)
        if isinstance(one, BaseExceptionGroup):
            if len(one.exceptions) > _MAX_EXCEPTIONS:
                return False
            left += one.exceptions
        left += (one.__cause__, one.__context__)
    _skip_large_sources(files)
    return True


def _size_of_notes(error: BaseException) -> int:
    notes = getattr(error, "__notes__", None)
    if notes is None:
        return 0
    if not isinstance(notes, list | tuple) or len(notes) > _MAX_EXCEPTIONS:
        return MAX_MESSAGE_CHARACTERS + 1
    return sum(len(note) if isinstance(note, str) else MAX_MESSAGE_CHARACTERS for note in notes)


def _links(first: TracebackType | None) -> Iterator[TracebackType]:
    while first is not None:
        yield first
        first = first.tb_next


def _skip_large_sources(files: Iterable[str]) -> None:
    """Return a context in which Python reads no source lines from endless files, such as ``/dev/zero``.

    Such file names can occur because a program may pass any name to `compile`.
    """
    for name in files:
        try:
            found = os.stat(name)  # noqa: PTH116 - a name may be no path
        except (OSError, ValueError):
            continue
        if not stat.S_ISREG(found.st_mode) or found.st_size > _MAX_SOURCE_BYTES:
            linecache.cache[name] = (0, None, [], name)


def _formatted_chain(error: BaseException) -> Iterator[str]:
    """Yield the texts of an exception and of the exceptions that caused it, the oldest first."""
    newest: list[tuple[BaseException, str]] = []
    oldest: deque[tuple[BaseException, str]] = deque(maxlen=_EXCEPTIONS_PER_END)
    seen, count = {id(error)}, 0
    next_one: BaseException | None = error
    joint = ""
    while next_one is not None:
        count += 1
        (newest if len(newest) < _EXCEPTIONS_PER_END else oldest).append((next_one, joint))
        cause, context = next_one.__cause__, next_one.__context__
        joint = _CAUSE_LINE if cause is not None else _CONTEXT_LINE
        next_one = cause if cause is not None else (None if next_one.__suppress_context__ else context)
        if next_one is not None and id(next_one) in seen:
            next_one = None
        seen.add(id(next_one))
    for one, after in reversed(oldest):
        yield from _formatted(one)
        yield after
    omitted = count - len(oldest) - len(newest)
    if omitted > 0:
        yield f"… ({omitted} exceptions in between are omitted) …\n\n"
    for one, after in reversed(newest):
        yield from _formatted(one)
        yield after


def _formatted(error: BaseException) -> Iterator[str]:
    """Yield the text of a single exception in parts of bounded length."""
    if error.__traceback__ is not None:
        yield "Traceback (most recent call last):\n"
        yield from _formatted_frames(error.__traceback__)
    yield f"{_qualified_name(error)}: {_without_middle(_whole_message(error), MAX_TRACEBACK_CHARACTERS // 2)}\n"
    notes = getattr(error, "__notes__", None)
    if isinstance(notes, list | tuple):
        for note in notes[:_MAX_GROUP_MEMBERS]:
            yield f"{_without_middle(note, MAX_MESSAGE_CHARACTERS)}\n" if isinstance(note, str) else ""
        if len(notes) > _MAX_GROUP_MEMBERS:
            yield f"… ({len(notes) - _MAX_GROUP_MEMBERS} more notes are omitted)\n"
    if isinstance(error, BaseExceptionGroup):
        members = error.exceptions
        for number, member in enumerate(members[:_MAX_GROUP_MEMBERS], 1):
            yield f"  {number} of {len(members)}: {_qualified_name(member)}: {message_of(member, 1000)}\n"
        if len(members) > _MAX_GROUP_MEMBERS:
            yield f"  … ({len(members) - _MAX_GROUP_MEMBERS} more exceptions are omitted)\n"


def _formatted_frames(first: TracebackType) -> Iterator[str]:
    head: list[TracebackType] = []
    tail: deque[TracebackType] = deque(maxlen=_FRAMES_PER_END)
    count = 0
    for link in _links(first):
        count += 1
        (head if len(head) < _FRAMES_PER_END else tail).append(link)
    _skip_large_sources({link.tb_frame.f_code.co_filename for link in (*head, *tail)})
    yield from traceback.format_tb(first, limit=_FRAMES_PER_END)
    omitted = count - len(head) - len(tail)
    if omitted > 0:
        yield f"  … ({omitted} frames are omitted) …\n"
    if tail:
        yield from traceback.format_tb(tail[0])


def _qualified_name(error: BaseException) -> str:
    module = type.__dict__["__module__"].__get__(type(error))
    name = class_name(error)
    return name if module in ("builtins", "__main__") or not isinstance(module, str) else f"{module[:200]}.{name}"


def _without_middle(text: str, limit: int) -> str:
    """Return the beginning and the end of a long text: a traceback begins with the place and ends with the error."""
    if len(text) <= limit:
        return text
    half = limit // 2
    return f"{text[:half]}\n… ({len(text) - 2 * half} characters are omitted) …\n{text[-half:]}"


# The place of an exception in user code: the file and line that the user can correct.

_MAX_LINE_CHARACTERS = 1_000
_CRASHHUNT_FOLDER = str(PACKAGE)
_IMPORT_SYSTEM_FILES = ("<", importlib.__file__)  # of importing itself
# Users look for their mistakes neither in the standard library nor in installed packages.
_LIBRARY_FOLDERS = tuple({sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")})


def in_words(error: BaseException) -> str:
    """Return type and message of an exception as one line of about 1,200 characters at most."""
    return " ".join(f"{class_name(error)}: {message_of(error, _MAX_LINE_CHARACTERS)}".split())


def is_users(filename: str) -> bool:
    """Return whether a source file belongs to the user, and not to crashhunt, an installed package or Python."""
    return not filename.startswith((_CRASHHUNT_FOLDER, *_LIBRARY_FOLDERS, *_IMPORT_SYSTEM_FILES))


def blamed(what: str, error: BaseException, *, fix: str = "correct the code") -> PluginError:
    """Return the error for a failure of user code: the failed action, the reason and the place.

    Args:
        what: the failed action, such as ``the sampler 'mine' cannot be made``.
        error: the exception that the user code raised.
        fix: the fix, as an instruction to the user.
    """
    return PluginError(f"{what}: {in_words(error)}", fix=fix, where=place_of(error))


def place_of(error: BaseException) -> str:
    """Return the origin of an exception as ``FILE, line N``; empty if no line of a file is known.

    The origin is the last traceback line in user code, or else the last line in an installed library.
    """
    if isinstance(error, SyntaxError) and error.filename:
        # Nothing of the file has run, so that it is in no traceback; and there may be no line, as with null bytes.
        return shown_path(error.filename) + (f", line {error.lineno}" if error.lineno else "")
    frames = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if not frame.filename.startswith(_IMPORT_SYSTEM_FILES)
    ]
    found = [frame for frame in frames if not frame.filename.startswith(_CRASHHUNT_FOLDER)]
    own = [frame for frame in found if not frame.filename.startswith(_LIBRARY_FOLDERS)]
    last = (own or found)[-1:]
    return f"{shown_path(last[0].filename)}, line {last[0].lineno}" if last else ""


def shown_path(name: str) -> str:
    """Return a path relative to the current directory, if that is shorter."""
    path = Path(name)
    try:
        return str(path.resolve().relative_to(Path.cwd()))
    except (ValueError, OSError):
        return str(path)
