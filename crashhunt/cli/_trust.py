"""``crashhunt trust``."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import BundleError, HuntDirectoryError, UsageError
from crashhunt.base.text import command_line, near_path
from crashhunt.cli._common import add_json, say

if TYPE_CHECKING:
    import argparse

    from crashhunt.cli._common import Commands
    from crashhunt.crashes import TrustedOrigin


def add_trust_command(commands: Commands) -> None:
    """Add the command ``trust`` to the parser."""
    trust = commands.add_parser(
        "trust",
        help="trust the code of hunts and crashes that you did not make on this machine",
        description="Trust the code of hunts, crashes and corpora that you did not make on this machine, such as "
        "folders from your other machine or hunts of an earlier version of crashhunt. Commands then run this code "
        "without asking. Prints what the trusted code would run: the agent, the version of crashhunt, and the "
        "snapshot. If the code changes, it is no longer trusted. If DIR is the root of a git work tree, trusts the "
        "crashes that git tracks there, now and later. Runs no code. Without DIR, lists everything that you trust.",
    )
    trust.add_argument(
        "places", metavar="DIR", type=Path, nargs="*",
        help="directory of a hunt, suite, crash, corpus or git work tree, or a file that crashhunt export wrote",
    )  # fmt: skip
    trust.add_argument(
        "--remove", metavar="ORIGIN", action="append", default=[],
        help="stop trusting the code with this fingerprint, or the code in this directory; the option may be given "
        "several times",
    )  # fmt: skip
    add_json(trust)
    trust.set_defaults(command=_trust)


def _trust(options: argparse.Namespace, _words: list[str]) -> int:
    from crashhunt.crashes import list_trusted, remove_trusted

    if options.places and options.remove:
        raise UsageError("DIR and --remove cannot be combined", fix="run the command once with each of them")
    if options.remove:
        removed = remove_trusted(options.remove)
        for origin in removed:
            say(f"no longer trusted: {_line(origin)}", as_json=options.json)
        if options.json:
            print(json.dumps({"removed": [origin.to_json() for origin in removed]}))
        return 0
    if options.places:
        found = {origin.fingerprint: origin for place in options.places for origin in _trust_place(place)}
        for origin in found.values():
            say(f"trusted: {_line(origin)}", as_json=options.json)
    else:
        found = {origin.fingerprint: origin for origin in list_trusted()}
        for origin in found.values():
            say(_line(origin), as_json=options.json)
        if not found:
            say("You trust no code besides what you made on this machine.", as_json=options.json)
    if options.json:
        print(json.dumps({"trusted": [origin.to_json() for origin in found.values()]}))
    return 0


def _trust_place(place: Path) -> list[TrustedOrigin]:
    """Trust all code at a place that the user has named.

    Raises:
        BundleError: the place has no code to run, or is damaged.
    """
    from crashhunt.base.git import work_tree
    from crashhunt.corpus import find_cases
    from crashhunt.crashes import open_archive, trust_repository
    from crashhunt.results import find_hunts
    from crashhunt.suites import trust_hunt

    if place.is_file():
        with open_archive(place) as archive:
            return trust_hunt(archive.directory, place)
    if not place.is_dir():
        raise BundleError(f"{str(place)!r} does not exist", fix=f"{near_path(place, '.zip')}give a folder or a file")
    if not any((place / name).exists() for name in (layout.CRASH, layout.HUNT)) and place.resolve() == work_tree(place):
        return [trust_repository(place.resolve())]
    hunts: set[Path] = set()
    if (place / layout.CRASH).is_file():
        hunts = {place.absolute().parent.parent}
    else:
        with suppress(HuntDirectoryError):
            hunts |= set(find_hunts(place))
        with suppress(BundleError):
            hunts |= set(find_cases([place]))  # a case is laid out as a hunt is
    found = [origin for hunt in sorted(hunts) for origin in trust_hunt(hunt, place)]
    if not found:
        raise BundleError("the folder has no code that could run", fix="give the directory of a hunt", where=str(place))
    return found


def _line(origin: TrustedOrigin) -> str:
    return f"{origin.id}  {origin.trusted_at}  {command_line(origin.path)}: {origin.runs}"
