"""Samplers of others, and a plain mutation, in the form of ours, to be measured beside them.

Optuna as its own documentation drives it; ``--sampler optuna:NAME`` gives it a random trial in five besides. VerifAI is
installed by whoever measures: ``pip install verifai``, best into an environment of its own, as it brings Scenic, and an
attrs of 2022. So is SMAC: ``pip install smac``.
"""

from __future__ import annotations

import tempfile
from bisect import insort
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from crashhunt.samplers import Cube, HuntFacts, Proposal
from crashhunt.trial import Choice

if TYPE_CHECKING:
    from crashhunt.samplers import Key, Space
    from crashhunt.trial import TrialResult, Value

__all__ = ["PEERS", "OptunaCmaEs", "OptunaTpe", "PlainMutation", "Smac", "VerifaiBandit", "VerifaiCrossEntropy"]

PEERS = {
    "optuna-tpe": "peers:OptunaTpe",
    "optuna-cma-es": "peers:OptunaCmaEs",
    "plain-mutation": "peers:PlainMutation",
    "verifai-ce": "peers:VerifaiCrossEntropy",
    "verifai-mab": "peers:VerifaiBandit",
    "smac": "peers:Smac",
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


class _Verifai:
    """A sampler of VerifAI with its default parameters: five buckets for each number, a category for each choice.

    It learns from samples that are below a fixed threshold of robustness, by default from crashes alone, of which
    there are none before the first. So it is given more: robustness is how far the danger was below that of the most
    dangerous tenth of all trials so far, so that each of those counts as a counterexample.
    """

    learns = True
    make = ""

    def __init__(self, space: Space, *, points: int = 10) -> None:
        from verifai.features import Box, Categorical, Feature, FeatureSpace
        from verifai.samplers import FeatureSampler

        self._space = dict(sorted(space.items()))
        self._names = {key: f"feature_{index}" for index, key in enumerate(self._space)}
        domains = {
            self._names[key]: Feature(Categorical(*known.options) if isinstance(known, Choice) else Box([0.0, 1.0]))
            for key, known in self._space.items()
        }
        self._sampler = getattr(FeatureSampler, self.make)(FeatureSpace(domains))
        self._asked: dict[int, Any] = {}
        self._dangers: list[float] = []

    def ask(self, number: int, rng: np.random.Generator) -> Proposal:
        """Return its sample; it draws from NumPy's own generator, which is seeded for it."""
        np.random.seed(int(rng.integers(2**32)))  # noqa: NPY002 - theirs
        sample, _ = self._asked[number] = self._sampler.getSample()
        drawn = {key: getattr(sample, name) for key, name in self._names.items()}
        return Proposal({
            key: drawn[key] if isinstance(known, Choice) else known.quantile(min(max(float(drawn[key][0]), 0.0), 1.0))
            for key, known in self._space.items()
        }, origin="verifai")  # fmt: skip

    def tell(self, result: TrialResult) -> None:
        """Update it."""
        danger = 1.0 if result.outcome.category != "no crash" else result.danger or 0.0
        level = self._dangers[-1 - len(self._dangers) // 10] if self._dangers else 1.0
        insort(self._dangers, danger)
        sample, info = self._asked.pop(result.spec.number)
        self._sampler.update(sample, info, level - danger)


class VerifaiCrossEntropy(_Verifai):
    """Its cross-entropy."""

    make = "crossEntropySamplerFor"


class VerifaiBandit(_Verifai):
    """Its multi-armed bandit."""

    make = "multiArmedBanditSamplerFor"


class Smac:
    """SMAC3 (Lindauer et al. 2022) with its facade for hyperparameters, a random forest, asked and told in turns."""

    learns = True
    wants_hunt = True

    def __init__(self, space: Space, *, points: int = 10, hunt: HuntFacts = HuntFacts()) -> None:  # noqa: B008
        import smac
        from ConfigSpace import Categorical, ConfigurationSpace, Float

        self._space = {f"x{place}": (key, known) for place, (key, known) in enumerate(sorted(space.items()))}
        seed = hunt.seed % 2**31
        configurations = ConfigurationSpace(seed=seed)
        configurations.add([
            Categorical(name, known.options) if isinstance(known, Choice) else Float(name, (0.0, 1.0))
            for name, (_, known) in self._space.items()
        ])  # fmt: skip
        scenario = smac.Scenario(
            configurations, deterministic=True, n_trials=100_000, seed=seed, output_directory=Path(tempfile.mkdtemp())
        )
        facade = smac.HyperparameterOptimizationFacade
        # The number of initial draws depends on the trials that are planned: as for 500 of them.
        initial = facade.get_initial_design(scenario, n_configs=min(10 * len(space), 50))
        self._smac = facade(scenario, lambda *_: 0.0, initial_design=initial, logging_level=False)
        self._asked: dict[int, Any] = {}

    def ask(self, number: int, rng: np.random.Generator) -> Proposal:
        """Return its next configuration."""
        self._asked[number] = asked = self._smac.ask()
        return Proposal({
            key: asked.config[name] if isinstance(known, Choice) else known.quantile(float(asked.config[name]))
            for name, (key, known) in self._space.items()
        }, origin="smac")  # fmt: skip

    def tell(self, result: TrialResult) -> None:
        """Tell it how far from a crash the trial was."""
        from smac.runhistory import TrialValue

        crashed = result.outcome.category != "no crash"
        cost = 0.0 if crashed else 1.0 - (result.danger or 0.0)
        self._smac.tell(self._asked.pop(result.spec.number), TrialValue(cost=cost), save=False)


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
