"""Samplers of others, and a plain mutation, in the form of ours, to be measured beside them.

Optuna as its own documentation drives it; ``--sampler optuna:NAME`` gives it a random trial in five besides.

The packages of some peers are not among the dependencies of crashhunt. Install these into another virtual environment:
``pip install verifai`` (which needs Scenic, and attrs of 2022), ``pip install smac``, ``pip install botorch``.
``scripts/studies/run search`` skips peers whose package is not installed.
"""

from __future__ import annotations

import importlib
import importlib.util
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

PEERS = {
    "optuna-tpe": "peers:OptunaTpe",
    "optuna-cma-es": "peers:OptunaCmaEs",
    "plain-mutation": "peers:PlainMutation",
    "verifai-ce": "peers:VerifaiCrossEntropy",
    "verifai-mab": "peers:VerifaiBandit",
    "smac": "peers:Smac",
    "turbo": "peers:Turbo",
}
"""Name in tables to what stands for it."""
SLOW = ("smac", "turbo")
"""Peers that take 0.1 s or more for a proposal, so that they run only if they are named."""
_PACKAGES = {
    "optuna-tpe": ("optuna",),
    "optuna-cma-es": ("optuna", "cmaes"),
    "verifai-ce": ("verifai",),
    "verifai-mab": ("verifai",),
    "smac": ("smac",),
    "turbo": ("botorch",),
}
"""Name in tables to the packages that it needs."""


def missing_packages(sampler: str) -> list[str]:
    """Return the packages that a sampler needs and that are not installed."""
    return [package for package in _PACKAGES.get(sampler, ()) if importlib.util.find_spec(package) is None]


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


def _never_called(config: object, seed: int = 0) -> float:
    """Have the arguments that SMAC expects from a function to minimize; SMAC does not call it in this use."""
    raise NotImplementedError


class Smac:
    """SMAC3 (Lindauer et al. 2022) with its facade for hyperparameters: a random forest, and expected improvement.

    SMAC gives proposals and receives results through its own methods `ask` and `tell`. Results may arrive late.
    """

    learns = True
    wants_hunt = True

    def __init__(self, space: Space, *, points: int = 10, hunt: HuntFacts = HuntFacts()) -> None:  # noqa: B008
        import smac
        from ConfigSpace import Categorical, ConfigurationSpace, Float

        self._space = {f"x{place}": (key, known) for place, (key, known) in enumerate(sorted(space.items()))}
        self._folder = tempfile.TemporaryDirectory(prefix="crashhunt-smac-")
        seed = hunt.seed % 2**31
        configurations = ConfigurationSpace(seed=seed)
        configurations.add([
            Categorical(name, known.options) if isinstance(known, Choice) else Float(name, (0.0, 1.0))
            for name, (_, known) in self._space.items()
        ])  # fmt: skip
        scenario = smac.Scenario(
            configurations, deterministic=True, n_trials=100_000, seed=seed, output_directory=Path(self._folder.name)
        )
        facade = smac.HyperparameterOptimizationFacade
        # The number of initial draws depends on the trials that are planned: as for 500 of them.
        initial = facade.get_initial_design(scenario, n_configs=min(10 * len(space), 50))
        self._smac = facade(scenario, _never_called, initial_design=initial, logging_level=False)
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


class Turbo:
    """TuRBO-1 (Eriksson et al. 2019) as the tutorial of BoTorch runs it, in batches of four.

    Source: https://botorch.org/docs/tutorials/turbo_1 (Thompson sampling). For this algorithm, the value of a choice is
    a number from 0 to 1.

    A Gaussian process with a Matérn kernel of 5/2, Thompson draws in a trust region around the best trial, and a new
    start where the region has shrunk to its minimum. The process is fitted for every fourth proposal, so that a
    proposal follows from the results that a batch of the tutorial has.
    """

    learns = True
    batch = 4

    def __init__(self, space: Space, *, points: int = 10) -> None:
        importlib.import_module("torch").set_num_threads(1)
        self._cube = Cube(space)
        self._begin()

    def _begin(self) -> None:
        self._points: list[Any] = []
        self._scores: list[float] = []
        self._length, self._successes, self._failures, self._best = 0.8, 0, 0, -1.0
        self._batch: list[Any] = []
        self._gained: list[bool] = []

    def ask(self, number: int, rng: np.random.Generator) -> Proposal:
        """Return a Sobol point, or the next of four draws of the process."""
        size = self._cube.dimensions
        if len(self._points) < 2 * size:
            torch = importlib.import_module("torch")
            point = torch.quasirandom.SobolEngine(size, scramble=True, seed=int(rng.integers(2**31))).draw(1)[0].numpy()
        else:
            if not self._batch:
                self._batch = self._drawn(int(rng.integers(2**31)))
            point = self._batch.pop()
        return Proposal(self._cube.arguments(np.asarray(point, dtype=float)), origin="turbo")

    def tell(self, result: TrialResult) -> None:
        """Add a result; four of them change the region as a batch does."""
        score = 1.0 if result.outcome.category != "no crash" else result.danger or 0.0
        self._points.append(self._cube.point(result.spec))
        self._scores.append(score)
        size = self._cube.dimensions
        if len(self._points) <= 2 * size:
            self._best = max(self._best, score)
            return
        self._gained.append(score > self._best + 1e-3 * abs(self._best))
        self._best = max(self._best, score)
        if len(self._gained) < self.batch:
            return
        gained = any(self._gained)
        self._gained = []
        self._successes, self._failures = (self._successes + 1, 0) if gained else (0, self._failures + 1)
        if self._successes == 10:
            self._length, self._successes = min(2.0 * self._length, 1.6), 0
        elif self._failures == max(1, -(-size // self.batch)):
            self._length, self._failures = self._length / 2.0, 0
        if self._length < 0.5**7:
            self._begin()

    def _drawn(self, seed: int) -> list[Any]:
        torch, botorch, gpytorch = (importlib.import_module(name) for name in ("torch", "botorch", "gpytorch"))
        interval = gpytorch.constraints.Interval
        torch.manual_seed(seed)
        points = torch.tensor(np.array(self._points), dtype=torch.double)
        scores = torch.tensor(self._scores, dtype=torch.double)
        scores = ((scores - scores.mean()) / scores.std().clamp_min(1e-9)).unsqueeze(-1)
        size = points.shape[1]
        kernel = gpytorch.kernels.ScaleKernel(
            gpytorch.kernels.MaternKernel(nu=2.5, ard_num_dims=size, lengthscale_constraint=interval(0.005, 4.0))
        )
        model = botorch.models.SingleTaskGP(
            points, scores, covar_module=kernel, outcome_transform=None,
            likelihood=gpytorch.likelihoods.GaussianLikelihood(noise_constraint=interval(1e-8, 1e-3)),
        )  # fmt: skip
        botorch.fit_gpytorch_mll(gpytorch.mlls.ExactMarginalLogLikelihood(model.likelihood, model))
        center = points[scores.argmax(), :].clone()
        weights = kernel.base_kernel.lengthscale.squeeze(0).detach()
        weights = weights / weights.mean()
        weights = weights / torch.prod(weights.pow(1.0 / size))
        low = torch.clamp(center - weights * self._length / 2.0, 0.0, 1.0)
        high = torch.clamp(center + weights * self._length / 2.0, 0.0, 1.0)
        many = min(5000, max(2000, 200 * size))
        drawn = low + (high - low) * torch.quasirandom.SobolEngine(size, scramble=True, seed=seed).draw(many).double()
        touched = torch.rand(many, size) <= min(20.0 / size, 1.0)
        bare = torch.where(touched.sum(dim=1) == 0)[0]
        touched[bare, torch.randint(0, size, (len(bare),))] = True
        candidates = torch.where(touched, drawn, center.expand(many, size))
        with torch.no_grad():
            draws = botorch.generation.MaxPosteriorSampling(model=model, replacement=False)
            chosen = draws(candidates, num_samples=self.batch)
        return list(chosen.numpy())


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
