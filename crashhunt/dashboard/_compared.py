"""Several hunts next to each other, with the numbers of ``crashhunt compare``."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING

from crashhunt.base.errors import CrashhuntError
from crashhunt.estimation import compare
from crashhunt.ledger import leave_untouched

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.base.codec import JsonObject
    from crashhunt.dashboard._hunt import HuntView
    from crashhunt.estimation import Comparison

__all__ = ["Compared"]

_SHARE_OF_TIME = 0.05  # that comparisons may take: each reads all trials
_MAX_TRIALS = 200_000  # of all hunts together


class Compared:
    """Compares hunts, and keeps the last comparison."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._found: tuple[object, JsonObject] | None = None
        self._paths: tuple[str, ...] = ()
        self._due = 0.0

    def compare(self, views: Sequence[HuntView]) -> JsonObject:
        """Return ``hunts``, each a row with its curve and ``figures``, and ``pairs``, the first against each other.

        Args:
            views: of the hunts.
        """
        with self._lock:
            rows = []
            for view in views:
                row = view.row()
                rows.append({**row, "curve": view.counts.curve() if view.counts is not None else []})
            figures = self._figures(views, rows)
            return {
                "hunts": [
                    {**row, "figures": figures["hunts"].get(row["dir"]), "problem": figures["problem"]} for row in rows
                ],
                "pairs": figures["pairs"],
            }

    def _figures(self, views: Sequence[HuntView], rows: Sequence[JsonObject]) -> JsonObject:
        if not views:
            return {"hunts": {}, "pairs": [], "problem": ""}
        paths, key = tuple(str(view.path) for view in views), [(row["dir"], row["trials_run"]) for row in rows]
        began = time.monotonic()
        known = self._found
        if known is not None and paths == self._paths and (known[0] == key or began < self._due):
            return known[1]
        trials = sum(row["trials_run"] for row in rows)
        if trials > _MAX_TRIALS:
            why = f"a comparison reads all trials, of which there are more than {_MAX_TRIALS:,}"
            return {"hunts": {}, "pairs": [], "problem": f"{why}; run: crashhunt compare"}
        try:
            with leave_untouched():
                found = _plain(compare(*(view.path for view in views)), rows)
        except CrashhuntError as error:
            found = {"hunts": {}, "pairs": [], "problem": str(error)}
        ended = time.monotonic()
        self._found, self._paths, self._due = (key, found), paths, ended + (ended - began) / _SHARE_OF_TIME
        return found


def _plain(found: Comparison, rows: Sequence[JsonObject]) -> JsonObject:
    data: JsonObject = found.to_json()
    names = {row["dir"]: row["name"] for row in rows}
    pairs = []
    for pair in found.pairs:
        verdict = pair.verdict
        for path in sorted(names, key=len, reverse=True):  # one may begin with another
            verdict = verdict.replace(path, names[path])
        pairs.append({"verdict": verdict, "caution": pair.caution})
    return {"hunts": {hunt["dir"]: hunt for hunt in data["hunts"]}, "pairs": pairs, "problem": ""}
