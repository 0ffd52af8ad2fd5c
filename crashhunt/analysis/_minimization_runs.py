"""Runs minimization candidates on persistent workers, several at a time, and stores the result of each candidate."""

from __future__ import annotations

import json
import shutil
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from crashhunt.base.errors import BundleError, CrashhuntError, RecorderError
from crashhunt.base.integrity import digest_of_data
from crashhunt.crashes import signature_of, write_bundle
from crashhunt.replays import reruns_of
from crashhunt.trial_reruns import Budget, EndedRun, StoppedError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from crashhunt.base.progress import Watch
    from crashhunt.crashes import Signature
    from crashhunt.replays import Rerun
    from crashhunt.trial import TrialSpec


@dataclass(frozen=True, slots=True)
class Ran:
    """The result of a minimization candidate."""

    same: bool  # whether the candidate crashes in the same manner as the original
    steps: int  # number of steps of the candidate's run
    digest: str  # digest of the run's recording


class Runs:
    """Runs the minimization candidates for a crash.

    Args:
        rerun: the crash to minimize.
        signature: signature of the crash, which candidates must keep.
        memory: A file with the results of candidates, for a search that resumes after an interruption.
        parallel: number of trials at a time.
        budget: maximum number of runs.
        time_s: wall-time limit for all runs, in s; None for no limit.
        stopped: function that returns whether to stop; called repeatedly.
        watch: function called with the number of finished runs and the maximum number.

    Attributes:
        count: number of runs, including runs whose results an interrupted call has stored.
        steps: total number of simulated steps in these runs.
        most_steps: maximum number of steps until the crash; a candidate that crashes later does not count as the same
            crash.
        found_steps: number of steps, including the last one, of the last candidate that crashed in the same manner.
    """

    def __init__(
        self,
        rerun: Rerun,
        signature: Signature,
        memory: Path,
        *,
        parallel: int,
        budget: int,
        time_s: float | None,
        stopped: Callable[[], bool],
        watch: Watch | None,
    ) -> None:
        self.count = self.steps = 0
        self.most_steps = self.found_steps = max(1, rerun.bundle.result.steps_begun)
        self._rerun, self._signature, self._memory_file = rerun, signature, memory
        self._budget, self._watch = budget, watch
        self._memory = _remembered(memory)
        # The traffic of most candidates differs, so a suspended set-up would rarely serve two of them.
        self._reruns = reruns_of(
            rerun, parallel=parallel, stopped=Budget(stopped, time_s).require, keep_all=False, warm_copies=0
        )

    def first(self, candidates: Sequence[TrialSpec], *, again: bool = False) -> int | None:
        """Return the index of the first candidate that crashes in the same manner; None if no candidate does.

        The result does not depend on the number of trials that run at a time. With ``again``, candidates run again that
        are known not to crash.

        Raises:
            StoppedError: The search stopped before the answer was known.
            CrashhuntError: no trial can be run.
        """
        found: dict[int, Ran] = {}
        places: list[int] = []  # of the candidates that have to be run
        for place, spec in enumerate(candidates):
            if self.count + len(found) + len(places) >= self._budget:
                break
            known = self._memory.get(self._key(spec))
            if known is None or (again and not known.same):
                places.append(place)
                continue
            found[place] = known
            if known.same:
                break

        def best() -> int:
            return min((place for place, ran in found.items() if ran.same), default=len(candidates))

        specs = [self._bounded(candidates[place]) for place in places]
        for ended in self._reruns.run(specs, recorded=False, needed=lambda number: places[number] < best()):
            place = places[ended.place]
            found[place] = ran = self._judged(ended)
            self._remember(candidates[place], ran)
        counted = [ran for place, ran in found.items() if place <= best()]
        self.count += len(counted)
        self.steps += sum(ran.steps for ran in counted)
        if self._watch is not None:
            self._watch(min(self.count, self._budget), self._budget)
        if best() < len(candidates):
            was = self._rerun.bundle.result
            self.found_steps = max(1, found[best()].steps + was.steps_begun - was.steps)
            return best()
        if len(found) < len(candidates):
            raise StoppedError
        return None

    def entered(self, spec: TrialSpec) -> tuple[str, ...]:
        """Return the actors that entered in a trial; empty if the simulator cannot report them.

        Raises:
            StoppedError: The search was stopped.
        """
        self.count += 1
        try:
            (ended,) = self._reruns.run([self._bounded(spec)], recorded=False)
        except RecorderError:
            raise
        except CrashhuntError:  # some older crashhunts in a snapshot refuse what they do not know
            return ()
        self.steps += ended.result.steps
        same = ended.result.digest == self._rerun.bundle.result.digest
        return tuple(dict.fromkeys(ended.entered)) if same else ()

    def close(self) -> None:
        """End all worker processes."""
        self._reruns.close()

    def _bounded(self, spec: TrialSpec) -> TrialSpec:
        return replace(spec, max_steps=min(spec.max_steps, self.most_steps))

    def _judged(self, ended: EndedRun) -> Ran:
        """Return whether a candidate crashed with the same type; the slow signature is compared last."""
        was, result = self._rerun.bundle.result, ended.result
        same = result.outcome is was.outcome
        if was.collision is not None and result.collision is not None:
            same = same and (was.collision.agent, was.collision.role) == (
                result.collision.agent, result.collision.role,
            )  # fmt: skip
        if same:
            same = is_same(self._signature_of(ended), self._signature, result.spec)
        return Ran(same, result.steps, result.digest)

    def _signature_of(self, ended: EndedRun) -> Signature | None:
        result = ended.result
        if result.collision is None and result.failure is not None:
            return signature_of(replace(self._rerun.bundle, result=result))
        place = ended.folder.with_name("made")
        try:
            bundle = write_bundle(place, result, ended.folder, hunt_seed=0, snapshot="0", lanes=ended.lanes)
            return signature_of(bundle)
        except BundleError:  # it died before it had recorded anything
            return None
        finally:
            shutil.rmtree(place, ignore_errors=True)

    def _key(self, spec: TrialSpec) -> str:
        return digest_of_data({**spec.to_json(), "number": 0, "most_steps": self.most_steps})

    def _remember(self, spec: TrialSpec, ran: Ran) -> None:
        key = self._key(spec)
        self._memory[key] = ran
        line = json.dumps({"key": key, "same": ran.same, "steps": ran.steps, "digest": ran.digest})
        with suppress(OSError), self._memory_file.open("a", encoding="utf-8") as file:  # `shrink` reports a full disk
            file.write(f"{line}\n")


def is_same(found: Signature | None, wanted: Signature, spec: TrialSpec) -> bool:
    """Return whether a trial crashed with the same type; disturbances of scripted actors are part of their paths."""
    if found is not None and spec.script is not None:
        found = replace(found, disturbed=wanted.disturbed)
    return found == wanted


def _remembered(file: Path) -> dict[str, Ran]:
    found: dict[str, Ran] = {}
    with suppress(OSError):
        for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
            with suppress(ValueError, KeyError, TypeError):  # the last line may have been cut off
                data = json.loads(line)
                found[data["key"]] = Ran(bool(data["same"]), int(data["steps"]), str(data["digest"]))
    return found
