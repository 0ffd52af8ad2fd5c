"""What commands tell a CI besides what they print: a summary in a file, annotations of GitHub's."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from crashhunt.base.files import cannot_write
from crashhunt.cli._common import say

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

__all__ = ["add_told", "tell"]


def add_told(parser: argparse.ArgumentParser) -> None:
    """Add ``--summary`` and ``--annotate``."""
    parser.add_argument(
        "--summary", metavar="FILE", type=Path,
        help="add a summary in Markdown to the end of FILE, such as $GITHUB_STEP_SUMMARY",
    )  # fmt: skip
    parser.add_argument(
        "--annotate",
        action="store_true",
        help="print annotations as well, ten at most, which GitHub shows beside the code",
    )


def tell(options: argparse.Namespace, summary: str, annotations: Sequence[str]) -> None:
    """Write the summary and print the annotations, where they were asked for.

    Raises:
        HuntDirectoryError: the file cannot be written.
    """
    if options.summary is not None:
        try:
            with options.summary.open("a", encoding="utf-8") as file:
                file.write(f"{summary}\n")
        except OSError as error:
            raise cannot_write(options.summary, error) from error
    if options.annotate:
        for line in annotations:
            say(line, as_json=options.json)
