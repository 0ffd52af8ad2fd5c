"""What the log of a program names as the reason of its end: sanitizers, assert, exceptions, a damaged heap."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from typing import Final

from crashhunt.agents._program_processes import MAX_FILE_BYTES
from crashhunt.base.text import one_line

_MAX_REPORT_BYTES: Final = 1 << 20  # of the end of the log, which may have the report of a sanitizer
_MAX_REASON_CHARACTERS: Final = 300
_REASONS: Final = tuple(
    re.compile(pattern, re.MULTILINE)
    for pattern in (
        r"^SUMMARY: (\w+Sanitizer: .+)$",
        r"^(.+: runtime error: .+)$",  # of the sanitizer for undefined behaviour
        r"^(.+: Assertion .+ failed\.)$",
        r"^terminate called after throwing an instance of '(.+)'\n {2}what\(\): +(.+)$",
        r"^(terminate called .+)$",
        r"^(\*\*\* .+ \*\*\*: terminated)$",  # of glibc, as the next one
        r"^(double free or corruption.*|(?:free|malloc|realloc|munmap_chunk)\(\): .+|corrupted size vs\. .+)$",
        # Uncaught exceptions and panics. Programs may log those that they catch, so Python's must be the log's end.
        r"^thread '.*' (?:\(\d+\) )?panicked at (.+?):?\n(.+)$",  # of Rust
        r"^((?:panic|fatal error): .+)$",  # of Go
        r"^Exception in thread \".*\" (.+)$",  # of Java
        r"^(\w*Error\b.*)\n(?: {4}at .*\n)+(?:(?:[ }].*)?\n)*Node\.js v.+\s*\Z",
        r"^Traceback \(most recent call last\):\n(?:[ \t].*\n)+(\w.*)\s*\Z",
    )
)


def reason_in(descriptor: int, begin: int) -> str:
    """Return the reason that a program has written to its log since a position, after a colon; empty if it has none."""
    with suppress(OSError), open(f"/proc/self/fd/{descriptor}", "rb") as log:
        size = log.seek(0, os.SEEK_END)
        if size >= MAX_FILE_BYTES:
            return f": its log has reached {MAX_FILE_BYTES >> 20} MB"
        log.seek(max(begin, size - _MAX_REPORT_BYTES))
        text = log.read(_MAX_REPORT_BYTES).decode("utf-8", "replace")
        found = next((match for pattern in _REASONS if (match := pattern.search(text))), None)
        return f": {one_line(': '.join(found.groups()))[:_MAX_REASON_CHARACTERS]}" if found else ""
    return ""
