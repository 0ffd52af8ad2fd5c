"""Trials that are made up, for hunts without processes."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from crashhunt.hunts import _hunt
from crashhunt.snapshots import _take
from crashhunt.trial import Outcome, TrialResult


def survives(spec):
    return TrialResult(spec, Outcome.SURVIVED, steps=10 + spec.number, digest=f"{spec.number:032x}", danger=0.5)


class Inline:
    """An executor with two workers, which returns one result at each call."""

    capacity, first = 2, 0

    def __init__(self, settings, *, parallel, ends):
        self.settings, self.parallel, self.ends = settings, parallel, ends
        self.waiting, self.submitted, self.most, self.cancelled, self.closed, self.said = [], [], 0, [], 0, ["a note"]

    def submit(self, spec):
        self.submitted.append(spec)
        self.waiting.append(spec)
        self.most = max(self.most, len(self.waiting))

    def completed(self, timeout_s):
        assert timeout_s == _hunt._TICK_S
        if self.waiting:
            yield self.ends(self.waiting.pop(self.first))

    def cancel(self, *, above=-1):
        self.cancelled.append(above)
        self.waiting = [spec for spec in self.waiting if spec.number <= above]

    def where(self):
        return {spec.number: "header" for spec in self.waiting}

    def notes(self):
        said, self.said = self.said, []
        return said

    def close(self):
        self.closed += 1


def replace_bundles(monkeypatch):
    """Replace bundles: each is confirmed, and has the result of its trial; returns the numbers of their trials."""
    written = []

    def write(folder, result, trial, *, hunt_seed, snapshot, lanes, recording):
        written.append(result.spec.number)
        return SimpleNamespace(result=result, id=f"{result.spec.number:06d}", confirmed=True, path=folder)

    monkeypatch.setattr(_hunt, "write_bundle", write)
    monkeypatch.setattr(_hunt, "read_black_box", lambda path: [])
    monkeypatch.setattr(_hunt, "Recording", lambda records: None)
    monkeypatch.setattr(_hunt.TrialReruns, "confirm", lambda again, crashes: list(crashes))
    return written


def leave_own_code_out(monkeypatch):
    """Leave crashhunt itself out of snapshots: hundreds of files, which take longer than a hunt on made-up results.

    A developer may also change them while tests run.
    """
    take = _take._take_module
    monkeypatch.setattr(_take, "_take_module", lambda name, *words: None if name == "crashhunt" else take(name, *words))


@pytest.fixture
def bundles(monkeypatch):
    return replace_bundles(monkeypatch)
