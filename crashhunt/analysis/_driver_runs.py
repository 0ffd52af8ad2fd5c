"""Asks models of a competent driver about a collision: runs its trial again, and a model drives from its perception on.

A model watches the collision partner from the first step at which the agent could see it. The agent drives until the
model perceives the risk. From then on, the model controls the speed, and the vehicle keeps its lane. A model prevents
the collision if its run has no crash and continues for at least 5 s after the recorded collision. The run must end
without an approach that needs more than 1 m/s².

The models describe traffic in one direction on a road. They do not apply to pedestrians, junctions, oncoming and
crossing traffic, to a vehicle that is hit from behind, and to lane changes of the agent itself. ``reg157`` applies only
if the other vehicle cut in.

Cost: one run for each model that applies.
"""

from __future__ import annotations

import math
from contextlib import closing
from dataclasses import replace
from typing import TYPE_CHECKING

from crashhunt.base.errors import CrashhuntError, RecorderError
from crashhunt.crashes import (
    COMPETENT_DRIVERS,
    INTERRUPTED,
    DriverRun,
    Preventability,
    contact_record,
    ending_of,
    overruled_trial,
    visible_from,
)
from crashhunt.replays import ReplayOptions, prepare, reruns_of
from crashhunt.trial import Outcome, Overruled
from crashhunt.trial_reruns import EndedRun, StoppedError
from crashhunt.world import is_person

if TYPE_CHECKING:
    from collections.abc import Callable

    from crashhunt.base.codec import JsonObject
    from crashhunt.crashes import Bundle
    from crashhunt.recording import Recording
    from crashhunt.replays import Rerun
    from crashhunt.trial import TrialResult, TrialSpec

PREVENTABILITY_RUNS = len(COMPETENT_DRIVERS)
"""The number of runs that the models need at most."""

_CHANGE_S = 5.0  # a lane change that began earlier has not led to the collision
_OUTSIDE_S = 10.0
_GENTLE_MPS2 = 1.0
_CUT_IN_MODEL = "reg157"
_UNDECIDED = {
    "other": "another crash follows",
    "unclear": "the run ends before the outcome is clear",
    "diverged": "the trial was not bit-identical when it was run again",
    "impossible": "the vehicle stops harder than any vehicle can",
}


def find_preventability(
    rerun: Rerun, *, parallel: int, stopped: Callable[[], bool], tell: Callable[[], None]
) -> Preventability:
    """Return which models of a competent driver would have prevented a collision of two actors.

    ``tell`` is called after each finished run.
    """
    result, recording = rerun.bundle.result, rerun.recorded
    hit = result.collision
    assert hit is not None
    visible = visible_from(recording, hit.agent, hit.other)
    since = min(visible or 0, max(0, result.steps - 1))
    why_not, is_cut_in = _applies(rerun)
    if why_not:
        return Preventability(since_step=since, why_not=why_not)
    models = [model for model in COMPETENT_DRIVERS if is_cut_in or model != _CUT_IN_MODEL]
    runs = {} if is_cut_in else {_CUT_IN_MODEL: DriverRun(model=_CUT_IN_MODEL, why_not=f"{hit.other} did not cut in")}
    base = overruled_trial(result, recording, since, None)

    def trial(model: str) -> TrialSpec:
        return replace(base, overruled=Overruled(hit.agent, since, reference=model, other=hit.other))

    with closing(reruns_of(rerun, parallel=parallel, stopped=stopped, todays=True)) as reruns:
        try:
            for ended in reruns.run([trial(model) for model in models]):
                model = models[ended.place]
                runs[model] = _answer(rerun, model, since, ended)
                tell()
        except StoppedError:
            return Preventability(since_step=since, runs=_in_order(runs), why_not=INTERRUPTED)
        except RecorderError:
            raise
        except CrashhuntError as error:
            return Preventability(since_step=since, runs=_in_order(runs), why_not=error.message)
    return Preventability(since_step=since, runs=_in_order(runs))


def judge_preventability(bundle: Bundle, *, parallel: int = 1) -> bool | None:
    """Return whether any model of a competent driver would have prevented a crash, by running its trial again.

    The code of its snapshot runs, and must be trusted.

    Returns:
        None if no model applies, or the runs do not decide it.

    Raises:
        CrashhuntError: the trial could not be run.
    """
    hit = bundle.result.collision
    if bundle.result.outcome is not Outcome.COLLISION or hit is None or not hit.other:
        return None
    rerun = prepare(bundle, ReplayOptions(force=True, trusted=True))
    return find_preventability(rerun, parallel=parallel, stopped=lambda: False, tell=lambda: None).by_any


def _in_order(runs: dict[str, DriverRun]) -> tuple[DriverRun, ...]:
    return tuple(runs[model] for model in COMPETENT_DRIVERS if model in runs)


def _applies(rerun: Rerun) -> tuple[str, bool]:
    """Return why no model applies to a collision, or an empty text, and whether the other vehicle cut in."""
    hit = rerun.bundle.result.collision
    assert hit is not None
    if is_person(hit.other):
        return f"{hit.other} is a person", False
    contact = contact_record(rerun.bundle, rerun.recorded)
    if contact is None or contact.is_disputed:
        return "the scenes do not show the contact", False
    if not contact.same_way:
        return "the two vehicles did not drive in the same direction", False
    if contact.follower == hit.other:
        return f"{hit.other} drove into the back of {hit.agent}", False
    changers = contact.lane_changers(_CHANGE_S)
    if hit.agent in changers:
        return f"{hit.agent} changed lanes, and the models do not decide about lanes", False
    if contact.follower != hit.agent and hit.other not in changers:
        return "neither a rear-end collision nor a cut-in", False
    return "", hit.other in changers and _was_in_other_lane(rerun.recorded, hit.agent, hit.other)


def _was_in_other_lane(recording: Recording, agent: str, other: str) -> bool:
    """Return whether another vehicle was outside the path of the agent within the last seconds."""
    steps = round(_OUTSIDE_S / recording.prologue.step_length_s)
    for scene in recording.scenes()[-steps:]:
        rows = scene.roster.index
        if agent not in rows or other not in rows:
            continue
        own, its = rows[agent], rows[other]
        # Halfway between both headings, an arc from one vehicle to the other has no sideways part.
        heading = scene.headings[own] + math.remainder(scene.headings[its] - scene.headings[own], math.tau) / 2
        dx, dy = (scene.centers[its] - scene.centers[own]).tolist()
        widths = scene.roster.actors[own].width + scene.roster.actors[its].width
        if abs(dy * math.cos(heading) - dx * math.sin(heading)) > widths / 2:
            return True
    return False


def _answer(rerun: Rerun, model: str, since: int, ended: EndedRun) -> DriverRun:
    result, recording = ended.result, ended.recording
    if result.outcome is Outcome.INVALID:
        return DriverRun(model=model, why_not=result.failure.message if result.failure else "the trial cannot run")
    if recording is None or ended.responses is None:
        return DriverRun(model=model, why_not="the run reported nothing")
    ending = ending_of(rerun.bundle.result, rerun.recorded, since, result, recording)
    (seen,) = ended.responses or ({},)
    found = DriverRun(
        model=model,
        perceived_step=seen.get("first"),
        gap_m=seen.get("gap_m"),
        speed_mps=seen.get("speed_mps"),
        other_speed_mps=seen.get("actor_speed_mps"),
    )
    if seen.get("in_junction"):
        return replace(found, why_not="the paths of both vehicles meet in a junction")
    if seen and (ending == "avoided" or (ending == "unclear" and _is_calm(result, seen))):
        return replace(found, prevented=True, margin_m=seen["least_gap_m"])
    if ending == "hit":
        return replace(found, prevented=False)
    if result.failure is not None:
        return replace(found, why_not=f"the run ends with {result.outcome}: {result.failure.message}")
    return replace(found, why_not=_UNDECIDED.get(ending, "the model perceived no risk"))


def _is_calm(result: TrialResult, seen: JsonObject) -> bool:
    """Return whether a run ended without a crash, and a gentle deceleration suffices for the rest of the approach."""
    if result.outcome not in (Outcome.SURVIVED, Outcome.FINISHED):
        return False
    gap, closing = float(seen["last_gap_m"]), max(0.0, float(seen["last_closing_mps"]))
    return gap > 0 and closing * closing <= 2 * _GENTLE_MPS2 * gap
