"""What samplers are measured on: crash regions of known size without any simulator, and real scenarios.

The first have a danger that leads to the crash, misleads, or says nothing; see each.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from crashhunt.plans import Given
    from crashhunt.trial import Kind

Danger = Callable[[Any, int], float]
"""Of the values of the arguments and a trial's seed; 1 for a crash."""


@dataclass(frozen=True, slots=True)
class Problem:
    """A crash region of known size.

    Args:
        about: in words.
        arguments: name to specification and kind.
        rate: of crashes, of random draws.
        danger: of a trial.
        hint: whether danger leads to the crash.
    """

    about: str
    arguments: Mapping[str, tuple[str, Kind | None]]
    rate: float
    danger: Danger
    hint: bool = True


@dataclass(frozen=True, slots=True)
class Real:
    """A scenario with an agent.

    Args:
        about: in words.
        rate: of crashes, of random draws, as it was first seen in a few hundred: it says when a hunt is given up.
        request: what is hunted.
        warmup_s: instead of what the scenario has, on SUMO, so that an episode is short.
        held_out: whether nobody who changes a sampler may look at it before that is done.
    """

    about: str
    rate: float
    request: Given
    warmup_s: float | None = None
    held_out: bool = False


def numbers(count: int) -> dict[str, tuple[str, Kind | None]]:
    """Return arguments from 0 to 1."""
    return {f"x{index:02d}": ("0.0:1.0", "float") for index in range(count)}


def radius_of(rate: float, dimensions: int) -> float:
    """Return the radius of a ball of such a volume."""
    return float((rate * math.gamma(dimensions / 2 + 1) / math.pi ** (dimensions / 2)) ** (1 / dimensions))


def ball(seed: int, dimensions: int, rate: float, reach: float) -> Danger:
    """Return a danger with a crash within a ball somewhere; it falls from there over the reach to nothing."""
    radius = radius_of(rate, dimensions)
    center = np.random.default_rng(seed).uniform(radius, 1 - radius, dimensions)

    def danger(values: Any, _seed: int) -> float:
        away = float(np.linalg.norm(values - center)) - radius
        return 1.0 if away < 0 else 0.95 * max(0.0, 1 - away / reach)

    return danger


def _deceptive(values: Any, _seed: int) -> float:
    """Danger rises over nearly all of the space to where nothing crashes, and near the crash in a narrow ring."""
    away = float(np.linalg.norm(values - np.array([0.2, 0.25, 0.8]))) - radius_of(1 / 200, 3)
    if away < 0:
        return 1.0
    false = 0.97 * max(0.0, 1 - float(np.linalg.norm(values - np.array([0.85, 0.8, 0.15]))) / 1.2)
    return max(false, 0.9 * max(0.0, 1 - away / 0.15))


def _discrete(values: Any, _seed: int) -> float:
    """One of 625 combinations of words, and a number of five or more out of ten."""
    *words, number = values
    right = sum(word == wanted for word, wanted in zip(words, "bdac", strict=True)) + (number > 4)
    return 1.0 if right == 5 else 0.95 * right / 6


def _twenty(rate: float) -> Danger:
    """A weighted sum of twenty arguments is above a limit."""
    weights = np.random.default_rng(1).uniform(0.3, 1, 20) * np.random.default_rng(2).choice([-1, 1], 20)
    sums = np.random.default_rng(3).random((400_000, 20)) @ weights
    least, limit = float(sums.min()), float(np.quantile(sums, 1 - rate))

    def danger(values: Any, _seed: int) -> float:
        total = float(values @ weights)
        return 1.0 if total > limit else min(0.99, max(0.0, (total - least) / (limit - least)))

    return danger


def _traffic(rate: float) -> Danger:
    """Mostly the traffic decides, which is the seed's; danger is told with much noise."""
    weights = np.array([2.4, -1.6, 1.0, 0.0, 0.0])
    rng = np.random.default_rng(5)
    margins = (rng.random((400_000, 5)) - 0.5) @ weights + rng.standard_normal(400_000)
    limit = float(np.quantile(margins, 1 - rate))

    def danger(values: Any, seed: int) -> float:
        luck = np.random.default_rng(seed)
        margin = float((values - 0.5) @ weights) + luck.standard_normal()
        return 1.0 if margin > limit else min(0.99, max(0.0, 0.5 + 0.12 * (margin + 1.5 * luck.standard_normal())))

    return danger


def _seeds(rate: float) -> Danger:
    """Which arguments crash is another with every seed: with the same one, danger leads there."""
    radius = radius_of(rate, 2)

    def danger(values: Any, seed: int) -> float:
        center = np.random.default_rng(seed).uniform(0.1, 0.9, 2)
        away = float(np.linalg.norm(values[:2] - center)) - radius
        return 1.0 if away < 0 else 0.95 * max(0.0, 1 - away / 0.5)

    return danger


def _blind(rate: float) -> Danger:
    """Danger is drawn by the seed alone."""
    inside = ball(4, 2, rate, 1.0)

    def danger(values: Any, seed: int) -> float:
        return 1.0 if inside(values, seed) == 1.0 else 0.9 * float(np.random.default_rng(seed).random())

    return danger


def as_floats(danger: Danger) -> Danger:
    """Return a danger that gets its values as an array of floats."""

    def of(values: Any, seed: int) -> float:
        floats: NDArray[np.float64] = values.astype(float)
        return danger(floats, seed)

    return of


_WORDS: dict[str, tuple[str, Kind | None]] = {f"c{index}": ("a|b|c|d|e", None) for index in range(4)}

PROBLEMS = {
    "easy": Problem(
        about="a ball in 3 dimensions", arguments=numbers(3), rate=1 / 50, danger=as_floats(ball(1, 3, 1 / 50, 1.0))
    ),
    "smooth": Problem(
        about="a ball in 5 dimensions",
        arguments=numbers(5),
        rate=1 / 500,
        danger=as_floats(ball(2, 5, 1 / 500, 1.0)),
    ),
    "needle": Problem(
        about="a ball in 3 dimensions, danger only near it",
        arguments=numbers(3),
        rate=1 / 5000,
        danger=as_floats(ball(3, 3, 1 / 5000, 0.12)),
    ),
    "deceptive": Problem(
        about="danger leads elsewhere", arguments=numbers(3), rate=1 / 200, danger=as_floats(_deceptive)
    ),
    "discrete": Problem(
        about="four words and a whole number",
        arguments={**_WORDS, "n": ("1:10", "int")},
        rate=0.6 / 625,
        danger=_discrete,
    ),
    "twenty": Problem(
        about="a sum of 20 arguments", arguments=numbers(20), rate=1 / 1000, danger=as_floats(_twenty(1 / 1000))
    ),
    "traffic": Problem(
        about="the seed decides more than the arguments",
        arguments=numbers(5),
        rate=1 / 500,
        danger=as_floats(_traffic(1 / 500)),
    ),
    "seeds": Problem(
        about="other arguments with every seed",
        arguments=numbers(4),
        rate=1 / 1000,
        danger=as_floats(_seeds(1 / 1000)),
    ),
    "blind": Problem(
        about="danger says nothing", arguments=numbers(2), rate=1 / 300, danger=as_floats(_blind(1 / 300)), hint=False
    ),
}

REAL = {
    "motorway": Real(
        "the shipped policy on a motorway of SUMO: traffic alone varies", 1 / 10,
        {"scenario": "motorway", "max_steps": 140, "scenario_arguments": {"demand": "2500:4000"}}, warmup_s=8.0,
    ),
    "ring": Real(
        "lane changes with a blind spot on a ring of SUMO", 1 / 25,
        {"scenario": "loop", "agents": {"": "lane-changer"}, "max_steps": 100,
         "arguments": {"blind_spot_m": "0:10", "desired_speed": "12:22", "patience_s": "1:5"},
         "scenario_arguments": {"vehicles": "10:18"}}, warmup_s=3.0,
    ),
    "motorway-lanes": Real(
        "lane changes with a blind spot on a motorway of SUMO", 1 / 40,
        {"scenario": "motorway", "agents": {"": "lane-changer"}, "max_steps": 100,
         "arguments": {"blind_spot_m": "0:6", "desired_speed": "20:32"},
         "scenario_arguments": {"demand": "2000:3500"}}, warmup_s=8.0,
    ),
    "highway-idm": Real(
        "the intelligent driver model on highway-env", 1 / 80,
        {"scenario": "highway", "agents": {"": "idm"}, "max_steps": 15,
         "scenario_arguments": {"vehicles_count": "6:12"}},
    ),
    "highway-delay": Real(
        "car following with a delay on highway-env", 1 / 120,
        {"scenario": "highway", "agents": {"": "car-following"}, "max_steps": 15,
         "arguments": {"delay_s": "0.2:1.2", "headway_s": "0.2:2"}, "scenario_arguments": {"vehicles_count": "6:12"}},
        held_out=True,
    ),
    "merge-lanes": Real(
        "lane changes with a blind spot where a ramp of SUMO merges", 1 / 120,
        {"scenario": "merge", "agents": {"": "lane-changer"}, "max_steps": 120,
         "arguments": {"blind_spot_m": "0:12", "desired_speed": "18:32", "patience_s": "1:4"},
         "scenario_arguments": {"motorway_demand": "2200:3000"}}, warmup_s=12.0, held_out=True,
    ),
    "motorway-blind": Real(
        "lane changes with a long blind spot on a full motorway of SUMO", 1 / 10,
        {"scenario": "motorway", "agents": {"": "lane-changer"}, "max_steps": 140,
         "arguments": {"blind_spot_m": "4:14", "desired_speed": "24:34", "patience_s": "0.5:3"},
         "scenario_arguments": {"demand": "3000:4500"}}, warmup_s=8.0,
    ),
    "highway-crowd": Real(
        "the intelligent driver model in a crowd on highway-env", 1 / 25,
        {"scenario": "highway", "agents": {"": "idm"}, "max_steps": 15,
         "arguments": {"headway_s": "0.2:1.5", "politeness": "0:1", "desired_speed": "22:30"},
         "scenario_arguments": {"vehicles_count": "10:25", "vehicles_density": "1:2"}},
    ),
    "highway-calm": Real(
        "car following with a short delay and a fair headway on highway-env", 1 / 150,
        {"scenario": "highway", "agents": {"": "car-following"}, "max_steps": 15,
         "arguments": {"delay_s": "0.2:0.8", "headway_s": "0.4:2"}, "scenario_arguments": {"vehicles_count": "6:12"}},
        held_out=True,
    ),
    "loop-follow": Real(
        "car following with a delay on a ring of SUMO", 1 / 330,
        {"scenario": "loop", "agents": {"": "car-following"}, "max_steps": 100,
         "arguments": {"delay_s": "0:2", "headway_s": "0.2:2", "desired_speed": "15:30", "max_brake": "2:8"},
         "scenario_arguments": {"vehicles": "12:20", "speed_spread": "0:0.4"}}, warmup_s=3.0, held_out=True,
    ),
    "loop-careful": Real(
        "car following with a shorter delay and better brakes on a ring of SUMO", 1 / 500,
        {"scenario": "loop", "agents": {"": "car-following"}, "max_steps": 100,
         "arguments": {"delay_s": "0:1.6", "headway_s": "0.3:2", "desired_speed": "15:28", "max_brake": "3:8"},
         "scenario_arguments": {"vehicles": "12:20", "speed_spread": "0:0.4"}}, warmup_s=3.0, held_out=True,
    ),
    "motorway-follow": Real(
        "car following with a delay on a full motorway of SUMO", 1 / 30,
        {"scenario": "motorway", "agents": {"": "car-following"}, "max_steps": 140,
         "arguments": {"delay_s": "0.2:2", "headway_s": "0.2:1.5", "desired_speed": "24:36", "max_brake": "2:8"},
         "scenario_arguments": {"demand": "3000:4500"}}, warmup_s=8.0, held_out=True,
    ),
    "loop-overtaker": Real(
        "two agents on a ring of SUMO: one overtakes with a short blind spot", 1 / 30,
        {"scenario": "loop-two-agents", "max_steps": 100,
         "arguments": {"overtaker.blind_spot_m": "0:1.5", "overtaker.patience_s": "2:8",
                       "overtaker.desired_speed": "14:20", "keeper.speed": "8:14"}}, warmup_s=3.0, held_out=True,
    ),
}  # fmt: skip
"""Each has other traffic with every seed. What rates they have, the table says."""

_REQUIRED = {
    "ring": ("always (ttc_s > 8)", 1 / 20),
    "highway-idm": ("always (ttc_s > 1.5)", 1 / 20),
    "highway-delay": ("always (headway_s > 0.15)", 1 / 20),
    "loop-follow": ("always (headway_s > 0.25)", 1 / 15),
    "motorway-follow": ("always (headway_s > 0.05)", 1 / 10),
    "merge-lanes": ("always (leader_changed -> eventually[0:1] (headway_s >= 1.5))", 1 / 20),
}
"""A requirement in place of the crash, and how often random draws violated it in the first 40 trials or more."""

REAL |= {
    f"{name}-required": replace(
        REAL[name], rate=rate, request={**REAL[name].request, "requirements": (formula,), "oracles": ("none",)}
    )
    for name, (formula, rate) in _REQUIRED.items()
}
