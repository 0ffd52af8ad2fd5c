"""``crashhunt note``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import BundleError, UsageError
from crashhunt.base.text import count_of, listed
from crashhunt.cli._common import (
    DONE,
    CommandOptions,
    Commands,
    CrashId,
    add_json,
    hunt_of_bundle,
    integer,
    opened_hunt,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.crashes import Note

_MAX_KNOWN, _MAX_TEXT = 8, 40  # tags and texts, and characters of a text, in the answer to --find


def add_note_command(commands: Commands) -> None:
    """Add the command ``note`` to the parser."""
    note = commands.add_parser(
        "note",
        help="add notes and tags to hunts and crashes, and search them",
        description="Add a note or tags to a hunt, or with --crash to one of its crashes. Without TEXT, --tag and "
        "--remove, list the notes of the hunts in DIR. The hunt stores its notes in notes.jsonl. The commands status, "
        "crashes, show and report and the dashboard show them. Exported crashes contain their notes. You may add notes "
        "while the hunt runs.",
    )
    note.add_argument(
        "directory", metavar="DIR", type=Path,
        help="directory of a hunt or of one crash; to list notes, also that of a suite, or an exported file",
    )  # fmt: skip
    note.add_argument("text", metavar="TEXT", nargs="*", default=[], help="text of the note")
    note.add_argument(
        "--crash",
        metavar="ID",
        action=CrashId,
        default="",
        help="the id of a crash or near miss, or the number of its trial",
    )
    note.add_argument(
        "--tag", metavar="TAG", action="append", default=[], dest="tags",
        help="add this tag, such as known or to-fix; several with commas, or by giving the option several times",
    )  # fmt: skip
    note.add_argument("--remove", metavar="N", type=integer, action="append", default=[], help="remove note number N")
    note.add_argument(
        "--find", metavar="WORDS", default="",
        help="list only notes with all of these words in their text, tags, crash or user",
    )  # fmt: skip
    add_json(note)
    note.set_defaults(command=_note)


def _note(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.report import describe_note

    tags = [tag for given in options.tags for tag in given.split(",")]
    changes = bool(options.text or tags or options.remove)
    if changes and options.find:
        raise UsageError("--find cannot be combined with a change", fix="run the command once with each of them")
    if options.text and options.remove:
        raise UsageError("TEXT and --remove cannot be combined", fix="run the command once with each of them")
    if not changes:
        known = [(place, note) for place, notes in _listed(options) for note in notes]
        words = options.find.split()
        found = [(place, note) for place, note in known if note.matches(words)]
        for place, note in found:
            options.say(f"{place}: {describe_note(note)}")
        if not found:
            options.say(_nothing_found(options.find, [note for _, note in known]))
        options.print_json({"notes": [{"hunt": place, **note.to_json()} for place, note in found]})
        return DONE
    hunt, crash = _subject(options)
    changed = _removed(options, hunt, crash) if options.remove else [_added(options, hunt, crash, tags)]
    for note in changed:
        options.say(f"{'removed' if options.remove else 'noted'}: {describe_note(note)}")
    if options.json:
        key = "removed" if options.remove else "added"
        print(json.dumps({key: [{"hunt": str(hunt), **note.to_json()} for note in changed]}))
    return DONE


def _nothing_found(words: str, known: Sequence[Note]) -> str:
    """Return the answer to a list without notes: which tags and words there are to look for."""
    if not known:
        return "There are no notes."
    tags = sorted({tag for note in known for tag in note.tags})
    texts = [note.text for note in known if note.text]
    what = [f"tags: {listed(tags[:_MAX_KNOWN])}"] if tags else []
    what += [f"texts: {listed(repr(text[:_MAX_TEXT]) for text in texts[:_MAX_KNOWN])}"] if texts else []
    return f"no note of {count_of(len(known), 'note')} contains {words!r} ({'; '.join(what)})"


def _added(options: CommandOptions, hunt: Path, crash: str, tags: list[str]) -> Note:
    from crashhunt.crashes import add_note

    return add_note(hunt, crash, " ".join(options.text), tags)


def _removed(options: CommandOptions, hunt: Path, crash: str) -> list[Note]:
    """Remove the given notes; refuse all of them if one does not exist or is about another crash."""
    from crashhunt.crashes import read_notes, remove_note

    if options.tags:
        raise UsageError("--tag and --remove cannot be combined", fix="run the command once with each of them")
    about = {note.number: note.crash for note in read_notes(hunt)}
    for number in options.remove:
        if crash and about.get(number, crash) != crash:
            raise UsageError(f"note {number} is not about {crash}", fix="omit --crash")
    missing = [number for number in options.remove if number not in about]
    return [remove_note(hunt, number) for number in missing or dict.fromkeys(options.remove)]


def _subject(options: CommandOptions) -> tuple[Path, str]:
    """Return the directory of the hunt to change, and the name of the crash; empty for the whole hunt.

    Raises:
        BundleError: the crash does not exist.
        UsageError: the place cannot have notes.
    """
    from crashhunt.crashes import find_bundle, subject_of
    from crashhunt.results import find_hunts

    directory: Path = options.directory
    if directory.is_file():
        raise UsageError(
            f"{str(directory)!r} is an exported file, which cannot change",
            fix="add the note to the hunt, and export the crash again",
        )
    if options.crash or (directory / layout.CRASH).is_file():
        bundle = find_bundle(directory, options.crash)
        hunt = directory if options.crash else hunt_of_bundle(directory)
        return hunt, subject_of(bundle)
    hunts = find_hunts(directory)
    if hunts != [directory]:
        raise UsageError(f"{str(directory)!r} contains several hunts", fix=f"give one of them, such as {hunts[0]}")
    return directory, ""


def _listed(options: CommandOptions) -> list[tuple[str, tuple[Note, ...]]]:
    """Return the notes of each hunt in the directory, or of the crash that the user names."""
    from crashhunt.crashes import find_bundle, read_notes, subject_of
    from crashhunt.results import find_hunts

    directory: Path = options.directory
    if directory.is_file() or (directory / layout.CRASH).is_file():
        with opened_hunt(directory) as (hunt, _):
            crash = "" if directory.is_file() else directory.resolve().name
            notes = {str(directory): read_notes(hunt, crash or None)}
    else:
        hunts = find_hunts(directory)
        crash = ""
        if options.crash:
            if len(hunts) != 1:
                raise BundleError("--crash needs the directory of one hunt", fix=f"give one, such as {hunts[0]}")
            crash = subject_of(find_bundle(hunts[0], options.crash))
        notes = {str(hunt): read_notes(hunt, crash or None) for hunt in hunts}
    return list(notes.items())
