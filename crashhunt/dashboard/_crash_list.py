"""The saved crashes and near misses of a hunt, with their types and places. No code of a bundle runs."""

from __future__ import annotations

import math
import threading
from contextlib import closing
from typing import TYPE_CHECKING, NamedTuple

from crashhunt.base import layout
from crashhunt.base.errors import BundleError, CrashhuntError
from crashhunt.base.text import command_line
from crashhunt.crashes import crash_folders, fault_of, most_dangerous, preventable_by, read_bundle, signature_of
from crashhunt.dashboard._catalog import FoundHunt, is_inside, unreadable, unreadable_below
from crashhunt.dashboard._hunt_page import read_tail, sign_of
from crashhunt.ledger import Ledger, has_begun
from crashhunt.recording import read_lanes, read_obstacles
from crashhunt.report import Story, lineage_of, player_data

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from crashhunt.base.codec import JsonObject
    from crashhunt.crashes import Bundle

_BUNDLE_FOLDERS = (layout.CRASHES, layout.NEAR_MISSES)
_MAX_LISTED = 2_000
_MAX_LANES = 4_000
_MAX_MAP_LOGS = 40  # that lanes are read from


class _Entry(NamedTuple):
    """A bundle, with the state of its ``crash.json``."""

    written: tuple[int, int, int]
    row: JsonObject


class CrashList:
    """The bundles of a hunt; each bundle is read once."""

    def __init__(self, found: FoundHunt) -> None:
        self._found = found
        self._entries: dict[str, _Entry] = {}
        self._analysed: dict[str, tuple[tuple[int, int, int], JsonObject]] = {}
        self._lanes: dict[str, list[list[float]]] = {}
        self._obstacles: dict[str, list[list[float]]] = {}
        self._lock = threading.RLock()
        self._thread: threading.Thread | None = None

    def folder(self, crash: str) -> Path | None:
        """Return the folder of a crash, near miss or minimized crash by its identifier; None if it is missing."""
        folders = self._folders()
        if crash in folders:
            return folders[crash]
        return self._minimized(folders.get(crash.removesuffix(layout.SMALL))) if crash.endswith(layout.SMALL) else None

    @staticmethod
    def _minimized(folder: Path | None) -> Path | None:
        """Return the folder with the minimized form of a crash; None if there is none."""
        if folder is None:
            return None
        found = folder.with_name(f"{folder.name}{layout.SMALL}")
        return found if found.is_dir() else None

    def _folders(self) -> dict[str, Path]:
        path = self._found.path
        found: dict[str, Path] = {}
        for place in reversed(_BUNDLE_FOLDERS):  # a crash hides a near miss of the same name
            found |= {folder.name: folder for folder in crash_folders(path, place)}
        return found

    def rows(self) -> JsonObject:
        """Return ``crashes``, with one entry for each crash or near miss, and how many there are.

        ``count`` is the number of crashes, and ``pending`` the number of crashes that are not analysed yet.
        ``near_misses`` and ``pending_near_misses`` are the same numbers of near misses.

        Reading the log of a crash takes 50 ms or more, so a separate thread reads the logs.
        """
        with self._lock:
            folders = self._folders()
            rows, unknown = [], []
            self._entries = {name: entry for name, entry in self._entries.items() if name in folders}
            for name, folder in sorted(folders.items())[:_MAX_LISTED]:
                row = self._row(name, folder)
                if not row["damaged"] and self._is_unknown(name):
                    unknown.append((name, folder))
                analysed = self._analysed.get(name)
                rows.append({**row, **(analysed[1] if analysed else {"type": None, "fault": None})})
            if unknown and (self._thread is None or not self._thread.is_alive()):
                self._thread = threading.Thread(target=self._analyse, args=(unknown,), daemon=True)
                self._thread.start()
            near = sum(_is_near_miss(folder) for folder in folders.values())
            pending_near = sum(_is_near_miss(folder) for _, folder in unknown)
            return {
                "crashes": rows,
                "pending": len(unknown) - pending_near,
                "pending_near_misses": pending_near,
                "count": len(folders) - near,
                "near_misses": near,
            }

    def _row(self, name: str, folder: Path) -> JsonObject:
        written = sign_of(folder / layout.CRASH)
        known = self._entries.get(name)
        if known is not None and known.written == written:
            return known.row
        try:
            row = _summary(self._read(folder))
        except BundleError as error:
            row = {"id": name, "damaged": str(error), "near_miss": _is_near_miss(folder)}
        self._entries[name] = _Entry(written, row)
        return row

    def _read(self, folder: Path) -> Bundle:
        """Read a bundle of the hunt.

        Raises:
            BundleError: the bundle is damaged, or a file of the bundle or the hunt must not be opened.
        """
        root = self._found.path
        why = (
            unreadable(folder.parent, root, [folder.name])
            or unreadable(folder, root, [path.name for path in folder.iterdir()])
            or unreadable(root, root)
            or unreadable_below(root / layout.SNAPSHOTS, root)
        )
        if why:
            raise BundleError(why, fix="do not trust this crash", where=str(folder))
        return read_bundle(folder)

    def bundle(self, crash: str) -> Bundle | None:
        """Return a crash by its identifier; None if the crash does not exist.

        Raises:
            BundleError: the crash is damaged, or one of its files must not be opened.
        """
        folder = self.folder(crash)
        return None if folder is None else self._read(folder)

    def _is_unknown(self, name: str) -> bool:
        analysed = self._analysed.get(name)
        return analysed is None or analysed[0] != self._entries[name].written

    def _analyse(self, unknown: Sequence[tuple[str, Path]]) -> None:
        for name, folder in unknown:
            written = sign_of(folder / layout.CRASH)
            said: JsonObject = {"type": None, "fault": None}
            try:
                said |= _analysis(self._read(folder))
            except (CrashhuntError, OSError) as error:
                said["damaged"] = str(error)
            with self._lock:
                self._analysed[name] = written, said

    def detail(self, crash: str) -> JsonObject | None:
        """Return the data of a crash for its page (player, texts, table and commands); None if it does not exist.

        Raises:
            BundleError: the crash is damaged.
        """
        folder = self.folder(crash)
        if folder is None:
            return None
        bundle = self._read(folder)
        story = Story(bundle)
        small = self._minimized(folder)
        names = sorted(self._folders())
        at = names.index(crash.removesuffix(layout.SMALL))
        result, root = bundle.result, self._found.path
        return {
            **player_data(bundle, story),
            "near_miss": bundle.is_near_miss,
            "previous": names[at - 1] if at else "",
            "next": names[at + 1] if at + 1 < len(names) else "",
            "minimized": small.name if small is not None else "",
            "minimized_from": crash.removesuffix(layout.SMALL) if crash.endswith(layout.SMALL) else "",
            "parameters": {agent: dict(given) for agent, given in result.spec.arguments.items()},
            "scenario_parameters": dict(result.spec.scenario_arguments),
            "judged": story.judgement.to_json() if story.judgement is not None else None,
            "fault": story.fault.to_json(),
            "run_log": read_tail(folder / layout.RUN_LOG, root),
            "error_log": read_tail(folder / layout.ERROR_LOG, root),
            "lineage": self._lineage(result.spec.number),
            "commands": _commands(root, crash, bundle),
            "path": str(folder),
        }

    def _lineage(self, number: int) -> list[list[object]]:
        """Return the ancestors of a trial, each with number, origin and criticality."""
        path = self._found.path / layout.LEDGER
        if not has_begun(path):
            return []
        with closing(Ledger(path, read_only=True)) as ledger:
            return lineage_of(number, ledger.plain_trial)

    def log(self, crash: str) -> Path | None:
        """Return the path of a crash's log inside the hunt; None if there is no log."""
        folder = self.folder(crash)
        if folder is None:
            return None
        path = (folder / layout.LOG).resolve()
        return path if is_inside(path, [self._found.path]) and path.is_file() else None

    def map(self) -> JsonObject:
        """Return the roads around the crashes, and the places of crashes and near misses.

        Returns:
            ``lanes``: for each lane, x and y of its two borders in m, right and then left. ``obstacles``: for each
            obstacle, such as a building, x and y of its outline. ``points``: for each crash its identifier, x and y in
            m, type, and whether it is a near miss.
        """
        with self._lock:
            rows = self.rows()["crashes"]
            folders = self._folders()
            for name in [row["id"] for row in rows if not row["damaged"]][:_MAX_MAP_LOGS]:
                if name not in self._lanes and (path := self.log(name)) is not None:
                    try:
                        borders, outlines = read_lanes(path), read_obstacles(path)
                    except (BundleError, OSError, ValueError):
                        borders, outlines = [], []
                    self._lanes[name] = [_flat(*right, *left[::-1]) for right, left in borders if len(right) > 1]
                    self._obstacles[name] = [_flat(*outline) for outline in outlines if len(outline) > 2]
            return {
                "lanes": _unique(self._lanes, folders),
                "obstacles": _unique(self._obstacles, folders),
                "points": [
                    {name: row.get(name) for name in ("id", "x", "y", "type", "near_miss", "outcome")}
                    for row in rows
                    if row.get("x") is not None
                ],
            }


def _flat(*points: Iterable[float]) -> list[float]:
    return [round(float(value), 2) for point in points for value in point]


def _unique(lines: Mapping[str, list[list[float]]], names: Iterable[str]) -> list[list[float]]:
    """Return the lines of crashes, each once."""
    unique = {tuple(line): None for name in names for line in lines.get(name, ())}
    return [list(line) for line in list(unique)[:_MAX_LANES]]


def _is_near_miss(folder: Path) -> bool:
    return folder.parent.name == layout.NEAR_MISSES


def _summary(bundle: Bundle) -> JsonObject:
    result = bundle.result
    place = result.collision or result.event
    x, y = (place.x, place.y) if place is not None else (math.nan, math.nan)
    known = math.isfinite(x) and math.isfinite(y)
    return {
        "id": bundle.id,
        "damaged": "",
        "near_miss": bundle.is_near_miss,
        "trial": result.spec.number,
        "outcome": str(result.outcome),
        "category": result.outcome.category,
        "summary": result.summary,
        "steps": result.steps,
        "danger": result.danger,
        "confirmed": bundle.confirmed,
        "why_unconfirmed": bundle.why_unconfirmed,
        "disturbed": result.disturbed,
        **({"preventable_by": answers} if (answers := preventable_by(bundle)) is not None else {}),
        "x": round(x, 2) if known else None,
        "y": round(y, 2) if known else None,
    }


def _analysis(bundle: Bundle) -> JsonObject:
    """Return the keys of a crash's or near miss's row that need its log: type and fault, or the critical place."""
    if not bundle.is_near_miss:
        recording = bundle.recording() if bundle.result.collision is not None else None
        return {"type": str(signature_of(bundle, recording)), "fault": fault_of(bundle, recording).verdict}
    recording = bundle.recording()
    most = most_dangerous(recording)
    if most is None:
        return {}
    scene = recording.scene(most.step)
    x, y = scene.points[scene.roster.index[most.agent]]
    return {"x": round(x, 2), "y": round(y, 2)}


def _commands(hunt: Path, crash: str, bundle: Bundle) -> list[list[str]]:
    """Return the commands for a crash by name, as text to paste into a shell."""
    near = bundle.is_near_miss
    may_shrink = not near and not crash.endswith(layout.SMALL)
    words = {
        "show": ["show", str(hunt), "--crash", crash],
        "replay": ["replay", str(hunt), "--crash", crash],
        "replay with your present code": ["replay", str(hunt), "--crash", crash, "--code", "current"],
        **({} if near else {"judge": ["judge", str(hunt), "--crash", crash]}),
        **({} if not may_shrink else {"minimize": ["shrink", str(hunt), "--crash", crash]}),
        "note": ["note", str(hunt), "--crash", crash, "TEXT"],
        "export": ["export", str(hunt), f"{crash}.zip", "--crash", crash],
        **({} if near else {"add to corpus": ["corpus", "add", str(bundle.path), "--to", "corpus"]}),
    }
    return [[name, command_line("crashhunt", *given)] for name, given in words.items()]
