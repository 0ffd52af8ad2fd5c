"""What an early crashhunt leaves out of a trial is noticed: it has run another one."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from crashhunt.analysis import SetArguments, WhatIfOptions, _whatif_runs as _engine, what_if
from crashhunt.base.errors import UsageError, WorkerError
from crashhunt.trial import Disturbance, Overruled, TrialSpec
from crashhunt.trial_reruns import NotUnderstoodError, _require_same_trial

SPEC = TrialSpec(1, 2, {"ego": {"speed": 3.0}}, {}, 9)


@pytest.mark.parametrize(
    "asked",
    [
        {"overruled": Overruled("ego", 3)},
        {"overruled": Overruled("ego", 3, keeps="lane")},
        {"disturbances": (Disturbance(3, "itself", "gone", 0.0, 9.0, "ego", "other"),)},
        {"only": ()},
    ],
)
def test_another_trial_than_was_asked_for_is_refused(asked):
    spec = replace(SPEC, **asked)
    _require_same_trial(spec, TrialSpec.from_json(spec.to_json()))
    with pytest.raises(NotUnderstoodError, match="too old"):
        _require_same_trial(spec, SPEC)


@pytest.mark.parametrize(
    ("error", "code", "is_current", "says"),
    [
        (NotUnderstoodError("another trial"), "snapshot", False, "is too old for this change"),
        (WorkerError("no key 'reseeding'"), "snapshot", False, "is too old for this change: no key 'reseeding'"),
        (WorkerError("no memory"), "snapshot", True, ""),
        (WorkerError("no memory"), "current", False, ""),
    ],
)
def test_snapshot_that_does_not_know_a_change_is_too_old_for_it(monkeypatch, error, code, is_current, says):
    def fails(specs):
        raise error

    closed = []
    rerun = SimpleNamespace(spec=SPEC, code=code, recorded=None, edits=(), warnings=())
    reruns = SimpleNamespace(run=fails, close=lambda: closed.append(True))
    monkeypatch.setattr(_engine, "_check", lambda *given: None)
    monkeypatch.setattr(_engine, "prepare", lambda bundle, options: rerun)
    monkeypatch.setattr(_engine, "is_current_code", lambda given: is_current)
    monkeypatch.setattr(_engine, "reruns_of", lambda *given, **more: reruns)
    monkeypatch.setattr(SetArguments, "applied", lambda self, given: given)
    with pytest.raises(UsageError if says else WorkerError) as caught:
        what_if(SimpleNamespace(id="c"), [SetArguments(changes={"speed": 5.0})], WhatIfOptions())
    assert caught.value.message.endswith(says or "no memory")
    assert not says or caught.value.fix == "add --code current"
    assert closed == [True]
