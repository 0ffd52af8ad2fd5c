"""Samplers of Optuna (Akiba and others, 2019) by their names: ``optuna:TPESampler``, or ``optuna:tpe``."""

from __future__ import annotations

import importlib
import warnings
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from optuna.storages import InMemoryStorage
from optuna.trial import FrozenTrial, TrialState

from crashhunt.base.errors import PluginError, UsageError
from crashhunt.base.extras import install_command
from crashhunt.base.text import one_of
from crashhunt.samplers._learning import Draft, Learning, ScoredTrial, Strategy
from crashhunt.samplers._protocol import HuntFacts, Space

if TYPE_CHECKING:
    from collections.abc import Iterator


PREFIX = "optuna:"
ORIGIN = "optuna"
_LONGEST = 2**29  # points of a sequence that are surely there
_INSTEAD = {
    "bruteforce": "--sampler grid tries every combination",
    "grid": "--sampler grid tries every combination",
    "partialfixed": "--arg NAME=VALUE fixes an argument, with any sampler",
}
"""Samplers of Optuna that make no sense here, and alternatives."""
_NEEDS = {
    "cmaes": ("cmaes", "search"),
    "gp": ("torch", "torch"),
}
"""Packages that Optuna itself does not bring, each with its extra."""


@dataclass(frozen=True, slots=True)
class OptunaMaker:
    """Creates samplers of one class of Optuna."""

    kind: str
    only_asked: ClassVar[bool] = False
    wants_hunt: ClassVar[bool] = True

    def __call__(self, space: Space, *, points: int = 10, hunt: HuntFacts = HuntFacts()) -> Learning:  # noqa: B008
        """Return a sampler of a space; every fifth of its trials is drawn at random."""
        return _OptunaSampler(space, self.kind, points=points, hunt=hunt)


def optuna_maker(name: str) -> OptunaMaker:
    """Return an object that creates samplers of the given name, such as ``optuna:TPESampler`` or ``optuna:tpe``.

    Raises:
        UsageError: the sampler is not suitable for hunts, or needs a further package.
        PluginError: Optuna has no such sampler.
    """
    asked = name[len(PREFIX) :]
    samplers = importlib.import_module("optuna.samplers")
    kinds = {
        _short(kind): kind
        for kind in samplers.__all__
        if kind.endswith("Sampler") and not kind.startswith("Base")
    }  # fmt: skip
    short = _short(asked)
    if short in _INSTEAD:
        raise UsageError(f"the sampler {name!r} cannot be used for hunts", fix=_INSTEAD[short])
    if short not in kinds:
        known = [kind for key, kind in kinds.items() if key not in _INSTEAD]
        raise PluginError(f"Optuna has no sampler {asked!r}", fix=one_of(asked, known))
    package, extra = _NEEDS.get(short, ("optuna", ""))
    try:
        importlib.import_module(package)
    except ImportError:
        fix = install_command(extra or "search")
        raise UsageError(f"the sampler {name!r} needs the package {package}", fix=fix) from None
    return OptunaMaker(kinds[short])


def _short(name: str) -> str:
    """Return a short name: ``tpe`` for TPESampler, tpe-sampler and TPE."""
    plain = "".join(letter for letter in name.lower() if letter.isalnum())
    return plain.removesuffix("sampler")


class _OptunaSampler(Learning):
    """A sampler whose proposals come from a study of Optuna."""

    origin = ORIGIN

    def __init__(self, space: Space, kind: str, *, points: int, hunt: HuntFacts) -> None:
        self._kind = kind
        super().__init__(space, points=points, hunt=hunt)

    def _make(self, space: Space) -> Strategy:
        return _Study(self._kind, self._cube.options, self._hunt.seed)


class _Study:
    """A study that maximizes criticality: a number from 0 to 1 for each numeric argument, a category for each choice.

    The proposals depend only on the reported results, as the sampler protocol requires, so a hunt can resume exactly.
    Each request and each report therefore uses a new Optuna sampler on the same study, seeded by that trial. A request
    leaves no trace in the study (`Storage`). A trial is added to the study when its result is reported.

    Args:
        kind: the class in ``optuna.samplers``.
        options: the number of values of each choice; 0 for a numeric argument.
        seed: seed of the hunt.
    """

    def __init__(self, kind: str, options: tuple[int, ...], seed: int) -> None:
        import optuna

        self._optuna = optuna
        self._make: Any = getattr(optuna.samplers, kind)
        self._kind = kind
        self._seed = seed % 2**32
        self._options = options
        self._distributions: dict[str, Any] = {
            f"x{index}": optuna.distributions.CategoricalDistribution(range(count))
            if count
            else optuna.distributions.FloatDistribution(0.0, 1.0)
            for index, count in enumerate(options)
        }
        self._storage = Storage()
        self._study: Any = None
        with self._seeded(self._seed):
            self._study = optuna.create_study(storage=self._storage, direction="maximize")
        if self._kind == "QMCSampler":  # learns nothing, but wants to have seen the arguments, and counts its draws
            self._add([0.5] * len(options), 0.0, 0)
            with self._seeded(self._seed):
                _ = self._study.ask().relative_params

    def tell(self, scored: ScoredTrial) -> None:
        """Report a result to the study; CMA-ES receives only the results of its own draws."""
        if self._kind == "QMCSampler" or (self._kind == "CmaEsSampler" and scored.origin != ORIGIN):
            return
        self._add(scored.point.tolist(), scored.score, scored.number)

    def propose(self, place: int, rng: np.random.Generator) -> Draft | None:
        """Return the next trial that the Optuna study proposes."""
        if self._kind == "QMCSampler":
            self._storage.count_from(place % _LONGEST)
        with self._seeded(int(rng.integers(2**31))), self._storage.asking():
            params = self._study.ask(self._distributions).params
        shares = [
            (params[name] + 0.5) / count if count else params[name]
            for name, count in zip(self._distributions, self._options, strict=True)
        ]
        return Draft(np.array(shares, dtype=np.float64))

    def _add(self, point: list[float], score: float, number: int) -> None:
        shares = zip(self._distributions, point, self._options, strict=True)
        params = {name: min(int(share * count), count - 1) if count else share for name, share, count in shares}
        with self._seeded(number):
            self._study.enqueue_trial(params)
            trial = self._study.ask(self._distributions)
            if self._kind != "GPSampler":  # which notes nothing, and takes longest
                _ = trial.relative_params  # notes in which generation it is, and the like
            self._study.tell(trial, score)

    def _sampler(self, seed: int) -> Any:
        if self._kind != "QMCSampler":
            return self._make(seed=seed)
        # The sequence is one and the same; what it has no place for, as categories in Optuna 4.0, is not.
        return self._make(
            seed=self._seed, scramble=True, independent_sampler=self._optuna.samplers.RandomSampler(seed=seed)
        )

    @contextmanager
    def _seeded(self, seed: int) -> Iterator[None]:
        """Return a context with a new sampler that has the given seed, without warnings and log messages of Optuna."""
        logging, known = self._optuna.logging, self._optuna.logging.get_verbosity()
        logging.set_verbosity(logging.ERROR)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                if self._study is not None:
                    self._study.sampler = self._sampler(seed)
                yield
        finally:
            logging.set_verbosity(known)


# A storage for Optuna studies that learn from reported results only.

_ASKED = -1  # the id of a requested trial; reported trials have ids from 0


class Storage(InMemoryStorage):  # type: ignore[misc] # whose types are not looked at
    """Keeps trials in memory; a requested trial exists only during the request.

    Optuna's samplers keep their state in the study: the generation in which a trial was requested, the state of CMA-ES,
    the parents of a generation. Without this class, proposals would depend on requests whose results never arrived.
    """

    def __init__(self) -> None:
        super().__init__()
        self._asked: FrozenTrial | None = None
        self.count = 0
        """The number of trials."""

    @contextmanager
    def asking(self) -> Iterator[None]:
        """Return a context in which everything that is written is discarded at the end."""
        self._asked = FrozenTrial(
            number=self.count, trial_id=_ASKED, state=TrialState.RUNNING, value=None, datetime_start=None,
            datetime_complete=None, params={}, distributions={}, user_attrs={}, system_attrs={}, intermediate_values={},
        )  # fmt: skip
        try:
            yield
        finally:
            self._asked = None

    def create_new_trial(self, study_id: int, template_trial: FrozenTrial | None = None) -> int:
        """Return the id of the requested trial, or of a new trial."""
        if self._asked is not None:
            return _ASKED
        self.count += 1
        made: int = super().create_new_trial(study_id, template_trial)
        return made

    def get_trial(self, trial_id: int) -> FrozenTrial:
        """Return a trial."""
        return self._asked if trial_id == _ASKED and self._asked is not None else super().get_trial(trial_id)

    def set_trial_param(self, trial_id: int, param_name: str, param_value_internal: float, distribution: Any) -> None:
        """Store the value of an argument."""
        if trial_id != _ASKED:
            super().set_trial_param(trial_id, param_name, param_value_internal, distribution)
            return
        assert self._asked is not None
        self._asked.distributions[param_name] = distribution
        self._asked.params[param_name] = distribution.to_external_repr(param_value_internal)

    def set_trial_system_attr(self, trial_id: int, key: str, value: Any) -> None:
        """Store what a sampler records about a trial."""
        if trial_id != _ASKED:
            super().set_trial_system_attr(trial_id, key, value)
            return
        assert self._asked is not None
        self._asked.system_attrs[key] = value

    def set_study_system_attr(self, study_id: int, key: str, value: Any) -> None:
        """Store what a sampler records about the study."""
        if self._asked is None:
            super().set_study_system_attr(study_id, key, value)

    def count_from(self, drawn: int) -> None:
        """Set the draw counters that samplers keep in attributes of the study, as after that number of draws."""
        for study in self.get_all_studies():
            for key in study.system_attrs:
                self.set_study_system_attr(study._study_id, key, drawn - 1)
