"""The bar of `film`, `export` and whatever takes its time; what a hunt shows while it runs is in `report`."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from crashhunt.base.watching import Watch

__all__ = ["shown_progress"]


@contextmanager
def shown_progress(what: str, *, as_json: bool) -> Iterator[Watch | None]:
    """Yield what is called with how much is done, and of how much; the line is gone in the end, also after Ctrl-C.

    Args:
        what: is done, such as ``writing crash.mp4``.
        as_json: nobody is looking.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    if as_json or not console.is_terminal:
        yield None
        return
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(20),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True) as line:
        task = line.add_task(what, total=None)
        yield lambda done, total: line.update(task, completed=done, total=total)
