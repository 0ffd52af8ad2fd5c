"""Resource limits of this process (``ulimit``): which one an error came from, and how to raise it."""

from __future__ import annotations

import errno
import resource

__all__ = ["limit_behind"]

_MEBIBYTE = 1 << 20
_NO_MEMORY = ("can't start new thread", "failed to map segment", "cannot allocate memory", "unable to allocate")


def limit_behind(error: BaseException) -> str:
    """Return the limit that an error came from and how to raise it, in words; empty where no limit is set.

    A limit on memory (``RLIMIT_AS``) shows as one of many errors: of Python, of a thread or of a library that does not
    load. A limit on the size of files (``RLIMIT_FSIZE``) is an `OSError`, since Python ignores its signal.
    """
    if _is_no_memory(error) and (limit := _soft_limit(resource.RLIMIT_AS)) is not None:
        return f"the limit on memory is {limit / _MEBIBYTE:.4g} MiB: raise it with ulimit -v"
    if (
        isinstance(error, OSError)
        and error.errno == errno.EFBIG
        and (limit := _soft_limit(resource.RLIMIT_FSIZE)) is not None
    ):
        return f"the limit on the size of a file is {limit / _MEBIBYTE:.4g} MiB: raise it with ulimit -f"
    return ""


def _is_no_memory(error: BaseException) -> bool:
    if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
        return True
    try:
        said = str(error).lower()
    except BaseException:  # of a class that cannot even say its message
        return False
    return isinstance(error, ImportError | RuntimeError | OSError) and any(words in said for words in _NO_MEMORY)


def _soft_limit(which: int) -> int | None:
    soft, _ = resource.getrlimit(which)
    return None if soft == resource.RLIM_INFINITY else soft
