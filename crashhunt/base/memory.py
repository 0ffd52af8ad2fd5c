"""How much of the memory is free."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Final

__all__ = ["FREE", "free_memory"]

FREE: Final = 0.25
"""The share of the memory that has to be free for another copy to be left asleep."""


def free_memory() -> float:
    """Return the share of the memory that is free, or would be as soon as somebody needs it; 1 where nobody can say."""
    with suppress(OSError, ValueError, KeyError, ZeroDivisionError):
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        found = {name: int(rest.split()[0]) for name, _, rest in (line.partition(":") for line in lines)}
        free = found["MemAvailable"] / found["MemTotal"]
        with suppress(OSError, ValueError):  # of a container
            most = int(Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii"))
            used = int(Path("/sys/fs/cgroup/memory.current").read_text(encoding="ascii"))
            free = min(free, 1 - used / most)
        return free
    return 1.0
