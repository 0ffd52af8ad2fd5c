"""The progress of a running hunt: a status screen on a terminal, otherwise a plain line every 5 s."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Self

from rich.console import Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from crashhunt.base.text import count_of, format_percent, one_line, out_of
from crashhunt.recording import Phase
from crashhunt.report._argument_words import format_arguments
from crashhunt.report._rate_text import describe_running
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import TracebackType

    from rich.console import Console, RenderableType

    from crashhunt.hunts import HuntStatus, PhaseStatus, SearchStatus
    from crashhunt.trial import TrialResult

_LINE_EVERY_S = 5.0  # where lines cannot be overwritten, such as in a CI log
_MIN_SCREEN_LINES = 16  # lines; on a lower screen, workers need the space
_LINES_BELOW_TYPES = 6  # lines; for the search, the nearest miss and the like
_MIN_TYPE_LINES = 2  # lines
_MIN_BAR_COLUMNS = 8  # columns; a shorter bar is unreadable, and the words need the space
_STYLES = {
    "traffic crash": "bold red",
    "traffic event": "bold yellow",
    "software fault": "bold magenta",
    "no crash": "green",
}


class Watcher:
    """Shows the progress of a running hunt.

    Args:
        console: where to print: a terminal shows the status screen, any other console plain lines.
        title: first line of the screen.
        notes: lines to print before the first status, once the hunt can no longer be refused.
    """

    def __init__(self, console: Console, title: str, notes: Sequence[str] = ()) -> None:
        self._console = console
        self._notes = notes
        self._title = one_line(title)
        self._last_line = -math.inf
        self._last_progress: tuple[str, int, int] | None = None
        # Rich's own refresh needs a thread, and with a thread this process could not be forked (`base/isolation.py`).
        self._live = Live(console=console, auto_refresh=False, transient=True) if console.is_terminal else None

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def __call__(self, status: HuntStatus) -> None:
        """Show a status of the hunt."""
        self.tell_notes()
        if self._live is not None:
            self._live.update(self._screen(status), refresh=True)
        elif self._is_line_due(status):
            self._last_line, self._last_progress = time.monotonic(), _progress(status)
            self._console.print(_line(status), soft_wrap=True, highlight=False)

    def _is_line_due(self, status: HuntStatus) -> bool:
        """Return whether a plain line is printed now; a phase with its own progress prints no count twice."""
        if status.progress is not None:
            if _progress(status) == self._last_progress:
                return False
            if self._last_progress is None or status.progress.name != self._last_progress[0]:
                return True
        return time.monotonic() - self._last_line >= _LINE_EVERY_S

    def tell_notes(self) -> None:
        """Print the notes, only once."""
        for note in self._notes:
            self._console.print(one_line(note), markup=False, soft_wrap=True, highlight=False)
        self._notes = ()

    def _screen(self, status: HuntStatus) -> RenderableType:
        """Return title, progress and outcomes, then as many other lines as fit, beginning with the workers."""
        width, height = self._console.size
        rows: list[RenderableType] = [self._head(status, width), _bar(status, width)]
        outcomes = Text("  ").join(
            Text(f"{name} {count}", style=_STYLES[Outcome(name).category] if name != Outcome.INVALID else "yellow")
            for name, count in sorted(status.outcomes.items())
        )
        if status.disturbed is not None and status.crashes:
            outcomes += Text(f"   {_disturbed(status)}")
        if status.steps:
            outcomes += Text(f"   {status.steps:,} steps simulated", style="dim")
        rows.append(outcomes or Text("no trial has finished", style="dim"))
        if status.rate is not None and status.done:
            rows.append(self._folded(Text(describe_running(status.rate))))
        if status.kinds:
            rows += self._types(status, height - 1 - len(rows) - len(status.workers) - _LINES_BELOW_TYPES)
        # A terminal shows nothing below its last line, and the cursor needs that line.
        left = height - 1 - len(self._console.render_lines(Group(*rows)))
        if status.search.strategies and len(status.workers) < left:
            tried = self._folded(Text(one_line(_strategies(status.search))))
            if len(self._console.render_lines(tried)) + len(status.workers) > left:
                tried = Text(tried.plain, no_wrap=True, overflow="ellipsis")
            left -= len(self._console.render_lines(tried))
            rows.append(tried)
        if status.nearest is not None:
            near = Text(
                one_line(f"nearest miss{_describe_growth(status.search)}: {_nearest_words(status.nearest)}"),
                overflow="fold",
            )
            if len(self._console.render_lines(near)) + len(status.workers) > left:
                near = Text(near.plain, no_wrap=True, overflow="ellipsis")
            left -= len(self._console.render_lines(near))
            rows.append(near)
        if status.stressed is not None and len(status.workers) < left:
            rows.append(Text(one_line(_describe_stress(status.stressed)), no_wrap=True, overflow="ellipsis"))
            left -= 1
        if status.not_fully_asked and len(status.workers) < left:
            count = status.not_fully_asked
            text = f"{count} {'trial was' if count == 1 else 'trials were'} not fully probed: copies of them died"
            rows.append(Text(text, no_wrap=True, overflow="ellipsis"))
            left -= 1
        if status.branched and len(status.workers) < left:
            rows.append(Text(f"crashes of branches: {status.branched}", no_wrap=True, overflow="ellipsis"))
            left -= 1
        nodes = _nodes(status, max(1, left // 2))
        return Group(*rows, *nodes, _workers(status, width, max(1, left - len(nodes))))

    def _types(self, status: HuntStatus, room: int) -> list[RenderableType]:
        """Return the crash types, one line each if there is room for more than one; otherwise together."""
        each = [one_line(f"{kind.signature} ({kind.count})") for kind in status.kinds or ()]
        if room <= _MIN_TYPE_LINES:
            return [self._folded(Text(f"{describe_kinds(status)}: ") + Text("; ".join(each), "dim"))]
        if len(each) > room - 1:
            each = [*each[: room - 2], f"and {len(each) - room + 2} more types"]
        lines: list[RenderableType] = [Text(f"  {line}", "dim", no_wrap=True, overflow="ellipsis") for line in each]
        return [self._folded(Text(f"{describe_kinds(status)}:")), *lines]

    def _folded(self, text: Text) -> Text:
        """Return a text in at most two lines; on a low screen, or if it is longer, it is cut to one line."""
        folds = self._console.height > _MIN_SCREEN_LINES and len(self._console.render_lines(text)) <= 2
        return text if folds else Text(text.plain, no_wrap=True, overflow="ellipsis")

    def _head(self, status: HuntStatus, width: int) -> Text:
        phase = _PHASES.get(status.phase, status.phase)  # such as "confirming near misses", as the next line says
        phase = "confirming" if phase.startswith("confirming") else phase
        now = f"   {phase}   {format_seconds(status.elapsed_s)}"
        title = Text(self._title, "bold")
        title.truncate(max(1, width - len(now)), overflow="ellipsis")
        return Text.assemble(title, now, no_wrap=True)


def _bar(status: HuntStatus, width: int) -> RenderableType:
    said: tuple[str, ...] = (
        f"{_count(status)} trials", format_pace(status.rate_per_s), f"{format_seconds(status.seconds_left)} left",
    )  # fmt: skip
    share, phase = status.share_done, status.progress
    if phase is not None:
        said, share = (describe_phase(phase.name, phase.done, phase.total, phase.seconds_left),), _share(phase)
    elif width - sum(len(part) + 2 for part in said) < _MIN_BAR_COLUMNS:
        said = (said[0].removesuffix(" trials"), *said[1:])
    table = Table.grid(padding=(0, 2))
    room = width - sum(len(part) + 2 for part in said)
    bar = ProgressBar(total=1.0, completed=share, width=max(1, min(30, room)))
    table.add_row(bar, *said)
    return table


def _nodes(status: HuntStatus, lines: int) -> list[RenderableType]:
    """Return the connected machines, one line each."""
    if status.nodes is None:
        return []
    if not status.nodes:
        return [Text("no node is connected; the hunt waits", style="yellow")]
    found = [
        "   ".join(
            (
                f"node {one_line(node.name)}",
                f"{node.parallel} at a time",
                f"{node.trials} trials",
                format_pace(node.rate_per_s),
            )
        )
        for node in status.nodes
    ]
    if len(found) > lines:
        found = [*found[: lines - 1], f"and {len(found) - lines + 1} more nodes"]
    return [Text(line, no_wrap=True, overflow="ellipsis") for line in found]


def _workers(status: HuntStatus, width: int, lines: int) -> RenderableType:
    """Return the state of each worker, one line each; on a small screen, one line for several workers."""
    doing = [
        (number, {Phase.SETUP: "setting up", Phase.DONE: "done"}.get(header.phase, f"step {header.step}"))
        for number, header in sorted(status.workers.items())
    ]
    workers = Table.grid(padding=(0, 3))
    if len(doing) <= lines:
        for number, what in doing:
            workers.add_row(f"trial {number}", what)
        return workers
    cells = [f"{number}: {what}" for number, what in doing]
    columns = max(1, (width + 3) // (max(map(len, cells)) + 3))
    most = columns * lines
    if len(cells) > most:
        cells = [*cells[: most - 1], f"and {len(cells) - most + 1} more"]
    for first in range(0, len(cells), columns):
        workers.add_row(*cells[first : first + columns])
    return workers


def format_pace(rate_per_s: float) -> str:
    """Return the pace of a hunt as text: ``4.6/s``, or ``12 s/trial`` below one trial per second."""
    if rate_per_s >= 0.95:
        return f"{rate_per_s:.1f}/s"
    if not rate_per_s:
        return "-/s"
    seconds = 1.0 / rate_per_s
    return f"{seconds:.1f} s/trial" if seconds < 9.95 else f"{seconds:.0f} s/trial"


_PHASES = {
    "hunting": "running",
    "confirming": "confirming",
    "auditing": "auditing",
    "waiting": "waiting for another program that has locked ledger.sqlite",
    "causes": "finding causes",
    "near misses": "confirming near misses",
    "probes": "confirming crashes of probes",
    "branches": "confirming crashes of branches",
    "rare crashes": "confirming rare crashes",
}


def describe_phase(name: str, done: int, total: int, seconds_left: float | None) -> str:
    """Return the progress of a phase after the last trial, such as ``confirming 24 of 60, 0:40 left``."""
    said = f"{_PHASES.get(name, name)} {done} of {total}"
    return said if seconds_left is None else f"{said}, {format_seconds(seconds_left)} left"


def _share(phase: PhaseStatus) -> float:
    return phase.done / phase.total if phase.total else 1.0


def format_seconds(seconds: float) -> str:
    """Return a duration as text: ``M:SS`` or ``H:MM:SS``."""
    if not math.isfinite(seconds):
        return "?"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def describe_types(count: int, by_cause: int | None, noun: str = "type") -> str:
    """Return as text the number of crash types, and the number of causes if the hunt counts causes.

    >>> describe_types(4, 6)
    '4 types, 6 by cause'
    """
    words = count_of(count, noun)
    return words if by_cause is None else f"{words}, {by_cause} by cause"


def describe_kinds(status: HuntStatus) -> str:
    """Return as text the numbers of crash types and causes, and the age of the last new crash type."""
    words = describe_types(len(status.kinds or ()), status.types_by_cause, "crash type")
    if status.newest_kind_s is None:
        return words
    ago, trials = format_seconds(status.newest_kind_s), status.newest_kind_trials
    if trials is not None:
        ago = f"{count_of(trials, 'trial')} / {ago}"
    return f"{words} (last new type: {ago} ago)"


def _disturbed(status: HuntStatus) -> str:
    return f"{status.disturbed} of {count_of(status.crashes, 'crash')} with disturbances"


def _progress(status: HuntStatus) -> tuple[str, int, int] | None:
    now = status.progress
    return None if now is None else (now.name, now.done, now.total)


def _line(status: HuntStatus) -> str:
    outcomes = ", ".join(f"{name} {count}" for name, count in sorted(status.outcomes.items()))
    if (after := status.progress) is not None and status.phase != "waiting":
        return describe_phase(after.name, after.done, after.total, after.seconds_left)
    phase = _PHASES.get(status.phase, status.phase)
    line = f"{phase}: {out_of(status.done, status.planned)} trials finished" + (f" ({outcomes})" if outcomes else "")
    if status.phase == "hunting" and status.done:
        line += f", {format_pace(status.rate_per_s)}, {format_seconds(status.seconds_left)} left"
    if status.disturbed is not None and status.crashes:
        line += f"; {_disturbed(status)}"
    if status.phase == "hunting" and status.kinds:
        line += f"; {describe_kinds(status)}"
    if status.phase == "hunting" and status.nodes is not None:
        line += f"; connected nodes: {len(status.nodes)}" if status.nodes else "; no node is connected"
    if status.rate is not None and status.done:
        line += f"; {describe_running(status.rate)}"
    return line


def _count(status: HuntStatus) -> str:
    return out_of(status.done, status.planned, "/")


def _describe_stress(result: TrialResult) -> str:
    stress = result.stress
    assert stress is not None
    what = stress.disturbance.words if stress.disturbance is not None else ""
    margin = f"{stress.least:.2f}" if stress.margin is not None else f"at most {stress.least:.2f} ({stress.extent})"
    parts = (f"least robustness margin: {margin}", f"trial {result.spec.number}", what, format_arguments(result))
    return ", ".join(filter(None, parts))


def _strategies(search: SearchStatus) -> str:
    """Return the strategies of the search, with the mean criticality of the trials of each strategy."""
    parts = []
    for one in search.strategies:
        came = [] if one.danger is None else [f"mean criticality {one.danger:.2f}"]
        came += [count_of(one.crashes, "crash")] if one.crashes else []
        parts.append(f"{one.name} {format_percent(one.share)} of trials" + (f" ({', '.join(came)})" if came else ""))
    return f"search: {', '.join(parts)}"


def _describe_growth(search: SearchStatus) -> str:
    """Return as text how long ago the greatest criticality of the hunt rose."""
    if search.grown_trials is None or search.grown_s is None:
        return ""
    return f" ({count_of(search.grown_trials, 'trial')} / {format_seconds(search.grown_s)} ago)"


def _nearest_words(result: TrialResult) -> str:
    closest = result.closest
    if math.isfinite(closest.time_to_collision_s):
        how = f"least TTC {closest.time_to_collision_s:.2f} s"
    else:
        how = "never on a collision course"
    danger = "" if result.danger is None else f"criticality {result.danger:.2f}"
    return ", ".join(filter(None, (f"trial {result.spec.number}", danger, how, format_arguments(result))))
