"""``crashhunt guide``."""

from __future__ import annotations

import json
import sys
from itertools import groupby
from typing import TYPE_CHECKING

from crashhunt.base.errors import UsageError
from crashhunt.cli._common import CommandOptions, Commands, add_json, make_console

if TYPE_CHECKING:
    from crashhunt.guide import FoundPage, Page


def add_guide(commands: Commands) -> None:
    """Add the command ``guide`` to the parser."""
    guide = commands.add_parser(
        "guide",
        help="read the guide: tutorials, how to, reference, troubleshooting",
        description="Read the guide in the terminal: tutorials, how-to pages, concepts, reference, troubleshooting. "
        "Without a TOPIC, list all pages.",
    )
    guide.add_argument(
        "topic",
        metavar="TOPIC",
        nargs="*",
        default=[],
        help="page to show, or words to find, such as replay differs; default: list all pages",
    )
    add_json(guide)
    guide.set_defaults(command=_guide)


def _guide(options: CommandOptions, _words: list[str]) -> int:
    from crashhunt.guide import find_page, for_terminal, list_pages, search_pages

    words = " ".join(options.topic)
    if not words:
        pages = list_pages()
        print(json.dumps({"topics": [_about(page) for page in pages]}) if options.json else _listing(pages))
        return 0
    try:
        page = find_page(words)
    except UsageError:
        found = search_pages(words)
        if not found:
            raise
        if options.json:
            print(json.dumps({"topics": [{**_about(one.page), "heading": one.heading} for one in found]}))
        else:
            print(_results(found, words))
        return 0
    text = page.text(options.parser)
    if options.json:
        print(json.dumps({"topic": page.topic, "section": page.section, "title": page.title, "text": text}))
    elif sys.stdout.isatty():
        _show(for_terminal(text))
    else:
        print(for_terminal(text).rstrip())
    return 0


def _about(page: Page) -> dict[str, str]:
    return {"topic": page.topic, "section": page.section, "title": page.title}


_MAX_RESULTS = 12


def _results(found: list[FoundPage], words: str) -> str:
    """Return the pages of a search as text, the best first."""
    width = max(len(one.page.topic) for one in found[:_MAX_RESULTS])
    lines = [f"crashhunt guide TOPIC shows the pages about {words!r}, the best first:", ""]
    for page, heading, _ in found[:_MAX_RESULTS]:
        lines.append(f"  {page.topic:{width}}  {page.title}{f' > {heading}' if heading else ''}")
    more = len(found) - _MAX_RESULTS
    return "\n".join([*lines, *([f"  and {more} more"] if more > 0 else [])])


def _listing(pages: list[Page]) -> str:
    from crashhunt.guide import SECTIONS

    width = max(len(page.topic) for page in pages)
    lines = ["crashhunt guide TOPIC shows one of these:"]
    for section, members in groupby(pages, key=lambda page: page.section):
        lines += ["", f"{SECTIONS[section]}:", *(f"  {page.topic:{width}}  {page.title}" for page in members)]
    return "\n".join(lines)


def _show(text: str) -> None:
    """Print Markdown in lines of readable length."""
    from rich.markdown import Markdown

    console = make_console()
    console.width = min(console.width, _MAX_COLUMNS)
    console.print(Markdown(text, code_theme="ansi_dark", hyperlinks=True))


_MAX_COLUMNS = 120
