"""What hunts and trials have printed, wherever it is."""

from __future__ import annotations

import time
from contextlib import closing
from typing import TYPE_CHECKING, Literal

from crashhunt.ledger import Ledger

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

__all__ = ["LogKind", "read_logs"]

LogKind = Literal["run", "error", "state"]

_MOST = 1_000_000  # characters of one log, from its end


def read_logs(hunt: Path, kinds: tuple[LogKind, ...], *, trial: int | None = None) -> Iterator[tuple[str, str]]:
    """Yield title and text of the logs of a hunt and its trials; empty ones are left out.

    Args:
        hunt: its directory.
        kinds: what of it.
        trial: only of this one.
    """
    if trial is None:
        if "state" in kinds and (hunt / "ledger.sqlite").exists():
            with closing(Ledger(hunt / "ledger.sqlite")) as ledger:
                lines = [
                    f"{time.strftime('%Y-%m-%d %H:%M:%S', time.localtime(at))}  {state}{f'  {why}' if why else ''}"
                    for at, state, why in ledger.events()
                ]
            if lines:
                yield "state", "\n".join(lines)
        yield from _texts(hunt, "", kinds)
    folders = [*(hunt / "crashes").glob("[!.]*"), *(hunt / "trials").glob("[!.]*")]
    for folder in sorted(folders, key=lambda folder: folder.name):
        number = folder.name.partition("-")[0]
        if number.isdecimal() and trial in (None, int(number)):
            yield from _texts(folder, f"trial {int(number)}, ", kinds)


def _texts(folder: Path, title: str, kinds: tuple[LogKind, ...]) -> Iterator[tuple[str, str]]:
    for kind in ("run", "error"):
        if kind not in kinds:
            continue
        try:
            text = (folder / f"{kind}.log").read_text(encoding="utf-8", errors="replace")
        except OSError:
            continue
        if text.strip():
            yield f"{title}{kind}", text[-_MOST:]
