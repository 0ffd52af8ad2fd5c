"""Samplers of others, and a plain mutation, in the form of ours, to be measured beside them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np

from crashhunt.samplers import Cube, HuntFacts, Proposal
from crashhunt.trial import Choice

if TYPE_CHECKING:
    from crashhunt.samplers import Key, Space
    from crashhunt.trial import TrialResult, Value

__all__ = ["PEERS", "OptunaCmaEs", "OptunaTpe", "PlainMutation"]

PEERS = {
    "optuna-tpe": "peers:OptunaTpe",
    "optuna-cma-es": "peers:OptunaCmaEs",
    "plain-mutation": "peers:PlainMutation",
}
"""Name in tables to what stands for it."""


class _Optuna:
    """A study of Optuna that maximizes danger: a number from 0 to 1 for each argument, a category for each choice."""

    learns = True
    wants_hunt = True
    kind = ""

    def __init__(self, space: Space, *, points: int = 10, hunt: HuntFacts = HuntFacts()) -> None:  # noqa: B008
        import optuna

        optuna.logging.set_verbosity(optuna.logging.ERROR)
        seed = hunt.seed % 2**32
        self._study = optuna.create_study(direction="maximize", sampler=getattr(optuna.samplers, self.kind)(seed=seed))
        self._space = dict(sorted(space.items()))
        self._asked: dict[int, Any] = {}

    def ask(self, number: int, rng: np.random.Generator) -> Proposal:
        """Return what the study suggests."""
        trial = self._study.ask()
        self._asked[number] = trial
        chosen: dict[Key, Value] = {}
        for key, known in self._space.items():
            name = ".".join(key)
            if isinstance(known, Choice):
                chosen[key] = cast("Value", trial.suggest_categorical(name, known.options))
            else:
                chosen[key] = known.quantile(trial.suggest_float(name, 0.0, 1.0))
        return Proposal(chosen, origin="optuna")

    def tell(self, result: TrialResult) -> None:
        """Tell the study."""
        crashed = result.outcome.category != "no crash"
        self._study.tell(self._asked.pop(result.spec.number), 1.0 if crashed else result.danger or 0.0)


class OptunaTpe(_Optuna):
    """Its default."""

    kind = "TPESampler"


class OptunaCmaEs(_Optuna):
    """Its CMA-ES."""

    kind = "CmaEsSampler"


class PlainMutation:
    """A normal step from one of the ten most dangerous trials, in four of five: no energy, no seeds, no scales."""

    learns = True

    def __init__(self, space: Space, *, points: int = 10) -> None:
        self._cube = Cube(space)
        self._best: list[tuple[float, int, Any]] = []

    def ask(self, number: int, rng: np.random.Generator) -> Proposal:
        """Return a neighbour, or a draw."""
        point = rng.random(self._cube.dimensions)
        if number % 5 and len(self._best) >= 10:
            point = np.clip(self._best[rng.integers(10)][2] + 0.1 * rng.standard_normal(len(point)), 0.0, 1.0)
        return Proposal(self._cube.arguments(point))

    def tell(self, result: TrialResult) -> None:
        """Keep it, if it is among the most dangerous."""
        self._best.append((-(result.danger or 0.0), result.spec.number, self._cube.point(result.spec)))
        self._best.sort(key=lambda one: one[:2])
        del self._best[10:]
