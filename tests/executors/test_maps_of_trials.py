"""Two slots that write the maps of their trials at the same moment."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from crashhunt.executors._postmortem import read_map
from crashhunt.executors._supervisor import Supervisor


def one_lane(name: str) -> str:
    return json.dumps([[name, 3.2, [[0.0, 0.0], [1.0, 0.0]]]])


@pytest.mark.parametrize("at_once", [False, True])
def test_each_kept_trial_has_its_own_map(tmp_path, monkeypatch, at_once):
    slot = SimpleNamespace(_settings=SimpleNamespace(scratch=tmp_path))
    if at_once:  # neither slot sees the file of the other one when it looks
        monkeypatch.setattr(Path, "exists", lambda _: False)
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        Supervisor._write_map(slot, one_lane(name), tmp_path / name)
    assert [lane.id for name in ("a", "b") for lane in read_map(tmp_path, tmp_path / name)] == ["a", "b"]


def test_map_that_all_trials_share_is_written_once(tmp_path):
    slot = SimpleNamespace(_settings=SimpleNamespace(scratch=tmp_path))
    kept = tmp_path / "kept"
    kept.mkdir()
    Supervisor._write_map(slot, one_lane("a"), None)
    Supervisor._write_map(slot, one_lane("a"), kept)
    Supervisor._write_map(slot, None, kept)
    assert list(kept.iterdir()) == []
    assert [lane.id for lane in read_map(tmp_path, kept)] == ["a"]
