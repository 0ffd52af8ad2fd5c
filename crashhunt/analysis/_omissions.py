"""Finds what an agent omitted: reruns the trial of a crash with a reference driver that controls a part of the driving.

First the reference driver only watches. The run with the watching driver must be bit-identical to the recording, and
reports the periods in which the agent was not safe. Then the reference driver takes control of speed or lanes from the
beginning of such a period, and from 0.5 s and 1 s before. The period is the cause if no such run ends in a crash. The
run from its beginning is made twice, and must have the same digest. If all crashes of such runs differ from the
recorded crash, the part of the driving that the agent kept may have caused them. In that case, the reference driver
takes control of both speed and lanes from the same steps in further runs, and none of these runs may end in a crash.

Cost: one run in which the reference driver watches, three or six for each candidate, and one repetition; at most
`_MAX_CANDIDATES` candidates.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from itertools import takewhile
from typing import TYPE_CHECKING

from crashhunt.analysis._causes import INCONCLUSIVE_OUTCOMES, lanes_around_crash
from crashhunt.base.errors import CrashhuntError, RecorderError
from crashhunt.crashes import (
    INTERRUPTED,
    Omission,
    Reference,
    ReferenceRun,
    changes_of,
    partner,
    visible_from,
)
from crashhunt.recording import has_same_scenes
from crashhunt.replays import is_current_code, reruns_of
from crashhunt.scenario import with_recorded_load_order
from crashhunt.trial import Outcome, Overruled
from crashhunt.trial_reruns import EndedRun, Reruns, StoppedError

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.base.codec import JsonObject
    from crashhunt.crashes import Without
    from crashhunt.replays import Rerun
    from crashhunt.trial import TrialResult, TrialSpec

_BEFORE_S = 10.0  # a period that ended longer before the crash has not led to it
_EARLIER_S = (0.0, 0.5, 1.0)  # the reference driver takes over from these times before the period
_LONGER_S = 5.0  # simulation time past the crash: a reference driver may only postpone it
_MAX_CANDIDATES = 4
_SPEED_CHANGED_MPS = 0.5  # less is no braking
_INSTEAD_S = 2.0  # before the crash: whether the agent then sped up
_SPEEDS_UP_MPS2 = 0.3  # on average over this time; less is a kept speed
_NOT_IDENTICAL_REASON = "the trial was not bit-identical when it was run again"
_OLD_SNAPSHOT_REASON = (
    "the crashhunt of the snapshot has no reference driver, and with this crashhunt the trial is not bit-identical"
)


def find_omission(
    rerun: Rerun,
    *,
    most: int,
    parallel: int,
    stopped: Callable[[], bool],
    tell: Callable[[], None],
) -> Reference:
    """Return what the agent omitted, according to runs with a reference driver.

    The runs use the current crashhunt, even if the snapshot has an older one. The first run must therefore be
    bit-identical. There are at most ``most`` runs. ``tell`` is called after each finished run.

    Raises:
        CrashhuntError: no trial can be run.
    """
    old = not is_current_code(rerun)
    if old:
        order = rerun.snapshot.environment.get("load_order")
        rerun = replace(
            rerun, worker=replace(rerun.worker, scenario=with_recorded_load_order(rerun.worker.scenario, order))
        )
    with closing(reruns_of(rerun, parallel=parallel, stopped=stopped, todays=True)) as runs:
        search = _Search(rerun, runs, most, tell)
        try:
            return search.find(_OLD_SNAPSHOT_REASON if old else _NOT_IDENTICAL_REASON)
        except StoppedError:
            return Reference(runs=tuple(search.runs), why_not=INTERRUPTED)
        except RecorderError:
            raise
        except CrashhuntError as error:
            return Reference(runs=tuple(search.runs), why_not=error.message)


class _Search:
    """The search for what one agent omitted."""

    def __init__(self, rerun: Rerun, reruns: Reruns, most: int, tell: Callable[[], None]) -> None:
        self.runs: list[ReferenceRun] = []
        self._rerun, self._reruns, self._tell = rerun, reruns, tell
        self._left = most
        self._result, self._recording = rerun.bundle.result, rerun.recorded
        self._agent, self._other = rerun.bundle.driver, partner(self._result)
        self._dt = self._recording.prologue.step_length_s
        self._end = self._result.steps
        self._lanes = lanes_around_crash(rerun)

    def find(self, differs: str) -> Reference:
        """Return the cause; `differs` is the reason for no result if the watching run is not bit-identical."""
        (watched,) = self._run([self._rerun.spec], "none", [0])
        if watched.result.outcome is Outcome.INVALID and watched.result.failure is not None:
            return Reference(why_not=watched.result.failure.message)
        if watched.result.digest != self._result.digest or watched.responses is None:
            return Reference(why_not=differs)
        candidates = self._candidates(watched.responses)
        replaced = []  # by another crash, which the agent brings about with its other faculty
        for candidate in candidates:
            began = len(self.runs)
            found = self._try(candidate, str(candidate["faculty"]))
            if found is not None:
                return found
            endings = {run.ending for run in self.runs[began:]}
            if "other" in endings and endings <= {"none", "other"}:
                replaced.append(candidate)
        if len({str(one["faculty"]) for one in candidates}) > 1:
            earliest = min(candidates, key=lambda one: int(one["first"]))
            if earliest not in replaced:
                replaced.append(earliest)
        for candidate in replaced:
            found = self._try(candidate, "both")
            if found is not None:
                return found
        return Reference(runs=tuple(self.runs))

    def _candidates(self, responses: tuple[JsonObject, ...]) -> list[JsonObject]:
        """Return the periods that may be the cause: lane changes first, then the latest period.

        A lane change takes precedence over the small gap that follows it, because the period of the small gap begins
        with the lane change. Only periods with the collision partner, red lights and missing lanes are returned. A run
        without another period may avoid the crash by chance, because everything after that period differs.
        """
        since = self._end - round(_BEFORE_S / self._dt)
        recent = [one for one in responses if int(one["last"]) >= since and one["actor"] in ("", self._other)]

        def order(one: JsonObject) -> tuple[bool, int]:
            return one["faculty"] != "lateral", -int(one["last"])

        return sorted(recent, key=order)[:_MAX_CANDIDATES]

    def _try(self, candidate: JsonObject, faculty: str) -> Reference | None:
        """Return the cause if no run with the reference driver from the beginning of a period on crashes."""
        first = int(candidate["first"])
        steps = list(dict.fromkeys(max(0, first - round(each / self._dt)) for each in _EARLIER_S))
        if self._left <= len(steps):
            return None
        longer = replace(self._rerun.spec, max_steps=self._end + round(_LONGER_S / self._dt))
        ended = self._run([longer] * len(steps), faculty, steps)
        found = [self._judged(faculty, step, one) for step, one in zip(steps, ended, strict=True)]
        self.runs += found
        endings = [one.ending for one in found]
        if endings[0] != "none" or any(ending in ("same", "other") for ending in endings):
            return None
        (again,) = self._run([longer], faculty, [first])
        if again.result.digest != ended[0].result.digest:
            return Reference(runs=tuple(self.runs), why_not="a run with the reference driver could not be repeated")
        return Reference(omission=self._omission(candidate, faculty), runs=tuple(self.runs))

    def _run(self, specs: list[TrialSpec], faculty: str, steps: list[int]) -> list[EndedRun]:
        """Run the trial with the reference driver in control from each of some steps on."""
        made = [
            replace(spec, overruled=Overruled(self._agent, step, reference=faculty))
            for spec, step in zip(specs, steps, strict=True)
        ]
        found: dict[int, EndedRun] = {}
        for ended in self._reruns.run(made):
            found[ended.place] = ended
            self._left -= 1
            self._tell()
        return [found[place] for place in range(len(made))]

    def _judged(self, faculty: str, step: int, ended: EndedRun) -> ReferenceRun:
        recording = ended.recording
        ending: Without = "unclear"
        changed: tuple[str, ...] = ()
        if recording is not None and has_same_scenes(self._recording, recording, step):
            ending = self._ending(ended.result)
            changed = changes_of(self._recording, recording, self._agent, self._lanes, step)
        return ReferenceRun(faculty=faculty, step=step, ending=ending, changed=changed)

    def _ending(self, result: TrialResult) -> Without:
        if result.outcome in (Outcome.SURVIVED, Outcome.FINISHED):
            return "none"
        if result.outcome in INCONCLUSIVE_OUTCOMES:
            return "unclear"
        was, now = self._result.collision, result.collision
        if was is None or now is None:
            return "same" if result.outcome is self._result.outcome else "other"
        if {was.collider, was.victim} == {now.collider, now.victim}:
            return "same"
        return "other" if now.involves(self._agent) else "unclear"  # the crash of another agent has ended the run

    def _omission(self, candidate: JsonObject, faculty: str) -> Omission:
        actor, first = str(candidate["actor"]), int(candidate["first"])
        lateral = candidate["faculty"] == "lateral"
        speeds = [] if lateral else self._speeds(first)
        return Omission(
            faculty=faculty,
            kind=str(candidate["kind"]),
            actor=actor,
            step=first,
            instead="changed lanes" if lateral else self._instead(speeds),
            speed_mps=float(candidate["speed_mps"]),
            actor_speed_mps=candidate.get("actor_speed_mps") if actor else None,
            gap_m=candidate.get("gap_m"),
            safe=candidate.get("safe"),
            visible_step=visible_from(self._recording, self._agent, actor) if actor else None,
            last_speed_mps=speeds[-1] if speeds else None,
            kept_s=self._kept_s(speeds) if speeds else None,
        )

    def _speeds(self, first: int) -> list[float]:
        """Return the agent's speeds from a step to the crash, without the change of speed in the crash itself."""
        scenes = [scene for scene in self._recording.scenes()[first:-1] if self._agent in scene.roster.index]
        return [float(scene.speeds[scene.roster.index[self._agent]]) for scene in scenes]

    def _instead(self, speeds: list[float]) -> str:
        # A period begins long before a crash, when many a driver still speeds up. The last seconds tell bugs apart.
        last = speeds[-1 - round(_INSTEAD_S / self._dt) :]
        if speeds and speeds[-1] <= max(speeds[0], last[0]) - _SPEED_CHANGED_MPS:
            return "braked too little"
        # The average, because a vehicle that reaches its top speed stops to accelerate, whatever its agent asks for.
        gained = last[-1] - last[0] if last else 0.0
        return "sped up" if gained > _SPEEDS_UP_MPS2 * (len(last) - 1) * self._dt else "kept its speed"

    def _kept_s(self, speeds: list[float]) -> float:
        """Return for how long before the crash the agent kept the speed that it had in the end."""
        kept = list(takewhile(lambda speed: abs(speed - speeds[-1]) < _SPEED_CHANGED_MPS, reversed(speeds)))
        return (len(kept) - 1) * self._dt
