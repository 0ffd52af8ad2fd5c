"""The cause of a crash, in a form that can be counted, and the groups of crashes with the same cause."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from crashhunt.base.codec import JsonObject, Serializable
from crashhunt.crashes import Encounter

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from crashhunt.crashes import Bundle, Factor, Group, Judgement, Omission, Why
    from crashhunt.recording import Recording
    from crashhunt.world import Scene

_LONG_M = 7.0  # a longer actor is a truck, a bus or a trailer, which agents that assume a car's length hit
_DEFECTS = ("omission", "decision", "disturbance", "argument")  # the kinds of causes that name what to fix
_LOOKS_S = (0.2, 1.0, 2.0)  # before the crash
_RELEVANT_DIFFERENCES = {"speed": 5.0, "gap": 5.0, "aside": 1.5, "length": 4.0}  # m/s, m: a difference that matters
_MAX_GAP_M, _MAX_ASIDE_M = 50.0, 5.0  # further away, the distance makes no difference


@dataclass(frozen=True, slots=True, order=True)
class Cause(Serializable):
    """The cause of a crash, as determined by runs.

    A cause contains no speeds, identifiers or times, because these differ between trials.
    """

    # type of the cause: ``omission``, ``decision``, ``disturbance``, ``argument``, ``traffic``, ``software fault`` or
    # ``unknown``
    kind: str
    # For an omission, what the agent disregarded, as in `Omission`. For a lane change into an unsafe gap, ``gap left``
    # or ``gap right``. For a decision, the action of the agent; for a disturbance, its type; for an argument, its name.
    what: str = ""
    instead: str = ""  # the action of the agent in place of the omitted action
    actor: str = ""  # the text ``long`` if the disregarded actor is longer than a car, else empty

    @property
    def is_defect(self) -> bool:
        """Whether the cause names what to fix, so that crashes of different types with this cause are one defect.

        The causes ``traffic``, ``software fault`` and ``unknown`` name nothing. Their crashes may have different
        defects, so the crash type has to distinguish them.
        """
        return self.kind in _DEFECTS

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
        what = known.get(self.what, f"brake for {actor}")
        if self.instead == "braked too little":
            return f"omission: brakes too little {f'for {actor}' if self.what == 'vehicle' else f'to {what}'}"
        # Whether an agent kept its speed before the last 2 s is not a part of the cause.
        return f"omission: does not {what}{', and speeds up' if self.instead == 'sped up' else ''}"


@dataclass(frozen=True, slots=True, kw_only=True)
class CauseGroup:
    """Crashes of the same crash type with the same cause."""

    cause: Cause  # the common cause of the crashes
    members: tuple[Bundle, ...]  # the crashes, in the order in which they were found
    # the crashes whose cause was determined by runs. Every other crash is given the cause of the most similar judged
    # crash.
    judged: tuple[Bundle, ...]

    @property
    def shortest(self) -> Bundle:
        """The crash with the fewest steps."""
        return min(self.members, key=lambda bundle: bundle.result.steps)

    def to_json(self) -> JsonObject:
        """Return the group in the form that ``crashes --by-cause --json`` prints."""
        return {
            "cause": self.cause.to_json(),
            "words": str(self.cause),
            "count": len(self.members),
            "shortest": str(self.shortest.path),
            "members": [str(bundle.path) for bundle in self.members],
            "judged": [str(bundle.path) for bundle in self.judged],
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class CauseType:
    """Crashes with the same cause, of one crash type or several: what a user would report as one defect."""

    cause: Cause  # the common cause of the crashes
    # the crash types of the crashes, each with the crashes that have this cause, the most frequent first
    variants: tuple[tuple[Group, CauseGroup], ...]

    @property
    def count(self) -> int:
        """The number of crashes that have a bundle."""
        return sum(len(part.members) for _, part in self.variants)

    @property
    def shortest(self) -> Bundle:
        """The crash with the fewest steps."""
        return min((part.shortest for _, part in self.variants), key=lambda bundle: bundle.result.steps)

    def to_json(self) -> JsonObject:
        """Return the crashes in the form that ``crashes --by-cause --json`` prints."""
        return {
            "cause": self.cause.to_json(),
            "words": str(self.cause),
            "count": self.count,
            "shortest": str(self.shortest.path),
            "types": [
                {"words": str(group.signature), "count": len(part.members), "judged": len(part.judged)}
                for group, part in self.variants
            ],
        }


def join_causes(groups: Sequence[Group], causes: Sequence[Sequence[CauseGroup]]) -> tuple[CauseType, ...]:
    """Return the crashes by cause across crash types, the most frequent first.

    Crashes of different types with the same defect are one entry. If the cause names no defect, each crash type is an
    entry.
    """
    lengths = without_chance_lengths({part.cause for parts in causes for part in parts})
    found: dict[object, list[tuple[Group, CauseGroup]]] = {}
    for group, parts in zip(groups, causes, strict=True):
        for part in parts:
            cause = lengths[part.cause]
            found.setdefault(cause if cause.is_defect else (cause, group.signature), []).append((group, part))
    joined = [
        CauseType(
            cause=lengths[variants[0][1].cause],
            variants=tuple(sorted(variants, key=lambda variant: -len(variant[1].members))),
        )
        for variants in found.values()
    ]
    return tuple(sorted(joined, key=lambda one: -one.count))


def count_causes(joined: Sequence[CauseType]) -> tuple[int, int]:
    """Return the number of crash types by cause as a hunt counts them, and the number of crashes that it omits.

    Crashes of an unknown cause may have a cause of the same crash type that already counts. An unknown cause therefore
    counts only if the crash type has no other cause.
    """
    caused = {group.signature for one in joined if one.cause.kind != "unknown" for group, _ in one.variants}
    rest = [one for one in joined if one.cause.kind == "unknown" and one.variants[0][0].signature in caused]
    return len(joined) - len(rest), sum(one.count for one in rest)


def without_chance_lengths(causes: Collection[Cause]) -> dict[Cause, Cause]:
    """Return each cause, without the length of the actor if another of these causes differs only in this length.

    A long actor belongs to the cause only if all disregarded actors were long. If the agent disregarded cars in the
    same way, the length is chance.
    """
    cars = {cause for cause in causes if not cause.actor}
    return {cause: bare if (bare := replace(cause, actor="")) in cars else cause for cause in causes}


def cause_of(bundle: Bundle, judgement: Judgement | None) -> Cause:
    """Return the cause of a crash from the results of its runs; ``unknown`` if they do not show a cause."""
    if bundle.result.outcome.is_software_fault:
        return Cause("software fault")
    if judgement is None:
        return Cause("unknown")
    if judgement.reference is not None and judgement.reference.omission is not None:
        return _of_omission(bundle, judgement.reference.omission)
    return _of_factors(judgement.why) if judgement.why is not None else Cause("unknown")


def _of_omission(bundle: Bundle, omission: Omission) -> Cause:
    """Return the cause for an omission.

    For a lane change, only the side counts, because the vehicle's position is chance.
    """
    relation, _, side = omission.kind.rpartition(" ")
    if omission.instead == "changed lanes" and relation != "no lane":
        return Cause("omission", f"gap {side}", omission.instead)
    long = _length(bundle.recording(), omission.actor) > _LONG_M
    return Cause(kind="omission", what=omission.kind, instead=omission.instead, actor="long" if long else "")


def _of_factors(why: Why) -> Cause:
    """Return the cause for the first factor, in a fixed order of factor kinds, without which no run crashed."""
    needed = [factor for factor in why.factors if factor.needed and factor.clear > 1]
    # An agent with another value meets the same traffic, so its default counts though there is only one such run.
    needed += [one for one in why.factors if one.needed and one.clear == 1 and one.what == "default" and _is_own(one)]
    seeds_crash = any(factor.kind == "seed" and factor.crashed for factor in why.factors)
    for kind, word in (("agent", "decision"), ("disturbance", "disturbance"), ("argument", "argument")):
        for factor in needed:
            if factor.kind == kind and (kind != "argument" or _is_own(factor) or seeds_crash):
                return Cause(word, factor.name if kind == "argument" else factor.what)
    return Cause("traffic") if needed else Cause("unknown")


def _is_own(factor: Factor) -> bool:
    """Return whether a factor is an argument of an agent; the name of such an argument begins with the agent's name.

    Changing a scenario argument changes the traffic from the start, as another seed does. A scenario argument is
    therefore a cause only if runs with other seeds crash as well; otherwise, any other traffic would have avoided the
    crash.
    """
    return factor.kind == "argument" and "." in factor.name


def _length(recording: Recording, actor: str) -> float:
    return next((one.length for one in recording.actors if one.id == actor), 0.0)


def features_of(bundle: Bundle, recording: Recording | None = None) -> tuple[float, ...]:
    """Return numbers that compare crashes of one type without runs; each is divided by a difference that matters.

    The numbers are the length of the collision partner, and, 0.2 s, 1 s and 2 s before the crash, the speeds, the gap
    and the partner's lateral position. Without this position, changes to the left and to the right are alike.

    Raises:
        BundleError: the log of the crash is missing or damaged.
    """
    hit = bundle.result.collision
    if hit is None or not hit.other:
        return ()
    recording = recording or bundle.recording()
    encounter = Encounter(recording, hit.agent, hit.other)
    moments = encounter.moments
    found = []
    for before_s in _LOOKS_S:
        end_s = moments[-1].time_s if moments else 0.0
        moment = next(
            (one for one in reversed(moments) if one.time_s <= end_s - before_s), moments[0] if moments else None
        )
        if moment is None:
            found += [0.0] * 4
            continue
        found += [
            moment.speed / _RELEVANT_DIFFERENCES["speed"],
            moment.other_speed / _RELEVANT_DIFFERENCES["speed"],
            min(moment.gap_m, _MAX_GAP_M) / _RELEVANT_DIFFERENCES["gap"],
            _aside_m(recording.scene(moment.step), hit.agent, hit.other) / _RELEVANT_DIFFERENCES["aside"],
        ]
    found.append(_length(recording, hit.other) / _RELEVANT_DIFFERENCES["length"])
    return tuple(found)


def _aside_m(scene: Scene, agent: str, other: str) -> float:
    """Return how far another actor is to the left of an agent, in m, at most one lane."""
    row, index = scene.roster.index[agent], scene.roster.index[other]
    (dx, dy), heading = scene.centers[index] - scene.centers[row], scene.headings[row]
    aside = float(dy * math.cos(heading) - dx * math.sin(heading))
    return max(-_MAX_ASIDE_M, min(_MAX_ASIDE_M, aside))


class Division:
    """The crashes of one type: runs judge some crashes, and all others get the cause of the nearest judged crash.

    The crashes chosen for judgement differ as much as possible. The shortest crash is chosen first, then always the
    crash furthest from all chosen crashes (farthest-first traversal: Gonzalez, Clustering to minimize the maximum
    intercluster distance, Theoretical Computer Science 38, 1985). Crashes may be added between two choices. At most
    ``most`` crashes are judged.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._steps: dict[int, int] = {}
        self._features: dict[int, tuple[float, ...]] = {}
        self._chosen: list[int] = []
        self._open: set[int] = set()  # chosen, without an answer yet
        self._known: dict[int, Cause] = {}

    def add(self, number: int, steps: int, features: tuple[float, ...]) -> None:
        """Add a crash to the division.

        The features are those of `features_of`.
        """
        self._steps[number], self._features[number] = steps, features

    def choose(self) -> int | None:
        """Return the number of the next crash to judge; None if enough crashes, or all of them, have been chosen."""
        left = [number for number in self._features if number not in self._chosen]
        if not left or len(self._chosen) >= self._most:
            return None
        if self._chosen:
            found = max(left, key=lambda number: (self._distance_to_judged(number, self._chosen), -number))
        else:
            found = min(left, key=lambda number: (self._steps[number], number))
        self._chosen.append(found)
        self._open.add(found)
        return found

    def settle(self, number: int, cause: Cause | None) -> None:
        """Store the cause of a crash.

        A crash that cannot be run again has no cause of its own, and gets the cause of the nearest judged crash.
        """
        self._open.discard(number)
        if number not in self._chosen:
            self._chosen.append(number)
        if cause is not None:
            self._known[number] = cause

    def answer(self, number: int) -> JsonObject | None:
        """Return a judged crash in the form that `restore` reads; None if the crash has not been judged."""
        if number not in self._chosen or number in self._open:
            return None
        cause = self._known.get(number)
        return {"features": list(self._features[number]), "cause": None if cause is None else cause.to_json()}

    def restore(self, number: int, answer: JsonObject) -> Cause | None:
        """Add a judged crash whose bundle was deleted; return its cause.

        ``answer`` is what `answer` returned for the crash.
        """
        self._features[number] = tuple(answer["features"])
        self.settle(number, None if answer["cause"] is None else Cause.from_json(answer["cause"]))
        return self._known.get(number)

    def postpone(self, number: int) -> None:
        """Withdraw a crash that was chosen but not judged; it may be chosen again."""
        self._open.remove(number)
        self._chosen.remove(number)

    @property
    def left(self) -> int:
        """The number of crashes that `choose` would still return."""
        return max(0, min(self._most, len(self._features)) - len(self._chosen))

    @property
    def judged(self) -> frozenset[int]:
        """The numbers of the crashes that have been judged."""
        return frozenset(self._known)

    @property
    def is_answered(self) -> bool:
        """Whether a crash has been judged, with or without a cause as the result."""
        return len(self._chosen) > len(self._open)

    @property
    def is_complete(self) -> bool:
        """Whether enough crashes have been judged."""
        return not self._open and len(self._chosen) >= self._most

    def causes(self) -> dict[int, Cause]:
        """Return the cause of each crash, by the number of the crash."""
        if not self._known:
            return dict.fromkeys(self._features, Cause("unknown"))
        lengths = without_chance_lengths({*self._known.values()})
        return {number: lengths[self._known[self._nearest(number)]] for number in self._features}

    def _nearest(self, number: int) -> int:
        if number in self._known:
            return number
        own = self._features[number]
        return min(sorted(self._known), key=lambda other: _distance(own, self._features[other]))

    def _distance_to_judged(self, number: int, others: Sequence[int]) -> float:
        return min(_distance(self._features[number], self._features[other]) for other in others)


def _distance(one: tuple[float, ...], other: tuple[float, ...]) -> float:
    return math.dist(one, other) if len(one) == len(other) else math.inf
