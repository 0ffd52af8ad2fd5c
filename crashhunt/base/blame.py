"""Where in somebody's code an exception comes from: the file and the line that they can mend."""

from __future__ import annotations

import importlib
import sysconfig
import traceback
from pathlib import Path

from crashhunt.base.errors import PluginError
from crashhunt.base.exception_text import class_name, message_of
from crashhunt.base.layout import PACKAGE

__all__ = ["blamed", "in_words", "is_users", "place_of", "shown_path"]

_MAX_LINE_CHARACTERS = 1_000
_OURS = str(PACKAGE)
_NOBODYS = ("<", importlib.__file__)  # of importing itself
# Neither the standard library nor what is installed is where somebody looks for their own mistake.
_OTHERS = tuple({sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")})


def in_words(error: BaseException) -> str:
    """Return type and message of an exception in one line of at most 1,200 characters or so."""
    return " ".join(f"{class_name(error)}: {message_of(error, _MAX_LINE_CHARACTERS)}".split())


def is_users(filename: str) -> bool:
    """Whether a source file belongs to a user: not to crashhunt, nor to what is installed, nor to Python itself."""
    return not filename.startswith((_OURS, *_OTHERS, *_NOBODYS))


def blamed(what: str, error: Exception, *, fix: str = "mend it") -> PluginError:
    """Return the error that says what somebody's own code cannot, why, and where.

    Args:
        what: as ``the sampler 'mine' cannot be made``.
        error: which it has raised.
        fix: what to do about it, as an imperative.
    """
    return PluginError(f"{what}: {in_words(error)}", fix=fix, where=place_of(error))


def place_of(error: BaseException) -> str:
    """Return ``FILE, line N``; empty where no line of a file is to blame.

    Of a traceback it is the last line of somebody's own code. Where there is only an installed library's, that.
    """
    if isinstance(error, SyntaxError) and error.filename:
        # Nothing of the file has run, so that it is in no traceback; and there may be no line, as with null bytes.
        return shown_path(error.filename) + (f", line {error.lineno}" if error.lineno else "")
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if not frame.filename.startswith(_NOBODYS)]
    found = [frame for frame in frames if not frame.filename.startswith(_OURS)]
    own = [frame for frame in found if not frame.filename.startswith(_OTHERS)]
    last = (own or found)[-1:]
    return f"{shown_path(last[0].filename)}, line {last[0].lineno}" if last else ""


def shown_path(name: str) -> str:
    """Return a path as short as it is from the current directory."""
    path = Path(name)
    try:
        return str(path.resolve().relative_to(Path.cwd()))
    except (ValueError, OSError):
        return str(path)
