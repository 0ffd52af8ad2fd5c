"""The built-in models, each of which draws place, strength and duration independently from a few values."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, TypeVar

from crashhunt.base.weighted_choice import one_of
from crashhunt.disturbances._protocol import Drawn

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    import numpy as np

T = TypeVar("T")

_WEIGHT_BY_PLACE = {"left": 1.0, "right": 1.0, "left ahead": 2.0, "right ahead": 2.0}


@dataclass(frozen=True, slots=True)
class Choices:
    """A model that draws place, strength and duration independently of each other.

    Args:
        what: kind of the disturbance, such as ``brake``.
        who: the possible places of the disturbed actor, relative to the agent, such as ``ahead``, each with its weight.
        how_strong: possible strengths with their weights, in the unit of the kind.
        how_long: possible durations with their weights, in s.
    """

    what: str
    who: Mapping[str, float]
    how_strong: Mapping[float, float]
    how_long: Mapping[float, float]

    def draw(self, rng: np.random.Generator) -> Drawn:
        """Draw place, strength and duration, in this order."""
        return Drawn(one_of(self.who, rng), one_of(self.how_strong, rng), one_of(self.how_long, rng))

    def possibilities(self) -> Iterator[tuple[Drawn, float]]:
        """Yield everything that `draw` can return, with its probability."""
        totals = [sum(part.values()) for part in (self.who, self.how_strong, self.how_long)]
        for who, strong, long in product(self.who.items(), self.how_strong.items(), self.how_long.items()):
            share = who[1] * strong[1] * long[1] / math.prod(totals)
            if share > 0:
                yield Drawn(who[0], strong[0], long[0]), share

    def log_likelihood(self, drawn: Drawn) -> float:
        """Return the sum of the log-probabilities of place, strength and duration."""
        return (
            _log_share(self.who, drawn.who)
            + _log_share(self.how_strong, drawn.how_strong)
            + _log_share(self.how_long, drawn.how_long)
        )


def brake() -> Choices:
    """The vehicle ahead brakes hard for a while."""
    return Choices(
        what="brake",
        who={"ahead": 1.0},
        how_strong={2.0: 3.0, 4.0: 2.0, 6.0: 1.0},
        how_long={1.0: 1.0, 2.0: 2.0, 3.0: 1.0},
    )


def stop() -> Choices:
    """The vehicle ahead stops in the middle of the road, and continues later."""
    return Choices(what="stop", who={"ahead": 1.0}, how_strong={3.0: 1.0, 6.0: 1.0}, how_long={8.0: 1.0, 15.0: 1.0})


def dawdle() -> Choices:
    """The vehicle ahead drives much slower for a while."""
    return Choices(what="dawdle", who={"ahead": 1.0}, how_strong={0.3: 2.0, 0.5: 1.0}, how_long={10.0: 1.0, 20.0: 1.0})


def speed() -> Choices:
    """The vehicle behind drives faster than allowed."""
    places = {"behind": 2.0, "left behind": 1.0, "right behind": 1.0}
    return Choices(what="speed", who=places, how_strong={0.2: 2.0, 0.5: 1.0}, how_long={10.0: 1.0, 20.0: 1.0})


def cut_in() -> Choices:
    """A vehicle changes from a neighbouring lane to the agent's, even into a small gap, and may brake there."""
    return Choices(
        what="cut_in", who=_WEIGHT_BY_PLACE, how_strong={0.0: 2.0, 2.0: 1.0, 4.0: 1.0}, how_long={2.0: 1.0, 4.0: 1.0}
    )


def late_merge() -> Choices:
    """A vehicle next to or ahead of the agent merges at the very end of its lane, even into a small gap."""
    return Choices(
        what="late_merge",
        who=_WEIGHT_BY_PLACE,
        how_strong={5.0: 1.0, 15.0: 1.0, 30.0: 1.0},
        how_long={10.0: 1.0, 20.0: 1.0},
    )


def step_out() -> Choices:
    """A pedestrian at the roadside steps onto the road, and turns back in the middle of the agent's path."""
    places = {"right ahead": 2.0, "left ahead": 1.0}
    return Choices(
        what="step_out", who=places, how_strong={0.8: 1.0, 1.4: 2.0, 2.0: 1.0}, how_long={6.0: 1.0, 10.0: 1.0}
    )


def ignore_priority() -> Choices:
    """A vehicle from another approach ignores the lights and the right of way at the junction."""
    places = {"left ahead": 2.0, "right ahead": 2.0, "left": 1.0, "right": 1.0}
    return Choices(what="ignore_priority", who=places, how_strong={1.0: 1.0}, how_long={5.0: 1.0, 10.0: 1.0})


def late_observation() -> Choices:
    """The agent receives all observations with a delay."""
    return Choices(
        what="late_observation",
        who={"itself": 1.0},
        how_strong={0.2: 2.0, 0.5: 1.0, 1.0: 1.0},
        how_long={1.0: 1.0, 3.0: 1.0},
    )


def noisy_observation() -> Choices:
    """Every number in the agent's observation is wrong by some share of itself."""
    return Choices(
        what="noisy_observation",
        who={"itself": 1.0},
        how_strong={0.05: 2.0, 0.1: 1.0, 0.2: 1.0},
        how_long={1.0: 1.0, 3.0: 1.0},
    )


def unseen() -> Choices:
    """The agent does not see another actor."""
    return Choices(
        what="unseen",
        who={"ahead": 2.0, **_WEIGHT_BY_PLACE},
        how_strong={1.0: 1.0},
        how_long={1.0: 2.0, 2.0: 1.0, 4.0: 1.0},
    )


def late_action() -> Choices:
    """The actions of the agent take effect late."""
    return Choices(
        what="late_action",
        who={"itself": 1.0},
        how_strong={0.2: 2.0, 0.5: 1.0, 1.0: 1.0},
        how_long={1.0: 1.0, 3.0: 1.0},
    )


def _log_share(weights: Mapping[T, float], value: T) -> float:
    weight = weights.get(value, 0.0)
    return math.log(weight / sum(weights.values())) if weight > 0 else -math.inf
