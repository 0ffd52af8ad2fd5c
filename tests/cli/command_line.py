"""The command line in the process of a test, whose parser takes 10 ms to make."""

from __future__ import annotations

import functools

from crashhunt import cli

parser = functools.cache(cli.make_parser)


def run(*words: object) -> int:
    """Run a command, and return its exit code."""
    options = parser().parse_args([str(word) for word in words])
    code: int = options.command(options, list(words))
    return code
