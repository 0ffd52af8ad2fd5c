"""Peers in the study of samplers, `scripts/search`: optional packages, and the limit for slow samplers."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts"


@pytest.fixture(scope="module")
def study():
    before = {*sys.modules}
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(SCRIPTS))
        yield importlib.import_module("search")
    for name in {*sys.modules} - before:
        path = getattr(sys.modules[name], "__file__", None)
        if path is not None and Path(path).parent == SCRIPTS:
            del sys.modules[name]


def test_a_peer_whose_package_is_missing_is_skipped_with_one_line(study, monkeypatch, capsys):
    monkeypatch.setattr(sys.modules["peers"].importlib.util, "find_spec", lambda name: None if name == "smac" else name)
    assert study._installed(["guided", "smac", "turbo", "optuna-tpe"]) == ["guided", "turbo", "optuna-tpe"]
    assert capsys.readouterr().err == "skipped, because a package is not installed: smac (pip install smac)\n"


def test_slow_peers_and_those_with_packages_are_peers(study):
    peers = sys.modules["peers"]
    assert {*peers.SLOW} <= {*peers.PEERS}
    assert {*peers._PACKAGES} <= {*peers.PEERS}


def test_a_hunt_ends_at_the_limit(study):
    runs = [study.synthetic_run("needle", "random", seed, limit=7) for seed in range(3)]
    assert [(run.trials, run.found) for run in runs] == [(7, False)] * 3  # one trial in 5000 crashes
