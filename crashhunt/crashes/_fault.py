"""The party at fault for a collision, by named rules with sources; undecided if no rule applies or rules disagree."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from crashhunt.base.codec import Serializable
from crashhunt.base.errors import CrashhuntError
from crashhunt.crashes._bundle import snapshot_of
from crashhunt.crashes._contact_record import SAME_WAY, ContactRecord, contact_record
from crashhunt.trial import Outcome
from crashhunt.world import STANDS_MPS, is_person, safe_distance

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from crashhunt.crashes import Bundle
    from crashhunt.recording import Recording
    from crashhunt.world import RightOfWay, StopLine


# The rules that assign the fault of a collision. A rule returns a finding only if it is certain.
#
# A rule reads a `ContactRecord` and returns a finding, or None where it does not apply. Names of sources: *Vienna* is
# the Convention on Road Traffic of 1968; *StVO* the German traffic code; *RSS* is S. Shalev-Shwartz, S. Shammah and
# A. Shashua, On a formal model of safe and scalable self-driving cars, 2017, with parameters like ad-rss-lib's.

Blame = Literal["ego", "other", "both"]

_RESPONSE_S = 1.0  # s, RSS: response time of the rear vehicle
_RSS_MAX_ACCELERATION_MPS2 = 3.5  # m/s², RSS: maximum acceleration of the rear vehicle in its response time
_RSS_MIN_BRAKING_MPS2 = 4.0  # m/s², RSS: minimum braking of the rear vehicle after its response time
_RSS_MAX_BRAKING_MPS2 = 8.0  # m/s², RSS: maximum braking of the front vehicle
_MAX_MERGE_ANGLE_RAD = math.radians(30)  # at a smaller angle, a vehicle follows the other or changes lanes
_IMPOSSIBLE_BRAKING_MPS2 = 10.0  # m/s²: no brake decelerates more, so the vehicle hit something or was stopped
_FOLLOWS_S = 3.5  # s: a vehicle that was ahead for longer did not just enter the path
_CHANGE_S = 3.0  # s: a lane change that began earlier is complete
_AT_ONCE_S = 1.5  # s before the contact: a driver behind cannot react to a later event
_TOGETHER_S = 0.5  # s: if two vehicles move within this time, neither was there first
_STANDS_S = 1.0  # s: an actor that stood for less time may only have paused
_STEP_M = 1.0  # m from the side of a car: a nearer person walks in the path of the car
_OFF_M = 2.5  # m from the axis of a car: a nearer person may already be on the road
_WALKING_SPEED_MPS = 3.0  # m/s: a slower vehicle can stop for any actor
_CLEARS_S = 3.0  # s before the contact: a vehicle that stood or was inside a junction for so long could be seen
_INSERTED_S = 1.0  # s after an actor has entered: earlier crashes result from the place where it was inserted
_SOURCES = {"red_light": "Vienna, article 23; StVO § 37", "wrong_way": "Vienna, article 10; StVO § 2"}
_RED_S = 8.0  # s: a vehicle that ran a red light has left the junction after this time


@dataclass(frozen=True, slots=True)
class FaultFinding(Serializable):
    """The verdict of a fault rule."""

    rule: str  # name of the rule
    blames: Blame  # the party at fault: ``ego``, the other actor, or both
    words: str  # the evidence, as a clause of a sentence
    source: str  # source of the rule, such as a law or a paper

    json_keys = ("rule", "blames=blamed", "words", "source")

    @property
    def blamed(self) -> Verdict:
        """The party at fault, in the words of a `Verdict`."""
        return _VERDICT_BY_ACTOR[self.blames]


def safe_gap_m(speed: float, ahead: float) -> float:
    """Return the safe gap to the vehicle ahead, in m, by lemma 2 of RSS; speeds are in m/s."""
    return safe_distance(
        speed, ahead, response_s=_RESPONSE_S, acceleration_mps2=_RSS_MAX_ACCELERATION_MPS2,
        braking_mps2=_RSS_MIN_BRAKING_MPS2, front_braking_mps2=_RSS_MAX_BRAKING_MPS2,
    )  # fmt: skip


def _blaming(case: ContactRecord, actor: str, rule: str, words: str, source: str) -> FaultFinding:
    """Return the finding of a rule that blames one actor of the contact."""
    return FaultFinding(rule=rule, blames="ego" if actor == case.agent else "other", words=words, source=source)


def _red_light(case: ContactRecord) -> FaultFinding | None:
    """Blame the actor that ran a red light at a junction with traffic from another side; blame both if both did."""
    if case.same_way:
        return None
    ran: dict[str, str] = {}
    for time_s, event in case.events:
        if event.kind != "red_light" or event.agent not in (case.agent, case.other) or case.time_s - time_s > _RED_S:
            continue
        if not case.is_past(event, time_s):
            ran[event.agent] = f"{event.what}, {case.ago(case.time_s - time_s)}"
    if not ran:
        return None
    found = _blaming(case, next(iter(ran)), "red light", ", and ".join(ran.values()), _SOURCES["red_light"])
    return replace(found, blames="both") if len(ran) == 2 else found


def _wrong_way(case: ContactRecord) -> FaultFinding | None:
    """Blame the vehicle that drove, wholly or partly, on the oncoming lane, as when it overtakes there."""
    if case.same_way:
        return None
    against = {actor: case.is_against_its_lane(actor) for actor in (case.agent, case.other)}
    for time_s, event in reversed(case.events):
        if event.kind == "wrong_way" and event.agent in against and case.time_s - time_s <= _RED_S:
            if against[event.agent] is False or against[case.partner(event.agent)]:
                continue  # it has returned to a lane of its direction
            return _blaming(case, event.agent, "wrong way", event.what, _SOURCES["wrong_way"])
    wholly = any(against.values())
    is_wrong = case.is_against_its_lane if wholly else case.reaches_oncoming_lane
    wrong = [actor for actor in against if is_wrong(actor)]
    if len(wrong) != 1 or not case.is_oncoming:
        return None
    (driver,) = wrong
    other = case.partner(driver)
    lately = [back for back, time_s in enumerate(case.times) if time_s <= _CHANGE_S]
    if any(is_person(actor) or case.way(actor).speeds[lately].max() < STANDS_MPS for actor in against):
        return None  # a vehicle that stands may be parked, and a place to park has no direction
    if any(case.is_against_its_lane(other, back) is not False for back in (None, *lately)):
        return None  # it may have come there from another road, or have been on the wrong side as well
    strays = case.is_over_side(other) if wholly else not case.is_inside_its_lanes(other)
    if strays or (not wholly and any(case.reaches_oncoming_lane(other, back) for back in lately)):
        return None
    since = lately[-1]
    while since >= lately[0] and is_wrong(driver, since):
        since -= 1
    since_s = float(case.times[since + 1]) if since < lately[-1] else 0.0
    when = f"for the last {since_s:.1f} s" if since_s else "just before the contact"
    if not wholly:
        words = f"{driver} was partly in the oncoming lane {when}, and {other} was wholly in its own lane"
        return _blaming(case, driver, "wrong way", words, "Vienna, articles 10 and 12; StVO § 2")
    words = f"{driver} drove against the direction of its lane {when}, towards {other}, which stayed in its lane"
    return _blaming(case, driver, "wrong way", words, "Vienna, articles 10 and 11; StVO §§ 2 and 5")


def _lane_change(case: ContactRecord) -> FaultFinding | None:
    """Blame a vehicle that changed lanes into an occupied gap, or into a gap too short for the vehicle behind."""
    if not case.lanes or not case.same_way:
        return None
    changed = {actor: case.changed_s(actor) for actor in (case.agent, case.other)}
    changers = [actor for actor, before in changed.items() if before is not None and before <= _CHANGE_S]
    source = "Vienna, articles 11 and 14; StVO § 7 (5)"
    if len(changers) == 2 and len(case.jumpers) == 1:
        return _into_changed_vehicle(case, case.jumpers[0], source)
    if len(changers) == 2:
        times = [before for before in changed.values() if before is not None]
        at_once = abs(times[0] - times[1]) <= _TOGETHER_S
        if case.follower or not at_once or not all(case.meets_sideways(actor) for actor in changers):
            return None  # the one may have been there when the other came
        return FaultFinding(
            rule="lane change", blames="both", words="both moved sideways into each other", source=source
        )
    if len(changers) != 1:
        return None
    changer = changers[0]
    other, before = case.partner(changer), changed[changer]
    assert before is not None
    if case.drifted(other) or case.turned(before) > SAME_WAY:
        return None  # in a bend or a roundabout, lanes lead apart and together
    if not case.follower:
        if not case.meets_sideways(changer):
            return None
        words = f"{changer} moved sideways into {other}, which was next to it and stayed in its lane"
        return _blaming(case, changer, "lane change", words, source)
    if case.follower == changer:
        if case.hardest_braking(other) > _IMPOSSIBLE_BRAKING_MPS2 or case.way(other).speeds[-1] < -STANDS_MPS:
            return None
        if case.turned(before) >= _MAX_MERGE_ANGLE_RAD or not case.was_off_path(
            changer, int(np.argmin(np.abs(case.times - before)))
        ):
            return None  # it turned off, or was behind all the time: that leaves a lane sideways, too
        words = f"{changer} changed lanes {case.ago(before)}, to behind {other}, and drove into it"
        return _blaming(case, changer, "lane change", words, source)
    return _cut_in(case, changer, before, source)


def _into_changed_vehicle(case: ContactRecord, changer: str, source: str) -> FaultFinding | None:
    """Blame an actor that jumped into a vehicle which had been in this lane, wholly or in part, for long enough."""
    other = case.partner(changer)
    since, reached = case.changed_s(other), case.reached_in_s(changer)
    if since is not None and since >= _RESPONSE_S - 1e-6 and case.turned(since) <= SAME_WAY:
        words = f"which had changed to the lane next to it {case.ago(since)}"
    elif reached >= _RESPONSE_S - 1e-6 and case.turned(reached) <= SAME_WAY:
        words = f"a part of which had been in this lane for at least {reached:.1f} s"
    else:
        return None  # the other may have been about to change as well, or came there in a bend
    words = f"{changer} moved sideways into {other}, {words}"
    return _blaming(case, changer, "lane change", words, source)


def _cut_in(case: ContactRecord, changer: str, before: float, source: str) -> FaultFinding | None:
    """Blame a vehicle that cut in, by the size of its gap and by what the driver behind could do."""
    other = case.partner(changer)
    back = int(np.argmin(np.abs(case.times - before)))
    if not case.was_off_path(changer, back):
        return None  # it was ahead, and left
    gap = case.gap_m(changer, back)
    safe = safe_gap_m(float(case.way(other).speeds[back]), float(case.way(changer).speeds[back]))
    words = f"{changer} changed lanes {case.ago(before)}, {max(0.0, gap):.1f} m ahead of {other}"
    if gap >= safe:
        return None
    if before > _AT_ONCE_S and case.slowed(other, before - _RESPONSE_S) < _RSS_MIN_BRAKING_MPS2:
        return None  # who drove behind had the time, and did not use it
    return _blaming(case, changer, "lane change", f"{words}; {safe:.1f} m would have been safe (RSS)", source)


def _rear_end(case: ContactRecord) -> FaultFinding | None:
    """Blame the follower that drove into the back of a vehicle that had been ahead of it for long."""
    follower = case.follower
    if not follower or is_person(case.partner(follower)):
        return None
    leader = case.partner(follower)
    ahead_s = case.in_its_way_s(leader)
    if ahead_s < _FOLLOWS_S or case.hardest_braking(leader) > _IMPOSSIBLE_BRAKING_MPS2:
        return None
    lead, follow = case.way(leader), case.way(follower)
    if min(lead.speeds[-1], case.speed_at_contact(leader)) < -STANDS_MPS:
        return None  # it reversed
    back = int(np.argmin(np.abs(case.times - min(ahead_s, _FOLLOWS_S))))
    gap, safe = max(0.0, case.gap_m(leader, back)), safe_gap_m(float(follow.speeds[back]), float(lead.speeds[back]))
    words = f"{follower} drove into the back of {leader}, which had been ahead of it for at least {_FOLLOWS_S:g} s"
    words += f"; {case.ago(case.times[back])}, the gap was {gap:.1f} m, and {safe:.1f} m is safe (RSS)"
    return _blaming(case, follower, "rear end", words, "Vienna, article 13 (5); StVO § 4 (1); RSS, definition 1")


def _turns_off(case: ContactRecord) -> FaultFinding | None:
    """Blame the follower that drove straight on into a turning vehicle that had been ahead of it for long."""
    for leader in (case.agent, case.other):
        follower = case.partner(leader)
        if case.follower == leader or is_person(leader) or is_person(follower) or case.times[0] < _FOLLOWS_S:
            continue
        left_s = case.turns_off_s(leader)
        if left_s is None or left_s > _AT_ONCE_S:
            continue
        lead = case.way(leader)
        if case.hardest_braking(leader) > _IMPOSSIBLE_BRAKING_MPS2 or float(lead.speeds.min()) < -STANDS_MPS:
            continue
        if _rear_end(case) is not None:
            return None  # it says the same
        words = f"{follower} drove straight on into {leader}, which had been ahead of it until {case.ago(left_s)}"
        words += " and was turning"
        return _blaming(case, follower, "rear end", words, "Vienna, article 13 (5); StVO § 4 (1)")
    return None


def _steps_out(case: ContactRecord) -> FaultFinding | None:
    """Blame a pedestrian who stepped onto the road too late for drivers to stop, except at junctions and crossings."""
    person, driver = (case.agent, case.other) if is_person(case.agent) else (case.other, case.agent)
    if not is_person(person) or is_person(driver) or not case.is_between_junctions(person, driver):
        return None
    asides = [abs(case.aside_m(person, back)) for back in range(len(case.times))]
    way, reach = case.way(driver), case.way(driver).width / 2 + _STEP_M
    inside = next((back for back in range(len(asides) - 1, -1, -1) if asides[back] > reach), -1) + 1
    if not 0 < inside < len(asides) or max(asides[:inside]) < _OFF_M or case.times[inside] > _AT_ONCE_S:
        return None  # the person was there all the time, walked along the edge of the road, or is still off the road
    speed, gap = float(way.speeds[inside]), case.gap_m(person, inside)
    stops = speed * _RESPONSE_S + speed * speed / (2 * _RSS_MAX_BRAKING_MPS2)
    if gap >= stops or speed < _WALKING_SPEED_MPS or float(np.max(case.times[:inside], initial=0.0)) < _STANDS_S:
        return None
    words = f"{person} came onto the road {case.ago(case.times[inside])}, {max(0.0, gap):.1f} m ahead of {driver}"
    words += f", which needs {stops:.1f} m to stop"
    return _blaming(case, person, "steps out", words, "Vienna, article 20 (6); StVO § 25 (3)")


def _standing(case: ContactRecord) -> FaultFinding | None:
    """Blame the actor that drove into an actor that had stood still for longer than the stopping time."""
    mover = case.collider
    actor = case.partner(mover)
    its = case.way(mover)
    needs = max(_STANDS_S, _RESPONSE_S + float(its.speeds.max()) / _RSS_MIN_BRAKING_MPS2)
    stood = case.stood_s(actor)
    if stood < needs or is_person(mover):
        return None
    words = f"{mover} drove into {actor}, which had stood for at least {stood:.1f} s"
    return _blaming(case, mover, "standing", words, "Vienna, article 13 (1); StVO § 3 (1)")


def _right_of_way(case: ContactRecord) -> FaultFinding | None:
    """Blame the vehicle that had to yield according to the map, at junctions without traffic lights."""
    found = _yielding(case)
    if found is None:
        return None
    yields, junction = found
    goes = case.partner(yields)
    if float(case.way(goes).speeds.min()) < STANDS_MPS or case.drifted(yields) or case.drifted(goes):
        return None  # who had stood in the junction may have been let through
    if case.is_over_side(goes):
        return None  # inside its lane, it might not have been hit
    if float(case.way(yields).speeds[case.times <= _CLEARS_S].max(initial=0.0)) < STANDS_MPS:
        return None  # who has stood there for so long could be seen
    if case.was_in_junction(yields, _CLEARS_S) and case.speed_mps(goes, _CLEARS_S) < _WALKING_SPEED_MPS:
        return None  # a vehicle that starts off must let the vehicle inside the junction clear it first
    words = f"{yields} had to give way to {goes} at the junction {junction}"
    return _blaming(case, yields, "right of way", words, "the map of the scenario; Vienna, article 18; StVO § 8")


def _yielding(case: ContactRecord) -> tuple[str, str] | None:
    """Return the actor that the map's rules order to yield to the other one, and the junction; None if unknown."""
    rights = case.right_of_way
    if rights is None or case.turn < _MAX_MERGE_ANGLE_RAD or not case.before:
        return None
    places = {actor: case.links(actor) for actor in (case.agent, case.other)}
    if not all(places.values()):
        return None
    links = [rights.links[place] for found in places.values() for place in found]
    if len({link.junction for link in links}) != 1 or any(link.signalised for link in links):
        return None
    pairs = [(one, two) for one in places[case.agent] for two in places[case.other]]
    gives = {(pair in rights.gives_way, pair[::-1] in rights.gives_way) for pair in pairs}
    if gives not in ({(True, False)}, {(False, True)}):
        return None  # both, neither, or it depends on where they were going
    return (case.agent if gives == {(True, False)} else case.other), links[0].junction


RULES: tuple[Callable[[ContactRecord], FaultFinding | None], ...] = (
    _red_light, _wrong_way, _lane_change, _rear_end, _turns_off, _steps_out, _standing, _right_of_way,
)  # fmt: skip
"""All rules. If two rules blame different parties, the fault is undecided. As an exception, a red light and the wrong
way take precedence over the right of way."""


Verdict = Literal["ego", "the other", "both", "nobody can tell"]
_VERDICT_BY_ACTOR: dict[str, Verdict] = {"ego": "ego", "other": "the other", "both": "both"}
_DECISIVE_RULES = ("red light", "wrong way")


@dataclass(frozen=True, slots=True)
class Fault(Serializable):
    """The vehicle at fault for a crash."""

    verdict: Verdict  # the vehicle at fault; ``ego`` is the controlled vehicle that crashed
    # the verdicts of the rules; they contradict each other in some undecided cases
    findings: tuple[FaultFinding, ...] = ()

    json_keys = ("verdict", "findings")

    @property
    def is_egos(self) -> bool:
        """Return whether the agent was at fault, alone or together with the other actor."""
        return self.verdict in ("ego", "both")


def fault_of(bundle: Bundle, recording: Recording | None = None, record: ContactRecord | None = None) -> Fault:
    """Return the vehicle at fault for a crash; no code of the bundle runs.

    Raises:
        BundleError: the log of the crash is missing or damaged.
    """
    result = bundle.result
    hit = result.collision
    if result.outcome is Outcome.AGENT_ERROR:
        return _egos("agent error", "the code of the agent failed", "the agent controls the vehicle")
    if result.outcome is Outcome.OFF_ROAD and hit is not None and not hit.other:
        return _egos(
            "off the road", "it left the road without contact with an actor", "Vienna, article 13 (1); StVO § 3 (1)"
        )
    event = result.event
    if event is not None and event.kind in _SOURCES:  # crash.json has no length of a step
        dt = result.step_length_s or (recording or bundle.recording()).prologue.step_length_s
        if result.steps * dt >= _INSERTED_S:
            return _egos(event.kind.replace("_", " "), event.what, _SOURCES[event.kind])
    if result.outcome is not Outcome.COLLISION or hit is None or not hit.other:
        return Fault("nobody can tell")
    contact = record or contact_record(bundle, recording)
    if contact is None:
        return Fault("nobody can tell")
    return fault_in(replace(contact, right_of_way=_right_of_way_of(bundle)))


def _egos(rule: str, words: str, source: str) -> Fault:
    return Fault("ego", (FaultFinding(rule=rule, blames="ego", words=words, source=source),))


def fault_in(case: ContactRecord) -> Fault:
    """Return the fault for a collision according to the rules."""
    if len(case.before) < 2 or case.time_s - max(case.began_s, case.before[0].time_s) < _INSERTED_S:
        return Fault("nobody can tell")
    if case.is_disputed:
        return Fault("nobody can tell")
    findings = tuple(finding for rule in RULES if (finding := rule(case)) is not None)
    return Fault(_verdict(findings), findings)


def _verdict(findings: Iterable[FaultFinding]) -> Verdict:
    found = list(findings)
    first = [one for one in found if one.rule in _DECISIVE_RULES]
    if first:
        found = [one for one in found if one.rule != "right of way"]
    blamed = {one.blames for one in found}
    return _VERDICT_BY_ACTOR[blamed.pop()] if len(blamed) == 1 else "nobody can tell"


def _right_of_way_of(bundle: Bundle) -> RightOfWay | None:
    try:
        scenario = snapshot_of(bundle).scenario
        ask = scenario.backend.right_of_way
        return ask(scenario) if ask is not None else None
    except (CrashhuntError, OSError):
        return None


def yielding_actor(bundle: Bundle, contact: ContactRecord | None) -> str:
    """Return the actor of a contact that had to yield by the map; empty if the map does not decide it."""
    if contact is None or contact.is_disputed or len(contact.before) < 2:
        return ""
    found = _yielding(replace(contact, right_of_way=_right_of_way_of(bundle)))
    return found[0] if found is not None else ""


def stop_lines_of(bundle: Bundle) -> tuple[StopLine, ...]:
    """Return the stop lines of a crash's map; none if the simulator has none, or the scenario is not in the hunt."""
    try:
        scenario = snapshot_of(bundle).scenario
        ask = scenario.backend.stop_lines
        return ask(scenario) if ask is not None else ()
    except (CrashhuntError, OSError):
        return ()
