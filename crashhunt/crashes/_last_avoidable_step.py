"""The last time at which braking would have avoided a crash, determined by runs when the crash is confirmed."""

from __future__ import annotations

import itertools
import math
import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

from crashhunt.crashes._contact_record import record_in
from crashhunt.crashes._encounter import Encounter, last_escape
from crashhunt.crashes._lanes import Borders, LaneMap
from crashhunt.recording import has_same_scenes
from crashhunt.trial import Escape, Outcome, Overruled

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from crashhunt.recording import Recording
    from crashhunt.simulators import FullBraking
    from crashhunt.trial import Collision, TrialResult, TrialSpec

_MAX_RUNS = 12  # enough to bisect a thousand steps
_BEFORE_S = 10.0  # earlier braking is not examined
_WALL_S = 60.0  # the search runs while the user waits for the confirmation of a crash
_ASSUMED_DECELERATION_MPS2 = 4.5  # m/s², if the deceleration is unknown; a wrong guess only costs more runs
_MAX_STANDING_SPEED_MPS = 0.1  # m/s
_MAX_DECELERATION_MPS2 = 15.0  # more than the tyres of a road vehicle hold
_AFTERWARDS_S = 5.0  # past the old end, so that a collision that only comes later is seen
_FULL_BRAKING_WORDS = "as hard as it can"
_UNCLEAR_REASONS = {
    "other": "another crash follows",
    "unclear": "the run ends before the outcome is clear",
    "diverged": "the run deviates before the braking",
    "impossible": "the vehicle stops harder than any vehicle can",
}

Ending = Literal["avoided", "hit", "other", "unclear", "diverged", "impossible"]
"""The result of a run with overridden actions.

In order: no crash, a crash of the same two actors, another crash, an unclear end, a run that deviated before the
override. The last is no crash, but the simulator stopped the vehicle harder than any vehicle can."""


class StepBisection:
    """Chooses the steps after which a manoeuvre runs next, to find the last step from which it avoids a crash.

    As long as no run avoids the crash, the search goes back with strides that double. It then bisects between the last
    step that avoids the crash and the next step that does not.

    Args:
        first: the first step to examine.
        start: the step at which the search begins.
        end: the step of the crash, at which it is too late.
        parallel: number of runs at a time.
        is_near: whether the last step is assumed to be near the start. Then strides also double towards the crash.
    """

    def __init__(self, first: int, start: int, end: int, *, parallel: int = 1, is_near: bool = False) -> None:
        self._first, self._start, self._end = first, start, end
        self._parallel, self._is_near, self._stride = parallel, is_near, 1

    def next_steps(self, endings: Mapping[int, Ending]) -> set[int]:
        """Return the steps to run next; empty if the last step that avoids the crash is known, or if there is none."""
        if not endings:
            return {self._start, self._end - 1} if self._parallel > 1 else {self._start}
        helps = last_avoiding(endings)
        late = min((step for step in endings if helps is None or step > helps), default=self._end)
        if helps is None:
            if late <= self._first:
                return set()
            found = {max(self._first, late - self._stride * 2**more) for more in range(self._parallel)}
            self._stride *= 2**self._parallel
            return found
        if late - helps <= 1:
            return set()
        if self._is_near and late == self._end:
            self._stride *= 2
            return {min(self._end - 1, helps + self._stride // 2)}
        parts = min(self._parallel, late - helps - 1) + 1
        return {helps + (late - helps) * part // parts for part in range(1, parts)}


def last_avoiding(endings: Mapping[int, Ending]) -> int | None:
    """Return the last step from which a run avoids the crash; None if no run does."""
    return max((step for step, ending in endings.items() if ending == "avoided"), default=None)


def partner(result: TrialResult) -> str:
    """Return the other actor of a collision; empty if there was none."""
    return result.collision.other if result.collision is not None else ""


def find_escape(
    result: TrialResult,
    recording: Recording,
    braking: FullBraking | None,
    run: Callable[[TrialSpec], tuple[TrialResult, Recording]],
    borders: Callable[[], Iterable[Borders]] = tuple,
) -> Escape | None:
    """Return until when braking would have avoided a collision of two actors, or why that time is unknown.

    The result comes from runs, not from a calculation. The same trial runs again, the agent brakes with full force
    after some step, and the other actors react. The result rests on two runs that differ by one step. The first run
    ends without a crash, the second in the same crash. If another vehicle drove into the agent from behind, there are
    no such runs.

    Args:
        result: result of the crashed trial.
        recording: recording of the crashed trial.
        braking: how the agent's vehicle brakes; None if that is unknown.
        run: function that runs a trial in the same way as the crashed trial.
        borders: function that returns the borders of the map's lanes, as `LaneMap` needs them; used to describe further
            differences of a run.

    Returns:
        The result; None if the crash was not a collision of two actors.
    """
    hit = result.collision
    if result.outcome is not Outcome.COLLISION or hit is None or not hit.other:
        return None
    if braking is None:
        return Escape(why_not=f"the simulator does not say how {hit.agent} brakes")
    if _is_from_behind(recording, hit):
        return Escape(why_not=f"{hit.other} drove into the back of {hit.agent}")
    search = _Search(result=result, recording=recording, braking=braking, run=run)
    found = search.last()
    if found is None:
        return Escape(why_not=search.why_not)
    deceleration = max(search.decelerations, default=0.0)
    return Escape(
        *found,
        deceleration if deceleration > _MAX_STANDING_SPEED_MPS else None,
        search.how(deceleration),
        changed=search.changed(LaneMap(borders(), (hit.x, hit.y))) if found[0] is not None else (),
    )


def _is_from_behind(recording: Recording, hit: Collision) -> bool:
    """Return whether the front of another actor drove into the rear of the agent, in the same direction."""
    record = record_in(recording.scenes(), hit)
    return hit.role == "victim" and record is not None and record.follower == hit.other


@dataclass(slots=True)
class _Search:
    result: TrialResult
    recording: Recording
    braking: FullBraking
    run: Callable[[TrialSpec], tuple[TrialResult, Recording]]
    endings: dict[int, Ending] = field(default_factory=dict)
    decelerations: list[float] = field(default_factory=list)
    latest: tuple[int, Recording] | None = None  # the run from the last step that helps
    began: float = field(default_factory=time.monotonic)
    why_not: str = ""

    def last(self) -> tuple[int | None, int | None] | None:
        """Return the last step after which braking avoids the crash, and the next step, after which it does not."""
        assert self.result.collision is not None
        end = self.result.steps
        dt = self.recording.prologue.step_length_s
        both = [moment.step for moment in self._encounter(self.recording).moments if moment.step < end]
        if not both:
            self.why_not = "the recording has the two vehicles together only when they touch"
            return None
        first = max(both[0], end - math.ceil(_BEFORE_S / dt), 0)
        agent, guess = self.result.collision.agent, self.braking.deceleration or _ASSUMED_DECELERATION_MPS2
        start = last_escape(self.recording, agent, self._other, braking=guess)
        start = min(max(first, end - 2 if start is None else start), end - 1)
        bisection = StepBisection(first, start, end, is_near=True)
        while steps := bisection.next_steps(self.endings):
            (step,) = steps
            ending = self._ending(step)
            if ending not in ("avoided", "hit"):
                self.why_not = self.why_not or f"when it brakes after step {step}, {_UNCLEAR_REASONS[ending]}"
                return None
        helps = last_avoiding(self.endings)
        if helps is None:
            return None, first
        return helps, helps + 1 if helps + 1 < end else None

    def how(self, deceleration: float) -> str:
        """Return a description of the braking; it contains only decelerations that the vehicle reached in a run."""
        said = self.braking.deceleration
        if said is None:
            return self.braking.how
        return (
            f"at {said:.3g} m/s², {self.braking.how},"
            if abs(said - deceleration) < 0.01 * said
            else _FULL_BRAKING_WORDS
        )

    def changed(self, lanes: LaneMap) -> tuple[str, ...]:
        """Return the agent's further differences in the run with the latest braking that avoids the crash."""
        if self.latest is None:
            return ()
        assert self.result.collision is not None
        after, recording = self.latest
        return changes_of(self.recording, recording, self.result.collision.agent, lanes, after)

    @property
    def _other(self) -> str:
        return partner(self.result)

    def _encounter(self, recording: Recording) -> Encounter:
        assert self.result.collision is not None
        return Encounter(recording, self.result.collision.agent, self._other)

    def _ending(self, after: int) -> Ending:
        """Run the trial with the agent overruled after a step, and return what happened to the crash."""
        if len(self.endings) >= _MAX_RUNS:
            self.why_not = f"{_MAX_RUNS} runs did not find it"
        elif time.monotonic() - self.began > _WALL_S:
            self.why_not = f"the runs took longer than {_WALL_S:g} s"
        else:
            self.endings[after] = self._run(after)
            return self.endings[after]
        return "unclear"

    def _run(self, after: int) -> Ending:
        braking = self.braking.deceleration
        result, recording = self.run(overruled_trial(self.result, self.recording, after, braking))
        found = ending_of(self.result, self.recording, after, result, recording, deceleration=braking)
        if found in ("avoided", "hit"):
            assert self.result.collision is not None
            self.decelerations.append(slowing(self.result.collision.agent, after, result, recording))
        if found == "avoided" and (self.latest is None or after > self.latest[0]):
            self.latest = after, recording
        return found


def overruled_trial(
    result: TrialResult, recording: Recording, after: int, deceleration: float | None, manoeuvre: str = "brake"
) -> TrialSpec:
    """Return the trial of a collision with its agent overruled after a step, with enough steps to see the result.

    The vehicle stops with ``deceleration``, in m/s²; None if it is unknown. The manoeuvre is as in `Overruled`.
    """
    assert result.collision is not None
    agent, scene = result.collision.agent, recording.scene(after)
    speed = scene.speeds[scene.roster.index[agent]]
    afterwards = _AFTERWARDS_S + max(0.0, speed) / (deceleration or _ASSUMED_DECELERATION_MPS2)
    steps = result.steps + math.ceil(afterwards / recording.prologue.step_length_s)
    return replace(result.spec, overruled=Overruled(agent, after, manoeuvre), max_steps=steps)


def ending_of(
    result: TrialResult,
    recording: Recording,
    after: int,
    rerun: TrialResult,
    rerun_recording: Recording,
    *,
    deceleration: float | None = None,
) -> Ending:
    """Return what happened to a collision in a run with its agent overruled after a step.

    The vehicle can brake with ``deceleration``, in m/s²; None if it is unknown.
    """
    hit = result.collision
    assert hit is not None
    if not has_same_scenes(recording, rerun_recording, after):
        return "diverged"
    if rerun.outcome in (Outcome.COLLISION, Outcome.OFF_ROAD) and (now := rerun.collision) is not None:
        if now.involves(hit.agent):
            return "hit" if {now.collider, now.victim} == {hit.collider, hit.victim} else "other"
        # The crash of another agent has ended the run, and says nothing about this one.
    elif rerun.outcome is Outcome.OFF_ROAD:
        return "other"
    elif rerun.outcome not in (Outcome.SURVIVED, Outcome.FINISHED):
        return "unclear"
    if not _is_over(rerun_recording, hit.agent, partner(result)):
        return "unclear"
    # SUMO stops a vehicle within one step at the end of a lane that does not lead on.
    limit = max(_MAX_DECELERATION_MPS2, 1.01 * (deceleration or 0.0))
    return "avoided" if slowing(hit.agent, after, rerun, rerun_recording) <= limit else "impossible"


def _is_over(recording: Recording, agent: str, other: str) -> bool:
    """Return whether the danger is over: one of the two actors has left, stands still, or drives elsewhere."""
    scene = recording.scenes()[-1]
    row = scene.roster.index.get(agent)
    if row is None or other not in scene.roster.index or scene.speeds[row] < _MAX_STANDING_SPEED_MPS:
        return True
    return math.isinf(Encounter(recording, agent, other).moments[-1].time_to_collision_s)


def changes_of(recorded: Recording, rerun: Recording, agent: str, lanes: LaneMap, step: int) -> tuple[str, ...]:
    """Return further differences of an agent in a run: lane changes that are missing or new after a step.

    ``step`` is the last step that both recordings have in common.
    """
    if not lanes:
        return ()
    was, now = (lanes.change_began(one.scenes()[step:], agent) is not None for one in (recorded, rerun))
    if was and not now:
        return (f"{agent} does not change lanes",)
    return (f"{agent} changes lanes",) if now and not was else ()


def slowing(agent: str, after: int, result: TrialResult, recording: Recording) -> float:
    """Return how hard a vehicle braked after a step, in m/s², without the change of speed caused by a collision."""
    crashed = result.outcome is not Outcome.SURVIVED and result.outcome is not Outcome.FINISHED
    scenes = recording.scenes()[after : -1 if crashed else None]
    speeds = [scene.speeds[scene.roster.index[agent]] for scene in scenes if agent in scene.roster.index]
    found = [(was - now) / recording.prologue.step_length_s for was, now in itertools.pairwise(speeds)]
    return max(found, default=0.0)
