"""Further contents of the pages: settings, command, logs, workers and events of a hunt, and comparisons of hunts."""

from __future__ import annotations

import re
import socket
import threading
import time
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError
from crashhunt.base.pacing import Paced
from crashhunt.crashes import crash_folders
from crashhunt.dashboard._catalog import unreadable
from crashhunt.dashboard._hunt_page import HuntView, read_tail
from crashhunt.ledger import leave_untouched
from crashhunt.recording import Phase, read_header
from crashhunt.report import UNCHOSEN, describe_versions, importance_of
from crashhunt.statistics import compare

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from crashhunt.base.codec import JsonObject
    from crashhunt.dashboard._plotted_trials import Point
    from crashhunt.plans import HuntSettings
    from crashhunt.statistics import Comparison
    from crashhunt.trial import Value


_MAX_WORKERS = 256
_MAX_EVENTS = 50
_PHASES = {
    Phase.SETUP: "sets up the simulator",
    Phase.ACT: "the agent decides",
    Phase.SIMULATE: "simulates",
    Phase.DONE: "has ended",
}


def detail_of(view: HuntView) -> JsonObject:
    """Return the data of a hunt for ``/api/hunts/ID``: its row, and the further contents of its page."""
    row = view.row()
    settings, counts = view.settings, view.counts
    is_readable = not view.unreadable()
    log_name, log = _log(view) if is_readable else ("", "")
    return {
        **row,
        "path": str(view.path),
        "command": _command(view.path / layout.HUNT) if is_readable else "",
        "settings": _settings(settings) if settings is not None else {},
        "columns": _columns(settings) if settings is not None else [],
        "scenario_columns": list(settings.scenario_arguments) if settings is not None else [],
        "kinds": row.get("kinds"),
        "parts": counts.parts() if counts is not None else [],
        "curve": counts.curve() if counts is not None else [],
        "events": [[at, state, why] for at, state, why in view.events[-_MAX_EVENTS:]],
        "dropped": {words: len(numbers) for words, numbers in (view.facts.get("dropped") or {}).items()},
        "until_rate": view.facts.get("until_rate"),
        "workers": _workers(view) if row["state"] == "running" else [],
        "run_log": log,
        "run_log_of": log_name,
        "problems": [
            *([describe_versions(row["code_versions"])] if row.get("code_versions") else []),
            *(view.sample.problems if view.sample is not None else []),
        ],
    }


def _log(view: HuntView) -> tuple[str, str]:
    """Return the name and the end of a log: of the suite's hunt, or else of the crash of the last trial."""
    if text := read_tail(view.path / layout.RUN_LOG, view.path):
        return "", text
    for folder in crash_folders(view.path)[-1:]:
        return folder.name, "".join(read_tail(folder / name, view.path) for name in (layout.RUN_LOG, layout.ERROR_LOG))
    return "", ""


def _settings(settings: HuntSettings) -> JsonObject:
    """Return settings as text, in the terms of the command line."""
    found: JsonObject = {
        "scenario": settings.scenario,
        **{f"agent {name}": agent.agent for name, agent in settings.agents.items()},
        "trials": settings.trials or "no limit",
        "max steps": settings.max_steps,
        "hunt seed": settings.seed,
        "sampler": settings.sampler,
        "counts as a crash": ", ".join(settings.crash_on_words),
        "oracles": ", ".join(settings.oracles),
        "disturbances": ", ".join(settings.disturb),
        "probe": settings.probe,
        "branch": settings.branch,
        "seeds": settings.seeds,
        "keep going": settings.run.keep_going,
        "near misses kept": settings.run.near_misses,
        f"crash types{' by cause' if settings.run.by_cause else ''} wanted": settings.run.distinct,
    }
    return {name: value for name, value in found.items() if value not in ("", None, False, 0)}


def _columns(settings: HuntSettings) -> list[str]:
    """Return the arguments that may vary, by their names in the data of the plots."""
    several = len(settings.agents) > 1
    names = [
        f"{agent}.{name}" if several else name for agent, chosen in settings.agents.items() for name in chosen.arguments
    ]
    return [*names, *settings.scenario_arguments]


def _command(path: Path) -> str:
    """Return the command line from the first line of ``hunt.toml``; empty if there is none."""
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            first = file.readline(20_000)
    except OSError:
        return ""
    return first[2:].rstrip("\n") if first.startswith("# ") else ""


def _workers(view: HuntView) -> list[JsonObject]:
    """Return the present step of each running trial, from the header of its black box."""
    owner = view.facts.get("owner")
    is_here = owner is not None and owner["host"] == socket.gethostname()
    now, found = time.monotonic(), {}  # the clock of black boxes, which counts from the start of a machine
    for path in sorted(view.path.glob(f".scratch-*/trial-*/{layout.BLACK_BOX}"))[:_MAX_WORKERS]:
        header = None if unreadable(path.parent, view.path, [path.name]) else read_header(path)
        if header is None or header.phase is Phase.DONE or not re.fullmatch(r"trial-\d+", path.parent.name):
            continue
        found[header.trial] = {
            "trial": header.trial,
            "step": max(0, header.step),
            "doing": _PHASES[header.phase],
            "since_s": round(max(0.0, now - header.started), 1) if is_here else None,
        }
    return [found[trial] for trial in sorted(found)]


def importance_of_points(points: Sequence[Point], first: int = 0) -> list[JsonObject]:
    """Return the share of the variation in criticality that each argument explains, as in the report.

    Trials with a lower number than ``first`` may have run with other code, and do not count.
    """
    trials: list[tuple[Mapping[str, Value], float]] = []
    for point in points:
        danger = 1.0 if point["category"] != "no crash" else point["danger"]
        counts = isinstance(point["number"], int) and point["number"] >= first
        if counts and point["origin"] in UNCHOSEN and point["parent"] is None and isinstance(danger, float):
            values = point["values"]
            assert isinstance(values, dict)
            trials.append((values, danger))
    return [dict(found) for found in importance_of(trials)]


# Several hunts next to each other, with the numbers of ``crashhunt compare``.

_MAX_TRIALS = 200_000  # of all hunts together


class HuntComparer:
    """Compares hunts, and caches the last comparison."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._found: Paced[JsonObject] = Paced()
        self._paths: tuple[str, ...] = ()

    def compare(self, views: Sequence[HuntView]) -> JsonObject:
        """Return ``hunts``, each a row with its curve and ``figures``, and ``pairs``, each hunt against the first."""
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
            return _no_figures("")
        trials = sum(row["trials_run"] for row in rows)
        if trials > _MAX_TRIALS:
            why = f"a comparison reads all trials, of which there are more than {_MAX_TRIALS:,}"
            return _no_figures(f"{why}; run: crashhunt compare")
        if why := next(filter(None, (view.unreadable() for view in views)), ""):
            return _no_figures(why)

        def make() -> JsonObject:
            try:
                with leave_untouched():
                    return _figures_as_json(compare(*(view.path for view in views)), rows)
            except CrashhuntError as error:
                return _no_figures(str(error))

        paths = tuple(str(view.path) for view in views)
        found = self._found([(row["dir"], row["trials_run"]) for row in rows], make, now=paths != self._paths)
        self._paths = paths
        return found


def _no_figures(why: str) -> JsonObject:
    return {"hunts": {}, "pairs": [], "problem": why}


def _figures_as_json(found: Comparison, rows: Sequence[JsonObject]) -> JsonObject:
    data: JsonObject = found.to_json()
    names = {row["dir"]: row["name"] for row in rows}
    pairs = []
    for pair in found.pairs:
        verdict = pair.verdict
        for path in sorted(names, key=len, reverse=True):  # one may begin with another
            verdict = verdict.replace(path, names[path])
        pairs.append({"verdict": verdict, "caution": pair.caution})
    return {"hunts": {hunt["dir"]: hunt for hunt in data["hunts"]}, "pairs": pairs, "problem": ""}
