"""How much of the memory is free."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Final

__all__ = ["FREE", "free_memory"]

FREE: Final = 0.25
"""The share of the memory that has to be free for another copy to be left asleep."""
_LINES = 30  # what is looked for stands further up


def free_memory(root: Path = Path("/")) -> float:
    """Return the share of the memory that is free, or would be as soon as somebody needs it; 1 where nobody can say.

    Args:
        root: where the kernel's own files are.
    """
    with suppress(OSError, ValueError, KeyError, ZeroDivisionError):
        found = _numbers(root / "proc" / "meminfo")
        free = found["MemAvailable"] / found["MemTotal"]
        with suppress(OSError, ValueError):  # of a container
            group = root / "sys" / "fs" / "cgroup"
            most = int((group / "memory.max").read_text(encoding="ascii"))
            used = int((group / "memory.current").read_text(encoding="ascii"))
            with suppress(OSError, ValueError, KeyError):  # files that were read or written once are in there, too
                used -= min(used, _numbers(group / "memory.stat")["inactive_file"])
            free = min(free, 1 - used / most)
        return free
    return 1.0


def _numbers(path: Path) -> dict[str, int]:
    """What each of the first lines has after its name."""
    lines = path.read_text(encoding="ascii").splitlines()[:_LINES]
    return {name.rstrip(":"): int(number) for name, number, *_ in map(str.split, lines)}
