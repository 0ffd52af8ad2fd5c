"""Text that others have written: agents, environments, the operating system."""

from __future__ import annotations

__all__ = ["encodable"]


def encodable(text: str) -> str:
    """Return the text so that it can be written as UTF-8: half a pair of surrogates, as in names of files, is spelt."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")
