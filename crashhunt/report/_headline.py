"""The verdict of a crash page: one sentence that uses only the recorded contact and the results of runs.

The clauses of the sentence are separated by semicolons: what happened at the contact, the gap if a lane change caused
the contact, and the run that avoided the contact. A clause with unknown or contradictory facts is omitted.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Protocol

import numpy as np

from crashhunt.report._judgement_words import describe_instead
from crashhunt.world import is_person, lane_jump

if TYPE_CHECKING:
    from crashhunt.crashes import Bundle, ContactRecord, Encounter, Fault, Judgement, Omission
    from crashhunt.recording import Recording
    from crashhunt.world import DangerousMoment

_CHANGE_S = 3.0  # before the contact: the rules of fault call a lane change that began earlier complete
_MAX_STRAIGHT_TURN_RAD = math.radians(10)  # in a bend, a sideways displacement is no lane change
_MAX_MERGE_ANGLE_RAD = math.radians(30)  # between their headings, as in the rules of fault
_SIDEWAYS_M = 1.0  # less does not say to which side
_MOVES_MPS = 1.0  # a time gap to a slower vehicle is no useful number
_SHORT_S = 0.1  # a shorter time gap is given in m
_MANOEUVRE_WORDS = {
    "brake": "brakes",
    "left": "changes to the lane on the left and brakes",
    "right": "changes to the lane on the right and brakes",
}


class CrashFacts(Protocol):
    """The facts of a crash on which the verdict is based; a `Story` provides them."""

    bundle: Bundle  # the crash or near miss
    recording: Recording
    agent: str  # the controlled vehicle
    other: str  # the actor that the agent touched or nearly touched; empty if there is none
    contact: ContactRecord | None  # record of the first contact with this actor; None if the two did not touch
    nearest: DangerousMoment | None  # the moment of the greatest criticality; None for a crash
    encounter: Encounter | None  # the motion of the agent and this actor, in all steps; None if there is no such actor
    judgement: Judgement | None  # result of `judge`; None if `judge` has not run
    fault: Fault  # the vehicle at fault


def verdict_of(story: CrashFacts) -> str:
    """Return one sentence on a crash or near miss: what happened, and which run avoided the crash."""
    if story.nearest is not None:
        return _of_a_near_miss(story)
    omission = _omission(story)
    contact = story.contact
    if contact is None or contact.is_disputed:
        what = story.bundle.result.summary
    else:
        what = describe_contact(contact, omission)
    clauses = [what, _avoided(story, omission)]
    return f"{'; '.join(clause for clause in clauses if clause)}."


def _of_a_near_miss(story: CrashFacts) -> str:
    near = story.nearest
    assert near is not None
    moments = story.encounter.moments if story.encounter is not None else []
    moment = next((one for one in moments if one.step == near.step), None)
    if moment is None:
        return f"{story.bundle.result.summary}."
    return (
        f"{near.agent} came close to {near.other} at {moment.time_s:.1f} s: the gap was {moment.gap_m:.1f} m, and the "
        f"criticality {near.danger:.2f}."
    )


def describe_contact(contact: ContactRecord, omission: Omission | None = None) -> str:
    """Return a description of a contact, without a final period.

    ``omission`` is the lane change that caused the contact according to runs.
    """
    changers = contact.lane_changers(_CHANGE_S) if contact.same_way else ()
    what = _what_touched(contact)
    began = [since for changer in changers if (since := contact.changed_s(changer)) is not None]
    if not changers or any(contact.turned(since) > _MAX_MERGE_ANGLE_RAD for since in began):
        return what  # in a bend or a roundabout, lanes lead apart and together
    if len(changers) == 2:
        return f"{', '.join(_lane_change(contact, changer) for changer in changers)}, and {what}"
    (changer,) = changers
    partner = contact.partner(changer)
    is_cause = omission is not None and (omission.instead, omission.actor) == ("changed lanes", partner)
    gap = _gap_of(omission) if omission is not None and is_cause else _gap_at(contact, changer)
    gap = f"; {gap}" if gap else ""
    change = _lane_change(contact, changer)
    if changer in contact.jumpers:
        return f"{change} into {partner}{gap}"
    if what.startswith(f"{changer} "):
        return f"{change} and {what.removeprefix(f'{changer} ')}{gap}"
    return f"{change}, and {what}{gap}"


def _lane_change(contact: ContactRecord, changer: str) -> str:
    """Return which actor changed lanes, to which side, and how long before the contact."""
    side, since = _side(contact, changer), contact.changed_s(changer)
    lane = f"to the {side} lane" if side else "lanes"
    if changer not in contact.jumpers and contact.is_changing(changer):
        return f"{changer} was changing {lane}"
    when = "" if changer in contact.jumpers else f" {contact.ago(since) if since is not None else 'just before'}"
    return f"{changer} changed {lane}{when}"


def _what_touched(contact: ContactRecord) -> str:
    """Return which actor drove into which actor, and which sides touched."""
    agent, manner, mover = contact.agent, contact.manner, contact.collider
    met = contact.partner(mover)
    if manner == "rear end":
        follower = contact.follower
        leader = contact.partner(follower)
        own, its = contact.speed_at_contact(follower), contact.speed_at_contact(leader)
        speeds = f" at {own:.1f} m/s against {its:.1f} m/s" if own > its else ""
        return f"{follower} drove into the back of {leader}{speeds}"
    stood = contact.standing
    if stood and manner not in ("side swipe", "pedestrian", "obstacle"):
        return f"{contact.partner(stood)} drove into {stood}, which stood still"
    if manner == "obstacle":
        return f"{mover} drove into {met}"
    if manner == "head-on":
        return f"{agent} and {contact.other} collided head-on"
    if manner == "pedestrian":
        return f"{mover} {'walked' if is_person(mover) else 'drove'} into {met}"
    if manner == "side swipe":
        return f"{mover} touched the side of {met}" if _touches_a_side(contact, met) else f"{mover} drove into {met}"
    side = manner.rpartition(" ")[2]
    if mover == agent:
        return f"{agent} drove into {met}, which came from the {side}"
    return f"{mover}, which came from the {side}, drove into {agent}"


def _touches_a_side(contact: ContactRecord, met: str) -> bool:
    face = contact.touch.face if met == contact.agent else contact.touch.other_face
    return face in ("left", "right")


def _side(contact: ContactRecord, changer: str) -> str:
    """Return the side to which an actor changed lanes; empty if its path does not show the side."""
    if changer in contact.jumpers and len(contact.through) > 1:
        jump = lane_jump(contact.through[-2], contact.through[-1], changer)
        return ("left" if jump > 0 else "right") if jump else ""
    way = contact.way(changer)
    recent = contact.times <= _CHANGE_S + 1e-6
    headings, points = way.headings[recent], way.centers[recent]
    if len(headings) < 2 or np.ptp(headings) > _MAX_STRAIGHT_TURN_RAD:
        return ""
    dx, dy = points[-1] - points[0]
    heading = float(headings[0])
    moved = dy * math.cos(heading) - dx * math.sin(heading)
    return "" if abs(moved) < _SIDEWAYS_M else "left" if moved > 0 else "right"


def _gap_at(contact: ContactRecord, changer: str) -> str:
    """Return as text the gap between the two actors when one of them changed lanes; empty if the gap is unknown."""
    since = 0.0 if changer in contact.jumpers else contact.changed_s(changer)
    if since is None:
        return ""
    back = len(contact.times) - 1 if not since else int(np.argmin(np.abs(contact.times - since)))
    partner = contact.partner(changer)
    ahead_m, behind_m = contact.gap_m(changer, back), contact.gap_m(partner, back)
    if max(ahead_m, behind_m) <= 0:
        return f"{partner} was alongside"
    follower = partner if ahead_m > 0 else changer
    return _gap_words(max(ahead_m, behind_m), float(contact.way(follower).speeds[back]))


def _gap_of(omission: Omission) -> str:
    relation = omission.kind.rpartition(" ")[0]
    if relation == "alongside":
        return f"{omission.actor} was alongside"
    if relation not in ("ahead", "behind") or omission.gap_m is None:
        return ""
    return _gap_words(omission.gap_m, (omission.actor_speed_mps or 0.0) if relation == "behind" else omission.speed_mps)


def _gap_words(gap_m: float, speed_mps: float) -> str:
    """Return a gap as text: the time in which the vehicle behind covers the gap, and the distance in m."""
    gap_m = max(0.0, gap_m)
    if speed_mps < _MOVES_MPS or gap_m < _SHORT_S * speed_mps:
        return f"the gap was {gap_m:.1f} m"
    return f"the gap was {gap_m / speed_mps:.1f} s ({gap_m:.1f} m)"


def _omission(story: CrashFacts) -> Omission | None:
    """Return the agent's omission that runs with a reference driver found; None if it concerns a third actor."""
    reference = story.judgement.reference if story.judgement is not None else None
    found = reference.omission if reference is not None else None
    return found if found is not None and found.actor in ("", story.other) else None


def _avoided(story: CrashFacts, omission: Omission | None) -> str:
    """Return which run avoided the crash, or that no run did; empty if this is unknown."""
    judgement, tried = story.judgement, story.bundle.result.escape
    if omission is not None:
        blamed = story.fault.verdict in ("ego", "both")
        return (
            f"{_omitted(story.agent, omission, had_to_yield=blamed)}with a reference driver this crash does not happen"
        )
    if judgement is not None and judgement.runs:
        none = "no run ends without a crash" if judgement.others_from(0) else "no run avoids it"
        if judgement.verdict == "invalid":
            return f"{none}: the trial starts in an unavoidable situation"
        if judgement.verdict == "too late when visible":
            avoided = "ended without a crash" if judgement.others_from(judgement.visible_step or 0) else "avoided it"
            return f"when {story.agent} first observed {story.other}, no run {avoided} any more"
        best = judgement.best
        if best is not None and best.last_step is not None:
            how = _MANOEUVRE_WORDS.get(best.manoeuvre, best.manoeuvre)
            return _if_it(story, how, best.last_step, best.changed)
        return none if judgement.avoidable is False else ""
    if tried is None or tried.why_not or tried.step is None:
        return ""
    is_changing = story.contact is not None and story.agent in story.contact.lane_changers(_CHANGE_S)
    if is_changing and not tried.changed:
        return ""  # an earlier version ran it, and has not recorded whether the run drops the lane change
    return _if_it(story, "brakes", tried.step, tried.changed)


def last_avoidable(story: CrashFacts) -> tuple[int, str, float | None] | None:
    """Return the last step from which a run avoided the crash, how, and its greatest deceleration in m/s².

    The deceleration is None if the run did not only brake. The result is None if no run avoided the crash, or if that
    is unknown.
    """
    judgement, tried = story.judgement, story.bundle.result.escape
    if judgement is not None and judgement.runs:
        best = judgement.best
        if best is None or best.last_step is None:
            return None
        how = _MANOEUVRE_WORDS.get(best.manoeuvre, best.manoeuvre)
        only_brakes = best.manoeuvre == "brake" and not best.changed
        return best.last_step, how, best.deceleration if only_brakes else None
    if tried is None or tried.why_not or tried.step is None:
        return None
    return tried.step, "brakes", None if tried.changed else tried.braking


def _if_it(story: CrashFacts, how: str, step: int, changed: tuple[str, ...]) -> str:
    """Return that a run with changes from a step on avoids the crash, and the agent's other changes in that run."""
    also = "".join(f" and {each.removeprefix(f'{story.agent} ')}" for each in changed)
    return f"if {story.agent} {how} {story.recording.ago(step)}{also}, this crash does not happen"


def _omitted(agent: str, omission: Omission, *, had_to_yield: bool) -> str:
    """Return the agent's omission as a clause that ends with a semicolon; empty for a lane change.

    Reason for the argument: the words "did not yield" blame the agent, so a rule of fault has to blame it as well.
    """
    if omission.kind.startswith("no lane"):
        return f"{agent} changed to the {omission.kind.rpartition(' ')[2]}, where it has no lane; "
    if omission.instead == "changed lanes":
        return ""
    if omission.kind == "red light":
        return f"{agent} did not stop for a red light; "
    if omission.instead == "braked too little":
        return f"{agent} braked too little; "
    verb = "yield" if omission.kind == "crossing" and had_to_yield else "brake"
    instead = describe_instead(omission)
    return f"{agent} did not {verb}{f' and {instead}' if instead else ''}; "
