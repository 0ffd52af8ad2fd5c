"""Compares what is said of collisions with the recording, by rules that share no code with the descriptions."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from crashhunt.base import layout
from crashhunt.base.errors import BundleError
from crashhunt.crashes import contact_record, fault_of, list_bundles, signature_of
from crashhunt.crashes._fault import fault_in
from crashhunt.crashes._lanes import LaneMap
from crashhunt.recording import read_lanes
from crashhunt.trial import Outcome
from crashhunt.world import Scene, is_person, lane_jump, poses_between

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from crashhunt.crashes import Bundle, ContactRecord, Fault, Signature
    from crashhunt.recording import Recording
    from crashhunt.trial import Collision

_JUMP_M, _STANDS_MPS, _SPEED_MPS, _ANGLE = 1.5, 0.1, 0.05, math.radians(2)
_NEAR_M, _LATELY_S = 70.0, 25.0
_SHIFTS = (0.25, 0.5, 0.75)
_LOOKS_BACK_S = 5.0
_LEFT_RIGHT = {"left": "right", "right": "left"}


@dataclass(frozen=True)
class Party:
    """An actor of a collision, as the last two scenes of the recording show it.

    Args:
        stood: whether it stood in both scenes, at the same place.
        sideways_m: how far it moved to its left between them, in m.
        speeds: in both scenes, in m/s.
        headings: in both scenes, in rad.
        center: in the first of them, in m.
        length: in m.
        width: in m.
    """

    stood: bool
    sideways_m: float
    speeds: tuple[float, float]
    headings: tuple[float, float]
    center: tuple[float, float]
    length: float
    width: float


def party(before: Scene, after: Scene, actor: str) -> Party:
    """Return an actor of a collision."""
    was, row = before.roster.index[actor], after.roster.index[actor]
    known = after.roster.actors[row]
    (x0, y0), (x1, y1) = before.points[was], after.points[row]
    heading, turned = before.headings[was], math.remainder(after.headings[row] - before.headings[was], math.tau)
    dx, dy, middle = x1 - x0, y1 - y0, heading + turned / 2
    speeds = before.speeds[was], after.speeds[row]
    moved = math.hypot(dx, dy) / (after.time_s - before.time_s)
    return Party(
        stood=max(*speeds, moved) < _STANDS_MPS,
        sideways_m=dy * math.cos(middle) - dx * math.sin(middle),
        speeds=speeds,
        headings=(heading, heading + turned),
        center=(x0 - known.length / 2 * math.cos(heading), y0 - known.length / 2 * math.sin(heading)),
        length=known.length,
        width=known.width,
    )


def contradictions(
    bundle: Bundle, recording: Recording, hit: Collision, signature: Signature, fault: Fault
) -> Iterator[str]:
    """Yield what the descriptions of a collision say that cannot be."""
    scenes = recording.scenes()
    before, after = scenes[-2:]
    parties = {actor: party(before, after, actor) for actor in (hit.agent, hit.other)}
    collider, victim = parties[hit.collider], parties[hit.victim]
    if collider.stood and not victim.stood:
        yield "an actor that stood drove into one that moved"
    step_s = after.time_s - before.time_s
    share = min(1.0, max(0.0, (hit.time_s - before.time_s) / step_s))
    jumpers = [name for name, one in parties.items() if abs(one.sideways_m) > _JUMP_M + 0.2 * abs(_turned(one))]
    if share > 1 - 1e-6 and len(jumpers) == 1 and not _overlap_before_jump(before, after, jumpers[0], hit):
        if hit.collider != jumpers[0]:
            yield "the actor that was moved into did the collision"
        if signature.manner == "rear end":
            yield "a rear end by a sideways jump"
    for one, speed, whose in ((collider, hit.collider_speed, "collider"), (victim, hit.victim_speed, "victim")):
        if not min(one.speeds) - _SPEED_MPS <= speed <= max(one.speeds) + _SPEED_MPS:
            yield f"the speed of the {whose} at the contact is none between the scenes"
    turn = abs(_difference(parties[hit.other], parties[hit.agent], share))
    yield from _against_manner(signature.manner, turn, hit, collider, victim, bool(jumpers))
    for finding in fault.findings:
        blamed = {"ego": hit.agent, "other": hit.other, "both": ""}[finding.blames]
        yield from _against_finding(finding.rule, finding.words, blamed, hit, signature.manner, parties)
    lanes = dict(zip((actor.id for actor in after.roster.actors), after.lanes, strict=False))
    if lanes and hit.lane != lanes[hit.agent] and not (hit.agent in jumpers and share < 1):
        yield "the lane is not the agent's"
    if bundle.confirmed and bundle.result.escape is None:
        yield "confirmed, with neither a braking sentence nor the reason"


def _against_manner(
    manner: str, turn: float, hit: Collision, collider: Party, victim: Party, jumped: bool
) -> Iterator[str]:
    if not manner or is_person(hit.agent) or is_person(hit.other):
        return  # the outlines contradict the simulator's report, and the type says nothing
    # In a bend, vehicles of one lane meet at any angle, and so do vehicles that come towards each other.
    low, high = {"head-on": (45, 180), "rear end": (0, 180), "side swipe": (0, 180)}.get(manner, (45, 135))
    if not math.radians(low) - _ANGLE <= turn <= math.radians(high) + _ANGLE:
        yield f"{manner.split(' from')[0]} at an angle of another type"
    heading = victim.headings[0]
    dx, dy = victim.center[0] - collider.center[0], victim.center[1] - collider.center[1]
    ahead, aside = dx * math.cos(heading) + dy * math.sin(heading), dy * math.cos(heading) - dx * math.sin(heading)
    if manner == "rear end" and turn <= math.radians(45):
        if hit.collider_speed <= hit.victim_speed:
            yield "a rear end with a slower collider"
        if ahead <= 0:
            yield "a rear end by the vehicle ahead"
    straight = max(abs(_turned(collider)), abs(_turned(victim)), turn) < math.radians(5)
    apart = abs(ahead) - (collider.length + victim.length) / 2
    if manner == "side swipe" and straight and not jumped and apart > 0 and abs(aside) < collider.width / 2:
        yield "a side swipe into the back"


def _against_finding(
    rule: str, words: str, blamed: str, hit: Collision, manner: str, parties: dict[str, Party]
) -> Iterator[str]:
    if "moved sideways" in words:
        if manner not in ("side swipe",):
            yield f"moved sideways into one beside it, and a {manner.split(' from')[0]}"
        if blamed and blamed != hit.collider and abs(parties[blamed].sideways_m) > _JUMP_M:
            yield "moved sideways into one that is the collider"
        if not blamed and min(abs(one.sideways_m) for one in parties.values()) < 0.02:
            yield "both moved sideways, and one did not"
    if "drove into the back" in words or "to behind" in words:
        if manner != "rear end":
            yield f"drove into the back, and a {manner.split(' from')[0]}"
        if blamed != hit.collider:
            yield "drove into the back, and is not the collider"
    if "was turning" in words and manner == "head-on":
        yield "turned off ahead of it, and head-on"
    if rule == "standing":
        if blamed != hit.collider or parties[blamed].stood:
            yield "blamed for driving into one that stood, and did not drive into it"
        if not next(one for name, one in parties.items() if name != blamed).stood:
            yield "stood, and moved"


def _turned(one: Party) -> float:
    return one.headings[1] - one.headings[0]


def _difference(other: Party, own: Party, share: float) -> float:
    turns = [one.headings[0] + share * _turned(one) for one in (other, own)]
    return math.remainder(turns[0] - turns[1], math.tau)


def _overlap_before_jump(before: Scene, after: Scene, jumper: str, hit: Collision) -> bool:
    """Whether they would have touched without the jump: the follower had caught up in the old lane."""
    own, its = (party(before, after, actor) for actor in (jumper, hit.other if jumper == hit.agent else hit.agent))
    heading = own.headings[0]
    dx, dy = its.center[0] - own.center[0], its.center[1] - own.center[1]
    return abs(dy * math.cos(heading) - dx * math.sin(heading)) < (own.width + its.width) / 2


# The same collision in another way: mirrored, rotated, or with its scenes taken at other instants.


def told(record: ContactRecord) -> tuple[str, ...]:
    """Return what is said of a contact, without what the map says of right of way."""
    touch, fault = record.touch, fault_in(replace(record, right_of_way=None))
    rules = sorted({f"{finding.rule} of {finding.blames}" for finding in fault.findings})
    changers = "+".join("agent" if one == record.agent else "other" for one in record.lane_changers(3.0))
    return (record.manner, "collider" if touch.drives_into else "victim", changers, fault.verdict, *rules)


def variants(record: ContactRecord, bundle: Bundle) -> Iterator[tuple[str, tuple[str, ...], bool]]:
    """Yield each variant with what is said of it, and whether left and right are exchanged."""
    around = record.touch.x, record.touch.y
    borders = [
        pair
        for pair in read_lanes(bundle.path / layout.LOG)
        if all((border.min(0) - _NEAR_M < around).all() and (border.max(0) + _NEAR_M > around).all() for border in pair)
    ]
    first_s = record.time_s - _LATELY_S
    record = replace(record, scenes=[scene for scene in record.scenes if scene.time_s >= first_s])
    for name, turn, flip in (("mirrored", 0.0, -1.0), ("rotated", 2.2, 1.0)):
        c, s = math.cos(turn), math.sin(turn)

        def moved(point: tuple[float, ...], c: float = c, s: float = s, flip: float = flip) -> tuple[float, ...]:
            x, y, *rest = point
            return (c * x - s * flip * y, s * x + c * flip * y, *rest)

        scenes = [
            Scene(
                scene.time_s, scene.roster, [moved(point) for point in scene.points],  # type: ignore[misc]
                [flip * heading + turn for heading in scene.headings], scene.speeds, lanes=scene.lanes,
                heights=scene.heights, grades=scene.grades,
                spines={row: tuple(moved(point) for point in spine) for row, spine in scene.spines.items()},  # type: ignore[misc]
            )
            for scene in record.scenes
        ]  # fmt: skip
        pairs = [
            tuple(np.array([moved(tuple(point)) for point in border]) for border in (pair if flip > 0 else pair[::-1]))
            for pair in borders
        ]
        lanes = LaneMap(pairs, moved(around))  # type: ignore[arg-type]
        yield name, told(replace(record, scenes=scenes, lanes=lanes)), flip < 0
    if any(scene.spines for scene in record.scenes[-2:]) or not record.swept or _jumped(record):
        return  # an instantaneous lane change takes place at the end of a step, so in a shifted step at another time
    for shift in _SHIFTS:
        yield "shifted", told(replace(record, scenes=_shifted(record, shift))), False


def _jumped(record: ContactRecord) -> bool:
    """Whether one of the actors has changed lanes in an instant, in the seconds that the rules look back."""
    since = [scene for scene in record.scenes if scene.time_s >= record.time_s - _LOOKS_BACK_S]
    return any(lane_jump(*pair, actor) for pair in pairwise(since) for actor in (record.agent, record.other))


def _shifted(record: ContactRecord, shift: float) -> list[Scene]:
    """Return scenes as if every step but the first had begun a share of a step later; the last one may be shorter."""
    found = list(record.scenes[:1])
    for before, after in zip(record.scenes, record.scenes[1:], strict=False):
        index = before.roster.index
        both = [actor for actor in after.roster.actors if actor.id in index]
        poses, speeds = [], []
        for actor in both:
            was, row = index[actor.id], after.roster.index[actor.id]
            size = actor.length, actor.width
            start = (*before.points[was], before.headings[was], *size)
            end = (*after.points[row], after.headings[row], *size)
            poses += poses_between(start, end, (shift,), bends=not is_person(actor.id))
            speeds.append((1 - shift) * before.speeds[was] + shift * after.speeds[row])
        roster = type(before.roster)(tuple(both))
        time_s = before.time_s + shift * (after.time_s - before.time_s)
        lanes = tuple(before.lanes[index[actor.id]] for actor in both) if before.lanes else ()
        found.append(Scene(time_s, roster, [pose[:2] for pose in poses], [pose[2] for pose in poses], speeds,
                           lanes=lanes))  # fmt: skip
        if time_s > record.time_s + 1e-6:
            return found
    return [*found, record.scenes[-1]]


def exchanged(words: tuple[str, ...]) -> tuple[str, ...]:
    """Return what is said with left and right exchanged."""
    side = words[0].rpartition(" ")[2]
    return (words[0].replace(side, _LEFT_RIGHT[side]), *words[1:]) if side in _LEFT_RIGHT else words


def described_again(hit: Collision, record: ContactRecord) -> Collision:
    """Return a collision of an earlier version as the oracles of this version describe it."""
    touch = record.touch
    speeds = touch.speed, touch.other_speed
    pair = record.agent, record.other
    return replace(
        hit,
        role="collider" if touch.drives_into else "victim",
        collider=pair[not touch.drives_into],
        victim=pair[touch.drives_into],
        collider_speed=speeds[not touch.drives_into],
        victim_speed=speeds[touch.drives_into],
        lane=record.lane,
        time_s=touch.time_s,
    )


def compare(folder: Path, *, again: bool = False, every: int = 1) -> int:
    """Print the table; return 1 where anything contradicts.

    Args:
        folder: of the hunts.
        again: describe the collisions of hunts by an earlier version again, instead of what it has saved.
        every: look at the variants of one in so many collisions; 0 leaves them out.
    """
    seen, wrong, differ, manners, verdicts = (
        Counter[str](),
        Counter[str](),
        Counter[str](),
        Counter[str](),
        Counter[str](),
    )
    braking, roles, silent, places = Counter[str](), Counter[str](), Counter[str](), set[str]()
    for hunt in sorted(folder.glob("hunts/*/hunt")):
        name, _, step = hunt.parent.name.rpartition("-")
        for bundle in list_bundles(hunt):
            hit = bundle.result.collision
            if bundle.result.outcome is not Outcome.COLLISION or hit is None or not hit.other:
                continue
            try:
                recording = bundle.recording()
            except BundleError as error:
                print(f"{bundle.path}: {error.message}")
                continue
            scenes = recording.scenes()
            if len(scenes) < 3 or any(
                one not in scene.roster.index for one in (hit.agent, hit.other) for scene in scenes[-2:]
            ):
                continue
            seen[step] += 1
            places.add(name.partition(":")[0])
            record = contact_record(bundle, recording)
            assert record is not None
            if again:
                hit = described_again(hit, record)
            described = replace(bundle, result=replace(bundle.result, collision=hit))
            signature, fault = signature_of(described, recording, record), fault_of(described, recording, record)
            manners[signature.manner] += 1
            verdicts[fault.verdict] += 1
            roles[hit.role] += 1
            if record.is_disputed and (signature.manner or fault.findings):
                wrong["the outlines contradict the report, and there is a type or a fault"] += 1
            if fault.verdict == "nobody can tell" and signature.manner == "rear end":
                silent[f"{step} s, {'first' if record.touch.share < 0.5 else 'second'} half"] += 1
            elif signature.manner == "rear end":
                silent[f"{step} s, {'first' if record.touch.share < 0.5 else 'second'} half, told"] += 1
            escape = bundle.result.escape
            if bundle.confirmed and not again:
                braking["none" if escape is None else "reason" if escape.why_not else "sentence"] += 1
            for what in contradictions(bundle, recording, hit, signature, fault):
                if again and "braking" in what:
                    continue
                wrong[what] += 1
                print(f"{hunt.parent.name} {bundle.id}: {what}; {signature}; {record.touch}", flush=True)
            said = told(record)
            for variant, words, mirrored in (
                variants(record, bundle) if every and sum(seen.values()) % every == 0 else ()
            ):
                differ[f"{variant}, all"] += 1
                if (exchanged(words) if mirrored else words) != said:
                    differ[variant] += 1
                    share = record.touch.share
                    print(f"{hunt.parent.name} {bundle.id}: {variant}, {share:.3f}: {said} -> {words}", flush=True)
    total = sum(seen.values())
    print(f"\n{total} collisions on {len(places)} networks; by step length: {dict(sorted(seen.items()))}")
    for title, counts in (
        ("type", manners),
        ("role", roles),
        ("fault", verdicts),
        ("rear ends without a verdict", silent),
        ("braking", braking),
        ("variants", differ),
    ):
        print(f"{title}: {dict(counts.most_common())}")
    print(f"contradictions: {sum(wrong.values())} {dict(wrong.most_common())}")
    return 1 if wrong else 0
