"""The cause of a crash in a form that can be counted, and the crash types of one cause."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from crashhunt.base.codec import Serializable
from crashhunt.crashes import Encounter

if TYPE_CHECKING:
    from collections.abc import Sequence

    from crashhunt.base.codec import JsonObject
    from crashhunt.crashes import Bundle, Judgement, Omission, Why
    from crashhunt.recording import Recording

__all__ = ["Cause", "CauseGroup", "cause_of", "features_of", "representatives", "spread"]

_LONG_M = 7.0  # a longer actor is a truck, a bus or a trailer, which agents that assume a car's length hit
_LOOKS_S = (0.2, 1.0, 2.0)  # before the crash
_SCALES = {"speed": 5.0, "gap": 5.0, "length": 4.0, "side": 1.0}  # m/s, m, m, 1: a difference that matters


@dataclass(frozen=True, slots=True, order=True)
class Cause(Serializable):
    """What a crash hangs on, according to runs. No speeds, identifiers and times: they differ from trial to trial.

    Args:
        kind: ``omission``, ``decision``, ``disturbance``, ``argument``, ``traffic``, ``software fault`` or ``unknown``.
        what: of an omission, what was disregarded, as in `Omission`. For a lane change into a gap that is not safe it
            is ``gap left`` or ``gap right``. Of a decision it is what the agent did, of a disturbance its type, of an
            argument its name.
        instead: what the agent did instead of what it omitted.
        actor: ``long`` where the disregarded actor is longer than a car, else empty.
    """

    kind: str
    what: str = ""
    instead: str = ""
    actor: str = ""

    def __str__(self) -> str:
        actor = "a long vehicle" if self.actor == "long" else "a vehicle"
        if self.kind != "omission":
            return f"{self.kind}: {self.what}" if self.what else self.kind
        relation, _, side = self.what.rpartition(" ")
        if relation == "no lane":
            return f"omission: changes to the {side}, where it has no lane"
        if self.instead == "changed lanes":
            return f"omission: changes to the {side} lane into a gap that is not safe"
        known = {"red light": "stop for a red light", "crossing": "yield"}
        return f"omission: does not {known.get(self.what, f'brake for {actor}')}, {self.instead}"


@dataclass(frozen=True, slots=True, kw_only=True)
class CauseGroup:
    """Crashes of one crash type with one cause.

    Args:
        cause: of all of them.
        members: the crashes, the first one found first.
        judged: those of them whose cause was found by runs; the others have the cause of the nearest of all such.
    """

    cause: Cause
    members: tuple[Bundle, ...]
    judged: tuple[Bundle, ...]

    @property
    def shortest(self) -> Bundle:
        """The one with the fewest steps."""
        return min(self.members, key=lambda bundle: bundle.result.steps)

    def to_json(self) -> JsonObject:
        """Return the shape that ``crashes --by-cause --json`` prints."""
        return {
            "cause": self.cause.to_json(),
            "words": str(self.cause),
            "count": len(self.members),
            "shortest": str(self.shortest.path),
            "members": [str(bundle.path) for bundle in self.members],
            "judged": [str(bundle.path) for bundle in self.judged],
        }


def cause_of(bundle: Bundle, judgement: Judgement | None) -> Cause:
    """Return the cause of a crash from what its runs have shown; ``unknown`` where they do not say.

    Args:
        bundle: the crash.
        judgement: what its runs have shown; None where it has not been judged.
    """
    if bundle.result.outcome.is_software_fault:
        return Cause("software fault")
    if judgement is None:
        return Cause("unknown")
    if judgement.reference is not None and judgement.reference.omission is not None:
        return _of_omission(bundle, judgement.reference.omission)
    return _of_factors(judgement.why) if judgement.why is not None else Cause("unknown")


def _of_omission(bundle: Bundle, omission: Omission) -> Cause:
    """Of a lane change only the side counts: whether a vehicle is ahead, behind or alongside is chance."""
    relation, _, side = omission.kind.rpartition(" ")
    if omission.instead == "changed lanes" and relation != "no lane":
        return Cause("omission", f"gap {side}", omission.instead)
    long = _length(bundle.recording(), omission.actor) > _LONG_M
    return Cause(kind="omission", what=omission.kind, instead=omission.instead, actor="long" if long else "")


def _of_factors(why: Why) -> Cause:
    """Return the first kind of factor, in a fixed order, without which no run crashed."""
    needed = [factor for factor in why.factors if factor.needed and factor.clear > 1]
    needed += [factor for factor in why.factors if factor.needed and factor.clear == 1 and factor.what == "default"]
    for kind, word in (("agent", "decision"), ("disturbance", "disturbance"), ("argument", "argument")):
        for factor in needed:
            if factor.kind == kind:
                return Cause(word, factor.name if kind == "argument" else factor.what)
    return Cause("traffic") if needed else Cause("unknown")


def _length(recording: Recording, actor: str) -> float:
    return next((one.length for one in recording.actors if one.id == actor), 0.0)


def features_of(bundle: Bundle) -> tuple[float, ...]:
    """Return what distinguishes crashes of one type without runs, in units of a difference that matters.

    Speeds and gap 0.2 s, 1 s and 2 s before the crash, the length of the collision partner, and the lateral offset of
    the partner one second before.

    Args:
        bundle: the crash; its log is read.
    """
    hit = bundle.result.collision
    if hit is None or not hit.other:
        return ()
    recording = bundle.recording()
    encounter = Encounter(recording, hit.agent, hit.other)
    moments = encounter.moments
    found = []
    for before_s in _LOOKS_S:
        end_s = moments[-1].time_s if moments else 0.0
        moment = next(
            (one for one in reversed(moments) if one.time_s <= end_s - before_s), moments[0] if moments else None
        )
        values = (0.0, 0.0, 0.0) if moment is None else (moment.speed, moment.other_speed, min(moment.gap_m, 50.0))
        found += [values[0] / _SCALES["speed"], values[1] / _SCALES["speed"], values[2] / _SCALES["gap"]]
    found.append(_length(recording, hit.other) / _SCALES["length"])
    return tuple(found)


def representatives(features: Sequence[tuple[float, ...]], steps: Sequence[int], count: int) -> list[int]:
    """Return the places of the crashes to judge: the shortest, then each time the one furthest from those chosen.

    Args:
        features: of each crash, as `features_of` returns them.
        steps: of each crash.
        count: how many at most.
    """
    if not features:
        return []
    chosen = [min(range(len(steps)), key=lambda place: (steps[place], place))]
    while len(chosen) < min(count, len(features)):
        away = [min(_distance(one, features[place]) for place in chosen) for one in features]
        left = [place for place in range(len(features)) if place not in chosen]
        chosen.append(max(left, key=lambda place: (away[place], -place)))
    return chosen


def spread(features: Sequence[tuple[float, ...]], known: dict[int, Cause]) -> list[Cause]:
    """Return the cause of each crash: its own where it was judged, else that of the nearest judged one.

    Args:
        features: of each crash.
        known: place to cause; at least one.
    """
    places = sorted(known)
    return [
        known[place] if place in known else known[min(places, key=lambda other: _distance(features[other], one))]
        for place, one in enumerate(features)
    ]


def _distance(one: tuple[float, ...], other: tuple[float, ...]) -> float:
    return math.dist(one, other) if len(one) == len(other) else math.inf
