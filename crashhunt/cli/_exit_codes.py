"""The exit codes of all commands."""

from __future__ import annotations

from typing import Final

DONE: Final = 0
THE_ANSWER_IS_NO: Final = 1
BAD_INPUT: Final = 2
NO_VALID_TRIAL: Final = 3
NO_ANSWER: Final = 3
INTERRUPTED: Final = 130
"""As a shell says it after Ctrl-C."""
OUTPUT_CLOSED: Final = 141
"""As a shell says it after SIGPIPE: neither 0 nor 1, because the reader of the output has not seen the answer."""
