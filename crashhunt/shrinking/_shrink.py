"""Making a crash smaller: what is taken away in which order, and the bundle of what is left."""

from __future__ import annotations

import os
import shutil
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypedDict

from crashhunt.base import layout
from crashhunt.base.errors import CrashhuntError, UsageError
from crashhunt.crashes import write_bundle
from crashhunt.episode import scratch_of
from crashhunt.executors import FreshProcessExecutor, read_map
from crashhunt.replays import ReplayOptions, confirm, prepare
from crashhunt.shrinking._runs import Runs, StoppedError
from crashhunt.shrinking._search import fewest, plainest
from crashhunt.triage import signature_of
from crashhunt.trial import EVERYBODY, Outcome

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from crashhunt.base.watching import Watch
    from crashhunt.crashes import Bundle
    from crashhunt.recording import Recording
    from crashhunt.replays import Rerun
    from crashhunt.triage import Signature
    from crashhunt.trial import Disturbance, TrialResult, TrialSpec, Value

__all__ = ["Shrunk", "ShrunkData", "shrink", "shrunk_name"]

Verdict = Literal["shrunk", "unchanged", "not_reproduced"]
Ended = Literal["done", "budget", "interrupted", "error"]
_TRIES = 3  # of a crash that does not come again at once
_NEAR = 6  # of the others, so many that are nearest in the end are tried together
_SINGLE = 40  # and so many one by one
_LONGER_S = 5.0  # simulation time by which it may become longer, besides twice as long, where fewer take part


class ShrunkData(TypedDict):
    """What ``shrink --json`` prints."""

    crash: str
    path: str | None
    verdict: Verdict
    ended: Ended
    why: str
    signature_kept: bool
    confirmed: bool | None
    actors_before: int
    actors_after: int
    steps_before: int
    steps_after: int
    trials_run: int
    removed: list[str]
    changed: dict[str, list[Value | None]]


@dataclass(frozen=True, slots=True)
class Shrunk:
    """What came of making a crash smaller.

    Args:
        bundle: the crash.
        verdict: whether it is smaller, or cannot be made so, or did not come again.
        ended: why it was ended.
        small: what is left of it; None where nothing was taken away.
        why: what is to be known about the end, in words.
        actors: how many were seen before and after, the agents with them.
        trials: how many were run.
        removed: who and what was taken away.
        changed: arguments that have another value: name to what it was and what it is.
    """

    bundle: Bundle
    verdict: Verdict
    ended: Ended
    small: Bundle | None = None
    why: str = ""
    actors: tuple[int, int] = (0, 0)
    trials: int = 0
    removed: tuple[str, ...] = ()
    changed: Mapping[str, tuple[Value | None, Value | None]] = field(default_factory=dict)

    def to_json(self) -> ShrunkData:
        """Return the shape that ``shrink --json`` prints."""
        after = self.small or self.bundle
        return {
            "crash": self.bundle.id,
            "path": str(self.small.path) if self.small else None,
            "verdict": self.verdict,
            "ended": self.ended,
            "why": self.why,
            "signature_kept": self.verdict != "not_reproduced",
            "confirmed": after.confirmed,
            "actors_before": self.actors[0],
            "actors_after": self.actors[1],
            "steps_before": self.bundle.result.steps,
            "steps_after": after.result.steps,
            "trials_run": self.trials,
            "removed": list(self.removed),
            "changed": {name: list(values) for name, values in self.changed.items()},
        }


def shrunk_name(crash: str) -> str:
    """Return what the smaller one of a crash is called."""
    return f"{crash}{layout.SMALL}"


def shrink(
    bundle: Bundle,
    *,
    budget: int = 500,
    parallel: int = 0,
    watch: Watch | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> Shrunk:
    """Make a crash smaller while it stays the same kind of crash, and write what is left as a bundle beside it.

    Others are left out, disturbances dropped, and arguments made plainer: towards their defaults, and rounder. The
    result depends on the crash and the budget only. Interrupted, it leaves the best that it has, and the same call goes
    on from there.

    Args:
        bundle: the crash.
        budget: how many trials may be run.
        parallel: how many at a time; 0 for one per core.
        watch: called with how many have been run, and how many may be.
        stopped: asked now and then whether to give up.

    Raises:
        BundleError: the crash is damaged.
        CrashhuntError: no trial can be run, or the bundle cannot be written.
    """
    if bundle.id.endswith(layout.SMALL):
        fix = f"give --crash {bundle.id.removesuffix(layout.SMALL)} to begin anew"
        raise UsageError(f"{bundle.id!r} has been made smaller already", fix=fix)
    if bundle.result.outcome in (Outcome.SURVIVED, Outcome.FINISHED):
        raise UsageError(f"{bundle.id!r} is a near miss, and nothing crashes in it", fix="give a crash")
    if budget < 1:
        raise UsageError(f"the budget is {budget}", fix="give at least 1 trial")
    rerun = prepare(bundle, ReplayOptions())
    signature = signature_of(bundle)
    memory = bundle.path.with_name(f".{shrunk_name(bundle.id)}.jsonl")
    with tempfile.TemporaryDirectory(prefix="crashhunt-shrink-") as folder:
        runs = Runs(
            rerun, signature, Path(folder), memory,
            parallel=parallel or len(os.sched_getaffinity(0)), budget=budget, stopped=stopped, watch=watch,
        )  # fmt: skip
        try:
            search = _Search(rerun, runs)
            ended, why = search.run(stopped)
        finally:
            runs.close()
    small = None
    if search.reproduced and search.best != rerun.spec:
        small = _written(rerun, search, signature)
        if small is None:
            why = "what was left did not do the same in a fresh process"
    if not search.reproduced:
        verdict: Verdict = "unchanged" if ended in ("interrupted", "budget") else "not_reproduced"
        return Shrunk(bundle, verdict, ended, why=why, actors=search.actors(None), trials=runs.count)
    if small is None:
        return Shrunk(bundle, "unchanged", ended, why=why, actors=search.actors(None), trials=runs.count)
    if ended == "done":
        memory.unlink(missing_ok=True)
    return Shrunk(
        bundle, "shrunk", ended, small, why, search.actors(small.recording()), runs.count,
        search.removed(), search.changed(),
    )  # fmt: skip


class _Search:
    """What is tried, and the smallest that still did it."""

    def __init__(self, rerun: Rerun, runs: Runs) -> None:
        self.best = rerun.spec
        self.smaller: list[TrialSpec] = []
        self.reproduced = False
        self._rerun, self._runs = rerun, runs
        self._everybody: tuple[str, ...] = ()

    def run(self, stopped: Callable[[], bool]) -> tuple[Ended, str]:
        """Make it smaller until nothing helps any more; returns why it ended."""
        try:
            for _ in range(_TRIES):
                self.reproduced = self.reproduced or self._runs.first([self.best]) is not None
            if not self.reproduced:
                return "done", f"it did not come again in {_TRIES} runs"
            before = None
            while before != self.best:
                before = self.best
                self._fewer_others()
                self._fewer_disturbances()
                self._plainer_arguments()
        except StoppedError:
            asked = stopped()
            return ("interrupted", "") if asked else ("budget", "give a larger --budget to go on from here")
        except CrashhuntError as error:
            if not self.reproduced:
                raise
            return "error", str(error)
        return "done", ""

    def _try(self, specs: Sequence[TrialSpec]) -> int | None:
        good = self._runs.first(specs)
        if good is not None:
            self.best = specs[good]
            self.smaller.append(self.best)
        return good

    def _fewer_others(self) -> None:
        best = self.best

        def tried(some: Sequence[tuple[str, ...]]) -> int | None:
            return self._try([replace(best, only=one) for one in some])

        if best.only is not None:
            fewest(best.only, tried)
            return
        self._everybody = self._runs.entered(replace(best, only=(EVERYBODY,)))
        if not self._everybody:
            return  # the simulator cannot leave anybody out
        shortest, likely = self._runs.most_steps, self._likely()
        middle = min(best.max_steps, round(2 * shortest + _LONGER_S / self._rerun.recorded.prologue.step_length_s))
        for most in dict.fromkeys((shortest, middle, best.max_steps)):
            self._runs.most_steps = most
            if (good := tried(likely)) is not None:
                fewest(likely[good], tried)
                return
        self._runs.most_steps = middle
        fewest(self._everybody, tried)

    def _likely(self) -> list[tuple[str, ...]]:
        """Who may be all that it takes: nobody, the other one, the nearest in the end, any single one of them."""
        recording, known = self._rerun.recorded, set(self._everybody)
        hit = self._rerun.bundle.result.collision
        other = (hit.other,) if hit is not None and hit.other in known else ()
        near = _nearest(recording, self._rerun.bundle.driver)
        near = [name for name in near if name in known]
        groups = [(), other, tuple(near[:2]), *((name,) for name in near[:_SINGLE]), tuple(near[:_NEAR])]
        return list(dict.fromkeys(groups))

    def _fewer_disturbances(self) -> None:
        best = self.best

        def tried(some: Sequence[tuple[Disturbance, ...]]) -> int | None:
            return self._try([replace(best, disturbances=one) for one in some])

        fewest(best.disturbances, tried)

    def _plainer_arguments(self) -> None:
        defaults = self._defaults()
        names = [("", name) for name in self.best.scenario_arguments]
        names += [(agent, name) for agent, given in self.best.arguments.items() for name in given]
        at_default = self.best
        for key in names:
            if defaults.get(key) is not None:
                at_default = _with(at_default, key, defaults[key])
        if at_default != self.best:
            self._try([at_default])
        for key in names:
            best = self.best
            values = plainest(_value(best, key), defaults.get(key))
            if values:
                self._try([_with(best, key, value) for value in values])

    def _defaults(self) -> dict[tuple[str, str], Value | None]:
        scenario = self._rerun.worker.scenario
        found = {("", name): known.default for name, known in scenario.scenario_arguments().items()}
        for agent in scenario.agents:
            found |= {(agent, name): known.default for name, known in scenario.agent_arguments(agent).items()}
        return found

    def actors(self, after: Recording | None) -> tuple[int, int]:
        """How many were seen before and after."""
        before = _actors(self._rerun.recorded)
        return before, before if after is None else _actors(after)

    def removed(self) -> tuple[str, ...]:
        """Who and what was taken away."""
        was, only = self._rerun.spec, self.best.only
        stay = {*(only or ()), *was.arguments, *self._rerun.worker.scenario.agents}
        others = [name for name in self._everybody if name not in stay] if only is not None else []
        gone = [one.words for one in was.disturbances if one not in self.best.disturbances]
        return (*others, *gone)

    def changed(self) -> dict[str, tuple[Value | None, Value | None]]:
        """Arguments that have another value."""
        was, now = self._rerun.spec, self.best
        keys = [("", name) for name in was.scenario_arguments]
        keys += [(agent, name) for agent, given in was.arguments.items() for name in given]
        pairs = {f"{agent}.{name}" if agent else name: (_value(was, (agent, name)), _value(now, (agent, name)))
                 for agent, name in keys}  # fmt: skip
        return {name: (left, right) for name, (left, right) in pairs.items() if left != right}


def _written(rerun: Rerun, search: _Search, signature: Signature) -> Bundle | None:
    """Run the smallest in a fresh process, and write its bundle; another process confirms it, as of every crash.

    Of what does not do the same there, the next larger one is taken; None where none does.
    """
    bundle = rerun.bundle
    for spec in reversed(search.smaller):
        search.best = spec
        small = _run_fresh(rerun, search.best)
        if signature_of(small) == signature:
            told = {"of": bundle.id, "removed": list(search.removed()), "changed": _plain(search)}
            small = replace(small, added={**small.added, "shrunk": told})
            small = confirm(small) or small
            small.write()
            return small
        shutil.rmtree(small.path)
    return None


def _run_fresh(rerun: Rerun, spec: TrialSpec) -> Bundle:
    bundle = rerun.bundle
    with tempfile.TemporaryDirectory(prefix="crashhunt-shrink-") as folder:
        scratch = Path(folder)
        executor = FreshProcessExecutor(replace(rerun.worker, scratch=scratch))
        try:
            executor.submit(spec)
            results: list[TrialResult] = []
            while not results:
                results = list(executor.completed(1.0))
        finally:
            executor.close()
        trial = scratch_of(scratch, spec.number)
        return write_bundle(
            bundle.hunt, results[0], trial, hunt_seed=bundle.hunt_seed, snapshot=bundle.snapshot,
            lanes=read_map(scratch, trial), name=shrunk_name(bundle.id),
        )  # fmt: skip


def _plain(search: _Search) -> dict[str, list[Value | None]]:
    return {name: list(values) for name, values in search.changed().items()}


def _actors(recording: Recording) -> int:
    return len({actor.id for scene in recording.scenes() for actor in scene.roster.actors})


def _nearest(recording: Recording, agent: str) -> list[str]:
    """The others in the last scene, the nearest first."""
    scenes = recording.scenes()
    if not scenes or agent not in scenes[-1].roster.index:
        return []
    scene = scenes[-1]
    x, y = scene.points[scene.roster.index[agent]]
    away = {
        actor.id: (point[0] - x) ** 2 + (point[1] - y) ** 2
        for actor, point in zip(scene.roster.actors, scene.points, strict=True)
        if actor.id != agent
    }
    return sorted(away, key=lambda name: (away[name], name))


def _value(spec: TrialSpec, key: tuple[str, str]) -> Value:
    agent, name = key
    return spec.arguments[agent][name] if agent else spec.scenario_arguments[name]


def _with(spec: TrialSpec, key: tuple[str, str], value: Value | None) -> TrialSpec:
    agent, name = key
    if value is None:
        return spec
    if not agent:
        return replace(spec, scenario_arguments={**spec.scenario_arguments, name: value})
    return replace(spec, arguments={**spec.arguments, agent: {**spec.arguments[agent], name: value}})
