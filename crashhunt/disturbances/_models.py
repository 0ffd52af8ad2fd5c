"""The built-in models, each of which draws place, strength and duration independently from a few values."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from crashhunt.base.errors import CrashhuntError, PluginError
from crashhunt.base.exceptions import blamed
from crashhunt.base.isolation import ServerApart
from crashhunt.disturbances._disturbance_rates import draw_checked, locate_model
from crashhunt.disturbances._protocol import DisturbanceModel, Drawn

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from crashhunt.base.json_types import Plain


# Random draws with weights.


def one_of(weights: Mapping[T, float], rng: np.random.Generator) -> T:
    """Return a random value; its probability is proportional to its weight, which must be positive."""
    place = rng.random() * sum(weights.values())
    for value, weight in weights.items():
        place -= weight
        if place < 0:
            return value
    return list(weights)[-1]  # rounding may leave a remainder after the last weight


T = TypeVar("T")

_WEIGHT_BY_PLACE = {"left": 1.0, "right": 1.0, "left ahead": 2.0, "right ahead": 2.0}


@dataclass(frozen=True, slots=True)
class Choices:
    """A model that draws place, strength and duration independently of each other."""

    what: str  # kind of the disturbance, such as ``brake``
    # the possible places of the disturbed actor, relative to the agent, such as ``ahead``, each with its weight
    who: Mapping[str, float]
    how_strong: Mapping[float, float]  # possible strengths with their weights, in the unit of the kind
    how_long: Mapping[float, float]  # possible durations with their weights, in s

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


# Foreign disturbance models, which draw in a separate process.


def described_model(name: str) -> str:
    """Create a model in this process, and return its kind.

    Raises:
        CrashhuntError: the model does not exist, or cannot be created.
    """
    kind: object = locate_model(name).what
    if not isinstance(kind, str):
        message = f"{name!r} is not a disturbance model: its attribute what is a {type(kind).__name__}, not a string"
        raise PluginError(message, fix="set what to the kind of the disturbance, such as 'brake'")
    return str(kind)


class ModelApart:
    """A model that runs in its own process, which starts at the first use.

    Args:
        name: name of the model, or ``module:attribute``.
        kind: kind of the model, if it is known.
        timeout_s: maximum wall time of each draw, in s; the first draw also imports the model.
    """

    def __init__(self, name: str, kind: str = "", *, timeout_s: float) -> None:
        self._name, self._kind, self._timeout_s = name, kind, timeout_s
        self._server: ServerApart | None = None
        self._model: DisturbanceModel | None = None  # only in its process

    @property
    def what(self) -> str:
        """Return the kind of the model."""
        if not self._kind:
            self._kind = self._ask({})["what"]
        return self._kind

    def draw(self, rng: np.random.Generator) -> Drawn:
        """Return a draw of the model. The random generator advances as if the model had drawn in this process."""
        found = self._ask({"generator": rng.bit_generator.state})
        rng.bit_generator.state = found["generator"]
        return Drawn(*found["drawn"])

    def log_likelihood(self, drawn: Drawn) -> float:
        """Return the natural logarithm of the probability with which the model draws this disturbance."""
        likely: float = self._ask({"drawn": [drawn.who, drawn.how_strong, drawn.how_long]})["likely"]
        return likely

    def close(self) -> None:
        """End the process; a second call does nothing."""
        if self._server is not None:
            self._server.close()

    def _ask(self, request: Plain) -> Any:
        if self._server is None:
            task, fix = f"the disturbance {self._name!r} cannot be drawn", "correct the code"
            self._server = ServerApart(self._answer, task=task, fix=fix, timeout_s=self._timeout_s)
        return self._server.ask(request)

    def _answer(self, request: Plain) -> Plain:
        model = self._model = self._model or locate_model(self._name)
        asked: Any = request
        if "generator" in asked:
            rng = np.random.default_rng()
            rng.bit_generator.state = asked["generator"]
            drawn = draw_checked(self._name, model, rng)
            values = [drawn.who, float(drawn.how_strong), float(drawn.how_long)]
            return {"drawn": values, "generator": rng.bit_generator.state}
        if "drawn" in asked:
            try:
                return {"likely": float(model.log_likelihood(Drawn(*asked["drawn"])))}
            except CrashhuntError:
                raise
            except Exception as error:  # of user code
                raise blamed(f"the likelihood of the disturbance {self._name!r} cannot be computed", error) from error
        return {"what": described_model(self._name)}
