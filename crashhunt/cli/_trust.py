"""``crashhunt trust``, and the question before a command runs foreign code."""

from __future__ import annotations

import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from crashhunt.base import layout
from crashhunt.base.errors import BundleError, HuntDirectoryError, UntrustedError, UsageError
from crashhunt.base.text import command_line, near_path, one_line
from crashhunt.cli._common import CommandOptions, Commands, Parser, add_json

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.crashes import Archive, Bundle, TrustedOrigin


def add_trust_command(commands: Commands) -> None:
    """Add the command ``trust`` to the parser."""
    trust = commands.add_parser(
        "trust",
        help="trust the code of hunts and crashes that you did not make on this machine",
        description="Trust the code of hunts, crashes and corpora that you did not make on this machine, such as "
        "folders from your other machine. Commands then run this code "
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


def _trust(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.crashes import list_trusted, remove_trusted

    if options.places and options.remove:
        raise UsageError("DIR and --remove cannot be combined", fix="run the command once with each of them")
    if options.remove:
        removed = remove_trusted(options.remove)
        for origin in removed:
            options.say(f"no longer trusted: {_line(origin)}")
        options.print_json({"removed": [origin.to_json() for origin in removed]})
        return 0
    if options.places:
        found = {origin.fingerprint: origin for place in options.places for origin in _trust_place(place)}
        for origin in found.values():
            options.say(f"trusted: {_line(origin)}")
    else:
        found = {origin.fingerprint: origin for origin in list_trusted()}
        for origin in found.values():
            options.say(_line(origin))
        if not found:
            options.say("You trust no code besides what you made on this machine.")
    options.print_json({"trusted": [origin.to_json() for origin in found.values()]})
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
        what = "is a device or a pipe" if place.exists() else "does not exist"
        raise BundleError(f"{str(place)!r} {what}", fix=f"{near_path(place, '.zip')}give a folder or a file")
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


# The question before a command runs the code of a crash that was not made on this machine.

T = TypeVar("T")


def add_trust(parser: Parser) -> None:
    """Add the option ``--trust``, which is the same for every command that runs code of a crash."""
    parser.add_argument(
        "--trust", action="store_true",
        help="run the code of a hunt or crash from another machine without asking; crashhunt trust DIR trusts this "
        "code permanently",
    )  # fmt: skip


def run_trusted(
    run: Callable[[bool | None], T],
    bundle: Bundle,
    archive: Archive | None,
    options: CommandOptions,
    *,
    path: Path | None = None,
) -> T:
    """Call a function that runs the code of a crash; if the code is not trusted, ask the user once for each origin.

    Args:
        run: function called with True if the code is trusted, or with None to determine it. The function raises
            `UntrustedError` before any code runs.
        bundle: the crash whose code runs.
        archive: the archive that contained the crash; None if there was none.
        options: the options ``trust``, ``json`` and ``directory`` of the command line.
        path: path as the user named it; by default ``directory``.

    Raises:
        UntrustedError: the code is not trusted, and there is no terminal for a question, or the user declines.
    """
    from crashhunt.crashes import refuse_untrusted, snapshot_of, trust_snapshot

    place = path or options.directory
    try:
        return run(True if options.trust or (archive is not None and archive.made_here) else None)
    except UntrustedError:
        made_by = f"{archive.made_by} on {archive.made_at}" if archive is not None else ""
        refusal = refuse_untrusted(bundle, where=str(place), made_by=made_by)
        if snapshot_of(bundle).faults() or not ask_to_trust(refusal, as_json=options.json):
            raise refusal from None
    trust_snapshot(snapshot_of(bundle), place)
    return run(True)


def check_trust(bundle: Bundle, trusted: bool | None) -> None:
    """Refuse a crash that is not trusted, for use in `run_trusted` before code that does not check the trust itself.

    Raises:
        UntrustedError: the crash is neither made here nor trusted.
    """
    from crashhunt.crashes import is_bundle_trusted, refuse_untrusted

    if not trusted and not is_bundle_trusted(bundle):
        raise refuse_untrusted(bundle)


def ask_to_trust(refusal: UntrustedError, *, as_json: bool) -> bool:
    """Ask whether the user trusts the code from now on; return False without a terminal."""
    from crashhunt.base.signals import interruptible

    if as_json or not (sys.stdin is not None and sys.stdin.isatty() and sys.stderr.isatty()):
        return False
    print(one_line(f"{refusal.where}: {refusal.message}"), file=sys.stderr)  # an archive names its maker as it likes
    print("Trust this code from now on and run it? [y/N] ", end="", file=sys.stderr, flush=True)
    with interruptible():
        return sys.stdin.readline().strip().lower() in ("y", "yes")
