"""Running candidates, where what runs them knows less than is asked."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from crashhunt.base.errors import CrashhuntError, RecorderError
from crashhunt.shrinking import _runs
from crashhunt.trial import EVERYBODY, TrialSpec


@dataclass
class Worker:
    scratch: object = None
    keep_trials: bool = True
    code: tuple = ()


class Refuses:
    """A crashhunt that is too old to leave anybody out.

    Args:
        worker, parallel: as of any executor.
    """

    error = CrashhuntError

    def __init__(self, worker, *, parallel):
        pass

    def submit(self, spec):
        self.spec = spec

    def completed(self, timeout_s):
        raise self.error(f"trial {self.spec.number} has only, which crashhunt 0.1.0 does not know")


def test_an_older_crashhunt_that_refuses_to_leave_others_out_has_nobody_left_out(tmp_path, monkeypatch):
    monkeypatch.setattr(_runs, "PoolExecutor", Refuses)
    rerun = SimpleNamespace(worker=Worker(), bundle=SimpleNamespace(result=SimpleNamespace(steps_begun=9)))
    words = {"parallel": 1, "budget": 9, "time_s": None, "stopped": lambda: False, "watch": None}
    runs = _runs.Runs(rerun, None, tmp_path, tmp_path / "memory", **words)
    spec = TrialSpec(0, 1, {}, {}, 9, only=(EVERYBODY,))
    assert runs.entered(spec) == ()
    monkeypatch.setattr(Refuses, "error", RecorderError)
    with pytest.raises(RecorderError):  # of a full disk nobody concludes anything
        runs.entered(spec)
