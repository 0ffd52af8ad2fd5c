"""Minimization of a crash, from the original crash to the bundle of the minimized crash."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

from crashhunt.analysis._minimization_candidates import Ended, Form, Minimizer
from crashhunt.analysis._minimization_runs import Runs, is_same
from crashhunt.base import layout
from crashhunt.base.codec import Serializable
from crashhunt.base.errors import BundleError, CrashhuntError, UsageError
from crashhunt.base.files import put_in_place, sync_folder
from crashhunt.base.temporary import temporary_beside
from crashhunt.crashes import Bundle, is_bundle_made_here, signature_of, write_bundle
from crashhunt.plans import takes_of
from crashhunt.replays import ReplayOptions, confirm, prepare
from crashhunt.trial import Outcome, Value
from crashhunt.trial_reruns import run_alone

if TYPE_CHECKING:
    from pathlib import Path

    from crashhunt.base.progress import Watch
    from crashhunt.crashes import Signature
    from crashhunt.replays import Rerun
    from crashhunt.trial import TrialSpec

Verdict = Literal["shrunk", "unchanged", "not_reproduced"]
_MAX_CONFIRMATIONS = 3  # of what is left of a flaky crash
_DISK_FIX = "free some space and run the same command again, which reuses the results of finished trials"


@dataclass(frozen=True, slots=True, kw_only=True)
class Shrunk(Serializable):
    """The result of a minimization."""

    bundle: Bundle  # bundle of the original crash
    verdict: Verdict  # whether the crash was minimized, cannot be minimized, or did not reproduce
    ended: Ended  # how the minimization ended
    small: Bundle | None = None  # the minimized crash; None if nothing was removed
    why: str  # the reason for the end, as text
    actors: tuple[int, int]  # number of actors in the scenes before and after the minimization, including agents
    agents: tuple[int, int]  # number of agents in the scenes before and after the minimization
    trials: int  # number of runs
    steps: int  # total number of simulated steps in these runs
    removed: tuple[str, ...] = ()  # the removed actors and disturbances
    # arguments with a new value: old and new value by name
    changed: Mapping[str, tuple[Value | None, Value | None]] = field(default_factory=dict)
    steps_cut: int = 0  # number of steps that were removed from the beginning
    notes: tuple[str, ...]  # notes on possible causes of different results, as text

    json_keys = (
        "crash=bundle.id", "path=small.path", "verdict", "ended", "why", "signature_kept", "confirmed=after.confirmed",
        "actors_before=actors.0", "actors_after=actors.1", "steps_before=bundle.result.steps",
        "steps_after=after.result.steps", "trials_run=trials", "steps_run=steps", "removed", "changed", "scripted",
        "steps_cut", "notes",
    )  # fmt: skip

    @property
    def others(self) -> tuple[int, int]:
        """The number of actors other than the agents, before and after the minimization."""
        (before, after), (agents_before, agents_after) = self.actors, self.agents
        return before - agents_before, after - agents_after

    @property
    def scripted(self) -> tuple[str, ...] | None:
        """The actors that follow recorded paths; None if the other actors drive themselves."""
        script = self.small.result.spec.script if self.small is not None else None
        return None if script is None else script.names

    @property
    def after(self) -> Bundle:
        """The minimized crash; the crash itself if it could not be made smaller."""
        return self.small or self.bundle

    @property
    def signature_kept(self) -> bool:
        """Whether the result has the crash type of the crash."""
        return self.verdict != "not_reproduced"


def shrunk_name(crash: str) -> str:
    """Return the name of the minimized bundle of a crash."""
    return f"{crash}{layout.SMALL}"


def shrink(
    bundle: Bundle,
    *,
    budget: int = 500,
    time_s: float | None = None,
    form: Form = "either",
    parallel: int = 0,
    watch: Watch | None = None,
    stopped: Callable[[], bool] = lambda: False,
    trusted: bool | None = None,
) -> Shrunk:
    """Minimize a crash while its crash type stays the same, and write the minimized crash as a bundle next to it.

    The search removes other actors and disturbances, and simplifies arguments: towards their defaults, or rounder. If
    the crash needs more than a few other actors, these follow their recorded paths. In that form, any path and the
    beginning can be removed. The result depends only on the crash and the budget, unless the time runs out. An
    interrupted search keeps the best result, and the same call resumes the search. The arguments are those of
    `crashhunt.shrink`. The two runs that confirm the result take additional time.

    Raises:
        BundleError: the crash is damaged.
        UntrustedError: the code of the crash is neither made here nor trusted.
        CrashhuntError: no trial can be run, or the bundle cannot be written.
    """
    if bundle.id.endswith(layout.SMALL):
        fix = f"give --crash {bundle.id.removesuffix(layout.SMALL)} to minimize the original crash again"
        raise UsageError(f"{bundle.id!r} is already minimized", fix=fix)
    if bundle.result.outcome in (Outcome.SURVIVED, Outcome.FINISHED):
        raise UsageError(f"{bundle.id!r} is a near miss, not a crash", fix="give a crash")
    if budget < 1:
        raise UsageError(f"the budget is {budget}", fix="give at least 1 trial")
    if time_s is not None and not time_s > 0:
        raise UsageError(f"the time limit is {time_s} s", fix="give more than 0")
    rerun = prepare(bundle, ReplayOptions(trusted=trusted))
    signature = signature_of(bundle)
    memory = bundle.path.with_name(f".{shrunk_name(bundle.id)}.jsonl")
    runs = Runs(
        rerun, signature, memory,
        parallel=parallel or len(os.sched_getaffinity(0)), budget=budget, time_s=time_s,
        stopped=stopped, watch=watch,
    )  # fmt: skip
    with closing(runs):
        search = Minimizer(rerun, runs, form, _constructor_defaults(rerun))
        ended, why = search.run(stopped)
    small = None
    if search.reproduced and search.best != rerun.spec:
        try:
            small = _write_smallest(rerun, search, signature)
        except OSError as error:
            message = f"{shrunk_name(bundle.id)!r} cannot be written: {error.strerror or error}"
            raise BundleError(message, fix=_DISK_FIX, where=str(bundle.path.parent)) from None
        if small is None:
            why = "the minimized trial differs when replayed in a new process"
    found = Shrunk(
        bundle=bundle,
        verdict="unchanged" if search.reproduced or ended != "done" else "not_reproduced",
        ended=ended,
        why=why,
        actors=search.actors(None),
        agents=search.agents(None),
        trials=runs.count,
        steps=runs.steps,
        notes=(*rerun.warnings, *search.notes),
    )
    if small is None:
        return found
    if ended == "done":
        memory.unlink(missing_ok=True)
    return replace(
        found,
        verdict="shrunk",
        small=small,
        actors=search.actors(after := small.recording()),
        agents=search.agents(after),
        removed=search.removed(),
        changed=search.changed(),
        steps_cut=search.steps_cut,
    )


def _constructor_defaults(rerun: Rerun) -> dict[tuple[str, str], Value]:
    """Return the default arguments of the agents' constructors, by agent and name, if they are plain values."""
    found: dict[tuple[str, str], Value] = {}
    for agent, setup in rerun.worker.scenario.agents.items():
        defaults = takes_of(setup.agent, rerun.worker.code).defaults
        found |= {(agent, name): default for name, default in defaults.items()}
    return found


def _write_smallest(rerun: Rerun, search: Minimizer, signature: Signature) -> Bundle | None:
    """Run the smallest candidate in a new process, and write its bundle, which another process then confirms.

    If a candidate does not reproduce, the next larger candidate is run. The result is None if no candidate reproduces.
    Until the confirmation has ended, the bundle has a temporary name: the bundle of an earlier minimization stays.
    """
    bundle = rerun.bundle
    final = bundle.hunt / layout.CRASHES / shrunk_name(bundle.id)
    tries = _MAX_CONFIRMATIONS if bundle.confirmed is False else 1
    for spec in (spec for spec in reversed(search.smaller) for _ in range(tries)):
        search.best = spec
        with temporary_beside(final) as building:
            small = _run_fresh(rerun, search.best, building.name)
            if is_same(signature_of(small), signature, spec):
                shrunk: dict[str, object] = {
                    "of": bundle.id, "removed": list(search.removed()), "changed": _plain(search),
                }  # fmt: skip
                if search.steps_cut:
                    shrunk["steps_cut"] = search.steps_cut
                return _confirm_smallest(replace(small, added={**small.added, "shrunk": shrunk}), final)
    return None


def _confirm_smallest(small: Bundle, final: Path) -> Bundle:
    """Confirm the minimized crash, then move its bundle to its final path."""
    confirmed = confirm(small, trusted=True) or small  # it runs what the whole crash was trusted to run
    placed = replace(confirmed, path=final)
    placed.write(into=small.path)
    put_in_place(small.path, final)
    sync_folder(final.parent)
    return placed


def _run_fresh(rerun: Rerun, spec: TrialSpec, name: str) -> Bundle:
    bundle = rerun.bundle
    for ended in run_alone(rerun.worker, spec):
        result = ended.result
        if result.was_killed_from_outside:
            raise CrashhuntError(f"a trial was {result.summary}", fix="run the same command again", where=bundle.id)
        return write_bundle(
            bundle.hunt, result, ended.folder, hunt_seed=bundle.hunt_seed, snapshot=bundle.snapshot,
            lanes=ended.lanes, name=name, authenticate=is_bundle_made_here(bundle),
        )  # fmt: skip
    raise AssertionError("a run that nothing stops ends")


def _plain(search: Minimizer) -> dict[str, list[Value | None]]:
    return {name: list(values) for name, values in search.changed().items()}
