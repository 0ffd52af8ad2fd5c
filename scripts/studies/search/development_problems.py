"""Problems on which versions of ``guided`` are developed, such as dev-easy, with seeds from 7000.

Each hunt has its own crash region, drawn by its seed, so that no version can fit one region. None of the regions is
that of a problem in the table of all samplers, which stays unseen until a version is complete.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from problems import Problem, as_floats, ball, numbers, radius_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from problems import Danger

    from crashhunt.trial import Kind

_DRAWS = 60_000  # from which the limit of a sum is estimated


def _linear(seed: int, rate: float) -> Danger:
    """A weighted sum of ten arguments is above a limit."""
    rng = np.random.default_rng([seed, 1])
    weights = rng.uniform(0.3, 1, 10) * rng.choice([-1, 1], 10)
    sums = rng.random((_DRAWS, 10)) @ weights
    least, limit = float(sums.min()), float(np.quantile(sums, 1 - rate))

    def danger(values: Any, _seed: int) -> float:
        total = float(values @ weights)
        return 1.0 if total > limit else min(0.99, max(0.0, (total - least) / (limit - least)))

    return danger


def _traffic(seed: int, rate: float) -> Danger:
    """The seed of a trial decides more than its arguments, and criticality has much noise."""
    rng = np.random.default_rng([seed, 2])
    weights = np.zeros(4)
    weights[:3] = rng.permutation([2.4, 1.6, 1.0]) * rng.choice([-1, 1], 3)
    margins = (rng.random((_DRAWS, 4)) - 0.5) @ weights + rng.standard_normal(_DRAWS)
    limit = float(np.quantile(margins, 1 - rate))

    def danger(values: Any, seed: int) -> float:
        luck = np.random.default_rng(seed)
        margin = float((values - 0.5) @ weights) + luck.standard_normal()
        return 1.0 if margin > limit else min(0.99, max(0.0, 0.5 + 0.12 * (margin + 1.5 * luck.standard_normal())))

    return danger


def _calm(seed: int, rate: float) -> Danger:
    """The criticality of a trial without a crash is at most 0.4, with noise."""
    inside = ball(seed + 77, 4, rate, 1.0)

    def danger(values: Any, seed: int) -> float:
        near = inside(values, seed)
        noise = 0.04 * np.random.default_rng(seed).standard_normal()
        return 1.0 if near == 1.0 else min(0.4, max(0.0, 0.4 * near + noise))

    return danger


def _seeds(_seed: int, rate: float) -> Danger:
    """Which arguments crash differs with the seed of a trial."""
    radius = radius_of(rate, 2)

    def danger(values: Any, seed: int) -> float:
        center = np.random.default_rng(seed).uniform(0.1, 0.9, 2)
        away = float(np.linalg.norm(values[:2] - center)) - radius
        return 1.0 if away < 0 else 0.95 * max(0.0, 1 - away / 0.5)

    return danger


def _blind(seed: int, rate: float) -> Danger:
    """The seed of a trial alone decides its criticality, and its arguments decide whether it crashes."""
    inside = ball(seed + 55, 2, rate, 1.0)

    def danger(values: Any, seed: int) -> float:
        return 1.0 if inside(values, seed) == 1.0 else 0.9 * float(np.random.default_rng(seed).random())

    return danger


def _chaos(seed: int, rate: float) -> Danger:
    """Criticality is random in arguments and seed."""
    inside = ball(seed + 55, 3, rate, 1.0)

    def danger(values: Any, seed: int) -> float:
        drawn = np.random.default_rng([seed % 2**32, *(int(value * 1e6) for value in values)]).random()
        return 1.0 if inside(values, seed) == 1.0 else 0.9 * float(drawn)

    return danger


def _alone(_seed: int, rate: float) -> Danger:
    """The seed of a trial alone decides everything."""

    def danger(_values: Any, seed: int) -> float:
        luck = np.random.default_rng(seed)
        return 1.0 if luck.random() < rate else 0.9 * float(luck.random())

    return danger


def _two_peaks(seed: int, rate: float, reach: float, highest: float) -> Danger:
    """Criticality rises to a point without a crash, and near the crash within a reach."""
    rng = np.random.default_rng([seed, 3])
    center, false = rng.uniform(0.15, 0.85, 3), rng.uniform(0.1, 0.9, 3)
    while np.linalg.norm(false - center) < 0.6:
        false, center = rng.uniform(0.1, 0.9, 3), rng.uniform(0.15, 0.85, 3)
    radius = radius_of(rate, 3)

    def danger(values: Any, _seed: int) -> float:
        away = float(np.linalg.norm(values - center)) - radius
        misleading = highest * max(0.0, 1 - float(np.linalg.norm(values - false)) / 1.2)
        return 1.0 if away < 0 else max(misleading, 0.9 * max(0.0, 1 - away / reach))

    return danger


def _discrete(seed: int, _rate: float) -> Danger:
    """One of 625 combinations of words, and a number that is great, or that is small."""
    rng = np.random.default_rng([seed, 4])
    wanted, is_great = [str(word) for word in rng.choice([*"abcde"], 4)], bool(rng.random() < 0.5)

    def danger(values: Any, _seed: int) -> float:
        *words, number = values
        right = sum(word == one for word, one in zip(words, wanted, strict=True))
        right += number > 4 if is_great else number <= 6
        return 1.0 if right == 5 else 0.95 * right / 6

    return danger


_WORDS: dict[str, tuple[str, Kind | None]] = {f"c{place}": ("a|b|c|d|e", None) for place in range(4)}
_Arguments = dict[str, tuple[str, "Kind | None"]]

DEVELOPMENT: Mapping[str, tuple[_Arguments, float, Callable[[int, float], Danger]]] = {
    "dev-easy": (numbers(3), 1 / 50, lambda seed, rate: ball(seed, 3, rate, 1.0)),
    "dev-smooth": (numbers(5), 1 / 500, lambda seed, rate: ball(seed, 5, rate, 1.0)),
    "dev-needle": (numbers(3), 1 / 2000, lambda seed, rate: ball(seed, 3, rate, 0.15)),
    "dev-discrete": ({**_WORDS, "n": ("1:10", "int")}, 0.6 / 625, _discrete),
    "dev-linear": (numbers(10), 1 / 300, _linear),
    "dev-calm": (numbers(4), 1 / 300, _calm),
    "dev-traffic": (numbers(4), 1 / 300, _traffic),
    "dev-seeds": (numbers(4), 1 / 600, _seeds),
    "dev-blind": (numbers(2), 1 / 200, _blind),
    "dev-chaos": (numbers(3), 1 / 150, _chaos),
    "dev-alone": (numbers(3), 1 / 150, _alone),
    "dev-deceptive": (numbers(3), 1 / 150, lambda seed, rate: _two_peaks(seed, rate, 0.15, 0.97)),
    "dev-twin": (numbers(3), 1 / 400, lambda seed, rate: _two_peaks(seed, rate, 0.45, 0.8)),
}
"""Name to arguments, rate of crashes of random draws, and danger by the seed of the hunt."""


def development_problem(name: str, seed: int) -> Problem:
    """Return a problem with the crash region of a hunt."""
    arguments, rate, made = DEVELOPMENT[name]
    danger = made(seed, rate)
    return Problem(
        about=name, arguments=arguments, rate=rate, danger=danger if "discrete" in name else as_floats(danger)
    )
