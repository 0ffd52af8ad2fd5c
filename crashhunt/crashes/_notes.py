"""Notes and tags that users add to hunts and crashes. One file of the hunt contains them, one JSON object per line.

A writer only appends, with a lock, so that two writers lose nothing and a running hunt does not matter. Removing a note
appends a line as well.
"""

from __future__ import annotations

import fcntl
import getpass
import json
import os
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.codec import Serializable
from crashhunt.base.errors import BundleError, UsageError
from crashhunt.base.files import cannot_write, sync_folder
from crashhunt.base.integrity import read_bounded, typed
from crashhunt.base.text import listed

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from crashhunt.crashes._bundle import Bundle

_MAX_CHARACTERS = 10_000  # of the text of a note
_MAX_TAG_CHARACTERS = 50
_MAX_TAGS = 20  # of one note


@dataclass(frozen=True, slots=True)
class Note(Serializable):
    """A remark of a user on a hunt or on one of its crashes."""

    number: int  # number of the note in the hunt, counted from 1. The number of a removed note is not used again.
    # identifier of the crash or near miss; empty if the note is about the whole hunt. The folder precedes the
    # identifier of a crash that a fork has found, such as ``probes/000012-collision``.
    crash: str
    at: str  # time at which the note was added, such as ``2026-11-28 18:05:00 UTC``
    by: str  # name of the user
    text: str  # text of the note; may be empty if the note has tags
    tags: tuple[str, ...] = ()  # tags of the note

    def matches(self, words: Iterable[str]) -> bool:
        """Return whether each of the words occurs in the text, the tags, the crash or the user; case is ignored."""
        text = "\n".join((self.text, *self.tags, self.crash, self.by)).casefold()
        return all(word.casefold() in text for word in words)


def subject_of(bundle: Bundle) -> str:
    """Return the name under which the notes on a crash or near miss are stored; see `Note`."""
    folder = bundle.path.absolute().parent.name
    return f"{folder}/{bundle.id}" if folder in (layout.PROBES, layout.BRANCHES) else bundle.id


def read_notes(hunt: Path, crash: str | None = None) -> tuple[Note, ...]:
    """Return the notes of a hunt in the order of their numbers; lines that cannot be read are skipped.

    ``crash`` selects the notes on one crash, see `subject_of`.
    """
    notes = _read_lines(hunt)[0]
    return tuple(note for note in notes.values() if crash in (None, note.crash))


def unreadable_notes(hunt: Path) -> list[int]:
    """Return the numbers of the lines of a hunt's notes that cannot be read; an interrupted write may leave one."""
    return _read_lines(hunt)[2]


def add_note(hunt: Path, crash: str, text: str, tags: Sequence[str] = ()) -> Note:
    """Add a note to a hunt or a crash.

    ``crash`` is as for `subject_of`, and empty for the hunt. The text may be empty if there are tags.

    Raises:
        UsageError: the text or a tag is empty or too long.
        HuntDirectoryError: the file of the notes cannot be written.
    """
    text, tags = text.strip(), list(dict.fromkeys(tag.strip() for tag in tags))
    if not text and not tags:
        raise UsageError("the note is empty", fix="give a text, or --tag TAG")
    if len(text) > _MAX_CHARACTERS:
        raise UsageError(
            f"the note has {len(text):,} characters (allowed: {_MAX_CHARACTERS:,})",
            fix="shorten it, or write it into a file and name the file in the note",
        )
    for tag in tags:
        if (
            not tag
            or len(tag) > _MAX_TAG_CHARACTERS
            or any(character.isspace() or character == "," for character in tag)
        ):
            raise UsageError(
                f"--tag is {tag[:_MAX_TAG_CHARACTERS]!r} (allowed: 1 to {_MAX_TAG_CHARACTERS} characters without "
                "spaces and commas)",
                fix="write the remark as the text of the note",
            )
    if len(tags) > _MAX_TAGS:
        raise UsageError(f"the note has {len(tags)} tags (allowed: {_MAX_TAGS})", fix="give fewer tags")
    at = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime())
    note = Note(number=0, crash=crash, at=at, by=user_name(), text=text, tags=tuple(tags))
    return _append(hunt, note)


def remove_note(hunt: Path, number: int) -> Note:
    """Remove a note of a hunt, and return it.

    Raises:
        BundleError: the hunt has no such note.
        HuntDirectoryError: the file of the notes cannot be written.
    """
    notes = _read_lines(hunt)[0]
    if number not in notes:
        raise BundleError(
            f"there is no note {number}",
            fix=f"give one of {listed(map(str, notes))}" if notes else "the hunt has no notes",
            where=str(hunt),
        )
    _append(hunt, notes[number], removes=True)
    return notes[number]


def user_name() -> str:
    """Return the name of the user of this process; the number of the user if it has no name, as in containers."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return str(os.getuid())


def notes_as_text(notes: Iterable[Note]) -> str:
    """Return the contents of a file with these notes."""
    return "".join(f"{json.dumps(note.to_json())}\n" for note in notes)


def _append(hunt: Path, note: Note, *, removes: bool = False) -> Note:
    path = hunt / layout.NOTES
    try:
        # Reason for O_NOFOLLOW: in a hunt from elsewhere, the name may link to a file of the user.
        flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
        with os.fdopen(os.open(path, flags, 0o666), "r+b", buffering=0) as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            _, last, _ = _read_lines(hunt)
            note = note if removes else replace(note, number=last + 1)
            data: dict[str, object] = {"removed": note.number} if removes else note.to_json()
            size = file.seek(0, os.SEEK_END)
            torn = size > 0 and os.pread(file.fileno(), 1, size - 1) != b"\n"  # an earlier writer was killed
            file.write(("\n" if torn else "").encode() + json.dumps(data).encode() + b"\n")
            os.fsync(file.fileno())
    except OSError as error:
        raise cannot_write(path, error) from error
    sync_folder(hunt)
    return note


def _read_lines(hunt: Path) -> tuple[dict[int, Note], int, list[int]]:
    """Return the notes by number, the greatest number that was ever used, and the lines that cannot be read."""
    path = hunt / layout.NOTES
    notes: dict[int, Note] = {}
    last, damaged = 0, []
    try:
        lines = read_bounded(path).split(b"\n") if path.is_file() and not path.is_symlink() else []
    except (OSError, ValueError):
        lines, damaged = [], [0]
    for place, line in enumerate(lines, 1):
        try:
            data = json.loads(line) if line.strip() else {"removed": 0}
            if "removed" in data:
                typed(data, {"removed": int})
                notes.pop(data["removed"], None)
                continue
            typed(data, {"number": int, "crash": str, "at": str, "by": str, "text": str, "tags": list[str]})
            note = Note.from_json(data)
        except (ValueError, TypeError, RecursionError):
            damaged.append(place)
            continue
        if note.number > last:  # the number of an edited line may occur twice
            notes[note.number] = note
            last = note.number
    return notes, last, damaged
