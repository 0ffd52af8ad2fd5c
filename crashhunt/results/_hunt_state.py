"""The state of a hunt, which any process can read from its directory at any time."""

from __future__ import annotations

import json
import math
import os
import socket
import time
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypedDict

from crashhunt.base import layout
from crashhunt.base.codec import OMIT_DEFAULT, JsonObject, Serializable, written_if
from crashhunt.base.errors import HuntDirectoryError
from crashhunt.base.process_owners import owner_in, start_time, this_process
from crashhunt.base.text import command_line, near_path
from crashhunt.crashes import Note, crash_folders, read_notes
from crashhunt.ledger import KindData, Ledger, RunningRate, damaged, has_begun
from crashhunt.results._code_versions import count_versions
from crashhunt.results._found_crashes import outcomes_of_crashes, tally_crashes
from crashhunt.trial import Outcome

if TYPE_CHECKING:
    from crashhunt.ledger import Facts, HuntOwner
    from crashhunt.plans import HuntSettings


# What has come of the copies of a hunt's trials so far, as its ledger sums it up.

PROBES, BRANCHES, RARE = "probes", "branches", "rare"


class ProbeSums(TypedDict):
    """The results of the robustness probes of a hunt in ``status --json``."""

    trials: int  # number of trials in which all probes have a result
    not_fully_asked: int  # number of further trials in which a probe has no result
    # the smallest robustness margin of the trials in which all probes have a result; None if there is no such trial
    least: float | None
    trial: int | None  # the number of the trial with the smallest margin; None if there is no such trial
    probes: int  # number of probes
    steps: int  # number of simulated steps of the forks
    left_out: int  # number of probes that were skipped because the forks had used up their steps
    crashed_trials: int  # number of trials without a crash in which a probe crashed
    # number of the mildest crashing disturbances that were run from the start; None before these runs
    run_again: int | None
    confirmed: int | None  # number of these runs that crashed


class BranchSums(TypedDict):
    """The results of the branches of a hunt in ``status --json``, with fields as in `ProbeSums`."""

    trials: int  # number of trials in which branches were possible
    moments: int  # number of steps after which forks continued
    branches: int  # number of branches
    steps: int  # number of simulated steps of the forks
    left_out: int  # number of branches that were skipped because the forks had used up their steps
    crashed: int  # number of branches that crashed
    crashed_trials: int  # number of trials with a crashed branch
    not_fully_asked: int  # number of trials in which a branch has no result
    # number of the likeliest crashed branches that were run from the start; None before these runs
    run_again: int | None
    confirmed: int | None  # number of these runs that crashed


def copies_to_come(settings: HuntSettings) -> list[str] | None:
    """Return the kinds of forks that a hunt's trials have: probes, branches or both; None for neither."""
    every = ((PROBES, settings.probe), (BRANCHES, settings.branch), (RARE, settings.rare))
    return [name for name, wanted in every if wanted] or None


def sums_of_probes(ledger: Ledger, facts: Facts) -> ProbeSums | None:
    """Return the present results of the probes of a hunt; None if it has no probes."""
    if PROBES not in (facts.get("copies") or ()):
        return None
    (row,) = ledger.summed(
        # Of a query with one min(), SQLite takes what stands bare from the row that has it.
        "count(margin), min(margin), number, total(probes), total(steps), total(left_out), total(crashed), "
        "count(probes)",
        "SELECT number, {stress.margin} AS margin, {stress.probes} AS probes, {stress.steps} AS steps, "
        "{stress.left_out} AS left_out, {stress.disturbance} IS NOT NULL AS crashed",
    )
    trials, least, trial, probes, steps, left_out, crashed, asked = row
    again, confirmed = _verified_counts(facts, PROBES)
    return {
        "trials": trials, "not_fully_asked": asked - trials, "least": least, "trial": trial if trials else None,
        "probes": int(probes), "steps": int(steps), "left_out": int(left_out), "crashed_trials": int(crashed),
        "run_again": again, "confirmed": confirmed,
    }  # fmt: skip


def sums_of_branches(ledger: Ledger, facts: Facts) -> BranchSums | None:
    """Return the present results of the branches of a hunt; None if it has no branches."""
    if BRANCHES not in (facts.get("copies") or ()):
        return None
    (row,) = ledger.summed(
        "count(asked), total(moments), total(asked), total(steps), total(left_out), total(crashed), total(crashed > "
        "0), total(unanswered > 0)",
        "SELECT {branches.moments} AS moments, {branches.asked} AS asked, {branches.steps} AS steps, "
        "{branches.left_out} AS left_out, {branches.unanswered} AS unanswered, json_array_length(data, "
        "'$.branches.crashes') AS crashed",
    )
    trials, moments, branches, steps, left_out, crashed, crashed_trials, not_fully_asked = map(int, row)
    again, confirmed = _verified_counts(facts, BRANCHES)
    return {
        "trials": trials, "moments": moments, "branches": branches, "steps": steps, "left_out": left_out,
        "crashed": crashed, "crashed_trials": crashed_trials, "not_fully_asked": not_fully_asked,
        "run_again": again, "confirmed": confirmed,
    }  # fmt: skip


def _verified_counts(facts: Facts, name: str) -> tuple[int | None, int | None]:
    """Return the number of fork crashes that were run from the start, and how many of these runs crashed."""
    found = None if facts.get("state") == "running" else (facts.get("confirmed") or {}).get(name)  # of an earlier run
    return (found[0], found[1]) if found else (None, None)


State = Literal["queued", "running", "finished", "crashed", "error", "interrupted", "killed"]

_HUNT_FILES = (layout.LEDGER, layout.REQUEST, layout.HUNT)  # of a hunt, or of one that is planned
_MAX_DEPTH = 2  # of hunts below the directory of a suite
HEARTBEAT_S = 1.0  # every so often a hunt says in its ledger that it is alive
_HEARTBEAT_DELAY_S = 20.0  # how much later than its last heartbeat a running hunt may be
_SILENCE_S = 60.0  # without a heartbeat, the owner on another machine counts as dead
_STATE_BY_REASON: dict[str, State] = {
    "crash": "crashed", "distinct": "crashed", "all_trials": "finished", "no_valid_trial": "error",
    "rate": "finished", "interrupted": "interrupted", "time": "finished", "precise": "finished",
    "error": "error", "queued": "queued",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class HuntState(Serializable):
    """The state of a hunt."""

    dir: str  # directory of the hunt
    # the state of the hunt: ``queued``, ``running``, ``finished`` (no crash), ``crashed`` (a crash was found),
    # ``error``, ``interrupted`` or ``killed`` (its process ended without recording a reason)
    state: State
    detail: str = ""  # the reason of an error
    trials_planned: int = 0  # number of planned trials; 0 if only the time is limited
    trials_run: int = 0  # number of finished trials
    outcomes: dict[str, int] = field(default_factory=dict)  # number of trials with each outcome
    crashes: int = 0  # number of crashes, with or without a bundle
    errors: int = 0  # number of trials that could not be set up, or ended in a software fault
    rate_per_s: float = 0.0  # trials per second in the last run of the hunt
    # expected time to the last trial, to the time limit, or to the end of the phase, in s; None if unknown
    seconds_left: float | None = None
    owner_alive: bool = False  # whether the process of the hunt is running
    damaged: bool = False  # whether the ledger of the hunt cannot be read, so that the counts are meaningless
    # number of crashes with a bundle, if ``--keep`` has deleted some bundles; else None
    crashes_saved: int | None = field(default=None, metadata=OMIT_DEFAULT)
    # phase of the hunt after its last trial: fields of `PhaseStatus` without the time; None before these phases, and if
    # the hunt is not running
    phase: dict[str, Any] | None = field(default=None, metadata=OMIT_DEFAULT)
    # number of crashes with disturbances; None if the hunt has no disturbances
    disturbed: int | None = field(default=None, metadata=OMIT_DEFAULT)
    # whether the simulator's compiled core is used; None if the simulator has none
    core: str | None = field(default=None, metadata=OMIT_DEFAULT)
    # what trials test otherwise than the user's files say, such as demand that the simulator omits; None if there is
    # nothing
    notices: list[str] | None = field(default=None, metadata=OMIT_DEFAULT)
    # the machines of the hunt's last run, with the fields of `NodeFigures`; None if it used only this machine
    nodes: list[dict[str, Any]] | None = field(default=None, metadata=OMIT_DEFAULT)
    # crash types, the most frequent first, with the fields of `KindData`; None if the hunt ends at its first crash
    kinds: list[KindData] | None = field(default=None, metadata=OMIT_DEFAULT)
    # time from the last new crash type until now, or until the last trial ended, in s; None if it is unknown
    newest_kind_s: float | None = field(default=None, metadata=written_if(lambda state: state.kinds is not None))
    # number of crash types by cause; None without ``--by-cause``
    types_by_cause: int | None = field(default=None, metadata=OMIT_DEFAULT)
    # present results of the probes; None if the hunt has no probes
    probes: ProbeSums | None = field(default=None, metadata=OMIT_DEFAULT)
    # present results of the branches; None if the hunt has no branches
    branches: BranchSums | None = field(default=None, metadata=OMIT_DEFAULT)
    # the crash rate at the hunt's last heartbeat, with the fields of `RunningRate`; None if it is unknown
    rate: RunningRate | None = field(default=None, metadata=OMIT_DEFAULT)
    # the trials of each version of the code, with the fields of `VersionCounts`; None if all trials ran with the same
    # code. Crash types and rate are those of the newest version.
    code_versions: list[dict[str, Any]] | None = field(default=None, metadata=OMIT_DEFAULT)
    # notes and tags of users on the hunt and on its crashes; None if there are none
    notes: list[Note] | None = field(default=None, metadata=OMIT_DEFAULT)

    @property
    def failed(self) -> bool:
        """Whether the hunt ended without completing its work."""
        return self.state in ("error", "interrupted", "killed")


def is_hunt(directory: Path) -> bool:
    """Return whether a directory contains a hunt or a planned hunt."""
    return any((directory / name).exists() for name in _HUNT_FILES)


def _explain_missing(directory: Path, what: str) -> HuntDirectoryError:
    is_file = directory.exists()
    near = "" if is_file else near_path(directory, with_file=_HUNT_FILES)
    wrong = "is a file" if is_file else "does not exist"
    return HuntDirectoryError(f"{str(directory)!r} {wrong}", fix=f"{near}give the directory of {what}")


def find_hunts(directory: Path) -> list[Path]:
    """Return the directories of hunts: the given directory itself, or those below it.

    Raises:
        HuntDirectoryError: the directory contains no hunt.
    """
    if not directory.is_dir():
        raise _explain_missing(directory, "a hunt or a suite")
    if is_hunt(directory):
        return [directory]
    found: set[Path] = set()
    for depth in range(1, _MAX_DEPTH + 1):
        for name in _HUNT_FILES:
            for sign in directory.glob(f"{'*/' * depth}{name}"):
                parts = sign.relative_to(directory).parts
                if not any(part.startswith(".") or layout.REPLACED in part for part in parts):
                    found.add(sign.parent)
    if not found:
        raise HuntDirectoryError(
            f"there is no hunt in {str(directory)!r}", fix="give a directory that crashhunt run or suite run made"
        )
    return sorted(found, key=_ordered_states)


def is_case(directory: Path) -> bool:
    """Return whether a directory is a case of a corpus, which has the layout of a hunt without a ledger."""
    return (Path(directory) / layout.CASE).exists()


def find_searches(directory: Path) -> list[Path]:
    """Return the directories of hunts as `find_hunts` does, without the cases of a corpus.

    Raises:
        HuntDirectoryError: the directory contains no hunt.
    """
    found = find_hunts(directory)
    hunts = [hunt for hunt in found if not is_case(hunt)]
    if not hunts:
        raise HuntDirectoryError(
            f"{str(directory)!r} has cases of a corpus, but no hunt",
            fix=f"run {command_line('crashhunt', 'corpus', 'list', directory)}, or give the directory of a hunt",
        )
    return hunts


def hunt_state(directory: Path) -> HuntState:
    """Return the state of a hunt, read from its directory.

    Raises:
        HuntDirectoryError: the directory contains no hunt.
    """
    return replace(_hunt_state(directory), notes=list(read_notes(directory)) or None)


def _hunt_state(directory: Path) -> HuntState:
    if not has_begun(directory / layout.LEDGER) and is_hunt(directory):
        if any((directory / layout.SNAPSHOTS).glob(layout.SHOWN)):  # which comes after the ledger
            gone = damaged(directory / layout.LEDGER, "it is missing, or empty")
            return HuntState(str(directory), "error", str(gone), damaged=True)
        return HuntState(str(directory), "queued", trials_planned=_planned(directory / layout.REQUEST))
    if not directory.is_dir():
        raise _explain_missing(directory, "a hunt")
    try:
        with closing(Ledger(directory / layout.LEDGER)) as ledger:
            facts, outcomes, last = ledger.facts(), ledger.outcomes(), ledger.last_ended_at()
            found = _with_crashes(state_of_facts(directory, facts, outcomes, last), ledger, facts)
            return replace(found, probes=sums_of_probes(ledger, facts), branches=sums_of_branches(ledger, facts))
    except HuntDirectoryError as error:
        if not (directory / layout.LEDGER).exists():
            raise
        # One that cannot be read hides no other.
        return HuntState(str(directory), "error", str(error).removeprefix(f"{directory}/"), damaged=True)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:  # facts of an early ledger
        wrong = damaged(directory / layout.LEDGER, f"a fact cannot be read: {type(error).__name__}: {error}")
        return HuntState(str(directory), "error", str(wrong), damaged=True)


def state_of_facts(directory: Path, facts: Facts, outcomes: dict[str, int], last: float | None) -> HuntState:
    """Return the state of a hunt from the facts in its ledger, without its crashes and the results of forks.

    ``last`` is the time at which the last trial ended, in s since the epoch; None if no trial has ended.
    """
    said = facts.get("state", "queued")
    owner = facts.get("owner")
    alive = owner is not None and _is_alive(owner, facts.get("heartbeat", 0.0))
    state: State = ("running" if alive else "killed") if said == "running" else _STATE_BY_REASON.get(said, "error")
    run = sum(outcomes.values())
    planned = int(facts.get("planned", 0))
    here = run - int(facts.get("done_before", 0))
    # The clocks of a hunt stand still after its last trial.
    until = time.time() if state == "running" and not facts.get("phase") else last
    lasted, newest = _duration_s(facts, until), facts.get("newest_kind")
    rate = here / lasted if lasted > 0 and here > 0 else 0.0
    return HuntState(
        dir=str(directory),
        state=state,
        detail=str(facts.get("detail") or ("its process is gone" if state == "killed" else "")),
        trials_planned=planned,
        trials_run=run,
        outcomes=outcomes,
        errors=sum(n for name, n in outcomes.items() if name == Outcome.INVALID or Outcome(name).is_software_fault),
        rate_per_s=rate,
        seconds_left=_seconds_left(facts, max(0, planned - run), rate) if state == "running" else None,
        phase=_phase(facts) if state == "running" else None,
        owner_alive=alive,
        core=facts.get("core"),
        notices=facts.get("notices"),
        nodes=facts.get("nodes"),
        kinds=facts.get("kinds"),
        types_by_cause=facts.get("types_by_cause"),
        rate=facts.get("running_rate"),
        newest_kind_s=None if newest is None or until is None else max(0.0, until - newest),
    )


def _duration_s(facts: Facts, until: float | None) -> float:
    """Return how long the last run of a hunt lasted up to a time, in s; 0 if that is unknown.

    If the system's clock was set or the machine was suspended, the hunt's own measurement counts. ``until`` is in s
    since the epoch.
    """
    began, measured = facts.get("began"), facts.get("elapsed_s")
    if began is None or until is None:  # such as in a copy that `check --salvage` has made
        return 0.0
    by_clock = until - began
    if measured is not None and not 0.0 <= by_clock <= measured + _HEARTBEAT_DELAY_S:
        return measured
    return by_clock


def _phase(facts: Facts) -> JsonObject | None:
    """Return the phase of a running hunt after its last trial."""
    phase = facts.get("phase")
    return {name: phase[name] for name in ("name", "done", "total")} if phase else None


def _seconds_left(facts: Facts, trials: int, rate: float) -> float | None:
    """Return the time until the last trial or the time limit; after that, the time until the end of the phase."""
    if phase := facts.get("phase"):
        left: float | None = phase["seconds_left"]
        return None if left is None else max(0.0, left - (time.time() - facts.get("heartbeat", time.time())))
    if (ends_at := facts.get("ends_at")) is not None:
        return max(0.0, ends_at - time.time())
    until = facts.get("until")
    by_clock = math.inf if until is None else max(0.0, until - time.time())
    by_count = trials / rate if rate > 0 and facts.get("planned") else math.inf
    left = min(by_clock, by_count)
    return left if left < math.inf else None


def _with_crashes(state: HuntState, ledger: Ledger, facts: Facts) -> HuntState:
    """Return the state with the counts of crashes over all trials."""
    directory = Path(state.dir)
    disturbs = bool(facts.get("disturb"))
    outcomes = outcomes_of_crashes(directory, facts)
    tally = None if outcomes is None else tally_crashes(ledger, outcomes, disturbed=disturbs)
    return replace(
        with_crash_counts(state, facts, 0 if tally is None else tally.found),
        disturbed=tally.disturbed if tally is not None and disturbs else None,
        code_versions=[asdict(one) for one in count_versions(ledger, facts, outcomes or ())] or None,
    )


def with_crash_counts(state: HuntState, facts: Facts, counted: int) -> HuntState:
    """Return a state with the numbers of crashes and of their bundles.

    ``counted`` is the number of crashed trials in the ledger.
    """
    saved = len(crash_folders(Path(state.dir)))
    dropped = sum(len(numbers) for numbers in (facts.get("dropped") or {}).values())
    found = max(saved + dropped, counted)  # a bundle is written before its row
    is_crashed = state.state == "finished" and found > 0
    return replace(
        state,
        state="crashed" if is_crashed else state.state,
        crashes=found,
        crashes_saved=saved if saved < found else None,
    )


def draws_independently(facts: Facts, settings: HuntSettings) -> bool:
    """Return whether every trial of a hunt was drawn independently of the others, as recorded by the hunt.

    Trials in the same traffic are not independent. In early ledgers without this fact, only the sampler `random` counts
    as independent.
    """
    return bool(facts.get("independent", settings.sampler == "random")) and not settings.seeds


def ledger_owner() -> HuntOwner:
    """Return a description that identifies this process, so that others can check whether it is still running."""
    pid = os.getpid()
    return {"host": socket.gethostname(), "pid": pid, "started": start_time(pid), "token": this_process().token}


def trials_of_running(directory: Path) -> int | None:
    """Return the number of finished trials of a hunt; None if the hunt is not running."""
    if not has_begun(directory / layout.LEDGER):
        return None
    try:
        with closing(Ledger(directory / layout.LEDGER)) as ledger:
            facts = ledger.facts()
            owner = facts.get("owner")
            alive = owner is not None and _is_alive(owner, facts.get("heartbeat", 0.0))
            return sum(ledger.outcomes().values()) if alive and facts.get("state") == "running" else None
    except HuntDirectoryError:
        return None


def _planned(request: Path) -> int:
    try:
        return int(json.loads(request.read_text(encoding="utf-8"))["request"]["trials"])
    except (OSError, ValueError, KeyError, TypeError):
        return 0


def _is_alive(owner: HuntOwner, heartbeat: float) -> bool:
    # Two containers may have one host name, and process ids of their own.
    known, here = owner_in(owner.get("token", "")), this_process()
    is_here = known is None or (known.boot, known.namespace) == (here.boot, here.namespace)
    if owner["host"] != socket.gethostname() or not is_here:
        return time.time() - heartbeat < _SILENCE_S
    return start_time(owner["pid"]) == owner["started"]  # a process id is given to another one some day


def _ordered_states(path: Path) -> tuple[tuple[int, int, str], ...]:
    """Return the sort key of folders of runs, which sorts by number: 2 before 10."""
    return tuple((0, int(part), "") if part.isdecimal() else (1, 0, part) for part in path.parts)
