"""Sphinx builds the guide as a web site: the pages of crashhunt/guide, completed as the command completes them."""

from __future__ import annotations

import tomllib
from itertools import groupby
from pathlib import Path
from typing import Any

import crashhunt
from crashhunt.cli import make_parser
from crashhunt.guide import SECTIONS, completed, list_pages

ROOT = Path(__file__).parents[3]
_PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

project = _PROJECT["name"]
project_copyright = "2026, The crashhunt authors"
author = _PROJECT["authors"][0]["name"]
release = crashhunt.__version__
extensions = ["myst_parser", "sphinx_copybutton"]
exclude_patterns = ["*.py", "**/__pycache__"]
myst_heading_anchors = 3  # [text](page.md#a-heading) leads there, and a heading that is not there fails the build
smartquotes = False  # they would make a dash of the dashes of an option
copybutton_prompt_text = "$ "  # what is copied is the command, without prompt and output
copybutton_line_continuation_character = "\\"
html_theme = "furo"
html_title = f"crashhunt {release}"
html_static_path = ["static"]
html_css_files = ["guide.css"]
html_theme_options = {
    "source_repository": _PROJECT["urls"]["Source"],
    "source_branch": "main",
    "source_directory": "crashhunt/guide/",
}


def _complete(_app: object, name: str, source: list[str]) -> None:
    source[0] = completed(source[0], make_parser())
    if name == "index":
        source[0] += "\n".join(_contents())


def _contents() -> list[str]:
    """The list of all pages, section by section."""
    lines = []
    for section, pages in groupby(list_pages(), key=lambda page: page.section):
        lines += ["", "```{toctree}", f":caption: {SECTIONS[section]}", ":maxdepth: 1", ""]
        lines += [f"{section}/{page.topic}" if section else page.topic for page in pages]
        lines += ["```", ""]
    return lines


def _always_read(*_: object) -> list[str]:
    """The pages of which the code makes a part, which may have changed although the file has not."""
    return [
        "index",
        "reference/api",
        "reference/commands",
        "reference/json",
        "reference/observations-and-actions",
        "reference/toml",
    ]


def setup(app: Any) -> None:
    """Have every page completed when it is read."""
    app.connect("source-read", _complete)
    app.connect("env-get-outdated", _always_read)
