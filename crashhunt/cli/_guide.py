"""``crashhunt guide``."""

from __future__ import annotations

import json
import sys
from itertools import groupby
from typing import TYPE_CHECKING

from crashhunt.base.errors import UsageError
from crashhunt.cli._common import add_json, make_console

if TYPE_CHECKING:
    import argparse

    from crashhunt.cli._common import Commands
    from crashhunt.guide import Page


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
        nargs="?",
        default="",
        help="page to show, or a word to find; default: list all pages",
    )
    add_json(guide)
    guide.set_defaults(command=_guide)


def _guide(options: argparse.Namespace, _words: list[str]) -> int:
    from crashhunt.guide import find_page, for_terminal, list_pages, search_pages

    pages = list_pages()
    is_search = False
    if options.topic:
        try:
            page = find_page(options.topic)
        except UsageError:
            pages, is_search = search_pages(options.topic), True
            if not pages:
                raise
    if is_search or not options.topic:
        if options.json:
            said = [{"topic": page.topic, "section": page.section, "title": page.title} for page in pages]
            print(json.dumps({"topics": said}))
        else:
            print(_listing(pages, f"the pages with the word {options.topic!r}" if is_search else "one of these"))
        return 0
    text = page.text(options.parser)
    if options.json:
        print(json.dumps({"topic": page.topic, "section": page.section, "title": page.title, "text": text}))
    elif sys.stdout.isatty():
        _show(for_terminal(text))
    else:
        print(for_terminal(text).rstrip())
    return 0


def _listing(pages: list[Page], which: str) -> str:
    from crashhunt.guide import SECTIONS

    width = max(len(page.topic) for page in pages)
    lines = [f"crashhunt guide TOPIC shows {which}:"]
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
