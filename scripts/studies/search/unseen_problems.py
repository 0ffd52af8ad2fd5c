"""Problems on which no version of ``guided`` is chosen: ``scripts/studies/run search --problems new-ridge``.

They confirm a version that was chosen on other problems. They were written down before any sampler ran on them. Each
hunt has its own crash region, which is drawn by its seed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from problems import Problem, as_floats, ball, numbers, radius_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from problems import Danger

    from crashhunt.trial import Kind

_DRAWS = 60_000  # from which the limit of a margin is estimated


def _ridge(seed: int, rate: float) -> Danger:
    """Criticality is high only along a curve through four arguments, and rises slowly along it to the crash."""
    rng = np.random.default_rng([seed, 11])
    phases, order = rng.uniform(0.0, 2.0 * np.pi, 4), rng.permutation(4)

    def margins(values: Any) -> Any:
        along = values[..., order[0]]
        curve = 0.5 + 0.35 * np.sin(2.5 * along[..., None] + phases[order[1:]])
        return 0.3 * along - np.linalg.norm(values[..., order[1:]] - curve, axis=-1)

    drawn = margins(rng.random((_DRAWS, 4)))
    least, limit = float(drawn.min()), float(np.quantile(drawn, 1 - rate))

    def danger(values: Any, _seed: int) -> float:
        margin = float(margins(values))
        return 1.0 if margin > limit else min(0.99, max(0.0, (margin - least) / (limit - least)))

    return danger


def _switch(seed: int, rate: float) -> Danger:
    """One of six words decides which two of four numbers matter; only one word can lead to a crash."""
    rng = np.random.default_rng([seed, 12])
    fatal = str(rng.choice([*"abcdef"]))
    radius = radius_of(6 * rate, 2)
    pairs = {word: rng.choice(4, 2, replace=False) for word in "abcdef"}
    centers = {word: rng.uniform(radius, 1 - radius, 2) for word in "abcdef"}

    def danger(values: Any, _seed: int) -> float:
        word = str(values[0])
        away = float(np.linalg.norm(values[1:].astype(float)[pairs[word]] - centers[word])) - radius
        if away < 0 and word == fatal:
            return 1.0
        return min(0.95, max(0.0, 0.95 * (1 - max(away, 0.0))) * (1.0 if word == fatal else 0.7))

    return danger


def _levels(seed: int, rate: float) -> Danger:
    """Criticality has five values only."""
    inside = ball(seed + 91, 4, rate, 1.0)

    def danger(values: Any, seed: int) -> float:
        near = inside(values, seed)
        return 1.0 if near == 1.0 else float(np.floor(5.0 * near)) / 5.0

    return danger


def _peaks(seed: int, rate: float) -> Danger:
    """Four peaks of criticality have the same width; the crash is at the one that is not the highest."""
    rng = np.random.default_rng([seed, 13])
    radius = radius_of(rate, 2)
    centers = rng.uniform(0.1, 0.9, (4, 2))
    while min(float(np.linalg.norm(centers[i] - centers[j])) for i in range(4) for j in range(i)) < 0.3:
        centers = rng.uniform(0.1, 0.9, (4, 2))
    heights = np.array([0.8, 0.9, 0.7, 0.6])

    def danger(values: Any, _seed: int) -> float:
        away = np.linalg.norm(centers - values, axis=1)
        return 1.0 if away[0] < radius else float(max(0.0, (heights * (1 - away / 0.5)).max()))

    return danger


def _noisy(seed: int, rate: float) -> Danger:
    """The seed of a trial decides whether a crash is possible, and criticality has noise."""
    inside = ball(seed + 93, 3, 2 * rate, 0.8)

    def danger(values: Any, seed: int) -> float:
        luck = np.random.default_rng(seed)
        near = inside(values, seed)
        is_possible = luck.random() < 0.5
        noise = 0.1 * luck.standard_normal()
        return 1.0 if near == 1.0 and is_possible else min(0.99, max(0.0, (0.9 if is_possible else 0.6) * near + noise))

    return danger


_Arguments = dict[str, tuple[str, "Kind | None"]]

UNSEEN: Mapping[str, tuple[_Arguments, float, Callable[[int, float], Danger]]] = {
    "new-ridge": (numbers(4), 1 / 500, _ridge),
    "new-switch": ({"word": ("a|b|c|d|e|f", None), **numbers(4)}, 1 / 400, _switch),
    "new-levels": (numbers(4), 1 / 300, _levels),
    "new-peaks": (numbers(2), 1 / 300, _peaks),
    "new-noisy": (numbers(3), 1 / 250, _noisy),
}
"""Name to arguments, rate of crashes of random draws, and danger by the seed of the hunt."""


def unseen_problem(name: str, seed: int) -> Problem:
    """Return a problem with the crash region of a hunt."""
    arguments, rate, made = UNSEEN[name]
    danger = made(seed, rate)
    danger = danger if name == "new-switch" else as_floats(danger)
    return Problem(about=name, arguments=arguments, rate=rate, danger=danger)
