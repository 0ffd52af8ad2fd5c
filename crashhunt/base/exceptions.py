"""Texts of exceptions, and the place in user code where an exception was raised."""

from __future__ import annotations

import importlib
import sys
import sysconfig
import traceback
from pathlib import Path
from typing import Final

from crashhunt.base.errors import PluginError
from crashhunt.base.layout import PACKAGE

MAX_MESSAGE_CHARACTERS: Final = 10_000
MAX_TRACEBACK_CHARACTERS: Final = 100_000
_MAX_NAME_CHARACTERS: Final = 200
_TRACEBACK_LINE: Final = "Traceback (most recent call last):\n"
_MAX_FRAMES: Final = 2_000  # the last frames show where the error is; Python takes 13 s to format a million


def class_name(error: BaseException) -> str:
    """Return the name of an exception's class, in at most 200 characters."""
    return type(error).__name__[:_MAX_NAME_CHARACTERS]


def message_of(error: BaseException, limit: int = MAX_MESSAGE_CHARACTERS) -> str:
    """Return the message of an exception; after ``limit`` characters, it is cut with a note on the remaining number.

    If an exception's ``__str__`` fails, the message says so.
    """
    try:
        text = str(error)
    except BaseException as other:
        text = f"(its message cannot be had: {class_name(other)})"
    return text if len(text) <= limit else f"{text[:limit]}… ({len(text) - limit} more characters are left out)"


def format_error(error: BaseException) -> str:
    """Return traceback and message of an exception and its causes, in Python's format.

    The text has about `MAX_TRACEBACK_CHARACTERS` characters at most, and a line for the cut. It is empty if formatting
    fails.
    """
    try:
        message = message_of(error, sys.maxsize)
        if len(message) > MAX_TRACEBACK_CHARACTERS:  # Python takes seconds to split a message of a million lines
            frames = traceback.format_tb(error.__traceback__, limit=-_MAX_FRAMES)
            text = "".join([_TRACEBACK_LINE, *frames, f"{class_name(error)}: {message}\n"])
        else:
            text = "".join(traceback.format_exception(error, limit=-_MAX_FRAMES))
    except BaseException:  # raised by a class of a user's, or by something that an agent has patched
        try:
            text = f"{class_name(error)}: {message_of(error)}\n"
        except BaseException:
            return ""
    if len(text) <= MAX_TRACEBACK_CHARACTERS:
        return text
    half = MAX_TRACEBACK_CHARACTERS // 2  # a traceback begins with the place and ends with the error
    return f"{text[:half]}\n… ({len(text) - 2 * half} characters are omitted) …\n{text[-half:]}"


# The place of an exception in user code: the file and line that the user can correct.

_MAX_LINE_CHARACTERS = 1_000
_CRASHHUNT_FOLDER = str(PACKAGE)
_IMPORT_SYSTEM_FILES = ("<", importlib.__file__)  # of importing itself
# Users look for their mistakes neither in the standard library nor in installed packages.
_LIBRARY_FOLDERS = tuple({sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")})
INSTALLED_FOLDERS = frozenset(("site-packages", "dist-packages"))
"""Names of folders with installed packages, also outside of Python's own folders; a version identifies a package."""


def in_words(error: BaseException) -> str:
    """Return type and message of an exception as one line of about 1,200 characters at most."""
    return " ".join(f"{class_name(error)}: {message_of(error, _MAX_LINE_CHARACTERS)}".split())


def is_users(filename: str) -> bool:
    """Return whether a source file belongs to the user, and not to crashhunt, an installed package or Python."""
    ours_or_pythons = (_CRASHHUNT_FOLDER, *_LIBRARY_FOLDERS, *_IMPORT_SYSTEM_FILES)
    return not filename.startswith(ours_or_pythons) and INSTALLED_FOLDERS.isdisjoint(Path(filename).parts)


def blamed(what: str, error: BaseException, *, fix: str = "correct the code") -> PluginError:
    """Return the error for a failure of user code: the failed action, the reason and the place.

    ``what`` is the failed action, such as ``the sampler 'mine' cannot be made``.
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
    own = [frame for frame in found if is_users(frame.filename)]
    last = (own or found)[-1:]
    return f"{shown_path(last[0].filename)}, line {last[0].lineno}" if last else ""


def shown_path(name: str) -> str:
    """Return a path relative to the current directory, if that is shorter."""
    path = Path(name)
    try:
        return str(path.resolve().relative_to(Path.cwd()))
    except (ValueError, OSError):
        return str(path)
