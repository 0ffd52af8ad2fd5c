"""The storage of a study of Optuna that learns from what is told alone: what is asked leaves no trace in it."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from optuna.storages import InMemoryStorage
from optuna.trial import FrozenTrial, TrialState

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["Storage"]

_ASKED = -1  # the id of the trial that is asked for; those that are told have 0 and more


class Storage(InMemoryStorage):  # type: ignore[misc] # whose types are not looked at
    """In memory; while something is asked, the new trial is beside the others, and is forgotten afterwards.

    Optuna's samplers keep what they know in the study: in which generation a trial was asked for, the state of CMA-ES,
    the parents of a generation. So, what they propose would depend on what was asked before and never told.
    """

    def __init__(self) -> None:
        super().__init__()
        self._asked: FrozenTrial | None = None
        self.count = 0
        """How many trials there are."""

    @contextmanager
    def asking(self) -> Iterator[None]:
        """Forget afterwards what is written in between."""
        self._asked = FrozenTrial(
            number=self.count, trial_id=_ASKED, state=TrialState.RUNNING, value=None, datetime_start=None,
            datetime_complete=None, params={}, distributions={}, user_attrs={}, system_attrs={}, intermediate_values={},
        )  # fmt: skip
        try:
            yield
        finally:
            self._asked = None

    def create_new_trial(self, study_id: int, template_trial: FrozenTrial | None = None) -> int:
        """Return the id of the trial that is asked for, or of a new one."""
        if self._asked is not None:
            return _ASKED
        self.count += 1
        made: int = super().create_new_trial(study_id, template_trial)
        return made

    def get_trial(self, trial_id: int) -> FrozenTrial:
        """Return a trial."""
        return self._asked if trial_id == _ASKED and self._asked is not None else super().get_trial(trial_id)

    def set_trial_param(self, trial_id: int, param_name: str, param_value_internal: float, distribution: Any) -> None:
        """Note the value of an argument."""
        if trial_id != _ASKED:
            super().set_trial_param(trial_id, param_name, param_value_internal, distribution)
            return
        assert self._asked is not None
        self._asked.distributions[param_name] = distribution
        self._asked.params[param_name] = distribution.to_external_repr(param_value_internal)

    def set_trial_system_attr(self, trial_id: int, key: str, value: Any) -> None:
        """Note what a sampler wants to know of a trial."""
        if trial_id != _ASKED:
            super().set_trial_system_attr(trial_id, key, value)
            return
        assert self._asked is not None
        self._asked.system_attrs[key] = value

    def set_study_system_attr(self, study_id: int, key: str, value: Any) -> None:
        """Note what a sampler wants to know of the study."""
        if self._asked is None:
            super().set_study_system_attr(study_id, key, value)

    def count_from(self, drawn: int) -> None:
        """Have samplers that count what they drew, in attributes of the study, go on as after so many draws."""
        for study in self.get_all_studies():
            for key in study.system_attrs:
                self.set_study_system_attr(study._study_id, key, drawn - 1)
