"""What state a hunt is in, read from its directory by any process at any time."""

from __future__ import annotations

import json
import math
import os
import socket
import time
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from crashhunt.base import layout
from crashhunt.base.errors import HuntDirectoryError
from crashhunt.base.integrity import read_object
from crashhunt.base.names import near_path
from crashhunt.crashes import crash_folders
from crashhunt.hunts._copies import sums_of_branches, sums_of_probes
from crashhunt.hunts._ledger import Ledger, has_begun
from crashhunt.hunts._ledger_file import damaged
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from crashhunt.hunts._copies import BranchSums, ProbeSums
    from crashhunt.hunts._data import Facts, Owner
    from crashhunt.hunts._kinds import KindData
    from crashhunt.plans import HuntSettings

__all__ = [
    "HEARTBEAT_S",
    "HuntState",
    "State",
    "draws_independently",
    "find_hunts",
    "hunt_state",
    "is_hunt",
    "this_process",
]

State = Literal["queued", "running", "finished", "crashed", "error", "interrupted", "killed"]

_SIGNS = (layout.LEDGER, layout.REQUEST, layout.HUNT)  # of a hunt, or of one that is planned
_DEPTH = 2  # of hunts below the directory of a suite
HEARTBEAT_S = 1.0  # every so often a hunt says in its ledger that it is alive
_SILENCE_S = 60.0  # without a heartbeat, the owner on another machine counts as dead
_ENDED: dict[str, State] = {
    "crash": "crashed", "distinct": "crashed", "all_trials": "finished", "no_valid_trial": "error",
    "interrupted": "interrupted", "time": "finished", "error": "error", "queued": "queued",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class HuntState:
    """Where a hunt stands.

    Args:
        dir: its directory.
        state: ``queued``, ``running``, ``finished`` (no crash), ``crashed`` (found one), ``error``, ``interrupted``
            or ``killed`` (its process is gone and did not say why).
        detail: why, where it is an error.
        trials_planned: how many were asked for; 0 where only the time is limited.
        trials_run: how many have ended.
        outcomes: how.
        crashes: how many were saved.
        errors: how many trials could not be set up, or ended in a software fault.
        rate_per_s: trials a second, in its last run.
        seconds_left: to the last trial, at that rate, or until its time is up; None where it does not run.
        owner_alive: whether its process is there.
        damaged: whether its ledger cannot be read, so that the counts say nothing.
        disturbed: how many of the crashes had disturbances; None where the hunt has none.
        probes: what came of them so far; None where it has none.
        branches: likewise.
        core: whether the simulator's compiled core is used; None where it has none.
        nodes: the machines on which it runs, or ran last: fields of `NodeFigures`; None where it was this one only.
        kinds: of crashes, the most frequent first: fields of `KindData`; None where the first crash ends the hunt.
        newest_kind_s: how long ago the last new one came, in s; None where nobody knows.
    """

    dir: str
    state: State
    detail: str = ""
    trials_planned: int = 0
    trials_run: int = 0
    outcomes: dict[str, int] = field(default_factory=dict)
    crashes: int = 0
    errors: int = 0
    rate_per_s: float = 0.0
    seconds_left: float | None = None
    owner_alive: bool = False
    damaged: bool = False
    disturbed: int | None = None
    core: str | None = None
    nodes: list[dict[str, Any]] | None = None
    kinds: list[KindData] | None = None
    newest_kind_s: float | None = None
    probes: ProbeSums | None = None
    branches: BranchSums | None = None

    @property
    def failed(self) -> bool:
        """Whether it ended without having done what was asked."""
        return self.state in ("error", "interrupted", "killed")

    def to_json(self) -> dict[str, object]:
        """Return the shape of one hunt in ``status --json``."""
        data = asdict(self)
        for name in ("disturbed", "core", "nodes", "probes", "branches"):
            if data[name] is None:
                del data[name]
        if self.kinds is None:
            del data["kinds"], data["newest_kind_s"]
        return data


def is_hunt(directory: Path) -> bool:
    """Whether a directory is that of a hunt, or of one that is planned."""
    return any((directory / name).exists() for name in _SIGNS)


def find_hunts(directory: Path) -> list[Path]:
    """Return the directories of hunts: this one, or those below it.

    Raises:
        HuntDirectoryError: there is none.
    """
    if not directory.is_dir():
        fix = f"{near_path(directory)}give the directory of a hunt or a suite"
        raise HuntDirectoryError(f"{str(directory)!r} does not exist", fix=fix)
    if is_hunt(directory):
        return [directory]
    found: set[Path] = set()
    for depth in range(1, _DEPTH + 1):
        for name in _SIGNS:
            for sign in directory.glob(f"{'*/' * depth}{name}"):
                parts = sign.relative_to(directory).parts
                if not any(part.startswith(".") or layout.REPLACED in part for part in parts):
                    found.add(sign.parent)
    if not found:
        raise HuntDirectoryError(
            f"there is no hunt in {str(directory)!r}", fix="give a directory that crashhunt run or suite run made"
        )
    return sorted(found, key=_in_order)


def hunt_state(directory: Path) -> HuntState:
    """Return the state of a hunt.

    Raises:
        HuntDirectoryError: it is not the directory of a hunt.
    """
    if not has_begun(directory / layout.LEDGER) and is_hunt(directory):
        if any((directory / layout.SNAPSHOTS).glob(layout.SHOWN)):  # which comes after the ledger
            gone = damaged(directory / layout.LEDGER, "it is missing, or empty")
            return HuntState(str(directory), "error", str(gone), damaged=True)
        return HuntState(str(directory), "queued", trials_planned=_planned(directory / layout.REQUEST))
    if not directory.is_dir():
        fix = f"{near_path(directory)}give the directory of a hunt"
        raise HuntDirectoryError(f"{str(directory)!r} does not exist", fix=fix)
    try:
        with closing(Ledger(directory / layout.LEDGER)) as ledger:
            facts, outcomes, last = ledger.facts(), ledger.outcomes(), ledger.last_ended_at()
            found = _state(directory, facts, outcomes, last)
            return replace(found, probes=sums_of_probes(ledger, facts), branches=sums_of_branches(ledger, facts))
    except HuntDirectoryError as error:
        if not (directory / layout.LEDGER).exists():
            raise
        # One that cannot be read hides no other.
        return HuntState(str(directory), "error", str(error), damaged=True)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:  # facts of an early ledger
        wrong = damaged(directory / layout.LEDGER, f"a fact cannot be read: {type(error).__name__}: {error}")
        return HuntState(str(directory), "error", str(wrong), damaged=True)


def _state(directory: Path, facts: Facts, outcomes: dict[str, int], last: float | None) -> HuntState:
    said = facts.get("state", "queued")
    owner = facts.get("owner")
    alive = owner is not None and _is_alive(owner, facts.get("heartbeat", 0.0))
    crashes = len(crash_folders(directory))
    state: State = ("running" if alive else "killed") if said == "running" else _ENDED.get(said, "error")
    if state == "finished" and crashes:
        state = "crashed"
    run = sum(outcomes.values())
    planned, began = int(facts.get("planned", 0)), float(facts.get("began", 0.0))
    until = time.time() if state == "running" else (last or began)
    here = run - int(facts.get("done_before", 0))
    rate = here / (until - began) if until > began and here > 0 else 0.0
    return HuntState(
        str(directory),
        state,
        "its process is gone" if state == "killed" else str(facts.get("detail") or ""),
        planned,
        run,
        outcomes,
        crashes,
        sum(n for name, n in outcomes.items() if name == Outcome.INVALID or Outcome(name).is_software_fault),
        rate,
        _seconds_left(facts, planned - run, rate) if state == "running" else None,
        alive,
        disturbed=_disturbed(directory) if facts.get("disturb") else None,
        core=facts.get("core"),
        nodes=facts.get("nodes"),
        kinds=facts.get("kinds"),
        newest_kind_s=max(0.0, time.time() - newest) if (newest := facts.get("newest_kind")) is not None else None,
    )


def _seconds_left(facts: Facts, trials: int, rate: float) -> float | None:
    """Until the last trial, at that rate, or until the time is up, whichever is first."""
    until = facts.get("until")
    by_clock = math.inf if until is None else max(0.0, until - time.time())
    by_count = trials / rate if rate > 0 and facts.get("planned") else math.inf
    left = min(by_clock, by_count)
    return left if left < math.inf else None


def _disturbed(directory: Path) -> int:
    """How many crashes had disturbances; one that cannot be read is left to whoever reads it."""
    count = 0
    for path in (directory / layout.CRASHES).glob(f"{layout.SHOWN}/{layout.CRASH}"):
        with suppress(OSError, ValueError):
            count += read_object(path, dict[str, object]).get("disturbed") is True
    return count


def draws_independently(facts: Facts, settings: HuntSettings) -> bool:
    """Whether every trial of a hunt was drawn independently of the others, as its sampler said when it ran.

    Trials in the same traffic are not.

    Args:
        facts: of its ledger.
        settings: of the hunt; before samplers said it, of ours the random one did.
    """
    return bool(facts.get("independent", settings.sampler == "random")) and not settings.seeds


def this_process() -> Owner:
    """Return what tells this process from every other, so that anybody can see later whether it is still there."""
    return {"host": socket.gethostname(), "pid": os.getpid(), "started": _started(os.getpid())}


def _planned(request: Path) -> int:
    try:
        return int(json.loads(request.read_text(encoding="utf-8"))["request"]["trials"])
    except (OSError, ValueError, KeyError, TypeError):
        return 0


def _is_alive(owner: Owner, heartbeat: float) -> bool:
    if owner["host"] != socket.gethostname():
        return time.time() - heartbeat < _SILENCE_S
    return bool(_started(owner["pid"]) == owner["started"])  # a process id is given to another one some day


def _started(pid: int) -> int:
    """When a process began, in ticks since the machine did; 0 where it is not there, -1 where nobody can say."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
    except OSError:
        if Path("/proc/self/stat").exists():
            return 0
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return 0
        except PermissionError:
            pass
        return -1
    return 0 if stat[0] == "Z" else int(stat[19])


def _in_order(path: Path) -> tuple[tuple[int, int, str], ...]:
    """Runs by number: 2 before 10."""
    return tuple((0, int(part), "") if part.isdecimal() else (1, 0, part) for part in path.parts)
