"""The scenarios that come with crashhunt."""

from __future__ import annotations

from typing import TYPE_CHECKING

from crashhunt.base.layout import PACKAGE, SCENARIO

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["shipped_folder", "shipped_scenarios"]


def shipped_folder() -> Path:
    """Return the folder of the scenarios that come with crashhunt."""
    inside = PACKAGE / "scenarios"
    return inside if inside.is_dir() else PACKAGE.parent / "scenarios"


def shipped_scenarios() -> tuple[str, ...]:
    """Return the names of the scenarios that come with crashhunt."""
    return tuple(sorted(path.parent.name for path in shipped_folder().glob(f"*/{SCENARIO}")))
