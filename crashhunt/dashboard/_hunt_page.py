"""The state of a hunt for the dashboard. When the files of the hunt change, only new data are read."""

from __future__ import annotations

import os
import threading
from contextlib import closing, suppress
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError, HuntDirectoryError
from crashhunt.base.pacing import Paced
from crashhunt.base.text import command_line
from crashhunt.crashes import read_notes
from crashhunt.dashboard._catalog import FoundHunt, unreadable, unreadable_below
from crashhunt.dashboard._plotted_trials import Sample
from crashhunt.dashboard._trial_counts import TrialCounts
from crashhunt.ledger import Ledger, damaged, has_begun
from crashhunt.plans import read_settings
from crashhunt.results import (
    HuntState,
    count_versions,
    first_trials,
    hunt_state,
    state_of_facts,
    sums_of_branches,
    sums_of_probes,
    with_crash_counts,
)
from crashhunt.statistics import counts_suffice, rate_of_counts, rate_of_trials
from crashhunt.training import held_out_traffics

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.base.codec import JsonObject
    from crashhunt.crashes import Note
    from crashhunt.ledger import Facts, KindData
    from crashhunt.plans import HuntSettings
    from crashhunt.statistics import CrashRate
    from crashhunt.training import HeldOutTraffics

_SPARKLINE_POINTS = 48  # points of the curve in the list
_MAX_TRIALS_READ = 200_000  # for a figure that needs all trials
_LOG_TAIL_BYTES = 20_000  # bytes of a log
_MAX_ERROR_CHARACTERS = 2_000  # characters of an error, at most

_Key = tuple[object, ...]


class HuntView:
    """The known state of a hunt, kept between requests."""

    def __init__(self, found: FoundHunt) -> None:
        self.found = found
        self._lock = threading.RLock()
        self._key: _Key = ()
        self._file: tuple[int, int] = (0, 0)
        self._settings_key = (0, 0, 0)
        self._why_unreadable: Paced[str] = Paced()
        self.settings: HuntSettings | None = None
        self.facts: Facts = {}
        self.events: list[tuple[float, str, str]] = []
        self.counts: TrialCounts | None = None
        self.sample: Sample | None = None
        self._last: float | None = None
        self._state: HuntState | None = None
        self._copies: Paced[JsonObject] = Paced()
        self._sums_of_copies: JsonObject = {}
        self._notes: Paced[list[Note]] = Paced()
        self._versions: list[JsonObject] = []
        self._rate: Paced[JsonObject] = Paced()
        self._held_out: Paced[HeldOutTraffics] = Paced()

    @property
    def path(self) -> Path:
        """The folder of the hunt."""
        return self.found.path

    def refresh(self, *, points: bool = False) -> HuntState:
        """Read new data of the hunt, and return its state.

        With ``points``, the sample for plots is read as well.
        """
        with self._lock:
            try:
                return self._refresh(points=points)
            except CrashhuntError as error:
                self._forget()
                return self._broken(str(error))
            except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
                self._forget()
                text = f"a fact cannot be read: {type(error).__name__}: {error}"
                return self._broken(str(damaged(self.path / layout.LEDGER, text)))

    def _broken(self, why: str) -> HuntState:
        return HuntState(str(self.path), "error", why[:_MAX_ERROR_CHARACTERS], damaged=True)

    def _forget(self) -> None:
        self._key, self.counts, self.sample = (), None, None

    def _refresh(self, *, points: bool) -> HuntState:
        if why := self.unreadable():
            raise HuntDirectoryError(
                why, fix=f"do not trust this hunt, or see {command_line('crashhunt', 'check', self.path)}"
            )
        self._read_settings()
        ledger = self.path / layout.LEDGER
        if not has_begun(ledger):
            self._forget()
            return HuntState(str(self.path), "finished") if self.found.exported else hunt_state(self.path)
        if self.settings is None:
            raise HuntDirectoryError(
                f"the directory has no {layout.HUNT}",
                fix=f"run {command_line('crashhunt', 'check', self.path)} to see what is left",
            )
        key = (sign_of(ledger), sign_of(ledger.with_name(f"{ledger.name}-wal")))
        if key != self._key or self.counts is None or (points and self.sample is None):
            self._read(ledger, points=points)
            self._key = key
        assert self.counts is not None
        state = state_of_facts(self.path, self.facts, dict(self.counts.outcomes), self._last)
        return replace(
            with_crash_counts(state, self.facts, self.counts.crashes),
            code_versions=self._versions or None,
            notes=self._notes(sign_of(self.path / layout.NOTES), lambda: list(read_notes(self.path)), now=True) or None,
            **self._sums_of_copies,
        )

    def unreadable(self) -> str:
        """Return the reason why a file of the hunt must not be opened; empty if all may be.

        Snapshots are examined once.
        """
        snapshots = self.path / layout.SNAPSHOTS
        if why := unreadable(self.path, self.found.root):
            return why
        return self._why_unreadable(sign_of(snapshots), lambda: unreadable_below(snapshots, self.found.root), now=True)

    def _read_settings(self) -> None:
        path = self.path / layout.HUNT
        if (key := sign_of(path)) != self._settings_key:
            self.settings = read_settings(path) if any(key) else None
            self._settings_key = key
            self._forget()

    def _read(self, path: Path, *, points: bool) -> None:
        settings = self.settings
        assert settings is not None
        with closing(Ledger(path, read_only=True)) as ledger, ledger.one_moment():
            file = path.stat().st_ino, ledger.replaced_count()
            if file != self._file:  # another ledger, or trials that run again
                self._file, self.counts, self.sample = file, None, None
            self.facts = ledger.facts()
            self.events = ledger.events()
            self._last = ledger.last_ended_at()
            if self.counts is None:
                self.counts = TrialCounts(settings.crash_on)
            began = self.counts.last >= 0
            new = self.counts.refresh(ledger)
            if self.sample is not None and began:
                self.sample.add(ledger, new)
            elif points and self.counts.last >= 0:
                sample = Sample(settings.crash_on)
                sample.begin(ledger, self.counts.last, self.counts.crashes)
                self.sample = sample
            self._versions = [asdict(one) for one in count_versions(ledger, self.facts, settings.crash_on)]
            self._read_copies(ledger)

    def _read_copies(self, ledger: Ledger) -> None:
        """Sum up the results of robustness probes and branches.

        The method reads all trials, so it runs only within its share of the time.
        """
        if not self.facts.get("copies"):
            self._sums_of_copies = {}
            return
        has_ended = self.facts.get("state") != "running"
        self._sums_of_copies = self._copies(
            (self._file, self._last, has_ended),
            lambda: {"probes": sums_of_probes(ledger, self.facts), "branches": sums_of_branches(ledger, self.facts)},
            now=has_ended,
        )

    # What the pages show.

    def row(self) -> JsonObject:
        """Return the hunt as an entry of ``/api/hunts``: the data of ``status --json``, and a few further keys."""
        with self._lock:
            state = self.refresh()
            settings, counts = self.settings, self.counts
            kinds = self.kinds()
            row: JsonObject = {
                **state.to_json(),
                "id": self.found.id,
                "name": self.found.name,
                "suite": self.found.suite,
                "exported": self.found.exported,
                "scenario": settings.scenario if settings else "",
                "agents": {name: agent.agent for name, agent in settings.agents.items()} if settings else {},
                "sampler": settings.sampler if settings else "",
                "max_steps": settings.max_steps if settings else 0,
                "crashed_trials": counts.crashes if counts else 0,
                "kinds_count": len(kinds) if kinds is not None else None,
                "rate": self.rate(state),
                "curve": [[trials, crashes] for trials, _, crashes in counts.curve(_SPARKLINE_POINTS)]
                if counts
                else [],
                "newest_kind_at": self.facts.get("newest_kind") if kinds is not None else None,
                "kind_firsts": self.kind_firsts(),
                "active_at": self.active_at(),
            }
            return row

    def kinds(self) -> list[KindData] | None:
        """Return the crash types that the hunt has recorded; None if the hunt ends at its first crash."""
        return self.facts.get("kinds") if self.counts is not None else None

    def kind_firsts(self) -> list[int]:
        """Return in order the numbers of the trials in which a crash type occurred for the first time."""
        first = {kind.get("words", ""): kind.get("first", "") for kind in self.kinds() or []}
        numbers = first_trials(first, self.facts.get("dropped") or {})
        return sorted(number for words, number in numbers.items() if words in first)

    def active_at(self) -> float:
        """Return the time of the hunt's last activity, in s since the epoch; 0 if it is unknown."""
        times = [self._last or 0.0, self.facts.get("heartbeat", 0.0), self.facts.get("began", 0.0)]
        if self.counts is None:
            with suppress(OSError):
                times.append(self.path.stat().st_mtime)
        return max(times)

    def rate(self, state: HuntState) -> JsonObject | None:
        """Return the crash rate per trial as ``rate --json`` does; None without a trial, or if it is not yet known."""
        settings, counts = self.settings, self.counts
        if settings is None or counts is None or not counts.trials:
            return None
        try:
            held_out = self._held_out(
                sign_of(self.path / layout.SNAPSHOTS), lambda: held_out_traffics(settings, [self.path]), now=True
            )
        except CrashhuntError as error:
            return {"why_not": str(error)[:_MAX_ERROR_CHARACTERS]}
        if counts_suffice(settings, self.facts, held_out):
            prefix = counts.prefix
            return self._rate(
                prefix,
                lambda: _rate_data(rate_of_counts(self.path, settings, self.facts, **prefix._asdict())),
                now=True,
            )
        return self._rate_of_all(state, settings, counts, held_out)

    def _rate_of_all(
        self, state: HuntState, settings: HuntSettings, counts: TrialCounts, held_out: HeldOutTraffics
    ) -> JsonObject | None:
        """Compute a crash rate that needs all trials, within its share of the time."""
        if counts.trials > _MAX_TRIALS_READ:
            why = f"it reads all trials, of which there are more than {_MAX_TRIALS_READ:,}"
            return {"why_not": f"{why}; run: {command_line('crashhunt', 'rate', self.path)}"}

        def make() -> JsonObject:
            try:
                with closing(Ledger(self.path / layout.LEDGER, read_only=True)) as ledger:
                    return _rate_data(rate_of_trials(self.path, settings, self.facts, ledger.plain_results(), held_out))
            except HuntDirectoryError as error:
                return {"why_not": str(error)}

        return self._rate((self._key, counts.trials), make, now=state.state != "running")


def _rate_data(rate: CrashRate) -> JsonObject:
    """Return the parts of a crash rate that the page needs, under the keys of ``rate --json``."""
    data = rate.to_json()
    names = ("per", "confidence", "method", "units", "crashes", "estimate", "certain", "why_not", "left_out")
    return {name: data[name] for name in names}


def sign_of(path: Path) -> tuple[int, int, int]:
    """Return a value that changes when the file changes; zeros if the file is missing."""
    try:
        found = path.stat()
    except OSError:
        return 0, 0, 0
    return found.st_ino, found.st_size, found.st_mtime_ns


def read_tail(path: Path, root: Path) -> str:
    """Return the last lines of a text file; empty if the file is missing or outside of a folder.

    The file must lie inside ``root`` after links are resolved.
    """
    resolved = path.resolve()
    if root not in resolved.parents:
        return ""
    try:
        with resolved.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - _LOG_TAIL_BYTES))
            text = file.read(_LOG_TAIL_BYTES).decode("utf-8", "replace")
    except OSError:
        return ""
    return text if size <= _LOG_TAIL_BYTES else text.partition("\n")[2]
